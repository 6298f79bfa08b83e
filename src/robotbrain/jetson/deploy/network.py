"""What a bundle says about its network: inputs, outputs and types, and vectors to check an engine with."""

from __future__ import annotations

import hashlib
import math
import re
import threading
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robotbrain.errors import InputError
from robotbrain.jetson.deploy.contents import MAX_BYTES
from robotbrain.optimisation.onnx_files import contents
from robotbrain.pipeline.segmentation import CLASSES, MEAN, STD

MODEL = "model.onnx"
"""Name of the network's file in a bundle."""

VECTORS = 3
"""Inputs with expected outputs in a bundle."""

TIME_LIMIT_S = 300.0
"""Time for computing all expected outputs, s."""

TOLERANCES: Mapping[str, Mapping[str, float]] = {
    "fp32": {"rms": 1e-4, "peak": 1e-3, "agreement": 0.999},
    "tf32": {"rms": 5e-3, "peak": 2e-2, "agreement": 0.995},
    "fp16": {"rms": 5e-3, "peak": 2e-2, "agreement": 0.995},
    "int8": {"rms": 5e-2, "peak": 0.2, "agreement": 0.97},
    "int8-calibrated": {"rms": 0.1, "peak": 0.5, "agreement": 0.95},
}
"""How far an engine's outputs may be from the expected ones, by its arithmetic; rules of this kit, not of NVIDIA.

``rms``: root mean square of the error over that of the expected output. ``peak``: largest error over the largest
expected magnitude. ``agreement``: share of positions with the same largest class. FP16 and TF32 round to 11 bits, a
relative 5e-4 an operation, which grows over some tens of layers. A QDQ network is compared with itself in float
emulation: where a value lies between two steps the engine may take the other one, and this goes on from layer to layer.
An engine from a calibration cache is compared with the float network, so the quantisation error itself is in it. On the
kit's teacher, torch in float16 is 6e-4 (rms) from float32, integer kernels are 1.2e-2 from float emulation, and INT8 is
2e-2 from float32: the bounds are some five times that.
"""

_TENSOR_NAME = re.compile(r"[^\s,'\"\\]{1,200}")  # trtexec separates names with commas and quotes them with '


@dataclass(frozen=True)
class Preprocessing:
    """How a camera image becomes the network's input.

    Attributes:
        mean, std: by channel, of values scaled to 0..1: ``(pixel / 255 - mean) / std``.
        classes: names of the output's classes, in their order; empty if not known.
        layout, colour: of the input.
    """

    mean: tuple[float, ...] = MEAN
    std: tuple[float, ...] = STD
    classes: tuple[str, ...] = CLASSES
    layout: str = "NCHW"
    colour: str = "RGB"

    def __post_init__(self) -> None:
        finite = bool(np.isfinite([*self.mean, *self.std]).all())
        if len(self.mean) != len(self.std) or not self.mean or not finite or min(self.std, default=0) <= 0:
            raise InputError(
                "preprocessing",
                given={"mean": self.mean, "std": self.std},
                expected="a mean and a positive standard deviation for each channel",
                fix="Name those that the network was trained with, for example --mean 0.45,0.45,0.45.",
            )

    def section(self) -> dict[str, Any]:
        """Return the section of a manifest."""
        return {key: list(value) if isinstance(value, tuple) else value for key, value in asdict(self).items()}


@dataclass(frozen=True)
class Tensor:
    """An input or output: its name, numpy's name of its type, and its shape with the batch filled in."""

    name: str
    dtype: str
    shape: tuple[int, ...]


@dataclass(frozen=True)
class Network:
    """What an ONNX file is, as far as a deployment must know.

    Attributes:
        sha256: of the file.
        opset: version of the default operator set.
        inputs, outputs: see Tensor; the shape of an output is the ONNX's own, 0 where it does not say.
        dynamic: whether the batch was left open by the exporter.
        quantised: it has QuantizeLinear or DequantizeLinear.
        half: it has float16 tensors.
        nodes: names of operators, each once.
        tensors: names of all tensors.
    """

    sha256: str
    opset: int
    inputs: tuple[Tensor, ...]
    outputs: tuple[Tensor, ...]
    dynamic: bool
    quantised: bool
    half: bool
    nodes: frozenset[str]
    tensors: frozenset[str]

    def section(self) -> dict[str, Any]:
        """Return the section of a manifest."""
        return {
            "file": MODEL,
            "sha256": self.sha256,
            "opset": self.opset,
            "inputs": [{**asdict(tensor), "shape": list(tensor.shape)} for tensor in self.inputs],
            "outputs": [{"name": tensor.name, "dtype": tensor.dtype} for tensor in self.outputs],
            "dynamic": self.dynamic,
            "quantised": self.quantised,
            "half": self.half,
        }


def inspect(content: bytes, batch: int = 1) -> Network:
    """Return what an ONNX file is.

    Args:
        content: of the file.
        batch: inputs in one query, where the ONNX leaves it open.

    Raises:
        InputError: if it is no valid ONNX, keeps weights in another file, or has inputs that a bundle cannot hold.
    """
    import onnx

    try:
        model = onnx.load_model_from_string(content)
        nodes, weights = contents(model)
        # Before the checker, which would open whatever file they name.
        external = any(tensor.data_location == onnx.TensorProto.EXTERNAL for tensor in weights)
        if not external:
            onnx.checker.check_model(model)
    except Exception as error:  # protobuf's and the checker's own, without a public base
        fix = f"ONNX says: {str(error).strip().partition(chr(10))[0][:200]}"
        raise InputError("model", given=f"{len(content)} bytes", expected="a valid ONNX file", fix=fix) from error
    if external:
        raise InputError(
            "model",
            given="an ONNX that keeps its weights in another file",
            expected="one file with the weights inside",
            fix='Save it whole: onnx.save(onnx.load("MODEL.onnx"), "WHOLE.onnx").',
        )
    opset = next((entry.version for entry in model.opset_import if entry.domain in ("", "ai.onnx")), 0)
    initial = {tensor.name for tensor in model.graph.initializer}
    inputs = [value for value in model.graph.input if value.name not in initial]
    if not inputs:
        raise InputError("model", given="no input", expected="one input or more", fix="Export what takes an image.")
    return Network(
        sha256=hashlib.sha256(content).hexdigest(),
        opset=opset,
        inputs=tuple(_tensor(value, batch) for value in inputs),
        outputs=tuple(_tensor(value, None) for value in model.graph.output),
        dynamic=any(not v.type.tensor_type.shape.dim[0].HasField("dim_value") for v in inputs),
        quantised=any(node.op_type in ("QuantizeLinear", "DequantizeLinear") for node in nodes),
        half=any(tensor.data_type == onnx.TensorProto.FLOAT16 for tensor in weights),
        nodes=frozenset(node.op_type for node in nodes),
        tensors=frozenset(name for node in nodes for name in (*node.input, *node.output)),
    )


def arithmetic_of(precision: str, *, tf32: bool, calibrated: bool) -> str:
    """Return which of :data:`TOLERANCES` an engine falls under."""
    if precision == "int8":
        return "int8-calibrated" if calibrated else "int8"
    return "tf32" if precision == "fp32" and tf32 else precision


def preprocessing_of(network: Network, given: Preprocessing | None) -> Preprocessing | None:
    """Return the preprocessing of a network of one image; None for any other network.

    Args:
        network: what it is for.
        given: what somebody says it is; None: that of the kit's networks, without classes if it has others.

    Raises:
        InputError: if the channels or classes are not the network's.
    """
    if len(network.inputs) != 1 or len(network.inputs[0].shape) != 4:
        if given is not None:
            raise InputError(
                "preprocessing", given=given, expected="none: the network takes no image", fix="Leave it out."
            )
        return None
    channels = network.inputs[0].shape[1]
    counts = {tensor.shape[1] for tensor in network.outputs if len(tensor.shape) > 1}
    found = given or Preprocessing()
    if given is None and counts != {len(found.classes)}:
        found = replace(found, classes=())
    if len(found.mean) != channels or (found.classes and not {0, len(found.classes)} & counts):
        raise InputError(
            "preprocessing",
            given=f"{len(found.mean)} channels, {len(found.classes)} classes",
            expected=f"those of the network: {channels} channels, {sorted(counts)} classes",
            fix="Name them with --mean, --std and --classes.",
        )
    return found


def make_inputs(
    network: Network, preprocessing: Preprocessing | None, given: NDArray[np.float32] | None, seed: int
) -> list[dict[str, NDArray[Any]]]:
    """Return inputs to check an engine with: the first of those given, else seeded pictures (or noise).

    Args:
        network: what they are for.
        preprocessing: of pictures; None for noise.
        given: (N, ...) normalised inputs, N at least VECTORS times the batch; for a network of one input.
        seed: of what is made up.

    Raises:
        InputError: if the given ones do not fit.
    """
    first = network.inputs[0]
    if given is not None:
        wanted, have = (VECTORS * first.shape[0], *first.shape[1:]), given.shape
        fits = len(network.inputs) == 1 and have[1:] == wanted[1:] and have[0] >= wanted[0]
        if not fits or given.dtype != np.float32 or not np.isfinite(given).all():
            raise InputError(
                "inputs",
                given=f"{given.dtype} {have}",
                expected=f"float32 {wanted} or more of them, finite, for a network of one input",
                fix="Normalise them as the network takes them (pipeline.segmentation.normalise).",
            )
        return [{first.name: part} for part in given[: wanted[0]].reshape(VECTORS, *first.shape)]
    rng = np.random.default_rng(seed)
    if preprocessing is not None:
        return [{first.name: _picture(first, preprocessing, rng)} for _ in range(VECTORS)]
    return [
        {tensor.name: rng.standard_normal(tensor.shape).astype(np.float32) for tensor in network.inputs}
        for _ in range(VECTORS)
    ]


def run(content: bytes, inputs: Sequence[Mapping[str, NDArray[Any]]]) -> list[dict[str, NDArray[Any]]]:
    """Return the outputs by name of ONNX Runtime without optimisation (INT8 is emulated in float then), one thread.

    Raises:
        InputError: if it cannot run the network, not within TIME_LIMIT_S, or the outputs are not finite.
    """
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4
    # INT8 kernels of some processors saturate; float emulation is the reference everywhere.
    options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_DISABLE_ALL
    # A Loop may go on for ever, and an interrupt from the keyboard does not reach ONNX Runtime.
    limits = onnxruntime.RunOptions()
    limits.log_severity_level = 4
    timer = threading.Timer(TIME_LIMIT_S, setattr, (limits, "terminate", True))
    timer.daemon = True
    timer.start()
    try:
        session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
        names = [output.name for output in session.get_outputs()]
        results = [dict(zip(names, session.run(names, dict(feed), limits), strict=True)) for feed in inputs]
    except Exception as error:  # ONNX Runtime raises a family of its own, without a common public base
        raise InputError(
            "model",
            given="an ONNX that ONNX Runtime does not run",
            expected="a network that runs here, too",
            fix=f"ONNX Runtime says: {str(error).splitlines()[0][:200]}",
        ) from error
    finally:
        timer.cancel()
    if not all(value.size and np.isfinite(value).all() for result in results for value in result.values()):
        raise InputError(
            "model", given="NaN, infinity or no values", expected="finite outputs", fix="Check weights and inputs."
        )
    return results


def _picture(tensor: Tensor, preprocessing: Preprocessing, rng: np.random.Generator) -> NDArray[np.float32]:
    """Return tiles of random colours with grain: flat parts, edges and noise, as camera images have them."""
    batch, channels, height, width = tensor.shape
    rows, columns = -(-height // 8), -(-width // 8)
    tiles = rng.integers(0, 256, (batch, channels, rows, columns))
    grain = rng.integers(-16, 17, tensor.shape)
    pixels = np.clip(np.kron(tiles, np.ones((1, 1, 8, 8), int))[:, :, :height, :width] + grain, 0, 255)
    mean, std = (np.reshape(values, (1, -1, 1, 1)) for values in (preprocessing.mean, preprocessing.std))
    made: NDArray[np.float32] = ((pixels / 255.0 - mean) / std).astype(np.float32)
    return made


def _tensor(value: Any, batch: int | None) -> Tensor:
    import onnx

    kind = value.type.tensor_type
    dims = [dim.dim_value if dim.HasField("dim_value") else 0 for dim in kind.shape.dim]
    dtype = {onnx.TensorProto.FLOAT: "float32", onnx.TensorProto.FLOAT16: "float16"}.get(kind.elem_type)
    if not _TENSOR_NAME.fullmatch(value.name) or dtype is None or (batch is not None and dtype != "float32"):
        raise InputError(
            f"tensor {value.name!r}",
            given=f"type {kind.elem_type}",
            expected="a name without spaces, quotes and commas; inputs in float32, outputs in float32 or float16",
            fix="Export the network with float inputs and outputs (TensorRT converts inside).",
        )
    if batch is not None and dims and dims[0] == 0:
        dims[0] = batch
    if batch is not None and (not dims or min(dims) < 1 or dims[0] != batch):
        raise InputError(
            f"input {value.name!r}",
            given=f"shape {dims} (0: left open)",
            expected=f"{batch} in the first dimension, the others fixed",
            fix="Export with fixed height and width; choose the batch with --batch.",
        )
    if batch is not None and 4 * VECTORS * math.prod(dims) > MAX_BYTES // 2:
        raise InputError(
            f"input {value.name!r}",
            given=f"shape {dims}, {4 * math.prod(dims) / 1e6:.0f} MB",
            expected=f"at most {MAX_BYTES / 2e6 / VECTORS:.0f} MB: a bundle holds {VECTORS} of them",
            fix="Choose a smaller --batch.",
        )
    return Tensor(value.name, dtype, tuple(dims))

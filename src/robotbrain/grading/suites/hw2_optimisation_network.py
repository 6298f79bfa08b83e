"""How `hw2_optimisation` reads a submitted network: as data from a stranger.

Before ONNX Runtime or the twin sees the file, :mod:`robotbrain.untrusted_onnx` judges it by the limits given here. The
network is measured in the tests' own process, where no student's code runs.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import Any

import numpy as np

from robotbrain.errors import InputError
from robotbrain.grading import expect, fail
from robotbrain.grading.suites.hw2_optimisation_probes import Array
from robotbrain.untrusted_onnx import (
    Limits,
    check_graph,
    check_work,
    first_line,
    open_session,
    parse_limited,
    read_limited,
)

MAX_BYTES = 16 * 2**20
"""Four times the teacher: what is merely too large for the budget is told so by its own test."""
MAX_NODES = 1000
BATCH = 10
"""Images that are handed to the network at once."""
MAX_ELEMENTS = 4_000_000
"""Numbers in any tensor, for ``BATCH`` images."""
MAX_WRITTEN = 60_000_000
"""Numbers in the outputs of all nodes together, for ``BATCH`` images."""
MAX_WORK = 5_000_000_000
"""Multiply-adds and numbers read or written for ``BATCH`` images: some five times the teacher's."""
OPSETS = range(13, 22)
SIZE = 64
QUANTISERS = ("QuantizeLinear", "DequantizeLinear")
SAME_NETWORK = 0.96
"""Two networks whose logits correlate so well on noise are one."""

# fmt: off
ALLOWED_OPS = frozenset((
    "Add", "AveragePool", "BatchNormalization", "Cast", "Clip", "Concat", "Constant", "Conv", "ConvTranspose",
    "DepthToSpace", "DequantizeLinear", "Div", "Elu", "Flatten", "Gather", "Gemm", "GlobalAveragePool", "HardSigmoid",
    "HardSwish", "Identity", "LeakyRelu", "MatMul", "Max", "MaxPool", "Min", "Mul", "Neg", "PRelu", "Pad",
    "QuantizeLinear", "ReduceMean", "Relu", "Reshape", "Resize", "Shape", "Sigmoid", "Slice", "Softmax",
    "SpaceToDepth", "Split", "Sqrt", "Squeeze", "Sub", "Tanh", "Transpose", "Unsqueeze",
))
# fmt: on
"""Operators that a segmentation network needs: no control flow, no state, no random numbers, no library of its own."""

LIMITS = Limits(
    what="network",
    fix="Export the network again with export_onnx.",
    ops=ALLOWED_OPS,
    opsets=OPSETS,
    rows=BATCH,
    max_nodes=MAX_NODES,
    max_elements=MAX_ELEMENTS,
    max_written=MAX_WRITTEN,
    max_work=MAX_WORK,
)

HINTS = {
    "file-beside-the-notebook": "The file must lie beside the notebook, under the name that the notebook gives it, and "
    "be handed in with it.",
    "not-a-network": "This file cannot be used as it is. Make it with `export_onnx` and `quantise_onnx`, and look at "
    "it before you hand it in: `onnx.checker.check_model`.",
    "image-in-logits-out": "The network takes normalised images (N, 3, 64, 64) and returns logits (N, 4, 64, 64), "
    "float32, N open: as `export_onnx` writes it.",
    "numbers-are-finite": "A network that answers NaN or infinity has diverged, or has a scale of 0.",
    "each-image-alone": "The answer to an image must not depend on the others in the batch: was the network exported "
    "in eval mode?",
    "train-your-own": "This is a network that the kit ships. Train one of your own: build_student, and your "
    "distil_step.",
}


@dataclass(frozen=True)
class Network:
    """A submitted network that keeps within the limits.

    Attributes:
        path: of the file.
        size_bytes: of the file.
        model: the parsed ``onnx.ModelProto``.
        session: ONNX Runtime's, which computes the graph as it is written.
    """

    path: Path
    size_bytes: int
    model: Any
    session: Any

    @property
    def quantised(self) -> bool:
        """Whether there are Q/DQ nodes in it."""
        return any(node.op_type in QUANTISERS for node in self.model.graph.node)

    def logits(self, inputs: Array) -> Array:
        """Return (N, 4, 64, 64) for (N, 3, 64, 64)."""
        name = self.session.get_inputs()[0].name
        rows = 1 if isinstance(self.session.get_inputs()[0].shape[0], int) else BATCH
        parts = [self.session.run(None, {name: inputs[i : i + rows]})[0] for i in range(0, len(inputs), rows)]
        return np.concatenate(parts)

    @functools.cached_property
    def on_noise(self) -> Array:
        """Logits for images of noise."""
        return self.logits(_noise())


def load(student: Any) -> Network:
    """Return the network in the file that was handed in, or fail and say what it is instead."""
    name = student.STUDENT
    if not isinstance(name, str) or Path(name).name != name:
        fail("the name of the file should be a plain file name", got=name, expected='"student_int8.onnx"',
             hint="file-beside-the-notebook")  # fmt: skip
    path = student.files / name
    if not path.is_file():
        fail(f"there is no file {name} beside the notebook", hint="file-beside-the-notebook")
    try:
        return _loaded(path, read_limited(path, MAX_BYTES))
    except InputError as error:
        fail(f"{name} cannot be used: {error.what}", got=error.given, expected=error.expected, hint="not-a-network")
        raise  # for the type checker: fail always raises


@functools.lru_cache(maxsize=2)
def _loaded(path: Path, data: bytes) -> Network:
    """Return the network in a file's bytes; read, checked and opened once for all tests."""
    network = Network(path, len(data), checked_model(data), _session(data))
    _check_shapes(network)
    return network


def checked_model(data: bytes) -> Any:
    """Parse a file's bytes and return the ``onnx.ModelProto`` if it keeps within this module's limits.

    Raises:
        InputError: otherwise.
    """
    model = parse_limited(data, LIMITS)
    check_graph(model, LIMITS)
    check_work(model, LIMITS)
    return model


def _session(data: bytes) -> Any:
    # As it is written, Q/DQ pairs around float operators: fused integer kernels saturate on some CPUs, this does not.
    return open_session(data, LIMITS, as_written=True)


def session_of(model: Any) -> Any:
    """Return a session for a model that :func:`checked_model` has passed, or that was made from one."""
    return _session(model.SerializeToString())


def _check_shapes(network: Network) -> None:
    """Fail unless images go in and logits come out, finite, each image by itself."""
    import onnx

    weights = {tensor.name for tensor in network.model.graph.initializer}
    for what, ends, channels in (
        ("input", [i for i in network.model.graph.input if i.name not in weights], 3),
        ("output", list(network.model.graph.output), 4),
    ):
        wanted = f"one float32 {what}, ('batch', {channels}, {SIZE}, {SIZE})"
        shapes = [tuple(d.dim_value or d.dim_param or "?" for d in end.type.tensor_type.shape.dim) for end in ends]
        kinds = {end.type.tensor_type.elem_type for end in ends}
        good = len(ends) == 1 and kinds == {onnx.TensorProto.FLOAT} and len(shapes[0]) == 4
        fixed = good and isinstance(shapes[0][0], int) and shapes[0][0] != 1
        if what == "input":
            good = good and shapes[0][1:] == (channels, SIZE, SIZE)
        expect(good and not fixed, f"the network's {what} is not as it should be", got=shapes or "none",
               expected=wanted, hint="image-in-logits-out")  # fmt: skip
    try:
        together = network.on_noise
        alone = np.concatenate([network.logits(image[None]) for image in _noise()])
    except Exception as error:  # ONNX Runtime raises a family of its own
        fail(f"the network does not run: {first_line(error)}", hint="not-a-network")
    expect(together.shape == (3, 4, SIZE, SIZE), "the network's output is not as it should be", got=together.shape,
           given="three images", expected=(3, 4, SIZE, SIZE), hint="image-in-logits-out")  # fmt: skip
    expect(bool(np.isfinite(together).all()), "the network answers NaN or infinity", given="three images of noise",
           hint="numbers-are-finite")  # fmt: skip
    apart = float(np.abs(together - alone).max())
    expect(apart <= 1e-3 * max(1.0, float(np.abs(alone).max())), "the answer depends on the other images of the batch",
           got=f"logits differ by {apart:.3g}", expected="each image by itself", hint="each-image-alone")  # fmt: skip


# ---------------------------------------------------------------- whose network is it?


def check_own(network: Network) -> None:
    """Fail if this network computes what one that the kit ships computes, whatever its graph looks like.

    It is asked about noise: on scenes all good networks agree (their logits correlate by up to 0.97), but what they say
    about noise they were never taught. There a quantised copy correlates with its original by more than 0.99, and
    networks that were trained separately by less than 0.9.
    """
    for name, logits in shipped_logits().items():
        alike = _likeness(network.on_noise, logits)
        expect(alike < SAME_NETWORK, f"this is the kit's {name}", given=f"{network.path.name} and images of noise",
               got=f"logits that correlate with the kit's by {alike:.3f}", hint="train-your-own")  # fmt: skip


@functools.cache
def _noise() -> Array:
    return np.random.default_rng(1).normal(0, 1, (3, 3, SIZE, SIZE)).astype(np.float32)


@functools.cache
def shipped_logits() -> dict[str, Array]:
    """Return what the kit's networks say about noise, by name."""
    from robotbrain.optimisation.networks import network_path

    found = {}
    for name in ("student", "student_plain", "teacher"):
        path = network_path(name)
        if path.is_file():
            session = _session(path.read_bytes())
            found[name] = session.run(None, {session.get_inputs()[0].name: _noise()})[0]
    return found


def _likeness(a: Array, b: Array) -> float:
    """Return the correlation of two networks' logits, apart from what a softmax does not see; -1 to 1."""
    a, b = (v - v.mean(axis=1, keepdims=True) for v in (a.astype(float), b.astype(float)))
    return float((a * b).sum() / max(1e-12, np.linalg.norm(a) * np.linalg.norm(b)))


# ---------------------------------------------------------------- how much of it runs in integers


def quantised_work(model: Any) -> tuple[int, int]:
    """Return the multiply-adds of convolutions and products that read dequantised values on both sides, and of all.

    Only what the output depends on counts, so that work which nobody needs makes no network more quantised.
    """
    import onnx

    one = onnx.ModelProto()
    one.CopyFrom(model)
    for end in (*one.graph.input, *one.graph.output):
        end.type.tensor_type.shape.dim[0].dim_value = 1
    del one.graph.value_info[:]  # the file's own claims
    graph = onnx.shape_inference.infer_shapes(one, strict_mode=True, data_prop=True).graph
    shapes = {t.name: tuple(t.dims) for t in graph.initializer}
    for value in (*graph.input, *graph.value_info, *graph.output):
        shapes[value.name] = tuple(d.dim_value for d in value.type.tensor_type.shape.dim)
    made = {name: node for node in graph.node for name in node.output}
    needed, low, every = {end.name for end in graph.output}, 0, 0
    for node in reversed(graph.node):  # the file is in the order of computation
        if needed.isdisjoint(node.output):
            continue
        needed.update(node.input)
        if node.op_type in PRODUCTS:
            work = _multiply_adds(node, shapes)
            both = all(name in made and made[name].op_type == "DequantizeLinear" for name in node.input[:2])
            low, every = low + work * both, every + work
    return low, every


PRODUCTS = ("Conv", "ConvTranspose", "Gemm", "MatMul")


def _multiply_adds(node: Any, shapes: dict[str, tuple[int, ...]]) -> int:
    first, second, out = (shapes[name] for name in (*node.input[:2], node.output[0]))
    if node.op_type == "Conv":
        return prod(out) * prod(second[1:])
    if node.op_type == "ConvTranspose":
        return prod(first) * prod(second[1:])
    turned = any(attribute.name == "transA" and attribute.i for attribute in node.attribute)
    return prod(out) * first[0 if turned else -1]

"""Building a plan from an ONNX file, with TensorRT 8.5 to 11.

What differs between the versions is in ``_network_flags``, ``_set_precision`` and ``_progress_monitor``; names that
only some versions have are looked up, never assumed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from robotbrain.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    import tensorrt

    from robotbrain.jetson.engine.runtime import TensorRTModule, TensorRTRuntime

    Progress = Callable[[str, int, int], object]

PRECISIONS = ("fp32", "fp16", "int8")


@dataclass(frozen=True)
class BuildOptions:
    """How to build.

    Attributes:
        precision: ``fp32``, ``fp16``, ``int8``, or None for the types that the file has. ``fp16`` lets TensorRT 8 and
            10 choose FP16 kernels; ``int8`` too, for what lies outside the file's Q/DQ pairs (as
            ``trtexec --int8 --fp16`` does). TensorRT 11 runs the types in the file only, so they must be there.
            ``fp32`` includes TF32, as TensorRT's default does.
        max_batch: largest batch, where the file's batch axis is open.
        best_batch: batch that the kernels are chosen for.
        workspace_bytes: most scratch memory that kernels may take.
    """

    precision: str | None = None
    max_batch: int = 8
    best_batch: int = 1
    workspace_bytes: int = 1 << 28

    def __post_init__(self) -> None:
        if self.precision is not None and self.precision not in PRECISIONS:
            raise InputError(
                "precision", given=self.precision, expected="None or one of " + ", ".join(PRECISIONS), fix="Choose one."
            )
        if not 1 <= self.best_batch <= self.max_batch or self.workspace_bytes < 1 << 20:
            raise InputError(
                "build options",
                given=str(self),
                expected="1 <= best_batch <= max_batch, and 1 MiB of workspace or more",
                fix="Correct them.",
            )

    def __str__(self) -> str:
        return (
            f"{self.precision or 'the types of the file'}, batch 1 to {self.max_batch}, best at {self.best_batch}, "
            f"workspace {self.workspace_bytes} bytes"
        )


def build_plan(
    model: Path,
    options: BuildOptions,
    runtime: TensorRTRuntime,
    *,
    timing_cache: bytes = b"",
    progress: Progress | None = None,
) -> tuple[bytes, bytes]:
    """Build a plan. On a Jetson this takes seconds to minutes.

    Args:
        model: path of the ONNX file.
        options: how to build.
        runtime: of this machine, or the stand-in.
        timing_cache: from an earlier build on the same GPU; shortens this one.
        progress: called with phase, steps done and steps in all; returning False cancels. TensorRT 8 tells nothing.

    Returns:
        The plan, and the timing cache for the next build.

    Raises:
        InputError: for a file that the parser refuses (every reason is listed with its node), a precision that the
            file does not carry, an input that is not float32 or has open axes besides the batch, or a failed build.
    """
    trt, mark = runtime.trt, runtime.log.mark()
    builder = trt.Builder(runtime.logger)
    network = builder.create_network(_network_flags(trt, runtime.version, options.precision))
    # The parser owns the weights until the build is done: it must outlive it.
    parser = trt.OnnxParser(network, runtime.logger)
    if not parser.parse_from_file(str(model)):
        raise _parser_error(model, parser, runtime, mark)
    config = builder.create_builder_config()
    config.set_memory_pool_limit(trt.MemoryPoolType.WORKSPACE, options.workspace_bytes)
    _set_precision(trt, runtime.version, network, config, options.precision, model)
    _set_profile(trt, builder, network, config, options, model)
    for known in (timing_cache, b""):  # a cache of another GPU or version is refused: begin a new one
        cache = config.create_timing_cache(known)
        if cache is not None and config.set_timing_cache(cache, False):
            break
    monitor = None if progress is None else _progress_monitor(trt, progress)
    if monitor is not None:
        config.progress_monitor = monitor
    built = builder.build_serialized_network(network, config)
    if built is None:
        said = runtime.log.errors(mark)
        raise InputError(
            f"TensorRT {trt.__version__} building {model.name}",
            given="no plan",
            expected="a plan",
            fix=f"It says: {'; '.join(said[-5:]) or 'nothing'}. If memory ran out, lower max_batch or workspace_bytes.",
        )
    cache = config.get_timing_cache()
    return bytes(built), b"" if cache is None else bytes(cache.serialize())


def _network_flags(trt: TensorRTModule, version: tuple[int, int], precision: str | None) -> int:
    # The flags' bits moved: bit 0 was EXPLICIT_BATCH up to 10 and is STRONGLY_TYPED in 11. Never write numbers.
    flags = 0
    if version < (10, 0):
        flags |= 1 << int(trt.NetworkDefinitionCreationFlag.EXPLICIT_BATCH)
    elif precision is None or version >= (11, 0):
        flags |= 1 << int(trt.NetworkDefinitionCreationFlag.STRONGLY_TYPED)
    return flags


def _contents(trt: TensorRTModule, network: tensorrt.INetworkDefinition) -> tuple[bool, bool]:
    """Return whether a parsed network has FP16 tensors, and whether it has Q/DQ nodes."""
    half = quantised = False
    for i in range(network.num_layers):
        layer = network.get_layer(i)
        quantised |= layer.type in (trt.LayerType.QUANTIZE, trt.LayerType.DEQUANTIZE)
        half |= any(layer.get_output(j).dtype == trt.DataType.HALF for j in range(layer.num_outputs))
    return half, quantised


def _set_precision(
    trt: TensorRTModule,
    version: tuple[int, int],
    network: tensorrt.INetworkDefinition,
    config: tensorrt.IBuilderConfig,
    precision: str | None,
    model: Path,
) -> None:
    half, quantised = _contents(trt, network)
    problem = fix = ""
    if precision == "int8" and not quantised:
        problem = "no Q/DQ nodes"
        fix = "Quantise it first (`robotbrain optimise quantise`); calibrators are gone since TensorRT 11."
    elif precision in ("fp32", "fp16") and quantised:
        problem, fix = "Q/DQ nodes", "Ask for int8, or give the file from before it was quantised."
    elif version >= (11, 0) and precision == "fp16" and not half:
        problem = "FP32 tensors only"
        fix = "TensorRT 11 runs the types in the file: convert it first (`python -m modelopt.onnx.autocast`)."
    elif precision == "fp32" and half:
        problem, fix = "FP16 tensors", "Ask for fp16, or give the FP32 file."
    if problem:
        raise InputError(f"{model.name} for {precision}", given=problem, expected=f"a file for {precision}", fix=fix)
    if version >= (10, 0) and (precision is None or version >= (11, 0)):
        return  # strongly typed
    wanted = {
        "FP16": precision in ("fp16", "int8") or (precision is None and half),
        "INT8": precision == "int8" or (precision is None and quantised),
    }
    for name, on in wanted.items():
        if on:
            config.set_flag(getattr(trt.BuilderFlag, name))


def _set_profile(
    trt: TensorRTModule,
    builder: tensorrt.Builder,
    network: tensorrt.INetworkDefinition,
    config: tensorrt.IBuilderConfig,
    options: BuildOptions,
    model: Path,
) -> None:
    if network.num_inputs != 1:
        raise InputError(
            f"inputs of {model.name}", given=network.num_inputs, expected="one input", fix="Export one image input."
        )
    tensor = network.get_input(0)
    shape = tuple(tensor.shape)
    if tensor.dtype != trt.DataType.FLOAT or not shape or any(size < 1 for size in shape[1:]):
        raise InputError(
            f"input {tensor.name} of {model.name}",
            given=f"{getattr(tensor.dtype, 'name', tensor.dtype)} {shape}",
            expected="float32, every axis fixed but the batch (-1)",
            fix="Export with dynamic_axes for the batch only; when converting to FP16, keep the types of the inputs.",
        )
    if shape[0] == -1:
        profile = builder.create_optimization_profile()
        lowest, best, highest = ((n, *shape[1:]) for n in (1, options.best_batch, options.max_batch))
        profile.set_shape(tensor.name, lowest, best, highest)
        config.add_optimization_profile(profile)


def _parser_error(model: Path, parser: tensorrt.OnnxParser, runtime: TensorRTRuntime, mark: int) -> InputError:
    reasons = []
    for i in range(parser.num_errors):
        error = parser.get_error(i)
        # Names of nodes came with TensorRT 10; before, there is only their number.
        name = getattr(error, "node_name", str)()
        operator = getattr(error, "node_operator", str)()
        where = " ".join(part for part in (f"node {error.node()}", name, f"({operator})" if operator else "") if part)
        reasons.append(f"{where}: {error.desc()}")
    shown = reasons[:10] or runtime.log.errors(mark)[-5:] or ["no reason given"]
    hidden = f"; and {len(reasons) - 10} more" if len(reasons) > 10 else ""
    # The reasons go into the last part of the message, which is not shortened.
    return InputError(
        f"{model.name} in the ONNX parser of TensorRT {runtime.trt.__version__}",
        given=f"{max(1, len(reasons))} error(s)",
        expected="a model that this parser takes",
        fix=f"{'; '.join(shown)}{hidden}. `robotbrain optimise lint` explains the usual reasons.",
    )


def _progress_monitor(trt: TensorRTModule, progress: Progress) -> tensorrt.IProgressMonitor | None:
    base: Any = getattr(trt, "IProgressMonitor", None)
    if base is None:
        return None

    class Monitor(base):  # type: ignore[misc]
        def __init__(self) -> None:
            base.__init__(self)
            self._steps: dict[str, int] = {}

        def phase_start(self, phase_name: str, parent_phase: str | None, num_steps: int) -> None:
            self._steps[phase_name] = num_steps
            progress(phase_name, 0, num_steps)

        def step_complete(self, phase_name: str, step: int) -> bool:
            return progress(phase_name, step + 1, self._steps.get(phase_name, step + 1)) is not False

        def phase_finish(self, phase_name: str) -> None:
            steps = self._steps.pop(phase_name, 0)
            progress(phase_name, steps, steps)

    made: tensorrt.IProgressMonitor = Monitor()
    return made

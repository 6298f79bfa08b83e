"""The simulated TensorRT's way from an ONNX file to a plan."""

from __future__ import annotations

import enum
import hashlib
import json
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from robotbrain.jetson.engine.simulated.versions import only, restrict

if TYPE_CHECKING:
    from robotbrain.jetson.engine.simulated.module import ILogger, World

MAGIC = b"simulated TensorRT plan\n"
_CACHE = b"simulated timing cache of "
_ERROR = 1  # ILogger.Severity.ERROR
UNSUPPORTED = frozenset({"NonMaxSuppression", "Unique", "StringNormalizer", "TfIdfVectorizer", "Det"})
"""Operators that the simulated parser refuses; the genuine parsers' tables differ from version to version."""


class IHostMemory(bytes):
    """Bytes that TensorRT returns."""

    _world: World

    @property
    def nbytes(self) -> int:
        """Number of bytes."""
        return len(self)


class ITensor:
    """A tensor of a network."""

    _world: World

    def __init__(self, name: str, dtype: enum.IntEnum, shape: tuple[int, ...] = ()) -> None:
        self.name, self.dtype, self.shape = name, dtype, shape


class ILayer:
    """A layer of a network."""

    _world: World

    def __init__(self, name: str, kind: enum.IntEnum | None, outputs: list[ITensor]) -> None:
        self.name, self.type, self._outputs = name, kind, outputs

    @property
    def num_outputs(self) -> int:
        """Number of outputs."""
        return len(self._outputs)

    def get_output(self, index: int) -> ITensor:
        """Return one output."""
        return self._outputs[index]


class INetworkDefinition:
    """A network; the parser fills it."""

    _world: World

    def __init__(self, flags: int) -> None:
        kinds = self._world.enums["NetworkDefinitionCreationFlag"]
        named = {kind.name for kind in kinds if flags & (1 << kind.value)}
        self._explicit = self._world.version >= (10, 0) or "EXPLICIT_BATCH" in named
        self._strongly_typed = self._world.version >= (11, 0) or "STRONGLY_TYPED" in named
        self._model = b""
        self._inputs: list[ITensor] = []
        self._layers: list[ILayer] = []

    @property
    def num_inputs(self) -> int:
        """Number of inputs."""
        return len(self._inputs)

    @property
    def num_layers(self) -> int:
        """Number of layers."""
        return len(self._layers)

    def get_input(self, index: int) -> ITensor:
        """Return one input."""
        return self._inputs[index]

    def get_layer(self, index: int) -> ILayer:
        """Return one layer."""
        return self._layers[index]


class IOptimizationProfile:
    """Ranges of shapes."""

    _world: World

    def __init__(self) -> None:
        self._shapes: dict[str, tuple[tuple[int, ...], ...]] = {}

    def set_shape(self, input: str, min: Sequence[int], opt: Sequence[int], max: Sequence[int]) -> None:
        """Set the smallest, best and largest shape of an input."""
        shapes = (tuple(min), tuple(opt), tuple(max))
        if len({len(shape) for shape in shapes}) > 1 or any(
            not 0 <= low <= best <= high for low, best, high in zip(*shapes, strict=True)
        ):
            raise ValueError(f"shapes of {input} are inconsistent: {shapes}")
        self._shapes[input] = shapes


class ITimingCache:
    """Remembered timings; here a word and nothing else."""

    _world: World

    def __init__(self, content: bytes) -> None:
        self._content = content

    def serialize(self) -> IHostMemory:
        """Return it as bytes."""
        return IHostMemory(self._content)


class IProgressMonitor:
    """Base class of progress monitors."""

    _world: World

    def __init__(self) -> None:
        pass


class IBuilderConfig:
    """Options of a build."""

    _world: World

    def __init__(self) -> None:
        self._flags: set[str] = set()
        self._profiles: list[IOptimizationProfile] = []
        self._pools: dict[enum.IntEnum, int] = {}
        self._cache: ITimingCache | None = None
        self._monitor: Any = None

    def set_flag(self, flag: enum.IntEnum) -> None:
        """Turn a flag on."""
        self._flags.add(flag.name)

    def set_memory_pool_limit(self, pool: enum.IntEnum, pool_size: int) -> None:
        """Limit a pool, bytes."""
        self._pools[pool] = pool_size

    def add_optimization_profile(self, profile: IOptimizationProfile) -> int:
        """Add a profile; return its number."""
        self._profiles.append(profile)
        return len(self._profiles) - 1

    def create_timing_cache(self, serialized_timing_cache: bytes) -> ITimingCache:
        """Return a cache, from bytes or empty."""
        return ITimingCache(bytes(serialized_timing_cache) or _CACHE + self._world.text.encode())

    def set_timing_cache(self, cache: ITimingCache, ignore_mismatch: bool) -> bool:
        """Use a cache; False if it is of another version."""
        if cache._content != _CACHE + self._world.text.encode() and not ignore_mismatch:
            return False
        self._cache = cache
        return True

    def get_timing_cache(self) -> ITimingCache | None:
        """Return the cache in use."""
        return self._cache

    @property
    @only(first="10.0")
    def progress_monitor(self) -> Any:
        """Who is told of progress."""
        return self._monitor

    def __setattr__(self, name: str, value: object) -> None:
        if name == "progress_monitor" and self._world.version >= (10, 0):
            object.__setattr__(self, "_monitor", value)
        elif name.startswith("_"):
            object.__setattr__(self, name, value)
        else:
            raise AttributeError(f"IBuilderConfig of TensorRT {self._world.text} has no attribute {name!r}")


class Builder:
    """Makes plans."""

    _world: World

    def __init__(self, logger: ILogger) -> None:
        self._logger = logger

    def create_network(self, flags: int = 0) -> INetworkDefinition:
        """Return an empty network."""
        network: INetworkDefinition = made(self._world, INetworkDefinition)(flags)
        return network

    def create_builder_config(self) -> IBuilderConfig:
        """Return default options."""
        config: IBuilderConfig = made(self._world, IBuilderConfig)()
        return config

    def create_optimization_profile(self) -> IOptimizationProfile:
        """Return an empty profile."""
        profile: IOptimizationProfile = made(self._world, IOptimizationProfile)()
        return profile

    def build_serialized_network(self, network: INetworkDefinition, config: IBuilderConfig) -> IHostMemory | None:
        """Return a plan, or None after logging why not."""
        problem = _build_problem(network, config) or _report_progress(config)
        if problem:
            self._logger.log(self._world.enums["Severity"](_ERROR), f"[simulated] {problem}")
            return None
        shapes = config._profiles[0]._shapes if config._profiles else {}
        header = {
            "version": self._world.text,
            "device": self._world.cuda.device,
            "flags": sorted(config._flags),
            "strongly_typed": network._strongly_typed,
            "profile": shapes,
            "sha256": hashlib.sha256(network._model).hexdigest(),
        }
        return IHostMemory(MAGIC + json.dumps(header, sort_keys=True).encode() + b"\n" + network._model)


def made(world: World, kind: type) -> Any:
    """Return the copy of a class that belongs to a simulated module."""
    return restrict(kind, world.version, _world=world)


def _quantised(network: INetworkDefinition) -> bool:
    return any(layer.type is not None and "QUANTIZE" in layer.type.name for layer in network._layers)


def _build_problem(network: INetworkDefinition, config: IBuilderConfig) -> str:
    if not network._model:
        return "the network is empty"
    precisions = config._flags & {"FP16", "INT8"}
    if network._strongly_typed and precisions:
        return f"a strongly typed network takes no precision flags, but {sorted(precisions)} are set"
    if _quantised(network) and not network._strongly_typed and "INT8" not in precisions:
        return "the network has Q/DQ layers, but INT8 is not enabled"
    for tensor in network._inputs:
        if -1 in tensor.shape and not any(tensor.name in profile._shapes for profile in config._profiles):
            return f"the input {tensor.name} has open axes, but no optimisation profile gives its range"
    return ""


def _report_progress(config: IBuilderConfig) -> str:
    monitor = config._monitor
    if monitor is None:
        return ""
    phase, steps = "Simulated build", 3
    monitor.phase_start(phase, None, steps)
    going = all(monitor.step_complete(phase, step) for step in range(steps))
    monitor.phase_finish(phase)
    return "" if going else "the build was cancelled by the progress monitor"


class ParserError:
    """Why the parser refused a model."""

    _world: World

    def __init__(self, index: int, text: str, name: str = "", operator: str = "") -> None:
        self._index, self._text, self._name, self._operator = index, text, name, operator

    def node(self) -> int:
        """Return the number of the node, -1 for the whole model."""
        return self._index

    def desc(self) -> str:
        """Return the reason."""
        return self._text

    @only(first="10.0")
    def node_name(self) -> str:
        """Return the name of the node."""
        return self._name

    @only(first="10.0")
    def node_operator(self) -> str:
        """Return the operator of the node."""
        return self._operator


class OnnxParser:
    """Reads an ONNX file into a network."""

    _world: World

    def __init__(self, network: INetworkDefinition, logger: ILogger) -> None:
        self._network = network
        self._errors: list[ParserError] = []

    @property
    def num_errors(self) -> int:
        """Number of errors."""
        return len(self._errors)

    def get_error(self, index: int) -> ParserError:
        """Return one error."""
        return self._errors[index]

    def _fail(self, *arguments: Any) -> None:
        self._errors.append(made(self._world, ParserError)(*arguments))

    def parse_from_file(self, model: str) -> bool:
        """Read a file; False if there were errors."""
        import onnx

        if not self._network._explicit:
            self._fail(-1, "[simulated] the parser takes networks with an explicit batch only")
            return False
        try:
            proto = onnx.load(model)
            onnx.checker.check_model(proto)
        except Exception as error:  # protobuf, onnx and the file system each have errors of their own
            self._fail(-1, f"[simulated] the model could not be read: {str(error).splitlines()[0][:200]}")
            return False
        zero_points = {tensor.name: tensor for tensor in proto.graph.initializer}
        for index, node in enumerate(proto.graph.node):
            if node.domain not in ("", "ai.onnx") or node.op_type in UNSUPPORTED:
                self._fail(index, f"[simulated] no importer for {node.domain or 'ai.onnx'}:{node.op_type}", *_of(node))
            elif node.op_type in ("QuantizeLinear", "DequantizeLinear") and len(node.input) > 2:
                zero = zero_points.get(node.input[2])
                if zero is not None and onnx.numpy_helper.to_array(zero).any():
                    self._fail(index, "[simulated] zero points other than 0 are not supported", *_of(node))
        if not self._errors:
            self._fill(proto)
        return not self._errors

    def _fill(self, proto: Any) -> None:
        import onnx

        types, layers = self._world.enums["DataType"], self._world.enums["LayerType"]
        names = {1: "FLOAT", 10: "HALF", 3: "INT8", 6: "INT32", 9: "BOOL", 2: "UINT8", 7: "INT64"}
        inferred = onnx.shape_inference.infer_shapes(proto).graph
        values = [*inferred.value_info, *inferred.output]
        dtypes = {value.name: names.get(value.type.tensor_type.elem_type, "FLOAT") for value in values}
        kinds = {"QuantizeLinear": layers["QUANTIZE"], "DequantizeLinear": layers["DEQUANTIZE"]}
        for node in proto.graph.node:
            outputs = [ITensor(name, types[dtypes.get(name, "FLOAT")]) for name in node.output if name]
            self._network._layers.append(ILayer(node.name, kinds.get(node.op_type), outputs))
        known = {tensor.name for tensor in proto.graph.initializer}
        for value in proto.graph.input:
            if value.name in known:
                continue
            kind = value.type.tensor_type
            shape = tuple(axis.dim_value if axis.HasField("dim_value") else -1 for axis in kind.shape.dim)
            self._network._inputs.append(ITensor(value.name, types[names.get(kind.elem_type, "FLOAT")], shape))
        self._network._model = proto.SerializeToString()


def _of(node: Any) -> tuple[str, str]:
    return node.name, node.op_type


CLASSES = (
    Builder,
    IBuilderConfig,
    IHostMemory,
    ILayer,
    INetworkDefinition,
    IOptimizationProfile,
    IProgressMonitor,
    ITensor,
    ITimingCache,
    OnnxParser,
    ParserError,
)

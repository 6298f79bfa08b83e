"""The simulated TensorRT's runtime: plans are loaded, checked and run, late, by ONNX Runtime."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from robotbrain.jetson.engine.simulated.building import MAGIC, made
from robotbrain.jetson.engine.simulated.memory import ALIGNMENT, Block
from robotbrain.jetson.engine.simulated.versions import only

if TYPE_CHECKING:
    from robotbrain.jetson.engine.simulated.module import ILogger, World

_TYPES = {"tensor(float)": "FLOAT", "tensor(float16)": "HALF", "tensor(int64)": "INT64", "tensor(int32)": "INT32"}
_NUMPY = {"FLOAT": np.float32, "HALF": np.float16, "INT64": np.int64, "INT32": np.int32}


class Runtime:
    """Loads plans."""

    _world: World

    def __init__(self, logger: ILogger) -> None:
        self._logger = logger

    def deserialize_cuda_engine(self, serialized_engine: bytes) -> ICudaEngine | None:
        """Return the engine of a plan, or None after logging why not."""
        plan = bytes(serialized_engine)
        problem, header, model = "", {}, b""
        if not plan.startswith(MAGIC):
            problem = "this is no plan of the simulated TensorRT"
        else:
            line, _, model = plan[len(MAGIC) :].partition(b"\n")
            header = json.loads(line)
            if header["version"] != self._world.text:
                problem = f"the plan is of version {header['version']}, this is {self._world.text}"
            elif header["device"] != self._world.cuda.device:
                problem = f"the plan is for {header['device']}, this is {self._world.cuda.device}"
        if problem:
            self._logger.log(self._world.enums["Severity"](1), f"[simulated] {problem}")
            return None
        engine: ICudaEngine = made(self._world, ICudaEngine)(model, header, self._logger)
        return engine


class ICudaEngine:
    """A loaded plan."""

    _world: World

    def __init__(self, model: bytes, header: dict[str, Any], logger: ILogger) -> None:
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        options.log_severity_level = 3
        # Q/DQ as floating point: like TensorRT's int32 sums, it does not saturate.
        options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_DISABLE_ALL
        self._session: Any = onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
        self._logger, self._profile = logger, header["profile"]
        self._inputs = {value.name: value for value in self._session.get_inputs()}
        self._outputs = {value.name: value for value in self._session.get_outputs()}
        self._names: list[str] = [*self._inputs, *self._outputs]

    @property
    def num_io_tensors(self) -> int:
        """Number of inputs and outputs."""
        return len(self._names)

    def get_tensor_name(self, index: int) -> str:
        """Return one name."""
        return self._names[index]

    def get_tensor_mode(self, name: str) -> Any:
        """Return INPUT or OUTPUT; NONE for an unknown name."""
        modes = self._world.enums["TensorIOMode"]
        return modes["INPUT"] if name in self._inputs else modes["OUTPUT"] if name in self._outputs else modes["NONE"]

    def get_tensor_dtype(self, name: str) -> Any:
        """Return the type of a tensor."""
        return self._world.enums["DataType"][self._kind(name)]

    def _kind(self, name: str) -> str:
        """Return the name of the type of a tensor."""
        return _TYPES.get(str({**self._inputs, **self._outputs}[name].type), "BOOL")

    def get_tensor_location(self, name: str) -> Any:
        """Return where a tensor must lie: on the device."""
        return self._world.enums["TensorLocation"]["DEVICE"]

    def get_tensor_shape(self, name: str) -> tuple[int, ...]:
        """Return the shape, -1 for open axes."""
        shape = {**self._inputs, **self._outputs}[name].shape
        return tuple(size if isinstance(size, int) else -1 for size in shape)

    def get_tensor_profile_shape(self, name: str, profile_index: int) -> list[tuple[int, ...]]:
        """Return smallest, best and largest shape of an input."""
        if name in self._profile:
            return [tuple(shape) for shape in self._profile[name]]
        return [self.get_tensor_shape(name)] * 3

    @property
    @only(before="10.0")
    def num_bindings(self) -> int:
        """Number of inputs and outputs, by their old name."""
        return len(self._names)

    @only(before="10.0")
    def get_binding_name(self, index: int) -> str:
        """Return one name, by its old name."""
        return self._names[index]

    @only(before="10.0")
    def binding_is_input(self, name: str) -> bool:
        """Return whether a name is an input, by its old name."""
        return name in self._inputs

    def create_execution_context(self) -> IExecutionContext:
        """Return a context."""
        context: IExecutionContext = made(self._world, IExecutionContext)(self)
        return context


class IExecutionContext:
    """Runs an engine: shapes first, then addresses, then ``execute_async_v3``."""

    _world: World

    def __init__(self, engine: ICudaEngine) -> None:
        self._engine = engine
        fixed = {name: engine.get_tensor_shape(name) for name in engine._inputs}
        self._shapes = {name: shape for name, shape in fixed.items() if -1 not in shape}
        self._addresses: dict[str, int] = {}
        self._sizes: dict[tuple[tuple[int, ...], ...], dict[str, tuple[int, ...]]] = {}

    def _refuse(self, why: str) -> bool:
        self._engine._logger.log(self._world.enums["Severity"](1), f"[simulated] {why}")
        return False

    def set_input_shape(self, name: str, shape: Sequence[int]) -> bool:
        """Set the shape of an input; False after logging why not."""
        if name not in self._engine._inputs:
            return self._refuse(f"no input is called {name}")
        low, _, high = self._engine.get_tensor_profile_shape(name, 0)
        given = tuple(shape)
        if len(given) != len(low) or any(
            not least <= size <= most for least, size, most in zip(low, given, high, strict=True)
        ):
            return self._refuse(f"{name}: {given} is outside the profile's {low} to {high}")
        self._shapes[name] = given
        return True

    def infer_shapes(self) -> list[str]:
        """Return the inputs whose shape is missing."""
        return [name for name in self._engine._inputs if name not in self._shapes]

    def get_tensor_shape(self, name: str) -> tuple[int, ...]:
        """Return a shape; -1 for what is not known before all inputs have theirs."""
        if name in self._engine._inputs:
            return self._shapes.get(name, self._engine.get_tensor_shape(name))
        return self._engine.get_tensor_shape(name) if self.infer_shapes() else self._outputs()[name]

    def _outputs(self) -> dict[str, tuple[int, ...]]:
        key = tuple(self._shapes[name] for name in self._engine._inputs)
        if key not in self._sizes:
            zeros = {name: np.zeros(self._shapes[name], _NUMPY[self._engine._kind(name)]) for name in self._shapes}
            results = self._engine._session.run(list(self._engine._outputs), zeros)
            self._sizes[key] = {name: value.shape for name, value in zip(self._engine._outputs, results, strict=True)}
        return self._sizes[key]

    def set_tensor_address(self, name: str, memory: int) -> bool:
        """Say where a tensor lies; a MisuseError for anything but aligned device memory."""
        if name not in self._engine._inputs and name not in self._engine._outputs:
            return self._refuse(f"no tensor is called {name}")
        self._world.cuda.block(memory, "device", 0)
        if memory % ALIGNMENT:
            self._world.cuda.fault("alignment", f"{memory:#x} is not a multiple of {ALIGNMENT}")
        self._addresses[name] = memory
        return True

    def execute_async_v3(self, stream_handle: int) -> bool:
        """Enqueue the network; False after logging what is missing."""
        missing = self.infer_shapes()
        if missing:
            return self._refuse(f"the shapes of {missing} were not set")
        unset = [name for name in (*self._engine._inputs, *self._engine._outputs) if name not in self._addresses]
        if unset:
            return self._refuse(f"the addresses of {unset} were not set")
        run, blocks = self._prepare(dict(self._addresses))
        self._world.cuda.enqueue("execute", stream_handle, run, *blocks)
        return True

    def execute_v2(self, bindings: Sequence[int]) -> bool:
        """Run at once, with the addresses in the order of the tensors."""
        names = [*self._engine._inputs, *self._engine._outputs]
        if len(bindings) != len(names) or self.infer_shapes():
            return self._refuse(f"{len(names)} addresses and all input shapes are needed")
        run, _ = self._prepare(dict(zip(names, bindings, strict=True)))
        self._world.cuda.calls.append("execute_v2")
        run()
        return True

    def _prepare(self, addresses: dict[str, int]) -> tuple[Callable[[], None], list[Block]]:
        """Check all memory now; return what computes later, and the memory that it uses."""
        shapes = {**self._shapes, **self._outputs()}
        dtypes = {name: np.dtype(_NUMPY[self._engine._kind(name)]) for name in shapes}
        sizes = {name: int(np.prod(shape)) * dtypes[name].itemsize for name, shape in shapes.items()}
        blocks = {name: self._world.cuda.block(addresses[name], "device", sizes[name]) for name in shapes}
        session, outputs = self._engine._session, list(self._engine._outputs)
        inputs = list(self._engine._inputs)

        def data(name: str) -> NDArray[np.uint8]:
            start = addresses[name] - blocks[name].address
            return blocks[name].data[start : start + sizes[name]]

        def run() -> None:
            feed = {name: data(name).view(dtypes[name]).reshape(shapes[name]).copy() for name in inputs}
            results = session.run(outputs, feed)
            for name, value in zip(outputs, results, strict=True):
                data(name)[:] = np.ascontiguousarray(value).view(np.uint8).ravel()

        return run, list(blocks.values())


CLASSES = (ICudaEngine, IExecutionContext, Runtime)

"""Running a network with TensorRT 8.5 to 11: named tensors, one explicit stream, buffers allocated once."""

from __future__ import annotations

import contextlib
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from robotbrain import files
from robotbrain.errors import InputError
from robotbrain.jetson.engine import plan as plans
from robotbrain.jetson.engine.build import BuildOptions, build_plan
from robotbrain.jetson.engine.cuda import OUT_OF_MEMORY, CudaError, host_view, out_of_memory
from robotbrain.jetson.engine.interface import check_input, check_open, example
from robotbrain.jetson.engine.runtime import TensorRTError, genuine_runtime
from robotbrain.jetson.engine.timing import TENSORRT, Latency, check_counts, summarise

if TYPE_CHECKING:
    from collections.abc import Callable
    from types import TracebackType
    from typing import Any

    import tensorrt
    from numpy.typing import NDArray

    from robotbrain.jetson.engine.build import Progress
    from robotbrain.jetson.engine.runtime import TensorRTRuntime

# Not tensorrt.nptype: in 8.5 it needs numpy.bool, which numpy removed in 1.24.
_DTYPES = {"FLOAT": "f4", "HALF": "f2", "INT8": "i1", "UINT8": "u1", "INT32": "i4", "INT64": "i8", "BOOL": "?"}


@dataclass(frozen=True)
class _Tensor:
    """One input or output: its type, and buffers for the largest batch on both sides."""

    name: str
    dtype: np.dtype[Any]
    device: int
    host: int
    size: int  # bytes

    def view(self, shape: tuple[int, ...]) -> NDArray[Any]:
        """Return the host buffer's beginning as an array of this shape."""
        count = int(np.prod(shape, dtype=np.int64)) * self.dtype.itemsize
        return host_view(self.host, self.size)[:count].view(self.dtype).reshape(shape)


class TensorRTEngine:
    """A plan on the GPU, with one float32 input; of several outputs the first is returned.

    Each call copies into page-locked memory, enqueues copy, network and copy back in one stream, waits for the
    stream, and only then reads. Calls from several threads take turns. Use it in a ``with`` block, or close it.

    Args:
        model: path of an ONNX file, which is built (or found in the cache), or of a plan (``.plan .engine .trt``).
        options: how to build; for a plan they say nothing.
        cache: folder for plans and timing caches; None: ``robotbrain-plans`` beside the model.
        progress: called with phase, steps done and steps in all while building (TensorRT 10 and later).
        runtime: TensorRT and CUDA; None: this machine's.

    Attributes:
        path: as given.
        plan_path: of the plan in use.
        backend: ``tensorrt``, or ``simulated tensorrt``.
        timing: empty: nothing is charged, real time passes by itself.
        resource: ``gpu``.

    Raises:
        MissingDependencyError: if TensorRT or CUDA is not installed.
        InputError: for a missing or unsuitable file, a plan made elsewhere, a failed build, or too little memory.
    """

    def __init__(
        self,
        model: str | Path,
        options: BuildOptions | None = None,
        *,
        cache: str | Path | None = None,
        progress: Progress | None = None,
        runtime: TensorRTRuntime | None = None,
    ) -> None:
        self.path = Path(model)
        if not self.path.is_file():
            raise InputError(
                "model", given=str(model), expected="the path of an ONNX file or a plan", fix="Check the path."
            )
        self.runtime = genuine_runtime() if runtime is None else runtime
        self.backend = "simulated tensorrt" if self.runtime.simulated else "tensorrt"
        self.timing, self.resource = "", "gpu"
        loaded: list[tensorrt.ICudaEngine] = []

        def loads(kept: Path) -> bool:
            with contextlib.suppress(InputError):
                loaded.append(self._deserialize(kept))
            return bool(loaded)

        if self.path.suffix.lower() in plans.SUFFIXES:
            plans.check_fits(self.path, self.runtime.trt.__version__, self.runtime.cuda.device, self.runtime.simulated)
            self.plan_path = self.path
        else:
            directory = self.path.parent / "robotbrain-plans" if cache is None else Path(cache)
            options = options or BuildOptions()
            self.plan_path = find_or_build(self.path, options, directory, self.runtime, progress, loads=loads)
        self._lock = threading.Lock()
        self._closed = False
        with contextlib.ExitStack() as undo:  # undone if anything below fails, otherwise by close()
            self._engine = loaded[0] if loaded else self._deserialize(self.plan_path)
            self._context = self._make_context()
            self._stream = self.runtime.cuda.stream_create()
            undo.callback(self.runtime.cuda.stream_destroy, self._stream)
            self._input, self._outputs = self._allocate(undo)
            self._resources = undo.pop_all()

    # ------------------------------------------------------------ setting up

    def _deserialize(self, plan: Path) -> tensorrt.ICudaEngine:
        mark = self.runtime.log.mark()
        # The engine needs its Runtime alive.
        self._trt_runtime = self.runtime.trt.Runtime(self.runtime.logger)
        engine = self._trt_runtime.deserialize_cuda_engine(plan.read_bytes())
        if engine is None:
            said = "; ".join(self.runtime.log.errors(mark)[-3:]) or "nothing"
            raise InputError(
                f"plan {plan.name}",
                given="a file that TensorRT cannot load",
                expected=f"a plan built by TensorRT {self.runtime.trt.__version__} on {self.runtime.cuda.device}",
                fix=f"TensorRT says: {said}. Plans do not travel: open the ONNX file here, which builds one.",
            )
        return engine

    def _make_context(self) -> tensorrt.IExecutionContext:
        context = self._engine.create_execution_context()
        if context is None:
            free, _ = self.runtime.cuda.memory_info()
            raise InputError(
                f"plan {self.plan_path.name}",
                given=f"no execution context; {free / 2**20:.0f} MiB are free",
                expected="enough free memory for it",
                fix="Close other programs, or build with a smaller max_batch or workspace_bytes.",
            )
        return context

    def _allocate(self, undo: contextlib.ExitStack) -> tuple[_Tensor, list[_Tensor]]:
        """Return buffers for the largest batch, with their addresses set for good."""
        trt, engine, context = self.runtime.trt, self._engine, self._context
        names = [engine.get_tensor_name(i) for i in range(engine.num_io_tensors)]
        inputs = [name for name in names if engine.get_tensor_mode(name) == trt.TensorIOMode.INPUT]
        here = all(engine.get_tensor_location(name) == trt.TensorLocation.DEVICE for name in names)
        if len(inputs) != 1 or not here or engine.get_tensor_dtype(inputs[0]) != trt.DataType.FLOAT:
            raise InputError(
                f"plan {self.plan_path.name}",
                given=f"tensors {names}, of which inputs {inputs}",
                expected="one float32 input, all tensors in device memory",
                fix="Export a network with one float32 image input.",
            )
        self._shape = tuple(engine.get_tensor_shape(inputs[0]))
        largest = self._shape
        if -1 in largest:
            largest = tuple(engine.get_tensor_profile_shape(inputs[0], 0)[2])
        self._max_batch = largest[0]
        self._set_shape(inputs[0], largest)
        tensors = [self._buffers(name, tuple(context.get_tensor_shape(name)), undo) for name in names]
        by_name = {tensor.name: tensor for tensor in tensors}
        for tensor in tensors:
            if not context.set_tensor_address(tensor.name, tensor.device):
                raise self._failure(f"set_tensor_address({tensor.name!r})")
        return by_name[inputs[0]], [tensor for tensor in tensors if tensor.name != inputs[0]]

    def _buffers(self, name: str, shape: tuple[int, ...], undo: contextlib.ExitStack) -> _Tensor:
        cuda = self.runtime.cuda
        kind = self._engine.get_tensor_dtype(name).name
        if kind not in _DTYPES or any(size < 0 for size in shape):
            raise InputError(
                f"tensor {name}",
                given=f"{kind} {shape}",
                expected="a shape that follows from the input's, of a type that numpy has",
                fix="Leave operators whose output size depends on values (NonMaxSuppression...) out of the file.",
            )
        dtype = np.dtype(_DTYPES[kind])
        size = max(1, int(np.prod(shape, dtype=np.int64)) * dtype.itemsize)
        try:
            device = cuda.malloc(size)
            undo.callback(cuda.free, device)
            host = cuda.host_alloc(size)
            undo.callback(cuda.host_free, host)
        except CudaError as error:
            if error.code == OUT_OF_MEMORY:
                raise out_of_memory(error, size, f"memory for the tensor {name}") from error
            raise
        return _Tensor(name, dtype, device, host, size)

    def _set_shape(self, name: str, shape: tuple[int, ...]) -> None:
        if not self._context.set_input_shape(name, shape):
            raise self._failure(f"set_input_shape({name!r}, {shape})")
        missing = self._context.infer_shapes()
        if missing:
            raise self._failure(f"infer_shapes(), which misses {missing}")

    def _failure(self, call: str) -> TensorRTError:
        said = "; ".join(self.runtime.log.errors(0)[-3:]) or "no reason given"
        return TensorRTError(f"{self.runtime!r} refused {call}: {said}.")

    # ------------------------------------------------------------ running

    @property
    def input_shape(self) -> tuple[int | str | None, ...]:
        """Shape of the input; -1 stands for a batch of 1 to :attr:`max_batch`."""
        return self._shape

    @property
    def max_batch(self) -> int:
        """Largest batch of one call."""
        return self._max_batch

    @property
    def latency_ns(self) -> int:
        """0: on a board time passes by itself. See :meth:`measure`."""
        return 0

    def _check(self, batch: object) -> NDArray[np.float32]:
        check_open(self._closed, self.path)
        given = check_input(batch, self._shape)
        if len(given) > self._max_batch:
            raise InputError(
                "network input",
                given=f"a batch of {len(given)}",
                expected=f"at most {self._max_batch}, for which the plan was built",
                fix="Split it, or build with a larger max_batch.",
            )
        return given

    def infer(self, batch: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the network's first output for one input, float32.

        Raises:
            InputError: for another dtype or shape than the network takes, a batch above ``max_batch``, values that
                are not finite, or a closed engine.
            CudaError, TensorRTError: if the GPU or TensorRT failed.
        """
        with self._lock:
            given = self._check(batch)
            shapes = self._prepare(given)
            try:
                self._enqueue(given.nbytes, shapes)
            finally:
                # Before it, the host buffer holds anything; and after a failure too the buffers must be idle.
                self.runtime.cuda.stream_synchronize(self._stream)
            output = self._outputs[0]
            return np.array(output.view(shapes[output.name]), dtype=np.float32)

    def _prepare(self, given: NDArray[np.float32]) -> dict[str, tuple[int, ...]]:
        """Fill the host buffer and set the input's shape; return the outputs' shapes, which follow from it."""
        self._set_shape(self._input.name, given.shape)
        np.copyto(self._input.view(given.shape), given)
        return {tensor.name: tuple(self._context.get_tensor_shape(tensor.name)) for tensor in self._outputs}

    def _enqueue(self, size: int, shapes: dict[str, tuple[int, ...]]) -> None:
        """Enqueue copy in, network and copies out."""
        cuda, stream = self.runtime.cuda, self._stream
        cuda.copy_to_device(self._input.device, self._input.host, size, stream)
        self._execute()
        for tensor in self._outputs:
            cuda.copy_to_host(tensor.host, tensor.device, tensor.view(shapes[tensor.name]).nbytes, stream)

    def _execute(self) -> None:
        if not self._context.execute_async_v3(self._stream):
            raise self._failure("execute_async_v3()")

    def measure(
        self, batch: NDArray[np.float32] | None = None, *, runs: int = 50, warmup: int = 10, copies: bool = True
    ) -> Latency:
        """Time inferences on the GPU with CUDA events.

        Args:
            batch: what is inferred; None: zeros, batch 1.
            runs, warmup: timed inferences, and untimed ones before.
            copies: whether the copies to and from the device are timed too.

        Raises:
            InputError: on a simulated runtime, which has no latency; for a batch that does not fit, or bad counts.
            CudaError, TensorRTError: if the GPU or TensorRT failed.
        """
        check_counts(runs, warmup)
        if self.runtime.simulated:
            raise InputError(
                "latency",
                given=repr(self.runtime),
                expected="a genuine TensorRT",
                fix="A simulated runtime has no latency. Ask the twin (backend twin), or measure on a board.",
            )
        cuda = self.runtime.cuda
        with self._lock, contextlib.ExitStack() as undo:
            given = self._check(example(self._shape) if batch is None else batch)
            events = []
            for _ in range(2):
                events.append(cuda.event_create())
                undo.callback(cuda.event_destroy, events[-1])
            start, end = events
            shapes = self._prepare(given)
            self._enqueue(given.nbytes, shapes)
            times = []
            for i in range(warmup + runs):
                cuda.event_record(start, self._stream)
                if copies:
                    self._enqueue(given.nbytes, shapes)
                else:
                    self._execute()
                cuda.event_record(end, self._stream)
                cuda.stream_synchronize(self._stream)
                if i >= warmup:
                    times.append(cuda.event_elapsed_ms(start, end))
        what = "copy in, network and copies out" if copies else "the network without copies"
        return summarise(
            times, batch=len(given), source=TENSORRT, harness=f"{self.runtime!r}, CUDA events around {what}"
        )

    # ------------------------------------------------------------ closing

    def close(self) -> None:
        """Wait for the GPU, then free everything, plan last. Closing twice is fine."""
        with self._lock:
            if self._closed:
                return
            self._closed = True
            try:
                self.runtime.cuda.stream_synchronize(self._stream)
            finally:
                # Context before engine before runtime, as TensorRT asks; buffers are no longer used by then.
                del self._context, self._engine, self._trt_runtime
                self._resources.close()

    def __enter__(self) -> TensorRTEngine:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"TensorRTEngine({str(self.path)!r}, {self.runtime!r})"


def find_or_build(
    model: Path,
    options: BuildOptions,
    directory: Path,
    runtime: TensorRTRuntime,
    progress: Progress | None = None,
    *,
    loads: Callable[[Path], bool] = lambda _: True,
) -> Path:
    """Return the path of a plan for an ONNX file: from the folder if it is there and whole, otherwise built into it.

    Args:
        model: path of the ONNX file.
        options, runtime, progress: see ``build.build_plan``.
        directory: with the plans.
        loads: whether a plan that is there can be used. After an update of CUDA or the driver, which TensorRT's
            version does not tell, it may not; then it is built again.

    Raises:
        InputError: see ``build.build_plan``; and for a folder that cannot be written to.
    """
    version, device = runtime.trt.__version__, runtime.cuda.device
    info = plans.PlanInfo(plans.onnx_digest(model), version, device, str(options), runtime.simulated)
    found = plans.find(directory, model.stem, info)
    if found is not None and loads(found):
        return found
    timings = plans.timing_cache_path(directory, version, device)
    known = timings.read_bytes() if timings.is_file() else b""
    plan, learnt = build_plan(model, options, runtime, timing_cache=known, progress=progress)
    try:
        if learnt:
            files.write_bytes(timings, learnt)
        return plans.put(directory, model.stem, info, plan)
    except OSError as error:
        raise InputError(
            "folder for plans",
            given=str(directory),
            expected="a folder that can be written to",
            fix=f"Name another with cache=... ({error.strerror or error}).",
        ) from error

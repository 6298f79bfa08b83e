"""The little of the CUDA runtime that an engine needs, and its route to the genuine one.

The route is ctypes on ``libcudart``, which CUDA itself installs, so a board needs no further package. It was chosen
over cuda-python, which has no wheel for the Python 3.8 of JetPack 5 and must match CUDA's major version, and over
torch, whose CUDA builds for Jetson are many hundred megabytes. NVIDIA's own Polygraphy takes the same route. The
functions below have kept their names and arguments in libcudart 11, 12 and 13.
"""

from __future__ import annotations

import ctypes
import sys
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from robotbrain.errors import InputError, MissingDependencyError, RobotBrainError

if TYPE_CHECKING:
    from numpy.typing import NDArray

OUT_OF_MEMORY = 2  # cudaErrorMemoryAllocation
_NO_DEVICE = {35: "the driver is older than this CUDA", 100: "CUDA found no GPU", 999: "unknown error"}
_HOST_TO_DEVICE, _DEVICE_TO_HOST = 1, 2
_NON_BLOCKING = 1  # the stream does not wait for the legacy default stream
_COMPUTE_MAJOR, _COMPUTE_MINOR, _MULTIPROCESSORS = 75, 76, 16  # of cudaDeviceAttr


class CudaError(RobotBrainError, RuntimeError):
    """A CUDA call failed.

    Args:
        call: the function.
        code: number of CUDA's error.
        text: what CUDA says it means.
    """

    def __init__(self, call: str, code: int, text: str) -> None:
        self.call, self.code, self.text = call, code, text
        super().__init__(f"{call} failed: {text} (CUDA error {code}).")

    def __reduce__(self) -> tuple[object, ...]:
        return (type(self), (self.call, self.code, self.text))


class CudaRuntime(Protocol):
    """Memory, streams and events of one GPU. Addresses and handles are plain integers, sizes are in bytes."""

    @property
    def simulated(self) -> bool:
        """Whether there is no GPU behind it."""
        ...

    @property
    def device(self) -> str:
        """What names the GPU closely enough to tell whether a plan fits it."""
        ...

    def malloc(self, size: int) -> int:
        """Return the address of new memory on the device; CudaError 2 if there is not enough."""
        ...

    def free(self, address: int) -> None:
        """Free memory of the device."""
        ...

    def host_alloc(self, size: int) -> int:
        """Return the address of new page-locked host memory: what asynchronous copies need."""
        ...

    def host_free(self, address: int) -> None:
        """Free page-locked host memory."""
        ...

    def stream_create(self) -> int:
        """Return a new stream that does not wait for the default stream."""
        ...

    def stream_synchronize(self, stream: int) -> None:
        """Wait until all work in the stream is done; raises what went wrong in it."""
        ...

    def stream_destroy(self, stream: int) -> None:
        """Free a stream."""
        ...

    def copy_to_device(self, device: int, host: int, size: int, stream: int) -> None:
        """Enqueue a copy from host memory to the device."""
        ...

    def copy_to_host(self, host: int, device: int, size: int, stream: int) -> None:
        """Enqueue a copy from the device to host memory."""
        ...

    def event_create(self) -> int:
        """Return a new event that can be timed."""
        ...

    def event_record(self, event: int, stream: int) -> None:
        """Enqueue taking the time."""
        ...

    def event_elapsed_ms(self, start: int, end: int) -> float:
        """Return the time between two recorded events whose stream was synchronised, ms."""
        ...

    def event_destroy(self, event: int) -> None:
        """Free an event."""
        ...

    def memory_info(self) -> tuple[int, int]:
        """Return free and total memory of the device."""
        ...


def host_view(address: int, size: int) -> NDArray[np.uint8]:
    """Return host memory as bytes, without a copy. It must not be used after it was freed."""
    return np.ctypeslib.as_array((ctypes.c_uint8 * size).from_address(address))


def _names() -> list[str]:
    if sys.platform == "win32":
        return ["cudart64_13.dll", "cudart64_130.dll", "cudart64_12.dll", "cudart64_110.dll"]
    bare = ["libcudart.so.13", "libcudart.so.12", "libcudart.so.11.0", "libcudart.so"]
    return bare + ["/usr/local/cuda/lib64/" + name for name in bare]


class LibCudart:
    """The genuine CUDA runtime, device 0.

    Args:
        library: path of ``libcudart``; None: looked for under its usual names.

    Raises:
        MissingDependencyError: if there is no CUDA runtime.
        InputError: if it has no driver or no GPU.
    """

    simulated = False

    def __init__(self, library: str | None = None) -> None:
        self._library = _load([library] if library is not None else _names())
        self._declare()
        count = ctypes.c_int(0)
        code = self._library.cudaGetDeviceCount(ctypes.byref(count))
        if code or not count.value:
            raise InputError(
                "GPU for TensorRT",
                given=self._text(code) if code else "none",
                expected="an NVIDIA GPU and a driver for this CUDA",
                fix="Here, use the backend onnxruntime or twin; run TensorRT on a Jetson.",
            )
        self.device = self._name()

    def _declare(self) -> None:
        address, size, handle = ctypes.c_void_p, ctypes.c_size_t, ctypes.c_void_p
        out = ctypes.POINTER(ctypes.c_void_p)
        signatures: dict[str, list[Any]] = {
            "cudaGetDeviceCount": [ctypes.POINTER(ctypes.c_int)],
            "cudaDeviceGetAttribute": [ctypes.POINTER(ctypes.c_int), ctypes.c_int, ctypes.c_int],
            "cudaGetDeviceProperties": [address, ctypes.c_int],
            "cudaMalloc": [out, size],
            "cudaFree": [address],
            "cudaHostAlloc": [out, size, ctypes.c_uint],
            "cudaFreeHost": [address],
            "cudaMemcpyAsync": [address, address, size, ctypes.c_int, handle],
            "cudaMemGetInfo": [ctypes.POINTER(size), ctypes.POINTER(size)],
            "cudaStreamCreateWithFlags": [out, ctypes.c_uint],
            "cudaStreamSynchronize": [handle],
            "cudaStreamDestroy": [handle],
            "cudaEventCreate": [out],
            "cudaEventRecord": [handle, handle],
            "cudaEventElapsedTime": [ctypes.POINTER(ctypes.c_float), handle, handle],
            "cudaEventDestroy": [handle],
        }
        for name, arguments in signatures.items():
            function = getattr(self._library, name)
            function.argtypes, function.restype = arguments, ctypes.c_int
        self._library.cudaGetErrorString.argtypes = [ctypes.c_int]
        self._library.cudaGetErrorString.restype = ctypes.c_char_p

    def _text(self, code: int) -> str:
        return _NO_DEVICE.get(code) or (self._library.cudaGetErrorString(code) or b"").decode("utf-8", "replace")

    def _call(self, name: str, *arguments: object) -> None:
        code = getattr(self._library, name)(*arguments)
        if code:
            raise CudaError(name, code, self._text(code))

    def _create(self, name: str, *arguments: object) -> int:
        made = ctypes.c_void_p()
        self._call(name, ctypes.byref(made), *arguments)
        return made.value or 0

    def _name(self) -> str:
        """Return e.g. ``Orin, compute capability 8.7, 8 multiprocessors``."""
        # The name comes first in cudaDeviceProp whatever the version, and no version of it reaches 4 KiB.
        properties = ctypes.create_string_buffer(4096)
        self._call("cudaGetDeviceProperties", properties, 0)
        values = []
        for attribute in (_COMPUTE_MAJOR, _COMPUTE_MINOR, _MULTIPROCESSORS):
            value = ctypes.c_int(0)
            self._call("cudaDeviceGetAttribute", ctypes.byref(value), attribute, 0)
            values.append(value.value)
        name = properties.value.decode("utf-8", "replace")
        return f"{name}, compute capability {values[0]}.{values[1]}, {values[2]} multiprocessors"

    def malloc(self, size: int) -> int:
        """Return the address of new memory on the device; CudaError 2 if there is not enough."""
        return self._create("cudaMalloc", size)

    def free(self, address: int) -> None:
        """Free memory of the device."""
        self._call("cudaFree", address)

    def host_alloc(self, size: int) -> int:
        """Return the address of new page-locked host memory."""
        return self._create("cudaHostAlloc", size, 0)

    def host_free(self, address: int) -> None:
        """Free page-locked host memory."""
        self._call("cudaFreeHost", address)

    def stream_create(self) -> int:
        """Return a new stream that does not wait for the default stream."""
        return self._create("cudaStreamCreateWithFlags", _NON_BLOCKING)

    def stream_synchronize(self, stream: int) -> None:
        """Wait until all work in the stream is done; raises what went wrong in it."""
        self._call("cudaStreamSynchronize", stream)

    def stream_destroy(self, stream: int) -> None:
        """Free a stream."""
        self._call("cudaStreamDestroy", stream)

    def copy_to_device(self, device: int, host: int, size: int, stream: int) -> None:
        """Enqueue a copy from host memory to the device."""
        self._call("cudaMemcpyAsync", device, host, size, _HOST_TO_DEVICE, stream)

    def copy_to_host(self, host: int, device: int, size: int, stream: int) -> None:
        """Enqueue a copy from the device to host memory."""
        self._call("cudaMemcpyAsync", host, device, size, _DEVICE_TO_HOST, stream)

    def event_create(self) -> int:
        """Return a new event that can be timed."""
        return self._create("cudaEventCreate")

    def event_record(self, event: int, stream: int) -> None:
        """Enqueue taking the time."""
        self._call("cudaEventRecord", event, stream)

    def event_elapsed_ms(self, start: int, end: int) -> float:
        """Return the time between two recorded events whose stream was synchronised, ms."""
        elapsed = ctypes.c_float(0.0)
        self._call("cudaEventElapsedTime", ctypes.byref(elapsed), start, end)
        return elapsed.value

    def event_destroy(self, event: int) -> None:
        """Free an event."""
        self._call("cudaEventDestroy", event)

    def memory_info(self) -> tuple[int, int]:
        """Return free and total memory of the device."""
        free, total = ctypes.c_size_t(0), ctypes.c_size_t(0)
        self._call("cudaMemGetInfo", ctypes.byref(free), ctypes.byref(total))
        return free.value, total.value


def _load(names: list[str]) -> ctypes.CDLL:
    reasons = []
    for name in names:
        try:
            return ctypes.CDLL(name)
        except OSError as error:
            reasons.append(str(error))
    raise MissingDependencyError(
        "The CUDA runtime (libcudart)",
        needed_for="TensorRT",
        install="on a Jetson `sudo apt install nvidia-jetpack` (or its smaller packages cuda-cudart "
        f"and tensorrt); elsewhere NVIDIA's CUDA toolkit. Last tried: {reasons[-1] if reasons else 'nothing'}",
    )


def out_of_memory(error: CudaError, needed: int, what: str) -> InputError:
    """Return the error that explains that memory ran out.

    Args:
        error: what CUDA said.
        needed: bytes asked for.
        what: which memory.
    """
    return InputError(
        what,
        given=f"{needed / 2**20:.1f} MiB more ({error.text})",
        expected="as much free memory (a Jetson's GPU shares it with everything else)",
        fix="Lower max_batch or workspace_bytes, close other programs, or add swap while building.",
    )

"""The route to CUDA passes what the C functions take: tried on a library of Python functions with C signatures."""

from __future__ import annotations

import ctypes
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from robotbrain.errors import InputError, MissingDependencyError
from robotbrain.jetson.engine import cuda
from robotbrain.jetson.engine.cuda import CudaError, LibCudart, host_view
from robotbrain.jetson.engine.simulated import SimulatedCuda

_POINTER, _SIZE, _INT = ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int
_BIG = 1 << 40


class FakeLibrary:
    """Looks like libcudart to ctypes; "device" memory is host memory. Addresses need all 64 bits, as real ones do."""

    def __init__(self, *, devices: int = 1, code: int = 0) -> None:
        self.log: list[tuple[Any, ...]] = []
        self._memory: dict[int, Any] = {}
        self._keep: list[Any] = []

        def put(address: int, value: int, kind: Any = _POINTER) -> int:
            kind.from_address(address).value = value
            return 0

        def allocate(address: int, size: int, *_: int) -> int:
            if size >= _BIG:
                return 2
            buffer = ctypes.create_string_buffer(size)
            self._memory[ctypes.addressof(buffer)] = buffer
            return put(address, ctypes.addressof(buffer))

        def free(address: int) -> int:
            return 0 if self._memory.pop(address, None) is not None else 1

        def copy(target: int, source: int, size: int, kind: int, stream: int) -> int:
            self.log.append(("copy", size, kind, stream))
            ctypes.memmove(target, source, size)
            return 0

        def properties(address: int, _device: int) -> int:
            ctypes.memmove(address, b"Orin\0", 5)
            return 0

        def logged(*arguments: int | None) -> int:
            self.log.append(arguments)
            return 0

        attributes = {75: 8, 76: 7, 16: 16}
        functions: dict[str, tuple[Any, list[Any]]] = {
            "cudaGetDeviceCount": (lambda a: put(a, devices, _INT) or code, [_POINTER]),
            "cudaDeviceGetAttribute": (lambda a, which, _: put(a, attributes[which], _INT), [_POINTER, _INT, _INT]),
            "cudaGetDeviceProperties": (properties, [_POINTER, _INT]),
            "cudaMalloc": (allocate, [_POINTER, _SIZE]),
            "cudaFree": (free, [_POINTER]),
            "cudaHostAlloc": (allocate, [_POINTER, _SIZE, ctypes.c_uint]),
            "cudaFreeHost": (free, [_POINTER]),
            "cudaMemcpyAsync": (copy, [_POINTER, _POINTER, _SIZE, _INT, _POINTER]),
            "cudaMemGetInfo": (lambda a, b: put(a, 3 << 33, _SIZE) or put(b, 4 << 33, _SIZE), [_POINTER, _POINTER]),
            "cudaStreamCreateWithFlags": (lambda a, flags: put(a, (7 << 40) + flags), [_POINTER, ctypes.c_uint]),
            "cudaStreamSynchronize": (logged, [_POINTER]),
            "cudaStreamDestroy": (logged, [_POINTER]),
            "cudaEventCreate": (lambda a: put(a, 9 << 40), [_POINTER]),
            "cudaEventRecord": (logged, [_POINTER, _POINTER]),
            "cudaEventElapsedTime": (lambda a, *_: put(a, 2.5, ctypes.c_float), [_POINTER, _POINTER, _POINTER]),  # type: ignore[arg-type]
            "cudaEventDestroy": (logged, [_POINTER]),
        }
        for name, (function, arguments) in functions.items():
            self._add(name, _INT, arguments, function)
        self._add("cudaGetErrorString", ctypes.c_char_p, [_INT], lambda _: None)

    def _add(self, name: str, result: Any, arguments: list[Any], function: Any) -> None:
        # A C function made from Python: it is declared from its address, as ctypes does with a library's.
        made = ctypes.CFUNCTYPE(result, *arguments)(function)
        self._keep.append(made)
        address = ctypes.cast(made, _POINTER).value
        assert address is not None
        setattr(self, name, ctypes.CFUNCTYPE(result)(address))


@pytest.fixture
def library(monkeypatch: pytest.MonkeyPatch) -> FakeLibrary:
    made = FakeLibrary()
    monkeypatch.setattr(cuda, "_load", lambda _: made)
    return made


def test_memory_goes_there_and_back(library: FakeLibrary) -> None:
    gpu = LibCudart()
    assert gpu.device == "Orin, compute capability 8.7, 16 multiprocessors" and not gpu.simulated
    stream = gpu.stream_create()
    assert stream == (7 << 40) + 1  # non-blocking, and no bit of the handle is lost
    values = np.arange(50, dtype=np.uint8)
    device, host = gpu.malloc(50), gpu.host_alloc(50)
    host_view(host, 50)[:] = values
    gpu.copy_to_device(device, host, 50, stream)
    host_view(host, 50)[:] = 0
    gpu.copy_to_host(host, device, 50, stream)
    gpu.stream_synchronize(stream)
    np.testing.assert_array_equal(host_view(host, 50), values)
    assert library.log == [("copy", 50, 1, stream), ("copy", 50, 2, stream), (stream,)]
    assert gpu.memory_info() == (3 << 33, 4 << 33)
    gpu.free(device)
    gpu.host_free(host)
    with pytest.raises(CudaError, match="cudaFree failed"):
        gpu.free(device)
    gpu.stream_destroy(stream)


def test_events(library: FakeLibrary) -> None:
    gpu = LibCudart()
    event = gpu.event_create()
    gpu.event_record(event, 5)
    assert event == 9 << 40 and library.log[-1] == (event, 5)
    assert gpu.event_elapsed_ms(event, event) == 2.5
    gpu.event_destroy(event)
    assert library.log[-1] == (event,)


@pytest.mark.usefixtures("library")
def test_too_little_memory_has_its_own_number() -> None:
    gpu = LibCudart()
    for allocate in (gpu.malloc, gpu.host_alloc):
        with pytest.raises(CudaError) as caught:
            allocate(_BIG)
        assert caught.value.code == cuda.OUT_OF_MEMORY


@pytest.mark.parametrize(
    ("made", "words"), [({"devices": 0}, "none"), ({"code": 35}, "driver is older"), ({"code": 100}, "no GPU")]
)
def test_without_a_gpu_the_message_says_what_to_use(
    monkeypatch: pytest.MonkeyPatch, made: dict[str, int], words: str
) -> None:
    library = FakeLibrary(**made)
    monkeypatch.setattr(cuda, "_load", lambda _: library)
    with pytest.raises(InputError, match=rf"{words}.*onnxruntime or twin"):
        LibCudart()


def test_without_cuda_the_message_names_the_packages(tmp_path: Path) -> None:
    with pytest.raises(MissingDependencyError, match=r"libcudart.*nvidia-jetpack"):
        LibCudart(str(tmp_path / "libcudart.so"))


def test_the_stand_in_offers_what_the_genuine_one_does() -> None:
    def public(kind: type) -> set[str]:
        return {name for name in dir(kind) if not name.startswith("_")}

    protocol = public(cuda.CudaRuntime) - {"device"}
    assert protocol <= public(LibCudart) and protocol <= public(SimulatedCuda)
    assert "simulated" in repr(SimulatedCuda("Orin")) and SimulatedCuda("Orin").device == "simulated Orin"

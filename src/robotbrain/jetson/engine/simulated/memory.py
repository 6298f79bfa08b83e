"""A stand-in for the CUDA runtime that catches misuse. It has no GPU and no clock.

Nothing that is enqueued happens before its stream is synchronised, as late as real hardware may be. Until then the
memory that it will write is poison (every byte 0xFF, a NaN in float32), so reading too early shows. Addresses of the
device lie where no host memory is, so that swapping the two is caught, as are sizes, use after free, and leaks.
"""

from __future__ import annotations

import ctypes
import itertools
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NoReturn

import numpy as np
from numpy.typing import NDArray

from robotbrain.errors import RobotBrainError
from robotbrain.jetson.engine.cuda import OUT_OF_MEMORY, CudaError, host_view

DEVICE_NAME = "simulated GPU"
ALIGNMENT = 256
POISON = 0xFF
_DEVICE_BASE = 1 << 60  # beyond what user programs get on 64-bit machines


class MisuseError(RobotBrainError, RuntimeError):
    """Misuse that real hardware would answer with garbage, a crash, or nothing at all.

    Args:
        kind: a short stable word.
        message: what was wrong, and what would be right.
    """

    def __init__(self, kind: str, message: str) -> None:
        self.kind, self.message = kind, message
        super().__init__(f"simulated CUDA: {kind}: {message}")

    def __reduce__(self) -> tuple[object, ...]:
        return (type(self), (self.kind, self.message))


@dataclass
class Block:
    """One allocation.

    Attributes:
        address: of its first byte.
        data: its bytes.
        where: ``device`` or ``host``.
        busy: enqueued operations that will read or write it.
        keep: what owns a host block's memory.
    """

    address: int
    data: NDArray[np.uint8]
    where: str
    busy: int = 0
    keep: object = None

    def __contains__(self, address: int) -> bool:
        return self.address <= address < self.address + max(1, self.data.size)


@dataclass
class _Operation:
    """Work in a stream: what to do, and the blocks that it reads or writes."""

    run: Callable[[], None]
    blocks: tuple[Block, ...] = field(default_factory=tuple)


class SimulatedCuda:
    """The simulated CUDA runtime of one imaginary GPU.

    Args:
        device: what the GPU is called; ``simulated`` is put before it if it is not there.
        memory_bytes: of the device.

    Attributes:
        calls: names of the calls so far, in order; ``run: ...`` where deferred work was done.
    """

    simulated = True

    def __init__(self, device: str = DEVICE_NAME, memory_bytes: int = 1 << 30) -> None:
        self.device = device if "simulated" in device else f"simulated {device}"
        self.calls: list[str] = []
        self._memory = memory_bytes
        self._blocks: dict[int, Block] = {}
        self._freed: list[tuple[int, int]] = []
        self._graveyard: list[object] = []  # keeps freed host memory mapped: reading it shows poison, not a crash
        self._next = _DEVICE_BASE
        self._streams: dict[int, list[_Operation]] = {}
        self._handles = itertools.count(0x5000)
        self._events: set[int] = set()

    def __repr__(self) -> str:
        return f"SimulatedCuda({self.device!r}, nothing measured here is a latency)"

    # ------------------------------------------------------------ memory

    def malloc(self, size: int) -> int:
        """Return the address of new poisoned device memory, aligned to 256 bytes; CudaError 2 if it is full."""
        self.calls.append("malloc")
        if size > self.memory_info()[0]:
            raise CudaError("cudaMalloc", OUT_OF_MEMORY, "out of memory (simulated)")
        address = self._next
        self._next += (size // ALIGNMENT + 2) * ALIGNMENT  # a gap, so that overruns hit nothing
        self._blocks[address] = Block(address, np.full(size, POISON, np.uint8), "device")
        return address

    def host_alloc(self, size: int) -> int:
        """Return the address of new poisoned page-locked host memory."""
        self.calls.append("host_alloc")
        buffer = ctypes.create_string_buffer(max(1, size))
        address = ctypes.addressof(buffer)
        data = host_view(address, size)
        data[:] = POISON
        self._blocks[address] = Block(address, data, "host", keep=buffer)
        return address

    def free(self, address: int) -> None:
        """Free device memory."""
        self._free(address, "device")

    def host_free(self, address: int) -> None:
        """Free page-locked host memory."""
        self._free(address, "host")

    def _free(self, address: int, where: str) -> None:
        self.calls.append("free" if where == "device" else "host_free")
        block = self.block(address, where, 0)
        if block.address != address:
            self.fault("bad-free", "free what was allocated, not an address inside it")
        if block.busy:
            self.fault("freed-early", "a stream still uses this memory: synchronise it before freeing")
        block.data[:] = POISON
        self._freed.append((address, block.data.size))
        self._graveyard.append(block.keep)
        del self._blocks[address]

    def memory_info(self) -> tuple[int, int]:
        """Return free and total memory of the imaginary device, bytes."""
        used = sum(block.data.size for block in self._blocks.values() if block.where == "device")
        return self._memory - used, self._memory

    def block(self, address: int, where: str, size: int) -> Block:
        """Return the allocation that holds ``size`` bytes from an address on; a fault if there is none."""
        block = next((block for block in self._blocks.values() if address in block), None)
        if block is None:
            if any(start <= address < start + max(1, length) for start, length in self._freed):
                self.fault("use-after-free", f"the address {address:#x} was freed")
            if where == "device" and address < _DEVICE_BASE:
                self.fault("host-pointer", f"{address:#x} is host memory; an address of the device belongs here")
            if where == "host" and address >= _DEVICE_BASE:
                self.fault("device-pointer", f"{address:#x} is device memory; page-locked host memory belongs here")
            self.fault("unknown-pointer", f"{address:#x} was not allocated ({where} memory belongs here)")
        if block.where != where:
            kind = "host-pointer" if block.where == "host" else "device-pointer"
            self.fault(kind, f"{address:#x} is {block.where} memory; {where} memory belongs here")
        if address + size > block.address + block.data.size:
            self.fault("overrun", f"{size} bytes from {address:#x} on are more than the {block.data.size} allocated")
        return block

    # ------------------------------------------------------------ streams

    def stream_create(self) -> int:
        """Return a new stream."""
        self.calls.append("stream_create")
        handle = next(self._handles)
        self._streams[handle] = []
        return handle

    def stream_synchronize(self, stream: int) -> None:
        """Do everything that was enqueued, in order."""
        self.calls.append("stream_synchronize")
        queue = self._queue(stream)
        while queue:
            operation = queue.pop(0)
            for block in operation.blocks:
                block.busy -= 1
            operation.run()

    def stream_destroy(self, stream: int) -> None:
        """Free a stream; a fault if work is left in it."""
        self.calls.append("stream_destroy")
        if self._queue(stream):
            self.fault("freed-early", "the stream still has work: synchronise it first")
        del self._streams[stream]

    def enqueue(self, name: str, stream: int, run: Callable[[], None], *blocks: Block) -> None:
        """Put work into a stream; used by the simulated TensorRT too."""
        self.calls.append(name)
        queue = self._queue(stream)
        for block in blocks:
            block.busy += 1

        def logged() -> None:
            self.calls.append(f"run: {name}")
            run()

        queue.append(_Operation(logged, blocks))

    def _queue(self, stream: int) -> list[_Operation]:
        if stream not in self._streams:
            what = "the default stream waits for all others" if stream == 0 else "no such stream"
            self.fault("stream", f"{what}: pass a stream made with stream_create")
        return self._streams[stream]

    def copy_to_device(self, device: int, host: int, size: int, stream: int) -> None:
        """Enqueue a copy to the device; a fault if the source changes before it runs."""
        target, source = self.block(device, "device", size), self.block(host, "host", size)
        start, begin = device - target.address, host - source.address
        promised = source.data[begin : begin + size].copy()

        def run() -> None:
            if not np.array_equal(source.data[begin : begin + size], promised):
                self.fault("overwritten", "the host buffer changed before the copy had run: synchronise first")
            target.data[start : start + size] = promised

        self.enqueue("copy_to_device", stream, run, target, source)

    def copy_to_host(self, host: int, device: int, size: int, stream: int) -> None:
        """Enqueue a copy to the host, whose buffer is poison until then."""
        target, source = self.block(host, "host", size), self.block(device, "device", size)
        start, begin = host - target.address, device - source.address
        target.data[start : start + size] = POISON

        def run() -> None:
            target.data[start : start + size] = source.data[begin : begin + size]

        self.enqueue("copy_to_host", stream, run, target, source)

    # ------------------------------------------------------------ events

    def event_create(self) -> int:
        """Return a new event."""
        handle = next(self._handles)
        self._events.add(handle)
        return handle

    def event_record(self, event: int, stream: int) -> None:
        """Enqueue a mark without a time."""
        self.enqueue("event_record", stream, lambda: None)

    def event_elapsed_ms(self, start: int, end: int) -> float:
        """Always a fault: there is no clock."""
        self.fault("no-clock", "a simulated runtime has no latency; ask the twin, or measure on a board")

    def event_destroy(self, event: int) -> None:
        """Free an event."""
        self._events.remove(event)

    # ------------------------------------------------------------ checks

    @property
    def live(self) -> tuple[str, ...]:
        """What is allocated now, in words; empty after everything was closed."""
        blocks = [f"{block.where} memory, {block.data.size} bytes" for block in self._blocks.values()]
        return (*blocks, *("stream" for _ in self._streams), *("event" for _ in self._events))

    def fault(self, kind: str, message: str) -> NoReturn:
        """Raise a MisuseError."""
        raise MisuseError(kind, message)

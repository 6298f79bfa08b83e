"""Makes a warm process cheap to fork, by closing the holes that its imports left in the heap.

A child that allocates takes the holes first. They lie scattered over hundreds of megabytes that it shares with its
parent, and each page it writes to is copied; memory from the end of the heap is its own at once.
"""

from __future__ import annotations

import ctypes
import sys

_FIELDS = "arena ordblks smblks hblks hblkhd usmblks fsmblks uordblks fordblks keepcost".split()  # noqa: SIM905
_LARGEST, _SMALLEST, _STEP = 64 << 10, 16, 16
_FINE = 1040  # below, a size has a list of its own
_MOST = 1_000_000


class _Statistics(ctypes.Structure):
    _fields_ = tuple((name, ctypes.c_size_t) for name in _FIELDS)


def fill_holes() -> int:
    """Take all free memory below the end of the heap, for good; return how much it was (bytes).

    Works with the GNU C library's allocator; elsewhere it does nothing.
    """
    if sys.platform != "linux":
        return 0
    libc = ctypes.CDLL(None)
    if not hasattr(libc, "mallinfo2"):
        return 0
    libc.mallinfo2.restype = _Statistics
    libc.malloc.restype, libc.malloc.argtypes = ctypes.c_void_p, [ctypes.c_size_t]
    libc.free.restype, libc.free.argtypes = None, [ctypes.c_void_p]
    libc.sbrk.restype, libc.sbrk.argtypes = ctypes.c_void_p, [ctypes.c_ssize_t]
    taken = count = 0
    for size in _sizes():
        end = (libc.sbrk(0) or 0) - int(libc.mallinfo2().keepcost)
        while count < _MOST:
            place = libc.malloc(size)
            if place is None or place >= end:  # no hole of this size is left
                libc.free(place)
                break
            taken, count = taken + size, count + 1
    return taken


def _sizes() -> list[int]:
    """What to ask for, the largest first, so that a large hole takes few requests."""
    sizes, size = [], _LARGEST
    while size >= _SMALLEST:
        sizes.append(size - 8)  # the allocator's own word beside it
        size = size - _STEP if size <= _FINE else size * 7 // 8 // _STEP * _STEP
    return sizes

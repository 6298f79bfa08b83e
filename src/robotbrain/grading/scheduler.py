"""Runs many tasks side by side and hands each result, as it comes, to one consumer."""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Iterable
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from typing import TypeVar

import psutil

_Task = TypeVar("_Task")
_Result = TypeVar("_Result")
_AHEAD = 2  # tasks handed out per worker, so that none waits for the consumer
_MEMORY_BYTES = 1 << 30  # free memory for each submission that runs; most need far less
_POLL_S = 0.5  # Windows does not interrupt a wait without an end


def usable_cores() -> int:
    """How many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def fitting_workers() -> int:
    """How many submissions to run at the same time here: one per core and one more, as far as memory allows.

    The one more runs while others start, end or wait for the gradebook: a tenth of the time, measured on two cores. On
    a single core nothing ever waits, and two submissions fight for the cache.
    """
    cores = usable_cores()
    return max(1, min(cores + (cores > 1), int(psutil.virtual_memory().available // _MEMORY_BYTES)))


def run(
    tasks: Iterable[_Task],
    work: Callable[[_Task], _Result],
    consume: Callable[[_Result], None],
    *,
    workers: int = 1,
    stop: Callable[[], None] | None = None,
) -> None:
    """Call ``work`` on each task in threads, and ``consume`` on each result in this one, in the order they end.

    Tasks are taken as workers become free, so that neither tasks nor results pile up. An exception in ``work`` or
    ``consume``, and Ctrl-C, end it: no further task begins, ``stop`` is called to cut short those that run, and the
    exception goes on to the caller once they have ended.
    """
    feed = iter(tasks)
    with ThreadPoolExecutor(max_workers=max(1, workers), thread_name_prefix="grade") as pool:
        running: set[Future[_Result]] = set()
        try:
            while True:
                for task in itertools.islice(feed, _AHEAD * max(1, workers) - len(running)):
                    running.add(pool.submit(work, task))
                if not running:
                    return
                ended, running = wait(running, timeout=_POLL_S, return_when=FIRST_COMPLETED)
                for future in ended:
                    consume(future.result())
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            if stop is not None:
                stop()
            raise

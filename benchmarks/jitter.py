"""How well this machine keeps a rate: ways to wait, with and without load, measured on the wall clock.

Run: ``python benchmarks/jitter.py [--hz 100] [--seconds 5]``. ``late``: from when a call was due to when it started.
``drift``: how much longer than meant a period is on average; 10000 ppm is 1 %. ``load``: a process that keeps a core
busy beside the loop for each core of the machine.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import platform
import subprocess
import sys
import time
from collections.abc import Iterator

from robotbrain.pipeline.patterns.jitter import WALL_METHODS, WallMethod, measure_jitter, realtime_priority

BUSY = "import time\nend = time.monotonic() + float(__import__('sys').argv[1])\nwhile time.monotonic() < end: pass"


@contextlib.contextmanager
def load(processes: int, seconds: float) -> Iterator[None]:
    """Keep cores busy; the processes end by themselves should nobody stop them."""
    busy = [subprocess.Popen([sys.executable, "-c", BUSY, str(seconds + 5)]) for _ in range(processes)]
    try:
        time.sleep(0.3 if busy else 0)
        yield
    finally:
        for process in busy:
            process.kill()
            process.wait()


def work_2ms() -> None:
    """Two milliseconds of work, as a small controller."""
    end = time.perf_counter() + 0.002
    while time.perf_counter() < end:
        pass


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description="How well this machine keeps a rate.")
    parser.add_argument("--hz", type=float, default=100.0, help="of the loop (default 100)")
    parser.add_argument("--seconds", type=float, default=5.0, help="for each row (default 5)")
    parser.add_argument("--no-load", action="store_true", help="leave out the rows with load")
    options = parser.parse_args()
    cores = os.cpu_count() or 1
    with realtime_priority() as outcome:
        pass
    print(f"{platform.system()} {platform.release()}, {cores} cores, real-time kernel: {outcome.preempt_rt}")
    print(f"{options.hz:g} Hz for {options.seconds:g} s, 2 ms of work in each call; real-time priority: {outcome}\n")
    head = ("late p50", "p99", "largest", "drift", "skipped", "CPU")
    print(f"{'wait':<12}{'load':>6}{'priority':>16}" + "".join(f"{name:>11}" for name in head))
    rows: list[tuple[WallMethod, int, int | None]] = [(method, 0, None) for method in WALL_METHODS]
    if not options.no_load:
        rows += [("timer", cores, None), *([("timer", cores, 50)] if outcome.granted else [])]
    for method, processes, priority in rows:
        with load(processes, options.seconds):
            found = measure_jitter(options.hz, options.seconds, method, work=work_2ms, priority=priority)
        median, p99, most = found.percentiles_us(50, 99, 100)
        cpu = found.cpu_s / (found.times.ends_ns[-1] * 1e-9)
        print(
            f"{method:<12}{processes:>6}{found.priority:>16}{median:>8.0f} μs{p99:>8.0f} μs{most:>8.0f} μs"
            f"{found.drift_ppm:>7.0f} ppm{found.skipped:>11}{100 * cpu:>9.0f} %"
        )


if __name__ == "__main__":
    main()

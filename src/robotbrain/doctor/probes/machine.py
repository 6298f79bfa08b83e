"""Processors, memory, the clock, and settings of how many threads libraries start."""

from __future__ import annotations

import os
import time
from pathlib import Path

from robotbrain.doctor.finding import Finding, Situation, everywhere, note, ok, set_variable, unset_variable, warning

LEAST_MEMORY = 4e9
LEAST_FREE = 1e9
_BUILT = 1_763_769_600  # 22 November 2025: no correct clock shows an earlier time
_THREAD_VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMEXPR_NUM_THREADS")


def machine(_: Situation) -> list[Finding]:
    """Processors, memory and the clock."""
    found: list[Finding] = []
    processors = _processors()
    total, free = _memory()
    if processors < 2:
        found.append(
            note(
                "one processor only: everything works, but training and grading take longer than stated",
                everywhere("Give the virtual machine or container two processors or more."),
            )
        )
    if total is not None and total < LEAST_MEMORY:
        found.append(
            warning(
                f"{total / 1e9:.1f} GB of memory; lessons with torch need 4 GB",
                everywhere(
                    "Give the container or virtual machine 4 GB or more (Docker Desktop: Settings > Resources; WSL: "
                    "memory=4GB under [wsl2] in .wslconfig), and keep one notebook open at a time."
                ),
            )
        )
    elif free is not None and free < LEAST_FREE:
        found.append(
            warning(
                f"only {free / 1e9:.1f} GB of memory are free",
                everywhere(
                    "Close other programs, and kernels of notebooks that are no longer used (JupyterLab: Kernel > "
                    "Shut Down All Kernels)."
                ),
            )
        )
    if time.time() < _BUILT:
        found.append(
            warning(
                f"the clock shows {time.strftime('%Y-%m-%d')}: downloads fail (certificates) and submissions seem late",
                everywhere("Set the computer's date and time; switch on setting it from the network."),
            )
        )
    size = "" if total is None else f", {total / 1e9:.1f} GB of memory"
    return [ok(f"{processors} processor{'s' if processors > 1 else ''}{size}"), *found]


def threads(_: Situation) -> list[Finding]:
    """Environment variables that set numbers of threads."""
    found: list[Finding] = []
    processors = _processors()
    for name in _THREAD_VARIABLES:
        value = os.environ.get(name)
        if value is None:
            continue
        numbers = value.split(",")
        if not all(n.strip().isdigit() and int(n) > 0 for n in numbers):
            found.append(
                warning(f"{name}={value!r} is no number of threads; libraries ignore it or stop", unset_variable(name))
            )
        elif int(numbers[0]) > 2 * processors:
            found.append(
                warning(
                    f"{name}={value} on {processors} processors: threads wait for one another, and all gets slower",
                    set_variable(name, str(processors)),
                )
            )
    return found or [ok("numbers of threads are left to the libraries or fit the processors")]


def _processors() -> int:
    affinity = getattr(os, "sched_getaffinity", None)  # Linux only
    return len(affinity(0)) if affinity is not None else os.cpu_count() or 1


def _memory() -> tuple[float | None, float | None]:
    """Total and free memory, bytes, within the limits of a container; None where the system does not say."""
    try:
        import psutil

        memory = psutil.virtual_memory()
        total, free = float(memory.total), float(memory.available)
    except Exception:  # missing or broken: another probe says so
        return None, None
    for name in ("memory.max", "memory/memory.limit_in_bytes"):
        try:
            limit = float((Path("/sys/fs/cgroup") / name).read_text(encoding="ascii"))
        except (OSError, ValueError):
            continue
        total, free = min(total, limit), min(free, limit)
    return total, free

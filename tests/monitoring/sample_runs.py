"""Runs that several tests look at; each is driven once."""

from __future__ import annotations

import functools

from robotbrain.monitoring.monitor import Monitor
from robotbrain.monitoring.trace import Trace
from robotbrain.pipeline.brain import RunResult, drive
from robotbrain.pipeline.devices import detector_deployment

SECONDS = 6.0


@functools.cache
def watched_run(overloaded: bool) -> tuple[RunResult, Monitor]:
    """Return a traced run and the monitor that watched it: one brain with time to spare, one far too slow."""
    monitor = Monitor(window_s=2.0)
    run = drive(
        0,
        profile="nano-4gb:5W" if overloaded else "orin-nano-8gb",
        deployment=detector_deployment() if overloaded else None,
        time_limit=SECONDS,
        trace=True,
        attach=[monitor.attach],
    )
    return run, monitor


def trace_of(overloaded: bool) -> Trace:
    """Return the trace of one of the two runs."""
    trace = watched_run(overloaded)[0].trace
    assert trace is not None
    return trace

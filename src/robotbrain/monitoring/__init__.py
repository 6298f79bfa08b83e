"""Watching a robot brain: what it does, how long that takes, where the time goes, and what would help.

Names are imported on first use, so that ``import robotbrain.monitoring`` stays cheap.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from robotbrain.monitoring.accuracy import OnlineSegmentationAccuracy
    from robotbrain.monitoring.alarms import Alarm, AlarmRules
    from robotbrain.monitoring.chains import chain_ages, end_to_end_ms, find_chains
    from robotbrain.monitoring.dashboard import Dashboard
    from robotbrain.monitoring.deadlines import KIT_DEADLINES, Deadlines
    from robotbrain.monitoring.diagnosis import Diagnosis, diagnose
    from robotbrain.monitoring.metrics import measure
    from robotbrain.monitoring.monitor import Monitor
    from robotbrain.monitoring.perfetto import write_perfetto
    from robotbrain.monitoring.report import write_report
    from robotbrain.monitoring.sketch import LatencySketch
    from robotbrain.monitoring.summary import Summary
    from robotbrain.monitoring.trace import Recorder, Trace

__all__ = [
    "KIT_DEADLINES",
    "Alarm",
    "AlarmRules",
    "Dashboard",
    "Deadlines",
    "Diagnosis",
    "LatencySketch",
    "Monitor",
    "OnlineSegmentationAccuracy",
    "Recorder",
    "Summary",
    "Trace",
    "chain_ages",
    "diagnose",
    "end_to_end_ms",
    "find_chains",
    "measure",
    "write_perfetto",
    "write_report",
]

_HOMES = {
    "accuracy": ("OnlineSegmentationAccuracy",),
    "alarms": ("Alarm", "AlarmRules"),
    "chains": ("chain_ages", "end_to_end_ms", "find_chains"),
    "dashboard": ("Dashboard",),
    "deadlines": ("KIT_DEADLINES", "Deadlines"),
    "diagnosis": ("Diagnosis", "diagnose"),
    "metrics": ("measure",),
    "monitor": ("Monitor",),
    "perfetto": ("write_perfetto",),
    "report": ("write_report",),
    "sketch": ("LatencySketch",),
    "summary": ("Summary",),
    "trace": ("Recorder", "Trace"),
}


def __getattr__(name: str) -> Any:
    for home, names in _HOMES.items():
        if name in names:
            return getattr(importlib.import_module(f"{__name__}.{home}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)

"""What `hw3_performance` runs in the student's process: inputs only, no answers."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from robotbrain.grading.suites.planner_probes import PlannerHost
from robotbrain.monitoring.trace import Trace
from robotbrain.ros.context import CallbackRecord, MessageRecord

if TYPE_CHECKING:
    from robotbrain.grading import Student

_SETTINGS = ("image_size", "network", "scan_rays", "one_thread", "precision", "camera_queue")
"""Fields of a deployment."""


def rebuilt(student: Student, parts: Mapping[str, Any]) -> Trace:
    """Probe: make a trace of its columns (see the traces' module), where the student's code can read it."""
    segments = ((parts["resources"][which], length) for which, length in parts["segments"].tolist())
    published = iter(parts["published"].tolist())
    calls = []
    for who, ready, start, end, demand, pieces, number, message, sent, executor, worker in parts["calls"].tolist():
        node, kind, name = parts["who"][who]
        asked = tuple(itertools.islice(segments, pieces))
        out = tuple(itertools.islice(published, sent))
        calls.append(
            CallbackRecord(node, kind, name, ready, start, end, demand, asked, number, message, out, executor, worker)
        )
    messages = []
    for number, what, released, size in parts["messages"].tolist():
        kind, name, type_name, node = parts["what"][what]
        messages.append(MessageRecord(number, kind, name, type_name, node, released, size))
    stamps = dict(parts["stamps"].tolist())
    return Trace(callbacks=tuple(calls), messages=tuple(messages), stamps=stamps, **parts["rest"])


def _repaired(student: Student, module: str) -> Any:
    from robotbrain.pipeline.inherited import inherited_brain

    given = inherited_brain()
    return student["repair"](replace(given, module=module) if module else given)


def describe_repair(student: Student, module: str) -> dict[str, Any] | str:
    """Probe: what ``repair`` makes of the inherited brain (on another module), or the name of what it is instead.

    ``planner`` is the name of one of the kit's planners, or '' for one of the student's own.
    """
    from robotbrain.pipeline.inherited import BrainSetup

    setup = _repaired(student, module)
    if not isinstance(setup, BrainSetup):
        return type(setup).__name__
    kits = str(getattr(setup.planner, "__module__", "")).startswith("robotbrain.")
    return {
        "module": setup.module,
        "replan_after": setup.replan_after,
        "planner": str(getattr(setup.planner, "__name__", "")) if kits else "",
        "deployment": {name: getattr(setup.deployment, name) for name in _SETTINGS},
    }


def host_repaired(student: Student, module: str) -> PlannerHost:
    """Probe: the planner of the repaired brain, ready to be asked."""
    return PlannerHost(_repaired(student, module).planner)

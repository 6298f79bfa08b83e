"""What `capstone` runs in the student's process: inputs only, no answers."""

from __future__ import annotations

from typing import TYPE_CHECKING

from robotbrain.grading.forbidden import why_forbidden
from robotbrain.grading.suite import Ban
from robotbrain.grading.suites.lab_integration import HELPERS

if TYPE_CHECKING:
    from robotbrain.grading import Student


def whose_planner(student: Student, name: str) -> str:
    """Probe: why the student's planner is the kit's, or '' if it is their own."""
    ban = Ban(("robotbrain.pipeline", "robotbrain.grading"), HELPERS)
    return why_forbidden(name, student[name], None, ban, student._namespace)

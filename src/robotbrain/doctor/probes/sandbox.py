"""What shuts student code in while grading on this host; only instructors need it."""

from __future__ import annotations

import sys

from robotbrain.doctor.finding import Finding, Situation, everywhere, note, ok, reinstall, warning
from robotbrain.doctor.isolated import try_out


def sandbox(situation: Situation) -> list[Finding]:
    """Start a student's process, as grading would, and name the layers that hold."""
    if sys.platform != "linux":
        return [
            note(
                "submissions are graded as plain processes: the sandbox needs Linux",
                everywhere(
                    "Grade on Linux: a server, a virtual machine, WSL (wsl --install), or the Dev Container. Students "
                    "need no sandbox."
                ),
            )
        ]
    outcome = try_out(["sandbox"], situation.limit_s)["sandbox"]
    if not outcome.fine:
        return [
            warning(
                "no student's process could be started; grading would fail (students need no sandbox)",
                everywhere(f"Cure the faults above first. If there are none: {reinstall('robotbrain').here()}"),
                outcome.message,
            )
        ]
    found = []
    held = []
    for name, active, words in outcome.data["layers"]:
        if active:
            held.append(name)
        else:
            found.append(
                note(f"the grading sandbox lacks the layer {name} (for instructors only)", everywhere(words.strip()))
            )
    return [ok(f"grading sandbox: {', '.join(held)}"), *found]

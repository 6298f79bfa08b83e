"""Findings as a table for people and as JSON for programs."""

from __future__ import annotations

import json
import shutil
import textwrap
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import TextIO

from robotbrain.doctor.finding import Finding, Severity

_COLOURS = {Severity.OK: "32", Severity.NOTE: "36", Severity.WARNING: "33", Severity.FAULT: "1;31"}
_LABELS = {Severity.OK: "ok", Severity.NOTE: "note", Severity.WARNING: "WARNING", Severity.FAULT: "FAULT"}
_LABEL, _NAME = 9, 19  # widths of the first two columns


def rows(findings: Iterable[Finding], *, colour: bool, width: int | None = None) -> str:
    """Return the rows of a table: severity, probe, what it found and the cure.

    Args:
        width: columns of the terminal; what was found is wrapped to it. Cures are not: a command that a line break cuts
            in two cannot be copied.
    """
    width = max(70, min(130, width or shutil.get_terminal_size((110, 24)).columns)) - _LABEL - _NAME
    margin = " " * (_LABEL + _NAME)
    lines = []
    for finding in findings:
        label = _paint(f"{_LABELS[finding.severity]:<{_LABEL}}", _COLOURS[finding.severity], colour)
        detail = f" ({finding.detail})" if finding.detail else ""
        what = _wrap(finding.what + detail, width)
        lines.append(f"{label}{finding.probe:<{_NAME}}{what[0]}")
        lines += [margin + line for line in what[1:]]
        if step := finding.cure.here():
            lines.append(margin + _paint("cure: ", "1", colour) + step)
    return "\n".join(lines)


def summary(findings: Sequence[Finding], *, colour: bool) -> str:
    """Return how many findings there are of each kind."""
    counts = Counter(finding.severity for finding in findings)
    if not counts[Severity.FAULT] and not counts[Severity.WARNING]:
        return _paint("Nothing is wrong here.", _COLOURS[Severity.OK], colour)
    worst = Severity.FAULT if counts[Severity.FAULT] else Severity.WARNING
    words = ", ".join(_count(counts[s], s.value) for s in (Severity.FAULT, Severity.WARNING, Severity.NOTE))
    rest = "" if counts[Severity.FAULT] else " The course will run."
    return _paint(f"{words}.{rest}", _COLOURS[worst], colour)


def as_json(findings: Sequence[Finding], about: dict[str, str]) -> str:
    """Return the findings as JSON, with the cure for this system."""
    rows = [
        {"probe": f.probe, "severity": f.severity.value, "what": f.what, "cure": f.cure.here(), "detail": f.detail}
        for f in findings
    ]
    return json.dumps({"about": about, "findings": rows}, indent=2)


def write(stream: TextIO, text: str) -> None:
    """Print ``text``, also where the terminal's encoding lacks a character of it."""
    encoding = getattr(stream, "encoding", None) or "ascii"
    print(text.encode(encoding, "backslashreplace").decode(encoding), file=stream, flush=True)


def _wrap(text: str, width: int) -> list[str]:
    return textwrap.wrap(text, width, break_long_words=False, break_on_hyphens=False) or [""]


def _paint(text: str, code: str, colour: bool) -> str:
    return f"\033[{code}m{text}\033[0m" if colour else text


def _count(number: int, word: str) -> str:
    return f"{number} {word}" if number == 1 else f"{number} {word}s"

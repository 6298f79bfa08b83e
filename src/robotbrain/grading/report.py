"""Reports a student can act on: plain text for terminals and nbgrader, HTML for the notebook and the feedback page."""

from __future__ import annotations

import html
import re
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from robotbrain.grading.reread import Place, places
from robotbrain.grading.results import TestResult, Verdict

SCORE_MIME = "application/vnd.robotbrain.score+json"
_WIDTH = 82  # nbgrader cuts longer lines when it prints a validation error
_COLOURS = {Verdict.PASSED: "#1a6b33", Verdict.NOT_WRITTEN: "#5c5c5c"}  # on white: contrast above 6:1
_FAILED_COLOUR = "#a3160f"


@dataclass(frozen=True)
class Report:
    """All test results of one exercise.

    Attributes:
        points: what the exercise is worth.
        substituted: upstream names that held the reference while these tests ran.
        complete: whether the hidden tests are among the results (or there are none).
    """

    lab: str
    exercise: str
    title: str
    points: float
    results: tuple[TestResult, ...]
    substituted: tuple[str, ...] = ()
    complete: bool = True

    @property
    def earned(self) -> float:
        """Points earned, scaled to :attr:`points` where hidden tests did not run; in ``[0, points]``."""
        worth = sum(r.points for r in self.results)
        share = sum(r.earned for r in self.results) / worth if worth else 0.0
        return min(self.points, max(0.0, round(share * self.points, 4)))

    @property
    def full(self) -> bool:
        """Whether every test passed."""
        return all(r.passed for r in self.results)

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready form, without anything a hidden test must not show."""
        return {
            "version": 1,
            "lab": self.lab,
            "exercise": self.exercise,
            "title": self.title,
            "points": self.points,
            "earned": self.earned,
            "complete": self.complete,
            "substituted": list(self.substituted),
            "tests": [r.to_dict() for r in self.results],
        }

    def _notes(self) -> list[str]:
        notes = []
        if self.substituted:
            names = ", ".join(self.substituted)
            notes.append(
                f"Used the course's reference for {names}, because yours does not pass its own tests yet: "
                f"this exercise is graded for its own part only."
            )
        if not self.complete:
            notes.append("More tests run when the lab is graded.")
        return notes

    def _places(self, result: TestResult) -> list[Place]:
        return [] if result.passed else places(self.lab, self.exercise, result.reread, self.title)

    def _details(self, result: TestResult) -> list[tuple[str, str]]:
        reread = "; ".join(place.text for place in self._places(result)) or result.reread
        pairs = [
            ("", result.message),
            ("given", result.given),
            ("expected", result.expected),
            ("got", result.got),
            ("likely", result.misconception),
            ("hint", result.hint),
            ("reread", reread),
            ("printed", result.printed.strip()[:300]),
        ]
        return [(label, text) for label, text in pairs if text]

    def __repr__(self) -> str:
        lines = [f"{self.title}: {_points(self.earned)} of {self.points:g} points"]
        for result in self.results:
            head = f"{result.verdict.symbol} {result.name} ({_points(result.earned)}/{result.points:g})"
            lines.append(f"  {head}: {result.verdict.label}")
            for label, text in self._details(result):
                first, *rest = [
                    line for part in text.splitlines() for line in textwrap.wrap(part, _WIDTH - 18) or [""]
                ] or [""]
                lines.append(f"      {label + ':':<10} {first}" if label else f"      {first}")
                lines += [f"      {'':<10} {line}" if label else f"      {line}" for line in rest]
        lines += [line for note in self._notes() for line in textwrap.wrap(note, _WIDTH)]
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        share = "all tests passed" if self.full else f"{_points(self.earned)} of {self.points:g} points"
        rows = "".join(_row(result, self._details(result), self._places(result)) for result in self.results)
        notes = "".join(f'<p style="margin:6px 0 0">{html.escape(note)}</p>' for note in self._notes())
        head = "".join(
            f'<th scope="col" style="text-align:left;padding:4px 8px">{h}</th>' for h in ("Test", "Result", "Points")
        )
        return (
            '<div class="robotbrain-report" role="group" style="background:#fff;color:#1a1a1a;'
            'border:1px solid #8a8a8a;border-radius:4px;padding:8px 12px;max-width:60em">'
            '<table style="border-collapse:collapse;table-layout:auto;width:100%;background:#fff;color:#1a1a1a">'
            '<caption style="text-align:left;font-weight:bold;padding:4px 8px;caption-side:top;color:#1a1a1a">'
            f"{html.escape(self.title)} ({html.escape(share)})</caption>"
            f"<thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table>{notes}</div>"
        )


def _row(result: TestResult, details: Sequence[tuple[str, str]], reread: Sequence[Place]) -> str:
    colour = _COLOURS.get(result.verdict, _FAILED_COLOUR)
    links = "; ".join(f'<a href="{html.escape(place.href)}">{html.escape(place.text)}</a>' for place in reread)
    told = "".join(
        f'<div style="margin:2px 0 2px 1.2em">{f"<b>{label}:</b> " if label else ""}'
        f"{links if label == 'reread' and links else _text_html(label, text)}</div>"
        for label, text in details
    )
    cell = "padding:4px 8px;vertical-align:top;text-align:left;border-top:1px solid #d0d0d0"
    hidden = " <i>(hidden)</i>" if result.hidden else ""
    return (
        f'<tr><td style="{cell}">{html.escape(result.name)}{hidden}</td>'
        f'<td style="{cell};white-space:nowrap;color:{colour};font-weight:bold">'
        f"{result.verdict.symbol} {result.verdict.label}</td>"
        f'<td style="{cell};white-space:nowrap">{_points(result.earned)} / {result.points:g}</td></tr>'
        + (f'<tr><td colspan="3" style="padding:0 8px 6px;text-align:left">{told}</td></tr>' if told else "")
    )


def _points(earned: float) -> str:
    """Points with at most one decimal: nobody reads the rest."""
    return f"{earned:.1f}".removesuffix(".0")


def _text_html(label: str, text: str) -> str:
    """Values as they would be printed; sentences with their `code` marked as such."""
    if label in ("given", "expected", "got", "printed"):
        return f'<code style="white-space:pre-wrap">{html.escape(text)}</code>'
    marked = re.sub(r"`([^`]+)`", r"<code>\1</code>", html.escape(text))
    return f'<span style="white-space:pre-wrap">{marked}</span>'


class Score(float):
    """The points of an exercise: a number to nbgrader, a report to a reader.

    ``text/plain`` is the bare number (nbgrader reads partial credit there), ``text/html`` the report, and
    :data:`SCORE_MIME` the results as JSON.
    """

    report: Report

    def __new__(cls, report: Report) -> Score:
        """Make the number out of ``report.earned``."""
        score = super().__new__(cls, report.earned)
        score.report = report
        return score

    def __repr__(self) -> str:
        return repr(float(self))

    def _repr_html_(self) -> str:
        return self.report._repr_html_()

    def _repr_mimebundle_(self, include: Any = None, exclude: Any = None) -> dict[str, Any]:
        return {
            "text/plain": repr(self),
            "text/html": self._repr_html_(),
            SCORE_MIME: self.report.to_dict(),
        }


class ScoreError(AssertionError):
    """Raised only while nbgrader validates a notebook: its text is the report, with no traceback around it."""

    def __init__(self, report: Report) -> None:
        super().__init__("\n" + repr(report))
        self.report = report

    def _render_traceback_(self) -> list[str]:
        """What IPython shows instead of a traceback."""
        return repr(self.report).splitlines()

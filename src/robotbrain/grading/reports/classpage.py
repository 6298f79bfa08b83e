"""The class on one page: the distribution of points, every student, and the item analysis; also as plain text."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from urllib.parse import quote

from markupsafe import Markup

from robotbrain.grading.marks import Marks
from robotbrain.grading.reports.items import Analysis, Item, analyse
from robotbrain.grading.reports.model import GradedClass, outcomes_of, unprotected, worths
from robotbrain.grading.reports.page import clean, points, render
from robotbrain.grading.results import Verdict

_TROUBLE = {Verdict.TIMEOUT, Verdict.CRASHED, Verdict.MEMORY, Verdict.FORBIDDEN}
BINS = 10


@dataclass(frozen=True)
class Student:
    """One row of the class table. ``marks`` holds (shown points, state) per exercise."""

    name: str
    page: str
    earned: float
    pending: float
    marks: Sequence[tuple[str, str]]
    trouble: Sequence[str]
    reason: str
    kinds: str
    without_sandbox: bool


def class_page(
    graded: GradedClass, pages: Mapping[str, str], *, similar: frozenset[str] = frozenset(), similarity: str = ""
) -> str:
    """The class as an HTML page.

    Args:
        pages: path of each student's feedback page, relative to this page.
        similar: students who are in the similarity report's list of pairs worth a look.
        similarity: path of that report, or "".
    """
    names = worths(graded.rows)
    students = [_student(row, names, pages, row.student in similar) for row in graded.rows]
    shares = [row.earned / (row.points or 1.0) for row in graded.rows]
    filters = [(kind, label, sum(kind in s.kinds.split() for s in students)) for kind, label in _FILTERS]
    return render(
        "class.html",
        lab=graded.lab,
        students=students,
        exercises=[(name.replace("_", " "), worth) for name, worth in names.items()],
        most=max((row.points for row in graded.rows), default=0.0),
        filters=[f for f in filters if f[2]],
        plot=histogram(shares),
        figures=_figures(graded.rows),
        analysis=analyse(graded.rows),
        similarity=similarity,
        unsandboxed=sum(s.without_sandbox for s in students),
    )


_FILTERS = (
    ("trouble", "Signs of trouble"),
    ("lost", "Lost points"),
    ("full", "Full points"),
    ("hand", "To be graded by hand"),
    ("similar", "In the similarity list"),
)


def _student(row: Marks, names: Mapping[str, float], pages: Mapping[str, str], similar: bool) -> Student:
    marks = {mark.exercise: mark for mark in row.marks}
    shown = []
    for name in names:
        mark = marks.get(name)
        if mark is None or mark.earned is None:
            shown.append(("–" if mark is None else "by hand", "quiet"))
        else:
            full = mark.earned >= mark.points - 1e-9
            shown.append((points(mark.earned) + ("" if full else " ✗"), "" if full else "bad"))
    trouble = signs_of_trouble(row)
    lost = any(m.earned is not None and m.earned < m.points - 1e-9 for m in row.marks)
    kinds = {"trouble": trouble, "lost": lost, "full": not lost and row.marks, "hand": row.pending, "similar": similar}
    return Student(
        name=row.student,
        # Quoted, it has no character left that means anything in HTML; and a path must not be cut.
        page=Markup(quote(pages[row.student], errors="replace")) if row.student in pages else "",
        earned=row.earned,
        pending=row.pending,
        marks=shown,
        trouble=trouble,
        reason=clean(row.reason(), 160),
        kinds=" ".join(kind for kind, yes in kinds.items() if yes),
        without_sandbox=bool(unprotected(row)),
    )


def signs_of_trouble(row: Marks) -> list[str]:
    """What an instructor should look at: repairs, crashes, time-outs, what was not allowed, tests that did not run."""
    verdicts = [o.verdict for mark in row.marks for o in outcomes_of(mark)]
    signs = [v.label for v in dict.fromkeys(verdicts) if v in _TROUBLE]
    if any(mark.error for mark in row.marks):
        signs.append("tests that could not run")
    if row.incidents:
        signs.append("repaired or disturbed")
    return signs


def histogram(shares: Sequence[float]) -> Markup:
    """How many students earned which share of the points: a plot, with the same numbers as its description."""
    counts = [0] * BINS
    for share in shares:
        counts[min(BINS - 1, max(0, int(share * BINS + 1e-9)))] += 1
    top = max([*counts, 1])
    told = "; ".join(f"{100 * i // BINS} to {100 * (i + 1) // BINS} %: {n}" for i, n in enumerate(counts) if n)
    bars = []
    for i, count in enumerate(counts):
        height = round(140 * count / top, 1)
        x = 30 + 46 * i
        if count:
            bars.append(f'<rect class="bar" x="{x}" y="{170 - height}" width="42" height="{height}"/>')
            bars.append(f'<text x="{x + 21}" y="{164 - height}" text-anchor="middle">{count}</text>')
        bars.append(f'<text x="{x - 2}" y="186" text-anchor="middle">{100 * i // BINS}</text>')
    bars.append('<text x="488" y="186" text-anchor="middle">100 %</text>')
    return Markup(
        f'<svg class="plot" viewBox="0 0 520 212" width="520" height="212" role="img" aria-label="Students by share of'
        f' the points. {told or "Nobody."}"><line class="axis" x1="24" y1="170" x2="494" y2="170"/>{"".join(bars)}'
        '<text x="259" y="206" text-anchor="middle">share of the points given so far</text></svg>'
    )


def _figures(rows: Sequence[Marks]) -> list[tuple[str, str]]:
    totals = sorted(row.earned for row in rows)
    if not totals:
        return [("students", "0")]
    count = len(totals)
    mean = math.fsum(totals) / count
    spread = math.sqrt(math.fsum((t - mean) ** 2 for t in totals) / (count - 1)) if count > 1 else 0.0
    quarters = [_quantile(totals, q) for q in (0.25, 0.5, 0.75)]
    return [
        ("students", str(count)),
        ("mean", points(mean)),
        ("standard deviation", points(spread)),
        ("lower quartile, median, upper quartile", ", ".join(map(points, quarters))),
        ("lowest and highest", f"{points(totals[0])}, {points(totals[-1])}"),
    ]


def _quantile(ordered: Sequence[float], q: float) -> float:
    """Linear interpolation between order statistics (type 7 of Hyndman and Fan 1996)."""
    place = q * (len(ordered) - 1)
    low = int(place)
    high = min(low + 1, len(ordered) - 1)
    return ordered[low] + (place - low) * (ordered[high] - ordered[low])


def items_text(analysis: Analysis) -> str:
    """The item analysis as plain text, a line for each exercise and test."""
    lines = [f"{analysis.students} submissions; {analysis.left_out} held nothing to test and are left out."]
    if analysis.small:
        lines.append(small_class_words(analysis))
    head = f"{'exercise / test':<58}{'points':>7}{'p':>7}{'r':>7}{'D':>7}  flags"
    lines += ["", head, "-" * len(head)]
    for exercise in analysis.exercises:
        lines.append(_line(clean(exercise.exercise, 56), exercise))
        lines += [_line("  " + clean(t.test, 54), t) for t in analysis.tests if t.exercise == exercise.exercise]
    lines += ["", f"Cronbach's alpha: {_shown(analysis.alpha_exercises)} over exercises, "
              f"{_shown(analysis.alpha_tests)} over tests{' (KR-20)' if analysis.dichotomous else ''}."]  # fmt: skip
    return "\n".join(line.rstrip() for line in lines)


def small_class_words(analysis: Analysis) -> str:
    """Why the numbers of a small class mean little."""
    return (
        f"With {analysis.students} submissions these numbers mean little: a discrimination between "
        f"{-analysis.notable:.2f} and {analysis.notable:.2f} cannot be told from 0."
    )


def _line(name: str, item: Item) -> str:
    figures = f"{item.points:>7g}{item.difficulty:>7.2f}{_shown(item.discrimination):>7}{item.upper_lower:>7.2f}"
    return f"{name:<58}{figures}  {', '.join(item.flags)}"


def _shown(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.2f}"

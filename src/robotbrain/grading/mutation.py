"""Testing the tests: does each named mistake lose its own points, show its own hint, and nothing else?"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

_CLOSE = 1e-6


@dataclass(frozen=True)
class Row:
    """What became of one sample submission.

    Attributes:
        lost: points lost in all.
        own: points lost in the exercise that the mistake is in.
        killers: names of the tests that found its mistake.
        problems: how it differs from what it should be; empty if it does not.
    """

    student: str
    kind: str
    name: str
    lost: float
    own: float
    killers: tuple[str, ...]
    hints: tuple[str, ...]
    problems: tuple[str, ...]


def judge(results: Mapping[str, Any], manifest: Mapping[str, Mapping[str, Any]]) -> list[Row]:
    """Compare ``results`` (of ``results.json``) with what each student of the sample class stands for."""
    graded = {s["student"]: s for s in results["students"]}
    rows = []
    for student, entry in manifest.items():
        if student not in graded:
            rows.append(Row(student, entry["kind"], entry["name"], 0.0, 0.0, (), (), ("has no grade",)))
            continue
        rows.append(_judge_one(graded[student], entry))
    return rows


def _judge_one(result: Mapping[str, Any], entry: Mapping[str, Any]) -> Row:
    losses = {e["exercise"]: e["points"] - e["earned"] for e in result["exercises"] if e["earned"] is not None}
    failed = [t for e in result["exercises"] for t in e["tests"] if t["verdict"] != "passed"]
    own = [t for t in failed if t["exercise"] == entry.get("exercise")]
    lost = result["points"] - result["pending"] - result["earned"]
    problems = _total_problems(entry["expect"], result, losses)
    if entry["expect"] == "exercise":
        problems += _exercise_problems(entry, losses, own)
    hints = tuple(dict.fromkeys(t["hint_key"] for t in own if t["hint_key"]))
    killers = tuple(f"{t['exercise']}: {t['name']}" for t in own)
    suffered = losses.get(entry.get("exercise", ""), 0.0)
    return Row(result["student"], entry["kind"], entry["name"], lost, suffered, killers, hints, tuple(problems))


def _total_problems(expect: str, result: Mapping[str, Any], losses: Mapping[str, float]) -> list[str]:
    earned, points = result["earned"], result["points"] - result["pending"]
    hurt = ", ".join(name for name, loss in losses.items() if loss > _CLOSE)
    if expect == "full" and earned < points - _CLOSE:
        return [f"should have full points, but loses {points - earned:g} in {hurt}"]
    if expect == "zero" and earned > _CLOSE:
        return [f"should have no points, but has {earned:g}"]
    if expect == "partial" and not _CLOSE < earned < points - _CLOSE:
        return [f"should have some of the points, but has {earned:g} of {points:g}"]
    return []


def _exercise_problems(
    entry: Mapping[str, Any], losses: Mapping[str, float], own: Sequence[Mapping[str, Any]]
) -> list[str]:
    exercise = entry["exercise"]
    allowed = {exercise, *entry.get("also", ())}
    problems = []
    if losses.get(exercise, 0.0) <= _CLOSE:
        problems.append(f"loses nothing in {exercise}: no test finds it")
    elif entry.get("loses") is not None and abs(losses[exercise] - entry["loses"]) > _CLOSE:
        problems.append(f"should lose {entry['loses']:g} in {exercise}, but loses {losses[exercise]:g}")
    problems += [
        f"also loses {loss:g} in {name}" for name, loss in losses.items() if loss > _CLOSE and name not in allowed
    ]
    hint = entry.get("hint")
    if hint and hint not in {t["hint_key"] for t in own}:
        shown = ", ".join(dict.fromkeys(t["hint_key"] for t in own if t["hint_key"])) or "none"
        problems.append(f"should be shown the hint {hint}, but is shown {shown}")
    return problems


def idle_tests(results: Mapping[str, Any], rows: Sequence[Row]) -> list[str]:
    """Tests that find no mutant: either useless, or their mistake has no mutant yet."""
    busy = {killer for row in rows if row.kind == "mutant" for killer in row.killers}
    return [name for name in test_names(results) if name not in busy]


def test_names(results: Mapping[str, Any]) -> list[str]:
    """All tests that ran, as ``exercise: name``, in order."""
    tests = (t for s in results["students"] for e in s["exercises"] for t in e["tests"])
    return list(dict.fromkeys(f"{t['exercise']}: {t['name']}" for t in tests))


test_names.__test__ = False  # type: ignore[attr-defined]  # the name begins with "test", but pytest need not call it


def table(rows: Sequence[Row]) -> str:
    """The outcome as text: one line per submission, what is wrong below it."""
    lines = []
    width = max((len(f"{r.kind} {r.name}") for r in rows), default=0)
    for row in rows:
        status = "ok " if not row.problems else "BAD"
        label = f"{row.kind} {row.name}"
        found = "; ".join(row.killers) if row.kind == "mutant" else ""
        lines.append(f"{status}  {row.student:<8} {label:<{width}}  -{row.lost:<6g} {found}".rstrip())
        lines += [f"       {problem}" for problem in row.problems]
    return "\n".join(lines)

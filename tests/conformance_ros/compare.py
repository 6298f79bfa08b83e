"""Comparing two decision logs, with a table of differences that are meant."""

from __future__ import annotations

import difflib
import json
from collections.abc import Sequence
from dataclasses import dataclass

from tests.conformance_ros.backends import DISTROS, Line


@dataclass(frozen=True)
class Difference:
    """A difference between the kit and genuine rclpy that is meant.

    Attributes:
        program: the program in which it shows.
        event: the event; all lines of this event are compared here and nowhere else. Of an exception the narrowest
            class counts.
        kit: fields of those lines on the kit, in order; empty when there is no such line.
        genuine: the same on genuine rclpy.
        reason: why it is so.
        distros: the distributions on which it shows.
    """

    program: str
    event: str
    kit: tuple[Line, ...]
    genuine: tuple[Line, ...]
    reason: str
    distros: tuple[str, ...] = DISTROS


def _as_caught(kit: Sequence[Line], genuine: Sequence[Line]) -> list[Line]:
    """Return the kit's lines, with the exceptions of genuine rclpy where an ``except`` catches both.

    A line of an exception lists the classes that catch it, narrowest first. The kit's errors may be of more kinds.
    """
    if len(kit) != len(genuine):
        return list(kit)
    lines = []
    for ours, theirs in zip(kit, genuine, strict=True):
        both = "raised" in ours and "raised" in theirs and theirs["raised"][0] in ours["raised"]
        lines.append({**ours, "raised": theirs["raised"]} if both else ours)
    return lines


def _fields(lines: Sequence[Line], event: str) -> list[Line]:
    return [{key: value for key, value in line.items() if key != "event"} for line in lines if line["event"] == event]


def _narrowest(line: Line) -> Line:
    """Return a line with the narrowest class of an exception only, as the table lists it."""
    return {**line, "raised": line["raised"][0]} if "raised" in line else line


def _text(lines: Sequence[Line]) -> list[str]:
    return [json.dumps(line, sort_keys=True) for line in lines]


def compare(
    program: str, distro: str, kit: Sequence[Line], genuine: Sequence[Line], table: Sequence[Difference]
) -> list[str]:
    """Return what is wrong: unlisted differences, and listed ones that are not (or no longer) so. Empty: they agree."""
    problems = []
    rows = [row for row in table if row.program == program and distro in row.distros]
    for row in rows:
        for side, lines, wanted in (("kit", kit, row.kit), (distro, genuine, row.genuine)):
            found = [_narrowest(line) for line in _fields(lines, row.event)]
            if found != list(wanted):
                problems.append(f"listed difference {row.event!r}: {side} gives {found}, listed is {list(wanted)}")
    listed = {row.event for row in rows}
    theirs = [line for line in genuine if line["event"] not in listed]
    left = _text(_as_caught([line for line in kit if line["event"] not in listed], theirs))
    right = _text(theirs)
    if left != right:
        problems += [
            line.rstrip() for line in difflib.unified_diff(right, left, distro, "kit", lineterm="", n=1) if line.strip()
        ]
    return problems


def check_table(table: Sequence[Difference], names: Sequence[str]) -> list[str]:
    """Return rows that cannot be meant: unknown program, no reason, the same on both sides, or twice."""
    problems, seen = [], set()
    for row in table:
        what = f"{row.program}/{row.event}"
        if row.program not in names:
            problems.append(f"{what}: there is no such program")
        if len(row.reason.split()) < 4:
            problems.append(f"{what}: give a reason")
        if row.kit == row.genuine:
            problems.append(f"{what}: both sides are the same")
        for distro in row.distros:
            if (row.program, row.event, distro) in seen:
                problems.append(f"{what}: listed twice for {distro}")
            seen.add((row.program, row.event, distro))
    return problems

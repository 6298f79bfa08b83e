"""``robotbrain bag``: look into a bag, check it, make it whole, or turn a topic into a table."""

from __future__ import annotations

import argparse
import csv
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from robotbrain.ros.bag.reader import BagReader


def bag_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare ``robotbrain bag ACTION PATH``."""
    actions = parser.add_subparsers(dest="action", metavar="ACTION", required=True)
    for name, text in (
        ("info", "topics, types, counts, rates and gaps"),
        ("check", "read and decode every message; the exit code is 1 when something is wrong"),
        ("recover", "make a bag whole whose recording was cut off"),
        ("csv", "write the messages of a topic as a table"),
    ):
        action = actions.add_parser(name, help=text, description=text)
        action.add_argument("path", type=Path, help="bag folder, or a storage file")
        if name == "csv":
            action.add_argument("topic", help="e.g. /odom")
            action.add_argument("-o", "--output", type=Path, help="file to write; standard output when omitted")


def bag_main(arguments: argparse.Namespace) -> int:
    """Run ``robotbrain bag``; return the exit code."""
    action: Callable[[argparse.Namespace], int] = {
        "info": _info,
        "check": _check,
        "recover": _recover,
        "csv": _csv,
    }[arguments.action]
    return action(arguments)


def _info(arguments: argparse.Namespace) -> int:
    from robotbrain.ros.bag.reader import open_bag
    from robotbrain.ros.bag.survey import survey

    with open_bag(arguments.path) as reader:
        _head(reader)
        lines: list[tuple[str, ...]] = [("topic", "type", "messages", "rate Hz", "longest gap s", "at s", "kB", "QoS")]
        for one in survey(reader):
            rate = one.rate_hz
            lines.append(
                (
                    one.name,
                    one.typename,
                    str(one.count),
                    "-" if rate is None else f"{rate:.2f}",
                    "-" if one.count < 2 else f"{one.gap_ns / 1e9:.3f}",
                    "-" if one.count < 2 else f"{(one.gap_at_ns - reader.start_ns) / 1e9:.3f}",
                    f"{one.size / 1e3:.1f}",
                    _qos(reader, one.name),
                )
            )
        _table(lines)
        _notes(reader)
    return 0


def _head(reader: BagReader) -> None:
    print(f"{reader.path}: {reader.message_count} messages, {len(reader.topics)} topics")
    if reader.message_count:
        print(f"{reader.duration_ns / 1e9:.3f} s, from {reader.start_ns / 1e9:.3f} to {reader.end_ns / 1e9:.3f} s")


def _notes(reader: BagReader) -> None:
    for note in reader.notes:
        print(f"note: {note}")
    if reader.unfinished:
        print(f"note: `robotbrain bag recover {reader.path}` makes it whole")


def _qos(reader: BagReader, topic: str) -> str:
    said = []
    for profile in reader.qos(topic):
        text = f"{profile.reliability.name.lower()}, {profile.durability.name.lower()}, depth {profile.depth}"
        if text not in said:
            said.append(text)
    return "; ".join(said) or "-"


def _table(lines: list[tuple[str, ...]]) -> None:
    widths = [max(len(line[column]) for line in lines) for column in range(len(lines[0]))]
    for line in lines:
        cells = [
            cell.rjust(width) if 2 <= column <= 6 else cell.ljust(width)
            for column, (cell, width) in enumerate(zip(line, widths, strict=True))
        ]
        print("  ".join(cells).rstrip())


def _check(arguments: argparse.Namespace) -> int:
    from robotbrain.ros.bag.reader import open_bag
    from robotbrain.ros.bag.survey import survey

    with open_bag(arguments.path) as reader:
        found = survey(reader, decode=True)
        problems = list(reader.notes)
        read = sum(one.count for one in found)
        if read != reader.message_count:
            problems.append(f"the index promises {reader.message_count} messages, {read} are there")
        problems += [
            f"{one.name}: {one.undecodable} of {one.count} not decoded: {one.problem}" for one in found if one.problem
        ]
        for problem in problems:
            print(f"problem: {problem}")
        if reader.unfinished:
            print(f"`robotbrain bag recover {reader.path}` makes it whole")
    if not problems:
        print(f"{arguments.path}: {read} messages read and decoded, nothing wrong")
    return 1 if problems else 0


def _recover(arguments: argparse.Namespace) -> int:
    from robotbrain.ros.bag.recovery import recover

    try:
        done = recover(arguments.path)
    except OSError as error:
        print(f"robotbrain bag recover: {error.strerror or error}; the bag is as it was", file=sys.stderr)
        return 2
    for note in done.notes:
        print(note)
    print(
        f"{arguments.path}: {done.messages} messages; "
        + (f"written again: {', '.join(done.rewritten)}" if done.rewritten else "it was whole already")
    )
    if done.rewritten and not done.messages:
        print("robotbrain bag recover: there was no message to save", file=sys.stderr)
        return 1
    return 0


def _csv(arguments: argparse.Namespace) -> int:
    from robotbrain.files import atomic_path
    from robotbrain.ros.bag.reader import open_bag
    from robotbrain.ros.bag.survey import rows

    with open_bag(arguments.path) as reader:
        # Two passes: an array may grow from message to message, and the first line names every column.
        columns = list(dict.fromkeys(name for row in rows(reader, arguments.topic) for name in row))
        if arguments.output is None:
            table = csv.DictWriter(sys.stdout, columns, restval="", lineterminator="\n")
            table.writeheader()
            table.writerows(rows(reader, arguments.topic))
            return 0
        with atomic_path(arguments.output) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
            table = csv.DictWriter(file, columns, restval="", lineterminator="\n")
            table.writeheader()
            table.writerows(rows(reader, arguments.topic))
    print(f"{arguments.output}: {len(columns)} columns")
    return 0

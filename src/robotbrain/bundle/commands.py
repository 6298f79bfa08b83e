"""The command ``robotbrain bundle``."""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

from robotbrain.errors import InputError

FOLDER = "robotbrain-course"
_FIXED_TIME = 1767225600  # 2026-01-01, where neither git nor SOURCE_DATE_EPOCH knows any other
_LISTED = 8


def bundle_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``robotbrain bundle``."""
    parser.add_argument(
        "--out", type=Path, default=Path("dist") / f"{FOLDER}.zip", metavar="ZIP", help="default: %(default)s"
    )
    parser.add_argument(
        "--compress",
        action="store_true",
        help="smaller, but the same bytes only where zlib is the same (default: stored, the same everywhere)",
    )
    parser.add_argument("--list", action="store_true", help="print every file with its size, write nothing")
    parser.add_argument("--course", type=Path, metavar="DIR", help="the course folder (default: found from here)")


def bundle_main(arguments: argparse.Namespace) -> int:
    """Run ``robotbrain bundle``; 1 if the key was found in what would have been given away."""
    from robotbrain.bundle.archive import checksums, pack
    from robotbrain.bundle.contents import check_labs, collect, last_change, tracked_files
    from robotbrain.bundle.key import Key
    from robotbrain.grading.course import find_course

    course = find_course(arguments.course)
    items = collect(course, tracked=tracked_files(course.home))
    if arguments.list:
        for item in items:
            print(f"{len(item.data):>10,}  {item.name}")
        print(f"{sum(len(item.data) for item in items):>10,}  in {len(items)} files")
        return 0
    print("comparing labs/ with what solutions/ gives, and looking for the key: half a minute", file=sys.stderr)
    check_labs(course)
    key = Key(course)
    leaks = key.leaks(items)
    for leak in leaks[:_LISTED]:
        print(f"robotbrain bundle: {leak}", file=sys.stderr)
    if leaks:
        print(
            f"{len(leaks)} parts of the key would have been given away, so nothing was written. What students may read "
            f"is declared in PUBLIC in src/robotbrain/bundle/key.py.",
            file=sys.stderr,
        )
        return 1
    seconds = entry_time(os.environ.get("SOURCE_DATE_EPOCH", ""), last_change(course.home))
    digest = pack(
        [*items, checksums(items)], arguments.out, folder=FOLDER, seconds=seconds, compress=arguments.compress
    )
    for folder in sorted({item.name.rpartition("/")[0].split("/")[0] for item in items}):
        inside = [i for i in items if (i.name.split("/")[0] if "/" in i.name else "") == folder]
        print(f"{len(inside):>5} files {sum(len(i.data) for i in inside):>12,} bytes  {folder or '(top folder)'}")
    print(f"none of the key's {len(key)} parts is in it")
    print(f"{arguments.out}: {arguments.out.stat().st_size:,} bytes\nsha256 {digest}")
    return 0


def entry_time(source_date_epoch: str, last_commit: int | None) -> int:
    """The time that all files of the bundle get: SOURCE_DATE_EPOCH, else the last commit's, else a fixed one."""
    if source_date_epoch:
        try:
            return int(source_date_epoch)
        except ValueError:
            raise InputError(
                "SOURCE_DATE_EPOCH",
                given=source_date_epoch,
                expected="seconds since 1970, a whole number",
                fix="Unset it, or correct it.",
            ) from None
    return _FIXED_TIME if last_commit is None else last_commit

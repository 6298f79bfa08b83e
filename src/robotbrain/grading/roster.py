"""Who is in the class, and what there is to run."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from pathlib import Path

from robotbrain.errors import InputError
from robotbrain.grading.jobs import Task


def handed_in(folder: Path, lab: str, *, in_place: bool) -> list[str]:
    """Who handed in, in order. In the course's own folder, having only other labs means not having handed in."""
    if not folder.is_dir():
        raise InputError(
            "submissions",
            given=str(folder),
            expected=f"a folder with <student>/{lab}/ in it",
            fix="Name it with --submitted, or collect the submissions there.",
        )
    # A link in place of a folder is a student too: the gate refuses to follow it and says so.
    folders = [p for p in sorted(folder.iterdir()) if (p.is_symlink() or p.is_dir()) and p.name[:1] != "."]
    students = [p.name for p in folders if _has(p, lab) or not (in_place and p.is_dir() and any(p.iterdir()))]
    if not students:
        raise InputError(
            "submissions", given=str(folder), expected=f"<student>/{lab}/ in it", fix="Is it the right folder?"
        )
    return students


def tasks(folder: Path, lab: str, sources: Sequence[Path], students: Iterable[str]) -> list[Task]:
    """One task per student and notebook, with the submissions in ``folder``."""
    found = []
    for student in students:
        there = _has(folder / student, lab)
        found += [Task(student, lab, source, folder / student / lab if there else None) for source in sources]
    return found


def _has(folder: Path, lab: str) -> bool:
    return folder.is_symlink() or os.path.lexists(folder / lab)

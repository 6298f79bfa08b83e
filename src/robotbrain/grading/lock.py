"""A lock on a folder, so that two runs do not write the same gradebook. It goes with the process that holds it."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import IO

from robotbrain.errors import InputError


@contextlib.contextmanager
def only_run(folder: Path) -> Iterator[None]:
    """Hold the lock in ``folder``; raises :class:`InputError` if another process does."""
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / ".lock").open("a+") as file:
        try:
            _lock(file)
        except OSError:
            raise InputError(
                "grading run",
                given=str(folder),
                expected="a folder in which no other run is grading",
                fix="Wait until the other grade-class has ended.",
            ) from None
        yield


def _lock(file: IO[str]) -> None:
    if os.name == "nt":
        import msvcrt

        file.seek(0)
        msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)  # type: ignore[attr-defined, unused-ignore]
    else:
        import fcntl

        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)

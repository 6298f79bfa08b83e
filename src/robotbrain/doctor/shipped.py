"""Checksums of the data that the kit ships: networks, results of training, profiles of Jetson modules.

``python -m robotbrain.doctor.shipped`` writes the list again after one of them was changed on purpose; a test compares.
Line ends are left out of account in text files, as git may change them on Windows.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[1]
LIST = Path(__file__).with_name("shipped.json")
PROFILES = "profiles/"
"""Start of names of files that lie in ``autograder/profiles`` in a checkout, and in the package once installed."""

_PATTERNS = ("*/weights/*", "*/results/*.json")
_BINARY = (".onnx", ".pt")


class State(Enum):
    """What became of a shipped file."""

    SAME = "same"
    MISSING = "missing"
    SHORT = "short"
    POINTER = "pointer"
    CHANGED = "changed"


@dataclass(frozen=True)
class Shipped:
    """One file: its name in the list, where it is, and how it is."""

    name: str
    path: Path
    state: State
    detail: str = ""


def examine() -> Iterator[Shipped]:
    """Compare every shipped file with the list."""
    for name, (size, digest) in json.loads(LIST.read_text(encoding="utf-8")).items():
        path = _place(name)
        try:
            data = _content(path)
        except OSError as error:
            yield Shipped(name, path, State.MISSING, error.strerror or str(error))
            continue
        if hashlib.sha256(data).hexdigest() == digest:
            yield Shipped(name, path, State.SAME)
        elif data.startswith(b"version https://git-lfs"):
            yield Shipped(name, path, State.POINTER)
        elif not data or (path.suffix in _BINARY and len(data) < size):
            yield Shipped(name, path, State.SHORT, f"{len(data)} of {size} bytes")
        else:
            yield Shipped(name, path, State.CHANGED)


def current() -> dict[str, tuple[int, str]]:
    """Return the list as it should be for the files that are there."""
    listed = {}
    profiles = _profiles()
    files = [(p.relative_to(PACKAGE).as_posix(), p) for pattern in _PATTERNS for p in PACKAGE.glob(pattern)]
    files += [(PROFILES + p.relative_to(profiles).as_posix(), p) for p in profiles.rglob("*")]
    for name, path in sorted(files):
        # What a board measured is the user's own, and notes about the numbers are no numbers.
        if path.is_file() and path.suffix != ".md" and not name.startswith(f"{PROFILES}measured/"):
            data = _content(path)
            listed[name] = (len(data), hashlib.sha256(data).hexdigest())
    return listed


def _profiles() -> Path:
    checkout = PACKAGE.parents[1] / "autograder" / "profiles"
    return checkout if checkout.is_dir() else PACKAGE / "jetson" / "data"


def _place(name: str) -> Path:
    return _profiles() / name.removeprefix(PROFILES) if name.startswith(PROFILES) else PACKAGE / name


def _content(path: Path) -> bytes:
    data = path.read_bytes()
    return data if path.suffix in _BINARY else data.replace(b"\r\n", b"\n")


def write() -> Path:
    """Write the list for the files that are there."""
    from robotbrain.files import write_text

    return write_text(LIST, json.dumps(current(), indent=1) + "\n")


if __name__ == "__main__":
    print(write())

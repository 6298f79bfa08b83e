"""Where the reference profiles and the catalogue of modules are read from.

They are TOML files under ``autograder/profiles``: tables, and ``modules/`` with one file per Jetson module. They are
looked for in the directory that the environment variable ``ROBOTBRAIN_PROFILES`` names, then in the checkout, then in
the copy that is installed with the package. A directory named by the variable that holds only some of the parts (say,
one table) stands in for these; the other parts come from the kit.
"""

from __future__ import annotations

import functools
import os
from pathlib import Path

from robotbrain.errors import InputError


def _override() -> Path | None:
    named = os.environ.get("ROBOTBRAIN_PROFILES")
    return Path(named) if named else None


@functools.cache
def _shipped() -> list[Path]:
    here = Path(__file__).resolve()
    return [here.parents[3] / "autograder" / "profiles", here.parent / "data"]


def profile_directory() -> Path:
    """Return the directory the profiles are read from.

    Raises:
        InputError: if it holds neither profiles nor modules.
    """
    override = _override()
    candidates = _shipped() if override is None else [override]
    for candidate in candidates:
        if any(candidate.glob("*.toml")) or any(candidate.glob("modules/*.toml")):
            return candidate
    raise InputError(
        "reference profiles",
        given=[str(c) for c in candidates],
        expected="a directory with *.toml profiles",
        fix="Unset ROBOTBRAIN_PROFILES, or point it at a copy of autograder/profiles.",
    )


def find_part(name: str) -> Path:
    """Return the path of a part of the profiles: a table (``jetpack.toml``) or a folder of TOML files (``modules``).

    Raises:
        InputError: if no place holds it, or ROBOTBRAIN_PROFILES names a directory with nothing of ours in it.
    """
    first = profile_directory()
    candidates = [first, *(place for place in _shipped() if place != first)]
    for candidate in candidates:
        path = candidate / name
        if path.is_file() or any(path.glob("*.toml")):
            return path
    raise InputError(
        f"part {name!r} of the reference profiles",
        given=[str(c) for c in candidates],
        expected=f"a directory that holds {name}",
        fix="Install the package again, or restore autograder/profiles from git.",
    )


def module_directory() -> Path:
    """Return the directory with one TOML file per Jetson module."""
    return find_part("modules")

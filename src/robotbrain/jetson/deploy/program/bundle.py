"""Checking the bundle that this program is part of: every file as the manifest says, nothing missing, nothing extra."""

import hashlib
import json
from pathlib import Path
from typing import Any

from .problem import Refused

COPY_AGAIN = "Copy the bundle to the board again (`sha256sum -c manifest.sha256` checks the manifest by hand)."


def sha256_of(path: Path) -> str:
    """Return the SHA-256 of a file in hexadecimal."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        for block in iter(lambda: file.read(1 << 20), b""):
            digest.update(block)
    return digest.hexdigest()


def read_manifest(folder: Path) -> "dict[str, Any]":
    """Return the manifest of the bundle in ``folder`` after checking every file.

    Raises:
        Refused: naming the first file that is not right.
    """
    path = folder / "manifest.json"
    try:
        named = (folder / "manifest.sha256").read_text(encoding="ascii").split()[:1]
        if [sha256_of(path)] != named:
            raise Refused("manifest.json", "another SHA-256", "the one in manifest.sha256", COPY_AGAIN)
        manifest = json.loads(path.read_text(encoding="ascii"))
        files = dict(manifest["files"])
        known = manifest["schema"] == "robotbrain-bundle" and manifest["version"] == 1
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise Refused("manifest.json", error, "the manifest of a bundle", COPY_AGAIN) from error
    if not known:
        raise Refused("manifest.json", manifest["version"], "version 1, which this program reads", COPY_AGAIN)
    _check_names(folder, set(files) | {"manifest.json", "manifest.sha256"})
    for name in sorted(files):
        size = (folder / name).stat().st_size
        if size != files[name]["bytes"]:
            raise Refused(name, f"{size} bytes", "{} bytes".format(files[name]["bytes"]), COPY_AGAIN)
        if sha256_of(folder / name) != files[name]["sha256"]:
            raise Refused(name, "another SHA-256", "the one in the manifest", COPY_AGAIN)
    return dict(manifest)


def _check_names(folder: Path, expected: "set[str]") -> None:
    found = set()
    for path in folder.rglob("*"):
        name = path.relative_to(folder).as_posix()
        if path.is_symlink():
            raise Refused(name, "a link", "ordinary files only", COPY_AGAIN)
        if path.is_file():
            found.add(name)
    for name in sorted(expected - found):
        raise Refused(name, "no such file", "all files of the manifest", COPY_AGAIN)
    for name in sorted(found - expected):
        raise Refused(name, "a file", "only files of the manifest", "Remove it: results go beside the bundle.")

"""A set of small files as a folder, a ``.tar.gz`` or a ``.zip``: written the same bytes each time, read with suspicion.

Archives are not compressed (weights hardly compress), so their bytes do not depend on a compression library, and an
archive that unpacks to more than its own size is a bomb by definition. An archive is accepted only if packing what it
holds gives its very bytes: there is no place in it for anything that no checksum covers.
"""

from __future__ import annotations

import io
import json
import os
import re
import shutil
import stat
import struct
import tarfile
import tempfile
import zipfile
import zlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from robotbrain.errors import InputError
from robotbrain.files import write_bytes

MAX_FILES = 64
"""Files in a bundle or result."""

MAX_BYTES = 512 * 1024 * 1024
"""Size of all files together, bytes."""

TAR_SUFFIXES, ZIP_SUFFIX = (".tar.gz", ".tgz"), ".zip"

_PLAIN = r"[A-Za-z0-9_][A-Za-z0-9_-]*(?:\.[A-Za-z0-9_-]+)*"
_NAME = re.compile(f"{_PLAIN}(?:/{_PLAIN})?")
_DEVICES = re.compile(r"(?:con|prn|aux|nul|com\d|lpt\d)(?:\.|/|$)|.*/(?:con|prn|aux|nul|com\d|lpt\d)(?:\.|$)", re.I)
_STORED = 65535  # bytes in one stored block of a deflate stream

AGAIN = "Copy it again from where it was made, or make it again."
_FOREIGN, _HANDS_OFF = "This is no bundle of this kit.", "Do not unpack it."


@dataclass(frozen=True)
class Contents:
    """What was read.

    Attributes:
        files: content by name; names have forward slashes and at most one folder.
        form: ``folder``, ``tar.gz`` or ``zip``.
    """

    files: Mapping[str, bytes]
    form: str


def refuse(what: str, given: object, expected: str, fix: str = AGAIN) -> InputError:
    """Return the error for a bundle that is not as it was made."""
    return InputError(f"bundle: {what}", given=given, expected=expected, fix=fix)


def read(path: str | Path) -> Contents:
    """Read a folder or an archive that :func:`write` made; nothing is ever written.

    Raises:
        InputError: for anything else: links, devices, names that leave the folder, files too many or too large,
            truncated, altered or foreign archives.
    """
    path = Path(path)
    try:
        if path.is_dir():
            return Contents(_read_folder(path), "folder")
        if not path.is_file():
            raise refuse("path", str(path), "a folder, a .tar.gz or a .zip", "Check the path.")
        if path.stat().st_size > MAX_BYTES + 1024 * 1024:
            raise refuse("size", f"{path.stat().st_size} bytes", f"at most {MAX_BYTES}", _FOREIGN)
        raw = path.read_bytes()
    except OSError as error:
        raise refuse("path", str(path), "readable files", f"The system says: {error.strerror}.") from error
    form = "zip" if raw[:2] == b"PK" else "tar.gz"
    files, top = _read_zip(raw) if form == "zip" else _read_tar(raw)
    if not files or pack(files, form, top) != raw:
        raise refuse(
            f"{form} archive",
            f"{len(raw)} bytes that are not as they were written",
            "the archive unchanged (not packed again by another program)",
            "Copy it again; or unpack it yourself and give the folder.",
        )
    return Contents(files, form)


def write(target: Path, files: Mapping[str, bytes], top: str) -> Path:
    """Write the files whole or not at all: an archive if ``target`` ends in .tar.gz, .tgz or .zip, a folder otherwise.

    Args:
        target: where to; a folder there is replaced only if it holds nothing but what a bundle may hold.
        files: content by name.
        top: name of the folder inside an archive.

    Raises:
        InputError: if something else is there already.
    """
    name = target.name.lower()
    if name.endswith((*TAR_SUFFIXES, ZIP_SUFFIX)):
        if target.is_dir():
            raise InputError("--out", given=str(target), expected="the name of a file", fix="A folder is in the way.")
        return write_bytes(target, pack(files, "zip" if name.endswith(ZIP_SUFFIX) else "tar.gz", top))
    if target.exists() and (not target.is_dir() or not _is_ours(target)):
        raise InputError(
            "--out",
            given=str(target),
            expected="a name that is free, or a folder with an earlier bundle",
            fix="Choose another name, or remove what is there.",
        )
    target.parent.mkdir(parents=True, exist_ok=True)
    fresh = Path(tempfile.mkdtemp(dir=target.parent, prefix=f".{target.name}."))
    try:
        for file, content in files.items():
            path = fresh / file
            path.parent.mkdir(exist_ok=True)
            path.write_bytes(content)
            path.chmod(_mode(file))
        fresh.chmod(0o755)
        if target.exists():
            old = fresh.with_name(fresh.name + ".old")
            target.rename(old)
            fresh.rename(target)
            shutil.rmtree(old)
        else:
            fresh.rename(target)
    finally:
        shutil.rmtree(fresh, ignore_errors=True)
    return target


def pack(files: Mapping[str, bytes], form: str, top: str) -> bytes:
    """Return the archive of these files; the same files give the same bytes on every machine."""
    buffer = io.BytesIO()
    if form == "zip":
        with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED, allowZip64=False) as archive:
            for name in sorted(files):
                entry = zipfile.ZipInfo(f"{top}/{name}", (1980, 1, 1, 0, 0, 0))
                entry.create_system = 3  # Unix, also where this runs on Windows
                entry.external_attr = (stat.S_IFREG | _mode(name)) << 16
                archive.writestr(entry, files[name])
        return buffer.getvalue()
    with tarfile.open(fileobj=buffer, mode="w", format=tarfile.USTAR_FORMAT) as tar:
        for name in sorted(files):
            member = tarfile.TarInfo(f"{top}/{name}")
            member.size, member.mode = len(files[name]), _mode(name)
            tar.addfile(member, io.BytesIO(files[name]))
    return _gzip(buffer.getvalue())


def check_names(names: Iterable[str]) -> None:
    """Refuse names that could leave the folder, or that some system would not take or could not tell apart."""
    seen: dict[str, str] = {}
    for name in names:
        if len(name) > 90 or not _NAME.fullmatch(name) or _DEVICES.match(name):
            raise refuse("name of a file", name, "a plain name in the bundle's own folder", _HANDS_OFF)
        if seen.setdefault(name.casefold(), name) != name or list(seen.values()).count(name) > 1:
            raise refuse("name of a file", name, "each name once", _HANDS_OFF)
    if len(seen) > MAX_FILES:
        raise refuse("number of files", len(seen), f"at most {MAX_FILES}", _FOREIGN)


def _mode(name: str) -> int:
    return 0o755 if name.endswith(".sh") else 0o644


def _is_ours(folder: Path) -> bool:
    """Whether a folder is empty or holds a bundle and nothing beside it: only that may be replaced."""
    names = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if not path.is_dir()}
    if not names:
        return True
    try:
        listed = json.loads((folder / "manifest.json").read_bytes())["files"]
        return names <= {*listed, "manifest.json", "manifest.sha256"}
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return False


def _read_folder(root: Path) -> dict[str, bytes]:
    found: dict[str, int] = {}
    for folder in (root, *_folders(root)):
        for entry in os.scandir(folder):
            name = Path(entry.path).relative_to(root).as_posix()
            status = entry.stat(follow_symlinks=False)
            if entry.is_dir(follow_symlinks=False):
                if folder != root or not any(os.scandir(entry.path)):
                    raise refuse("folder", name, "only folders that the bundle names", "Remove it.")
                continue
            if not stat.S_ISREG(status.st_mode):
                raise refuse("file", f"{name}, a link or device", "ordinary files only", "Copy the files themselves.")
            found[name] = status.st_size
            if len(found) > MAX_FILES or sum(found.values()) > MAX_BYTES:
                raise refuse("folder", str(root), f"at most {MAX_FILES} files and {MAX_BYTES} bytes", "Is it a bundle?")
    check_names(found)
    return {name: (root / name).read_bytes() for name in sorted(found)}


def _folders(root: Path) -> list[Path]:
    return [Path(entry.path) for entry in os.scandir(root) if entry.is_dir(follow_symlinks=False)]


def _read_tar(raw: bytes) -> tuple[dict[str, bytes], str]:
    stream = zlib.decompressobj(wbits=31)
    try:
        plain = stream.decompress(raw, max(1, len(raw)))
    except zlib.error as error:
        raise refuse("archive", raw[:4], "a whole .tar.gz or .zip", f"{AGAIN} ({error})") from error
    if not stream.eof or stream.unused_data or stream.unconsumed_tail:
        given = "it ends early, goes on after its end, or unpacks to more than its size"
        raise refuse("tar.gz archive", given, "the whole archive, not compressed", AGAIN)
    files: dict[str, bytes] = {}
    tops: set[str] = set()
    try:
        with tarfile.open(fileobj=io.BytesIO(plain), mode="r:") as tar:
            for member in tar:
                if member.type != tarfile.REGTYPE or member.sparse or member.pax_headers:
                    raise refuse("archive member", member.name, "ordinary files only (no links)", _HANDS_OFF)
                reader = tar.extractfile(member)
                assert reader is not None
                _add(files, tops, member.name, reader.read(len(plain)))
    except (tarfile.TarError, OSError, ValueError, EOFError, struct.error, OverflowError, RecursionError) as error:
        if isinstance(error, InputError):
            raise
        raise refuse("tar.gz archive", str(error), "a whole archive") from error
    return files, tops.pop() if tops else ""


def _read_zip(raw: bytes) -> tuple[dict[str, bytes], str]:
    files: dict[str, bytes] = {}
    tops: set[str] = set()
    try:
        with zipfile.ZipFile(io.BytesIO(raw)) as archive:
            entries = archive.infolist()
            if sum(entry.file_size for entry in entries) > len(raw) or len(entries) > MAX_FILES:
                raise refuse("zip archive", "more than its own size", "files that are not compressed", _HANDS_OFF)
            for entry in entries:
                kind = stat.S_IFMT(entry.external_attr >> 16)
                if kind != stat.S_IFREG or entry.compress_type != zipfile.ZIP_STORED or entry.flag_bits & 1:
                    raise refuse("archive member", entry.orig_filename, "ordinary files only (no links)", _HANDS_OFF)
                _add(files, tops, entry.orig_filename, archive.read(entry))
    except (
        zipfile.BadZipFile,
        OSError,
        ValueError,
        EOFError,
        struct.error,
        NotImplementedError,
        RuntimeError,
    ) as error:
        if isinstance(error, InputError):
            raise
        raise refuse("zip archive", str(error), "a whole archive") from error
    return files, tops.pop() if tops else ""


def _add(files: dict[str, bytes], tops: set[str], member: str, content: bytes) -> None:
    top, _, name = member.partition("/")
    tops.add(top)
    if len(top) > 150 or not _NAME.fullmatch(top) or len(tops) > 1 or name in files:  # a tar's folder ends at 155
        raise refuse("name of a file", member, "plain names, each once, in one folder", _HANDS_OFF)
    check_names([name])
    if len(files) >= MAX_FILES:
        raise refuse("number of files", f"more than {MAX_FILES}", f"at most {MAX_FILES}", _FOREIGN)
    files[name] = content


def _gzip(data: bytes) -> bytes:
    """Return a gzip stream of stored blocks (RFC 1951 and 1952), without name and time."""
    parts = [b"\x1f\x8b\x08\x00\x00\x00\x00\x00\x00\xff"]
    for at in range(0, max(1, len(data)), _STORED):
        block = data[at : at + _STORED]
        last = at + _STORED >= len(data)
        parts += [struct.pack("<BHH", last, len(block), len(block) ^ 0xFFFF), block]
    parts.append(struct.pack("<II", zlib.crc32(data), len(data) & 0xFFFFFFFF))
    return b"".join(parts)

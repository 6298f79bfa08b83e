"""The gate: what a student handed in becomes plain bytes in memory, and nothing else gets in.

No link is followed, no device or pipe is opened, and nothing is read beyond fixed sizes, so that a submission can
neither point at another's work nor stop the grader.
"""

from __future__ import annotations

import functools
import io
import os
import stat
import unicodedata
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

LARGEST_NOTEBOOK = 64_000_000  # bytes that are read of a notebook; what lies beyond is treated as cut off
LARGEST_FILE = 20_000_000  # bytes of a further file
LARGEST_TOTAL = 100_000_000  # bytes of all files of a submission
MOST_FILES = 300
_MOST_ENTRIES = 3000  # names looked at, so that a folder of a million files costs nothing
_DEEPEST = 6  # folders inside folders
_LONGEST_NAME = 180  # bytes of a whole relative name
_IGNORED = frozenset({"__pycache__", "__MACOSX", ".git", "node_modules", ".DS_Store", "Thumbs.db", "desktop.ini"})
CHECKPOINTS = ".ipynb_checkpoints"
_RESERVED = frozenset({"con", "prn", "aux", "nul", *(f"{n}{i}" for n in ("com", "lpt") for i in range(1, 10))})


@dataclass
class Received:
    """The files of a submission.

    Attributes:
        files: content by relative name with forward slashes; notebooks among them.
        refused: one sentence for each thing that was left out, and why.
        ages: modification time (s) by name.
    """

    files: dict[str, bytes] = field(default_factory=dict)
    refused: list[str] = field(default_factory=list)
    ages: dict[str, float] = field(default_factory=dict)

    def further(self) -> dict[str, bytes]:
        """The files that go beside the notebook when it runs."""
        return {
            name: data
            for name, data in self.files.items()
            if not name.lower().endswith(".ipynb") and not PurePosixPath(name).parts[0].startswith(".")
        }


def receive(folder: Path, *, below: Path | None = None, protected: Iterable[Path] = ()) -> Received:
    """Read the submission in ``folder``; never raises.

    Args:
        below: the folder that the instructor owns; no folder under it may be a link. Default: two above ``folder``,
            as in ``<submitted>/<student>/<lab>``.
        protected: files and folders of the course; a hard link to anything in them is refused.
    """
    received = Received()
    try:
        if why := _folder_problem(folder, below or folder.parent.parent):
            received.refused.append(why)
        else:
            _collect(folder, received, functools.partial(_inodes, tuple(protected), below or folder.parent.parent))
    except OSError as error:
        received.refused.append(f"the submitted folder cannot be read ({error.strerror or type(error).__name__})")
    _unpack_all(received)
    return received


def read_notebook(path: Path) -> tuple[bytes | None, str]:
    """The bytes of one notebook file and ``""``, or None and why not; at most :data:`LARGEST_NOTEBOOK` of them."""
    try:
        info = path.lstat()
    except (OSError, ValueError):
        return None, ""
    if why := _kind_problem(info, "the notebook"):
        return None, why
    try:
        return _read(path, LARGEST_NOTEBOOK), ""
    except OSError as error:
        return None, f"the notebook cannot be read ({error.strerror or type(error).__name__})"


def _folder_problem(folder: Path, below: Path) -> str:
    """Why a submission's folder is not read; ``""`` if it is, or is not there."""
    parts = folder.relative_to(below).parts if folder.is_relative_to(below) else folder.parts[-1:]
    here = below if folder.is_relative_to(below) else folder.parent
    for part in parts:
        here = here / part
        try:
            mode = here.lstat().st_mode
        except FileNotFoundError:
            return ""
        if stat.S_ISLNK(mode) or _is_junction(here):
            return f"the folder {_shown(part)} is a link to somewhere else; links are not followed"
        if not stat.S_ISDIR(mode):
            return f"{_shown(part)} is a file where the folder of the submission should be"
    return ""


def _is_junction(path: Path) -> bool:
    info = path.lstat()
    return bool(getattr(info, "st_file_attributes", 0) & getattr(stat, "FILE_ATTRIBUTE_REPARSE_POINT", 0x400))


def _collect(folder: Path, received: Received, course_inodes: Callable[[], frozenset[tuple[int, int]]]) -> None:
    total = 0
    taken: dict[str, str] = {}
    for name, path, info in _walk(folder, received.refused):
        why = name_problem(name) or _kind_problem(info, _shown(name)) or _size_problem(name, info, total)
        if not why and len(received.files) >= MOST_FILES:
            received.refused.append(f"there are more than {MOST_FILES} files; the rest was left out")
            return
        folded = unicodedata.normalize("NFC", name).casefold()
        if not why and folded in taken and not _is_notebook(name):  # which notebook counts is chosen by its exact name
            why = f"{_shown(name)} differs from {_shown(taken[folded])} in upper and lower case only; it was left out"
        if not why and info.st_nlink > 1 and (info.st_dev, info.st_ino) in course_inodes():
            why = f"{_shown(name)} is a hard link to a file of the course; it was left out"
        if why:
            received.refused.append(why)
            continue
        try:
            data = _read(path, LARGEST_NOTEBOOK if _is_notebook(name) else LARGEST_FILE)
        except OSError as error:
            received.refused.append(f"{_shown(name)} cannot be read ({error.strerror or type(error).__name__})")
            continue
        taken[folded] = name
        total += len(data)
        received.files[name], received.ages[name] = data, info.st_mtime


def _walk(folder: Path, refused: list[str]) -> Iterator[tuple[str, Path, os.stat_result]]:
    """Everything in the folder that is no folder, by relative name, files at the top first."""
    seen = 0
    todo = [(folder, "", 0)]
    while todo:
        here, prefix, depth = todo.pop(0)
        with os.scandir(here) as entries:
            found = []
            for entry in entries:
                seen += 1
                if seen > _MOST_ENTRIES:
                    refused.append(f"the folder holds more than {_MOST_ENTRIES} files; the rest was left out")
                    todo.clear()
                    break
                found.append(entry)
        for entry in sorted(found, key=lambda e: (not _is_notebook(e.name), e.name)):
            info = entry.stat(follow_symlinks=False)
            name = prefix + entry.name
            if not stat.S_ISDIR(info.st_mode):
                if entry.name not in _IGNORED:
                    yield name, Path(entry.path), info
            elif entry.name not in _IGNORED and not _is_junction(Path(entry.path)):
                if depth + 1 < _DEEPEST:
                    todo.append((Path(entry.path), f"{name}/", depth + 1))
                else:
                    refused.append(f"the folder {_shown(name)} lies too deep; it was left out")


def name_problem(name: str) -> str:
    """Why a file of this relative name is refused; ``""`` if it is not."""
    parts = name.split("/")
    try:
        encoded = name.encode()
    except UnicodeEncodeError:
        return f"the file {_shown(name)} has a name that is not text; it was left out"
    strange = any(unicodedata.category(c) in ("Cc", "Cs", "Cn") for c in name) or any(c in '\\:*?"<>|' for c in name)
    if (
        strange
        or len(encoded) > _LONGEST_NAME
        or any(p in ("", ".", "..") or p[-1] in ". " or p.split(".")[0].strip().lower() in _RESERVED for p in parts)
    ):
        return f"the file {_shown(name)} has a name that not every computer can keep; it was left out"
    return ""


def _kind_problem(info: os.stat_result, name: str) -> str:
    mode = info.st_mode
    attributes = getattr(info, "st_file_attributes", 0)
    if stat.S_ISLNK(mode) or (attributes & 0x400):
        return f"{name} is a link to somewhere else; links are not followed"
    if stat.S_ISDIR(mode):
        return f"{name} is a folder"
    if not stat.S_ISREG(mode):
        kind = "a pipe" if stat.S_ISFIFO(mode) else "a socket" if stat.S_ISSOCK(mode) else "a device"
        return f"{name} is {kind}, not a file; it was left out"
    return ""


def _size_problem(name: str, info: os.stat_result, total: int) -> str:
    if not _is_notebook(name) and info.st_size > LARGEST_FILE:
        return f"{_shown(name)} is larger than {LARGEST_FILE // 1_000_000} MB; it was left out"
    if total + min(info.st_size, LARGEST_NOTEBOOK) > LARGEST_TOTAL:
        return f"{_shown(name)} was left out: all files together are larger than {LARGEST_TOTAL // 1_000_000} MB"
    return ""


def _read(path: Path, most: int) -> bytes:
    """Read a plain file without following a link or waiting for a pipe, whatever it has become meanwhile."""
    flags = os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
    handle = os.open(path, flags)
    try:
        if not stat.S_ISREG(os.fstat(handle).st_mode):
            raise OSError(0, "it is no plain file")
        with os.fdopen(handle, "rb", closefd=False) as file:
            return file.read(most)
    finally:
        os.close(handle)


@functools.lru_cache(maxsize=8)
def _inodes(protected: tuple[Path, ...], below: Path) -> frozenset[tuple[int, int]]:
    """The files of the course; what was handed in may lie among them and is none."""
    files = (p for root in protected for p in ([root] if root.is_file() else root.rglob("*")))
    infos = (p.lstat() for p in files if p.is_file() and not p.is_relative_to(below))
    return frozenset((i.st_dev, i.st_ino) for i in infos)


def _is_notebook(name: str) -> bool:
    return name.lower().endswith(".ipynb")


def _unpack_all(received: Received) -> None:
    """Add what is in ZIP archives to the files; an archive's own name becomes a folder."""
    for name in [n for n, data in received.files.items() if n.lower().endswith(".zip") and data[:2] == b"PK"][:5]:
        inner = unpack(received.files[name], received.refused, LARGEST_TOTAL - sum(map(len, received.files.values())))
        room = MOST_FILES - len(received.files)
        if any(_is_notebook(n) for n in inner):  # otherwise it may be the student's data, which stays as it is
            stem = name[:-4]
            received.files |= {f"{stem}/{n}": data for n, data in list(inner.items())[:room]}


def unpack(data: bytes, refused: list[str] | None = None, room: int = LARGEST_TOTAL) -> dict[str, bytes]:
    """The files of a ZIP archive in memory, at most ``room`` bytes; what does not fit or may not be is left out."""
    files: dict[str, bytes] = {}
    total = 0
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            for member in archive.infolist()[:_MOST_ENTRIES]:
                name = member.filename
                if member.is_dir() or _IGNORED & set(PurePosixPath(name).parts):
                    continue
                if name_problem(name) or name in files or len(files) >= MOST_FILES or member.flag_bits & 1:
                    if refused is not None:
                        refused.append(f"{_shown(name)} in the archive was left out")
                    continue
                most = min(LARGEST_NOTEBOOK if _is_notebook(name) else LARGEST_FILE, room - total)
                with archive.open(member) as file:
                    content = file.read(most)
                total += len(content)
                files[name] = content
    except (zipfile.BadZipFile, zlib.error, OSError, ValueError, NotImplementedError, RuntimeError, EOFError) as error:
        if refused is not None:
            refused.append(f"an archive is damaged ({type(error).__name__}); what could be read of it was taken")
    return files


def gunzip(data: bytes) -> bytes:
    """The content of gzip data, as far as it can be read and at most :data:`LARGEST_NOTEBOOK`."""
    stream = zlib.decompressobj(wbits=31)
    out = b""
    try:
        out = stream.decompress(data, LARGEST_NOTEBOOK)
    except zlib.error:  # damaged: byte by byte up to where it breaks
        stream = zlib.decompressobj(wbits=31)
        pieces = bytearray()
        for start in range(0, len(data), 256):
            try:
                pieces += stream.decompress(data[start : start + 256], LARGEST_NOTEBOOK)
            except zlib.error:
                break
            if len(pieces) >= LARGEST_NOTEBOOK:
                break
        out = bytes(pieces[:LARGEST_NOTEBOOK])
    return out


def _shown(name: str) -> str:
    """A name as it may be printed: short, without control characters."""
    text = "".join(c if c.isprintable() else "?" for c in name)
    return repr(text if len(text) <= 60 else f"{text[:40]}…{text[-15:]}")

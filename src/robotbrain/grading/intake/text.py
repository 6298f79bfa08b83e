"""From the bytes of a submitted notebook to text: archives, encodings, conflict markers."""

from __future__ import annotations

import codecs
import itertools
import re

from robotbrain.grading.intake import gate

_BOMS = (  # the longer ones first: UTF-32's begins like UTF-16's
    (codecs.BOM_UTF32_LE, "utf-32-le"),
    (codecs.BOM_UTF32_BE, "utf-32-be"),
    (codecs.BOM_UTF8, "utf-8"),
    (codecs.BOM_UTF16_LE, "utf-16-le"),
    (codecs.BOM_UTF16_BE, "utf-16-be"),
)
_LONGEST_CONFLICT = 20_000_000  # characters of a file in which both versions are looked for
_CONFLICT = re.compile(r"^(?:<{7}|\|{7}|={7}|>{7})(?:[ \t].*)?$", re.M)


def decode(data: bytes, repairs: list[str]) -> str:
    """The text in ``data``, however it is encoded or packed; says in ``repairs`` what was unusual."""
    data = _unpacked(data, repairs)
    for bom, encoding in _BOMS:
        if data.startswith(bom):
            if encoding != "utf-8":
                repairs.append(f"the notebook was saved as {encoding[:6].upper()}, not as UTF-8")
            return _without_nuls(data[len(bom) :].decode(encoding, "replace"), repairs)
    if encoding := _wide(data[:4000]):
        repairs.append(f"the notebook was saved as {encoding[:6].upper()}, not as UTF-8")
        return _without_nuls(data.decode(encoding, "replace"), repairs)
    try:
        return _without_nuls(data.decode("utf-8"), repairs)
    except UnicodeDecodeError:
        pass
    lenient = data.decode("utf-8", "replace")
    bad = lenient.count("\ufffd")
    if bad <= len(lenient) - len(lenient.encode("ascii", "ignore")) - bad:  # mostly well-formed: UTF-8 with damage
        repairs.append("some characters of the notebook were damaged")
        return _without_nuls(lenient, repairs)
    repairs.append("the notebook was saved in an old encoding, not as UTF-8")
    return _without_nuls(data.decode("cp1252", "replace").replace("\ufffd", "?"), repairs)


def _unpacked(data: bytes, repairs: list[str]) -> bytes:
    if data[:2] == b"\x1f\x8b":
        repairs.append("the notebook was packed with gzip")
        return gate.gunzip(data)
    if data[:4] == b"PK\x03\x04":
        inner = gate.unpack(data)
        notebooks = [n for n in inner if n.lower().endswith(".ipynb")] or list(inner)
        if notebooks:
            repairs.append(f"the notebook was packed in a ZIP archive, as {notebooks[0][:60]}")
            return inner[notebooks[0]]
    return data


def _wide(head: bytes) -> str:
    """The encoding of text in two- or four-byte characters that says so nowhere; ``""`` for any other."""
    if len(head) < 8 or head.count(0) < len(head) // 3 or not head.strip(b"\0"):
        return ""
    zeros = [head[i::4].count(0) * 4 > len(head) * 3 // 4 for i in range(4)]
    return {
        (False, True, True, True): "utf-32-le",
        (True, True, True, False): "utf-32-be",
        (False, True, False, True): "utf-16-le",
        (True, False, True, False): "utf-16-be",
    }.get((zeros[0], zeros[1], zeros[2], zeros[3]), "")


def _without_nuls(text: str, repairs: list[str]) -> str:
    if "\0" in text:
        repairs.append("the notebook held zero bytes, as after a computer that stopped while saving")
        text = text.replace("\0", "")
    return text.lstrip("\ufeff")


def conflict_sides(text: str) -> list[str]:
    """The two versions in a text with git's conflict markers, the other's first; the text alone where it has none."""
    marked = len(text) < _LONGEST_CONFLICT and any(m in text for m in ("<<<<<<<", ">>>>>>>"))
    if not marked or len(list(itertools.islice(_CONFLICT.finditer(text), 2))) < 2:
        return [text]
    ours: list[str] = []
    theirs: list[str] = []
    side = "both"
    for line in text.splitlines(keepends=True):
        if _CONFLICT.match(line.rstrip("\r\n")) and (side != "both" or line[0] in "<>"):
            side = {"<": "ours", "|": "base", "=": "theirs", ">": "both"}[line[0]]
            continue
        if side in ("both", "ours"):
            ours.append(line)
        if side in ("both", "theirs"):
            theirs.append(line)
    return ["".join(theirs), "".join(ours)]


def scrubbed(text: str) -> str:
    """``text`` with ``\\n`` line ends and without characters that no file can keep."""
    if "\r" in text:
        text = text.replace("\r\n", "\n").replace("\r", "\n")
    if "\0" in text:
        text = text.replace("\0", "")
    return text if text.isascii() else text.encode("utf-8", "replace").decode("utf-8")

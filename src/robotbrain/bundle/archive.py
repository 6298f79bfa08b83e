"""A zip file whose bytes follow from its contents alone.

Entries are sorted; each has the same time, the same rights (``rw-r--r--``) and no extra field, whatever the files on
disk have. They are stored without compression, because what zlib makes of the same bytes differs between its versions
(and Python's own installers bring several); :func:`pack` compresses on demand, and then promises the same bytes only
where zlib is the same. ``SHA256SUMS`` inside is the same either way.
"""

from __future__ import annotations

import hashlib
import time
import zipfile
from collections.abc import Sequence
from pathlib import Path

from robotbrain.bundle.contents import Item
from robotbrain.files import atomic_path

CHECKSUMS = "SHA256SUMS"
_EARLIEST, _LATEST = 315532800, 4354819198  # what a zip file can say: 1980 to 2107
_UNIX, _PLAIN_FILE = 3, 0o100644


def checksums(items: Sequence[Item]) -> Item:
    """The list that ``sha256sum --check SHA256SUMS`` reads."""
    lines = [f"{hashlib.sha256(item.data).hexdigest()}  {item.name}\n" for item in items]
    return Item(CHECKSUMS, "".join(lines).encode())


def pack(items: Sequence[Item], target: Path, *, folder: str, seconds: int, compress: bool = False) -> str:
    """Write ``items`` below ``folder`` into the zip file ``target``, whole or not at all; return its SHA-256.

    Args:
        items: what goes in, in any order.
        folder: the one folder that unpacking makes.
        seconds: the time of every entry, since 1970, in UTC.
        compress: whether to make it smaller.
    """
    moment = time.gmtime(min(max(seconds, _EARLIEST), _LATEST))[:6]
    method = zipfile.ZIP_DEFLATED if compress else zipfile.ZIP_STORED
    with atomic_path(target) as temporary:
        with zipfile.ZipFile(temporary, "w") as made:
            for item in sorted(items, key=lambda item: item.name):
                entry = zipfile.ZipInfo(f"{folder}/{item.name}", moment)
                entry.create_system, entry.external_attr = _UNIX, _PLAIN_FILE << 16
                made.writestr(entry, item.data, method, 9 if compress else None)
        with temporary.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()

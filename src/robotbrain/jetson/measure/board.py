"""Which Jetson this is, from what its device tree and Jetson Linux say.

The module's part number (``p3767-0005``) decides: the name in ``model`` is the kit's or the carrier board's and is
wrong for mixed kits (an Orin Nano on an Orin NX reference kit says Orin NX). Part numbers are in NVIDIA's quick start
guides and in jetson_stats' hardware table; where one covers two memory sizes, the memory decides.
"""

from __future__ import annotations

import platform
import re
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from robotbrain.errors import InputError
from robotbrain.jetson.measure.nvpmodel import offered_modes

MODULES: Mapping[str, str] = {
    "3448-0000": "nano-4gb",  # Developer Kit
    "3448-0002": "nano-4gb",
    "3310-1000": "tx2",
    "3668-0000": "xavier-nx",  # Developer Kit
    "3668-0001": "xavier-nx",
    "2888-0003": "agx-xavier-32gb",
    "2888-0004": "agx-xavier-32gb",
    "3767-0000": "orin-nx-16gb",
    "3767-0001": "orin-nx-8gb",
    "3767-0003": "orin-nano-8gb",
    "3767-0004": "orin-nano-4gb",
    "3767-0005": "orin-nano-8gb",  # Developer Kit
    "3701-0000": "agx-orin-64gb",  # Developer Kit of 2022: cores and clocks of the 64 GB module, 32 GB of memory
    "3701-0004": "agx-orin-32gb",
    "3701-0005": "agx-orin-64gb",
    "3834-0000": "t4000",
    "3834-0008": "t5000",
}
"""Slug by part number."""

BY_MEMORY: Mapping[str, tuple[int, int, str]] = {
    "2888-0001": (24, 40, "agx-xavier-32gb"),  # Developer Kits with 16 GB and with 32 GB
    "3701-0001": (40, 70, "agx-orin-64gb"),
    "3701-0002": (40, 70, "agx-orin-64gb"),
}
"""Part numbers that cover several modules: the memory in GiB (from, to) with which they are this one."""

SUPER = frozenset({"orin-nano-4gb", "orin-nano-8gb", "orin-nx-8gb", "orin-nx-16gb"})
"""Modules that JetPack 6.2 and later also run with the clocks of the Super modes."""

_PART = re.compile(r"(?<!\d)p?(\d{4})-(\d{4})(?!\d)")
_RELEASE = re.compile(r"R(\d+) \(release\), REVISION: (\d+(?:\.\d+)*)")


@dataclass(frozen=True)
class Board:
    """What a board says about itself.

    Attributes:
        model: text of the device tree's ``model``.
        compatible: entries of its ``compatible``.
        identifiers: board ids that the boot loader left there, the module's first.
        release: first line of ``/etc/nv_tegra_release``.
        jetpack: version of the ``nvidia-jetpack`` package.
        memory_mb: total RAM, MiB.
        modes: power modes on offer, by number.
        machine: processor architecture.
    """

    model: str = ""
    compatible: tuple[str, ...] = ()
    identifiers: tuple[str, ...] = ()
    release: str = ""
    jetpack: str | None = None
    memory_mb: float | None = None
    modes: Mapping[int, str] = field(default_factory=dict)
    machine: str = ""

    @property
    def is_jetson(self) -> bool:
        """Whether this is a Jetson at all."""
        tegra = any(re.search(r"nvidia,tegra\d", entry) for entry in self.compatible)
        return tegra or "jetson" in self.model.casefold() or bool(self.jetson_linux)

    @property
    def jetson_linux(self) -> str | None:
        """Version of Jetson Linux (L4T), e.g. ``36.4.3``."""
        match = _RELEASE.search(self.release)
        return f"{match.group(1)}.{match.group(2)}" if match else None

    @property
    def parts(self) -> tuple[str, ...]:
        """Part numbers that name a module, most trustworthy first, without repeats."""
        texts = (*self.identifiers, *self.compatible)
        numbers = [f"{board}-{sku}" for text in texts for board, sku in _PART.findall(text)]
        families = {number[:4] for number in MODULES}
        return tuple(dict.fromkeys(number for number in numbers if number[:4] in families))

    @property
    def slug(self) -> str | None:
        """Slug of the module, or None if it is none of the catalogue's."""
        first = next(iter(self.parts), "")
        slug = MODULES.get(first) or self._by_memory(first)
        return f"{slug}-super" if slug in SUPER and self._is_super() else slug

    def _by_memory(self, part: str) -> str | None:
        low, high, slug = BY_MEMORY.get(part, (0, 0, None))
        return slug if low < (self.memory_mb or 0) / 1024 < high else None

    def _is_super(self) -> bool:
        words = " ".join((self.model, *self.compatible)).casefold()
        return "super" in words or any("SUPER" in mode.upper() for mode in self.modes.values())


def read_board(root: Path = Path("/")) -> Board:
    """Read what the board below ``root`` says; nothing is required to be there."""
    tree = root / "proc" / "device-tree"
    plugin_ids = tree / "chosen" / "plugin-manager" / "ids"
    ids = sorted(path.name for path in plugin_ids.iterdir()) if plugin_ids.is_dir() else []
    ids += [*_text(tree / "chosen" / "ids").split(), _text(tree / "nvidia,dtsfilename")]
    memory = re.search(r"MemTotal:\s+(\d+) kB", _text(root / "proc" / "meminfo"))
    return Board(
        model=_text(tree / "model"),
        compatible=tuple(entry for entry in _text(tree / "compatible", separator="\n").split("\n") if entry),
        identifiers=tuple(entry for entry in ids if entry),
        release=_text(root / "etc" / "nv_tegra_release").partition("\n")[0],
        jetpack=_jetpack() if root == Path("/") else None,
        memory_mb=int(memory.group(1)) / 1024 if memory else None,
        modes=offered_modes(_text(root / "etc" / "nvpmodel.conf")),
        machine=platform.machine(),
    )


def require_slug(board: Board, device: str | None) -> str:
    """Return the slug of the board's module, or ``device`` where the board's is not known.

    Raises:
        InputError: if neither says, or both say different modules.
    """
    slug = board.slug
    if slug is None and device is None:
        raise InputError(
            "module",
            given={"model": board.model, "part numbers": board.parts, "memory_mb": board.memory_mb},
            expected="a module of the catalogue (`robotbrain jetson list`)",
            fix="Name the nearest one with --device SLUG.",
        )
    if slug is not None and device is not None and slug.removesuffix("-super") != device.removesuffix("-super"):
        raise InputError(
            "--device", given=device, expected=f"{slug}, which this board says it is", fix="Leave --device out."
        )
    return device or slug or ""


def not_a_jetson(board: Board, looked_for: Sequence[str]) -> InputError:
    """Return the error for a machine that is no Jetson: what was looked for, and what to do instead."""
    return InputError(
        "robotbrain jetson measure",
        given=f"{platform.system()} on {board.machine or 'an unknown processor'}",
        expected="a Jetson (looked for " + ", ".join(looked_for) + ")",
        fix=(
            "Copy the ONNX file to the board, `pip install robotbrain` there (Python 3.11 or later; JetPack 7 has it), "
            "run this command there, and copy the file that it writes back. Or, with any JetPack, run there "
            "`tegrastats --interval 200 --logfile tegrastats.log &` and "
            "`/usr/src/tensorrt/bin/trtexec --onnx=MODEL.onnx --fp16 --useSpinWait --noDataTransfers --duration=10 "
            "2>&1 | tee trtexec.log`, and read both logs here with --from-logs trtexec.log --tegrastats tegrastats.log."
        ),
    )


def _text(path: Path, separator: str = " ") -> str:
    try:
        raw = path.read_bytes()
    except OSError:
        return ""
    return raw.decode("utf-8", "replace").rstrip("\0").replace("\0", separator).strip()


def _jetpack() -> str | None:
    try:
        query = ["dpkg-query", "--show", "--showformat=${Version}", "nvidia-jetpack"]
        done = subprocess.run(query, capture_output=True, text=True, timeout=10, check=False)
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip() or None if done.returncode == 0 else None

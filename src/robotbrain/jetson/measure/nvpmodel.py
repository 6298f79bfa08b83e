"""Reading the power mode from ``nvpmodel -q`` and the clocks from ``jetson_clocks --show``."""

from __future__ import annotations

import re
from dataclasses import dataclass

from robotbrain.errors import InputError

_MODE = re.compile(r"NV Power Mode:\s*([A-Za-z0-9_.+-]+)\s*$", re.MULTILINE)
_NUMBER = re.compile(r"^\s*(\d+)\s*$", re.MULTILINE)
_OFFERED = re.compile(r"<\s*POWER_MODEL\s+ID=(\d+)\s+NAME=([A-Za-z0-9_.+-]+)\s*>")
_CPU = re.compile(r"^cpu\d+:\s+(?:Online=(\d)\s+)?.*?MinFreq=(\d+)\s+MaxFreq=(\d+)\s+CurrentFreq=(\d+)", re.MULTILINE)
_GPU = re.compile(r"^GPU MinFreq=(\d+)\s+MaxFreq=(\d+)\s+CurrentFreq=(\d+)", re.MULTILINE)


@dataclass(frozen=True)
class Mode:
    """A power mode: its name, and its number where nvpmodel printed one."""

    name: str
    number: int | None = None


@dataclass(frozen=True)
class Clocks:
    """Limits of the clocks.

    Attributes:
        gpu_min_mhz, gpu_max_mhz: limits of the GPU's clock, MHz.
        cpus_pinned: whether every online core's minimum is its maximum; None if no core was listed.
    """

    gpu_min_mhz: float
    gpu_max_mhz: float
    cpus_pinned: bool | None

    @property
    def pinned(self) -> bool:
        """Whether GPU and cores are held at their maximum, as ``sudo jetson_clocks`` does."""
        return self.gpu_min_mhz == self.gpu_max_mhz and self.cpus_pinned is not False


def parse_mode(text: str) -> Mode:
    """Return the mode that ``nvpmodel -q`` printed; its warnings and errors around it are ignored.

    Raises:
        InputError: if it printed none.
    """
    match = _MODE.search(text)
    if match is None:
        raise InputError(
            "nvpmodel -q",
            given=text.strip()[:200],
            expected="a line `NV Power Mode: <name>`",
            fix="Run `sudo nvpmodel -q` on the board, and name the mode with --mode.",
        )
    number = _NUMBER.search(text, match.end())
    return Mode(match.group(1), int(number.group(1)) if number else None)


def offered_modes(text: str) -> dict[int, str]:
    """Return the modes of an ``nvpmodel.conf``, or of ``nvpmodel -p --verbose``, by number."""
    return {int(number): name for number, name in _OFFERED.findall(text)}


def parse_clocks(text: str) -> Clocks | None:
    """Return what ``jetson_clocks --show`` printed, or None if it showed no GPU (it needs root)."""
    gpu = _GPU.search(text)
    if gpu is None:
        return None
    cores = [(low, high) for online, low, high, _ in _CPU.findall(text) if online != "0"]
    pinned = all(low == high for low, high in cores) if cores else None
    return Clocks(float(gpu.group(1)) / 1e6, float(gpu.group(2)) / 1e6, pinned)

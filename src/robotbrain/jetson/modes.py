"""Power modes of a Jetson module: reading them, and finding the one that a user means."""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping
from dataclasses import dataclass

from robotbrain.errors import InputError
from robotbrain.jetson.figures import Table


@dataclass(frozen=True, slots=True)
class PowerMode:
    """What nvpmodel leaves of a module.

    Attributes:
        name: as nvpmodel spells it.
        id: number that nvpmodel takes.
        watts: budget, None for a mode without one (MAXN).
        default: whether the module starts in it.
        cpu_online: CPU cores that are on.
        cpu_mhz, gpu_mhz, emc_mhz: highest clocks of CPU, GPU and memory.
        sms_on: streaming multiprocessors that are on.
        dla_mhz: highest clock of the DLAs, None if they are off or absent.
        provenance, source, note: origin of the numbers (see figures.Figure).
        aliases: other names for it.
    """

    name: str
    id: int
    watts: float | None
    default: bool
    cpu_online: int
    cpu_mhz: float
    gpu_mhz: float
    sms_on: int
    emc_mhz: float
    dla_mhz: float | None
    provenance: str
    source: str
    note: str = ""
    aliases: tuple[str, ...] = ()


_KEYS = (
    *("id", "watts", "default", "cpu_online", "cpu_mhz", "gpu_mhz", "sms_on", "emc_mhz", "dla_mhz"),
    *("provenance", "source", "note", "aliases"),
)


def read_modes(
    root: Table, *, cores: int, cpu_mhz: float, gpu_mhz: float, sms: int, emc_mhz: float, dla_mhz: float | None
) -> dict[str, PowerMode]:
    """Read the table ``[modes]`` of a module's file, in the order of the modes' numbers.

    Args:
        root: the whole file.
        cores, cpu_mhz, gpu_mhz, sms, emc_mhz, dla_mhz: what the module has at most; None for no DLA.

    Raises:
        InputError: for anything missing, unknown or beyond what the module has, and unless one mode is the default.
    """
    modes: list[PowerMode] = []
    for name, table in root.tables("modes").items():
        table.only(_KEYS)
        provenance, source = table.origin()
        if table.has("dla_mhz") and dla_mhz is None:
            raise table.fail("dla_mhz", "no such key: the module has no DLA", "Remove it.")
        modes.append(
            PowerMode(
                name=name,
                id=table.whole("id", 0, 255),
                watts=table.number("watts", 1, 1000, "W") if table.has("watts") else None,
                default=table.flag("default"),
                cpu_online=table.whole("cpu_online", 1, cores),
                cpu_mhz=table.number("cpu_mhz", 50, cpu_mhz, "MHz"),
                gpu_mhz=table.number("gpu_mhz", 50, gpu_mhz, "MHz"),
                sms_on=table.whole("sms_on", 1, sms),
                emc_mhz=table.number("emc_mhz", 50, emc_mhz, "MHz"),
                dla_mhz=table.number("dla_mhz", 50, dla_mhz or 0, "MHz") if table.has("dla_mhz") else None,
                provenance=provenance,
                source=source,
                note=table.text("note", ""),
                aliases=table.texts("aliases", ()),
            )
        )
    defaults = [mode.name for mode in modes if mode.default]
    if len(defaults) != 1:
        raise root.fail("modes", "one mode with default = true", "Mark the mode the module starts in.", given=defaults)
    ids = [mode.id for mode in modes]
    if len(set(ids)) != len(ids):
        raise root.fail("modes", "another id for each mode", "Number them as nvpmodel does.", given=ids)
    return {mode.name: mode for mode in sorted(modes, key=lambda mode: mode.id)}


def _words(text: str) -> tuple[str, ...]:
    """Split a mode's name into upper-case words without the leading MODE, e.g. ("15W", "6CORE")."""
    joined = re.sub(r"MAX-(?=[NPQ])", "MAX", re.sub(r"(?<=\d)\s+(?=W\b)", "", text.upper()))
    words = tuple(word for word in re.split(r"[\s_\-():]+", joined) if word)
    return words[1:] if len(words) > 1 and words[0] == "MODE" else words


def _watts(word: str) -> float | None:
    found = re.fullmatch(r"(\d+(?:\.\d+)?)W", word)
    return float(found[1]) if found else None


def resolve_mode(module: str, modes: Mapping[str, PowerMode], wanted: str | int | PowerMode | None) -> PowerMode:
    """Return the mode that is meant.

    Upper and lower case are alike, as are spaces, hyphens and underscores, and a leading ``MODE_`` may be left out.
    Tried in this order; the first that fits anything decides:

    1. None: the default mode. A number, also as text: the mode with that id.
    2. The name, or an alias that the module's file lists.
    3. The beginning of names (``15W`` for ``MODE_15W_6CORE``, ``MAXP`` for ``MAXP_CORE_ALL``), then a budget in
       watts (``15W`` for a mode of another name with that budget). If several fit, it is the default mode if that is
       among them, else the one with most CPU cores on, then the highest GPU clock, then the lowest id.
    4. ``MAXN`` where nvpmodel has no such mode: the mode with the most GPU throughput, then the fastest memory, then
       the most CPU cores.

    Args:
        module: its name, for the message.
        modes: its modes by name.
        wanted: name, alias, id, a mode of this module, or None.

    Raises:
        InputError: if nothing fits.
    """
    if wanted is None:
        return next(mode for mode in modes.values() if mode.default)
    if isinstance(wanted, PowerMode):
        if modes.get(wanted.name) == wanted:
            return wanted
        raise _unknown(module, modes, wanted.name)
    text = str(wanted).strip()
    if isinstance(wanted, bool) or not text:
        raise _unknown(module, modes, wanted)
    if text.isdecimal():
        for mode in modes.values():
            if mode.id == int(text):
                return mode
        raise _unknown(module, modes, wanted)
    words = _words(text)
    for mode in modes.values():
        if words in (_words(mode.name), *map(_words, mode.aliases)):
            return mode
    near = [mode for mode in modes.values() if words and _words(mode.name)[: len(words)] == words]
    if not near and len(words) == 1 and _watts(words[0]) is not None:
        near = [mode for mode in modes.values() if mode.watts == _watts(words[0])]
    if near:
        return min(near, key=lambda mode: (not mode.default, -mode.cpu_online, -mode.gpu_mhz, mode.id))
    if words == ("MAXN",):
        return max(modes.values(), key=lambda mode: (mode.gpu_mhz * mode.sms_on, mode.emc_mhz, mode.cpu_online))
    raise _unknown(module, modes, wanted)


def _unknown(module: str, modes: Mapping[str, PowerMode], given: object) -> InputError:
    by_upper = {name.upper(): name for name in modes}
    near = difflib.get_close_matches(str(given).upper(), list(by_upper), n=1, cutoff=0.5)
    listed = ", ".join(f"{mode.name} ({mode.id})" for mode in modes.values())
    return InputError(
        f"power mode of {module}",
        given=given,
        expected="one of " + listed,
        fix=f"Did you mean {by_upper[near[0]]!r}?" if near else "Choose one of these, by name or number.",
    )

"""CPU work of the brain's nodes: what one unit of each kind took on the computer where it was timed.

``work.toml`` is written by ``benchmarks/cpu_work.py --write``. On a module a unit takes as many times longer as the
module's CPU is slower by a published single-thread benchmark (see catalogue.Module.cpu_score).
"""

from __future__ import annotations

import difflib
import functools
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

from robotbrain.errors import InputError
from robotbrain.jetson.figures import Table, read_table
from robotbrain.jetson.paths import find_part

ENTITY_KINDS = ("timer", "subscription", "service", "client")
"""Kinds of callbacks."""

MIDDLEWARE = ("message_in", "message_out")
"""Kinds of work that carry messages; every callback pays them by what it receives and sends."""

SLOWEST_NS = 1e10
"""More than this for one unit or one call is a mistake, ns."""


@dataclass(frozen=True, slots=True)
class WorkKind:
    """One kind of CPU work.

    Attributes:
        name: as ``charge_work`` takes it.
        unit: what is counted.
        what: which code it stands for.
        fixed_ns: of each call, ns on the host.
        unit_ns: of each unit, ns on the host.
        error: median relative deviation of single calls from the fit.
    """

    name: str
    unit: str
    what: str
    fixed_ns: float
    unit_ns: float
    error: float

    def host_ns(self, units: float, calls: float = 1.0) -> float:
        """Return the time on the host, ns."""
        return self.fixed_ns * calls + self.unit_ns * units


@dataclass(frozen=True, slots=True)
class TypicalCallback:
    """The work that a callback of the reference brain does on average.

    Attributes:
        name: short name, e.g. ``perception``.
        role: of its node.
        kind: one of ENTITY_KINDS.
        topic: topic or service; empty for a timer.
        work: (calls, units) by kind of work.
    """

    name: str
    role: str
    kind: str
    topic: str
    work: Mapping[str, tuple[float, float]]


@dataclass(frozen=True, slots=True)
class WorkTable:
    """Everything in ``work.toml``.

    Attributes:
        host: key of the computer in ``cpu_hosts.toml``.
        cpu: its CPU in words.
        provenance, source: origin of the times.
        kinds: by name.
        callbacks: by short name.
    """

    host: str
    cpu: str
    provenance: str
    source: str
    kinds: Mapping[str, WorkKind]
    callbacks: Mapping[str, TypicalCallback]

    def kind(self, name: str) -> WorkKind:
        """Return one kind of work.

        Raises:
            InputError: for an unknown one.
        """
        found = self.kinds.get(name)
        if found is None:
            near = difflib.get_close_matches(str(name), list(self.kinds), n=1, cutoff=0.4)
            raise InputError(
                "kind of work",
                given=name,
                expected="one of " + ", ".join(self.kinds),
                fix=f"Did you mean {near[0]!r}?" if near else "Charge work of your own in ns: charge(ns).",
            )
        return found

    def callback_ns(self, callback: TypicalCallback) -> float:
        """Return what a typical callback takes on the host, ns."""
        return sum(self.kind(name).host_ns(units, calls) for name, (calls, units) in callback.work.items())


def load_work() -> WorkTable:
    """Return the work table of the profile directory.

    Raises:
        InputError: if there is none, or it does not hold what it must.
    """
    path = find_part("work.toml")
    return _load(path, path.stat().st_mtime_ns)


@functools.lru_cache(maxsize=8)
def _load(path: Path, _changed: int) -> WorkTable:
    return read_work(path)


def read_work(path: Path) -> WorkTable:
    """Read a work table and check all of it.

    Raises:
        InputError: that names the file, the table and the key at fault.
    """
    root = read_table(path)
    root.only(("sources", "host", "kinds", "callbacks"))
    host = root.table("host")
    host.only(("key", "cpu", "date", "command", "software", "provenance", "source"))
    for key in ("date", "command", "software"):
        host.text(key)
    provenance, source = host.origin()
    kinds = {name: _kind(name, table) for name, table in root.tables("kinds").items()}
    callbacks = {name: _callback(name, table, kinds) for name, table in root.tables("callbacks").items()}
    return WorkTable(
        host.text("key"),
        host.text("cpu"),
        provenance,
        source,
        MappingProxyType(kinds),
        MappingProxyType(callbacks),
    )


def _kind(name: str, table: Table) -> WorkKind:
    table.only(("unit", "what", "fixed_ns", "unit_ns", "error", "calls"))
    return WorkKind(
        name,
        table.text("unit"),
        table.text("what"),
        table.number("fixed_ns", 0, SLOWEST_NS, "ns"),
        table.number("unit_ns", 0, SLOWEST_NS, "ns"),
        table.number("error", 0, 10),
    )


def _callback(name: str, table: Table, kinds: Mapping[str, WorkKind]) -> TypicalCallback:
    table.only(("role", "kind", "topic", "work"))
    kind = table.text("kind")
    if kind not in ENTITY_KINDS:
        raise table.fail("kind", "one of " + ", ".join(ENTITY_KINDS), "Say what calls back.")
    inner, work = table.table("work"), {}
    inner.only(kinds)
    for key, pair in inner.data.items():
        numbers = isinstance(pair, list) and len(pair) == 2 and all(isinstance(v, int | float) for v in pair)
        if not numbers or not all(0 <= v < 1e12 for v in pair):
            raise inner.fail(key, "[calls, units], both 0 or more", "Write them with benchmarks/cpu_work.py --write.")
        work[key] = (float(pair[0]), float(pair[1]))
    return TypicalCallback(name, table.text("role"), kind, table.text("topic", ""), MappingProxyType(work))

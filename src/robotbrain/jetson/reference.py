"""Reference profiles: what each lab's network and the brain's callbacks take on each module, with a tolerance.

Tests compare student work against these files (``autograder/profiles/reference/<slug>.toml``); the twin and the work
table make them. ``robotbrain jetson reference`` writes them all again, ``--check`` says what has drifted.
"""

from __future__ import annotations

import argparse
import functools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from types import MappingProxyType

from robotbrain.errors import InputError
from robotbrain.files import write_text
from robotbrain.jetson.catalogue import list_modules, load_module
from robotbrain.jetson.figures import PROVENANCES, Table, read_table
from robotbrain.jetson.kernels import PRECISIONS as PRECISIONS
from robotbrain.jetson.paths import find_part, profile_directory

NETWORKS: Mapping[str, tuple[str, str]] = MappingProxyType(
    {"segmentation": ("robotbrain", "pipeline/weights/segmentation.onnx")}
)
"""Networks of the labs: the package and the file in it, by name."""

TOLERANCE = 0.02
"""Relative difference that a test allows by default: far above rounding, far below what a mistake makes."""

DRIFT = 1e-3
"""Relative difference at which a stored figure counts as out of date."""


@dataclass(frozen=True, slots=True)
class NetworkReference:
    """One network on one module in one power mode.

    Attributes:
        network: name of the network, a key of NETWORKS (or of a later file).
        mode: power mode, as nvpmodel spells it.
        precision: of the engine.
        latency_ms, latency_low_ms, latency_high_ms: of one inference, with its 80 % interval.
        memory_mb, power_w, energy_mj: see twin.Prediction.
        provenance: one of figures.PROVENANCES.
    """

    network: str
    mode: str
    precision: str
    latency_ms: float
    latency_low_ms: float
    latency_high_ms: float
    memory_mb: float
    power_w: float
    energy_mj: float
    provenance: str


@dataclass(frozen=True)
class ReferenceProfile:
    """Reference numbers of one module.

    Attributes:
        slug: of the module.
        tolerance: relative difference that tests allow.
        networks: every figure.
        callbacks_ms: CPU time of a typical callback by power mode and short name, ms.
    """

    slug: str
    tolerance: float
    networks: tuple[NetworkReference, ...]
    callbacks_ms: Mapping[str, Mapping[str, float]]

    def network(self, name: str, mode: str | None = None, precision: str = "fp16") -> NetworkReference:
        """Return the figures of one network.

        Raises:
            InputError: for a network, mode or precision that has none.
        """
        wanted = load_module(self.slug).mode(mode).name
        for item in self.networks:
            if (item.network, item.mode, item.precision) == (name, wanted, precision):
                return item
        raise InputError(
            f"reference of {self.slug}",
            given=f"{name} in mode {wanted}, {precision}",
            expected="one of " + ", ".join(sorted({f"{i.network} ({i.precision})" for i in self.networks})),
            fix="Run `robotbrain jetson reference` if the network is new.",
        )

    def callback_ms(self, callback: str, mode: str | None = None) -> float:
        """Return the CPU time of a typical callback, ms.

        Raises:
            InputError: for an unknown callback or mode.
        """
        callbacks = self.callbacks_ms.get(load_module(self.slug).mode(mode).name, {})
        if callback not in callbacks:
            raise InputError(
                f"reference of {self.slug}: callback",
                given=callback,
                expected="one of " + ", ".join(callbacks),
                fix="Run `robotbrain jetson reference` if it is new.",
            )
        return callbacks[callback]

    def agrees(self, value: float, reference: float) -> bool:
        """Whether a value is within the tolerance of a reference figure."""
        return math.isfinite(value) and abs(value - reference) <= self.tolerance * abs(reference)


def make_reference(slug: str) -> ReferenceProfile:
    """Compute the reference numbers of one module from the twin and the work table."""
    from robotbrain.jetson.profiles import load_profile
    from robotbrain.jetson.twin import as_graph, predict

    module = load_module(slug)
    figures: list[NetworkReference] = []
    for name, (package, inside) in NETWORKS.items():
        with resources.as_file(resources.files(package) / inside) as path:
            graph = as_graph(path)
        for mode in module.modes.values():
            for precision in PRECISIONS:
                found = predict(graph, module, mode=mode, precision=precision)
                figures.append(
                    NetworkReference(
                        network=name,
                        mode=mode.name,
                        precision=precision,
                        latency_ms=_short(found.latency_ms),
                        latency_low_ms=_short(found.latency_low_ms),
                        latency_high_ms=_short(found.latency_high_ms),
                        memory_mb=_short(found.memory_mb),
                        power_w=_short(found.power_w),
                        energy_mj=_short(found.energy_mj),
                        provenance=found.provenance,
                    )
                )
    callbacks = {
        mode: {name: _short(ms) for name, ms in load_profile(slug, mode).callback_ms.items()} for mode in module.modes
    }
    return ReferenceProfile(slug, TOLERANCE, tuple(figures), MappingProxyType(callbacks))


def _short(value: float) -> float:
    return float(f"{value:.5g}")


def to_toml(profile: ReferenceProfile) -> str:
    """Return a reference profile as text."""
    lines = [
        f"# What the labs' networks and the brain's callbacks take on the {load_module(profile.slug).name}.",
        "# Written by `robotbrain jetson reference`; do not edit: change the catalogue, the calibration data or the",
        "# work table and write it again. Times in ms, memory in MB, power of the module in W, energy of an inference",
        "# in mJ.",
        f'slug = "{profile.slug}"',
        f"tolerance = {profile.tolerance}  # relative difference that tests allow",
        'source = "kit:twin (networks) and work table (callbacks), see README.md in this directory\'s parent"',
        "",
    ]
    for item in profile.networks:
        lines.append(f"[[networks.{item.network}]]")
        lines.append(f'mode = "{item.mode}"')
        lines.append(f'precision = "{item.precision}"')
        lines += [f"{key} = {getattr(item, key)!r}" for key in _NUMBERS]
        lines += [f'provenance = "{item.provenance}"', ""]
    for mode, callbacks in profile.callbacks_ms.items():
        lines.append(f'[callbacks."{mode}"]  # predicted')
        lines += [f"{name}_ms = {ms!r}" for name, ms in callbacks.items()]
        lines.append("")
    return "\n".join(lines)


_NUMBERS = ("latency_ms", "latency_low_ms", "latency_high_ms", "memory_mb", "power_w", "energy_mj")


def read_reference(path: Path) -> ReferenceProfile:
    """Read a reference profile and check all of it.

    Raises:
        InputError: that names the file, the table and the key at fault.
    """
    root = read_table(path)
    root.only(("slug", "tolerance", "source", "networks", "callbacks"))
    if root.text("slug") != path.stem:
        raise root.fail("slug", path.stem, "A reference profile is named like its file.")
    figures: list[NetworkReference] = []
    networks = root.table("networks")
    for name, items in networks.data.items():
        if not isinstance(items, list) or not all(isinstance(item, dict) for item in items):
            raise networks.fail(name, "tables [[networks.<name>]]", "Write the file again.")
        for position, item in enumerate(items):
            figures.append(_network(Table(path.name, item, f"networks.{name}[{position}]"), name))
    callbacks = {
        mode: MappingProxyType(
            {key.removesuffix("_ms"): table.number(key, 0, 1e6, "ms") for key in table.data if key.endswith("_ms")}
        )
        for mode, table in root.tables("callbacks").items()
    }
    return ReferenceProfile(path.stem, root.number("tolerance", 1e-6, 1), tuple(figures), MappingProxyType(callbacks))


def _network(table: Table, name: str) -> NetworkReference:
    table.only(("mode", "precision", "provenance", *_NUMBERS))
    numbers = {key: table.number(key, 0, 1e9) for key in _NUMBERS}
    provenance = table.text("provenance")
    if provenance not in PROVENANCES:
        raise table.fail("provenance", "one of " + ", ".join(PROVENANCES), "Write the file again.")
    return NetworkReference(name, table.text("mode"), table.text("precision"), **numbers, provenance=provenance)


@functools.lru_cache(maxsize=64)
def _load(path: Path, _changed: int) -> ReferenceProfile:
    return read_reference(path)


def load_reference(slug: str) -> ReferenceProfile:
    """Return the stored reference numbers of a module.

    Raises:
        InputError: for an unknown module, or a file that does not hold what it must.
    """
    path = find_part(f"reference/{load_module(slug).slug}.toml")
    return _load(path, path.stat().st_mtime_ns)


def drifted(slug: str) -> list[str]:
    """Return what in a stored reference profile differs from what the kit computes now, in words."""
    stored, fresh = load_reference(slug), make_reference(slug)
    known = {(i.network, i.mode, i.precision): i for i in stored.networks}
    remarks = []
    for item in fresh.networks:
        old = known.pop((item.network, item.mode, item.precision), None)
        where = f"{slug} {item.network} {item.mode} {item.precision}"
        if old is None:
            remarks.append(f"{where}: not stored")
            continue
        for key in _NUMBERS:
            before, now = getattr(old, key), getattr(item, key)
            if abs(before - now) > DRIFT * max(abs(now), 1e-9):
                remarks.append(f"{where} {key}: stored {before:g}, now {now:g}")
    remarks += [f"{slug} {' '.join(key)}: stored, but there is no such any more" for key in known]
    for mode, callbacks in fresh.callbacks_ms.items():
        before_all = stored.callbacks_ms.get(mode, {})
        for name, now in callbacks.items():
            before = before_all.get(name, math.nan)
            if not abs(before - now) <= DRIFT * now:
                remarks.append(f"{slug} {mode} {name}_ms: stored {before:g}, now {now:g}")
    return remarks


def reference_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``robotbrain jetson reference``."""
    parser.add_argument("--check", action="store_true", help="write nothing; exit 1 if a stored figure is out of date")


def reference_main(arguments: argparse.Namespace) -> int:
    """Write the reference profiles of all modules, or check them."""
    if arguments.check:
        remarks = [remark for slug in list_modules() for remark in drifted(slug)]
        for remark in remarks:
            print(remark)
        print(f"{len(remarks)} figures are out of date" if remarks else "all reference figures are up to date")
        return 1 if remarks else 0
    directory = profile_directory() / "reference"
    for slug in list_modules():
        write_text(directory / f"{slug}.toml", to_toml(make_reference(slug)))
    print(f"{len(list_modules())} reference profiles in {directory}")
    return 0

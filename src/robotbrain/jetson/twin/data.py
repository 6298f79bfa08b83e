"""The published measurements that the twin is calibrated on (``autograder/profiles/calibration``)."""

from __future__ import annotations

import csv
import functools
import hashlib
import io
import json
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from robotbrain.errors import InputError
from robotbrain.jetson.catalogue import Module, load_module
from robotbrain.jetson.figures import SOURCE_FORMS, read_text
from robotbrain.jetson.kernels import KernelGraph
from robotbrain.jetson.modes import PowerMode
from robotbrain.jetson.paths import find_part
from robotbrain.jetson.twin.conditions import HARNESSES, PRECISIONS, Conditions, conditions

USES = ("fit", "check", "out")
"""What a row is for: calibration, a look from outside, or neither (its note says why)."""


@dataclass(frozen=True)
class LatencyRow:
    """A published latency of one inference, batch 1.

    Attributes:
        module, mode: slug, and power mode (clocks below override its own).
        network: as published.
        kernels: name of its kernel list.
        precision, harness: see twin.conditions.
        latency_ms: as published.
        use: one of USES.
        note, source: where it is from and what was assumed.
        where: conditions of the model.
    """

    module: str
    mode: str
    network: str
    kernels: str
    precision: str
    harness: str
    latency_ms: float
    use: str
    note: str
    source: str
    where: Conditions


@dataclass(frozen=True)
class PowerRow:
    """A published power at the wall of a developer kit, under MLPerf.

    Attributes:
        module: slug.
        mode: clocks, as a power mode.
        network, precision, scenario, round: as MLPerf names them.
        kernels: name of its kernel list, empty if the kit has none.
        gflop: of one inference (two for each multiply-accumulate), None if not known; those of networks without a
            kernel list are from Reddi et al., MLPerf Inference Benchmark, ISCA 2020, table 1.
        latency_ms: of the same run, None if not published.
        wall_power_w: as published.
        use, note, source: as in LatencyRow.
    """

    module: str
    mode: PowerMode
    network: str
    precision: str
    scenario: str
    round: str
    kernels: str
    gflop: float | None
    latency_ms: float | None
    wall_power_w: float
    use: str
    note: str
    source: str


def calibration_directory() -> Path:
    """Return the directory with the calibration data."""
    return find_part("calibration/latency.csv").parent


def data_digest() -> str:
    """Return a digest of all calibration data, to tell whether a fit is out of date (of text, so not of line ends)."""
    digest = hashlib.sha256()
    for name in ("kernels.json", "latency.csv", "power.csv"):
        digest.update(read_text(find_part(f"calibration/{name}"), "text").encode())
    return digest.hexdigest()


@functools.lru_cache(maxsize=4)
def _kernel_lists(path: Path, _changed: int) -> dict[str, KernelGraph]:
    try:
        data = json.loads(read_text(path, "text"))
    except (ValueError, RecursionError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(str(path), given=str(error), expected="a JSON file", fix="Restore it from git.") from error
    if not isinstance(data, dict) or not all(isinstance(kernels, list) for kernels in data.values()):
        raise InputError(
            str(path), given=type(data).__name__, expected="a list of kernels by name", fix="Restore it from git."
        )
    return {name: KernelGraph.from_list(kernels, name) for name, kernels in data.items()}


def load_kernel_lists() -> Mapping[str, KernelGraph]:
    """Return the kernel lists of published architectures, by name.

    Raises:
        InputError: for a file that does not hold what it must.
    """
    path = find_part("calibration/kernels.json")
    return _kernel_lists(path, path.stat().st_mtime_ns)


class _Row:
    """A row of a table, read with checks that name the file, the line and the column."""

    def __init__(self, file: str, line: int, cells: Mapping[str, str]) -> None:
        self.file, self.line, self.cells = file, line, cells

    def fail(self, key: str, expected: str, fix: str) -> InputError:
        return InputError(
            f"{self.file}, line {self.line}: {key}", given=self.cells.get(key), expected=expected, fix=fix
        )

    def number(self, key: str) -> float:
        try:
            value = float(self.cells[key])
        except ValueError:
            value = -1.0
        if not 0 < value < 1e9:
            raise self.fail(key, "a positive number", "Compare with the rows around it.")
        return value

    def maybe(self, key: str) -> float | None:
        return self.number(key) if self.cells[key] else None

    def choice(self, key: str, choices: Collection[str], fix: str = "Choose one of these.") -> str:
        if self.cells[key] not in choices:
            raise self.fail(key, "one of " + ", ".join(choices), fix)
        return self.cells[key]

    def module(self) -> Module:
        try:
            return load_module(self.cells["module"])
        except InputError as error:
            raise self.fail("module", error.expected, error.fix) from error

    def mode(self, module: Module) -> PowerMode:
        try:
            return module.mode(self.cells["mode"]) if self.cells["mode"] else fastest_mode(module)
        except InputError as error:
            raise self.fail("mode", error.expected, error.fix) from error

    def origin(self) -> tuple[str, str, str]:
        """Return use, note and source."""
        use = self.choice("use", USES)
        if use == "out" and not self.cells["note"].strip():
            raise self.fail("note", "why the row is left out", "Say it in a few words.")
        if not self.cells["source"].startswith(SOURCE_FORMS):
            raise self.fail("source", "text that begins with " + " or ".join(SOURCE_FORMS), "Give the address.")
        return use, self.cells["note"], self.cells["source"]


def _read(name: str, columns: tuple[str, ...]) -> list[_Row]:
    path = find_part(f"calibration/{name}")
    reader = csv.DictReader(io.StringIO(read_text(path, "text")), restkey="", restval=None, strict=True)
    try:
        rows = [_Row(name, reader.line_num, cells) for cells in reader]
    except csv.Error as error:
        raise InputError(
            f"{name}, line {reader.line_num}", given=str(error), expected="comma-separated values", fix="Correct it."
        ) from error
    missing = [key for key in columns if key not in (reader.fieldnames or ())]
    if missing or not rows:
        raise InputError(
            str(path),
            given="no column " + ", ".join(missing) if missing else "no rows",
            expected="rows of " + ", ".join(columns),
            fix="Restore it from git.",
        )
    for row in rows:
        if None in row.cells.values() or "" in row.cells:
            raise InputError(
                f"{name}, line {row.line}",
                given=f"{'fewer' if None in row.cells.values() else 'more'} cells than columns",
                expected=f"{len(reader.fieldnames or ())} cells",
                fix="Put cells that hold a comma in quotation marks.",
            )
    return rows


def _clocked(module: Module, mode: PowerMode, gpu: float | None, emc: float | None) -> PowerMode:
    return replace(
        mode,
        gpu_mhz=min(gpu or mode.gpu_mhz, module.gpu_max_mhz),
        emc_mhz=min(emc or mode.emc_mhz, module.emc_max_mhz),
    )


def fastest_mode(module: Module) -> PowerMode:
    """Return the power mode with the most of everything."""
    rank: Callable[[PowerMode], tuple[float, ...]] = lambda m: (m.gpu_mhz * m.sms_on, m.emc_mhz, m.cpu_online)  # noqa: E731
    return max(module.modes.values(), key=rank)


_BOTH = ("module", "gpu_mhz", "emc_mhz", "network", "kernels", "precision", "latency_ms", "use", "note", "source")
_LATENCY = (*_BOTH, "mode", "harness")
_POWER = (*_BOTH, "cpu_mhz", "cpu_cores", "gflop", "scenario", "round", "wall_power_w")


def load_latency_rows(*, uses: tuple[str, ...] = ("fit",)) -> list[LatencyRow]:
    """Return the latency rows for some uses.

    Raises:
        InputError: for a row that does not hold what it must.
    """
    known = load_kernel_lists()
    rows = []
    for row in _read("latency.csv", _LATENCY):
        module = row.module()
        mode = _clocked(module, row.mode(module), row.maybe("gpu_mhz"), row.maybe("emc_mhz"))
        precision, harness = row.choice("precision", PRECISIONS), row.choice("harness", HARNESSES)
        use, note, source = row.origin()
        rows.append(
            LatencyRow(
                module=module.slug,
                mode=row.cells["mode"],
                network=row.cells["network"],
                kernels=row.choice("kernels", known, "Add the kernel list to kernels.json, or remove the row."),
                precision=precision,
                harness=harness,
                latency_ms=row.number("latency_ms"),
                use=use,
                note=note,
                source=source,
                where=conditions(module, mode, precision, harness),
            )
        )
    return [row for row in rows if row.use in uses]


def load_power_rows(*, uses: tuple[str, ...] = ("fit",)) -> list[PowerRow]:
    """Return the rows of wall power for some uses.

    Raises:
        InputError: for a row that does not hold what it must.
    """
    known = load_kernel_lists()
    rows = []
    for row in _read("power.csv", _POWER):
        module = row.module()
        mode = _clocked(module, fastest_mode(module), row.maybe("gpu_mhz"), row.maybe("emc_mhz"))
        mode = replace(
            mode,
            cpu_mhz=row.maybe("cpu_mhz") or mode.cpu_mhz,
            cpu_online=int(row.maybe("cpu_cores") or mode.cpu_online),
        )
        kernels = row.choice("kernels", ("", *known), "Add the kernel list to kernels.json, or leave it empty.")
        use, note, source = row.origin()
        rows.append(
            PowerRow(
                module=module.slug,
                mode=mode,
                network=row.cells["network"],
                precision=row.choice("precision", PRECISIONS),
                scenario=row.cells["scenario"],
                round=row.cells["round"],
                kernels=kernels,
                gflop=2e-9 * known[kernels].macs if kernels else row.maybe("gflop"),
                latency_ms=row.maybe("latency_ms"),
                wall_power_w=row.number("wall_power_w"),
                use=use,
                note=note,
                source=source,
            )
        )
    return [row for row in rows if row.use in uses]

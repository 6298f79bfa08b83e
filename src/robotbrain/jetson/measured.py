"""Measured profiles: what one network took on one real board, in a file that takes precedence over a prediction.

A profile is ``<directory>/<module slug>/<model>-<precision>-<power mode>-<harness>.toml``. It is looked for under
``measured/`` in the profile directory, and in the directories that the environment variable ``ROBOTBRAIN_MEASURED``
names (separated as ``PATH`` is). Nothing is read from a home directory, so that a grade never depends on what the
machine that grades happens to have measured once.

Units: ms, W, degC, MHz, and MiB where a field says ``mb`` (as trtexec and tegrastats do). What was not measured is
absent from the file and ``None`` here; it is never 0.
"""

from __future__ import annotations

import itertools
import os
import re
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields
from datetime import UTC, datetime
from pathlib import Path

from robotbrain.errors import InputError
from robotbrain.files import write_text
from robotbrain.jetson.kernels import PRECISIONS
from robotbrain.jetson.measure.tomlio import Reader, is_number, pairs, table
from robotbrain.jetson.paths import profile_directory

FORMAT = 1
"""Version of the file format; a file of a later one is refused."""

HARNESSES = ("trtexec", "torch2trt", "tf_to_trt", "efficientvit", "ultralytics", "mlperf")
"""Kinds of timing, as the predictor names them."""

DIRECTORIES_VARIABLE = "ROBOTBRAIN_MEASURED"
"""Environment variable with further directories of measured profiles."""

_SLUG = re.compile(r"[a-z0-9]+(?:-[a-z0-9]+)*")
_SHA256 = re.compile(r"[0-9a-f]{64}")


@dataclass(frozen=True)
class Timing:
    """Statistics over the timed inferences, ms.

    Raises:
        InputError: for values that are not finite, negative, or in an order no sample of times can have.
    """

    median: float
    mean: float
    min: float
    max: float
    p90: float | None = None
    p95: float | None = None
    p99: float | None = None

    def __post_init__(self) -> None:
        given = {f.name: getattr(self, f.name) for f in fields(self)}
        known = {name: value for name, value in given.items() if value is not None}
        for name, value in known.items():
            if not is_number(value) or not 0 <= value < 1e9:
                raise InputError(f"timing: {name}", given=value, expected="milliseconds, 0 or more", fix="See the log.")
        slack = 1e-4 * self.max + 1e-6  # trtexec sums in float32 and prints six digits
        inside = all(self.min - slack <= value <= self.max + slack for value in known.values())
        tail = [known[name] for name in ("median", "p90", "p95", "p99") if name in known]
        if not inside or any(high < low - slack for low, high in itertools.pairwise(tail)):
            raise InputError(
                "timing",
                given=known,
                expected="min <= median <= p90 <= p95 <= p99 <= max, and min <= mean <= max",
                fix="The numbers contradict each other: was the log edited, or two logs mixed?",
            )


@dataclass(frozen=True)
class Power:
    """Power of the module (not of the whole kit) while the network ran, W.

    Attributes:
        mean, peak: over the samples.
        samples: how many.
        rails: names of the supply rails that were added up.
        sampler: ``"tegrastats"`` or ``"jtop"``.
    """

    mean: float
    peak: float
    samples: int
    rails: tuple[str, ...]
    sampler: str


@dataclass(frozen=True)
class MeasuredProfile:
    """One network on one module in one power mode, as measured.

    Attributes:
        module: slug, e.g. ``orin-nano-8gb``.
        mode: power mode as nvpmodel spells it.
        model: name of the network.
        sha256: of the ONNX file, in lower-case hexadecimal.
        precision: one of ``fp32 fp16 int8``.
        latency: time TensorRT took on the GPU for one query (trtexec's "GPU Compute Time"), ms.
        source: who measured, with what.
        date: when, in UTC, whole seconds.
        harness: kind of timing, one of :data:`HARNESSES`.
        batch: inputs in one query.
        cuda_graph: whether the launches were captured in a CUDA graph.
        shapes: of the inputs, by name.
        host_latency: with the copies to and from the device, ms.
        throughput_qps: queries per second over the whole run.
        memory_mb: device memory held by TensorRT (weights, activations, scratch), without the CUDA context.
        system_memory_mb: most RAM in use on the board while the network ran, everything included.
        power: of the module.
        temperature_mean_c, temperature_peak_c: of the hottest sensor on the die.
        clocks_pinned: whether ``jetson_clocks`` held the clocks at their maximum.
        gpu_mhz, emc_mhz, cpu_mhz: mean clocks while the network ran.
        jetpack, jetson_linux, tensorrt: versions.
        command: the command line that was timed.
        notes: what a reader should know.
    """

    module: str
    mode: str
    model: str
    sha256: str
    precision: str
    latency: Timing
    source: str
    date: datetime
    harness: str = "trtexec"
    batch: int = 1
    cuda_graph: bool = False
    shapes: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    host_latency: Timing | None = None
    throughput_qps: float | None = None
    memory_mb: float | None = None
    system_memory_mb: float | None = None
    power: Power | None = None
    temperature_mean_c: float | None = None
    temperature_peak_c: float | None = None
    clocks_pinned: bool | None = None
    gpu_mhz: float | None = None
    emc_mhz: float | None = None
    cpu_mhz: float | None = None
    jetpack: str | None = None
    jetson_linux: str | None = None
    tensorrt: str | None = None
    command: str | None = None
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        _check(_SLUG.fullmatch(self.module), "module", self.module, "a module's slug such as orin-nano-8gb")
        _check(_SHA256.fullmatch(self.sha256), "sha256", self.sha256, "64 lower-case hexadecimal digits")
        _check(self.precision in PRECISIONS, "precision", self.precision, "one of " + ", ".join(PRECISIONS))
        _check(self.harness in HARNESSES, "harness", self.harness, "one of " + ", ".join(HARNESSES))
        _check(self.batch >= 1, "batch", self.batch, "a whole number, 1 or more")
        _check(self.date.tzinfo is not None, "date", self.date, "a time with its zone")
        for name in ("mode", "model", "source"):
            _check(getattr(self, name).strip(), name, getattr(self, name), "text")
        _check(self.latency.min > 0, "latency_ms: min", self.latency.min, "more than 0 ms")
        _check(1970 <= self.date.year <= 9000, "date", self.date, "a date after 1970")
        object.__setattr__(self, "date", self.date.astimezone(UTC).replace(microsecond=0))

    @property
    def provenance(self) -> str:
        """Always ``"measured"``."""
        return "measured"

    @property
    def latency_ms(self) -> float:
        """Median time of one query on the GPU, ms."""
        return self.latency.median

    @property
    def energy_mj(self) -> float | None:
        """Energy of the module for one query, mJ, if its power was measured.

        The power counts from one query to the next, so the pauses between them are in it.
        """
        if self.power is None:
            return None
        return self.power.mean * (1000 / self.throughput_qps if self.throughput_qps else self.latency.mean)

    @property
    def filename(self) -> str:
        """Name of its file; lower case, without what a file system could stumble on."""
        parts = [self.model, self.precision, self.mode, self.harness]
        parts += [f"batch{self.batch}"] if self.batch != 1 else []
        parts += ["cudagraph"] if self.cuda_graph else []
        return "-".join(_plain(part) for part in parts) + ".toml"

    def to_toml(self) -> str:
        """Return the content of its file."""
        top = {
            "format": FORMAT,
            "module": self.module,
            "power_mode": self.mode,
            "harness": self.harness,
            "cuda_graph": self.cuda_graph,
            "date": self.date,
            "provenance": self.provenance,
            "source": self.source,
            "command": self.command,
            "notes": self.notes or None,
            "throughput_qps": self.throughput_qps,
            "memory_mb": self.memory_mb,
            "system_memory_mb": self.system_memory_mb,
        }
        model = {"name": self.model, "sha256": self.sha256, "precision": self.precision, "batch": self.batch}
        power = {} if self.power is None else {f.name: getattr(self.power, f.name) for f in fields(Power)}
        heat = {"mean": self.temperature_mean_c, "peak": self.temperature_peak_c}
        clocks = {name: getattr(self, name) for name in ("gpu_mhz", "emc_mhz", "cpu_mhz")}
        software = {name: getattr(self, name) for name in ("jetpack", "jetson_linux", "tensorrt")}
        lines = [
            "# Measured on a real board; written by `robotbrain jetson measure`. Times in ms, memory in MiB.",
            *pairs(top),
            *table("model", model),
            *table("model.shapes", self.shapes),
            *table("latency_ms", _times(self.latency)),
            *table("host_latency_ms", _times(self.host_latency)),
            *table("power_w", power),
            *table("temperature_c", heat),
            *table("clocks", {"pinned": self.clocks_pinned, **clocks}),
            *table("software", software),
        ]
        return "\n".join(lines) + "\n"

    def write(self, directory: str | Path) -> Path:
        """Write it below ``directory`` and return the path; an older measurement of the same is replaced.

        A file of the same name that measures another network is kept: this one's name then gets the first digits
        of its checksum.
        """
        path = Path(directory) / self.module / self.filename
        if path.exists() and f'sha256 = "{self.sha256}"' not in path.read_text(encoding="utf-8", errors="replace"):
            path = path.with_name(f"{path.stem}-{self.sha256[:8]}.toml")
        return write_text(path, self.to_toml())


def load(path: str | Path) -> MeasuredProfile:
    """Return the measured profile in a file.

    Raises:
        InputError: naming the file and the key, if it is not such a file.
    """
    path = Path(path)
    try:
        data = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError("measured profile", given=str(path), expected="a readable file", fix=str(error)) from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, ValueError, RecursionError) as error:
        raise InputError(
            f"measured profile {path.name}", given=str(error), expected="a TOML file", fix="Measure again."
        ) from error
    reader = Reader(path.name, data)
    if reader.get("", "format", int) != FORMAT:
        raise reader.error("format", data["format"], f"{FORMAT}")
    if reader.get("", "provenance", str) != "measured":
        raise reader.error("provenance", data["provenance"], "measured")
    try:
        return MeasuredProfile(
            module=reader.get("", "module", str),
            mode=reader.get("", "power_mode", str),
            model=reader.get("model", "name", str),
            sha256=reader.get("model", "sha256", str),
            precision=reader.get("model", "precision", str),
            batch=reader.get("model", "batch", int),
            shapes=_shapes(reader, reader.group("model").get("shapes", {})),
            latency=_timing(reader, "latency_ms"),
            host_latency=_timing(reader, "host_latency_ms") if "host_latency_ms" in data else None,
            source=reader.get("", "source", str),
            date=reader.get("", "date", datetime),
            harness=reader.get("", "harness", str),
            cuda_graph=reader.get("", "cuda_graph", bool),
            throughput_qps=reader.number("", "throughput_qps"),
            memory_mb=reader.number("", "memory_mb"),
            system_memory_mb=reader.number("", "system_memory_mb"),
            power=_power(reader) if "power_w" in data else None,
            temperature_mean_c=reader.number("temperature_c", "mean", low=-273.15),
            temperature_peak_c=reader.number("temperature_c", "peak", low=-273.15),
            clocks_pinned=reader.maybe("clocks", "pinned", bool),
            gpu_mhz=reader.number("clocks", "gpu_mhz"),
            emc_mhz=reader.number("clocks", "emc_mhz"),
            cpu_mhz=reader.number("clocks", "cpu_mhz"),
            jetpack=reader.maybe("software", "jetpack", str),
            jetson_linux=reader.maybe("software", "jetson_linux", str),
            tensorrt=reader.maybe("software", "tensorrt", str),
            command=reader.maybe("", "command", str),
            notes=reader.texts("", "notes"),
        )
    except InputError as error:
        if error.what.startswith(path.name):
            raise
        raise reader.error(error.what, error.given, error.expected) from error


def directories() -> list[Path]:
    """Return the directories that are searched, first the profile directory's ``measured/``."""
    extra = [Path(part) for part in os.environ.get(DIRECTORIES_VARIABLE, "").split(os.pathsep) if part]
    return [profile_directory() / "measured", *extra]


def find(
    sha256: str,
    slug: str,
    mode: str,
    precision: str,
    harness: str = "trtexec",
    batch: int = 1,
    *,
    cuda_graph: bool = False,
    among: Iterable[str | Path] | None = None,
) -> MeasuredProfile | None:
    """Return the newest measurement of this network on this module, or None.

    Args:
        sha256: of the ONNX file; the empty string (a graph that came from no file) matches nothing.
        slug: of the module.
        mode: power mode; aliases that the catalogue knows and either case are accepted.
        precision, harness, batch, cuda_graph: must match.
        among: directories to search instead of :func:`directories`.

    Raises:
        InputError: for a measured profile of this module that cannot be read.
    """
    wanted = canonical_mode(slug, mode).casefold()
    key = (sha256, precision, harness, batch, cuda_graph)
    found: list[tuple[datetime, str, MeasuredProfile]] = []
    for directory in directories() if among is None else among:
        for path in sorted((Path(directory) / slug).glob("*.toml")):
            profile = load(path)
            same = (profile.sha256, profile.precision, profile.harness, profile.batch, profile.cuda_graph) == key
            if profile.module != slug:
                raise InputError(
                    f"{path.name}: module",
                    given=profile.module,
                    expected=f"{slug}, the name of its folder",
                    fix="Move the file to the folder of its module.",
                )
            if same and canonical_mode(slug, profile.mode).casefold() == wanted:
                found.append((profile.date, str(path), profile))
    return max(found, key=lambda item: item[:2])[2] if found else None


def canonical_mode(slug: str, mode: str) -> str:
    """Return the catalogue's spelling of a power mode, or ``mode`` itself if the catalogue does not know it."""
    from robotbrain.jetson.catalogue import load_module

    try:
        return str(load_module(slug).mode(mode).name)
    except InputError:
        return mode  # a board may run a mode that its owner added to nvpmodel.conf


def _timing(reader: Reader, table_name: str) -> Timing:
    values = {f.name: reader.number(table_name, f.name) for f in fields(Timing)}
    for name in ("median", "mean", "min", "max"):
        if values[name] is None:
            raise reader.error(f"[{table_name}] {name}", None, "milliseconds")
    try:
        return Timing(**values)  # type: ignore[arg-type]  # the required ones were checked above
    except InputError as error:
        raise reader.error(f"[{table_name}]", error.given, error.expected) from error


def _power(reader: Reader) -> Power:
    mean, peak = reader.number("power_w", "mean"), reader.number("power_w", "peak")
    if mean is None or peak is None or peak < mean:
        raise reader.error("[power_w]", {"mean": mean, "peak": peak}, "mean and peak in W, mean at most peak")
    return Power(
        mean,
        peak,
        reader.get("power_w", "samples", int),
        reader.texts("power_w", "rails"),
        reader.get("power_w", "sampler", str),
    )


def _shapes(reader: Reader, shapes: object) -> dict[str, tuple[int, ...]]:
    right = isinstance(shapes, dict) and all(
        isinstance(dims, list) and all(isinstance(d, int) and not isinstance(d, bool) and d >= 0 for d in dims)
        for dims in shapes.values()
    )
    if not isinstance(shapes, dict) or not right:
        raise reader.error("[model.shapes]", shapes, "a list of whole numbers for each input")
    return {str(name): tuple(dims) for name, dims in shapes.items()}


def _check(right: object, what: str, given: object, expected: str) -> None:
    if not right:
        raise InputError(f"measured profile: {what}", given=given, expected=expected, fix="Measure again.")


def _times(timing: Timing | None) -> dict[str, float | None]:
    return {} if timing is None else {f.name: getattr(timing, f.name) for f in fields(Timing)}


def _plain(text: str) -> str:
    return re.sub(r"[^a-z0-9_.]+", "_", text.casefold()).strip("._") or "model"

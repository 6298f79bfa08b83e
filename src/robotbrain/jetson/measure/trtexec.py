"""Reading what ``trtexec`` prints, from TensorRT 7 to 11.

Two layouts of the performance summary exist:

- TensorRT 8.0 and later print one line for each metric: ``GPU Compute Time: min = 1.2 ms, max = ... percentile(99%) =
  ...``. 8.0 to 8.2 add an ``End-to-End Host Latency``; 8.5 and later print three percentiles.
- TensorRT 7 prints a heading (``Host Latency``, ``Enqueue Time``, ``GPU Compute``) and below it ``min: 1.2 ms`` and so
  on; its throughput reads 0 for networks with explicit batch, which is no measurement and is left out.

Where each was seen is listed in ``tests/data/jetson_logs/README.md``.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime

from robotbrain.errors import InputError
from robotbrain.jetson.measured import Timing

METRICS = {
    "latency": "host",
    "end-to-end host latency": "end_to_end",
    "enqueue time": "enqueue",
    "h2d latency": "host_to_device",
    "gpu compute time": "gpu",
    "d2h latency": "device_to_host",
}
"""Metrics of TensorRT 8 and later, by the name in the log."""

OLD_METRICS = {"host latency": "host", "enqueue time": "enqueue", "gpu compute": "gpu"}
"""Metrics of TensorRT 7, by the heading in the log."""

_NUMBER = r"[-+]?(?:\d+\.?\d*(?:[eE][-+]?\d+)?|inf|nan)"
_PREFIX = re.compile(r"(?:\[(\d\d/\d\d/\d{4}-\d\d:\d\d:\d\d)\] )?\[([VIWEF])\] ?(?:\[TRT\] )?")
_BANNER = re.compile(
    r"&&&& (RUNNING|PASSED|FAILED|WAIVED) TensorRT\.trtexec(?: \[TensorRT v([\d.]+)\])?(?: \[b\d+\])?(?: # (.*))?"
)
_METRIC = re.compile(r"([A-Za-z0-9 -]+): (min = .*)")
_FIELD = re.compile(rf"(min|max|mean|median|percentile\((\d+(?:\.\d+)?)%\)) = ({_NUMBER}) ms(?=,|$)")
_OLD_FIELD = re.compile(rf"(min|max|mean|median|percentile): ({_NUMBER}) ms(?: at (\d+(?:\.\d+)?)%)?(?: \(.*\))?$")
_SCALAR = re.compile(rf"(Throughput|throughput|Total Host Walltime|walltime): ({_NUMBER}) (?:qps|s)$")
_BINDING = re.compile(r"(?:Created input|Input) binding for (.+) with dimensions ([\dx]*)(?: is created\.?)?$")
_INPUT_SHAPE = re.compile(r"Input inference shape ?: (.+)=([\dx]+)$")
_MEMORY = re.compile(
    r"\[MemUsageChange\] TensorRT-managed allocation in IExecutionContext creation: "
    r".*now: CPU \d+, GPU (\d{1,9}) \(MiB\)"
)
_QUERIES = re.compile(r"Timing trace has (\d{1,12}) queries over ")
_MAX_LINE = 20_000


@dataclass(frozen=True)
class TrtexecReport:
    """What a log says.

    Attributes:
        timings: statistics by metric: ``gpu`` always; ``host``, ``enqueue``, ``host_to_device``, ``device_to_host``,
            ``end_to_end`` where printed. Milliseconds.
        throughput_qps: queries per second.
        walltime_s: over which the queries were timed.
        queries: how many were timed; None in logs of TensorRT 7, which count 0.
        version: of TensorRT, e.g. ``10.3.0``.
        command: as trtexec repeats it.
        passed: whether trtexec said PASSED; None if the log ends before.
        precision: ``fp32``, ``fp16`` or ``int8`` as asked for; None if the log does not say (engine loaded).
        shapes: of the inputs, by name.
        implicit_batch: ``--batch`` of an engine whose shapes leave the batch out (before TensorRT 10).
        cuda_graph, data_transfers: options of the run; None if not printed.
        memory_mb: device memory held by TensorRT, MiB.
        started, ended: first and last time stamp of the inference phase, in the board's local time.
        warnings: warnings of the performance summary.
    """

    timings: Mapping[str, Timing]
    throughput_qps: float | None = None
    walltime_s: float | None = None
    queries: int | None = None
    version: str | None = None
    command: str | None = None
    passed: bool | None = None
    precision: str | None = None
    shapes: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    implicit_batch: int | None = None
    cuda_graph: bool | None = None
    data_transfers: bool | None = None
    memory_mb: float | None = None
    started: datetime | None = None
    ended: datetime | None = None
    warnings: tuple[str, ...] = ()

    @property
    def date(self) -> datetime | None:
        """When it was timed. The board's zone is not in the log; its clock is taken for UTC."""
        stamp = self.ended or self.started
        return None if stamp is None else stamp.replace(tzinfo=UTC)

    @property
    def batch(self) -> int | None:
        """Inputs in one query: the first dimension that all shapes share; None if they differ or are not known."""
        if self.implicit_batch is not None:
            return self.implicit_batch
        sizes = {dims[0] for dims in self.shapes.values() if dims}
        return sizes.pop() if len(sizes) == 1 else None


@dataclass
class _Scan:
    """What was read so far."""

    numbers: dict[str, dict[str, float]] = field(default_factory=dict)
    scalars: dict[str, float] = field(default_factory=dict)
    options: dict[str, str] = field(default_factory=dict)
    shapes: dict[str, tuple[int, ...]] = field(default_factory=dict)
    errors: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    version: str | None = None
    command: str | None = None
    verdict: str | None = None
    runs: int = 0
    memory_mb: float | None = None
    queries: int | None = None
    started: datetime | None = None
    ended: datetime | None = None
    section: str | None = None
    in_summary: bool = False


def parse(text: str) -> TrtexecReport:
    """Return what one run's log says.

    Raises:
        InputError: if the run failed (with its own reason), if the log ends before the performance summary, holds
            several runs, or holds numbers that contradict each other.
    """
    scan = _Scan()
    for line in text.splitlines():
        _line(scan, line[:_MAX_LINE].strip())
    if scan.runs > 1:
        raise InputError(
            "trtexec log", given=f"{scan.runs} runs", expected="one run", fix="Cut the log at `&&&& RUNNING`."
        )
    if scan.verdict == "FAILED" or (scan.errors and "gpu" not in scan.numbers):
        raise InputError(
            "trtexec",
            given=" | ".join(scan.errors[:3]) or "&&&& FAILED",
            expected="a run that ends in &&&& PASSED",
            fix=_advice(scan.errors),
        )
    timings = {name: timing for name, found in scan.numbers.items() if (timing := _timing(name, found)) is not None}
    if "gpu" not in timings:
        raise InputError(
            "trtexec log",
            given=text.strip()[-80:],
            expected="a performance summary with GPU Compute Time (min, max, mean, median)",
            fix="The log is cut off, or it is not trtexec's: record all of it with `trtexec ... 2>&1 | tee LOG`.",
        )
    batch = _implicit_batch(scan.command or "")
    throughput = scan.scalars.get("throughput") or None
    if throughput is not None and batch is not None:
        throughput /= batch  # with an implicit batch, trtexec counts inputs, not queries
    return TrtexecReport(
        timings=timings,
        throughput_qps=throughput,
        walltime_s=scan.scalars.get("walltime"),
        queries=scan.queries,
        version=scan.version,
        command=scan.command,
        passed={"PASSED": True}.get(scan.verdict or ""),
        precision=_precision(scan),
        shapes=scan.shapes,
        implicit_batch=batch,
        cuda_graph=_enabled(scan.options.get("cuda graph")),
        data_transfers=_enabled(scan.options.get("data transfers")),
        memory_mb=scan.memory_mb,
        started=scan.started,
        ended=scan.ended,
        warnings=tuple(scan.warnings),
    )


def version_of(number: int) -> str:
    """Return the version that a banner's number stands for: 8201 is 8.2.1, 100300 is 10.3.0."""
    step = 100 if number >= 100_000 else 10
    major, rest = divmod(number, 100 * step)
    return f"{major}.{rest // 100}.{rest % 100}"


def banner_version(text: str | None) -> str | None:
    """Return the version in a banner: a number (8201) or, in some of TensorRT 11, words with dots (11.1.0.106)."""
    if not text or len(text) > 20:
        return None
    return version_of(int(text)) if text.isdecimal() else text if re.fullmatch(r"\d+(\.\d+)+", text) else None


def _line(scan: _Scan, line: str) -> None:
    banner = _BANNER.match(line)
    if banner is not None:
        word, number, command = banner.groups()
        scan.runs += word == "RUNNING"
        scan.verdict = word if word != "RUNNING" else scan.verdict
        scan.version = banner_version(number) or scan.version
        scan.command = command or scan.command
        return
    prefix = _PREFIX.match(line)
    level = "I" if prefix is None else prefix.group(2)
    body = line if prefix is None else line[prefix.end() :].strip()
    if level in "EF":
        scan.errors.append(body[:300])
        return
    if level == "W":
        scan.warnings += [body[:300]] if scan.in_summary else []
        return
    if level == "I":
        _phase(scan, body, prefix.group(1) if prefix is not None else None)
        if not _result(scan, body):
            _setting(scan, body)


def _phase(scan: _Scan, body: str, stamp: str | None) -> None:
    if body.startswith(("=== Performance summary", "Host Latency")):
        scan.in_summary = True
    starts = body.startswith("Starting inference")
    ends = body.startswith(("Timing trace has", "=== Performance summary"))
    if stamp is None or not (starts or ends):
        return
    try:
        time = datetime.strptime(stamp, "%m/%d/%Y-%H:%M:%S")
    except ValueError:
        return
    if starts:
        scan.started = time
    else:
        scan.ended = scan.ended or time


def _result(scan: _Scan, body: str) -> bool:
    """Read a line of the performance summary; say whether it was one."""
    metric = _METRIC.match(body)
    if metric is not None and metric.group(1).strip().casefold() in METRICS:
        found = {_name(name, percent): float(value) for name, percent, value in _FIELD.findall(metric.group(2))}
        scan.numbers[METRICS[metric.group(1).strip().casefold()]] = found
        return True
    if body.casefold() in OLD_METRICS:
        scan.section = OLD_METRICS[body.casefold()]
        scan.numbers.setdefault(scan.section, {})
        return True
    old = _OLD_FIELD.match(body)
    if old is not None and scan.section is not None:
        name, value, percent = old.groups()
        scan.numbers[scan.section][_name(name, percent)] = float(value)
        return True
    scalar = _SCALAR.match(body)
    if scalar is not None:
        value = float(scalar.group(2))
        name = "throughput" if scalar.group(1).casefold() == "throughput" else "walltime"
        if not math.isfinite(value) or value < 0:
            raise InputError(f"trtexec log: {name}", given=value, expected="a number, 0 or more", fix="Measure again.")
        scan.scalars[name] = value
        return True
    return False


def _setting(scan: _Scan, body: str) -> None:
    shape = _BINDING.match(body) or _INPUT_SHAPE.match(body)
    if shape is not None:
        dims = tuple(int(part) for part in shape.group(2).split("x") if part and len(part) < 10)
        scan.shapes[shape.group(1).strip()] = dims
        return
    memory = _MEMORY.match(body)
    if memory is not None:
        scan.memory_mb = float(memory.group(1))
        return
    queries = _QUERIES.match(body)
    if queries is not None:
        scan.queries = int(queries.group(1)) or None
        return
    if body.startswith("TensorRT version: "):
        word = body.removeprefix("TensorRT version: ").strip()
        if re.fullmatch(r"\d+(?:\.\d+)+", word):
            scan.version = word
        return
    name, colon, value = body.partition(": ")
    if colon and name.casefold() in ("precision", "cuda graph", "data transfers", "load engine"):
        scan.options.setdefault(name.casefold(), value.strip())


def _name(name: str, percent: str | None) -> str:
    return f"p{float(percent):g}" if name.startswith("percentile") and percent else name


def _timing(name: str, found: Mapping[str, float]) -> Timing | None:
    if not {"min", "max", "mean", "median"} <= found.keys():
        return None  # TensorRT 7 prints no mean of the enqueue time
    try:
        return Timing(
            found["median"], found["mean"], found["min"], found["max"], *(found.get(p) for p in ("p90", "p95", "p99"))
        )
    except InputError as error:
        if name != "gpu":
            return None  # the others are extras; enqueue times of some versions mix two clocks
        raise InputError(
            "trtexec log: GPU Compute Time", given=error.given, expected=error.expected, fix=error.fix
        ) from error


def _precision(scan: _Scan) -> str | None:
    if scan.options.get("load engine") or "--loadEngine" in (scan.command or ""):
        return None  # some versions print FP32 then, whatever the engine holds
    text = scan.options.get("precision", "")
    return next((name for name in ("int8", "fp16", "fp32") if name in text.casefold()), None)


def _implicit_batch(command: str) -> int | None:
    found = re.search(r"--batch=([1-9]\d{0,5})(?:\s|$)", command)
    return int(found.group(1)) if found and "--onnx" not in command else None


def _enabled(text: str | None) -> bool | None:
    return {"Enabled": True, "Disabled": False}.get(text or "")


def _advice(errors: Iterable[str]) -> str:
    text = " ".join(errors).casefold()
    if "unknown option" in text:
        return "This version of trtexec lacks the option: run `robotbrain jetson measure`, which asks it what it has."
    if "out of memory" in text or "allocat" in text:
        return "The board ran out of memory: close other programs, give it swap, or take a smaller batch or input."
    if "parse" in text or "onnx" in text:
        return "TensorRT does not take this ONNX: export it with another opset, or simplify it."
    if "deserializ" in text or "serialization" in text:
        return "The engine was built by another version of TensorRT or for another GPU: build it on this board."
    return "See the lines marked [E] in the log."

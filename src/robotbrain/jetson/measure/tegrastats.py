"""Reading what ``tegrastats`` prints, from JetPack 4 (Nano, TX2, Xavier) to JetPack 7 (Orin, Thor).

A line is a sequence of fields that differ by board and release. What varies, with an example of each:

- time stamp: none (JetPack 4), ``05-17-2026 10:00:32`` (JetPack 5 and later);
- rails: ``VDD_IN 4067/4067`` in mW (JetPack 4), ``VDD_IN 5299mW/5299mW`` (5), current, mean and peak (7.2);
- sensors: ``GPU@36C`` (4, 5), ``gpu@47.812C`` (6), ``gpu@46.8C/46.9C`` (7.2), ``CV0@-256C`` when powered off;
- GPU: ``GR3D_FREQ 0%@76``, ``0%`` without its clock, ``0%@[305,305]`` per cluster, ``@[0,0,0]`` without load (Thor).

Where each was seen is listed in ``tests/data/jetson_logs/README.md``.
"""

from __future__ import annotations

import re
import statistics
from dataclasses import dataclass
from datetime import datetime

from robotbrain.errors import InputError
from robotbrain.jetson.measure.samples import Sample

_STAMP = re.compile(r"(\d\d-\d\d-\d{4} \d\d:\d\d:\d\d)\s")
_RAM = re.compile(r"(?:^|\s)RAM (\d{1,9})/(\d{1,9})MB(?=\s|$)")
_CPU = re.compile(r"\sCPU \[([^\]]*)\]")
_CORE = re.compile(r"(?<!\d)\d{1,3}%@(\d{1,6})(?!\d)")
_ENGINE = r"(?: (\d{1,3})%)?(?:\s?@(?:\[([\d,]{0,99})\]|(\d{1,6})))?(?=\s|$)"
_GPU = re.compile(r"\sGR3D_FREQ" + _ENGINE)
_EMC = re.compile(r"\sEMC_FREQ" + _ENGINE)
_SENSOR = re.compile(r"\s([A-Za-z][\w.]*)@(-?\d{1,3}(?:\.\d+)?)C(?:/-?\d+(?:\.\d+)?C)?(?=\s|$)")
_RAIL = re.compile(r"\s([A-Z][A-Z0-9_]*)\s(-?\d{1,7})(mW|)/-?\d+\3(?:/-?\d+\3)?(?=\s|$)")

_LONGEST = 4000  # characters; a board with 14 cores prints 700. Also bounds the time of a search.
_OFF_C = -200.0  # a sensor that is powered off reads -256


@dataclass(frozen=True)
class TegrastatsLog:
    """The readings of a log and how many of its lines were not readings."""

    samples: tuple[Sample, ...]
    skipped: int


def parse_line(line: str) -> Sample:
    """Return the reading in one line.

    Raises:
        InputError: if the line does not have the RAM and the CPU field that every tegrastats prints.
    """
    text = " " + line.strip()[:_LONGEST]
    ram, cpu = _RAM.search(text), _CPU.search(text)
    if ram is None or cpu is None:
        raise InputError(
            "tegrastats line",
            given=line.strip(),
            expected="RAM <used>/<total>MB ... CPU [...] ...",
            fix="Record with `sudo tegrastats --interval 200 --logfile FILE`.",
        )
    rest = text[: cpu.start()] + text[cpu.end() :]
    load, gpu_mhz = _engine(_GPU, rest)
    cores = [float(mhz) for mhz in _CORE.findall(cpu.group(1))]
    return Sample(
        time=_stamp(text),
        # "NC" is a monitor's channel that nothing is connected to
        rails_w={name: float(mw) / 1000 for name, mw, _ in _RAIL.findall(rest) if name != "NC"},
        temperatures_c={name: float(c) for name, c in _SENSOR.findall(rest) if float(c) > _OFF_C},
        gpu_mhz=gpu_mhz,
        emc_mhz=_engine(_EMC, rest)[1],
        cpu_mhz=statistics.fmean(cores) if cores else None,
        gpu_load=load,
        ram_used_mb=float(ram.group(1)),
        ram_total_mb=float(ram.group(2)),
    )


def parse_log(text: str) -> TegrastatsLog:
    """Return all readings of a log; lines that are not readings are skipped and counted.

    Raises:
        InputError: if there is none.
    """
    samples: list[Sample] = []
    skipped = 0
    for line in text.splitlines():
        if not line.strip():
            continue
        try:
            samples.append(parse_line(line))
        except InputError:
            skipped += 1
    if not samples:
        raise InputError(
            "tegrastats log",
            given=text.strip()[:80],
            expected="at least one line RAM <used>/<total>MB ... CPU [...] ...",
            fix="Record with `sudo tegrastats --interval 200 --logfile FILE`.",
        )
    return TegrastatsLog(tuple(samples), skipped)


def _stamp(text: str) -> datetime | None:
    match = _STAMP.match(text.lstrip())
    if match is None:
        return None
    try:
        return datetime.strptime(match.group(1), "%m-%d-%Y %H:%M:%S")
    except ValueError:
        return None  # e.g. month 13: a line cut and glued together


def _engine(pattern: re.Pattern[str], text: str) -> tuple[float | None, float | None]:
    match = pattern.search(text)
    if match is None:
        return None, None
    load = None if match.group(1) is None else min(1.0, float(match.group(1)) / 100)
    clusters = [float(part) for part in (match.group(2) or match.group(3) or "").split(",") if part]
    # Clusters of the GPU that are gated read 0; without any clock there is nothing to report.
    return load, max(clusters, default=0.0) or None

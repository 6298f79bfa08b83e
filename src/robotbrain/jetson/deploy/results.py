"""What a board wrote back: its result folder, checked and turned into a measured profile."""

from __future__ import annotations

import re
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from robotbrain.errors import InputError
from robotbrain.jetson.catalogue import load_module
from robotbrain.jetson.deploy.contents import read, refuse
from robotbrain.jetson.deploy.manifest import read_json
from robotbrain.jetson.deploy.verify import check_files
from robotbrain.jetson.measure import tegrastats, trtexec
from robotbrain.jetson.measure.profile import Model, Setting, make_profile
from robotbrain.jetson.measure.samples import Telemetry, summarise, within
from robotbrain.jetson.measured import MeasuredProfile

RESULT, DIGEST = "result.json", "result.sha256"
"""The two files of a result that it does not list itself."""

_SHA = re.compile(r"[0-9a-f]{64}")
_NAME = re.compile(r"run_\d{1,4}\.(?:trtexec|tegrastats)\.log")

FORM: Mapping[str, Any] = {
    "schema": str,
    "version": int,
    "kit": str,
    "date": re.compile(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\dZ"),
    "bundle_sha256": _SHA,
    "name": re.compile(r"[A-Za-z0-9_][A-Za-z0-9_-]{0,60}"),
    "network_sha256": _SHA,
    "module": str,
    "mode": str,
    "precision": str,
    "shapes": {"*": [int]},
    "jetpack": str,
    "jetson_linux": (str, type(None)),
    "tensorrt": str,
    "python": str,
    "board": {"model": str, "parts": [str], "memory_mb": (int, type(None))},
    "engine": {"key": str, "sha256": _SHA, "bytes": int, "flags": [str]},
    "clocks_pinned": (bool, type(None)),
    "cuda_graph": bool,
    "runs": [{"trtexec": _NAME, "tegrastats": (None, _NAME)}],
    "numerics": [
        {"vector": int, "output": str, "positions": int} | dict.fromkeys(("rms", "peak", "agreement"), (float, int))
    ],
    "notes": [str],
    "files": {"*": {"bytes": int, "sha256": _SHA}},
}
"""What a result holds (see manifest.FORM)."""


def profile_from_result(path: str | Path, source: str | None = None) -> MeasuredProfile:
    """Return the measured profile of the median run in a result folder.

    Args:
        path: the folder ``result`` that the board's program wrote.
        source: who measured, for the profile.

    Raises:
        InputError: for a result that is altered or incomplete, or whose logs say something else than it does.
    """
    contents = read(path)
    data = read_json(contents.files, RESULT, DIGEST, FORM)
    if (data["schema"], data["version"]) != ("robotbrain-result", 1):
        raise refuse("result", f"{data['schema']} {data['version']}", "robotbrain-result 1", "Update the kit.")
    check_files({name: c for name, c in contents.files.items() if name not in (RESULT, DIGEST)}, data["files"])
    try:
        # By the board's clock, which may be wrong without a network.
        date = datetime.strptime(data["date"], "%Y-%m-%dT%H:%M:%SZ").replace(tzinfo=UTC)
    except ValueError as error:
        raise refuse("result", data["date"], "a date of the calendar") from error
    if not data["runs"] or not data["numerics"]:
        raise refuse("result", "no run, or numbers that were not checked", "both", "Run `sh run.sh` on the board.")
    load_module(data["module"]).mode(data["mode"])
    reports = [trtexec.parse(_text(contents.files, run["trtexec"])) for run in data["runs"]]
    medians = [report.timings["gpu"].median for report in reports]
    middle = sorted(range(len(medians)), key=lambda index: (medians[index], index))[(len(medians) - 1) // 2]
    report, sensors = reports[middle], data["runs"][middle]["tegrastats"]
    if report.version is not None and report.version != data["tensorrt"]:
        raise refuse("result", f"a log of TensorRT {report.version}", f"{data['tensorrt']}, as result.json says")
    if report.cuda_graph is not None and report.cuda_graph != data["cuda_graph"]:
        raise refuse(
            "result", f"CUDA graph {report.cuda_graph} in the log", f"{data['cuda_graph']}, as result.json says"
        )
    notes = [*data["notes"], "median of runs: " + ", ".join(f"{value:.4g}" for value in medians) + " ms"]
    notes.append(f"outputs checked on the board, worst relative error {max(r['rms'] for r in data['numerics']):.2g}")
    telemetry = None
    if sensors is not None:
        telemetry = _telemetry(report, tegrastats.parse_log(_text(contents.files, sensors)))
    shapes = {name: tuple(shape) for name, shape in data["shapes"].items()}
    setting = Setting(
        module=data["module"],
        mode=data["mode"],
        source=f"{source or 'robotbrain ' + data['kit']}: bundle {data['bundle_sha256'][:12]} on "
        f"{data['board']['model'] or data['module']}",
        date=date,
        precision=data["precision"],
        typed=True,  # the engine was built before; its log cannot say the precision
        shapes=shapes,
        clocks_pinned=data["clocks_pinned"],
        jetpack=data["jetpack"],
        jetson_linux=data["jetson_linux"],
        notes=notes,
    )
    return make_profile(report, Model(data["name"], data["network_sha256"], shapes), setting, telemetry)


def _telemetry(report: trtexec.TrtexecReport, log: tegrastats.TegrastatsLog) -> Telemetry:
    """Summarise the readings while the network was timed; without times all count, for the engine was only loaded."""
    samples = list(log.samples)
    if report.started is not None and report.ended is not None and any(sample.time for sample in samples):
        samples = within(samples, report.started, report.ended)
    return summarise(samples, "tegrastats")


def _text(files: Mapping[str, bytes], name: str) -> str:
    if name not in files:
        raise InputError(f"result: {name}", given="no such file", expected="the log of each run", fix="Copy it again.")
    return files[name].decode("utf-8", "replace")

"""Making a measured profile from a trtexec log and a summary of the sensors."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from robotbrain.errors import InputError
from robotbrain.jetson.measure.samples import Telemetry
from robotbrain.jetson.measure.trtexec import TrtexecReport
from robotbrain.jetson.measured import MeasuredProfile, canonical_mode


@dataclass(frozen=True)
class Model:
    """The network that was timed: its name, the checksum of its file, and the shapes of its inputs as far as known."""

    name: str
    sha256: str
    shapes: Mapping[str, tuple[int, ...]]

    @staticmethod
    def from_file(path: Path) -> Model:
        """Read an ONNX file (not its weights, if they lie in a file beside it).

        Raises:
            InputError: if it is not there or not valid.
        """
        import onnx

        if not path.is_file():
            raise InputError("model", given=str(path), expected="the path of an ONNX file", fix="Check the path.")
        content = path.read_bytes()
        try:
            graph = onnx.load_model_from_string(content).graph
        except Exception as error:  # protobuf's own, without a public base
            raise InputError(
                "model", given=str(path), expected="a valid ONNX file", fix=str(error).partition("\n")[0][:200]
            ) from error
        weights = {tensor.name for tensor in graph.initializer}
        shapes = {value.name: _static(value) for value in graph.input if value.name not in weights}
        known = {name: dims for name, dims in shapes.items() if dims is not None}
        return Model(path.stem, hashlib.sha256(content).hexdigest(), known)


@dataclass(frozen=True)
class Setting:
    """Where and how it was timed, as far as the log does not say."""

    module: str
    mode: str
    source: str
    date: datetime | None = None
    precision: str | None = None
    typed: bool = False
    shapes: Mapping[str, tuple[int, ...]] | None = None
    clocks_pinned: bool | None = None
    jetpack: str | None = None
    jetson_linux: str | None = None
    notes: Sequence[str] = ()


def make_profile(report: TrtexecReport, model: Model, setting: Setting, telemetry: Telemetry | None) -> MeasuredProfile:
    """Return the profile.

    Raises:
        InputError: if the log and the setting contradict each other, or neither says precision or shapes.
    """
    precision = _precision(report, setting)
    shapes = dict(setting.shapes or {}) or dict(report.shapes) or dict(model.shapes)
    clash = {n: (s, report.shapes[n]) for n, s in shapes.items() if report.shapes.get(n, s) != s}
    if clash:
        raise InputError("--shape", given=clash, expected="the shapes in the log", fix="Is this the log of this run?")
    sizes = {dims[0] for dims in shapes.values() if dims} if report.implicit_batch is None else {report.implicit_batch}
    if len(sizes) != 1:
        raise InputError(
            "batch",
            given=shapes or "no shapes",
            expected="inputs that share their first dimension",
            fix="Name the shapes that were timed, with --shape name:1x3x224x224.",
        )
    notes = [*setting.notes, *(f"trtexec warns: {text.lstrip('* ')}" for text in report.warnings)]
    if report.date is None and setting.date is None:
        notes.append("the log has no date: the time it was read is stated instead")
    if telemetry is not None and not telemetry.samples:
        notes.append("no reading of the sensors fell into the time of the inferences")
    elif telemetry is not None and telemetry.power is None:
        notes.append("the readings name no rails of the module, so its power is not known")
    return MeasuredProfile(
        module=setting.module,
        mode=canonical_mode(setting.module, setting.mode),
        model=model.name,
        sha256=model.sha256,
        precision=precision,
        latency=report.timings["gpu"],
        source=setting.source,
        date=setting.date or report.date or datetime.now(UTC),
        batch=sizes.pop(),
        cuda_graph=report.cuda_graph or False,
        shapes=shapes,
        host_latency=report.timings.get("host") if report.data_transfers is not False else None,
        throughput_qps=report.throughput_qps,
        memory_mb=report.memory_mb,
        system_memory_mb=None if telemetry is None else telemetry.system_memory_mb,
        power=None if telemetry is None else telemetry.power,
        temperature_mean_c=None if telemetry is None else telemetry.temperature_mean_c,
        temperature_peak_c=None if telemetry is None else telemetry.temperature_peak_c,
        clocks_pinned=setting.clocks_pinned,
        gpu_mhz=None if telemetry is None else telemetry.gpu_mhz,
        emc_mhz=None if telemetry is None else telemetry.emc_mhz,
        cpu_mhz=None if telemetry is None else telemetry.cpu_mhz,
        jetpack=setting.jetpack,
        jetson_linux=setting.jetson_linux,
        tensorrt=report.version,
        command=report.command,
        notes=tuple(notes),
    )


def _precision(report: TrtexecReport, setting: Setting) -> str:
    found, asked = report.precision, setting.precision
    if found is None and asked is None:
        raise InputError(
            "precision",
            given="a log that does not say (it loads a finished engine)",
            expected="fp32, fp16 or int8",
            fix="Name the engine's precision with --precision.",
        )
    if found is not None and asked is not None and found != asked and not setting.typed:
        raise InputError(
            "--precision",
            given=asked,
            expected=f"{found}, which the log says",
            fix="Leave it out, or add --typed if the ONNX itself carries another precision.",
        )
    return asked or found or ""


def _static(value: Any) -> tuple[int, ...] | None:
    dims = value.type.tensor_type.shape.dim
    sizes = [dim.dim_value if dim.HasField("dim_value") else 0 for dim in dims]
    return tuple(sizes) if sizes and all(size > 0 for size in sizes) else None

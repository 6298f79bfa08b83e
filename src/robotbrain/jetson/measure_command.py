"""``robotbrain jetson measure``: time a network on the Jetson this runs on, or read logs recorded on one."""

from __future__ import annotations

import argparse
import os
import re
import sys
from pathlib import Path

from robotbrain import __version__
from robotbrain.errors import InputError
from robotbrain.jetson import measured
from robotbrain.jetson.kernels import PRECISIONS
from robotbrain.jetson.measure import board as boards
from robotbrain.jetson.measure import nvpmodel, tegrastats, trtexec
from robotbrain.jetson.measure.command import Request, build_command, parse_shapes
from robotbrain.jetson.measure.profile import Model, Setting, make_profile
from robotbrain.jetson.measure.samples import Telemetry, summarise, within
from robotbrain.jetson.measured import MeasuredProfile

CURRENT = "current"
"""Stands for the power mode that the board is in."""


def measure_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``robotbrain jetson measure``."""
    parser.add_argument("model", type=Path, nargs="?", metavar="MODEL.onnx", help="the network")
    parser.add_argument(
        "--precision", type=str.lower, choices=PRECISIONS, help="default: fp16 on a board, what a log says with logs"
    )
    parser.add_argument("--mode", default=CURRENT, help="power mode; on a board it must be the one that is set")
    parser.add_argument(
        "--device", type=str.lower, metavar="SLUG", help="module; found out on a board, required with --from-logs"
    )
    parser.add_argument(
        "--shape", action="append", default=[], metavar="NAME:1x3x224x224", help="shape of an input with dynamic axes"
    )
    parser.add_argument("--output", type=Path, metavar="DIR", help="default: where profiles are looked for")
    parser.add_argument("--source", metavar="TEXT", help="who measured, for the profile")
    parser.add_argument("--typed", action="store_true", help="the ONNX carries its precision itself (TensorRT 10, 11)")
    board = parser.add_argument_group("on a board")
    board.add_argument("--iterations", type=int, default=100, help="at least so many inferences (default: 100)")
    board.add_argument("--duration", type=int, default=10, metavar="S", help="at least so long (default: 10 s)")
    board.add_argument("--cuda-graph", action="store_true", help="launch through a CUDA graph")
    board.add_argument("--data-transfers", action="store_true", help="copy input and output for every inference")
    board.add_argument("--workspace", type=int, metavar="MIB", help="the builder's workspace")
    board.add_argument("--save-engine", metavar="FILE", help="keep the engine")
    board.add_argument("--trtexec", metavar="FILE", help="default: on PATH, or where JetPack puts it")
    board.add_argument("--keep-logs", action="store_true", help="keep trtexec's log beside the profile")
    logs = parser.add_argument_group("from logs recorded on a board, on any machine")
    logs.add_argument("--from-logs", type=Path, metavar="TRTEXEC.log", help="what trtexec printed")
    logs.add_argument("--tegrastats", type=Path, metavar="LOG", help="what tegrastats printed meanwhile")
    logs.add_argument("--jetpack", metavar="VERSION", help="for the profile")
    logs.add_argument("--from-bundle", type=Path, metavar="RESULT", help="what the program of a bundle wrote back")


def measure_main(arguments: argparse.Namespace) -> int:
    """Make a measured profile and say where it is; 130 if interrupted."""
    if arguments.from_bundle is not None:
        profile = _from_bundle(arguments)
    elif arguments.model is None:
        raise InputError("MODEL.onnx", given=None, expected="the network", fix="Name its ONNX file.")
    elif arguments.from_logs is not None:
        profile = _from_logs(arguments)
    else:
        if arguments.tegrastats is not None:
            raise InputError(
                "--tegrastats", given=str(arguments.tegrastats), expected="--from-logs beside it", fix="Add it."
            )
        found = _on_board(arguments)
        if found is None:
            return 130
        profile = found
    path = profile.write(_output(arguments))
    print(_summary(profile))
    print(f"written: {path}")
    directory = path.parents[1]
    if directory.resolve() not in [known.resolve() for known in measured.directories()]:
        print(f"It takes effect where {measured.DIRECTORIES_VARIABLE} names {directory}.")
    return 0


def _from_bundle(arguments: argparse.Namespace) -> MeasuredProfile:
    from robotbrain.jetson.deploy import profile_from_result

    named = {"--from-logs": arguments.from_logs, "--tegrastats": arguments.tegrastats, "--device": arguments.device}
    if any(value is not None for value in named.values()) or arguments.mode != CURRENT:
        raise InputError(
            "robotbrain jetson measure --from-bundle",
            given="--mode or " + ", ".join(name for name, value in named.items() if value is not None),
            expected="none of them: the result says",
            fix="Leave them out.",
        )
    profile = profile_from_result(arguments.from_bundle, arguments.source)
    if arguments.model is not None and Model.from_file(arguments.model).sha256 != profile.sha256:
        raise InputError(
            "model",
            given=str(arguments.model),
            expected=f"the network that was measured, SHA-256 {profile.sha256[:12]}...",
            fix="Leave it out, or name the ONNX file that the bundle was made of.",
        )
    return profile


def _from_logs(arguments: argparse.Namespace) -> MeasuredProfile:
    from robotbrain.jetson.catalogue import load_module

    if arguments.device is None or arguments.mode == CURRENT:
        raise InputError(
            "robotbrain jetson measure --from-logs",
            given={"--device": arguments.device, "--mode": None if arguments.mode == CURRENT else arguments.mode},
            expected="the module and its power mode; logs do not say",
            fix="Add for example --device orin-nano-8gb --mode 15W (`sudo nvpmodel -q` on the board says the mode).",
        )
    load_module(arguments.device)  # an unknown slug is refused, with a suggestion
    report = trtexec.parse(_read(arguments.from_logs))
    telemetry: Telemetry | None = None
    notes: list[str] = []
    if arguments.tegrastats is not None:
        telemetry, notes = _telemetry(report, tegrastats.parse_log(_read(arguments.tegrastats)))
    if report.date is not None:
        notes.append("the date is by the board's own clock")
    source = arguments.source or "log"
    files = ", ".join(p.name for p in (arguments.from_logs, arguments.tegrastats) if p is not None)
    setting = Setting(
        module=arguments.device,
        mode=arguments.mode,
        source=f"{source}: {files}",
        precision=arguments.precision,
        typed=arguments.typed,
        shapes=parse_shapes(arguments.shape),
        jetpack=arguments.jetpack,
        notes=notes,
    )
    return make_profile(report, Model.from_file(arguments.model), setting, telemetry)


def _telemetry(report: trtexec.TrtexecReport, log: tegrastats.TegrastatsLog) -> tuple[Telemetry, list[str]]:
    notes = [f"{log.skipped} lines of the tegrastats log were no readings"] if log.skipped else []
    samples = list(log.samples)
    if report.started is not None and report.ended is not None:
        timed = within(samples, report.started, report.ended)
        if timed:
            return summarise(timed, "tegrastats"), notes
        if any(sample.time is not None for sample in samples):
            raise InputError(
                "tegrastats log",
                given=f"readings from {samples[0].time} to {samples[-1].time}",
                expected=f"readings between {report.started} and {report.ended}, when the network was timed",
                fix="Record tegrastats while trtexec runs.",
            )
    notes.append("tegrastats readings without time: the building of the engine is averaged in")
    return summarise(samples, "tegrastats"), notes


def _on_board(arguments: argparse.Namespace) -> MeasuredProfile | None:
    from robotbrain.jetson.measure import run

    board = boards.read_board()
    if not board.is_jetson:
        looked_for = ["/proc/device-tree/compatible with nvidia,tegra", "/etc/nv_tegra_release", "trtexec"]
        raise boards.not_a_jetson(board, looked_for)
    program = run.find_trtexec(arguments.trtexec)
    if program is None:
        raise InputError(
            "trtexec",
            given=arguments.trtexec,
            expected="trtexec on PATH or at " + run.TRTEXEC_PLACES[0],
            fix="Install it with `sudo apt install libnvinfer-bin`, or name it with --trtexec.",
        )
    module = boards.require_slug(board, arguments.device)
    mode = _mode(module, run.ask(["nvpmodel", "-q"]), arguments.mode)
    clocks = nvpmodel.parse_clocks(run.ask(["jetson_clocks", "--show"]))
    pinned = None if clocks is None else clocks.pinned
    notes = _warn(pinned)
    model = Model.from_file(arguments.model)
    request = Request(
        onnx=str(arguments.model),
        precision=arguments.precision or "fp16",
        shapes=parse_shapes(arguments.shape),
        iterations=arguments.iterations,
        duration_s=arguments.duration,
        workspace_mb=arguments.workspace,
        cuda_graph=arguments.cuda_graph,
        data_transfers=arguments.data_transfers,
        save_engine=arguments.save_engine,
        typed=arguments.typed,
    )
    command = build_command([program], run.capabilities_of([program]), request)
    sampler = run.choose_sampler()
    if sampler is None:
        notes.append("neither jtop nor tegrastats was there: no power, temperature and clocks")
    with _Progress(arguments.model.name) as progress:
        recording = run.record(command, sampler, warm_up_s=request.warm_up_ms / 1000, on_line=progress)
    log = _output(arguments) / module / f"{arguments.model.stem}.trtexec.log"
    if recording.interrupted:
        print(f"stopped; what trtexec printed is in {run.write_log(log, recording.log)}", file=sys.stderr)
        return None
    setting = Setting(
        module=module,
        mode=mode,
        source=f"{arguments.source or 'robotbrain ' + __version__}: trtexec on {board.model or module}",
        precision=request.precision,
        typed=request.typed,
        shapes=request.shapes,
        clocks_pinned=pinned,
        jetpack=board.jetpack,
        jetson_linux=board.jetson_linux,
        notes=notes,
    )
    try:
        profile = make_profile(trtexec.parse(recording.log), model, setting, recording.telemetry)
    except InputError:
        print(f"what trtexec printed is in {run.write_log(log, recording.log)}", file=sys.stderr)
        raise
    if arguments.keep_logs:
        run.write_log(_output(arguments) / module / profile.filename.replace(".toml", ".trtexec.log"), recording.log)
    return profile


class _Progress:
    """A line on the terminal that says what trtexec is doing and how long it has been at it."""

    def __init__(self, title: str) -> None:
        from tqdm import tqdm

        self._bar = tqdm(desc=f"{title}: starting", bar_format="{desc} [{elapsed}]", leave=False)
        self._title = title

    def __enter__(self) -> _Progress:
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.close()

    def __call__(self, line: str) -> None:
        stages = {
            "Start parsing": "reading the ONNX",
            "Finish": "building the engine (minutes)",
            "Engine built": "loading the engine",
            "Starting inference": "timing",
            "=== Performance summary": "done",
        }
        stage = next((words for sign, words in stages.items() if sign in line), None)
        if stage is not None:
            self._bar.set_description_str(f"{self._title}: {stage}", refresh=False)
        self._bar.refresh()


def _mode(module: str, answer: str, asked: str) -> str:
    if asked != CURRENT and not answer.strip():
        return asked  # in a container nvpmodel may be missing
    mode = nvpmodel.parse_mode(answer).name
    same = measured.canonical_mode(module, mode).casefold() == measured.canonical_mode(module, asked).casefold()
    if asked != CURRENT and not same:
        raise InputError(
            "--mode", given=asked, expected=f"{mode}, which the board is in", fix="Set it first: `sudo nvpmodel -m ID`."
        )
    return mode


def _warn(pinned: bool | None) -> list[str]:
    if pinned:
        return []
    text = "clocks were not pinned" if pinned is False else "not known whether the clocks were pinned (needs root)"
    print(f"warning: {text}; for steady figures run `sudo jetson_clocks` first", file=sys.stderr)
    return [text]


def _output(arguments: argparse.Namespace) -> Path:
    if arguments.output is not None:
        return Path(arguments.output)
    *_, last = measured.directories()
    nearest = next((p for p in (last, *last.parents) if p.exists()), last)
    if not os.access(nearest, os.W_OK):
        raise InputError(
            "--output", given=None, expected="a directory that can be written to", fix=f"{last} cannot: name another."
        )
    return last


def _read(path: Path) -> str:
    try:
        raw = path.read_bytes()
    except OSError as error:
        raise InputError("log", given=str(path), expected="a readable file", fix=str(error)) from error
    if raw[:2] in (b"\xff\xfe", b"\xfe\xff"):  # PowerShell's `>` writes UTF-16
        return raw.decode("utf-16", "replace")
    # tee keeps the carriage returns of progress bars, and terminals their colours
    return re.sub(r"\x1b\[[0-9;]*m", "", raw.decode("utf-8", "replace").replace("\r\n", "\n"))


def _summary(profile: MeasuredProfile) -> str:
    latency = profile.latency
    tail = "" if latency.p99 is None else f", p99 {latency.p99:.3f} ms"
    rows = [
        f"{profile.model} {profile.precision}, batch {profile.batch}, on {profile.module} in mode {profile.mode}",
        f"  GPU latency  median {latency.median:.3f} ms, mean {latency.mean:.3f} ms{tail}",
        f"  memory       {_or_not(profile.memory_mb, '{:.0f} MiB held by TensorRT')}",
    ]
    if profile.power is None:
        rows.append("  power        not measured")
    else:
        energy = f", {profile.energy_mj:.2f} mJ per query"
        rows.append(f"  power        mean {profile.power.mean:.2f} W, peak {profile.power.peak:.2f} W{energy}")
    rows.append(f"  temperature  {_or_not(profile.temperature_peak_c, 'peak {:.1f} degC')}")
    return "\n".join([*rows, *(f"  note         {note}" for note in profile.notes)])


def _or_not(value: float | None, form: str) -> str:
    return "not measured" if value is None else form.format(value)

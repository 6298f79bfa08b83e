"""``robotbrain jetson measure``: from logs, without a Jetson, with stand-in programs, and (on a Jetson) in earnest."""

from __future__ import annotations

import _thread
import argparse
import hashlib
import signal
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import onnx
import pytest
from onnx import TensorProto, helper

from robotbrain.errors import InputError
from robotbrain.jetson import measure_command, measured
from robotbrain.jetson.measure import board as boards
from robotbrain.jetson.measure import run, trtexec
from robotbrain.jetson.measure.command import Capabilities
from robotbrain.jetson.measure.samples import Sample
from robotbrain.jetson.measured import MeasuredProfile

LOGS = Path(__file__).resolve().parents[1] / "data" / "jetson_logs"


@pytest.fixture
def model(tmp_path: Path) -> Path:
    """Return a small network with one static input."""
    image = helper.make_tensor_value_info("images", TensorProto.FLOAT, [1, 3, 640, 640])
    out = helper.make_tensor_value_info("out", TensorProto.FLOAT, [1, 3, 640, 640])
    graph = helper.make_graph([helper.make_node("Relu", ["images"], ["out"])], "g", [image], [out])
    path = tmp_path / "Detector v1.onnx"
    onnx.save(helper.make_model(graph), path)
    return path


def measure(*words: object) -> int:
    parser = argparse.ArgumentParser()
    measure_command.measure_arguments(parser)
    return measure_command.measure_main(parser.parse_args([str(word) for word in words]))


def the_only(directory: Path) -> MeasuredProfile:
    (path,) = directory.rglob("*.toml")
    return measured.load(path)


# ---- from logs ----


def test_from_logs(model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    code = measure(
        model, "--from-logs", LOGS / "trtexec_10_3_orin.log", "--device", "orin-nano-8gb", "--mode", "15w",
        "--tegrastats", LOGS / "tegrastats_orin_nx_jp5.log", "--output", out, "--source", "A. Teacher",
        "--jetpack", "6.1",
    )  # fmt: skip
    assert code == 0
    profile = the_only(out)
    assert (profile.module, profile.mode, profile.precision, profile.batch) == ("orin-nano-8gb", "15W", "fp16", 1)
    assert profile.sha256 == hashlib.sha256(model.read_bytes()).hexdigest()
    assert profile.latency_ms == 7.14139 and profile.tensorrt == "10.3.0" and profile.memory_mb == 114
    assert profile.power is not None and profile.power.mean == pytest.approx(5.299)
    assert profile.source.startswith("A. Teacher") and "trtexec_10_3_orin.log" in profile.source
    assert profile.date.year == 2024 and profile.provenance == "measured" and profile.jetpack == "6.1"
    assert any("without time" in note for note in profile.notes)
    shown = capsys.readouterr().out
    assert "7.141 ms" in shown and "5.30 W" in shown and measured.DIRECTORIES_VARIABLE in shown
    found = measured.find(profile.sha256, "orin-nano-8gb", "15W", "fp16", among=[out])
    assert found == profile


def test_without_tegrastats_power_is_missing(model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    measure(model, "--from-logs", LOGS / "trtexec_10_3_orin.log", "--device", "t5000", "--mode", "MAXN",
            "--output", tmp_path / "out")  # fmt: skip
    assert the_only(tmp_path / "out").power is None
    assert "power        not measured" in capsys.readouterr().out


def with_times(first: str) -> str:
    """Return three readings a second apart, 2, 6 and 4 W, beginning at ``first``."""
    line = "10-03-2024 {time} RAM 1000/7620MB CPU [1%@729] GR3D_FREQ 99%@[612] cpu@50C VDD_IN {mw}mW/9999mW\n"
    hour, minute, second = (int(part) for part in first.split(":"))
    return "".join(
        line.format(time=f"{hour:02}:{minute:02}:{second + i:02}", mw=mw) for i, mw in enumerate((2000, 6000, 4000))
    )


def test_only_readings_while_the_network_ran_are_averaged(model: Path, tmp_path: Path) -> None:
    # timed from 10:47:55 to 10:47:59; the first reading is of the build
    log = tmp_path / "t.log"
    log.write_text(with_times("10:47:54"), encoding="utf-8")
    measure(model, "--from-logs", LOGS / "trtexec_10_3_orin.log", "--tegrastats", log, "--device", "orin-nano-8gb",
            "--mode", "15W", "--output", tmp_path / "out")  # fmt: skip
    profile = the_only(tmp_path / "out")
    assert profile.power is not None
    assert (profile.power.mean, profile.power.samples) == (5.0, 2)
    # the instant value counts, not tegrastats' own running average
    assert profile.power.peak == 6.0


def test_readings_of_another_time_are_refused(model: Path, tmp_path: Path) -> None:
    log = tmp_path / "t.log"
    log.write_text(with_times("12:00:00"), encoding="utf-8")
    with pytest.raises(InputError, match="while trtexec runs"):
        measure(model, "--from-logs", LOGS / "trtexec_10_3_orin.log", "--tegrastats", log, "--device",
                "orin-nano-8gb", "--mode", "15W", "--output", tmp_path / "out")  # fmt: skip
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"--device": None}, "--device"),
        ({"--mode": None}, "--mode"),
        ({"--device": "orin-nano-9gb"}, "orin-nano-8gb"),
        ({"--precision": "int8"}, "fp16"),
        ({"--shape": "images:1x3x320x320"}, "images"),
        ({"--from-logs": "missing.log"}, "missing.log"),
        ({"--from-logs": LOGS / "README.md"}, "cut off"),
        ({"--from-logs": LOGS / "trtexec_10_3_out_of_memory.log"}, "out of memory"),
        ({"--from-logs": LOGS / "trtexec_8_0_loads_fp16_engine.log"}, "--precision"),
        ({"--tegrastats": LOGS / "README.md"}, "tegrastats"),
    ],
)
def test_what_is_wrong_with_logs_is_said(model: Path, tmp_path: Path, changes: dict[str, Any], word: str) -> None:
    words = {"--from-logs": LOGS / "trtexec_10_3_orin.log", "--device": "orin-nano-8gb", "--mode": "15W", **changes}
    flat = [item for name, value in words.items() if value is not None for item in (name, value)]
    with pytest.raises(InputError) as caught:
        measure(model, *flat, "--output", tmp_path / "out")
    assert word in str(caught.value)
    assert not (tmp_path / "out").exists()


def test_an_engine_needs_its_precision_and_takes_the_models_shapes(model: Path, tmp_path: Path) -> None:
    measure(model, "--from-logs", LOGS / "trtexec_8_0_loads_fp16_engine.log", "--device", "nano-4gb", "--mode", "MAXN",
            "--precision", "fp16", "--output", tmp_path / "out")  # fmt: skip
    profile = the_only(tmp_path / "out")
    assert profile.precision == "fp16" and profile.shapes == {"images": (1, 3, 640, 640)}
    assert any("no date" in note for note in profile.notes)


def test_a_log_of_power_shells_redirection_is_read(model: Path, tmp_path: Path) -> None:
    log = tmp_path / "utf16.log"
    log.write_bytes((LOGS / "trtexec_10_3_orin.log").read_text(encoding="utf-8").encode("utf-16"))
    measure(model, "--from-logs", log, "--device", "t5000", "--mode", "MAXN", "--output", tmp_path / "out")
    assert the_only(tmp_path / "out").latency_ms == 7.14139


def test_a_model_that_is_none(tmp_path: Path) -> None:
    path = tmp_path / "m.onnx"
    for content in (b"", b"\x08\xff\xff", b"not an onnx file"):
        path.write_bytes(content)
        with pytest.raises(InputError):
            measure(path, "--from-logs", LOGS / "trtexec_8_4_no_transfers_unstable.log", "--device", "t5000",
                    "--mode", "MAXN", "--precision", "fp16", "--output", tmp_path / "out")  # fmt: skip


# ---- without a Jetson ----


@pytest.mark.skipif(boards.read_board().is_jetson, reason="this is a Jetson")
def test_without_a_jetson_it_says_what_to_do(model: Path) -> None:
    with pytest.raises(InputError) as caught:
        measure(model)
    for words in ("/etc/nv_tegra_release", "Copy the ONNX file to the board", "--from-logs"):
        assert words in str(caught.value)


# ---- on a board, with stand-ins for its programs ----

STAND_IN = """
import sys, time
if "--help" in sys.argv:
    print(open({help!r}, encoding="utf-8").read()); raise SystemExit
for line in open({log!r}, encoding="utf-8"):
    print(line, end="", flush=True)
    if "Starting inference" in line:
        time.sleep({pause})
raise SystemExit({code})
"""

SENSORS = """
import time
while True:
    print("RAM 1000/7620MB CPU [1%@729] GR3D_FREQ 99%@[612] cpu@50C VDD_IN 6000mW/9999mW", flush=True)
    time.sleep(0.02)
"""


def stand_in(tmp_path: Path, log: str = "trtexec_10_3_orin.log", pause: float = 0.4, code: int = 0) -> list[str]:
    """Return the command of a program that prints a recorded log as trtexec would."""
    path = tmp_path / "trtexec.py"
    text = STAND_IN.format(help=str(LOGS / "trtexec_help_10_5.txt"), log=str(LOGS / log), pause=pause, code=code)
    path.write_text(text, encoding="utf-8")
    return [sys.executable, str(path)]


def sensors(tmp_path: Path) -> run.TegrastatsSampler:
    path = tmp_path / "tegrastats.py"
    path.write_text(SENSORS, encoding="utf-8")
    return run.TegrastatsSampler([sys.executable, str(path)])


def test_a_recording_has_the_log_and_the_sensors_of_the_timed_phase(tmp_path: Path) -> None:
    seen: list[str] = []
    recording = run.record(stand_in(tmp_path, pause=1.0), sensors(tmp_path), on_line=seen.append)
    assert recording.exit_code == 0 and not recording.interrupted
    assert trtexec.parse(recording.log) == trtexec.parse((LOGS / "trtexec_10_3_orin.log").read_text(encoding="utf-8"))
    assert recording.telemetry is not None and recording.telemetry.power is not None
    assert recording.telemetry.power.mean == 6.0 and recording.telemetry.gpu_mhz == 612
    assert any("Starting inference" in line for line in seen)


def test_readings_before_and_after_the_timed_phase_are_dropped(tmp_path: Path) -> None:
    class Clock:
        """A sampler that was read all the time: 1 W while the engine was built, 9 W after."""

        name = "tegrastats"

        def __init__(self) -> None:
            self.start_s = 0.0

        def start(self) -> None:
            self.start_s = time.monotonic()

        def stop(self) -> list[tuple[float, Sample]]:
            now = time.monotonic()
            readings = [(self.start_s - 1, 1.0), (now + 5, 9.0)]
            return [(when, Sample(rails_w={"VDD_IN": watts})) for when, watts in readings]

    recording = run.record(stand_in(tmp_path, pause=0.0), Clock())
    assert recording.telemetry is not None
    assert recording.telemetry.samples == 0 and recording.telemetry.power is None


def test_an_interruption_ends_the_child_and_keeps_what_it_printed(tmp_path: Path) -> None:
    children: list[Any] = []
    popen = run._popen

    def remember(command: Any) -> Any:
        children.append(popen(command))
        return children[-1]

    def interrupt(line: str) -> None:
        if "Starting inference" in line:
            raise KeyboardInterrupt  # as Python does where Ctrl-C meets the loop

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(run, "_popen", remember)
        recording = run.record(stand_in(tmp_path, pause=60.0), sensors(tmp_path), on_line=interrupt)
    assert recording.interrupted and "Starting inference" in recording.log
    assert "Performance summary" not in recording.log
    assert len(children) == 2 and all(child.poll() is not None for child in children)


@pytest.fixture
def plain_sigint() -> Iterator[None]:
    """Make SIGINT raise KeyboardInterrupt, as in a fresh process: a library used earlier may have taken it over."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("plain_sigint")
def test_ctrl_c_meets_the_loop_while_trtexec_is_silent(tmp_path: Path) -> None:
    """A signal must be seen although no line arrives."""
    done = threading.Event()

    def press() -> None:
        # Again and again: an interrupt that falls into a finaliser is swallowed by the interpreter.
        while not done.wait(4.0):
            _thread.interrupt_main()

    threading.Thread(target=press, daemon=True).start()
    recording = run.record(stand_in(tmp_path, pause=60.0), None)
    done.set()
    assert recording.interrupted and "Starting inference" in recording.log


def test_a_program_that_cannot_be_started_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no-such-program"):
        run.record([str(tmp_path / "no-such-program")], None)


def test_missing_tegrastats_gives_no_readings(tmp_path: Path) -> None:
    sampler = run.TegrastatsSampler([str(tmp_path / "no-such-program")])
    recording = run.record(stand_in(tmp_path, pause=0.0), sampler)
    assert recording.telemetry is not None and recording.telemetry.power is None


@pytest.fixture
def orin(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> dict[str, str]:
    """Let the command believe that it runs on an Orin Nano Super; return what the board's programs answer."""
    answers = {
        "nvpmodel": "NVPM WARN: fan mode is not set!\nNV Power Mode: 25W\n1\n",
        "jetson_clocks": (LOGS / "jetson_clocks_orin_nano.txt").read_text(encoding="utf-8"),
    }
    board = boards.Board(
        model="NVIDIA Jetson Orin Nano Engineering Reference Developer Kit Super",
        compatible=("nvidia,p3768-0000+p3767-0005-super", "nvidia,tegra234"),
        release="# R36 (release), REVISION: 4.3, GCID: 1",
        jetpack="6.2+b77",
    )
    program = stand_in(tmp_path)
    able = Capabilities.from_help((LOGS / "trtexec_help_10_5.txt").read_text(encoding="utf-8"))
    monkeypatch.setattr(boards, "read_board", lambda: board)
    monkeypatch.setattr(run, "find_trtexec", lambda named: "trtexec")
    monkeypatch.setattr(run, "capabilities_of", lambda _: able)
    monkeypatch.setattr(run, "ask", lambda command, timeout_s=20: answers.get(command[0], ""))
    monkeypatch.setattr(run, "choose_sampler", lambda: None)
    record = run.record
    monkeypatch.setattr(run, "record", lambda command, *rest, **more: record(program, *rest, **more))
    return answers


def test_a_run_on_a_board(
    orin: dict[str, str], model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert measure(model, "--output", tmp_path / "out", "--keep-logs") == 0
    profile = the_only(tmp_path / "out")
    assert (profile.module, profile.mode, profile.precision) == ("orin-nano-8gb-super", "25W", "fp16")
    assert profile.clocks_pinned is False and profile.jetson_linux == "36.4.3" and profile.jetpack == "6.2+b77"
    assert profile.power is None
    assert any("not pinned" in note for note in profile.notes) and any("jtop" in note for note in profile.notes)
    assert "sudo jetson_clocks" in capsys.readouterr().err
    (kept,) = (tmp_path / "out").rglob("*.log")
    assert "Performance summary" in kept.read_text(encoding="utf-8")


def test_the_mode_must_be_the_one_that_is_set(orin: dict[str, str], model: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="nvpmodel -m"):
        measure(model, "--mode", "15W", "--output", tmp_path / "out")
    assert measure(model, "--mode", "25w", "--output", tmp_path / "out") == 0
    orin["nvpmodel"] = ""  # in a container
    with pytest.raises(InputError, match="--mode"):
        measure(model, "--output", tmp_path / "out")
    assert measure(model, "--mode", "MAXN_SUPER", "--output", tmp_path / "container") == 0


def test_an_interrupted_run_keeps_its_log_and_writes_no_profile(
    orin: dict[str, str],
    model: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(run, "record", lambda *_, **__: run.Recording("half a log\n", None, None))
    assert measure(model, "--output", tmp_path / "out") == 130
    (kept,) = (tmp_path / "out").rglob("*.log")
    assert kept.read_text(encoding="utf-8") == "half a log\n"
    assert not list((tmp_path / "out").rglob("*.toml"))
    assert str(kept) in capsys.readouterr().err


def test_a_failed_run_keeps_its_log_and_says_why(
    orin: dict[str, str], model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = (LOGS / "trtexec_10_3_out_of_memory.log").read_text(encoding="utf-8")
    monkeypatch.setattr(run, "record", lambda *_, **__: run.Recording(log, 1, None))
    with pytest.raises(InputError, match="out of memory"):
        measure(model, "--output", tmp_path / "out")
    assert [path.suffix for path in (tmp_path / "out").rglob("*.*")] == [".log"]


# ---- on a Jetson ----


def test_a_real_board(model: Path, tmp_path: Path) -> None:
    """Needs a Jetson with JetPack. Everywhere else this skips, also where CI promised not to: CI has no Jetson."""
    if not boards.read_board().is_jetson:
        pytest.skip("needs a Jetson: nothing here can time TensorRT")
    assert run.find_trtexec() is not None, "a Jetson without trtexec: sudo apt install libnvinfer-bin"
    assert measure(model, "--duration", "3", "--output", tmp_path / "out") == 0
    profile = the_only(tmp_path / "out")
    assert 0 < profile.latency.min <= profile.latency_ms < 1000
    assert profile.power is None or 0.5 < profile.power.mean < 200
    assert profile.tensorrt is not None

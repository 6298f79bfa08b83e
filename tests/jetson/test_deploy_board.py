"""A bundle's program, run for real on a board that is a stand-in (board_stand_ins.py): nothing here is a latency."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from board_stand_ins import StandInBoard
from deploy_builders import bundle, files_of, network, put

from robotbrain import cli
from robotbrain.errors import InputError
from robotbrain.jetson import measured
from robotbrain.jetson.deploy import profile_from_result, verify_bundle
from robotbrain.jetson.deploy.manifest import digest_line
from robotbrain.jetson.twin import predict

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="the stand-ins are POSIX scripts")
QUICK = ("--runs", "1", "--duration", "1")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("made")
    model = network(folder)
    return bundle(folder, model=model), model


@pytest.fixture
def copy(made: tuple[Path, Path], tmp_path: Path) -> Path:
    # A space, a comma and a colon: what a path on a board may hold.
    return put(tmp_path / "a b,c:d" / "bundle", files_of(made[0]))


@pytest.fixture
def board(tmp_path: Path) -> StandInBoard:
    (tmp_path / "board").mkdir()
    return StandInBoard(tmp_path / "board")


@pytest.fixture(scope="module")
def result(made: tuple[Path, Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A result of three runs."""
    folder = tmp_path_factory.mktemp("result")
    done = StandInBoard(folder).run(made[0], "--runs", "3", "--duration", "1", "--work", str(folder / "work"))
    assert done.returncode == 0, done.stderr
    return folder / "work" / "result"


def engines(copy: Path) -> list[str]:
    return sorted(p.name for p in copy.with_name("bundle-board").joinpath("engines").iterdir())


def test_it_builds_checks_measures_and_uses_the_engine_again(copy: Path, board: StandInBoard) -> None:
    before = files_of(copy)
    done = board.run(copy, *QUICK)
    assert (done.returncode, done.stderr) == (0, "")
    for words in ("building the engine", "3 outputs agree", "run 1 of 1", "not built again"):
        assert (words in done.stdout) == (words != "not built again")
    assert len(board.called("onnx")) == 1
    again = board.run(copy, *QUICK, script="measure.sh", shell="dash" if shutil.which("dash") else "sh")
    assert again.returncode == 0 and "not built again" in again.stdout, again.stderr
    assert len(board.called("onnx")) == 1
    assert files_of(copy) == before and verify_bundle(copy)
    (engine, record) = engines(copy)
    assert engine.endswith(".engine") and record.endswith(".json")
    # what the engine was made of counts: another TensorRT of the same release is built anew
    assert board.check(copy, command="build", STAND_IN_TENSORRT="100301", STAND_IN_PACKAGE="10.3.1-1") == ""
    assert len(board.called("onnx")) == 2 and len(engines(copy)) == 4
    # an engine that is no longer whole is not used
    copy.with_name("bundle-board").joinpath("engines", engine).write_bytes(b"stand-in")
    assert board.check(copy, command="build") == ""
    assert len(board.called("onnx")) == 3


def start(board: StandInBoard, copy: Path) -> subprocess.Popen[bytes]:
    """Start a build that hangs, and return when half an engine is there."""
    child = subprocess.Popen(
        board.command(copy), env=board.environment(STAND_IN_BUILD="hang"), stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE, start_new_session=True,
    )  # fmt: skip
    folder = copy.with_name("bundle-board") / "engines"
    deadline = time.monotonic() + 60
    while not list(folder.glob("*.part")) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert list(folder.glob("*.part"))
    return child


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_an_interrupted_build_leaves_nothing(copy: Path, board: StandInBoard, how: signal.Signals) -> None:
    child = start(board, copy)
    child.send_signal(how)
    _, said = child.communicate(timeout=60)
    assert child.returncode == 130 and b"nothing half-done is left" in said and b"Traceback" not in said
    assert engines(copy) == []


def test_a_killed_build_is_swept_away_by_the_next(copy: Path, board: StandInBoard) -> None:
    child = start(board, copy)
    os.killpg(child.pid, signal.SIGKILL)
    child.communicate(timeout=60)
    assert len(engines(copy)) == 1
    assert board.check(copy, command="build") == ""
    assert [Path(name).suffix for name in engines(copy)] == [".engine", ".json"]


def test_a_failed_build_says_why_and_leaves_nothing(copy: Path, board: StandInBoard) -> None:
    text = board.check(copy, command="build", STAND_IN_BUILD="fail")
    assert "out of memory" in text and "build.log" in text
    assert engines(copy) == []


def test_an_engine_that_computes_something_else_is_not_measured(copy: Path, board: StandInBoard) -> None:
    assert "rms" in board.check(copy, command="run", STAND_IN_ERROR="0.05")
    assert "NaN" in board.check(copy, command="run", STAND_IN_NAN="1")
    assert not copy.with_name("bundle-board").joinpath("result").exists()
    assert board.check(copy, command="build", STAND_IN_ERROR="1e-4") == ""


def place(folder: Path, parts: str, release: str = "36, 4.3") -> StandInBoard:
    folder.mkdir()
    return StandInBoard(folder, parts, release)


def test_the_wrong_board_is_refused(copy: Path, board: StandInBoard, tmp_path: Path) -> None:
    assert board.check(copy) == ""
    text = place(tmp_path / "nx", "p3767-0000").check(copy)
    assert "3767-0000" in text and "Jetson Orin Nano 8GB" in text and "--module" in text
    assert "35.4.1" in place(tmp_path / "jp5", "p3767-0005", "35, 4.1").check(copy)
    assert place(tmp_path / "point", "p3767-0003", "36, 4.4").check(copy) == ""  # a point release is only noted
    assert "8.5.2" in board.check(copy, STAND_IN_TENSORRT="8502", STAND_IN_PACKAGE="8.5.2-1+cuda11.4")
    assert "10.5.0" in board.check(copy, STAND_IN_TENSORRT="100500")
    assert "Two versions" in board.check(copy, STAND_IN_PACKAGE="10.7.0.23-1+cuda12.6")
    assert "nvpmodel -m" in board.check(copy, STAND_IN_MODE="MAXN")
    assert board.check(copy, STAND_IN_MODE="15w") == ""
    (board.bin / "nvpmodel").unlink()
    assert "--mode" in board.check(copy) and board.check(copy, "--mode", "15W") == ""
    assert "outside the bundle" in board.check(copy, "--work", str(copy / "w"), "--mode", "15W", command="run")
    (board.bin / "trtexec").unlink()
    assert "libnvinfer-bin" in board.check(copy, "--mode", "15W")
    shutil.rmtree(board.root)
    assert "this machine" in board.check(copy)


def flip(path: Path) -> None:
    raw = bytearray(path.read_bytes())
    raw[len(raw) // 2] ^= 1
    path.write_bytes(raw)


@pytest.mark.parametrize(
    ("tamper", "word"),
    [
        (lambda b: flip(b / "model.onnx"), "model.onnx"),
        (lambda b: flip(b / "manifest.json"), "manifest.json"),
        (lambda b: (b / "vectors" / "0_in0.f32").write_bytes(b""), "0 bytes"),
        (lambda b: (b / "vectors" / "0_in0.f32").unlink(), "no such file"),
        (lambda b: (b / "extra").write_bytes(b""), "extra"),
        (lambda b: (b / "link").symlink_to("model.onnx"), "link"),
        (lambda b: (b / "manifest.sha256").unlink(), "manifest"),
    ],
)
def test_an_altered_bundle_is_refused_on_the_board(
    copy: Path, board: StandInBoard, tamper: Callable[[Path], object], word: str
) -> None:
    tamper(copy)
    assert word in board.check(copy)
    assert not board.calls.exists()


# ---- what comes back ----


def test_a_result_becomes_a_measured_profile_that_precedes_the_twin(
    result: Path,
    made: tuple[Path, Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    out = tmp_path / "out"
    assert predict(made[1], "orin-nano-8gb", precision="fp16").provenance == "predicted"
    assert cli.main(["jetson", "measure", "--from-bundle", str(result), "--output", str(out)]) == 0
    (path,) = out.rglob("*.toml")
    profile = measured.load(path)
    assert (profile.module, profile.mode, profile.precision, profile.batch) == ("orin-nano-8gb", "15W", "fp16", 1)
    assert profile.shapes == {"image": (1, 3, 16, 16)}
    assert profile.clocks_pinned and profile.tensorrt == "10.3.0" and profile.jetson_linux == "36.4.3"
    assert profile.power is not None and profile.power.mean == 6.0
    assert any("median of runs" in note for note in profile.notes)
    assert any("outputs checked" in note for note in profile.notes)
    monkeypatch.setenv(measured.DIRECTORIES_VARIABLE, str(out))
    found = predict(made[1], "orin-nano-8gb", precision="fp16")
    assert (found.provenance, found.latency_ms) == ("measured", profile.latency_ms)
    assert files_of(bundle(tmp_path, model=made[1])) == files_of(made[0])  # which holds a prediction all the same
    capsys.readouterr()
    other = network(tmp_path, seed=3)
    assert cli.main(["jetson", "measure", str(other), "--from-bundle", str(result), "--output", str(out)]) == 2
    assert cli.main(["jetson", "measure", "--from-bundle", str(result), "--mode", "7W"]) == 2


def edit(content: dict[str, bytes], /, **changes: object) -> dict[str, bytes]:
    data = {**json.loads(content["result.json"]), **changes}
    raw = (json.dumps(data, indent=1, sort_keys=True) + "\n").encode()
    return {**content, "result.json": raw, "result.sha256": digest_line(raw, "result.json")}


def test_the_median_run_counts(result: Path, tmp_path: Path) -> None:
    from robotbrain.jetson.deploy.manifest import files_section

    files = files_of(result)
    for index, value in ((1, "9.0"), (2, "6.0"), (3, "7.0")):
        name = f"run_{index}.trtexec.log"
        files[name] = files[name].replace(b"median = 7.14139 ms", f"median = {value} ms".encode())
    logs = {name: content for name, content in files.items() if name.endswith(".log")}
    files = edit(files, files=files_section(logs))
    assert profile_from_result(put(tmp_path / "r", files)).latency_ms == 7.0


def test_altered_results_are_refused(result: Path, tmp_path: Path) -> None:
    files = files_of(result)
    log = "run_1.trtexec.log"
    wrong = {
        "altered log": {**files, log: files[log].replace(b"7.14139", b"0.14139")},
        "truncated log": {**files, log: files[log][:-1]},
        "missing log": {name: content for name, content in files.items() if name != log},
        "extra": {**files, "extra": b""},
        "altered json": {**files, "result.json": files["result.json"].replace(b"15W", b"7W")},
        "unknown module": edit(files, module="orin-nano-9gb"),
        "unknown mode": edit(files, mode="99W"),
        "no runs": edit(files, runs=[]),
        "numbers not checked": edit(files, numerics=[]),
        "other TensorRT": edit(files, tensorrt="8.5.2"),
        "other CUDA graph": edit(files, cuda_graph=True),
        "other precision": edit(files, precision="int4"),
        "log elsewhere": edit(files, runs=[{"trtexec": "../x", "tegrastats": None}]),
        "no such day": edit(files, date="2026-13-45T99:99:99Z"),
        "other shape": edit(files, shapes={"image": [1, 3, 8, 8]}),
        "version": edit(files, version=2),
        "extra key": edit(files, more=1),
    }
    put(tmp_path / "right", files)
    profile_from_result(tmp_path / "right")
    for at, (name, content) in enumerate(wrong.items()):
        with pytest.raises(InputError):
            profile_from_result(put(tmp_path / str(at), content))
            pytest.fail(name)

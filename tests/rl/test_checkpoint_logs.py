"""Checkpoints and logs: what a killed process, a foreign file or a full disk must not do to a training."""

from __future__ import annotations

import importlib
import importlib.util
import json
import math
import os
import pickle
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from robotbrain.errors import InputError
from robotbrain.rl import checkpoint as checkpoint_module
from robotbrain.rl.checkpoint import load_checkpoint, previous_path, save_checkpoint
from robotbrain.rl.logs import METRICS_FILE, Progress, RunLog, read_run
from tests.conftest import need


def some_state() -> dict[str, Any]:
    torch.manual_seed(0)
    net = torch.nn.Linear(3, 2)
    optimizer = torch.optim.Adam(net.parameters(), lr=1e-3)
    net(torch.ones(1, 3)).sum().backward()
    optimizer.step()
    return {
        "net": net.state_dict(),
        "optimizer": optimizer.state_dict(),
        "generator": torch.Generator().manual_seed(1).get_state(),
        "numpy": np.random.default_rng(2).bit_generator.state,
        "step": 7,
        "shape": (3, 2),
        "best": None,
    }


def same(a: Any, b: Any) -> bool:
    if isinstance(a, torch.Tensor):
        return torch.equal(a, b)
    if isinstance(a, dict):
        return list(a) == list(b) and all(same(a[key], b[key]) for key in a)
    if isinstance(a, (list, tuple)):
        return type(a) is type(b) and len(a) == len(b) and all(map(same, a, b))
    return bool(a == b) and type(a) is type(b)


def test_loads_what_was_saved_and_same_state_is_same_bytes(tmp_path: Path) -> None:
    first = save_checkpoint(tmp_path / "deep" / "a.pt", some_state(), kind="ppo")
    second = save_checkpoint(tmp_path / "b.pt", some_state(), kind="ppo")
    loaded = load_checkpoint(first, kind="ppo")
    assert same(dict(some_state(), net=dict(some_state()["net"])), loaded)
    # The random states are not only equal: they go on as the saved ones would have.
    rng = np.random.default_rng()
    rng.bit_generator.state = loaded["numpy"]
    assert rng.random() == np.random.default_rng(2).random()
    assert first.read_bytes() == second.read_bytes()
    # Also where equal strings happen to be two objects, as after loading.
    third = save_checkpoint(tmp_path / "b.pt", loaded, kind="ppo", keep_previous=False)
    assert first.read_bytes() == third.read_bytes()
    assert sorted(item.name for item in tmp_path.iterdir()) == ["b.pt", "deep"]  # no temporary files


def test_a_view_does_not_drag_its_storage_along(tmp_path: Path) -> None:
    path = save_checkpoint(tmp_path / "view.pt", {"row": torch.zeros(1000, 1000)[3]})
    assert path.stat().st_size < 20_000


def test_keeps_the_one_before(tmp_path: Path) -> None:
    path = tmp_path / "latest.pt"
    for step in (1, 2, 3):
        save_checkpoint(path, {"step": step})
    assert load_checkpoint(path) == {"step": 3}
    assert load_checkpoint(previous_path(path)) == {"step": 2}
    save_checkpoint(path, {"step": 4}, keep_previous=False)
    assert load_checkpoint(previous_path(path)) == {"step": 2}


def test_keeps_the_one_before_without_hard_links(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_links(*_: object) -> None:
        raise OSError("not supported")

    monkeypatch.setattr(checkpoint_module.os, "link", no_links)
    test_keeps_the_one_before(tmp_path)


def test_a_failed_save_changes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = save_checkpoint(tmp_path / "latest.pt", {"step": 1})
    before = path.read_bytes()

    def disk_full(_: object, file: Any) -> None:
        file.write(b"half of it")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(checkpoint_module.torch, "save", disk_full)
    with pytest.raises(OSError, match="space"):
        save_checkpoint(path, {"step": 2})
    assert path.read_bytes() == before
    assert [item.name for item in tmp_path.iterdir()] == ["latest.pt"]


@pytest.mark.parametrize(
    ("value", "names"),
    [
        (np.zeros(3), "ndarray"),
        (np.float64(1.0), "float64"),
        ({"deep": [0, object()]}, r"state\['x'\]\['deep'\]\[1\]"),
        ({(1, 2): 3}, "key"),
    ],
)
def test_refuses_what_could_not_be_loaded_again(tmp_path: Path, value: object, names: str) -> None:
    with pytest.raises(InputError, match=names):
        save_checkpoint(tmp_path / "a.pt", {"x": value})
    assert not list(tmp_path.iterdir())


def test_every_cut_of_a_checkpoint_is_refused(tmp_path: Path) -> None:
    path = save_checkpoint(tmp_path / "a.pt", some_state())
    whole = path.read_bytes()
    for length in [0, 1, *range(100, len(whole), 397), len(whole) - 1]:
        path.write_bytes(whole[:length])
        with pytest.raises(InputError, match="checkpoint"):
            load_checkpoint(path)


class _Trap:
    def __reduce__(self) -> tuple[Any, ...]:
        return (os.mkdir, ("trapped",))


def test_foreign_files_are_refused_and_run_no_code(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    torch.save({"trap": _Trap()}, tmp_path / "trap.pt")
    (tmp_path / "pickle.pt").write_bytes(pickle.dumps({"trap": _Trap()}))
    torch.save({"model": torch.zeros(2)}, tmp_path / "plain.pt")
    (tmp_path / "text.pt").write_text("not a checkpoint")
    for name in ("trap", "pickle", "plain", "text"):
        with pytest.raises(InputError, match="checkpoint"):
            load_checkpoint(tmp_path / f"{name}.pt")
    assert not (tmp_path / "trapped").exists()


def test_missing_and_other_kinds_are_refused_with_a_way_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InputError, match="no folder"):
        load_checkpoint(tmp_path / "nowhere" / "a.pt")
    save_checkpoint(tmp_path / "policy.pt", {}, kind="ddpg")
    with pytest.raises(InputError, match=r"policy\.pt"):
        load_checkpoint(tmp_path / "a.pt")
    with pytest.raises(InputError, match=r"ddpg.*ppo"):
        load_checkpoint(tmp_path / "policy.pt", kind="ppo")
    monkeypatch.setattr(checkpoint_module, "SCHEMA", 2)
    with pytest.raises(InputError, match="version"):
        load_checkpoint(tmp_path / "policy.pt")


# ---------------------------------------------------------------- logs


def test_log_reads_back_and_keeps_names_apart(tmp_path: Path) -> None:
    with RunLog(tmp_path, tensorboard=False) as log:
        log.settings({"task": "reach", "seed": 3})
        log.scalar("return", 1.5, 10)
        log.scalars({"return": 2.5, "loss": math.nan}, 20)
    run = read_run(tmp_path)
    assert run.settings == {"task": "reach", "seed": 3}
    np.testing.assert_array_equal(run["return"].step, [10, 20])
    np.testing.assert_array_equal(run["return"].value, [1.5, 2.5])
    np.testing.assert_array_equal(run["loss"].value, [math.nan])
    assert np.all(np.diff(run["return"].elapsed_s) >= 0)
    with pytest.raises(InputError, match="loss, return"):
        run["retrun"]
    # Strict JSON, which other programs read too.
    for line in (tmp_path / METRICS_FILE).read_text().splitlines():
        json.loads(line, parse_constant=lambda word: pytest.fail(word))


KILLED = """
import os, signal, sys
from robotbrain.rl.logs import RunLog
log = RunLog(sys.argv[1], tensorboard=False)
log.scalar("return", 1.0, 10)
log.scalar("return", 2.0, 20)
log._file.write('{"step": 30, "elapsed_s"')
log._file.flush()
os._exit(9)
"""


def test_a_process_killed_in_mid_line_loses_that_line_only(tmp_path: Path) -> None:
    assert subprocess.run([sys.executable, "-c", KILLED, str(tmp_path)], check=False).returncode == 9
    np.testing.assert_array_equal(read_run(tmp_path)["return"].value, [1, 2])
    before = read_run(tmp_path)["return"].elapsed_s[-1]
    with RunLog(tmp_path, resume_step=20, tensorboard=False) as log:
        assert log.elapsed_s >= before
        log.scalar("return", 3.0, 30)
    np.testing.assert_array_equal(read_run(tmp_path)["return"].value, [1, 2, 3])


def test_resuming_drops_what_came_after_the_checkpoint(tmp_path: Path) -> None:
    with RunLog(tmp_path, tensorboard=False) as log:
        for step in (10, 20, 30):
            log.scalar("x", step, step)
    with RunLog(tmp_path, resume_step=20, tensorboard=False) as log:
        log.scalar("x", -30, 30)
    np.testing.assert_array_equal(read_run(tmp_path)["x"].value, [10, 20, -30])
    with RunLog(tmp_path, tensorboard=False):
        pass
    assert read_run(tmp_path).series == {}


def test_damaged_and_missing_logs_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=METRICS_FILE):
        read_run(tmp_path)
    (tmp_path / METRICS_FILE).write_text('{"step": 1, "elapsed_s": 0, "values": {}}\nrubbish\n')
    with pytest.raises(InputError, match="line 2"):
        read_run(tmp_path)
    (tmp_path / METRICS_FILE).write_text("")
    (tmp_path / "run.json").write_text("{")
    with pytest.raises(InputError, match="settings"):
        read_run(tmp_path)


def test_tensorboard_gets_the_same_figures(tmp_path: Path) -> None:
    need(importlib.util.find_spec("tensorboard"), 'no TensorBoard (pip install "robotbrain[rl]")')
    accumulator = importlib.import_module("tensorboard.backend.event_processing.event_accumulator")
    with RunLog(tmp_path, tensorboard=True) as log:
        log.scalar("train/return", 1.5, 10)
        log.scalar("train/return", 2.5, 20)
    events = accumulator.EventAccumulator(str(tmp_path / "tensorboard"))
    events.Reload()
    assert [(event.step, event.value) for event in events.Scalars("train/return")] == [(10, 1.5), (20, 2.5)]


def test_progress_is_silent_into_a_pipe(capsys: pytest.CaptureFixture[str]) -> None:
    with Progress(10) as bar:
        bar.update(5, loss=0.1234567, phase="warm-up")
    assert capsys.readouterr().err == ""

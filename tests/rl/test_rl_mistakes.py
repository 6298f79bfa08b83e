"""What goes wrong around a training: damaged folders, policies of other tasks, changed lengths, strangers' metadata."""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import io
import json
import shutil
from pathlib import Path
from typing import Any

import pytest
import torch

from robotbrain.cli import main
from robotbrain.errors import InputError, RobotBrainError
from robotbrain.rl import checkpoint
from robotbrain.rl.checkpoint import load_checkpoint, save_checkpoint
from robotbrain.rl.export import export_policy
from robotbrain.rl.onnx_policy import OnnxPolicy
from robotbrain.rl.policies import load_policy
from robotbrain.rl.ppo_train import train_ppo
from robotbrain.rl.registry import make
from tests.rl.ppo_toys import ChainEnv, small_cfg

PPO = ["train", "reach", "--algorithm", "ppo", "--envs", "4", "--threads", "1", "--quiet"]
PPO += ["--set", "agent.num_steps_per_env=8", "--set", "agent.actor.hidden_dims=[16]"]


def rl(*words: str | Path) -> int:
    return main(["rl", *map(str, words)])


@pytest.fixture(autouse=True)
def _one_thread() -> None:
    torch.set_num_threads(1)


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("a run")
    assert rl(*PPO, "--set", "env.episode_length_s=1.6", "--run-dir", folder, "--iterations", "1") == 0
    return folder


def test_a_policy_of_another_task_is_refused(trained: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert rl("evaluate", trained, "--task", "velocity", "--episodes", "1", "--threads", "1") == 2
    assert "expected 27" in capsys.readouterr().err


def test_evaluation_tells_which_settings_it_took_over(trained: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert rl("evaluate", trained, "--episodes", "2", "--threads", "1") == 0
    assert "as in its training: env.episode_length_s=1.6" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "answer"), [(["--episodes", "-3"], "1 or more"), (["--set", "agent.gamma=1"], "env.PATH=VALUE")]
)
def test_evaluations_that_cannot_be_meant(
    trained: Path, words: list[str], answer: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert rl("evaluate", trained, *words) == 2
    assert answer in capsys.readouterr().err


@pytest.mark.parametrize("text", ["null", "{}", "[1]", '{"task": "reach"}', "", "{"])
def test_a_damaged_command_file_is_told(
    text: str, trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(trained, tmp_path, dirs_exist_ok=True)
    (tmp_path / "command.json").write_text(text, encoding="utf-8")
    for command in (["resume", tmp_path], ["evaluate", tmp_path], [*PPO, "--run-dir", tmp_path]):
        assert rl(*command) == 2
        assert "command.json" in capsys.readouterr().err


def test_a_new_length_takes_the_place_of_the_old_ones(trained: Path, tmp_path: Path) -> None:
    shutil.copytree(trained, tmp_path, dirs_exist_ok=True)
    for words, iterations in ((["--minutes", "1e-9"], 2), (["--steps", "96"], 3), (["--iterations", "5"], 5)):
        assert rl("resume", tmp_path, *words, "--threads", "1", "--quiet") == 0
        assert load_checkpoint(tmp_path / "checkpoint.pt")["iteration"] == iterations


@pytest.mark.parametrize("minutes", ["-1", "0", "nan", "soon"])
def test_times_that_are_none_are_refused(minutes: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        rl(*PPO, "--minutes", minutes)
    assert "more than 0 minutes" in capsys.readouterr().err


def test_fewer_samples_than_mini_batches_are_refused() -> None:
    with pytest.raises(InputError, match="at least 8 samples for 4 mini-batches"):
        train_ppo(ChainEnv(1), small_cfg(num_steps_per_env=7), iterations=1, progress=False)


@pytest.mark.parametrize("changed", [5, [5], {"a": 1}, "env.seed=1"])
def test_settings_in_a_strangers_file_are_texts(changed: Any, trained: Path, tmp_path: Path) -> None:
    assert rl("export", trained, "--out", tmp_path / "right.onnx") == 0
    meta = OnnxPolicy(tmp_path / "right.onnx").meta
    module = load_policy(trained).module
    assert module is not None
    wrong = dataclasses.replace(meta, provenance={"set": changed})
    export_policy(module, tmp_path / "wrong.onnx", wrong)
    with pytest.raises(InputError, match="a list of texts"):
        load_policy(tmp_path / "wrong.onnx")


def test_settings_in_a_strangers_file_are_not_obeyed(
    trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert rl("export", trained, "--out", tmp_path / "right.onnx") == 0
    module = load_policy(trained).module
    assert module is not None
    endless = ["env.episode_length_s=0.02", "env.terminations=null", "\x1b[2J"]
    wrong = dataclasses.replace(OnnxPolicy(tmp_path / "right.onnx").meta, provenance={"set": endless})
    export_policy(module, tmp_path / "wrong.onnx", wrong)
    assert load_policy(tmp_path / "wrong.onnx").command == {"task": "reach", "set": []}
    assert rl("evaluate", tmp_path / "wrong.onnx", "--episodes", "2", "--threads", "1") == 0
    out = capsys.readouterr().out
    assert "not taken over from the file: 'env.episode_length_s=0.02, env.terminations=null" in out
    assert "\x1b" not in out


def test_a_folder_is_no_policy_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert rl("gap", tmp_path) == 2
    err = capsys.readouterr().err
    assert "(a folder)" in err and "robotbrain rl export" in err


@pytest.mark.parametrize("task", ["reach", "velocity", "navigation"])
def test_every_task_goes_on_exactly_from_a_file(task: str, tmp_path: Path) -> None:
    """Through a checkpoint, where equal numbers are other objects, into an environment with another past."""
    first, second = (make(task, num_envs=2, seed=0, num_threads=1, episode_length_s=0.6) for _ in range(2))
    generator = torch.Generator().manual_seed(1)
    first.reset(seed=1)
    for _ in range(5):
        first.step(torch.randn(2, first.num_actions, generator=generator))
    save_checkpoint(tmp_path / "state.pt", first.state_dict())
    second.reset(seed=2)
    second.load_state_dict(load_checkpoint(tmp_path / "state.pt"))
    for _ in range(35):
        action = torch.randn(2, first.num_actions, generator=generator)
        one, other = first.step(action), second.step(action)
        assert torch.equal(one[0]["policy"], other[0]["policy"])
        assert all(torch.equal(x, y) for x, y in zip(one[1:4], other[1:4], strict=True))


def test_a_damaged_checkpoint_names_the_one_before(
    trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(trained, tmp_path, dirs_exist_ok=True)
    shutil.copy(tmp_path / "checkpoint.pt", tmp_path / "checkpoint.previous.pt")
    (tmp_path / "checkpoint.pt").write_bytes((trained / "checkpoint.pt").read_bytes()[:5000])
    assert rl("resume", tmp_path, "--quiet") == 2
    assert "under the name checkpoint.pt a training goes on from it" in capsys.readouterr().err
    (tmp_path / "checkpoint.previous.pt").replace(tmp_path / "checkpoint.pt")
    assert rl("resume", tmp_path, "--quiet", "--iterations", "1") == 0
    assert json.loads((tmp_path / "command.json").read_text(encoding="utf-8"))["iterations"] == 1


def test_a_full_disk_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Full(io.BytesIO):
        def write(self, data: Any, /) -> int:
            if self.tell() > 500:
                raise OSError(errno.ENOSPC, "No space left on device")
            return super().write(data)

    class Place:
        def open(self, mode: str) -> Full:
            return Full()

    save_checkpoint(tmp_path / "c.pt", {"a": 1})
    monkeypatch.setattr(checkpoint, "atomic_path", lambda target: contextlib.nullcontext(Place()))
    with pytest.raises(RobotBrainError, match="disk full"):
        save_checkpoint(tmp_path / "c.pt", {"a": torch.zeros(1000)})
    assert load_checkpoint(tmp_path / "c.pt") == {"a": 1}


def test_an_export_into_a_folder(trained: Path, tmp_path: Path) -> None:
    assert rl("export", trained, "--out", tmp_path) == 0
    assert (tmp_path / "policy.onnx").is_file()

"""``robotbrain rl``: training survives a kill, mistakes are answered with what would have been right."""

from __future__ import annotations

import dataclasses
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from robotbrain.cli import main
from robotbrain.errors import InputError
from robotbrain.rl.checkpoint import load_checkpoint
from robotbrain.rl.commands import SUBCOMMANDS
from robotbrain.rl.ddpg import DDPGConfig
from robotbrain.rl.logs import read_run
from robotbrain.rl.onnx_policy import OnnxPolicy
from robotbrain.rl.overrides import apply_overrides, split_overrides
from robotbrain.rl.policies import load_policy
from robotbrain.rl.recipes import ddpg_recipe, ppo_recipe
from robotbrain.rl.registry import TASKS
from tests.rl.ppo_toys import small_cfg

TINY = ["--envs", "4", "--threads", "1", "--quiet"]
PPO = ["train", "reach", "--algorithm", "ppo", *TINY, "--set", "agent.save_interval=1"]
PPO += ["--set", "agent.algorithm.num_learning_epochs=1", "--set", "agent.num_steps_per_env=8"]
PPO += ["--set", "agent.actor.hidden_dims=[16]"]


def rl(*words: str | Path) -> int:
    return main(["rl", *map(str, words)])


@pytest.fixture(autouse=True)
def _one_thread() -> None:
    torch.set_num_threads(1)


def iteration(folder: Path) -> int:
    path = folder / "checkpoint.pt"
    return int(load_checkpoint(path)["iteration"]) if path.is_file() else 0


def test_a_killed_training_goes_on_as_if_it_had_not_been(tmp_path: Path) -> None:
    killed, whole = tmp_path / "killed", tmp_path / "whole"
    words = [*PPO, "--run-dir", str(killed), "--iterations", "100000"]
    process = subprocess.Popen([sys.executable, "-m", "robotbrain.cli", "rl", *words], stdout=subprocess.DEVNULL)
    try:
        while not (killed / "checkpoint.previous.pt").is_file():
            assert process.poll() is None, "it ended by itself"
            time.sleep(0.02)
    finally:
        process.kill()
        process.wait()
    total = iteration(killed) + 3
    assert rl("resume", killed, "--iterations", str(total), "--threads", "1", "--quiet") == 0
    assert rl(*PPO, "--run-dir", whole, "--iterations", str(total)) == 0
    assert (killed / "checkpoint.pt").read_bytes() == (whole / "checkpoint.pt").read_bytes()
    for name, series in read_run(whole).series.items():
        if not name.startswith("time/"):
            np.testing.assert_array_equal(read_run(killed)[name].value, series.value)


def test_the_same_command_goes_on_and_another_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = [*PPO, "--run-dir", tmp_path]
    assert rl(*words, "--iterations", "1") == 0
    assert "Training reach: ppo, 4 environments, seed 0, 1 iterations, 32 steps" in capsys.readouterr().out
    assert rl(*words, "--steps", "96") == 0
    assert "Going on with reach" in capsys.readouterr().out and iteration(tmp_path) == 3
    assert rl("resume", tmp_path, "--quiet") == 0  # the length is remembered
    assert iteration(tmp_path) == 3
    assert rl(*words, "--seed", "1") == 2
    assert "seed = 1" in capsys.readouterr().err
    # What was trained can be tried and exported, and the file does what the checkpoint does.
    assert rl("evaluate", tmp_path, "--episodes", "5") == 0
    assert "0.0 % (0.0 to 52.2)" in capsys.readouterr().out
    assert rl("export", tmp_path) == 0
    policy = OnnxPolicy(tmp_path / "policy.onnx")
    assert policy.meta.task == "reach" and policy.meta.provenance["algorithm"] == "ppo"
    obs = np.random.default_rng(0).normal(size=(3, policy.meta.observation_dim)).astype(np.float32)
    trained, exported = load_policy(tmp_path), load_policy(tmp_path / "policy.onnx")
    np.testing.assert_allclose(trained.act(obs), exported.act(obs), atol=1e-5)
    assert np.abs(trained.act(100 * obs)).max() <= 1  # as it was clipped in training
    assert rl("export", tmp_path / "policy.onnx") == 2


def test_ddpg_too(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["train", "reach", *TINY, "--run-dir", tmp_path, "--seed", "3"]
    words += ["--set", "agent.warmup_steps=100", "--set", "agent.hidden=[16, 16]", "--set", "agent.eval_every=10000"]
    assert rl(*words, "--steps", "400") == 0
    assert rl(*words, "--steps", "600") == 0
    saved = load_checkpoint(tmp_path / "checkpoint.pt", kind="ddpg")
    assert saved["step"] == 600 and saved["config"]["hidden"] == (16, 16) and saved["seed"] == 3
    assert rl("evaluate", tmp_path, "--episodes", "4") == 0
    assert rl("export", tmp_path, "--out", tmp_path / "p.onnx") == 0
    obs = np.zeros((2, OnnxPolicy(tmp_path / "p.onnx").meta.observation_dim), np.float32)
    np.testing.assert_allclose(load_policy(tmp_path).act(obs), load_policy(tmp_path / "p.onnx").act(obs), atol=1e-5)
    capsys.readouterr()
    assert rl("resume", tmp_path, "--iterations", "5") == 2
    assert "--steps" in capsys.readouterr().err


def test_ctrl_c_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    from robotbrain.rl import ppo_train

    loop = ppo_train.training_loop

    def press(iterate: Any, *rest: Any, **options: Any) -> Any:
        def once() -> Any:
            signal.raise_signal(signal.SIGINT)
            return iterate()

        return loop(once, *rest, **options)

    monkeypatch.setattr(ppo_train, "training_loop", press)
    assert rl(*PPO, "--run-dir", tmp_path, "--iterations", "50") == 130
    assert "same command again" in capsys.readouterr().err
    assert iteration(tmp_path) == 1


def test_list_shows_sizes_and_terms(capsys: pytest.CaptureFixture[str]) -> None:
    assert rl("list") == 0
    out = capsys.readouterr().out
    assert all(task in out for task in TASKS)
    assert rl("list", "velocity") == 0
    out = capsys.readouterr().out
    assert "'policy': 48 numbers" in out and "track_lin_vel_xy_exp" in out and "base_contact" in out


@pytest.mark.parametrize(
    ("words", "answer"),
    [
        (["list", "velocty"], "Did you mean 'velocity'"),
        (["train", "raech"], "Did you mean 'reach'"),
        (["train", "reach", "--set", "episode_length_s=3"], "env.PATH=VALUE"),
        (["train", "reach", "--set", "env.episode_lenght_s=3"], "Did you mean 'episode_length_s'"),
        (["train", "reach", "--set", "env.rewards.position_trakcing.weight=3"], "Did you mean 'position_tracking'"),
        (["train", "reach", "--set", "agent.gama=0.9"], "Did you mean 'gamma'"),
        (["train", "reach", "--set", "agent.gamma=high"], "a float"),
        (["train", "velocity", "--set", "agent.actor.activation=eluu", "--envs", "2"], "Did you mean 'elu'"),
        (["resume", "nowhere"], "command.json"),
        (["evaluate", "nowhere"], "existing file"),
    ],
)
def test_mistakes_are_answered(
    words: list[str], answer: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert rl(*words) == 2
    assert answer in capsys.readouterr().err


def test_every_subcommand_has_help(capsys: pytest.CaptureFixture[str]) -> None:
    for name in SUBCOMMANDS:
        with pytest.raises(SystemExit) as end:
            rl(name, "--help")
        assert end.value.code == 0 and f"robotbrain rl {name}" in capsys.readouterr().out


def test_impossible_lengths_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    for words in (["--steps", "0"], ["--steps", "many"], ["--steps", "5", "--iterations", "5"]):
        with pytest.raises(SystemExit):
            rl("train", "reach", *words)
    assert "200k" in capsys.readouterr().err


# ------------------------------------------------------------ overrides and recipes


def test_values_keep_the_kind_of_what_they_replace() -> None:
    cfg = small_cfg()
    values = split_overrides(
        [
            "agent.algorithm.gamma=1",
            "agent.algorithm.learning_rate=3e-4",
            "agent.actor.hidden_dims=[8, 8]",
            "agent.actor.distribution_cfg.std_range=[0.1, 1]",
            "agent.clip_actions=2.5",
            "agent.num_steps_per_env=1e3",
            "env.rewards.alive=null",
        ]
    )
    apply_overrides(cfg, values["agent"], "agent")
    assert (cfg.algorithm.gamma, cfg.algorithm.learning_rate) == (1.0, 3e-4)
    assert isinstance(cfg.algorithm.gamma, float)
    assert cfg.actor.hidden_dims == [8, 8] and cfg.actor.distribution_cfg.std_range == (0.1, 1)
    assert cfg.clip_actions == 2.5 and cfg.num_steps_per_env == 1000
    assert values["env"] == {"rewards.alive": None}
    changed = apply_overrides(DDPGConfig(), {"hidden": [8, 8], "gamma": 0.5}, "agent")
    assert changed == dataclasses.replace(DDPGConfig(), hidden=(8, 8), gamma=0.5)


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("algorithm", 3),
        ("algorithm.gamma", "high"),
        ("algorithm.symmetry_cfg.mirror_loss_coeff", 1.0),
        ("save_interval", 2.5),
        ("save_interval", True),
        ("obs_groups.actr", ["policy"]),
        ("actor.hidden_dims.7", 3),
        ("seed.bits", 3),
    ],
)
def test_values_of_another_kind_are_refused(path: str, value: Any) -> None:
    with pytest.raises(InputError):
        apply_overrides(small_cfg(), {path: value}, "agent")


@pytest.mark.parametrize("task", list(TASKS))
def test_recipes_are_complete(task: str) -> None:
    ppo_recipe(task).validate()
    assert ddpg_recipe(task).total_steps > 0

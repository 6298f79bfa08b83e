"""rsl-rl as the learner: the same steps as the kit's PPO, and the same promises about runs."""

from __future__ import annotations

import importlib
import importlib.metadata
import importlib.util
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from robotbrain.errors import InputError, MissingDependencyError
from robotbrain.rl.logs import read_run
from robotbrain.rl.ppo import PPO, Network
from robotbrain.rl.ppo_cfg import RslRlOnPolicyRunnerCfg, RslRlSymmetryCfg
from robotbrain.rl.ppo_env import ppo_env
from robotbrain.rl.ppo_train import CHECKPOINT_FILE, train_ppo
from robotbrain.rl.rsl_rl_runner import (
    MODEL_FILE,
    RslRlVecEnv,
    actor_of,
    load_rsl_rl_actor,
    make_runner,
    network_from_rsl_rl,
    train_rsl_rl,
)
from tests.conftest import need
from tests.rl.ppo_toys import PointEnv, mirror, small_cfg

OPTIONS: dict[str, Any] = {"progress": False, "tensorboard": False}


@pytest.fixture(autouse=True)
def _installed() -> None:
    torch.set_num_threads(1)
    need(importlib.util.find_spec("rsl_rl"), 'no rsl-rl (pip install "robotbrain[rl]")')


def same_weights(agent: PPO, algorithm: Any, cfg: RslRlOnPolicyRunnerCfg) -> float:
    """Return by how much the networks of rsl-rl differ from those of the kit."""
    saved = algorithm.save()
    largest = 0.0
    for mine, name, model in ((agent.actor, "actor", cfg.actor), (agent.critic, "critic", cfg.critic)):
        theirs = network_from_rsl_rl(saved[f"{name}_state_dict"], model)
        for a, b in zip(mine.parameters(), theirs.parameters(), strict=True):
            largest = max(largest, float((a - b).detach().abs().max()))
    return largest


@pytest.mark.parametrize("symmetric", [False, True])
@pytest.mark.parametrize("clipped_value", [False, True])
def test_one_batch_teaches_both_the_same(symmetric: bool, clipped_value: bool) -> None:
    # All samples in one part, so that their order does not matter; three steps, so that ratios, divergence and
    # learning rate are not those of the beginning.
    cfg = small_cfg(
        **{
            "algorithm.num_mini_batches": 1,
            "algorithm.num_learning_epochs": 3,
            "algorithm.use_clipped_value_loss": clipped_value,
            "algorithm.entropy_coef": 0.01,
            "algorithm.learning_rate": 3e-3,
        }
    )
    if symmetric:
        cfg.algorithm.symmetry_cfg = RslRlSymmetryCfg(
            use_data_augmentation=True, use_mirror_loss=True, mirror_loss_coeff=0.5, data_augmentation_func=mirror
        )
    torch.manual_seed(0)
    vec = RslRlVecEnv(PointEnv(limit=1000), seed=0)
    runner = make_runner(vec, cfg)
    agent = PPO({"policy": 2}, 1, cfg)
    saved = runner.alg.save()
    agent.actor.load_state_dict(network_from_rsl_rl(saved["actor_state_dict"], cfg.actor).state_dict())
    agent.critic.load_state_dict(network_from_rsl_rl(saved["critic_state_dict"], cfg.critic).state_dict())
    stepper = ppo_env(PointEnv(limit=1000))
    rollout, last = agent.collect(stepper, stepper.reset(0))
    from tensordict import TensorDict

    algorithm = runner.alg
    with torch.inference_mode():
        for t in range(cfg.num_steps_per_env):
            algorithm.act(TensorDict({"policy": rollout.obs["policy"][t]}, batch_size=[16]))
            # Its own draw is replaced by what the kit's agent did.
            algorithm.transition.actions = rollout.action[t]
            algorithm.transition.actions_log_prob = algorithm.actor.get_output_log_prob(rollout.action[t])
            nothing = {"time_outs": torch.zeros(16, dtype=torch.bool)}
            algorithm.process_env_step(None, rollout.reward[t], rollout.done[t].long(), nothing)
        algorithm.compute_returns(TensorDict(dict(last), batch_size=[16]))
    storage = algorithm.storage
    torch.testing.assert_close(storage.returns.squeeze(-1), rollout.advantage + rollout.value, atol=1e-5, rtol=1e-5)
    assert same_weights(agent, algorithm, cfg) == 0
    before = agent.actor.mlp[0].weight.detach().clone()  # type: ignore[union-attr,operator]
    figures, theirs = agent.update(rollout), algorithm.update()
    assert figures["loss/surrogate"] == pytest.approx(theirs["surrogate"], abs=1e-5)
    assert figures["loss/value"] == pytest.approx(theirs["value"], rel=1e-4)
    assert figures["policy/entropy"] == pytest.approx(theirs["entropy"], rel=1e-5)
    assert figures["policy/learning_rate"] == pytest.approx(algorithm.learning_rate)
    assert figures["policy/learning_rate"] != 3e-3
    if symmetric:
        assert figures["loss/mirror"] == pytest.approx(theirs["symmetry"], rel=1e-3, abs=1e-6)
    moved = float((agent.actor.mlp[0].weight - before).abs().max())  # type: ignore[union-attr,operator]
    assert same_weights(agent, algorithm, cfg) < 0.01 * moved


def test_learns_and_its_model_is_read_back(tmp_path: Path) -> None:
    cfg = small_cfg(max_iterations=25, num_steps_per_env=20)
    env = PointEnv(num_envs=64)
    result = train_rsl_rl(env, cfg, run_dir=tmp_path, **OPTIONS)
    returns = result.run["train/return"].value
    assert returns[-1] > 0.4 * returns.min() and result.steps == 25 * 20 * 64
    assert {"loss/surrogate", "loss/value", "policy/std", "env/distance"} <= result.run.series.keys()
    obs = torch.randn(5, 2)
    from tensordict import TensorDict

    with torch.no_grad():
        expected = result.agent.get_inference_policy()(TensorDict({"policy": obs}, batch_size=[5]))
        for network in (actor_of(result.agent, cfg.actor), load_rsl_rl_actor(tmp_path / MODEL_FILE, cfg.actor)):
            assert isinstance(network, Network)
            torch.testing.assert_close(network(obs), expected)
    # Tensors of inference mode could not be written to any more by whoever steps the environment next.
    assert not env.obs_buf["policy"].is_inference()
    # The runner's own way of going on takes the file too.
    runner = make_runner(RslRlVecEnv(PointEnv(), seed=0), cfg)
    runner.load(str(tmp_path / MODEL_FILE))
    assert runner.current_learning_iteration == 25


def test_resumed_training_is_the_uninterrupted_one_bit_by_bit(tmp_path: Path) -> None:
    cfg = small_cfg(max_iterations=5)
    train_rsl_rl(PointEnv(), cfg, run_dir=tmp_path / "whole", **OPTIONS)
    for iterations in (2, 5):
        torch.manual_seed(iterations)
        train_rsl_rl(PointEnv(), cfg, run_dir=tmp_path / "parts", resume=True, iterations=iterations, **OPTIONS)
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    assert (whole / CHECKPOINT_FILE).read_bytes() == (parts / CHECKPOINT_FILE).read_bytes()
    np.testing.assert_array_equal(read_run(whole)["loss/value"].value, read_run(parts)["loss/value"].value)
    with pytest.raises(InputError, match=r"rsl-rl.*ppo"):
        train_ppo(PointEnv(), cfg, run_dir=whole, resume=True, **OPTIONS)


def test_settings_that_rsl_rl_refuses_are_named() -> None:
    with pytest.raises(InputError, match="rsl-rl says"):
        train_rsl_rl(PointEnv(), small_cfg(**{"actor.activation": "eluu"}), **OPTIONS)


def test_models_that_do_not_fit_are_named(tmp_path: Path) -> None:
    cfg = small_cfg(max_iterations=1)
    with pytest.raises(InputError, match="existing"):
        load_rsl_rl_actor(tmp_path / MODEL_FILE, cfg.actor)
    train_rsl_rl(PointEnv(), cfg, run_dir=tmp_path, **OPTIONS)
    for changes in ({"actor.hidden_dims": [8]}, {"actor.obs_normalization": False}):
        with pytest.raises(InputError, match="rsl-rl's model"):
            load_rsl_rl_actor(tmp_path / MODEL_FILE, small_cfg(**changes).actor)
    (tmp_path / MODEL_FILE).write_bytes(b"rubbish")
    with pytest.raises(InputError, match="saved by rsl-rl"):
        load_rsl_rl_actor(tmp_path / MODEL_FILE, cfg.actor)


def test_a_missing_or_other_version_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.metadata, "version", lambda name: "6.0.1")
    with pytest.raises(MissingDependencyError, match=r"5\.5\.x \(there is 6\.0\.1\).*robotbrain\[rl\]"):
        train_rsl_rl(PointEnv(), small_cfg(), **OPTIONS)

    def missing(name: str) -> str:
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(importlib.metadata, "version", missing)
    with pytest.raises(MissingDependencyError, match=r"robotbrain\[rl\]"):
        train_rsl_rl(PointEnv(), small_cfg(), **OPTIONS)

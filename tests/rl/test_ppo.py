"""PPO: its formulas against brute force and finite differences, its loop against known values and itself, resumed."""

from __future__ import annotations

import dataclasses
import math
import signal
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from torch.distributions import Independent, Normal, kl_divergence

from robotbrain.errors import InputError, RobotBrainError
from robotbrain.rl.checkpoint import load_checkpoint
from robotbrain.rl.logs import read_run
from robotbrain.rl.ppo import (
    PPO,
    Network,
    Rollout,
    RunningNorm,
    adapted_rate,
    gae,
    gaussian_kl,
    gaussian_log_prob,
    surrogate_loss,
    value_loss,
)
from robotbrain.rl.ppo_cfg import RslRlSymmetryCfg
from robotbrain.rl.ppo_env import ppo_env
from robotbrain.rl.ppo_train import CHECKPOINT_FILE, PpoState, load_actor, train_ppo
from tests.rl.ppo_toys import ChainEnv, PointEnv, mirror, small_cfg


@pytest.fixture(autouse=True)
def _one_thread() -> None:
    torch.set_num_threads(1)


# ------------------------------------------------------------ formulas


@pytest.mark.parametrize(("gamma", "lam"), [(0.9, 0.8), (0.99, 0.0), (1.0, 1.0), (0.0, 0.5)])
def test_gae_is_the_sum_of_its_definition(gamma: float, lam: float) -> None:
    draw = torch.Generator().manual_seed(3)
    reward, value, next_value = torch.randn(3, 9, 4, generator=draw, dtype=torch.float64)
    terminated = torch.rand(9, 4, generator=draw) < 0.2
    truncated = (torch.rand(9, 4, generator=draw) < 0.2) & ~terminated
    expected = torch.zeros(9, 4, dtype=torch.float64)
    for n in range(4):
        for t in range(9):
            for k in range(9 - t):
                bootstrap = 0.0 if terminated[t + k, n] else gamma * next_value[t + k, n]
                expected[t, n] += (gamma * lam) ** k * (reward[t + k, n] + bootstrap - value[t + k, n])
                if terminated[t + k, n] or truncated[t + k, n]:
                    break
    torch.testing.assert_close(gae(reward, value, next_value, terminated, truncated, gamma, lam), expected)


def test_surrogate_gradient_is_that_of_finite_differences_and_zero_where_clipped() -> None:
    draw = torch.Generator().manual_seed(0)
    old = torch.randn(64, generator=draw, dtype=torch.float64)
    # Ratios away from the kinks at 0.8 and 1.2, where no derivative exists.
    ratio = torch.tensor([0.5, 0.9, 1.1, 1.5], dtype=torch.float64).repeat(16)
    advantage = torch.randn(64, generator=draw, dtype=torch.float64)
    new = (old + ratio.log()).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: surrogate_loss(x, old, advantage, 0.2), (new,))
    surrogate_loss(new, old, advantage, 0.2).backward()
    assert new.grad is not None
    clipped = ((ratio > 1.2) & (advantage > 0)) | ((ratio < 0.8) & (advantage < 0))
    assert clipped.any() and (~clipped).any()
    assert torch.equal(new.grad == 0, clipped)
    # Where nothing is clipped it is the policy gradient: -ratio * advantage / B.
    torch.testing.assert_close(new.grad[~clipped], (-ratio * advantage / 64)[~clipped])


def test_value_loss_by_hand() -> None:
    value, old, target = (torch.tensor(x) for x in ([1.0, 2.0], [0.0, 2.0], [1.0, 0.0]))
    assert value_loss(value, old, target, None).item() == pytest.approx((0 + 4) / 2)
    # The first may not have come further than 0.2 from 0: its error there counts.
    assert value_loss(value, old, target, 0.2).item() == pytest.approx((0.8**2 + 4) / 2)


def test_densities_and_divergence_are_those_of_torch() -> None:
    draw = torch.Generator().manual_seed(1)
    action, mean, old_mean = torch.randn(3, 7, 4, generator=draw)
    std, old_std = torch.rand(2, 4, generator=draw) + 0.2
    new, old = Independent(Normal(mean, std), 1), Independent(Normal(old_mean, old_std), 1)
    torch.testing.assert_close(gaussian_log_prob(action, mean, std), new.log_prob(action))
    torch.testing.assert_close(gaussian_kl(old_mean, old_std, mean, std), kl_divergence(old, new))


def test_learning_rate_follows_the_divergence() -> None:
    assert adapted_rate(1e-3, 0.021, 0.01) == pytest.approx(1e-3 / 1.5)
    assert adapted_rate(1e-3, 0.004, 0.01) == pytest.approx(1.5e-3)
    assert adapted_rate(1e-3, 0.01, 0.01) == 1e-3
    assert adapted_rate(1e-3, 0.0, 0.01) == 1e-3  # of the first step, before anything has changed
    assert adapted_rate(1.2e-5, 1.0, 0.01) == 1e-5
    assert adapted_rate(9e-3, 1e-4, 0.01) == 1e-2


def test_running_norm_has_the_statistics_of_all_samples() -> None:
    norm = RunningNorm(3)
    samples = np.random.default_rng(0).normal([0, 5, -2], [1, 0.1, 30], (1000, 3)).astype(np.float32)
    for part in np.split(samples, [1, 10, 400]):
        norm.update(torch.from_numpy(part))
    np.testing.assert_allclose(norm.mean, samples.mean(0), rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(norm.var, samples.var(0), rtol=1e-3)
    out = norm(torch.from_numpy(samples))
    np.testing.assert_allclose(out.mean(0), 0, atol=1e-3)
    np.testing.assert_allclose(out.std(0), [1, 0.1 / 0.11, 1], rtol=0.05)


# ------------------------------------------------------------ collecting


def constant_critic(agent: PPO, value: float) -> None:
    with torch.no_grad():
        for parameter in agent.critic.parameters():
            parameter.zero_()
        agent.critic.mlp[-1].bias.fill_(value)  # type: ignore[union-attr,operator]


def collected(env: Any, **changes: Any) -> tuple[PPO, Rollout]:
    stepper = ppo_env(env)
    obs = stepper.reset(0)
    agent = PPO({name: x.shape[1] for name, x in obs.items()}, 1, small_cfg(**changes))
    constant_critic(agent, 10.0)
    return agent, agent.collect(stepper, obs)[0]


def test_a_time_limit_is_no_end_of_the_world() -> None:
    # A reward of 1 for ever is worth 1 / (1 - 0.9) = 10 everywhere: a critic that says so is never surprised.
    changes = {"num_steps_per_env": 12, "algorithm.gamma": 0.9}
    _, rollout = collected(ChainEnv(num_envs=3, limit=5), **changes)
    assert rollout.done.sum() == 6  # two ends in each environment
    torch.testing.assert_close(rollout.advantage, torch.zeros(12, 3), atol=1e-5, rtol=0)
    # With a finite horizon it is wrong: k steps before the end only (1 - 0.9^k) / 0.1 was still to be had.
    _, rollout = collected(ChainEnv(num_envs=3, limit=5, finite=True), **changes, **{"algorithm.lam": 1.0})
    to_go = torch.tensor([5, 4, 3, 2, 1] * 2)
    torch.testing.assert_close(rollout.advantage[:10, 0], (1 - 0.9**to_go) / 0.1 - 10, atol=1e-5, rtol=0)


def test_who_fails_in_the_last_step_has_failed() -> None:
    env = PointEnv(num_envs=2, limit=1)
    stepper = ppo_env(env)
    stepper.reset(0)
    env.state[0, 0] = 5.0
    step = stepper.step(torch.zeros(2, 1))
    assert step.terminated.tolist() == [True, False] and step.truncated.tolist() == [False, True]


def test_the_value_after_a_time_limit_is_that_of_the_final_observation() -> None:
    env = ChainEnv(num_envs=2, limit=4)
    stepper = ppo_env(env)
    obs = stepper.reset(0)
    cfg = small_cfg(num_steps_per_env=4)
    cfg.critic.obs_normalization = False
    agent = PPO({"policy": 1}, 1, cfg)
    asked = []
    forward = agent.critic.forward
    agent.critic.forward = lambda x: (asked.append(x), forward(x))[1]  # type: ignore[assignment,method-assign]
    agent.collect(stepper, obs)
    assert [x.flatten().tolist() for x in asked] == [[0, 0, 1, 1, 2, 2, 3, 3, 0, 0], [4, 4]]


def test_observations_are_those_before_the_action_although_the_environment_reuses_its_memory() -> None:
    class Reuses(PointEnv):
        def _obs(self) -> dict[str, torch.Tensor]:
            fresh = super()._obs()["policy"]
            self.memory = getattr(self, "memory", fresh.clone())
            self.memory[:] = fresh
            return {"policy": self.memory}

    _, plain = collected(PointEnv())
    _, reused = collected(Reuses())
    assert torch.equal(plain.obs["policy"], reused.obs["policy"])
    assert not torch.equal(plain.obs["policy"][0], plain.obs["policy"][1])


def test_gymnasium_vector_environments_too() -> None:
    same_step = {"autoreset_mode": gymnasium.vector.AutoresetMode.SAME_STEP}
    env = gymnasium.make_vec("Pendulum-v1", 3, vector_kwargs=same_step, max_episode_steps=5)
    stepper = ppo_env(env)
    first = stepper.reset(4)["policy"]
    assert first.shape == (3, 3) and first.dtype == torch.float32
    single = gymnasium.make("Pendulum-v1", max_episode_steps=5)
    single.reset(seed=4)
    for index in range(5):
        step = stepper.step(torch.full((3, 1), 9.0))  # clipped to 2
        alone, reward, *_ = single.step(np.full(1, 2.0, np.float32))
        assert step.reward[0].item() == pytest.approx(float(reward), rel=1e-5)
        assert step.truncated.all() == (index == 4)
    assert step.final_obs is not None
    torch.testing.assert_close(step.final_obs["policy"][0], torch.from_numpy(alone))
    assert not torch.equal(step.obs["policy"][0], step.final_obs["policy"][0])
    result = train_ppo(env, small_cfg(max_iterations=2), progress=False)
    assert result.steps == 2 * 3 * 16 and math.isfinite(result.run["train/return"].value[-1])
    with pytest.raises(InputError, match="SAME_STEP"):
        ppo_env(gymnasium.make_vec("Pendulum-v1", 2))
    with pytest.raises(InputError, match="one dimension"):
        ppo_env(gymnasium.make_vec("CartPole-v1", 2, "sync", vector_kwargs=same_step))
    with pytest.raises(InputError, match="VectorEnv"):
        ppo_env(single)


# ------------------------------------------------------------ learning


def weights(agent: PPO) -> torch.Tensor:
    return torch.cat([p.detach().flatten() for net in (agent.actor, agent.critic) for p in net.parameters()])


def test_with_symmetry_a_mirrored_world_teaches_the_same() -> None:
    changes = {"algorithm.schedule": "fixed"}
    agents = []
    for flip in (1.0, -1.0):
        agent, rollout = collected(PointEnv(), **changes)
        agent = PPO({"policy": 2}, 1, small_cfg(**changes))
        agent.cfg.algorithm.symmetry_cfg = RslRlSymmetryCfg(use_data_augmentation=True, data_augmentation_func=mirror)
        mirrored = {name: flip * x for name, x in rollout.obs.items()}
        rollout = dataclasses.replace(rollout, obs=mirrored, action=flip * rollout.action, mean=flip * rollout.mean)
        agent.update(rollout)
        agents.append(agent)
    start = PPO({"policy": 2}, 1, small_cfg())
    assert (weights(agents[0]) - weights(start)).abs().max() > 1e-3
    torch.testing.assert_close(weights(agents[0]), weights(agents[1]), atol=2e-6, rtol=1e-5)
    assert agents[0].actor.normalizer.mean.abs().max() < 1e-7  # type: ignore[union-attr,operator]


def test_the_mirror_loss_makes_the_policy_symmetric() -> None:
    def asymmetry(coefficient: float) -> float:
        cfg = small_cfg(max_iterations=15)
        cfg.algorithm.symmetry_cfg = RslRlSymmetryCfg(
            use_mirror_loss=True, mirror_loss_coeff=coefficient, data_augmentation_func=mirror
        )
        agent = train_ppo(PointEnv(), cfg, progress=False).agent
        x = torch.randn(200, 2, generator=torch.Generator().manual_seed(0))
        with torch.no_grad():
            return float((agent.actor(x) + agent.actor(-x)).abs().mean())

    assert asymmetry(5.0) < 0.5 * asymmetry(0.0)


def test_a_wrong_symmetry_function_is_named() -> None:
    agent, rollout = collected(PointEnv())
    agent.cfg.algorithm.symmetry_cfg = RslRlSymmetryCfg(
        use_data_augmentation=True,
        data_augmentation_func=lambda env, obs, actions: (mirror(env, obs, None)[0], actions),
    )
    with pytest.raises(InputError, match="data_augmentation_func"):
        agent.update(rollout)


def test_learns_to_reach_and_what_it_saves_is_what_it_learnt(tmp_path: Path) -> None:
    cfg = small_cfg(max_iterations=40, num_steps_per_env=20)
    result = train_ppo(PointEnv(num_envs=64), cfg, run_dir=tmp_path, progress=False, tensorboard=False)
    returns = result.run["train/return"].value
    assert returns[0] < -8
    assert returns[-1] > -4.5  # the quickest possible is about -3
    assert result.run["policy/std"].value[-1] < 0.7
    obs = torch.randn(9, 2)
    assert torch.equal(load_actor(tmp_path / CHECKPOINT_FILE)(obs), result.agent.act({"policy": obs}))
    assert read_run(tmp_path)["train/return"].value.tolist() == returns.tolist()


def same_figures(a: dict[str, Any], b: dict[str, Any]) -> bool:
    return a.keys() == b.keys() and all(
        np.array_equal(a[name].value, b[name].value) and np.array_equal(a[name].step, b[name].step)
        for name in a
        if not name.startswith("time/")
    )


def test_resumed_training_is_the_uninterrupted_one_bit_by_bit(tmp_path: Path) -> None:
    cfg = small_cfg(max_iterations=6)
    options: dict[str, Any] = {"progress": False, "tensorboard": False}
    train_ppo(PointEnv(), cfg, run_dir=tmp_path / "whole", **options)
    for iterations in (2, 5, 6):
        env = PointEnv()
        env.reset(seed=999)  # whatever it did before does not matter
        torch.manual_seed(iterations)  # nor does torch's global generator
        resumed = train_ppo(env, cfg, run_dir=tmp_path / "parts", resume=True, iterations=iterations, **options)
    assert resumed.iteration == 6 and resumed.steps == 6 * 16 * 16
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    assert (whole / CHECKPOINT_FILE).read_bytes() == (parts / CHECKPOINT_FILE).read_bytes()
    assert same_figures(read_run(whole).series, read_run(parts).series)
    # Seeds matter, and the figures compared are not trivially equal.
    other = train_ppo(PointEnv(), small_cfg(max_iterations=6, seed=2), **options)
    assert not same_figures(other.run.series, read_run(whole).series)


def test_training_neither_uses_nor_moves_the_global_generator() -> None:
    torch.manual_seed(5)
    expected = torch.rand(3)
    torch.manual_seed(5)
    train_ppo(PointEnv(), small_cfg(max_iterations=1), progress=False)
    assert torch.equal(torch.rand(3), expected)


def test_ctrl_c_finishes_the_iteration_and_saves(tmp_path: Path) -> None:
    def press(state: PpoState) -> None:
        if state.iteration == 3:
            signal.raise_signal(signal.SIGINT)

    cfg = small_cfg(max_iterations=50, save_interval=1000)
    handler = signal.getsignal(signal.SIGINT)
    result = train_ppo(PointEnv(), cfg, run_dir=tmp_path, callback=press, progress=False, tensorboard=False)
    assert result.interrupted and result.iteration == 3
    assert load_checkpoint(tmp_path / CHECKPOINT_FILE, kind="ppo")["iteration"] == 3
    assert signal.getsignal(signal.SIGINT) is handler

    def press_twice(state: PpoState) -> None:
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        train_ppo(PointEnv(), cfg, callback=press_twice, progress=False)
    assert signal.getsignal(signal.SIGINT) is handler


def test_limits_and_callback_stop() -> None:
    assert train_ppo(PointEnv(), small_cfg(), minutes=0, progress=False).iteration == 1
    assert train_ppo(PointEnv(), small_cfg(), callback=lambda s: s.iteration == 2, progress=False).iteration == 2
    seen: list[bool] = []
    result = train_ppo(PointEnv(), small_cfg(), callback=lambda s: seen.append(s.last), progress=False)
    assert seen == [False, False, False, True] and not result.interrupted
    assert "env/distance" in result.run.series


# ------------------------------------------------------------ mistakes


def test_runs_are_not_mixed_up(tmp_path: Path) -> None:
    options: dict[str, Any] = {"run_dir": tmp_path, "progress": False, "tensorboard": False}
    train_ppo(PointEnv(), small_cfg(), **options)
    with pytest.raises(InputError, match="resume=True"):
        train_ppo(PointEnv(), small_cfg(), **options)
    with pytest.raises(InputError, match=r"cfg\.algorithm\.gamma = 0\.5.*cfg\.algorithm\.gamma = 0\.95"):
        train_ppo(PointEnv(), small_cfg(**{"algorithm.gamma": 0.5}), resume=True, **options)
    with pytest.raises(InputError, match="num_envs"):
        train_ppo(PointEnv(num_envs=8), small_cfg(), resume=True, **options)
    with pytest.raises(InputError, match="run_dir"):
        train_ppo(PointEnv(), small_cfg(), resume=True)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"actor.activation": "eluu"}, "Did you mean 'elu'"),
        ({"algorithm.optimizer": "lion"}, "adam"),
        ({"algorithm.schedule": "cosine"}, "adaptive"),
        ({"actor.distribution_cfg": None}, "explore"),
        ({"obs_groups": {"actor": ["polcy"], "critic": ["policy"]}}, "Did you mean 'policy'"),
        ({"obs_groups": {"actor": ["policy"]}}, "critic"),
        ({"algorithm.rnd_cfg": {}}, "rsl_rl_runner"),
        ({"actor.class_name": "RNNModel"}, "rsl_rl_runner"),
    ],
)
def test_settings_that_do_not_work_are_named(changes: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError, match=words):
        PPO({"policy": 2}, 1, small_cfg(**changes))


def test_what_is_not_a_number_is_traced_to_its_place() -> None:
    class Breaks(PointEnv):
        def _obs(self) -> dict[str, torch.Tensor]:
            obs = super()._obs()
            if self.episode_length_buf[5] == 3:
                obs["policy"][5, 1] = torch.nan
            return obs

    with pytest.raises(InputError, match=r"'policy'.*nan in environment 5, component 1"):
        train_ppo(Breaks(), small_cfg(init_at_random_ep_len=False), progress=False)


def test_divergence_is_said_and_not_saved() -> None:
    agent, rollout = collected(PointEnv())
    rollout.advantage[0, 0] = torch.inf
    before = weights(agent)
    with pytest.raises(RobotBrainError, match="diverged"):
        agent.update(rollout)
    assert torch.equal(weights(agent), before)


def test_privileged_critic_and_images_of_observations() -> None:
    cfg = small_cfg(obs_groups={"actor": ["policy"], "critic": ["policy", "privileged"]})
    agent = PPO({"policy": 2, "privileged": 3}, 1, cfg)
    assert agent.actor.mlp[0].in_features == 2 and agent.critic.mlp[0].in_features == 5
    flat = agent.critic.inputs({"privileged": torch.full((4, 3), 2.0), "policy": torch.ones(4, 2)})
    assert flat[0].tolist() == [1, 1, 2, 2, 2]

    class Image(PointEnv):
        def _obs(self) -> dict[str, torch.Tensor]:
            return {"policy": torch.zeros(self.num_envs, 4, 4)}

    with pytest.raises(InputError, match=r"num_envs, size"):
        train_ppo(Image(), small_cfg(), progress=False)


@pytest.mark.parametrize("std_type", ["scalar", "log"])
def test_deviation_begins_and_stays_in_its_range(std_type: str) -> None:
    cfg = small_cfg(**{"actor.distribution_cfg.init_std": 0.7, "actor.distribution_cfg.std_type": std_type})
    cfg.actor.distribution_cfg.std_range = (0.5, 1.0)
    network = Network({"policy": 2}, 3, cfg.actor)
    torch.testing.assert_close(network.std(), torch.full((3,), 0.7))
    with torch.no_grad():
        network.std_param.sub_(10)
    torch.testing.assert_close(network.std(), torch.full((3,), 0.5))

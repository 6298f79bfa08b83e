"""Tasks behind Gymnasium's interfaces."""

from __future__ import annotations

import subprocess
import sys
import warnings
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env

from robotbrain.errors import InputError
from robotbrain.rl import registry
from robotbrain.rl.envs import ManagerBasedRLEnv
from robotbrain.rl.envs.gym import TaskEnv, TaskVectorEnv
from robotbrain.rl.managers import ObservationTermCfg
from tests.rl import tiny_tasks as tiny

torch.set_num_threads(1)


def counted(cfg: Any) -> Any:
    cfg.observations.policy.step = ObservationTermCfg(func=tiny.step_number)
    return cfg


@pytest.mark.parametrize("cfg", [tiny.ArmCfg, tiny.WalkerCfg])
def test_single_environment_passes_the_checker_without_warnings(cfg: Any) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*infinity.*")  # physical quantities have no bounds
        check_env(TaskEnv(cfg()), skip_render_check=True)


def test_single_environment_ends_with_the_last_observation_of_the_episode() -> None:
    env = TaskEnv(counted(tiny.ArmCfg()))
    for _ in range(2):
        obs, _ = env.reset(seed=1)
        assert obs.shape == (7,) and obs.dtype == np.float32 and obs[-1] == 0
        for step in range(1, 21):
            obs, reward, terminated, truncated, info = env.step(env.action_space.sample())
            assert obs[-1] == step and not terminated and truncated == (step == 20)
            assert isinstance(reward, float) and ("log" in info) == truncated


def test_vector_environment_follows_same_step_autoreset() -> None:
    env = TaskVectorEnv(counted(tiny.WalkerCfg()), num_threads=1)
    assert isinstance(env, gymnasium.vector.VectorEnv)
    assert env.metadata["autoreset_mode"] is gymnasium.vector.AutoresetMode.SAME_STEP
    obs, _ = env.reset(seed=0)
    assert env.observation_space.contains(obs) and env.single_observation_space.contains(obs[0])
    env.action_space.seed(0)
    clock, ends = np.zeros(6), 0
    for _ in range(80):
        obs, reward, terminated, truncated, info = env.step(env.action_space.sample())
        clock += 1
        done = terminated | truncated
        assert (reward.dtype, reward.shape, terminated.dtype) == (np.float32, (6,), np.bool_)
        if done.any():
            ends += done.sum()
            assert (info["_final_obs"] == done).all() and info["final_obs"].shape == obs.shape
            np.testing.assert_array_equal(info["final_obs"][done, -1], clock[done])
            assert not (terminated & truncated).any() or truncated.any()
        else:
            assert "final_obs" not in info
        clock[done] = 0
        np.testing.assert_array_equal(obs[:, -1], clock)
    assert ends >= 6


def test_vector_environment_is_the_environment_underneath() -> None:
    vector = TaskVectorEnv(tiny.ArmCfg(), num_threads=1)
    env = ManagerBasedRLEnv(tiny.ArmCfg(), num_threads=1)
    first, second = vector.reset(seed=3)[0], env.reset(seed=3)[0]["policy"]
    np.testing.assert_array_equal(first, second.numpy())
    action = np.full((4, 2), 0.3)
    for _ in range(25):
        got, want = vector.step(action), env.step(torch.full((4, 2), 0.3))
        np.testing.assert_array_equal(got[0], want[0]["policy"].numpy())
        np.testing.assert_array_equal(got[1], want[1].numpy())
    np.testing.assert_array_equal(vector.observation, got[0])
    state = vector.state_dict()
    again = vector.step(action)[0]
    vector.load_state_dict(state)
    np.testing.assert_array_equal(vector.step(action)[0], again)


def test_finite_horizon_ends_instead_of_being_cut_off() -> None:
    env = TaskVectorEnv(tiny.ArmCfg(is_finite_horizon=True), num_threads=1)
    env.reset(seed=0)
    for _ in range(20):
        _, _, terminated, truncated, info = env.step(np.zeros((4, 2)))
    assert terminated.all() and not truncated.any() and info["_final_obs"].all()


def test_seeds_may_be_one_or_one_per_environment() -> None:
    env = TaskVectorEnv(tiny.ArmCfg(), num_threads=1)
    first = env.reset(seed=[1, 2, 3, 4])[0]
    assert np.array_equal(first, env.reset(seed=[1, 2, 3, 4])[0])
    assert not np.array_equal(first, env.reset(seed=[1, 2, 3, 5])[0])
    assert not np.array_equal(env.reset(seed=0)[0], env.reset(seed=1)[0])
    with pytest.raises(InputError, match="seed"):
        env.reset(seed=-1)


def test_some_environments_can_be_reset_alone() -> None:
    env = TaskVectorEnv(counted(tiny.ArmCfg()), num_threads=1)
    env.reset(seed=0)
    env.step(np.zeros((4, 2)))
    obs, _ = env.reset(options={"reset_mask": np.array([True, False, True, False])})
    assert obs[:, -1].tolist() == [0, 1, 0, 1]
    with pytest.raises(InputError, match="reset_mask"):
        env.reset(options={"reset_mask": np.array([True])})


def test_wrong_use_is_explained() -> None:
    with pytest.raises(InputError, match="policy"):
        TaskVectorEnv(tiny.ArmCfg(), obs_group="critic")
    with pytest.raises(InputError, match="compute_final_obs"):
        TaskVectorEnv(ManagerBasedRLEnv(tiny.ArmCfg(), num_threads=1))
    env = TaskVectorEnv(tiny.ArmCfg(), num_threads=1)
    env.reset(seed=0)
    with pytest.raises(InputError, match="one row per environment"):
        env.step(np.zeros((4, 3)))


def test_registry_makes_tasks_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(registry.TASKS, "arm", "tests.rl.tiny_tasks:ArmCfg")
    env = registry.make("arm", num_envs=3, seed=5, num_threads=1, **{"rewards.effort.weight": -1.0, "decimation": 2})
    assert env.num_envs == 3 and env.step_dt == pytest.approx(0.01) and env.cfg.seed == 5
    assert env.reward_manager.get_term_cfg("effort").weight == -1.0
    vector = registry.make_vec("arm", num_envs=2, num_threads=1, action_limit=None)
    assert vector.num_envs == 2 and np.isinf(vector.single_action_space.high).all()
    with pytest.raises(InputError, match="Did you mean 'velocity'"):
        registry.make("velcity")
    with pytest.raises(InputError, match="Did you mean 'decimation'"):
        registry.make("arm", decimaton=2)


def test_the_package_is_cheap_to_import() -> None:
    code = (
        "import sys, robotbrain.rl.managers, robotbrain.rl.scene, robotbrain.rl.envs, robotbrain.rl.registry;"
        "heavy = {'torch', 'mujoco', 'gymnasium', 'matplotlib', 'onnx'} & set(sys.modules); print(sorted(heavy))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert done.stdout.strip() == "[]"

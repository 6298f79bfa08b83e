"""The reach task: what it observes and rewards, against the model itself; and that training on it is reproducible."""

import dataclasses

import mujoco
import numpy as np
import pytest
import torch

from robotbrain.rl.ddpg import train_ddpg
from robotbrain.rl.envs.gym import TaskVectorEnv
from robotbrain.rl.registry import make_vec
from robotbrain.rl.robots.arm import HOME, WORKSPACE, arm_mjcf
from robotbrain.rl.tasks.reach import (
    ACTION_SCALE,
    EPISODE_STEPS,
    START_SPREAD,
    ReachDistanceEnvCfg,
    ReachEnvCfg,
    ReachEvaluation,
    reach_ddpg_config,
    reached,
)

PARTS = {"joint_pos": 7, "joint_vel": 7, "pose_command": 7, "ee_pos": 3, "ee_to_target": 3}


def parts(obs):
    edges = np.cumsum(list(PARTS.values()))
    return dict(zip(PARTS, np.split(obs, edges[:-1], axis=1), strict=True))


@pytest.fixture(scope="module")
def model():
    return mujoco.MjModel.from_xml_string(arm_mjcf())


def fingertips(model, angles):
    data, found = mujoco.MjData(model), []
    for row in angles:
        data.qpos[:] = row
        mujoco.mj_kinematics(model, data)
        found.append(data.site("ee").xpos.copy())
    return np.array(found)


def actions(steps, n, seed=0):
    return np.random.default_rng(seed).uniform(-1, 1, (steps, n, 7)).astype(np.float32)


def test_observations_and_both_rewards_are_what_they_say(model):
    cfg, plain_cfg = ReachEnvCfg(), ReachDistanceEnvCfg()
    cfg.scene.num_envs = plain_cfg.scene.num_envs = 6
    env, plain = (TaskVectorEnv(one, num_threads=1) for one in (cfg, plain_cfg))
    for one in (env, plain):
        one.reset(seed=4)
    for action in actions(5, 6):
        obs, reward, *_ = env.step(action)
        _, plain_reward, *_ = plain.step(action)
    seen = parts(obs)
    place = fingertips(model, np.array(HOME) + seen["joint_pos"])
    np.testing.assert_allclose(seen["ee_pos"], place, atol=2e-6)
    np.testing.assert_allclose(seen["ee_to_target"] / 5, seen["pose_command"][:, :3] - place, atol=2e-6)
    distance = np.linalg.norm(seen["pose_command"][:, :3] - place, axis=1)
    np.testing.assert_allclose(plain_reward, -distance, atol=1e-5)
    np.testing.assert_allclose(reward, -distance - 0.2 * (1 - np.exp(-((distance / 0.03) ** 2))), atol=1e-5)


def test_action_moves_the_servo_targets_from_where_the_joints_are():
    env = make_vec("reach", num_envs=4, num_threads=1)
    obs, _ = env.reset(seed=0)
    before = np.array(HOME) + parts(obs)["joint_pos"]
    action = actions(1, 4)[0]
    env.step(action)
    target = env.env.scene["robot"].data.joint_pos_target.torch.numpy()
    low, high = np.moveaxis(env.env.scene["robot"].data.joint_pos_limits.torch.numpy(), -1, 0)
    np.testing.assert_allclose(
        np.clip(target, low, high), np.clip(before + ACTION_SCALE * action, low, high), atol=1e-5
    )


def test_starts_and_targets_fill_their_ranges():
    env = make_vec("reach", num_envs=600, num_threads=1)
    seen = parts(env.reset(seed=1)[0])
    low, high = np.array(WORKSPACE).T
    share = (seen["pose_command"][:, :3] - low) / (high - low)
    spread = (seen["joint_pos"] / START_SPREAD + 1) / 2
    for column in np.concatenate([share, spread], axis=1).T:
        assert column.min() > -1e-5 and column.max() < 1 + 1e-5
        counts = np.bincount(np.clip((column * 6).astype(int), 0, 5), minlength=6)
        assert ((counts - 100) ** 2 / 100).sum() < 25  # chi-square, 5 degrees of freedom, p = 1e-4


def test_episode_is_cut_by_the_clock_and_shows_its_last_observation():
    env = make_vec("reach", num_envs=3, num_threads=1)
    env.reset(seed=0)
    for step, action in enumerate(actions(EPISODE_STEPS, 3), 1):
        obs, _, terminated, truncated, info = env.step(action)
        assert not terminated.any()
        assert truncated.all() == (step == EPISODE_STEPS)
    assert not np.allclose(parts(info["final_obs"])["pose_command"], parts(obs)["pose_command"])


def test_reached_asks_for_all_of_the_last_five_steps():
    near, late, early = np.full((3, 50), 0.5, np.float32)
    near[45:], late[46:], early[:49] = 0.019, 0.0, 0.0
    assert reached(np.stack([near, late, early])).tolist() == [True, False, False]


def jacobian_policy(model):
    """Damped least squares: what an engineer would write instead of learning."""
    data = mujoco.MjData(model)

    def policy(obs):
        seen, found = parts(np.asarray(obs, float)), []
        for angles, error in zip(np.array(HOME) + seen["joint_pos"], seen["ee_to_target"] / 5, strict=True):
            data.qpos[:] = angles
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            jac = np.zeros((3, model.nv))
            mujoco.mj_jacSite(model, data, jac, None, model.site("ee").id)
            found.append(jac.T @ np.linalg.solve(jac @ jac.T + 0.01 * np.eye(3), error) / ACTION_SCALE)
        return np.clip(found, -1, 1).astype(np.float32)

    return policy


def test_evaluation_tells_a_policy_that_reaches_from_one_that_does_not(model):
    judge = ReachEvaluation(episodes=40, seed=7, num_threads=1)
    good = judge(jacobian_policy(model))
    assert good["success"] >= 0.9 and good["error_m"] < 0.02
    idle = judge.distances(lambda obs: np.zeros((len(obs), 7), np.float32))
    assert reached(idle).mean() < 0.05
    assert idle.shape == (40, EPISODE_STEPS)
    np.testing.assert_allclose(idle, np.repeat(idle[:, :1], EPISODE_STEPS, axis=1), atol=0.02)  # no reset in between
    assert judge(jacobian_policy(model)) == good


def test_training_does_not_depend_on_the_simulation_s_threads_and_resumes_exactly(tmp_path):
    config = reach_ddpg_config(total_steps=640, warmup_steps=128, batch_size=16, hidden=(16, 16), eval_every=320)

    def weights(threads, **options):
        steps = options.pop("steps", config.total_steps)
        result = train_ddpg(
            lambda: make_vec("reach", num_envs=8, num_threads=threads),
            dataclasses.replace(config, total_steps=steps),
            seed=5,
            progress=False,
            **options,
        )
        return torch.cat([p.flatten() for p in result.agent.actor.parameters()])

    one = weights(1)
    assert torch.equal(one, weights(2))
    weights(2, run_dir=tmp_path, steps=312)  # in the middle of episodes
    assert torch.equal(one, weights(1, run_dir=tmp_path, resume=True))


def test_variants_differ_in_the_reward_alone():
    full, plain = ReachEnvCfg().to_dict(), ReachDistanceEnvCfg().to_dict()
    assert {key for key in full if full[key] != plain[key]} == {"rewards"}
    assert set(full["rewards"]) - set(plain["rewards"]) == {"position_precision"}

"""The velocity task: its mirror symmetry, its measure, and the policy that ships with the kit."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch

from robotbrain.errors import InputError
from robotbrain.rl.envs import ManagerBasedRLEnv
from robotbrain.rl.onnx_policy import OnnxPolicy
from robotbrain.rl.ppo_train import train_ppo
from robotbrain.rl.robots.quadruped import STAND_HEIGHT
from robotbrain.rl.tasks import velocity
from robotbrain.rl.tasks.velocity_eval import draw_commands, track
from robotbrain.rl.tasks.velocity_symmetry import (
    JOINT_MIRROR,
    JOINT_SIGN,
    OBS_MIRROR,
    OBS_SIGN,
    OBSERVATIONS,
    mirror_left_right,
)

Tensor = torch.Tensor


@pytest.fixture(autouse=True, scope="module")
def _one_thread() -> None:
    torch.set_num_threads(1)


@pytest.fixture(scope="module")
def recipe() -> dict[str, object]:
    return json.loads(velocity.SHIPPED_RECIPE.read_text())


def plain_env(num_envs: int) -> ManagerBasedRLEnv:
    cfg = velocity.VelocityEnvCfg()
    cfg.play_mode()
    cfg.scene.num_envs, cfg.seed = num_envs, 0
    cfg.commands.base_velocity.rel_standing_envs = 0.0
    return ManagerBasedRLEnv(cfg, num_threads=1)


# ------------------------------------------------------------ the task


def test_the_observations_are_those_of_isaac_labs_flat_velocity_task_in_its_order() -> None:
    env = plain_env(1)
    assert env.observation_manager.active_terms["policy"] == [name for name, _ in OBSERVATIONS]
    sizes = [math.prod(shape) for shape in env.observation_manager.group_obs_term_dim["policy"]]
    assert sizes == [size for _, size in OBSERVATIONS]
    assert env.reset(seed=0)[0]["policy"].shape == (1, 48)
    assert env.num_actions == 12
    assert (env.step_dt, env.physics_dt, env.max_episode_length) == (0.02, 0.005, 1000)


def test_randomisation_has_the_outlines_ranges() -> None:
    events = velocity.VelocityEnvCfg().events
    assert events.physics_material.params["static_friction_range"] == (0.5, 1.25)
    assert events.add_base_mass.params["mass_distribution_params"] == (-1.0, 3.0)
    assert events.add_base_mass.params["operation"] == "add"
    assert events.push_robot.interval_range_s == (10.0, 15.0)


def test_mirroring_twice_changes_nothing_and_swaps_the_legs() -> None:
    x, a = torch.randn(5, 48), torch.randn(5, 12)
    both, actions = mirror_left_right(None, {"policy": x}, a)
    assert torch.equal(both["policy"][:5], x)
    assert torch.equal(actions[:5], a)
    again, back = mirror_left_right(None, {"policy": both["policy"][5:]}, actions[5:])
    assert torch.equal(again["policy"][5:], x)
    assert torch.equal(back[5:], a)
    assert torch.equal(actions[5:, 3], -a[:, 0])  # the right hip does what the left one did, the other way round
    assert torch.equal(actions[5:, 4], a[:, 1])
    assert mirror_left_right(None, None, None) == (None, None)


def test_a_mirrored_robot_with_mirrored_actions_has_mirrored_observations_and_equal_rewards() -> None:
    env = plain_env(2)
    env.reset(seed=0)
    robot, both = env.scene["robot"], torch.tensor([0, 1])
    generator = torch.Generator().manual_seed(3)
    angles = robot.data.default_joint_pos.torch[0] + 0.1 * torch.randn(12, generator=generator)
    speeds = torch.randn(12, generator=generator)
    linear, angular = torch.tensor([0.3, 0.2, 0.0]), torch.tensor([0.2, -0.3, 0.4])
    flip, axial = torch.tensor([1.0, -1.0, 1.0]), torch.tensor([-1.0, 1.0, -1.0])
    pose = torch.tensor([0.0, 0.0, STAND_HEIGHT, 0.0, 0.0, 0.0, 1.0]).repeat(2, 1)
    robot.write_root_pose_to_sim_index(root_pose=pose, env_ids=both)
    twist = torch.stack([torch.cat([linear, angular]), torch.cat([linear * flip, angular * axial])])
    robot.write_root_velocity_to_sim_index(root_velocity=twist, env_ids=both)
    robot.write_joint_state_to_sim(
        torch.stack([angles, angles[JOINT_MIRROR] * JOINT_SIGN]),
        torch.stack([speeds, speeds[JOINT_MIRROR] * JOINT_SIGN]),
        env_ids=both,
    )
    env.command_manager.get_term("base_velocity").command[:] = torch.tensor([[0.5, 0.3, -0.6], [0.5, -0.3, 0.6]])
    for _ in range(12):
        action = 0.5 * torch.randn(12, generator=generator)
        obs, reward, _, _, _ = env.step(torch.stack([action, action[JOINT_MIRROR] * JOINT_SIGN]))
    seen = obs["policy"]
    assert seen[0, 1].abs() > 0.01  # it moves sideways, so the mirror shows
    torch.testing.assert_close(seen[1], seen[0, OBS_MIRROR] * OBS_SIGN, rtol=1e-2, atol=1e-2)
    torch.testing.assert_close(reward[0], reward[1], rtol=1e-2, atol=1e-4)


# ------------------------------------------------------------ the measure


def test_commands_are_within_their_ranges_and_repeat() -> None:
    commands = draw_commands(500, seed=1)
    low, high = torch.tensor(velocity.COMMAND_RANGES).T
    assert (commands >= low).all()
    assert (commands <= high).all()
    assert (commands.std(dim=0) / (high - low) - 1.0 / math.sqrt(12.0)).abs().max() < 0.03
    assert torch.equal(commands, draw_commands(500, seed=1))
    assert not torch.equal(commands, draw_commands(500, seed=2))


def test_who_stands_still_misses_the_command_by_all_of_it() -> None:
    commands = torch.tensor([[0.6, 0.0, 0.0], [0.0, -0.4, 0.5], [0.3, 0.4, -1.0]])
    result = track(lambda obs: torch.zeros(len(obs), 12), commands, seconds=3.0, settle_s=1.0, num_threads=1)
    assert not result.fell.any()
    torch.testing.assert_close(result.error, torch.tensor([0.6, 0.4, 0.5]), rtol=0.0, atol=0.03)
    torch.testing.assert_close(result.yaw_error, torch.tensor([0.0, 0.5, 1.0]), rtol=0.0, atol=0.03)


def test_falling_is_noticed_and_what_follows_does_not_count() -> None:
    def collapse(obs: Tensor) -> Tensor:
        action = torch.zeros(len(obs), 12)
        action[0, 1::3], action[0, 2::3] = 6.0, -4.0  # legs folded: it lies down on its trunk
        return action

    result = track(collapse, torch.zeros(2, 3), seconds=4.0, settle_s=3.0, num_threads=1)
    assert result.fell.tolist() == [True, False]
    assert result.achieved[0].isnan().all()
    assert result.error[1] < 0.05


@pytest.mark.parametrize("commands", [torch.zeros(3), torch.zeros(0, 3), torch.zeros(2, 2)])
def test_commands_of_another_shape_are_refused(commands: Tensor) -> None:
    with pytest.raises(InputError, match="commands"):
        track(lambda obs: obs, commands)


# ------------------------------------------------------------ the shipped policy


def test_the_shipped_policy_goes_where_it_is_told() -> None:
    commands = draw_commands(12, seed=5)
    result = track(velocity.load_shipped(), commands, seconds=5.0, settle_s=1.5, num_threads=1)
    assert not result.fell.any()
    assert result.error.mean() < 0.25
    assert result.error.max() < 0.4
    assert result.yaw_error.mean() < 0.25


def test_the_shipped_policy_survives_pushes_on_robots_it_does_not_know() -> None:
    result = track(
        velocity.load_shipped(), draw_commands(8, seed=6), pushes=True, randomised=True, seconds=16.0, num_threads=1
    )
    assert not result.fell.any()
    assert result.error.mean() < 0.25


def test_told_to_stand_the_shipped_policy_stands_still() -> None:
    actor, env = velocity.load_shipped(), plain_env(2)
    obs = env.reset(seed=0)[0]
    told = env.command_manager.get_term("base_velocity").command
    speeds = []
    with torch.no_grad():
        for step in range(200):
            told[:] = 0.0
            obs = env.step(actor(obs["policy"]))[0]
            if step >= 100:
                speeds.append(env.scene["robot"].data.joint_vel.torch.abs().mean())
    assert torch.stack(speeds).mean() < 0.3


def test_the_shipped_files_belong_together(recipe: dict[str, object]) -> None:
    policy = OnnxPolicy(velocity.SHIPPED_ONNX)
    obs = torch.randn(16, 48)
    with torch.no_grad():
        expected = velocity.load_shipped()(obs)
    np.testing.assert_allclose(policy(obs.numpy()), expected.numpy(), rtol=1e-4, atol=1e-4)
    assert policy.meta.observation_names == OBSERVATIONS == tuple(map(tuple, recipe["observations"]))
    assert policy.meta.action_scale == velocity.ACTION_SCALE == recipe["action_scale"]
    assert policy.meta.provenance["env_steps"] == recipe["env_steps"]
    curve = json.loads(velocity.SHIPPED_CURVE.read_text())
    assert curve["env_steps"][-1] == recipe["env_steps"]
    assert len({len(values) for values in curve.values()}) == 1
    size = sum(p.stat().st_size for p in (velocity.SHIPPED_CHECKPOINT, velocity.SHIPPED_ONNX))
    assert size < 2_000_000


def test_the_recipe_reports_what_was_asked_for(recipe: dict[str, object]) -> None:
    for row in recipe["evaluation"]:
        assert row["commands"] >= 200
        assert row["error_mean_m_s"] < 0.25
        assert row["falls"] < 0.02 * row["commands"]
    cfg = velocity.VelocityEnvCfg()
    assert cfg.scene.num_envs == recipe["num_envs"]
    assert (
        recipe["env_steps"]
        == recipe["num_envs"] * recipe["iterations"] * velocity.VelocityPPORunnerCfg().num_steps_per_env
    )


def test_training_can_go_on_from_the_shipped_checkpoint(tmp_path: Path, recipe: dict[str, object]) -> None:
    cfg, ppo = velocity.VelocityEnvCfg(), velocity.VelocityPPORunnerCfg(seed=recipe["seed"])
    cfg.finish_curriculum()
    assert cfg.rewards.feet_air_time.weight > velocity.RewardsCfg().feet_air_time.weight
    done = velocity.start_from_shipped(tmp_path)
    assert done == recipe["iterations"]
    before = velocity.load_shipped()
    result = train_ppo(
        ManagerBasedRLEnv(cfg, num_threads=1), ppo, run_dir=tmp_path, resume=True, iterations=done + 1, progress=False
    )
    assert (result.iteration, result.steps) == (done + 1, recipe["env_steps"] + 256 * 24)
    obs = torch.randn(50, 48)
    with torch.no_grad():
        change = (result.agent.actor(obs) - before(obs)).abs().mean()
    assert 0.0 < change < 0.2  # it has learnt a little, and forgotten nothing

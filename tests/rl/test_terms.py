"""Terms against closed forms; the comparison with genuine Isaac Lab is in tests/conformance_isaaclab."""

from __future__ import annotations

import math
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from scipy import stats

from robotbrain.errors import InputError
from robotbrain.rl import math_utils, mdp
from robotbrain.rl.envs import ManagerBasedRLEnv
from robotbrain.rl.managers import CurriculumTermCfg, EventTermCfg, SceneEntityCfg
from robotbrain.rl.tasks.reach import ReachEnvCfg
from robotbrain.rl.tasks.velocity import VelocityEnvCfg
from tests.conformance_isaaclab.worlds import disturb, reaching, walking

N = 16


@pytest.fixture(autouse=True, scope="module")
def _as_in_the_environment() -> Iterator[None]:
    with torch.inference_mode():
        yield


@pytest.fixture(scope="module")
def dog() -> ManagerBasedRLEnv:
    env = walking(num_envs=N)
    disturb(env, torch.Generator().manual_seed(0))
    return env


@pytest.fixture(scope="module")
def arm() -> ManagerBasedRLEnv:
    env = reaching(num_envs=N)
    disturb(env, torch.Generator().manual_seed(0))
    return env


def entity(env: ManagerBasedRLEnv, **kwargs: Any) -> SceneEntityCfg:
    cfg = SceneEntityCfg("robot", **kwargs)
    cfg.resolve(env.scene)
    return cfg


def close(a: torch.Tensor, b: torch.Tensor | float, tolerance: float = 1e-5) -> None:
    torch.testing.assert_close(a, torch.as_tensor(b, dtype=a.dtype).expand_as(a), rtol=tolerance, atol=tolerance)


# -- observations


def test_root_velocities_are_the_world_s_seen_from_the_robot(dog: ManagerBasedRLEnv) -> None:
    quat = mdp.root_quat_w(dog)
    close(math_utils.quat_apply(quat, mdp.base_lin_vel(dog)), mdp.root_lin_vel_w(dog))
    close(math_utils.quat_apply(quat, mdp.base_ang_vel(dog)), mdp.root_ang_vel_w(dog))
    close(math_utils.quat_apply(quat, mdp.projected_gravity(dog)), torch.tensor([0.0, 0.0, -1.0]))
    assert (mdp.root_quat_w(dog, make_quat_unique=True)[:, 3] >= 0).all()
    assert torch.equal(mdp.base_pos_z(dog)[:, 0], mdp.root_pos_w(dog)[:, 2])


def test_joints_relative_to_defaults_and_limits(arm: ManagerBasedRLEnv) -> None:
    data, some = arm.scene["robot"].data, entity(arm, joint_names="joint[24]")
    assert mdp.joint_pos(arm, some).shape == (N, 2)
    close(mdp.joint_pos_rel(arm) + data.default_joint_pos.torch, mdp.joint_pos(arm))
    normal = mdp.joint_pos_limit_normalized(arm)
    limits = data.soft_joint_pos_limits.torch
    close(limits[..., 0] + 0.5 * (normal + 1.0) * (limits[..., 1] - limits[..., 0]), mdp.joint_pos(arm))


def test_times_and_body_poses(arm: ManagerBasedRLEnv) -> None:
    close(mdp.current_time_s(arm) + mdp.remaining_time_s(arm), arm.max_episode_length_s)
    hand = entity(arm, body_names="hand")
    pose = mdp.body_pose_w(arm, hand)
    assert pose.shape == (N, 7)
    close(pose[:, :3], mdp.body_pos_b(arm, hand))  # the arm's root is the world's origin
    close(mdp.body_to_command_b(arm, "ee_pose", hand), arm.command_manager.get_command("ee_pose")[:, :3] - pose[:, :3])
    close(math_utils.quat_apply(pose[:, 3:], mdp.body_projected_gravity_b(arm, hand)), torch.tensor([0.0, 0.0, -1.0]))


# -- rewards and terminations


def test_tracking_is_one_without_error_and_falls_to_1_over_e_at_std(dog: ManagerBasedRLEnv) -> None:
    command = dog.command_manager.get_term("base_velocity").vel_command_b
    command[:, :2] = mdp.base_lin_vel(dog)[:, :2]
    command[:, 2] = mdp.base_ang_vel(dog)[:, 2]
    close(mdp.track_lin_vel_xy_exp(dog, 0.5, "base_velocity"), 1.0)
    close(mdp.track_ang_vel_z_exp(dog, 0.5, "base_velocity"), 1.0)
    command[:, 0] += 0.3
    command[:, 1] -= 0.4
    command[:, 2] += 0.5
    close(mdp.track_lin_vel_xy_exp(dog, 0.5, "base_velocity"), math.exp(-1.0))
    close(mdp.track_ang_vel_z_exp(dog, 0.5, "base_velocity"), math.exp(-1.0))


def test_tilt_is_punished_and_ended(dog: ManagerBasedRLEnv) -> None:
    robot = dog.scene["robot"]
    angle = torch.linspace(0.0, math.pi, N)
    zero = torch.zeros(N)
    pose = robot.data.default_root_pose.torch.clone()
    pose[:, 3:] = math_utils.quat_from_euler_xyz(angle, zero, zero)
    robot.write_root_pose_to_sim_index(root_pose=pose)
    close(mdp.flat_orientation_l2(dog), angle.sin() ** 2)
    assert torch.equal(mdp.bad_orientation(dog, limit_angle=1.0), angle > 1.0)
    assert torch.equal(mdp.root_height_below_minimum(dog, minimum_height=0.5), pose[:, 2] < 0.5)


def test_limits_punish_only_what_is_beyond_them(arm: ManagerBasedRLEnv) -> None:
    robot = arm.scene["robot"]
    limits = robot.data.soft_joint_pos_limits.torch
    position = limits.mean(-1)
    position[0, 0], position[1, 3] = limits[0, 0, 1] + 0.25, limits[1, 3, 0] - 0.5
    robot.write_joint_state_to_sim(position, torch.zeros_like(position))
    expected = torch.zeros(N)
    expected[:2] = torch.tensor([0.25, 0.5])
    close(mdp.joint_pos_limits(arm), expected)
    assert torch.equal(mdp.joint_pos_out_of_limit(arm), expected > 0)
    assert not mdp.joint_pos_out_of_limit(arm, entity(arm, joint_names="joint7")).any()
    velocity = torch.zeros_like(position)
    velocity[3, 2], velocity[4, 1] = 2.0, -2.0
    robot.write_joint_state_to_sim(position, velocity)
    assert mdp.joint_vel_out_of_manual_limit(arm, 1.9).nonzero().flatten().tolist() == [3, 4]
    close(mdp.joint_vel_l1(arm, entity(arm)), velocity.abs().sum(1))
    robot.data.joint_vel.torch[5, 0] = torch.nan
    assert mdp.joint_vel_out_of_manual_limit(arm, 1.9)[5]
    robot.write_joint_state_to_sim(position, torch.zeros_like(position))


def test_an_early_end_costs_its_weight_whatever_the_rate(dog: ManagerBasedRLEnv) -> None:
    dog.termination_manager.terminated.copy_(torch.arange(N) % 2 == 0)
    close(mdp.terminated_penalty(dog) * dog.step_dt, (torch.arange(N) % 2 == 0).float())
    close(mdp.is_alive(dog) + mdp.is_terminated(dog), 1.0)


def test_precision_reward_is_steep_near_the_goal(arm: ManagerBasedRLEnv) -> None:
    hand, std = entity(arm, body_names="hand"), 0.03
    at = mdp.body_pos_b(arm, hand)
    distances = torch.linspace(0.0, 0.3, N)
    arm.command_manager.get_term("ee_pose").pose_command_b[:, :3] = at + distances.unsqueeze(1) * torch.eye(3)[1]
    close(mdp.position_command_error(arm, "ee_pose", hand), distances)
    close(mdp.position_command_error_gauss(arm, std, "ee_pose", hand), 1.0 - torch.exp(-((distances / std) ** 2)), 1e-4)
    close(mdp.position_command_error_tanh(arm, std, "ee_pose", hand), 1.0 - torch.tanh(distances / std), 1e-4)


def test_what_cannot_work_is_refused(dog: ManagerBasedRLEnv) -> None:
    with pytest.raises(InputError, match="flat"):
        mdp.base_height_l2(dog, 0.3, sensor_cfg=SceneEntityCfg("height_scanner"))
    with pytest.raises(InputError, match="pose command"):
        mdp.pose_command_success(dog, "base_velocity")
    with pytest.raises(InputError, match="at least two feet"):
        one = SceneEntityCfg("contact_forces", body_names="FL_foot")
        one.resolve(dog.scene)
        mdp.feet_air_time_variance(dog, "base_velocity", one)


# -- commands


def test_velocity_commands_stay_in_their_ranges_and_some_robots_stand() -> None:
    env = walking(num_envs=1000)
    term: Any = env.command_manager.get_term("base_velocity")
    command = env.command_manager.get_command("base_velocity")
    term.compute(0.0)
    standing = term.is_standing_env
    assert 0.15 < standing.float().mean() < 0.25  # probability 0.2
    assert (command[standing] == 0).all()
    moving = command[~standing]
    for axis, bounds in ((0, (-1.0, 1.0)), (1, (-0.5, 0.5))):
        assert stats.kstest(moving[:, axis].numpy(), stats.uniform(bounds[0], bounds[1] - bounds[0]).cdf).pvalue > 1e-4
    following = term.is_heading_env & ~standing
    error = math_utils.wrap_to_pi(term.heading_target - env.scene["robot"].data.heading_w.torch)
    close(command[following, 2], (term.cfg.heading_control_stiffness * error[following]).clamp(-1.0, 1.0))


def test_heading_needs_a_range() -> None:
    cfg = VelocityEnvCfg()
    cfg.scene.num_envs = 1
    cfg.commands.base_velocity.heading_command = True
    with pytest.raises(InputError, match="heading"):
        ManagerBasedRLEnv(cfg)


def test_velocity_success_is_judged_by_the_mean_over_the_episode(dog: ManagerBasedRLEnv) -> None:
    term: Any = dog.command_manager.get_term("base_velocity")
    ids = torch.arange(N)
    term._error_xy_sum[:] = torch.where(ids < 4, 0.4, 0.6) * 10
    term._error_yaw_sum[:] = 0.3 * 10
    term._step_count[:] = 10
    log = term.reset(ids)
    assert log["error_vel_xy"].item() == pytest.approx((4 * 0.4 + 12 * 0.6) / 16)
    assert dog.extras["log"]["Metrics/success_rate"].item() == pytest.approx(0.25)
    assert term._step_count.sum() == 0


def test_pose_commands_lie_in_the_box_and_success_needs_every_threshold() -> None:
    env = reaching(num_envs=400)
    term: Any = env.command_manager.get_term("ee_pose")
    ranges = term.cfg.ranges
    for axis, (low, high) in enumerate((ranges.pos_x, ranges.pos_y, ranges.pos_z)):
        assert stats.kstest(term.command[:, axis].numpy(), stats.uniform(low, high - low).cdf).pvalue > 1e-4
    close(term.command[:, 3:].norm(dim=1), 1.0)
    hand = env.scene["robot"].data.body_pos_w.torch[:, term.body_idx]
    turned = env.scene["robot"].data.body_quat_w.torch[:, term.body_idx]
    term.pose_command_b[:] = torch.cat((hand, turned), 1)
    term.pose_command_b[:100, 0] += term.cfg.position_success_threshold * 1.01
    half = torch.tensor([0.0, 0.0, math.sin(0.8), math.cos(0.8)]).expand(100, 4)  # 1.6 rad about z; 1.5 are allowed
    term.pose_command_b[100:200, 3:] = math_utils.quat_mul(half, term.pose_command_b[100:200, 3:])
    success = term.compute_success()
    assert not success[:200].any() and success[200:].all()


def test_a_goal_on_the_ground_is_told_in_the_robot_s_frame(dog: ManagerBasedRLEnv) -> None:
    term: Any = dog.command_manager.get_term("pose")
    term._resample_command(torch.arange(N))
    term._update_command()
    data = dog.scene["robot"].data
    heading = math_utils.yaw_quat(data.root_quat_w.torch)
    close(math_utils.quat_apply(heading, term.command[:, :3]) + data.root_pos_w.torch, term.pos_command_w, 1e-4)
    turn = term.command[:, 3]
    line = torch.atan2(term.command[:, 1], term.command[:, 0])
    assert (turn.abs() <= math.pi / 2 + 1e-5).all()  # forwards or backwards, whichever is nearer
    close(torch.sin(turn - line), 0.0, 1e-4)


# -- actions


def make_action(env: ManagerBasedRLEnv, cfg: Any) -> Any:
    return cfg.class_type(cfg, env)


def test_actions_are_scaled_offset_and_clipped_by_joint(dog: ManagerBasedRLEnv) -> None:
    term = make_action(
        dog,
        mdp.JointPositionActionCfg(
            asset_name="robot",
            joint_names=[".*_thigh_joint", ".*_calf_joint"],
            scale={".*_thigh_joint": 0.5, ".*_calf_joint": 2.0},
            offset={"FL_calf_joint": 0.1},
            clip={"F._thigh_joint": (-0.2, 0.3)},
            use_default_offset=False,
        ),
    )
    assert term.joint_names[:2] == ["FL_thigh_joint", "FL_calf_joint"]  # in the robot's order
    term.process_actions(torch.ones(N, 8))
    close(term.processed_actions[0], torch.tensor([0.3, 2.1, 0.3, 2.0, 0.5, 2.0, 0.5, 2.0]))
    for wrong in ({"joint_names": ["tail"]}, {"scale": {"tail": 1.0}}, {"scale": "big"}):
        with pytest.raises(InputError):
            fields = {"asset_name": "robot", "joint_names": [".*"], **wrong}
            make_action(dog, mdp.JointPositionActionCfg(**fields))  # type: ignore[arg-type]


def test_the_relative_target_runs_ahead_and_the_held_one_stays(arm: ManagerBasedRLEnv) -> None:
    robot = arm.scene["robot"]
    fields = {"asset_name": "robot", "joint_names": ["joint.*"], "scale": 0.1}
    free = make_action(arm, mdp.RelativeJointPositionActionCfg(**fields))
    held = make_action(arm, mdp.HeldRelativeJointPositionActionCfg(**fields))
    assert free.apply_every_substep and not held.apply_every_substep
    start = robot.data.joint_pos.torch.clone()
    for term in (free, held):
        term.process_actions(torch.ones(N, 7))
    robot.write_joint_state_to_sim(start + 0.05, torch.zeros_like(start))
    for term, expected in ((free, start + 0.15), (held, start + 0.1)):
        term.apply_actions()
        close(robot.data.joint_pos_target.torch, expected)


def test_wheels_turn_as_the_base_shall_drive() -> None:
    given: dict[str, torch.Tensor] = {}
    asset = SimpleNamespace(
        find_joints=lambda names, preserve_order: ([3, 1], names),
        set_joint_velocity_target_index=lambda *, target, joint_ids: given.update(target=target, ids=joint_ids),
    )
    env = SimpleNamespace(num_envs=2, device="cpu", scene={"robot": asset}, cfg=SimpleNamespace(decimation=2))
    cfg = mdp.DifferentialDriveActionCfg(
        asset_name="robot", left_joint="l", right_joint="r", wheel_radius=0.1, track_width=0.4, max_yaw_rate=2.0
    )
    term: Any = mdp.DifferentialDriveAction(cfg, env)  # type: ignore[arg-type]
    term.process_actions(torch.tensor([[0.5, 0.0], [3.0, 0.5]]))  # 3 is clipped to 1
    term.apply_actions()
    close(term.processed_actions, torch.tensor([[0.5, 0.0], [1.0, 1.0]]))
    close(given["target"], torch.tensor([[5.0, 5.0], [8.0, 12.0]]))  # (v -+ w * track / 2) / radius
    assert given["ids"].tolist() == [3, 1]


def test_a_late_action_is_the_earlier_one() -> None:
    def run(latency: int | None, actions: list[torch.Tensor]) -> torch.Tensor:
        cfg = ReachEnvCfg()
        cfg.scene.num_envs, cfg.seed = 2, 0
        cfg.actions = {"arm": mdp.DelayedJointPositionActionCfg(asset_name="robot", joint_names=["joint.*"], scale=0.3)}
        cfg.events = {}
        if latency is not None:
            cfg.events["late"] = EventTermCfg(
                func=mdp.randomize_action_latency,
                mode="reset",
                params={"action_name": "arm", "latency_range": (latency, latency)},
            )
        env = ManagerBasedRLEnv(cfg, num_threads=1)
        env.reset(seed=0)
        path = []
        for action in actions:
            env.step(action)
            path.append(env.scene["robot"].data.joint_pos.torch.clone())
        return torch.stack(path)

    generator = torch.Generator().manual_seed(0)
    actions = [torch.randn(2, 7, generator=generator) for _ in range(6)]
    decimation = ReachEnvCfg().decimation
    shifted = run(None, [actions[0], *actions[:-1]])
    late = run(decimation, actions)
    assert torch.equal(late, shifted)
    assert not torch.equal(run(1, actions), late)
    assert torch.equal(run(0, actions), run(None, actions))


# -- curriculum


def test_curriculum_changes_what_it_names(dog: ManagerBasedRLEnv) -> None:
    def later(env: Any, env_ids: Any, old: Any, value: Any, num_steps: int) -> Any:
        return value if env.common_step_counter > num_steps else mdp.modify_env_param.NO_CHANGE

    params: dict[str, Any] = {"term_name": "action_rate_l2", "weight": -0.5, "num_steps": 10**9}
    weight = mdp.modify_reward_weight(CurriculumTermCfg(func=mdp.modify_reward_weight, params=params), dog)
    before = dog.reward_manager.get_term_cfg("action_rate_l2").weight
    assert weight(dog, None, **params) == before
    assert weight(dog, None, **{**params, "num_steps": -1}) == -0.5
    assert dog.reward_manager.get_term_cfg("action_rate_l2").weight == -0.5
    params = {"address": "rewards.feet_air_time.params", "modify_fn": later, "modify_params": {"value": {"a": 1}, "num_steps": 10**9}}  # fmt: skip  # noqa: E501
    term = mdp.modify_term_cfg(CurriculumTermCfg(func=mdp.modify_term_cfg, params=params), dog)
    old = dog.reward_manager.cfg.feet_air_time.params
    term(dog, None, **params)
    assert dog.reward_manager.cfg.feet_air_time.params is old
    term(dog, None, **{**params, "modify_params": {"value": old, "num_steps": -1}})
    params["address"] = "rewards.feet_airtime.params"
    wrong = mdp.modify_term_cfg(CurriculumTermCfg(func=mdp.modify_term_cfg, params=params), dog)
    with pytest.raises(InputError, match="feet_airtime"):
        wrong(dog, None, **params)


# -- lidar


@pytest.mark.parametrize("kind", ["kit", "isaaclab"])
def test_lidar_ranges_are_shares_of_the_reach(kind: str) -> None:
    distance = torch.tensor([[1.0, 4.0, torch.inf]])
    view = lambda tensor: SimpleNamespace(torch=tensor)  # noqa: E731
    hits = distance.unsqueeze(-1) * torch.tensor([1.0, 0.0, 0.0]) + torch.tensor([5.0, 0.0, 0.0])
    data = (
        SimpleNamespace(ranges=view(distance))
        if kind == "kit"
        else SimpleNamespace(ray_hits_w=view(hits), pos_w=view(torch.tensor([[5.0, 0.0, 0.0]])))
    )
    env: Any = SimpleNamespace(scene=SimpleNamespace(sensors={"lidar": SimpleNamespace(data=data)}))
    close(mdp.lidar_ranges(env, max_distance=2.0), torch.tensor([[0.5, 1.0, 1.0]]))

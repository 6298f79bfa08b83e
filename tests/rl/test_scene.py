"""Robots and sensors of a scene against MuJoCo's own functions and SciPy's rotations."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from robotbrain.errors import InputError
from robotbrain.rl import math_utils
from robotbrain.rl.scene import ArticulationCfg, ContactSensorCfg, InitialStateCfg, InteractiveScene, LidarCfg
from robotbrain.rl.scene.scene_cfg import SimulationCfg
from tests.rl import tiny_tasks as tiny

torch.set_num_threads(1)


def scene(cfg: Any = None, **changes: Any) -> InteractiveScene:
    changes.setdefault("num_envs", 6)
    made = InteractiveScene((cfg or tiny.WalkerSceneCfg)(**changes), SimulationCfg(dt=0.005), num_threads=2)
    made.reset()
    return made


def scattered(made: InteractiveScene, seed: int = 0) -> np.random.Generator:
    """Put the walker into random states in the air."""
    rng = np.random.default_rng(seed)
    n, robot = made.num_envs, made["robot"]
    pose = np.concatenate((rng.normal((0, 0, 2), 1, (n, 3)), Rotation.random(n, rng=rng).as_quat()), 1)
    robot.write_root_pose_to_sim_index(root_pose=torch.from_numpy(pose).float())
    robot.write_root_velocity_to_sim_index(root_velocity=torch.from_numpy(rng.normal(size=(n, 6))).float())
    q, v = (torch.from_numpy(rng.uniform(-0.5, 0.5, (n, 2))).float() for _ in range(2))
    robot.write_joint_state_to_sim(q, v)
    return rng


def reference(made: InteractiveScene, env: int) -> tuple[mujoco.MjModel, mujoco.MjData]:
    model, data = made.world.batch.get_model(env), made.world.batch.get_data(env)
    mujoco.mj_forward(model, data)
    return model, data


def test_root_frame_agrees_with_scipy() -> None:
    made = scene()
    scattered(made)
    data = made["robot"].data
    turn = Rotation.from_quat(data.root_quat_w.torch.numpy())
    close = {"rtol": 0, "atol": 2e-6}
    np.testing.assert_allclose(data.root_rotation_w.torch, turn.as_matrix(), **close)
    np.testing.assert_allclose(data.root_lin_vel_b.torch, turn.inv().apply(data.root_lin_vel_w.torch), **close)
    np.testing.assert_allclose(data.root_ang_vel_b.torch, turn.inv().apply(data.root_ang_vel_w.torch), **close)
    np.testing.assert_allclose(data.projected_gravity_b.torch, turn.inv().apply([[0, 0, -1.0]] * 6), **close)
    np.testing.assert_allclose(data.heading_w.torch, np.arctan2(*turn.as_matrix()[:, [1, 0], 0].T), **close)


def test_bodies_agree_with_mujoco() -> None:
    made = scene()
    scattered(made)
    data, names = made["robot"].data, made["robot"].body_names
    velocity = np.zeros(6)
    for env in range(made.num_envs):
        model, mj = reference(made, env)
        for i, name in enumerate(names):
            body = mj.body(name)
            np.testing.assert_allclose(data.body_pos_w.torch[env, i], body.xpos, atol=1e-5)
            np.testing.assert_allclose(data.body_quat_w.torch[env, i], body.xquat[[1, 2, 3, 0]], atol=1e-6)
            mujoco.mj_objectVelocity(model, mj, int(mujoco.mjtObj.mjOBJ_XBODY), body.id, velocity, 0)
            np.testing.assert_allclose(data.body_ang_vel_w.torch[env, i], velocity[:3], atol=1e-5)
            np.testing.assert_allclose(data.body_lin_vel_w.torch[env, i], velocity[3:], atol=1e-5)
        np.testing.assert_allclose(data.joint_acc.torch[env], mj.qacc[6:], rtol=1e-4, atol=1e-3)
        np.testing.assert_allclose(data.applied_torque.torch[env], mj.qfrc_actuator[6:], rtol=1e-5, atol=1e-5)
    assert torch.equal(data.body_pos_w.torch[:, 0], data.root_pos_w.torch)


def test_what_is_written_is_read_back() -> None:
    made = scene()
    robot, before = made["robot"], made.world.rows.copy()
    ids = torch.tensor([4, 1])
    quat = torch.tensor([[0.1, -0.2, 0.3, 0.9], [0.5, 0.5, -0.5, 0.5]])
    quat /= quat.norm(dim=1, keepdim=True)
    pose, velocity = torch.cat((torch.rand(2, 3), quat), 1), torch.rand(2, 6)
    robot.write_root_pose_to_sim_index(root_pose=pose, env_ids=ids)
    robot.write_root_velocity_to_sim_index(root_velocity=velocity, env_ids=ids)
    robot.write_joint_state_to_sim(torch.full((2, 1), 0.3), torch.full((2, 1), -0.7), joint_ids=[1], env_ids=ids)
    torch.testing.assert_close(robot.data.root_pose_w.torch[ids], pose)
    torch.testing.assert_close(robot.data.root_vel_w.torch[ids], velocity)
    assert robot.data.joint_pos.torch[ids].tolist() == [[0.0, pytest.approx(0.3)]] * 2
    assert robot.data.joint_vel.torch[ids].tolist() == [[0.0, pytest.approx(-0.7)]] * 2
    others = [0, 2, 3, 5]
    np.testing.assert_array_equal(made.world.rows[others], before[others])
    made.reset(ids)
    np.testing.assert_array_equal(made.world.rows, before)


@pytest.mark.parametrize("asked_before", [True, False])
def test_derived_data_are_computed_once_per_state_and_are_those_of_the_new_state(asked_before: bool) -> None:
    made = scene()
    view = made["robot"].data.body_pos_w
    if asked_before:
        first = view.torch
        clone = first.clone()
        assert view.torch is first
    made.world.step(20)
    before = made.world.rows.copy()
    assert not asked_before or not torch.equal(view.torch, clone)
    for env in range(made.num_envs):
        model, mj = made.world.batch.get_model(env), made.world.batch.get_data(env)
        mujoco.mj_kinematics(model, mj)
        np.testing.assert_allclose(view.torch[env], mj.xpos[made["robot"].body_ids_in_model], atol=1e-6)
    np.testing.assert_array_equal(made.world.rows, before)  # looking changes nothing


def test_targets_reach_the_actuators_by_joint() -> None:
    made = scene(tiny.ArmSceneCfg, num_envs=4)
    robot = made["robot"]
    robot.set_joint_position_target(torch.tensor([[0.1, 0.2]] * 4))
    assert made.world.ctrl.tolist() == [pytest.approx([0.2, 0.1])] * 4  # the elbow's actuator comes first
    robot.set_joint_position_target(torch.tensor([[0.5]]), joint_ids=[1], env_ids=[3])
    assert made.world.ctrl[3].tolist() == pytest.approx([0.5, 0.1]) and made.world.ctrl[0, 0] == pytest.approx(0.2)
    torch.testing.assert_close(robot.data.joint_pos_target.torch[3], torch.tensor([0.1, 0.5]))
    with pytest.raises(InputError, match="fixed-base"):
        robot.write_root_pose_to_sim_index(root_pose=torch.zeros(4, 7))


def test_default_state_comes_from_the_configuration() -> None:
    init = InitialStateCfg(
        pos=(0.0, 0.0, 1.0), rot=(0.0, 0.0, 1.0, 0.0), joint_pos={"left_.*": 0.2}, lin_vel=(1.0, 0.0, 0.0)
    )
    made = scene(robot=ArticulationCfg(model=tiny.WALKER, init_state=init, soft_joint_pos_limit_factor=0.5))
    data = made["robot"].data
    assert data.root_pose_w.torch[0].tolist() == [0.0, 0.0, 1.0, 0.0, 0.0, 1.0, 0.0]
    assert data.joint_pos.torch[0].tolist() == [pytest.approx(0.2), 0.0]
    assert data.root_lin_vel_b.torch[0].tolist() == pytest.approx([-1.0, 0.0, 0.0], abs=1e-6)
    assert data.soft_joint_pos_limits.torch[0, 0].tolist() == [-0.5, 0.5]


def test_model_parameters_differ_between_environments() -> None:
    made = scene()
    robot = made["robot"]
    mass = robot.model_param("body_mass")
    trunk = robot.body_ids_in_model[0]
    mass[1, trunk] *= 3
    robot.mark_const_dirty([1])
    scattered(made)
    made.world.step(1)
    for env in (0, 1):
        model, _ = reference(made, env)
        expected = mujoco.MjModel.from_xml_string(tiny.WALKER)
        expected.body_mass[trunk] *= 3 if env else 1
        mujoco.mj_setConst(expected, mujoco.MjData(expected))
        assert model.body_mass[trunk] == expected.body_mass[trunk]
        np.testing.assert_allclose(model.dof_invweight0, expected.dof_invweight0, rtol=1e-12)
    with pytest.raises(InputError, match="Did you mean 'body_mass'"):
        robot.model_param("body_mas")


def test_contact_forces_carry_the_weight() -> None:
    made = scene(num_envs=2)
    sensor, robot = made["contact_forces"], made["robot"]
    for _ in range(200):
        made.world.step(4)
        made.update(0.02)
    weight = 9.81 * float(robot.default_model_param("body_mass").sum())
    forces = sensor.data.net_normal_forces_w_history.torch
    assert forces.shape == (2, 1, 2, 3) and (forces[..., :2] == 0).all()
    assert forces[0, 0, :, 2].sum().item() == pytest.approx(weight, rel=0.02)
    assert torch.equal(sensor.data.net_forces_w.torch, forces[:, 0])
    assert (sensor.data.current_contact_time.torch > 3.0).all() and (sensor.data.current_air_time.torch == 0).all()
    sensor.reset([0])
    assert (sensor.data.current_contact_time.torch[0] == 0).all() and (forces[0] == 0).all() and forces[1].sum() > 0


def air_times(touch: np.ndarray, dt: float) -> list[tuple[float, float, float, float]]:
    """The four clocks of one body, written down from their definition: (air, last air, contact, last contact)."""
    air = last_air = contact = last_contact = 0.0
    rows = []
    for touching in touch:
        if touching:
            last_air = air + dt if air > 0 else last_air
            contact, air = contact + dt, 0.0
        else:
            last_contact = contact + dt if contact > 0 else last_contact
            air, contact = air + dt, 0.0
        rows.append((air, last_air, contact, last_contact))
    return rows


def test_air_and_contact_times_follow_their_definition(monkeypatch: pytest.MonkeyPatch) -> None:
    made = scene(num_envs=3)
    sensor, dt = made["contact_forces"], 0.02
    touch = np.random.default_rng(0).random((40, 3, 2)) < 0.6
    fields = ("current_air_time", "last_air_time", "current_contact_time", "last_contact_time")
    seen = []
    for row in touch:
        monkeypatch.setattr(made.world, "measured", lambda name, row=row: row * 25.0)
        sensor.update(dt)
        seen.append(np.stack([getattr(sensor.data, f).torch.numpy().copy() for f in fields], -1))
        landed = sensor.compute_first_contact(dt).torch.numpy()
        np.testing.assert_array_equal(landed, (seen[-1][..., 2] > 0) & (seen[-1][..., 2] < 1.5 * dt))
    for env in range(3):
        for body in range(2):
            expected = air_times(touch[:, env, body], dt)
            np.testing.assert_allclose(np.stack(seen)[:, env, body], expected, atol=1e-5)


def test_lidar_measures_the_wall_in_each_environment() -> None:
    made = scene()
    robot, ranges = made["robot"], made["lidar"].data.ranges
    place = torch.tensor([[0.0, 0, 1, 0, 0, 0, 1]]).repeat(6, 1)
    place[:, 0] = torch.linspace(-1.0, 1.0, 6)
    turn = torch.linspace(-0.5, 0.5, 6)
    place[:, 5], place[:, 6] = (turn / 2).sin(), (turn / 2).cos()
    robot.write_root_pose_to_sim_index(root_pose=place)
    angles = turn[:, None] + torch.tensor([-0.3, 0.0, 0.3])
    expected = (1.9 - place[:, :1] - 0.1 * turn[:, None].cos()) / angles.cos()
    torch.testing.assert_close(ranges.torch, expected, atol=1e-5, rtol=0)
    robot.write_root_pose_to_sim_index(root_pose=torch.tensor([[0, 0, 1.0, 0, 0, 1, 0]]), env_ids=[2])
    assert ranges.torch[2].tolist() == [5.0, 5.0, 5.0]  # turned away: out of range
    torch.testing.assert_close(ranges.torch[3:], expected[3:], atol=1e-5, rtol=0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"robot": ArticulationCfg(model="<mujoco>")}, "MuJoCo says"),
        ({"robot": ArticulationCfg(model=tiny.WALKER, root_body="trnk")}, "Did you mean 'trunk'"),
        ({"lidar": LidarCfg(body="tronk")}, "Did you mean 'trunk'"),
        ({"lidar": LidarCfg(body="trunk", angles=())}, "at least one angle"),
        ({"lidar": LidarCfg(body="trunk", geomgroup=(1, 0))}, "6 flags"),
        ({"robot": ArticulationCfg(model=tiny.WALKER, init_state=InitialStateCfg(joint_pos={"hip": 1.0}))}, "left_hip"),
        ({"robot": None}, "exactly one articulation"),
        ({"robot": ArticulationCfg(model=tiny.ARM), "lidar": None}, "contact_<body>"),
    ],
)
def test_scenes_that_cannot_work_are_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        scene(**changes)


def test_a_scene_names_its_entities() -> None:
    made = scene(contact_forces=ContactSensorCfg())
    assert made.keys() == ["robot", "contact_forces", "lidar"]
    with pytest.raises(InputError, match="Did you mean 'robot'"):
        made["robt"]
    assert made["robot"].find_joints(["right_.*", "left_hip"], preserve_order=True) == (
        [1, 0],
        ["right_hip", "left_hip"],
    )
    assert made["robot"].find_joints(["right_.*", "left_hip"]) == ([0, 1], ["left_hip", "right_hip"])
    with pytest.raises(InputError, match="More than one"):
        made["robot"].find_joints([".*", "left_hip"])
    with pytest.raises(InputError, match="regular expression"):
        made["robot"].find_joints("*")


def test_rotations_agree_with_scipy() -> None:
    rng = np.random.default_rng(1)
    a, b = Rotation.random(50, rng=rng), Rotation.random(50, rng=rng)
    vectors = rng.normal(size=(50, 3))
    qa, qb, v = (torch.from_numpy(x) for x in (a.as_quat(), b.as_quat(), vectors))

    def same(quat: torch.Tensor, rotation: Rotation) -> None:
        assert (Rotation.from_quat(quat.numpy()) * rotation.inv()).magnitude().max() < 1e-7

    same(math_utils.quat_mul(qa, qb), a * b)
    same(math_utils.quat_inv(2 * qa), a.inv())
    np.testing.assert_allclose(math_utils.quat_apply(qa, v), a.apply(vectors), atol=1e-12)
    np.testing.assert_allclose(math_utils.quat_apply_inverse(qa, v), a.inv().apply(vectors), atol=1e-12)
    np.testing.assert_allclose(math_utils.matrix_from_quat(qa), a.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(math_utils.quat_error_magnitude(qa, qb), (a * b.inv()).magnitude(), atol=1e-7)
    np.testing.assert_allclose(
        math_utils.matrix_from_quat(math_utils.quat_from_angle_axis(*_angle_axis(a))), a.as_matrix(), atol=1e-7
    )
    np.testing.assert_allclose(math_utils.axis_angle_from_quat(-qa), a.as_rotvec(), atol=1e-7)
    euler = [torch.from_numpy(e) for e in a.as_euler("xyz").T]
    same(math_utils.quat_from_euler_xyz(*euler), a)
    np.testing.assert_allclose(torch.stack(math_utils.euler_xyz_from_quat(qa)), torch.stack(euler), atol=1e-7)
    same(math_utils.yaw_quat(qa), Rotation.from_euler("z", a.as_euler("xyz")[:, 2:]))
    position, quat = math_utils.combine_frame_transforms(v, qa, v, qb)
    back, turned = math_utils.subtract_frame_transforms(v, qa, position, quat)
    np.testing.assert_allclose(back, v, atol=1e-12)
    same(turned, b)
    assert (math_utils.quat_unique(qa)[:, 3] >= 0).all()


def _angle_axis(rotation: Rotation) -> tuple[torch.Tensor, torch.Tensor]:
    vector = torch.from_numpy(rotation.as_rotvec())
    return vector.norm(dim=1), 3 * vector


def test_wrapping_keeps_the_angle_and_the_range() -> None:
    angles = torch.linspace(-20, 20, 1001, dtype=torch.float64)
    wrapped = math_utils.wrap_to_pi(angles)
    assert (wrapped.abs() <= np.pi).all()
    torch.testing.assert_close(torch.stack((wrapped.sin(), wrapped.cos())), torch.stack((angles.sin(), angles.cos())))
    assert math_utils.wrap_to_pi(torch.tensor([np.pi, -np.pi, 3 * np.pi])).tolist() == pytest.approx(
        [np.pi, -np.pi, np.pi]
    )


def test_draws_have_their_distribution() -> None:
    generator = torch.Generator().manual_seed(0)
    uniform = math_utils.sample_uniform(-1.0, 3.0, (20000,), generator)
    assert uniform.min() >= -1 and uniform.max() < 3 and uniform.mean().item() == pytest.approx(1.0, abs=0.04)
    log = math_utils.sample_log_uniform(0.1, 10.0, (20000,), generator).log10()
    assert log.mean().item() == pytest.approx(0.0, abs=0.02) and log.std().item() == pytest.approx(
        2 / 12**0.5, abs=0.02
    )
    gaussian = math_utils.sample_gaussian(2.0, 0.5, (20000,), generator)
    assert gaussian.mean().item() == pytest.approx(2.0, abs=0.02) and gaussian.std().item() == pytest.approx(
        0.5, abs=0.02
    )
    # rotations uniform over SO(3) turn a vector to any direction equally often
    turned = math_utils.quat_apply(
        math_utils.random_orientation(20000, generator), torch.tensor([1.0, 0, 0]).expand(20000, 3)
    )
    assert turned.mean(0).abs().max() < 0.02 and (turned.square().mean(0) - 1 / 3).abs().max() < 0.02
    yaw = math_utils.random_yaw_orientation(20000, generator)
    assert (yaw[:, :2] == 0).all() and (2 * torch.atan2(yaw[:, 2], yaw[:, 3])).std().item() == pytest.approx(
        1.81, abs=0.03
    )

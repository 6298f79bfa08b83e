"""The arm and the quadruped as physics: reach, damping, mass, symmetry, standing, touch."""

from __future__ import annotations

import math

import mujoco
import numpy as np
import pytest

from robotbrain.rl.robots import arm, arm_mjcf, quadruped, quadruped_mjcf

FLIP = np.array([1.0, -1.0, 1.0])  # the mirror image of a point


@pytest.fixture(scope="module")
def dog() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(quadruped_mjcf())


@pytest.fixture(scope="module")
def manipulator() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(arm_mjcf())


def mirrored(name: str) -> str:
    return name[:1] + name[1:2].translate(str.maketrans("LR", "RL")) + name[2:] if name[:1] in "FR" else name


# ------------------------------------------------------------ the arm


def test_the_arm_has_the_names_everybody_relies_on(manipulator: mujoco.MjModel) -> None:
    joints = [manipulator.joint(i).name for i in range(manipulator.njnt)]
    assert joints == [f"joint{i}" for i in range(1, 8)]
    assert [manipulator.actuator(i).name for i in range(manipulator.nu)] == joints
    assert {f"link{i}" for i in range(1, 8)} | {"hand"} <= {manipulator.body(i).name for i in range(manipulator.nbody)}
    assert manipulator.site("ee").bodyid[0] == manipulator.body("hand").id
    assert manipulator.opt.timestep == 0.005
    np.testing.assert_allclose(manipulator.qpos0, manipulator.key("home").qpos)


def test_stretched_the_arm_is_as_long_as_it_says(manipulator: mujoco.MjModel) -> None:
    data = mujoco.MjData(manipulator)
    data.qpos[:] = 0.0
    mujoco.mj_kinematics(manipulator, data)
    np.testing.assert_allclose(data.site("ee").xpos, (0.0, 0.0, arm.SHOULDER_HEIGHT + arm.REACH), rtol=0, atol=1e-12)


def test_every_point_of_the_workspace_is_within_reach_with_margin(manipulator: mujoco.MjModel) -> None:
    data, jacobian = mujoco.MjData(manipulator), np.zeros((3, manipulator.nv))
    site, (low, high) = manipulator.site("ee").id, manipulator.jnt_range.T
    home = np.array(arm.HOME)
    corners = [np.linspace(*bounds, count) for bounds, count in zip(arm.WORKSPACE, (3, 5, 3), strict=True)]
    for target in np.stack(np.meshgrid(*corners), axis=-1).reshape(-1, 3):
        q = home.copy()
        q[0] = math.atan2(target[1], target[0])
        for _ in range(80):  # damped least squares that prefers the default pose
            data.qpos[:] = q
            mujoco.mj_kinematics(manipulator, data)
            mujoco.mj_comPos(manipulator, data)
            mujoco.mj_jacSite(manipulator, data, jacobian, None, site)
            error = target - data.site_xpos[site]
            inverse = jacobian.T @ np.linalg.inv(jacobian @ jacobian.T + 1e-3 * np.eye(3))
            q = q + inverse @ error + (np.eye(7) - inverse @ jacobian) @ (0.1 * (home - q))
            q = q.clip(low + 0.1, high - 0.1)
        assert np.linalg.norm(error) < 1e-3, target
        # The ends of the box are near a stretched arm, but its hand can still move in every direction.
        assert np.linalg.svd(jacobian, compute_uv=False)[-1] > 0.1, target


def test_the_arm_holds_its_pose_without_effort(manipulator: mujoco.MjModel) -> None:
    data = mujoco.MjData(manipulator)
    mujoco.mj_resetDataKeyframe(manipulator, data, 0)
    mujoco.mj_step(manipulator, data, nstep=200)
    np.testing.assert_allclose(data.qpos, arm.HOME, atol=1e-9)
    assert np.abs(data.actuator_force).max() < 1e-6


@pytest.mark.parametrize("joint", range(7))
def test_the_servos_settle_without_ringing(manipulator: mujoco.MjModel, joint: int) -> None:
    data, step = mujoco.MjData(manipulator), 0.3
    mujoco.mj_resetDataKeyframe(manipulator, data, 0)
    data.ctrl[joint] += step
    angle = np.empty(400)
    for k in range(angle.size):
        mujoco.mj_step(manipulator, data)
        angle[k] = (data.qpos[joint] - arm.HOME[joint]) / step
    assert angle.max() < 1.2
    assert np.argmax(angle > 0.9) * manipulator.opt.timestep < 0.25
    assert abs(angle[-1] - 1.0) < 1e-3


def test_the_servos_are_critically_damped_in_the_default_pose(manipulator: mujoco.MjModel) -> None:
    data, inertia = mujoco.MjData(manipulator), np.zeros((7, 7))
    mujoco.mj_resetDataKeyframe(manipulator, data, 0)
    mujoco.mj_forward(manipulator, data)
    mujoco.mj_fullM(manipulator, data, inertia)
    felt = 1.0 / np.diag(np.linalg.inv(inertia))  # by one motor while the other joints are free
    stiffness, damping = manipulator.actuator_gainprm[:, 0], -manipulator.actuator_biasprm[:, 2]
    np.testing.assert_allclose(damping, 2.0 * np.sqrt(stiffness * felt), rtol=1e-6)


def test_random_targets_at_25_hz_never_shake_the_arm(manipulator: mujoco.MjModel) -> None:
    data, rng, (low, high) = mujoco.MjData(manipulator), np.random.default_rng(0), manipulator.jnt_range.T
    mujoco.mj_resetDataKeyframe(manipulator, data, 0)
    for _ in range(250):
        data.ctrl[:] = np.clip(data.qpos + 0.3 * rng.uniform(-1.0, 1.0, 7), low, high)
        mujoco.mj_step(manipulator, data, nstep=8)
        assert np.abs(data.qvel).max() < 12.0
    assert data.warning.number.sum() == 0


# ------------------------------------------------------------ the quadruped


def test_the_quadruped_has_the_names_everybody_relies_on(dog: mujoco.MjModel) -> None:
    joints = tuple(dog.joint(i).name for i in range(1, dog.njnt))
    expected = tuple(f"{leg}_{part}_joint" for leg in ("FL", "FR", "RL", "RR") for part in ("hip", "thigh", "calf"))
    assert joints == expected == quadruped.JOINT_NAMES
    assert tuple(dog.actuator(i).name for i in range(dog.nu)) == joints
    np.testing.assert_allclose(dog.qpos0, dog.key("home").qpos)
    np.testing.assert_allclose(dog.qpos0[7:], quadruped.DEFAULT_JOINT_POS)
    sensors = {dog.sensor(i).name for i in range(dog.nsensor)}
    assert {"contact_base", "contact_FL_foot", "contact_RR_calf", "contact_RL_thigh"} <= sensors


def test_the_masses_add_up(dog: mujoco.MjModel) -> None:
    assert dog.body_mass.sum() == pytest.approx(quadruped.SPEC.mass)
    assert 12.0 < quadruped.SPEC.mass < 15.0
    x, y, z = quadruped.SPEC.trunk_half
    expected = quadruped.SPEC.trunk_mass / 3.0 * np.array([y * y + z * z, x * x + z * z, x * x + y * y])
    np.testing.assert_allclose(np.sort(dog.body("base").inertia), np.sort(expected))


def test_left_and_right_are_mirror_images(dog: mujoco.MjModel) -> None:
    for i in range(1, dog.nbody):
        body, twin = dog.body(i), dog.body(mirrored(dog.body(i).name))
        np.testing.assert_allclose(body.pos, twin.pos * FLIP, atol=1e-12)
        np.testing.assert_allclose(body.ipos, twin.ipos * FLIP, atol=1e-12)
        np.testing.assert_allclose(body.inertia, twin.inertia, atol=1e-12)
        assert body.mass == twin.mass


def test_mirrored_motors_move_it_in_mirrored_ways(dog: mujoco.MjModel) -> None:
    names = quadruped.JOINT_NAMES
    swap = np.array([names.index(mirrored(name)) for name in names])
    sign = np.array([-1.0 if "hip" in name else 1.0 for name in names])
    rng, data, image = np.random.default_rng(1), mujoco.MjData(dog), mujoco.MjData(dog)
    for d in (data, image):
        mujoco.mj_resetDataKeyframe(dog, d, 0)
    for _ in range(25):
        data.ctrl[:] = np.array(quadruped.DEFAULT_JOINT_POS) + 0.2 * rng.standard_normal(12)
        image.ctrl[:] = data.ctrl[swap] * sign
        mujoco.mj_step(dog, data, nstep=4)
        mujoco.mj_step(dog, image, nstep=4)
    assert abs(data.qpos[1]) > 1e-3  # it has left the plane of symmetry
    np.testing.assert_allclose(image.qpos[:3], data.qpos[:3] * FLIP, atol=1e-5)
    np.testing.assert_allclose(image.qpos[7:], data.qpos[7:][swap] * sign, atol=1e-4)


def test_it_stands_in_its_default_pose(dog: mujoco.MjModel) -> None:
    data = mujoco.MjData(dog)
    mujoco.mj_resetDataKeyframe(dog, data, 0)
    mujoco.mj_forward(dog, data)
    feet = [data.body(f"{leg}_foot").xpos[2] - quadruped.SPEC.foot_radius for leg in quadruped.LEGS]
    assert all(0.0 <= gap < 2e-3 for gap in feet)
    mujoco.mj_step(dog, data, nstep=800)
    assert abs(data.qpos[2] - quadruped.STAND_HEIGHT) < 0.04  # springs give way a little
    tilt = math.acos(1.0 - 2.0 * (data.qpos[4] ** 2 + data.qpos[5] ** 2))
    assert tilt < math.radians(5.0)
    assert np.abs(data.qvel).max() < 0.02
    assert np.abs(data.actuator_force).max() < 0.5 * min(quadruped.SPEC.torque)
    touch = {dog.sensor(i).name: data.sensor(i).data[0] for i in range(dog.nsensor)}
    weight = quadruped.SPEC.mass * 9.81
    assert sum(f for name, f in touch.items() if name.endswith("foot")) == pytest.approx(weight, rel=0.02)
    assert all(f == 0.0 for name, f in touch.items() if not name.endswith("foot"))


@pytest.mark.parametrize(
    ("height", "quat", "angles", "touching"),
    [
        (0.05, (1.0, 0.0, 0.0, 0.0), (0.0, 2.5, -2.6), "contact_base"),
        (0.12, (0.0, 1.0, 0.0, 0.0), (0.0, 0.9, -1.6), "contact_base"),
        (0.22, (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, -2.69), "contact_FL_thigh"),
        (0.06, (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, -1.57), "contact_FL_calf"),
    ],
)
def test_every_touch_sensor_feels_its_body_touch_the_floor(
    dog: mujoco.MjModel, height: float, quat: tuple[float, ...], angles: tuple[float, ...], touching: str
) -> None:
    data = mujoco.MjData(dog)
    data.qpos[:] = [0.0, 0.0, height, *quat, *(angles * 4)]
    data.ctrl[:] = angles * 4
    felt: dict[str, float] = {}
    for _ in range(200):
        mujoco.mj_step(dog, data)
        felt = {dog.sensor(i).name: max(felt.get(dog.sensor(i).name, 0.0), data.sensor(i).data[0]) for i in range(13)}
    assert felt[touching] > 1.0, felt
    # What the sensors feel together is all that the floor presses: no contact lies outside their sites.
    pressed = sum(float(c.frame[2]) * _normal_force(dog, data, i) for i, c in enumerate(data.contact[: data.ncon]))
    assert sum(data.sensordata) == pytest.approx(abs(pressed), rel=1e-6)


def _normal_force(model: mujoco.MjModel, data: mujoco.MjData, contact: int) -> float:
    force = np.zeros(6)
    mujoco.mj_contactForce(model, data, contact, force)
    return float(force[0])

"""The surrogate's parts against closed forms and MuJoCo, and its promises: serial, seeds, independence."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robotbrain.errors import InputError
from robotbrain.rl.policy_meta import PolicyMeta
from robotbrain.rl.surrogate import RANGES, Surrogate, SurrogateFleet, SurrogateParams, draw, neutral
from robotbrain.rl.surrogate.body import Kinematics, load_body
from robotbrain.rl.surrogate.drive import DelayLine, Drive, lag_factor, play
from robotbrain.rl.surrogate.velocity import walk


def _with(**changes: object) -> SurrogateParams:
    return SurrogateParams(**{**vars(neutral(7)), **changes})  # type: ignore[arg-type]


@given(amplitude=st.floats(0.01, 1.0), gap=st.floats(0.001, 0.4))
@settings(max_examples=15, deadline=None)
def test_the_hysteresis_loop_of_play_has_the_area_of_the_closed_form(amplitude: float, gap: float) -> None:
    half = np.array(gap / 2)
    motor = amplitude * np.sin(np.linspace(0.0, 4 * np.pi, 2001))
    out, link = np.array(0.0), []
    for angle in motor:
        out = play(out, np.array(angle), half)
        link.append(float(out))
    x, y = motor[1000:], np.array(link[1000:])  # the second turn: the loop is closed
    area = abs(float(np.sum((y[1:] + y[:-1]) / 2 * np.diff(x))))
    # The loop is a parallelogram of height 2 (A - h) and width 2 h.
    expected = max(0.0, 4 * (gap / 2) * (amplitude - gap / 2))
    assert area == pytest.approx(expected, abs=1e-4 + 2e-3 * expected)


def test_play_does_not_depend_on_speed_and_passes_nothing_smaller_than_the_gap() -> None:
    half = np.full(1, 0.05)
    slow, fast = np.zeros(1), np.zeros(1)
    for angle in np.linspace(0.0, 0.3, 100):
        slow = play(slow, np.array([angle]), half)
    fast = play(fast, np.array([0.3]), half)
    np.testing.assert_allclose(slow, fast)
    np.testing.assert_allclose(play(fast, np.array([0.21]), half), fast)
    np.testing.assert_allclose(play(fast, np.array([0.19]), half), [0.24])


def test_lag_is_that_of_mujocos_exact_filter() -> None:
    lag = np.array([0.02, 0.05])
    drive = Drive(0.005, np.zeros(2, np.int64), lag, np.zeros((2, 1)))
    ours = drive.run(np.ones((2, 1)), 40)[:, :, 0]
    for row, constant in enumerate(lag):
        model = mujoco.MjModel.from_xml_string(
            f"""<mujoco><option timestep="0.005"/><worldbody><body><joint name="j" axis="0 0 1"/>
            <geom size="0.1"/></body></worldbody><actuator><general joint="j" dyntype="filterexact"
            dynprm="{constant}"/></actuator></mujoco>"""
        )
        data = mujoco.MjData(model)
        data.ctrl[0] = 1.0
        for step in range(40):
            mujoco.mj_step(model, data)
            assert ours[row, step] == pytest.approx(data.act[0], abs=1e-12)
            assert ours[row, step] == pytest.approx(1 - np.exp(-(step + 1) * 0.005 / constant), abs=1e-12)
    assert lag_factor(0.005, 0.0) == 1.0


def test_the_delay_is_exact_and_each_robots_own() -> None:
    delays = np.array([0, 1, 5, 9])
    line = DelayLine(delays, 1)
    line.fill(np.arange(4), np.full((4, 1), -1.0))
    samples = np.arange(40.0)
    out = np.concatenate([line.push(np.tile(samples[i : i + 4, None], (4, 1, 1))) for i in range(0, 40, 4)], axis=1)
    for row, delay in enumerate(delays):
        expected = np.concatenate([np.full(delay, -1.0), samples])[:40]
        np.testing.assert_array_equal(out[row, :, 0], expected)


def test_a_ramp_in_pieces_is_the_ramp_in_one() -> None:
    def drive() -> Drive:
        return Drive(0.005, np.array([2]), np.array([0.01]), np.full((1, 1), 0.001))

    whole = drive().run(np.ones((1, 1)), 8, 8)
    pieces = drive()
    parts = [pieces.run(np.ones((1, 1)), 2, left) for left in (8, 6, 4, 2)]
    np.testing.assert_allclose(np.concatenate(parts, axis=1), whole, atol=1e-12)


def test_kinematics_are_mujocos() -> None:
    body = load_body("arm")
    data = mujoco.MjData(body.model)
    angles = np.random.default_rng(0).uniform(body.limits[:, 0], body.limits[:, 1], (20, 7))
    hand = Kinematics(body)(angles)
    for row, place in zip(angles, hand, strict=True):
        data.qpos[body.qpos] = row
        mujoco.mj_kinematics(body.model, data)
        np.testing.assert_allclose(place, data.site("ee").xpos, atol=1e-12)


def test_a_payload_adds_its_weight_times_its_arm_to_the_shoulder() -> None:
    mass, offset = 0.8, np.array([0.02, -0.01, 0.03])
    fleet = SurrogateFleet([0, 1], params=[neutral(7), _with(payload=mass, payload_offset=offset)])
    body = fleet.body
    torques = []
    for row in range(2):
        model = fleet._batch.get_model(row)
        data = mujoco.MjData(model)
        data.qpos[body.qpos] = body.default_joint_pos
        mujoco.mj_forward(model, data)
        torques.append(data.qfrc_bias - data.qfrc_gravcomp)
        if row == 1:
            turn = data.body("hand").xmat.reshape(3, 3)
            weight = np.array([0.0, 0.0, -9.81 * mass])
            # About the compensated hand: its own weight now acts at the common centre of mass.
            place = data.body("hand").xpos + turn @ offset
            own = model.body_mass[body.payload] - mass
            before = data.body("hand").xpos + turn @ body.model.body_ipos[body.payload]
            moved = data.xipos[body.payload] - before
            joint = data.joint("joint2")
            expected = -np.dot(joint.xaxis, np.cross(place - joint.xanchor, weight))
            slack = own * 9.81 * np.linalg.norm(moved)
    np.testing.assert_allclose(torques[0], 0.0, atol=1e-9)  # the nominal arm's weight is compensated
    assert abs(expected) > 1.0
    assert torques[1][1] == pytest.approx(expected, abs=slack)


def test_a_neutral_surrogate_is_the_nominal_robot() -> None:
    fleet = SurrogateFleet([5], params=[neutral(7)])
    body = fleet.body
    data = mujoco.MjData(body.model)
    target = body.default_joint_pos + 0.1
    data.qpos[body.qpos] = body.default_joint_pos
    data.ctrl[:] = target
    for _ in range(10):
        fleet.advance(target[None], 4)
        mujoco.mj_step(body.model, data, nstep=4)
    readings = fleet.read()
    np.testing.assert_allclose(readings.joint_pos[0], data.qpos[body.qpos], atol=1e-9)
    np.testing.assert_allclose(readings.joint_vel[0], data.qvel[body.dof], atol=1e-9)


def test_encoder_errors_have_the_stated_statistics() -> None:
    bias = np.linspace(-0.003, 0.003, 7)
    params = _with(encoder_bias=bias, encoder_noise=0.0004, velocity_noise=0.02, frame_drop=0.1)
    fleet = SurrogateFleet([1], params=[params])
    n, fresh, angles, speeds = 3000, [], [], []
    for _ in range(n):
        readings = fleet.read()
        fresh.append(bool(readings.fresh[0]))
        if fresh[-1]:
            angles.append(readings.joint_pos[0] - fleet.joint_pos[0])
            speeds.append(readings.joint_vel[0])
    error = np.array(angles)
    # 5 standard errors: a false alarm in about 1e5 runs, and the seed is fixed
    np.testing.assert_allclose(error.mean(0), bias, atol=5 * 0.0004 / np.sqrt(len(error)))
    np.testing.assert_allclose(error.std(0), 0.0004, rtol=5 / np.sqrt(2 * len(error)))
    np.testing.assert_allclose(np.std(speeds, axis=0), 0.02, rtol=5 / np.sqrt(2 * len(error)))
    assert np.mean(fresh) == pytest.approx(0.9, abs=5 * np.sqrt(0.09 / n))


def test_a_lost_frame_repeats_the_last_reading() -> None:
    fleet = SurrogateFleet([1], params=[_with(encoder_noise=0.001, frame_drop=0.5)])
    last = fleet.read().joint_pos
    for _ in range(50):
        readings = fleet.read()
        assert np.array_equal(readings.joint_pos, last) == (not readings.fresh[0])
        last = readings.joint_pos


def test_the_encoder_sits_on_the_motors_side_of_the_play() -> None:
    gap = 0.02
    fleet = SurrogateFleet([0], params=[_with(play=np.full(7, gap))])
    start = fleet.body.default_joint_pos
    for target in (start + 0.1, start - 0.1):
        for _ in range(60):
            fleet.advance(target[None], 8)
        side = np.sign(target - start)
        np.testing.assert_allclose(fleet.joint_pos[0], target - side * gap / 2, atol=1e-4)
        np.testing.assert_allclose(fleet.read().joint_pos[0], target, atol=1e-4)


def test_dry_friction_leaves_a_dead_band_that_stiffness_explains() -> None:
    share = 0.02
    fleet = SurrogateFleet([0], params=[_with(dry_friction=np.full(7, share))])
    body = fleet.body
    stiffness = body.model.actuator_gainprm[:, 0]
    band = share * body.torque / stiffness
    # Friction is a constraint of the solver: below breakaway it creeps by a hair.
    fleet.advance((body.default_joint_pos + 0.8 * band)[None], 8)
    moved = np.abs(fleet.joint_pos[0] - body.default_joint_pos)
    assert (moved < 0.25 * band).all()
    for _ in range(20):
        fleet.advance((body.default_joint_pos + 8 * band)[None], 8)
    assert (fleet.joint_pos[0] - body.default_joint_pos > 4 * band).all()


def test_one_serial_is_one_robot_and_ranges_hold() -> None:
    for robot, joints in (("arm", 7), ("quadruped", 12)):
        seen = [draw(s, robot, joints) for s in range(60)]  # type: ignore[arg-type]
        again = draw(3, robot, joints)  # type: ignore[arg-type]
        for name, (low, high) in RANGES[robot].items():  # type: ignore[index]
            np.testing.assert_array_equal(getattr(seen[3], name), getattr(again, name))
            values = np.array([getattr(p, name) for p in seen])
            assert low <= values.min()
            assert values.max() <= high
            assert np.ptp(values) > 0.6 * (high - low)
    assert not np.array_equal(draw(0).play, draw(1).play)


def _roll(fleet: SurrogateFleet, steps: int = 6) -> np.ndarray:
    rows = []
    for k in range(steps):
        fleet.advance(np.tile(fleet.body.default_joint_pos + 0.1 * (-1) ** k, (len(fleet), 1)), 8, 8)
        rows.append(fleet.read().joint_pos)
    return np.stack(rows)


def test_a_surrogate_does_not_depend_on_its_neighbours_nor_on_threads() -> None:
    alone = _roll(Surrogate(serial=4, seed=2))[:, 0]
    np.testing.assert_array_equal(_roll(SurrogateFleet([9, 4, 1], seed=2))[:, 1], alone)
    np.testing.assert_array_equal(_roll(SurrogateFleet([9, 4, 1], seed=2, num_threads=2))[:, 1], alone)
    assert not np.array_equal(_roll(Surrogate(serial=4, seed=3))[:, 0], alone)


def test_the_quadruped_stands_under_the_same_mechanism() -> None:
    fleet = SurrogateFleet(range(3), "quadruped")
    for _ in range(50):
        fleet.advance(np.tile(fleet.body.default_joint_pos, (3, 1)), 4)
    assert (fleet.qpos[:, 2] > 0.25).all()


def test_the_base_moves_as_its_velocity_says() -> None:
    fleet = SurrogateFleet([0], "quadruped", params=[neutral(12)])
    turn = np.array([0.9, 0.1, -0.3, 0.3])
    fleet._batch.qpos[0, :7] = [0.0, 0.0, 5.0, *(turn / np.linalg.norm(turn))]
    fleet._batch.qvel[0, :6] = [0.3, -0.2, 0.1, 0.4, 0.5, -0.6]
    speed, rate, down = fleet.base_state
    data = mujoco.MjData(fleet.body.model)
    data.qpos[:], data.qvel[:] = fleet._batch.qpos[0], fleet._batch.qvel[0]
    mujoco.mj_forward(fleet.body.model, data)
    local = np.zeros(6)  # MuJoCo's own answer: angular, linear, in the body's frame
    body = fleet.body.model.body("base").id
    mujoco.mj_objectVelocity(fleet.body.model, data, mujoco.mjtObj.mjOBJ_XBODY, body, local, 1)
    np.testing.assert_allclose(np.concatenate([rate[0], speed[0]]), local, atol=1e-12)
    np.testing.assert_allclose(down[0], data.xmat[body].reshape(3, 3).T @ [0.0, 0.0, -1.0], atol=1e-12)
    with pytest.raises(InputError):
        _ = SurrogateFleet([0]).base_state


class _Stand:
    """A walking policy that stands, and keeps what it saw."""

    def __init__(self) -> None:
        names = fleet_names("quadruped")
        self.meta = PolicyMeta(
            task="velocity",
            observation_names=(("base_lin_vel", 3), ("velocity_commands", 3), ("joint_pos", 12)),
            control_dt=0.02,
            action_kind="joint_position",
            action_scale=0.25,
            joint_names=names[::-1],
            default_joint_pos=tuple(load_body("quadruped").default_joint_pos[::-1]),
        )

    def __call__(self, obs: np.ndarray, /) -> np.ndarray:
        return np.zeros((len(obs), 12), np.float32)


def fleet_names(robot: str) -> tuple[str, ...]:
    return load_body(robot).joint_names  # type: ignore[arg-type]


def test_a_standing_policy_has_the_error_of_its_command_and_does_not_fall() -> None:
    commands = np.array([[0.0, 0.0, 0.0], [0.6, 0.0, 0.0], [0.3, 0.4, 0.0]])
    done = walk(_Stand(), range(3), commands, seconds=1.5)
    np.testing.assert_allclose(done.error, [0.0, 0.6, 0.5], atol=0.05)
    assert not done.fell.any()
    with pytest.raises(InputError):
        walk(_Stand(), range(3), commands[:2])


@pytest.mark.parametrize(
    "call",
    [
        lambda: draw(-1),
        lambda: draw(0, "boat"),  # type: ignore[arg-type]
        lambda: SurrogateFleet([]),
        lambda: SurrogateFleet([1, 2], params=[neutral(7)]),
        lambda: Surrogate(0).advance(np.full((1, 7), np.nan), 8),
        lambda: Surrogate(0).advance(np.zeros((1, 6)), 8),
        lambda: draw(0).with_nominal("temperature"),
    ],
)
def test_bad_input_is_refused(call: object) -> None:
    with pytest.raises(InputError):
        call()  # type: ignore[operator]

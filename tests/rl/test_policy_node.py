"""The policy node in simulated time, alone and against a surrogate arm; and the deployment code under both."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray

import robotbrain.ros  # noqa: F401 - makes rclpy and the messages importable
from robotbrain.errors import InputError
from robotbrain.rl.deployment import NodeOptions, PolicyRunner, joint_order, reach_bound
from robotbrain.rl.policy_meta import PolicyMeta
from robotbrain.rl.surrogate import Surrogate, SurrogateFleet, SurrogateReachEnv, neutral
from robotbrain.rl.surrogate.body import Kinematics, load_body
from robotbrain.ros import SimContext

ARM = load_body("arm")
GOAL = ARM.default_joint_pos + np.array([0.3, 0.1, -0.2, 0.2, 0.1, -0.1, 0.2])


class ServoPolicy:
    """A policy with a known answer: drive the joints to ``goal``, joints in an order of its own."""

    def __init__(self, order: ArrayLike = range(7), goal: NDArray[np.float64] = GOAL, **meta: Any) -> None:
        order = np.asarray(order)
        self.goal, self.default = goal[order], ARM.default_joint_pos[order]
        self.seen: list[NDArray[np.float32]] = []
        self.meta = PolicyMeta(
            **{
                "task": "reach",
                "observation_names": (("joint_pos", 7), ("joint_vel", 7), ("target", 3), ("actions", 7)),
                "control_dt": 0.04,
                "action_kind": "held_relative_joint_position",
                "action_scale": 0.3,
                "action_low": (-1.0,) * 7,
                "action_high": (1.0,) * 7,
                "joint_names": tuple(ARM.joint_names[i] for i in order),
                "default_joint_pos": tuple(ARM.default_joint_pos[order]),
                **meta,
            }
        )

    def __call__(self, obs: ArrayLike, /) -> NDArray[np.float32]:
        rows = np.asarray(obs, np.float32)
        self.seen.append(rows[0])
        return np.asarray((self.goal - self.default - rows[:, :7]) / 0.3, np.float32)


@pytest.fixture
def context() -> Iterator[SimContext]:
    context = SimContext()
    with context.as_default():
        yield context
    context.try_shutdown()


class Bench:
    """A node with its topics in the test's hands."""

    def __init__(self, context: SimContext, policy: Any, hand: Any = None, **options: Any) -> None:
        from geometry_msgs.msg import PoseStamped
        from rclpy.node import Node
        from rclpy.qos import qos_profile_sensor_data
        from sensor_msgs.msg import JointState
        from trajectory_msgs.msg import JointTrajectory

        from robotbrain.rl.policy_node import TRAJECTORY_TOPIC, PolicyNode

        self.context, self.sent = context, []
        order = joint_order(policy.meta.joint_names, ARM.joint_names)
        self.node = PolicyNode(policy, ARM.limits[order], hand, options=NodeOptions(**options))
        hands = Node("hands")
        self.states = hands.create_publisher(JointState, "joint_states", qos_profile_sensor_data)
        self.goals = hands.create_publisher(PoseStamped, "goal_pose", 1)
        hands.create_subscription(JointTrajectory, TRAJECTORY_TOPIC, self._take, 10)
        self.state_type, self.pose_type = JointState, PoseStamped

    def _take(self, msg: Any) -> None:
        self.sent.append((self.context.now_ns, msg))

    def goal(self, frame: str = "base", x: float = 0.5) -> None:
        msg = self.pose_type()
        msg.header.frame_id, msg.pose.position.x, msg.pose.orientation.w = frame, x, 1.0
        self.goals.publish(msg)

    def state(
        self,
        position: ArrayLike,
        names: Any = ARM.joint_names,
        velocity: ArrayLike | None = None,
        stamp_ns: int | None = None,
    ) -> None:
        from robotbrain.ros.conversions import ns_to_time

        msg = self.state_type()
        msg.header.stamp, msg.name = ns_to_time(self.context.now_ns if stamp_ns is None else stamp_ns), list(names)
        msg.position = [float(v) for v in np.asarray(position)]
        msg.velocity = [float(v) for v in (np.zeros(len(msg.name)) if velocity is None else np.asarray(velocity))]
        self.states.publish(msg)

    def run(self, seconds: float, feed: Callable[[], None] | None = None) -> None:
        end = self.context.now_ns + round(seconds * 1e9)
        while self.context.now_ns < end:
            if feed is not None:
                feed()
            self.context.run_until(min(end, self.context.now_ns + 10_000_000))


def test_commands_come_at_the_policys_rate_without_drift(context: SimContext) -> None:
    bench = Bench(context, ServoPolicy())
    bench.goal()
    bench.run(4.0, lambda: bench.state(ARM.default_joint_pos))
    times = np.array([t for t, _ in bench.sent])
    assert len(times) in (99, 100)
    np.testing.assert_array_equal(np.diff(times), 40_000_000)


@pytest.mark.parametrize("seed", range(3))
def test_joints_are_reordered_by_name_both_ways(context: SimContext, seed: int) -> None:
    rng = np.random.default_rng(seed)
    mine, theirs = rng.permutation(7), rng.permutation(9)
    position, speed = rng.uniform(0.1, 0.6, 7), rng.uniform(-1, 1, 7)
    names = [*ARM.joint_names, "finger_left", "finger_right"]
    all_position, all_speed = np.append(position, [9.0, 9.0]), np.append(speed, [9.0, 9.0])
    policy = ServoPolicy(mine)
    bench = Bench(context, policy)
    bench.goal(x=0.625)
    bench.run(0.2, lambda: bench.state(all_position[theirs], [names[i] for i in theirs], all_speed[theirs]))
    np.testing.assert_allclose(policy.seen[0][:7], (position - ARM.default_joint_pos)[mine], atol=1e-6)
    np.testing.assert_allclose(policy.seen[0][7:14], speed[mine], atol=1e-6)
    assert policy.seen[0][14] == 0.625
    np.testing.assert_array_equal(policy.seen[0][17:], 0.0)
    assert np.abs(policy.seen[1][17:]).max() > 0.0  # the last action is the policy's own
    _, msg = bench.sent[0]
    got = dict(zip(msg.joint_names, msg.points[0].positions, strict=True))
    change = 0.3 * np.clip((GOAL - position) / 0.3, -1, 1)
    for i, name in enumerate(ARM.joint_names):
        assert got[name] == pytest.approx(np.clip(position[i] + change[i], *ARM.limits[i]), abs=1e-6)


def test_another_robots_joint_states_are_refused_in_words(context: SimContext) -> None:
    bench = Bench(context, ServoPolicy())
    bench.goal()
    bench.run(0.5, lambda: bench.state(np.zeros(6), ARM.joint_names[:6]))
    assert not bench.sent
    assert bench.node.refused > 0
    refused = bench.node.refused
    bench.run(0.5, lambda: bench.state(np.zeros(2), ["finger_left", "finger_right"]))  # not ours: no error either
    assert bench.node.refused == refused
    with pytest.raises(InputError, match="joint7"):
        joint_order(ARM.joint_names, ARM.joint_names[:6])
    with pytest.raises(InputError, match="twice"):
        joint_order(["a"], ["a", "a"])


@pytest.mark.parametrize("on_stale", ["hold", "stop"])
def test_the_watchdog_holds_and_then_resumes_or_waits_for_a_goal(context: SimContext, on_stale: str) -> None:
    bench = Bench(context, ServoPolicy(), stale_s=0.15, on_stale=on_stale)
    here = ARM.default_joint_pos + 0.05
    bench.goal()
    bench.run(1.0, lambda: bench.state(here))
    silent_from = context.now_ns
    bench.run(1.0)
    late = [(t, m) for t, m in bench.sent if t > silent_from + 150_000_000]
    assert len(late) == 1  # once, and then silence
    assert late[0][0] < silent_from + 250_000_000
    np.testing.assert_allclose(late[0][1].points[0].positions, here)
    assert bench.node.stale_periods == 1
    count = len(bench.sent)
    bench.run(0.5, lambda: bench.state(here))
    assert (len(bench.sent) > count + 5) == (on_stale == "hold")
    if on_stale == "stop":
        bench.goal()
        bench.run(0.5, lambda: bench.state(here))
        assert len(bench.sent) > count + 5


def test_nothing_moves_without_a_goal_or_with_one_in_another_frame(context: SimContext) -> None:
    bench = Bench(context, ServoPolicy())
    bench.run(0.5, lambda: bench.state(ARM.default_joint_pos))
    bench.goal(frame="map")
    bench.run(0.5, lambda: bench.state(ARM.default_joint_pos))
    assert not bench.sent
    assert bench.node.refused == 1


def test_values_that_are_not_finite_are_no_joint_states(context: SimContext) -> None:
    bench = Bench(context, ServoPolicy())
    bench.goal()
    bench.run(0.3, lambda: bench.state(np.full(7, np.nan)))
    assert not bench.sent
    assert bench.node.refused > 0


@pytest.mark.parametrize("stamp_s", [100.0, 1e6])
def test_a_clock_that_was_set_back_silences_the_node_only_until_the_last_state_is_stale(
    context: SimContext, stamp_s: float
) -> None:
    bench = Bench(context, ServoPolicy(), stale_s=0.15)
    bench.goal()
    bench.run(0.5, lambda: bench.state(ARM.default_joint_pos))
    bench.state(ARM.default_joint_pos, stamp_ns=round(stamp_s * 1e9))  # of the future: obeyed, as of another clock
    bench.run(1.0, lambda: bench.state(ARM.default_joint_pos))
    assert 13 <= bench.node.refused <= 17  # in 0.15 s, one every 10 ms
    assert [t for t, _ in bench.sent][-1] > context.now_ns - 50_000_000
    assert bench.node.stale_periods <= 1


def test_overtaken_states_are_refused_and_copies_are_not_counted(context: SimContext) -> None:
    policy = ServoPolicy()
    bench = Bench(context, policy)
    bench.goal()

    def feed() -> None:
        bench.state(ARM.default_joint_pos)
        bench.state(ARM.default_joint_pos)
        bench.state(ARM.default_joint_pos + 0.3, stamp_ns=max(1, context.now_ns - 5_000_000))

    context.run_until(100_000_000)
    bench.run(0.2, feed)
    assert bench.node.refused == 20
    np.testing.assert_allclose([row[:7] for row in policy.seen], 0.0, atol=1e-6)


def test_a_stamp_that_stands_still_is_told(context: SimContext) -> None:
    bench = Bench(context, ServoPolicy(), stale_s=0.15)
    bench.goal()
    bench.run(0.5, lambda: bench.state(ARM.default_joint_pos, stamp_ns=7))
    assert bench.node.stale_periods == 1
    assert bench.node.refused > 20


def test_goals_out_of_reach_are_refused_and_the_last_one_stays(context: SimContext) -> None:
    policy = ServoPolicy()
    bench = Bench(context, policy, hand=Kinematics(ARM))
    bench.goal(x=0.5)
    bench.run(0.2, lambda: bench.state(ARM.default_joint_pos))
    bench.goal(x=50.0)
    bench.run(0.2, lambda: bench.state(ARM.default_joint_pos))
    assert bench.node.refused == 1
    assert policy.seen[-1][14] == 0.5


def test_the_reach_bound_is_that_of_a_straight_arm() -> None:
    def hand(q: NDArray[np.float64]) -> NDArray[np.float64]:
        angle = np.cumsum(q, axis=1)
        return np.stack([np.cos(angle) @ [0.5, 0.3, 0.2], np.sin(angle) @ [0.5, 0.3, 0.2], np.zeros(len(q))], axis=1)

    free = np.array([[-np.inf, np.inf]] * 3)
    assert reach_bound(hand, free) == pytest.approx(1.05, rel=0.01)
    bent = np.array([[-3.0, 3.0], [1.0, 2.0], [0.0, 1e-9]])  # straight forearm, elbow at 1 rad at least
    expected = np.sqrt(0.5**2 + 0.5**2 + 2 * 0.5 * 0.5 * np.cos(1.0))
    assert reach_bound(hand, bent) == pytest.approx(1.05 * expected, rel=0.01)


def test_readings_far_outside_the_limits_are_refused_with_the_joints_name(
    context: SimContext, capfd: pytest.CaptureFixture[str]
) -> None:
    bench = Bench(context, ServoPolicy([6, 5, 4, 3, 2, 1, 0]))
    bench.goal()
    position = ARM.default_joint_pos.copy()
    position[3] = ARM.limits[3, 0] - 0.4
    bench.run(0.1, lambda: bench.state(position))
    assert bench.node.refused == 0
    count = bench.node.commands
    assert count > 0
    position[3] = np.rad2deg(1.6)
    bench.run(0.1, lambda: bench.state(position))
    assert bench.node.refused == 10
    assert "angle of joint4" in "".join(capfd.readouterr())


def test_the_last_action_is_observed_as_it_was_used() -> None:
    policy = ServoPolicy(goal=GOAL + 100.0)
    runner = PolicyRunner(policy, ARM.limits)
    for _ in range(2):
        runner.act(ARM.default_joint_pos[None], np.zeros((1, 7)), np.zeros((1, 3)))
    np.testing.assert_array_equal(policy.seen[1][17:], 1.0)  # not some 300


@pytest.mark.parametrize("stamped", [True, False])
def test_missing_velocities_are_differentiated(context: SimContext, stamped: bool) -> None:
    policy = ServoPolicy()
    bench = Bench(context, policy)
    bench.goal()

    def feed() -> None:
        from robotbrain.ros.conversions import ns_to_time

        msg = bench.state_type()
        msg.header.stamp, msg.name = ns_to_time(context.now_ns if stamped else 0), list(ARM.joint_names)
        msg.position = [float(v) for v in ARM.default_joint_pos + 0.5 * context.now_ns * 1e-9]
        bench.states.publish(msg)

    bench.run(0.4, feed)
    np.testing.assert_allclose(policy.seen[-1][7:14], 0.5, rtol=1e-3)


def test_targets_stay_within_limits_and_near_the_joints() -> None:
    far = ServoPolicy(goal=ARM.limits[:, 1] + 5.0, action_low=(), action_high=())
    runner = PolicyRunner(far, ARM.limits, max_step=0.2)
    position = ARM.limits[:, 1][None] - 0.1
    target = runner.act(position, np.zeros((1, 7)), np.zeros((1, 3)))
    np.testing.assert_allclose(target[0], ARM.limits[:, 1])
    runner = PolicyRunner(far, ARM.limits, max_step=0.05)
    np.testing.assert_allclose(runner.act(position, np.zeros((1, 7)), np.zeros((1, 3))), position + 0.05)


@pytest.mark.parametrize(
    "changes",
    [
        {"observation_names": (("camera", 7),)},
        {"observation_names": (("ee_pos", 3),)},  # without kinematics
        {"joint_names": (), "action_names": tuple("abcdefg")},
        {"action_kind": "joint_effort"},
    ],
)
def test_a_policy_that_does_not_fit_is_refused_before_anything_moves(changes: dict[str, Any]) -> None:
    with pytest.raises(InputError):
        PolicyRunner(ServoPolicy(**changes), ARM.limits)


def test_a_wrong_size_is_refused_with_the_terms_name() -> None:
    runner = PolicyRunner(ServoPolicy(observation_names=(("joint_pos", 5), ("actions", 7))), ARM.limits)
    with pytest.raises(InputError, match="joint_pos"):
        runner.act(np.zeros((1, 7)), np.zeros((1, 7)), None)


def test_node_and_surrogate_node_reach_what_the_policy_wants(context: SimContext) -> None:
    from rclpy.node import Node

    from robotbrain.rl.policy_node import PolicyNode
    from robotbrain.rl.surrogate.node import SurrogateArmNode

    fleet = SurrogateFleet([3], params=[neutral(7)])
    arm = SurrogateArmNode(fleet)
    node = PolicyNode(ServoPolicy([6, 5, 4, 3, 2, 1, 0]), ARM.limits[::-1])
    bench = Bench.__new__(Bench)
    bench.context = context
    hands = Node("hands")
    from geometry_msgs.msg import PoseStamped

    bench.goals, bench.pose_type = hands.create_publisher(PoseStamped, "goal_pose", 1), PoseStamped
    bench.goal()
    bench.run(2.0)
    assert node.commands > 40
    assert arm.refused == 0
    np.testing.assert_allclose(fleet.joint_pos[0], GOAL, atol=2e-3)
    assert fleet.elapsed_steps == pytest.approx(400, abs=3)


def test_the_surrogate_node_refuses_trajectories_of_other_robots(context: SimContext) -> None:
    from rclpy.node import Node
    from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

    from robotbrain.rl.policy_node import TRAJECTORY_TOPIC
    from robotbrain.rl.surrogate.node import SurrogateArmNode

    arm = SurrogateArmNode(Surrogate(1))
    publisher = Node("hands").create_publisher(JointTrajectory, TRAJECTORY_TOPIC, 10)
    names = list(ARM.joint_names)
    for joint_names, positions in (
        (names[:6], [0.0] * 6),
        (names, [0.0] * 6),
        (names, [float("nan")] * 7),
        (names, None),
    ):
        points = [] if positions is None else [JointTrajectoryPoint(positions=positions)]
        publisher.publish(JointTrajectory(joint_names=joint_names, points=points))
        context.run_until(context.now_ns + 50_000_000)
    assert arm.refused == 4


def test_batch_evaluation_measures_the_true_hand() -> None:
    env = SurrogateReachEnv([0, 1], seed=3, params=[neutral(7)] * 2)
    place = Kinematics(ARM)(GOAL[None])[0]
    policy = ServoPolicy([2, 1, 0, 3, 4, 6, 5])
    readings = env.reset(target=np.tile(place, (2, 1)), start=np.tile(ARM.default_joint_pos, (2, 1)))
    runner = env.runner(policy)
    order = joint_order(policy.meta.joint_names, ARM.joint_names)
    for _ in range(50):
        command = runner.act(readings.joint_pos[:, order], readings.joint_vel[:, order], env.target)
        readings, distance = env.step(command[:, np.argsort(order)])
    np.testing.assert_allclose(distance, 0.0, atol=3e-3)


def test_episodes_do_not_depend_on_the_fleet() -> None:
    policy = ServoPolicy()
    many = SurrogateReachEnv([7, 8], seed=1).run(policy, record=True)
    one = SurrogateReachEnv([7], seed=1).run(policy, record=True)
    np.testing.assert_array_equal(many.distance[0], one.distance[0])
    assert many.qpos is not None
    assert one.qpos is not None
    assert one.qpos.shape == (1, 50, 7)
    np.testing.assert_array_equal(many.qpos[0], one.qpos[0])


def test_an_arm_of_your_own_is_a_file_away(tmp_path: Path, context: SimContext) -> None:
    import torch

    from robotbrain.rl.export import export_policy
    from robotbrain.rl.robots import arm_mjcf
    from robotbrain.rl.surrogate.process import make_policy_node

    meta = ServoPolicy([1, 0, 2, 3, 4, 5, 6], observation_names=(("joint_pos", 7), ("ee_pos", 3))).meta
    policy = export_policy(torch.nn.Linear(10, 7), tmp_path / "p.onnx", meta)
    mine = tmp_path / "arm.xml"
    mine.write_text(arm_mjcf(), encoding="utf-8")
    node = make_policy_node(policy, mjcf=mine)
    assert node.joint_names[:2] == ("joint2", "joint1")
    mine.write_text(arm_mjcf().replace("joint3", "elbow"), encoding="utf-8")
    with pytest.raises(InputError, match="joint3"):
        make_policy_node(policy, mjcf=mine)
    with pytest.raises(InputError, match="mjcf"):
        make_policy_node(policy, mjcf=mine, site="nose")


def test_arm_and_policy_as_two_processes(tmp_path: Path) -> None:
    import torch

    from robotbrain.rl.export import export_policy
    from robotbrain.rl.surrogate.process import LinkOptions, run_policy

    meta = ServoPolicy(observation_names=(("joint_pos", 7), ("target", 3))).meta
    policy = export_policy(torch.nn.Linear(10, 7), tmp_path / "p.onnx", meta)
    replay = tmp_path / "arm.html"
    arm = subprocess.Popen(
        [sys.executable, "-m", "robotbrain.cli", "rl", "surrogate", "--serial", "7", "--port", "0", "--html", replay],
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "HOME": str(tmp_path), "USERPROFILE": str(tmp_path)},
    )
    try:
        assert arm.stdout is not None
        line = arm.stdout.readline()
        found = re.search(r"listening on [\d.]+:(\d+); token in (\S+)", line)
        assert found is not None, line
        token = Path(found[2]).read_text(encoding="utf-8").strip()
        link = LinkOptions(port=int(found[1]), token=token)
        commands = run_policy(policy, [(0.5, 0.0, 0.4)], link, seconds_per_goal=1.0, say=lambda _: None)
        assert commands > 0
    finally:
        arm.terminate()
        rest, _ = arm.communicate(timeout=60)
    if os.name != "nt":  # where terminating is a signal that can be handled
        assert "the surrogate ends" in rest
        assert replay.exists()

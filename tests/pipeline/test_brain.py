"""The whole brain in simulated time: it arrives, it repeats, it needs its eyes, and its parts can be replaced."""

from __future__ import annotations

import gc
from types import FunctionType, MethodType, ModuleType
from typing import Any

import numpy as np
import pytest

from robotbrain.errors import InputError
from robotbrain.jetson import load_profile
from robotbrain.pipeline.brain import GOAL_RADIUS, drive
from robotbrain.pipeline.nodes.mission import MissionNode
from robotbrain.pipeline.nodes.perception import PerceptionNode
from robotbrain.pipeline.nodes.planner import PlannerNode
from robotbrain.pipeline.nodes.poses import StampedPoses
from robotbrain.pipeline.nodes.sightings import thin_out
from robotbrain.ros import CallbackError, SimContext
from robotbrain.sim import RobotSim, generate_world, to_child


@pytest.mark.parametrize(("seed", "robot"), [(101, "nominal"), (102, "nominal"), (103, "surrogate")])
def test_the_reference_brain_arrives_and_touches_nothing(seed: int, robot: Any) -> None:
    run = drive(seed, robot=robot)
    assert run.success, run.reason
    assert run.goal_distance < GOAL_RADIUS and not run.collisions
    assert run.marker is not None
    # the judge's verdict agrees with the recorded path, and the brain's belief with the truth
    world = generate_world(seed)
    assert np.hypot(run.trajectory[-1, 1] - world.goal.x, run.trajectory[-1, 2] - world.goal.y) < GOAL_RADIUS
    goal = to_child(world.start, np.array([[world.goal.x, world.goal.y]]))[0]
    assert np.hypot(*(goal - run.marker)) < GOAL_RADIUS
    steps = np.linalg.norm(np.diff(run.trajectory[:, 1:3], axis=0), axis=1)
    assert steps.sum() == pytest.approx(run.path_length, rel=0.1)


def test_one_seed_gives_one_log_and_two_seeds_two() -> None:
    digests = [drive(seed, time_limit=4.0).log_sha256 for seed in (5, 5, 6)]
    assert digests[0] == digests[1] != digests[2]


def test_a_slower_jetson_answers_later_by_what_its_profile_says() -> None:
    fast, slow = load_profile("agx-orin-64gb"), load_profile("nano-4gb:5W")
    runs = [drive(5, time_limit=3.0, profile=profile) for profile in (fast, slow)]
    for run, profile in zip(runs, (fast, slow), strict=True):
        # Inference and the callback's own CPU time. The scan is due at the same time, so they may share a core; the
        # typical callback has seen more points than this one.
        alone = profile.segmentation_ms + profile.callback_ms["perception"]
        assert np.median(run.perception_ms) == pytest.approx(alone, rel=0.35)
        assert run.perception_ms.min() > profile.segmentation_ms
    assert np.median(runs[0].perception_ms) < np.median(runs[1].perception_ms)
    assert runs[0].log_sha256 != runs[1].log_sha256


def blind(seed: int) -> type[PerceptionNode]:
    class Blind(PerceptionNode):
        """Sees noise where the network would have answered."""

        rng = np.random.default_rng(seed)

        def segment(self, image: np.ndarray) -> np.ndarray:
            return self.rng.integers(0, 4, image.shape[:2]).astype(np.uint8)

    return Blind


def test_without_the_network_the_goal_is_not_found() -> None:
    sim = RobotSim(generate_world(0))
    mount = sim.camera.extrinsics

    def successes(seed: int) -> bool:
        from robotbrain.jetson import OnnxEngine
        from robotbrain.pipeline.brain import default_model

        def make() -> PerceptionNode:
            return blind(seed)(OnnxEngine(default_model()), (mount.x, mount.y, mount.z, mount.pitch))

        return drive(seed, parts={"perception": make}).success

    assert sum(successes(seed) for seed in (101, 102, 103)) == 0


def reachable(root: Any) -> set[int]:
    """Ids of every object that can be reached from ``root`` without passing through ROS or a module."""
    seen: set[int] = set()
    todo = [root]
    while todo:
        thing = todo.pop()
        if id(thing) in seen or isinstance(thing, ModuleType | SimContext | type):
            continue
        seen.add(id(thing))
        if isinstance(thing, FunctionType):
            todo += [c.cell_contents for c in thing.__closure__ or ()]
        elif isinstance(thing, MethodType):
            todo += [thing.__self__, thing.__func__]
        elif type(thing).__module__.startswith("robotbrain.ros") and not hasattr(thing, "get_name"):
            continue
        else:
            todo += gc.get_referents(thing)
    return seen


def test_no_node_can_reach_the_truth() -> None:
    from robotbrain.pipeline.brain import make_parts
    from robotbrain.pipeline.nodes.robot import RobotNode

    sim = RobotSim(generate_world(1))
    context = SimContext()
    with context.as_default():
        robot = RobotNode(sim)
        assert id(sim) in reachable(vars(robot))  # the search finds it where it is
        for role, make in make_parts(load_profile("nano-4gb"), sim).items():
            node = make()
            own = {k: v for k, v in vars(node).items() if "context" not in k and "executor" not in k}
            found = reachable(own)
            assert id(sim) not in found and id(sim.truth) not in found, role
            assert id(sim.world) not in found, role


def test_a_students_node_takes_the_place_of_ours_and_its_errors_name_it() -> None:
    class Broken(PlannerNode):
        def _plan(self, request: Any, response: Any) -> Any:
            raise ZeroDivisionError("student's mistake")

    with pytest.raises(CallbackError, match="/planner") as caught:
        drive(5, parts={"planner": Broken}, time_limit=10.0)
    assert isinstance(caught.value.cause, ZeroDivisionError)


def test_a_brain_that_stays_put_runs_out_of_time_and_one_that_boasts_is_not_believed() -> None:
    class Lazy(MissionNode):
        def _decide(self) -> None:
            pass

    class Boaster(MissionNode):
        def _decide(self) -> None:
            self._finish()

    assert "did not arrive" in drive(5, parts={"mission": Lazy}, time_limit=2.0).reason
    run = drive(5, parts={"mission": Boaster}, time_limit=5.0)
    assert not run.success and "from the goal" in run.reason


def test_saying_not_yet_is_not_saying_arrived() -> None:
    from std_msgs.msg import Bool

    class NotYet(MissionNode):
        def _decide(self) -> None:
            self._reached_pub.publish(Bool(data=False))

    assert "did not arrive" in drive(5, parts={"mission": NotYet}, time_limit=2.0).reason


def odometry(stamp_ns: int, x: float, yaw: float) -> Any:
    from nav_msgs.msg import Odometry

    from robotbrain.ros.conversions import ns_to_time, pose_2d

    msg = Odometry()
    msg.header.stamp = ns_to_time(stamp_ns)
    msg.pose.pose = pose_2d(x, 0.0, yaw)
    return msg


def test_a_late_message_meets_the_pose_of_its_own_moment() -> None:
    poses = StampedPoses()
    seen: list[tuple[int, Any]] = []
    for stamp in (-50, 250, 150, 900):
        poses.when_known(stamp, lambda pose, stamp=stamp: seen.append((stamp, pose)))
    assert seen == []
    for k in range(5):
        poses.on_odometry(odometry(100 * k, float(k), 0.0))
    # one from before the first pose is dropped, one from the future still waits
    assert [(stamp, pose[0]) for stamp, pose in sorted(seen)] == [(150, pytest.approx(1.5)), (250, pytest.approx(2.5))]
    poses.when_known(350, lambda pose: seen.append((350, pose)))
    assert seen[-1][1][0] == pytest.approx(3.5)  # known at once, and not the newest


def test_a_pose_that_is_no_number_is_named_with_its_topic() -> None:
    with pytest.raises(InputError, match="odometry/filtered"):
        StampedPoses().on_odometry(odometry(0, float("nan"), 0.0))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"parts": {"pilot": PlannerNode}}, "pilot"),
        ({"parts": {"planner": 3}}, "class that makes a node"),
        ({"robot": "real"}, "surrogate"),
        ({"profile": "orin"}, "Jetson module"),
        ({"model": "nowhere.onnx"}, "ONNX"),
    ],
)
def test_bad_arguments_are_explained(arguments: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError, match=words):
        drive(1, time_limit=0.5, **arguments)


def test_a_replay_can_be_made_of_any_run() -> None:
    run = drive(5, time_limit=3.0)
    page = run.replay().static_html()
    assert page.startswith("<!") and len(page) > 500_000


def test_thinning_keeps_every_occupied_square_once() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(-2, 2, (5000, 2))
    thin = thin_out(points, 0.1)
    squares = {(int(a), int(b)) for a, b in np.floor(points / 0.1)}
    assert len(thin) == len(squares)
    assert np.abs(points[:, None] - thin[None]).max(axis=2).min(axis=1).max() <= 0.05 + 1e-9


def test_ages_are_right_when_messages_come_late() -> None:
    from robotbrain.monitoring import end_to_end_ms
    from robotbrain.monitoring.faults import LateFrames

    for late_ms in (0.0, 150.0):
        fault = LateFrames("/perception/points", late_ms)
        run = drive(3, difficulty=0.2, time_limit=4, trace=True, attach=[fault.install])
        assert run.trace is not None
        assert np.median(run.e2e_ms) == pytest.approx(np.nanmedian(end_to_end_ms(run.trace)), abs=1e-6)
        assert np.median(run.camera_age_ms) > late_ms


@pytest.mark.parametrize(("encoding", "flipped"), [("rgb8", False), ("bgr8", True)])
def test_colours_are_read_in_the_order_that_the_message_says(encoding: str, flipped: bool) -> None:
    from robotbrain.pipeline.nodes.perception import rgb_of
    from robotbrain.ros.conversions import ns_to_time, numpy_to_image

    image = np.arange(2 * 3 * 3, dtype=np.uint8).reshape(2, 3, 3)
    msg = numpy_to_image(image, encoding, stamp=ns_to_time(0), frame_id="camera")
    assert np.array_equal(rgb_of(msg), image[..., ::-1] if flipped else image)


def test_an_image_without_colours_is_refused() -> None:
    from robotbrain.errors import InputError
    from robotbrain.pipeline.nodes.perception import rgb_of
    from robotbrain.ros.conversions import ns_to_time, numpy_to_image

    msg = numpy_to_image(np.zeros((2, 3), np.uint8), "mono8", stamp=ns_to_time(0), frame_id="camera")
    with pytest.raises(InputError, match="mono8"):
        rgb_of(msg)

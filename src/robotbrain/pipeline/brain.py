"""The whole brain on a robot in a world: wire the nodes, drive, and let a judge say how it went."""

from __future__ import annotations

import operator
import struct
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from robotbrain.errors import InputError
from robotbrain.jetson.profiles import JetsonProfile, load_profile

if TYPE_CHECKING:
    from rclpy.node import Node

    from robotbrain.ros.context import CallbackRecord
    from robotbrain.sim import RobotSim, World
    from robotbrain.sim.view import Replay

ROLES = ("perception", "estimator", "mapper", "planner", "mission", "controller")
"""The nodes of a brain. Each can be replaced through ``parts``."""

GOAL_RADIUS = 0.35
"""The robot has reached the goal when its centre is this close to the marker's centre, m (the mat's radius)."""

TIME_LIMIT = 120.0
"""A run that has not ended by then has failed, s."""

RobotKind = Literal["nominal", "surrogate"]
Parts = Mapping[str, Callable[[], Any]]
"""Replacements by role: a function (or class) without arguments that returns a node."""


def default_model() -> Path:
    """Return the path of the shipped segmentation network."""
    return Path(__file__).parent / "weights" / "segmentation.onnx"


@dataclass(frozen=True)
class RunResult:
    """How a run went, as the judge saw it.

    Attributes:
        seed: of the world.
        robot: ``nominal`` or ``surrogate``.
        profile: slug of the Jetson profile.
        success: the brain said it had arrived, stood on the mat, and had touched nothing.
        reason: why the run ended, in words.
        seconds: simulated time.
        path_length: m.
        goal_distance: from the robot's centre to the marker's centre at the end, m.
        collisions: names of what was touched.
        log_sha256: digest of every message published, in order.
        perception_ms: from taking an image to publishing its segmentation, for each image, ms.
        planning_ms: of each answered plan request, from its arrival to its answer, ms.
        trajectory: (T, 4) true time s, x m, y m, yaw rad, ten a second.
        plans: (time s, (N, 2) points in the map frame) of every path handed to the controller.
        marker: the goal position that the brain believed in at the end, in the map frame; None if it never had one.
        box_poses: (T, boxes, 3) x, y, yaw of the movable boxes at the times of ``trajectory``.
        wall_seconds: real time the run took, without setting up.
        world: where it happened.
    """

    seed: int
    robot: RobotKind
    profile: str
    success: bool
    reason: str
    seconds: float
    path_length: float
    goal_distance: float
    collisions: tuple[str, ...]
    log_sha256: str
    perception_ms: NDArray[np.float64] = field(repr=False)
    planning_ms: NDArray[np.float64] = field(repr=False)
    trajectory: NDArray[np.float64] = field(repr=False)
    plans: tuple[tuple[float, NDArray[np.float64]], ...] = field(repr=False)
    marker: tuple[float, float] | None
    box_poses: NDArray[np.float64] = field(repr=False)
    wall_seconds: float
    world: World = field(repr=False)

    @property
    def real_time_factor(self) -> float:
        """Simulated seconds per real second."""
        return self.seconds / self.wall_seconds

    def replay(self) -> Replay:
        """Return the run as a replay to watch in 3D: ``run.replay().show()`` in a notebook."""
        from robotbrain.sim import Pose2D, to_parent
        from robotbrain.sim.view import Replay

        replay = Replay(self.world)
        for (t, x, y, yaw), boxes in zip(self.trajectory, self.box_poses, strict=True):
            poses = tuple(Pose2D(*(float(v) for v in box)) for box in boxes)
            replay.add_state(float(t), Pose2D(float(x), float(y), float(yaw)), poses)
        for t, points in self.plans:
            if len(points) > 1:
                replay.add_plan(t, to_parent(self.world.start, points))
        return replay


class ProfileCosts:
    """Simulated CPU time of the brain's callbacks on a Jetson profile (a cost model for ``robotbrain.ros``).

    Costs go by a node's role, whatever it is called: by topic for subscriptions, one price for a role's timers and
    one for the plan service. The inference itself and the reference planner's search charge their own time on top.
    """

    _TOPICS: Mapping[tuple[str, str], str] = {
        ("perception", "/camera/image"): "perception",
        ("estimator", "/scan"): "estimator_scan",
        ("estimator", "/joint_states"): "estimator_wheels",
        ("mapper", "/scan"): "mapper",
        ("mapper", "/perception/points"): "mapper",
    }
    _TIMERS = ("mission", "controller")

    def __init__(self, profile: JetsonProfile) -> None:
        self._topics = {key: profile.callback_ns(name) for key, name in self._TOPICS.items()}
        self._timers = {role: profile.callback_ns(role) for role in self._TIMERS}
        self._plan = profile.planning_ns(0)
        self._roles: dict[str, str] = {}

    def assign(self, node_name: str, role: str) -> None:
        """Say which role the node of this fully qualified name plays."""
        self._roles[node_name] = role

    def cost(self, node_name: str, kind: str, name: str) -> int:
        """Return the cost of one callback in ns; 0 for callbacks that only store a message."""
        role = self._roles.get(node_name, "")
        if kind == "service":
            return self._plan if role == "planner" else 0
        if kind == "timer":
            return self._timers.get(role, 0)
        return self._topics.get((role, name), 0)


def make_parts(
    profile: JetsonProfile, sim: RobotSim, model: str | Path | None = None, overrides: Parts | None = None
) -> dict[str, Callable[[], Node]]:
    """Return a factory for each role, the kit's own unless overridden.

    Raises:
        InputError: for a role that does not exist.
    """
    from robotbrain.jetson.engine import OnnxEngine
    from robotbrain.pipeline.nodes.controller import ControllerNode
    from robotbrain.pipeline.nodes.estimator import EstimatorNode
    from robotbrain.pipeline.nodes.mapper import MapperNode
    from robotbrain.pipeline.nodes.mission import MissionNode
    from robotbrain.pipeline.nodes.perception import PerceptionNode
    from robotbrain.pipeline.nodes.planner import PlannerNode

    mounting = sim.camera.extrinsics

    def planning_ns(expanded: int) -> int:
        return profile.planning_ns(expanded) - profile.planning_ns(0)

    parts: dict[str, Callable[[], Any]] = {
        "perception": lambda: PerceptionNode(
            OnnxEngine(model or default_model(), profile), (mounting.x, mounting.y, mounting.z, mounting.pitch)
        ),
        "estimator": lambda: EstimatorNode(sim.robot.wheel_radius, sim.robot.track),
        "mapper": MapperNode,
        "planner": lambda: PlannerNode(planning_ns=planning_ns),
        "mission": MissionNode,
        "controller": ControllerNode,
    }
    for role, factory in (overrides or {}).items():
        if role not in parts:
            raise InputError("part", given=role, expected="one of " + ", ".join(ROLES), fix="Replace one of these.")
        if not callable(factory):
            raise InputError(
                f"part {role!r}",
                given=factory,
                expected="a function or class that makes a node",
                fix="Pass the class itself, not an instance: the node is made inside the run.",
            )
        parts[role] = factory
    return parts


def drive(
    seed: int | World,
    *,
    difficulty: float = 0.5,
    robot: RobotKind = "nominal",
    profile: str | JetsonProfile = "orin-nano-8gb",
    parts: Parts | None = None,
    model: str | Path | None = None,
    time_limit: float = TIME_LIMIT,
    surrogate_seed: int = 0,
) -> RunResult:
    """Let a brain look for the marker and drive to it, in simulated time.

    Args:
        seed: of the world, or a world.
        difficulty: of the world, 0 to 1.
        robot: the nominal robot, or the surrogate (a stand-in for a physical one: the same robot with other friction,
            mass, motor lag, backlash, sensor errors and delays).
        profile: the Jetson that the brain runs on; a slug or a profile.
        parts: nodes of your own by role, see ROLES.
        model: ONNX file of the segmentation network; the shipped one by default.
        time_limit: s.
        surrogate_seed: which surrogate.

    Raises:
        InputError: for unknown roles, robots or profiles.
        robotbrain.ros.exceptions.CallbackError: if a node's callback raises; its cause is the node's own error.
    """
    from robotbrain.ros import SimContext
    from robotbrain.ros.record import DecisionLog
    from robotbrain.sim import RobotSim, World, generate_world

    if robot not in ("nominal", "surrogate"):
        raise InputError("robot", given=robot, expected="'nominal' or 'surrogate'", fix="Choose one of the two.")
    chosen = load_profile(profile) if isinstance(profile, str) else profile
    world = seed if isinstance(seed, World) else generate_world(operator.index(seed), difficulty)
    noise_seed = world.spec.seed
    if robot == "surrogate":
        from robotbrain.sim.surrogate import surrogate_robot

        body, sensors = surrogate_robot(surrogate_seed)
        sim = RobotSim(world, body, sensors, seed=noise_seed)
    else:
        sim = RobotSim(world, seed=noise_seed)
    costs = ProfileCosts(chosen)
    context = SimContext(cost_model=costs)
    log = DecisionLog(context)
    watch = _Watch(context)
    with context.as_default():
        from robotbrain.pipeline.nodes.robot import RobotNode

        RobotNode(sim)
        for role, make in make_parts(chosen, sim, model, parts).items():
            before = set(context.nodes)
            make()
            for node in set(context.nodes) - before:
                costs.assign(node.get_fully_qualified_name(), role)
        began = time.perf_counter()
        try:
            reason, success = _run(context, sim, watch, time_limit)
        finally:
            context.try_shutdown()
        wall_seconds = time.perf_counter() - began
    return RunResult(
        seed=world.spec.seed,
        robot=robot,
        profile=chosen.slug,
        success=success,
        reason=reason,
        seconds=context.now_ns * 1e-9,
        path_length=sim.truth.path_length,
        goal_distance=sim.truth.distance_to_goal,
        collisions=tuple(sorted(sim.truth.collided)),
        log_sha256=log.sha256(),
        perception_ms=np.array(watch.perception_ms),
        planning_ms=np.array(watch.planning_ms),
        trajectory=np.array(watch.trajectory).reshape(-1, 4),
        plans=tuple(watch.plans),
        marker=watch.marker,
        box_poses=np.array(watch.boxes),
        wall_seconds=wall_seconds,
        world=world,
    )


def _run(context: Any, sim: RobotSim, watch: _Watch, time_limit: float) -> tuple[str, bool]:
    step_ns = 100_000_000
    while context.now_ns < time_limit * 1e9:
        context.run_until(context.now_ns + step_ns)
        sim.advance_to(context.now_ns)
        watch.sample(sim, context.now_ns * 1e-9)
        if sim.truth.collided:
            return "touched " + ", ".join(sorted(sim.truth.collided)), False
        if watch.reached:
            # Let it come to rest before judging where it stands.
            context.run_for(1.0)
            sim.advance_to(context.now_ns)
            watch.sample(sim, context.now_ns * 1e-9)
            distance = sim.truth.distance_to_goal
            if sim.truth.collided:
                return "touched " + ", ".join(sorted(sim.truth.collided)), False
            if distance > GOAL_RADIUS:
                return f"said it had arrived, {distance:.2f} m from the goal", False
            if abs(sim.truth.twist.v) > 0.05 or abs(sim.truth.twist.w) > 0.2:
                return "said it had arrived, but kept moving", False
            return "reached the goal", True
    return f"did not arrive within {time_limit:g} s", False


class _Watch:
    """Collects what a report needs from the messages that pass, and the truth for the judge."""

    def __init__(self, context: Any) -> None:
        self.perception_ms: list[float] = []
        self.planning_ms: list[float] = []
        self.plans: list[tuple[float, NDArray[np.float64]]] = []
        self.trajectory: list[tuple[float, float, float, float]] = []
        self.boxes: list[list[tuple[float, float, float]]] = []
        self.marker: tuple[float, float] | None = None
        self.reached = False
        context.add_tap(self._on_message)
        context.add_callback_tap(self._on_callback)

    def sample(self, sim: RobotSim, now: float) -> None:
        pose = sim.truth.pose
        self.trajectory.append((now, pose.x, pose.y, pose.yaw))
        self.boxes.append([(p.x, p.y, p.yaw) for p in sim.truth.obstacle_poses()])

    def _on_message(self, time_ns: int, topic: str, type_name: str, _node: str, cdr: bytes) -> None:
        if topic == "/perception/segmentation":
            # CDR starts with four bytes of encapsulation, then the header's stamp.
            seconds, nanoseconds = struct.unpack_from("<iI", cdr, 4)
            self.perception_ms.append((time_ns - seconds * 1_000_000_000 - nanoseconds) * 1e-6)
        elif topic in ("/plan", "/goal_pose", "/goal_reached"):
            from rclpy.serialization import deserialize_message

            from robotbrain.ros.conversions import msg_class

            message: Any = deserialize_message(cdr, msg_class(type_name))
            if topic == "/plan":
                points = np.array([(p.pose.position.x, p.pose.position.y) for p in message.poses]).reshape(-1, 2)
                self.plans.append((time_ns * 1e-9, points))
            elif topic == "/goal_reached":
                self.reached |= bool(message.data)
            else:
                self.marker = (message.pose.position.x, message.pose.position.y)

    def _on_callback(self, record: CallbackRecord) -> None:
        if record.kind == "service" and record.name == "/plan":
            self.planning_ms.append((record.end_ns - record.ready_ns) * 1e-6)

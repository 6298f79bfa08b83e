"""The whole brain on a robot in a world: wire the nodes, drive, and let a judge say how it went."""

from __future__ import annotations

import operator
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from robotbrain.errors import InputError
from robotbrain.jetson.profiles import JetsonProfile, default_network, load_profile
from robotbrain.pipeline.costs import ProfileCosts
from robotbrain.pipeline.deployment import Deployment
from robotbrain.pipeline.watch import Watch
from robotbrain.progress import bar

if TYPE_CHECKING:
    from rclpy.node import Node

    from robotbrain.monitoring.trace import Trace
    from robotbrain.ros import SimContext
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
    return default_network()


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
        power_mode: of that Jetson.
        control_hz: commands published per second, from the first to the last.
        camera_age_ms, scan_age_ms: of each command, once there is such an input: how long before the command's release
            the newest input that it was built on was taken, ms. For the camera: the newest image whose obstacle points
            the controller had; for the scan: the newest scan matched into the pose that the controller had. Both hold
            the sensor's period as well as the latency (a saw-tooth from the latency up to the latency plus a period).
        busy: share of its capacity that each resource of the Jetson was busy, 0 to 1.
        deadline_misses: callbacks by name (``controller``, ``perception``, ``estimator_scan``, ``estimator_wheels``)
            that ended later than one period of their timer or sensor after they were due, or were dropped before that.
        perception_ms: from taking an image to publishing its segmentation, for each image, ms.
        planning_ms: of each answered plan request, from its arrival to its answer, ms.
        trajectory: (T, 4) true time s, x m, y m, yaw rad, ten a second.
        plans: (time s, (N, 2) points in the map frame) of every path handed to the controller.
        marker: the goal position that the brain believed in at the end, in the map frame; None if it never had one.
        box_poses: (T, boxes, 3) x, y, yaw of the movable boxes at the times of ``trajectory``.
        wall_seconds: real time the run took, without setting up.
        world: where it happened.
        trace: every callback and message, if the run was traced.
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
    power_mode: str
    control_hz: float
    camera_age_ms: NDArray[np.float64] = field(repr=False)
    scan_age_ms: NDArray[np.float64] = field(repr=False)
    busy: Mapping[str, float]
    deadline_misses: Mapping[str, int]
    perception_ms: NDArray[np.float64] = field(repr=False)
    planning_ms: NDArray[np.float64] = field(repr=False)
    trajectory: NDArray[np.float64] = field(repr=False)
    plans: tuple[tuple[float, NDArray[np.float64]], ...] = field(repr=False)
    marker: tuple[float, float] | None
    box_poses: NDArray[np.float64] = field(repr=False)
    wall_seconds: float
    world: World = field(repr=False)
    trace: Trace | None = field(default=None, repr=False)

    @property
    def real_time_factor(self) -> float:
        """Simulated seconds per real second."""
        return self.seconds / self.wall_seconds

    @property
    def e2e_ms(self) -> NDArray[np.float64]:
        """End-to-end latency of each command, sensor to actuator: the age of the older of its two inputs, ms."""
        return np.maximum(self.camera_age_ms, self.scan_age_ms)

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


def make_parts(
    profile: JetsonProfile,
    sim: RobotSim,
    model: str | Path | None = None,
    overrides: Parts | None = None,
    deployment: Deployment | None = None,
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

    deployed = deployment or Deployment()
    mount = sim.camera.extrinsics
    mounting = (mount.x, mount.y, mount.z, mount.pitch)
    parts: dict[str, Callable[[], Any]] = {
        "perception": lambda: PerceptionNode(
            OnnxEngine(model or default_model(), profile, deployed.image_size, deployed.network, deployed.precision),
            mounting,
            deployed.camera_queue,
        ),
        "estimator": lambda: EstimatorNode(sim.robot.wheel_radius, sim.robot.track),
        "mapper": MapperNode,
        "planner": PlannerNode,
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
    mode: str | int | None = None,
    deployment: Deployment | None = None,
    parts: Parts | None = None,
    model: str | Path | None = None,
    time_limit: float = TIME_LIMIT,
    surrogate_seed: int = 0,
    trace: bool = False,
    attach: Sequence[Callable[[SimContext], object]] = (),
) -> RunResult:
    """Let a brain look for the marker and drive to it, in simulated time.

    Args:
        seed: of the world, or a world.
        difficulty: of the world, 0 to 1.
        robot: the nominal robot, or the surrogate (a stand-in for a physical one: the same robot with other friction,
            mass, motor lag, backlash, sensor errors and delays).
        profile: the Jetson that the brain runs on; a slug such as ``nano-4gb`` or ``nano-4gb:5W``, or a profile.
        mode: its power mode; None for its default, or that of the profile.
        deployment: which sensors are charged for, and how nodes share threads; see Deployment.
        parts: nodes of your own by role, see ROLES.
        model: ONNX file of the segmentation network; the shipped one by default.
        time_limit: s.
        surrogate_seed: which surrogate.
        trace: record every callback and message (some 15 MB a simulated minute).
        attach: functions that are given the simulation before any node is made: monitors, faults.

    Raises:
        InputError: for unknown roles, robots, profiles or power modes.
        robotbrain.ros.exceptions.CallbackError: if a node's callback raises; its cause is the node's own error.
    """
    from robotbrain.ros import DeviceResources, SimContext
    from robotbrain.ros.executors import SingleThreadedExecutor
    from robotbrain.ros.record import DecisionLog
    from robotbrain.sim import RobotSim, World, generate_world

    if robot not in ("nominal", "surrogate"):
        raise InputError("robot", given=robot, expected="'nominal' or 'surrogate'", fix="Choose one of the two.")
    chosen = _chosen_profile(profile, mode)
    world = seed if isinstance(seed, World) else generate_world(operator.index(seed), difficulty)
    noise_seed = world.spec.seed
    if robot == "surrogate":
        from robotbrain.sim.surrogate import surrogate_robot

        body, sensors = surrogate_robot(surrogate_seed)
        sim = RobotSim(world, body, sensors, seed=noise_seed)
    else:
        sim = RobotSim(world, seed=noise_seed)
    deployed = deployment or Deployment()
    camera = sim.camera.intrinsics
    costs = ProfileCosts(chosen, deployed.scales(camera.width * camera.height, sim.lidar.spec.rays))
    device = DeviceResources(cpu_cores=chosen.cpu_cores, gpu=1, dla=chosen.dla)
    context = SimContext(cost_model=costs, resources=device)
    log = DecisionLog(context)
    watch = Watch(context, costs)
    recorder = None
    if trace:
        from robotbrain.monitoring.trace import Recorder

        recorder = Recorder(context, title=f"world {world.spec.seed} on {chosen.slug} in {chosen.power_mode}")
    for function in attach:
        function(context)
    with context.as_default():
        from robotbrain.pipeline.nodes.robot import RobotNode

        RobotNode(sim)
        if deployed.one_thread:
            shared = SingleThreadedExecutor(context=context)
            context.default_executor_factory = lambda node: shared
        for role, make in make_parts(chosen, sim, model, parts, deployed).items():
            before = set(context.nodes)
            make()
            for node in set(context.nodes) - before:
                costs.assign(node.get_fully_qualified_name(), role, foreign=role in (parts or {}))
        began = time.perf_counter()
        try:
            with bar(f"driving in world {world.spec.seed}", time_limit, "s at most") as progress:
                reason, success = _run(context, sim, watch, time_limit, progress)
        finally:
            context.try_shutdown()
        wall_seconds = time.perf_counter() - began
        watch.finish(context)
        recording = None if recorder is None else recorder.trace(roles=costs.roles)
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
        power_mode=chosen.power_mode,
        control_hz=watch.control_hz,
        camera_age_ms=np.array(watch.camera_age_ms),
        scan_age_ms=np.array(watch.scan_age_ms),
        busy=device.utilisation(),
        deadline_misses=dict(watch.deadline_misses),
        perception_ms=np.array(watch.perception_ms),
        planning_ms=np.array(watch.planning_ms),
        trajectory=np.array(watch.trajectory).reshape(-1, 4),
        plans=tuple(watch.plans),
        marker=watch.marker,
        box_poses=np.array(watch.boxes),
        wall_seconds=wall_seconds,
        world=world,
        trace=recording,
    )


def _chosen_profile(profile: str | JetsonProfile, mode: str | int | None) -> JetsonProfile:
    if isinstance(profile, str):
        return load_profile(profile, mode)
    if mode is not None and load_profile(profile.slug, mode).power_mode != profile.power_mode:
        raise InputError(
            "mode",
            given=f"{mode!r} beside a profile in mode {profile.power_mode!r}",
            expected="one power mode",
            fix="Load the profile in that mode: load_profile(slug, mode).",
        )
    return profile


def _run(context: Any, sim: RobotSim, watch: Watch, time_limit: float, progress: Any) -> tuple[str, bool]:
    step_ns = 100_000_000
    while context.now_ns < time_limit * 1e9:
        context.run_until(context.now_ns + step_ns)
        sim.advance_to(context.now_ns)
        progress.update(step_ns * 1e-9)
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

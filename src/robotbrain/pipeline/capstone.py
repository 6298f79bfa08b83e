"""The capstone's brain: a student's network, planner, policy and supervisor, wired by a launch configuration.

What is given and the same for everybody stands in ``BRIEF``; what a student decides about the wiring in a
:class:`Launch`. :func:`drive_brain` lets the whole of it drive.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from robotbrain.errors import InputError
from robotbrain.jetson.kernels import PRECISIONS
from robotbrain.pipeline.brain import ROLES, RobotKind, RunResult, drive
from robotbrain.pipeline.deployment import Deployment

if TYPE_CHECKING:
    from robotbrain.ros import SimContext
    from robotbrain.sim import World


@dataclass(frozen=True)
class Brief:
    """The mission as the customer states it.

    Attributes:
        module: the Jetson on the robot and the power mode that its battery allows, ``slug:mode``.
        image_size: (width, height) of the camera that is charged for.
        network_ms, network_mb: latency at that image size and memory, at most.
        end_to_end_ms: 95th percentile of the age of what a command was built on, at most.
        missed: share of control steps, images, scans or wheel readings that may miss their deadline, at most.
        seconds: to the marker, at most.
        replan_s: age of a path, at most.
    """

    module: str = "orin-nano-8gb:7W"
    image_size: tuple[int, int] = (640, 480)
    network_ms: float = 3.2
    network_mb: float = 365.0
    end_to_end_ms: float = 150.0
    missed: float = 0.01
    seconds: float = 45.0
    replan_s: float = 2.0


BRIEF = Brief()
"""One brief for everybody: with the same module, budget and kind of world, the capstone is equally hard for all."""

DIFFICULTY = 0.3
"""Of the worlds, practised in and judged in."""


@dataclass(frozen=True)
class Launch:
    """Which node runs where, and how.

    Attributes:
        executors: groups of roles; each group shares one single-threaded executor, that is a process of its own under
            one ``rclpy.spin``: its callbacks wait for each other. Every role stands in exactly one group.
        precision: that the network is built in, ``fp32``, ``fp16`` or ``int8``.
        camera_queue: images that may wait for perception; None: as many as come.
        replan_after: how old a path may grow before the mission asks for another, s.
    """

    executors: tuple[tuple[str, ...], ...]
    precision: str = "fp16"
    camera_queue: int | None = 1
    replan_after: float = 1.5

    def __post_init__(self) -> None:
        groups = self.executors
        lists = (tuple, list)
        if not isinstance(groups, lists) or not all(isinstance(group, lists) for group in groups):
            raise _error("executors", groups, "a tuple of tuples of roles", 'For example (("perception",), (...)).')
        object.__setattr__(self, "executors", tuple(tuple(str(role) for role in group) for group in groups))
        if sorted(role for group in self.executors for role in group) != sorted(ROLES):
            raise _error("executors", groups, f"each of {', '.join(ROLES)} exactly once", "Add or remove roles.")
        if self.precision not in PRECISIONS:
            raise _error("precision", self.precision, "one of " + ", ".join(PRECISIONS), "Choose one of these.")
        Deployment(camera_queue=self.camera_queue)  # checks it
        age = self.replan_after
        if isinstance(age, bool) or not isinstance(age, (int, float)) or not 0 < age < float("inf"):
            raise _error("replan_after", age, "seconds > 0", "For example 1.5.")

    def install(self, context: SimContext) -> None:
        """Give the nodes that are made in a context from now on their executors."""
        from robotbrain.ros.executors import Executor, SingleThreadedExecutor

        shared = [(group, SingleThreadedExecutor(context=context)) for group in self.executors]

        def executor_of(node: Any) -> Executor:
            for group, executor in shared:
                if node.get_name() in group:
                    return executor
            return SingleThreadedExecutor(context=context)  # the robot's drivers are no part of the brain

        context.default_executor_factory = executor_of


def _error(what: str, given: object, expected: str, fix: str) -> InputError:
    return InputError(f"launch.{what}", given=given, expected=expected, fix=fix)


@dataclass(frozen=True)
class BrainParts:
    """A student's parts.

    Attributes:
        network: ONNX file of the segmentation network; None: the kit's.
        policy: ONNX file of the navigation policy; None: the kit's.
        planner: makes the planner node: a class, or a function without arguments.
        observe: makes the policy's input; see :mod:`robotbrain.pipeline.nodes.supervised_controller`.
        supervisor: makes what decides, with a method ``decide(health)``.
    """

    network: str | Path | None
    policy: str | Path | None
    planner: Callable[[], Any]
    observe: Callable[..., Any]
    supervisor: Callable[[], Any]


@dataclass(frozen=True)
class BrainRun:
    """How a brain drove.

    Attributes:
        run: as the judge of :func:`robotbrain.pipeline.brain.drive` saw it.
        modes: (time s, mode) of every change of the supervisor's mind.
    """

    run: RunResult
    modes: tuple[tuple[float, str], ...]

    @property
    def missed(self) -> float:
        """The largest share of deadlines missed, among control steps, images, scans and wheel readings."""
        run = self.run
        due = {"controller": run.control_hz, "perception": 10.0, "estimator_scan": 10.0, "estimator_wheels": 50.0}
        return max(run.deadline_misses[name] / max(1.0, rate * run.seconds) for name, rate in due.items())


def starter_planner() -> Any:
    """Return the kit's planner node, for those who bring none from the lab."""
    from robotbrain.pipeline.nodes.planner import PlannerNode

    return PlannerNode()


def drive_brain(
    seed: int | World,
    parts: BrainParts,
    launch: Launch,
    *,
    brief: Brief = BRIEF,
    robot: RobotKind = "nominal",
    surrogate_seed: int = 0,
    policy_fails_at: float = float("inf"),
    attach: Sequence[Callable[[SimContext], object]] = (),
    trace: bool = False,
) -> BrainRun:
    """Let a whole brain drive in a world, in simulated time on the brief's Jetson.

    Args:
        seed: of the world, or a world.
        parts: network, planner, policy, glue and supervisor.
        launch: how they are wired.
        brief: the mission.
        robot: ``nominal`` or ``surrogate``.
        surrogate_seed: which surrogate.
        policy_fails_at: from this time on the policy answers NaN, s.
        attach: functions that are given the simulation before any node is made, faults for instance.
        trace: record every callback and message.
    """
    from robotbrain.jetson.engine import OnnxEngine
    from robotbrain.jetson.profiles import load_profile
    from robotbrain.rl.onnx_policy import OnnxPolicy
    from robotbrain.rl.tasks.navigation_spec import default_policy

    profile = load_profile(brief.module)
    policy = OnnxPolicy(default_policy() if parts.policy is None else parts.policy)
    latency_ns = OnnxEngine(policy.path, profile).latency_ns
    made: list[Any] = []

    def controller() -> Any:
        from robotbrain.pipeline.nodes.supervised_controller import SupervisedControllerNode

        decide = parts.supervisor().decide
        made.append(SupervisedControllerNode(policy, parts.observe, decide, latency_ns, policy_fails_at))
        return made[0]

    def mission() -> Any:
        from robotbrain.pipeline.nodes.mission import MissionNode

        return MissionNode(launch.replan_after)

    run = drive(
        seed,
        difficulty=DIFFICULTY,
        robot=robot,
        profile=profile,
        deployment=Deployment(
            image_size=brief.image_size, precision=launch.precision, camera_queue=launch.camera_queue
        ),
        parts={"planner": parts.planner, "mission": mission, "controller": controller},
        model=parts.network,
        time_limit=brief.seconds,
        surrogate_seed=surrogate_seed,
        trace=trace,
        attach=[launch.install, *attach],
    )
    return BrainRun(run, tuple(made[0].modes))

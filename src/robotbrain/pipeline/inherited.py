"""A brain that "works in the lab, on the workstation", and not on its Jetson: the patient of homework 3.

Nothing in it is wrong in itself. Its camera delivers the largest images that it has, its network computes in the
precision that it was trained in, no image is ever thrown away, its nodes share one thread, and four times a second it
plans anew on the whole map. On a workstation none of that shows.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from robotbrain.errors import InputError
from robotbrain.pipeline.brain import RobotKind, RunResult, drive
from robotbrain.pipeline.deployment import Deployment
from robotbrain.pipeline.devices import detector_deployment

if TYPE_CHECKING:
    from robotbrain.ros import SimContext
    from robotbrain.sim import World

MODULE = "orin-nano-8gb:15W"
"""The module on this robot, and the power mode that its battery allows."""

SMALLEST_IMAGE = (640, 480)
"""(width, height): with fewer pixels the detector misses the marker at 4 m."""

SLOWEST_REPLANNING = 2.0
"""The map grows while the robot drives: a path must not grow older than this, s."""

MAP50: Mapping[str, float] = {"fp32": 0.912, "fp16": 0.912, "int8": 0.904}
"""The detector's accuracy (mAP at IoU 0.5) by precision, as the team that trained it states; made up for the course."""

LOWEST_MAP50 = 0.90
"""What the customer accepts."""


def whole_map_planner() -> Any:
    """Return a planner node that plans on the whole map, known or not."""
    from robotbrain.pipeline.nodes.planner import PlannerNode

    return PlannerNode(crop=False)


def cropped_planner() -> Any:
    """Return the kit's planner node, which plans on what is known of the map and its surroundings."""
    from robotbrain.pipeline.nodes.planner import PlannerNode

    return PlannerNode()


@dataclass(frozen=True)
class BrainSetup:
    """A brain and how it is put onto a module. Change it with ``dataclasses.replace``.

    Attributes:
        module: Jetson and power mode, ``slug:mode``.
        deployment: camera, network, precision, queue and threads; see Deployment.
        planner: makes the planner node: a class, or a function without arguments.
        replan_after: how old a path may grow before the mission asks for another, s.
    """

    module: str
    deployment: Deployment
    planner: Callable[[], Any]
    replan_after: float

    def __post_init__(self) -> None:
        if not isinstance(self.deployment, Deployment):
            raise InputError(
                "setup.deployment",
                given=self.deployment,
                expected="a Deployment",
                fix="replace(setup, deployment=replace(setup.deployment, ...)).",
            )
        if not callable(self.planner):
            raise InputError(
                "setup.planner",
                given=self.planner,
                expected="a class or function that makes a planner node",
                fix="Pass the class itself, not an instance.",
            )
        age = self.replan_after
        if isinstance(age, bool) or not isinstance(age, (int, float)) or not 0 < age < float("inf"):
            raise InputError("setup.replan_after", given=age, expected="seconds > 0", fix="For example 1.5.")

    def drive(
        self,
        seed: int | World,
        *,
        difficulty: float = 0.0,
        time_limit: float = 40.0,
        robot: RobotKind = "nominal",
        trace: bool = False,
        attach: Sequence[Callable[[SimContext], object]] = (),
    ) -> RunResult:
        """Let this brain drive; see :func:`robotbrain.pipeline.brain.drive`."""

        def mission() -> Any:
            from robotbrain.pipeline.nodes.mission import MissionNode

            return MissionNode(self.replan_after)

        return drive(
            seed,
            difficulty=difficulty,
            robot=robot,
            profile=self.module,
            deployment=self.deployment,
            parts={"planner": self.planner, "mission": mission},
            time_limit=time_limit,
            trace=trace,
            attach=attach,
        )


def inherited_brain() -> BrainSetup:
    """Return the brain as it was handed over."""
    network = detector_deployment().network
    return BrainSetup(
        module=MODULE,
        deployment=Deployment(
            image_size=(1280, 960), network=network, one_thread=True, precision="fp32", camera_queue=None
        ),
        planner=whole_map_planner,
        replan_after=0.25,
    )


def unmet_requirements(setup: BrainSetup) -> list[str]:
    """Return in words what a setup must not have changed, but has; empty if all is well.

    Module and power mode, the network and the lidar stay; the images keep at least SMALLEST_IMAGE; the precision keeps
    the accuracy at LOWEST_MAP50; a path is not older than SLOWEST_REPLANNING.
    """
    given = inherited_brain()
    found = []
    if setup.module != given.module:
        found.append(f"module {setup.module}: the robot carries {given.module}")
    deployed = setup.deployment
    if deployed.network is None or Path(deployed.network).resolve() != Path(given.deployment.network or "").resolve():
        found.append("network: it must stay the detector that the customer approved")
    if deployed.image_size is None or any(
        side < smallest for side, smallest in zip(deployed.image_size, SMALLEST_IMAGE, strict=True)
    ):
        found.append(f"image_size {deployed.image_size}: at least {SMALLEST_IMAGE} is needed to see the marker at 4 m")
    if MAP50.get(deployed.precision, 0.0) < LOWEST_MAP50:
        found.append(f"precision {deployed.precision}: mAP 0.5 must be at least {LOWEST_MAP50:g}")
    if deployed.scan_rays != given.deployment.scan_rays:
        found.append("scan_rays: the lidar stays as it is")
    if setup.replan_after > SLOWEST_REPLANNING:
        found.append(f"replan_after {setup.replan_after:g} s: a path must not be older than {SLOWEST_REPLANNING:g} s")
    return found

"""The stages of a brain as times on a device: what perception, estimation, planning and control take.

A stage is a list of segments ``(resource, ns)`` that run in order, for instance perception: CPU to prepare the image,
GPU for the network, CPU to make points of its answer. The times come from a Jetson profile (:func:`brain_stages`) or
are made up (:meth:`Stage.of`); the brains of :mod:`robotbrain.pipeline.patterns.brains` then differ only in how they
arrange the same stages.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from robotbrain.errors import InputError
from robotbrain.ros.resources import RESOURCES, DeviceResources, Segment

if TYPE_CHECKING:
    from robotbrain.jetson.profiles import JetsonProfile
    from robotbrain.pipeline.deployment import Deployment

NS_PER_MS = 1_000_000
NS_PER_S = 1_000_000_000

CAMERA_PIXELS = 64 * 64
"""Pixels of the simulator's camera, to which the profile's typical callbacks refer."""

LIDAR_RAYS = 120
"""Beams of the simulator's lidar, likewise."""

STAGES = ("perception", "estimation", "planning", "control")
"""The four steps of a perception-control loop, in the order of the data."""

CALLBACKS = {
    "estimation": ("estimator_scan", "controller_scan", "controller_points"),
    "planning": ("planner",),
    "control": ("controller",),
}
"""Which callbacks of the kit's brain make up a stage. Estimation is the pose (scan matching) and the memory of nearby
obstacles (scan and camera points); perception is put together from its work, see :func:`brain_stages`."""


@dataclass(frozen=True)
class Stage:
    """One step of a brain: what it is called and what it costs for each frame.

    Attributes:
        name: a valid ROS name, e.g. ``perception``.
        segments: (resource, ns) in order; resources are ``cpu``, ``gpu``, ``dla0`` and ``dla1``.
        work: for times that change from frame to frame: given the frame's number (from 1), returns its segments. The
            stage's ``segments`` are then the typical ones, and closed forms do not apply. None: every frame is alike.

    Raises:
        InputError: no segments, an unknown resource, or a length that is not a whole number of ns >= 1.
    """

    name: str
    segments: tuple[Segment, ...]
    work: Callable[[int], Sequence[Segment]] | None = field(default=None, compare=False, repr=False)

    def __post_init__(self) -> None:
        if not self.name.isidentifier():
            raise InputError("stage name", given=self.name, expected="letters, digits and _", fix="Try 'perception'.")
        if not self.segments:
            raise InputError(
                f"stage {self.name!r}",
                given=self.segments,
                expected="at least one (resource, ns)",
                fix="Leave out a stage that does nothing.",
            )
        for resource, length in self.segments:
            if resource not in RESOURCES:
                raise InputError(
                    f"stage {self.name!r}",
                    given=resource,
                    expected="one of " + ", ".join(RESOURCES),
                    fix="Say what the segment runs on.",
                )
            if isinstance(length, bool) or not isinstance(length, int) or length < 1:
                raise InputError(
                    f"stage {self.name!r}, time on {resource}",
                    given=length,
                    expected="a whole number of ns >= 1",
                    fix="Stage.of(name, cpu_ms=..., gpu_ms=...) takes milliseconds.",
                )

    @classmethod
    def of(cls, name: str, cpu_ms: float = 0.0, gpu_ms: float = 0.0, post_ms: float = 0.0) -> Stage:
        """Return a stage of up to three segments: CPU, then GPU, then CPU again.

        Args:
            name: of the stage.
            cpu_ms, gpu_ms, post_ms: lengths, ms; segments of 0 are left out.
        """
        times = (("cpu", cpu_ms), ("gpu", gpu_ms), ("cpu", post_ms))
        return cls(name, tuple((resource, round(ms * NS_PER_MS)) for resource, ms in times if ms))

    @property
    def ns(self) -> int:
        """Time of one frame on an idle device, ns."""
        return sum(length for _, length in self.segments)

    @property
    def ms(self) -> float:
        """Time of one frame on an idle device, ms."""
        return self.ns / NS_PER_MS

    def on(self, resource: str) -> int:
        """Return the time of one frame on ``resource``, ns."""
        return sum(length for name, length in self.segments if name == resource)

    def scaled(self, factor: float, resource: str | None = None) -> Stage:
        """Return the stage with its (typical) time multiplied, on one resource or on all: a what-if.

        Args:
            factor: > 0.
            resource: None for all.
        """
        return Stage(
            self.name,
            tuple(
                (name, max(1, round(length * factor)) if resource in (None, name) else length)
                for name, length in self.segments
            ),
        )

    def split(self) -> tuple[Stage, ...]:
        """Return a stage for each segment, so that a pipeline can overlap them: pre, inference, post.

        Parts are called ``<name>_pre``, ``<name>_<resource>`` and ``<name>_post``; a stage of one segment stays whole.

        Raises:
            InputError: for a stage with ``work``.
        """
        if len(self.segments) == 1:
            return (self,)
        if self.work is not None:
            raise InputError(
                f"stage {self.name!r}",
                given="work that changes from frame to frame",
                expected="fixed segments",
                fix="Split it by hand: a Stage with work of its own for each part.",
            )
        names = []
        for place, (resource, _) in enumerate(self.segments):
            ends = {0: "pre", len(self.segments) - 1: "post"}
            part = ends.get(place, f"cpu{place}") if resource == "cpu" else resource
            names.append(part if part not in names else f"{part}{place}")
        return tuple(
            Stage(f"{self.name}_{part}", (segment,)) for part, segment in zip(names, self.segments, strict=True)
        )


@dataclass(frozen=True)
class Device:
    """What the brains run on.

    Attributes:
        cpu_cores: cores online.
        dla: deep-learning accelerators, 0 to 2.
        gpu: GPUs, 0 or 1.
        name: for titles.
    """

    cpu_cores: int = 4
    dla: int = 0
    gpu: int = 1
    name: str = ""

    def resources(self) -> DeviceResources:
        """Return fresh resources for one simulation.

        Raises:
            InputError: for numbers that no device has.
        """
        return DeviceResources(cpu_cores=self.cpu_cores, gpu=self.gpu, dla=self.dla)


def as_device(device: Device | JetsonProfile | str | int) -> Device:
    """Return a device from itself, a profile, the slug of one (``"orin-nano-8gb:15W"``), or a number of CPU cores."""
    if isinstance(device, Device):
        return device
    if isinstance(device, int):
        return Device(cpu_cores=device, name=f"{device} core{'s' if device != 1 else ''}")
    if isinstance(device, str):
        from robotbrain.jetson.profiles import load_profile

        device = load_profile(device)
    name = f"{device.name.removeprefix('Jetson ')}, {device.power_mode}"
    return Device(cpu_cores=device.cpu_cores, dla=device.dla, name=name)


def brain_stages(
    profile: str | JetsonProfile = "orin-nano-8gb",
    mode: str | int | None = "15W",
    deployment: Deployment | None = None,
) -> tuple[Stage, ...]:
    """Return the kit's brain as four stages with the times of a Jetson.

    CPU times are those of the profile's typical callbacks, the messages that they take and send included; image and
    scan work is charged for the deployment's sensors (Deployment.scales); the network's latency is the twin's. The
    mapper and the mission, which run beside the loop from camera to command, are left out.

    Args:
        profile: a slug such as ``nano-4gb``, or a profile (then ``mode`` is not looked at).
        mode: power mode; None for the module's default.
        deployment: of the kit's own sensors and network if None; see pipeline.devices.detector_deployment() for those
            of a real robot.

    Raises:
        InputError: for an unknown profile or mode.
    """
    from robotbrain.jetson.profiles import default_network, load_profile
    from robotbrain.pipeline.costs import SCALES_WITH
    from robotbrain.pipeline.deployment import Deployment

    found = load_profile(profile, mode) if isinstance(profile, str) else profile
    deployed = deployment or Deployment()
    scales = deployed.scales(CAMERA_PIXELS, LIDAR_RAYS)

    def work_ns(callback: str, kinds: Sequence[str] | None = None) -> int:
        total = 0.0
        for kind, (calls, units) in found.work.callbacks[callback].work.items():
            if kinds is None or kind in kinds:
                call, unit = found.work_cost(kind)
                total += calls * call + units * unit * scales.get(SCALES_WITH.get(kind, ""), 1.0)
        return round(total)

    # What comes before the network's answer runs before it; everything else needs the answer.
    pre = work_ns("perception", ("message_in", "preprocess"))
    gpu = round(found.network_ms(deployed.network or default_network(), image_size=deployed.image_size) * NS_PER_MS)
    post = work_ns("perception") - pre
    perception = Stage("perception", (("cpu", pre), ("gpu", gpu), ("cpu", post)))
    others = (Stage(name, (("cpu", sum(map(work_ns, parts))),)) for name, parts in CALLBACKS.items())
    return (perception, *others)


def check_stages(stages: Sequence[Stage], device: Device | None = None) -> tuple[Stage, ...]:
    """Return the stages as a tuple.

    Raises:
        InputError: none, two of one name, or a resource that the device does not have.
    """
    chosen = tuple(stages)
    names = [stage.name for stage in chosen]
    if not chosen or len(set(names)) != len(names):
        raise InputError(
            "stages", given=names, expected="at least one, each with a name of its own", fix="Rename the second one."
        )
    if device is not None:
        has = device.resources()
        for stage in chosen:
            for resource, _ in stage.segments:
                has.check(resource)
    return chosen


def split_stage(stages: Sequence[Stage], name: str) -> tuple[Stage, ...]:
    """Return the stages with one of them split by segments (see :meth:`Stage.split`).

    Raises:
        InputError: there is no stage of that name.
    """
    if name not in [stage.name for stage in stages]:
        raise InputError(
            "stage", given=name, expected="one of " + ", ".join(s.name for s in stages), fix="Choose one of these."
        )
    return tuple(part for stage in stages for part in (stage.split() if stage.name == name else (stage,)))

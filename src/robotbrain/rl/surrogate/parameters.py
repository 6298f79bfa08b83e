"""What makes one surrogate differ from the nominal robot, and from the next: ranges, and the draw by serial number.

The ranges are those of ordinary geared servo arms and legs. They are deliberately not the law that training
randomises by: every joint differs from its neighbours, friction and payload follow other distributions, and play,
motor lag, encoder bias, velocity filtering and lost frames are in no training simulation of the kit.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from robotbrain.errors import InputError
from robotbrain.sim.checks import check_seed

Array = NDArray[np.float64]
Robot = Literal["arm", "quadruped"]
ROBOTS: tuple[Robot, ...] = get_args(Robot)

RANGES: dict[Robot, dict[str, tuple[float, float]]] = {
    "arm": {
        "dry_friction": (0.004, 0.02),  # share of the joint's torque limit, each joint its own: harmonic drives
        "viscous_friction": (0.7, 2.0),  # factor, each joint its own: grease, cold to warm
        "link_mass": (0.9, 1.2),  # factor, each link its own: cables, covers, brackets
        "com_shift": (-0.015, 0.015),  # m, each link and axis its own
        "payload": (0.0, 1.0),  # kg, in the hand; the controller's weight compensation does not know it
        "payload_offset": (-0.04, 0.04),  # m from the hand's frame, each axis its own
        "motor_strength": (0.75, 1.05),  # factor of stiffness and torque limit, each joint its own
        "motor_lag_s": (0.005, 0.015),
        "play": (0.0005, 0.004),  # rad, each joint its own: 0.03 to 0.23 degrees
        "command_delay_s": (0.0025, 0.015),  # field bus and drive; rounded to physics steps of 5 ms
        "measurement_delay_s": (0.0, 0.0075),
        "encoder_bias": (-0.003, 0.003),  # rad, each joint its own: homing
        "encoder_noise": (0.0001, 0.0005),  # rad, standard deviation
        "velocity_noise": (0.005, 0.03),  # rad/s, standard deviation
        "frame_drop": (0.0, 0.05),  # share of joint states that never arrive
    },
    "quadruped": {
        "dry_friction": (0.003, 0.015),
        "viscous_friction": (0.7, 2.0),
        "link_mass": (0.95, 1.1),
        "com_shift": (-0.01, 0.01),
        "payload": (0.0, 1.5),  # kg, on the trunk
        "payload_offset": (-0.05, 0.05),
        "motor_strength": (0.8, 1.05),
        "motor_lag_s": (0.003, 0.01),
        "play": (0.002, 0.012),  # rad: planetary gears
        "command_delay_s": (0.0, 0.015),
        "measurement_delay_s": (0.0, 0.01),
        "encoder_bias": (-0.015, 0.015),
        "encoder_noise": (0.0005, 0.003),
        "velocity_noise": (0.05, 0.3),
        "frame_drop": (0.0, 0.03),
    },
}
"""Range of every parameter per robot; each is drawn uniformly, but for friction and payload (see :func:`draw`)."""

DIFFERENCES: dict[str, tuple[str, ...]] = {
    "delays": ("command_delay_s", "motor_lag_s", "measurement_delay_s"),
    "friction": ("dry_friction", "viscous_friction"),
    "masses": ("link_mass", "com_shift", "payload", "payload_offset"),
    "motors": ("motor_strength",),
    "play": ("play",),
    "encoders": ("encoder_bias", "encoder_noise", "velocity_noise"),
    "lost frames": ("frame_drop",),
}
"""What kinds of parameters there are, for asking which of them costs a policy its success."""


@dataclass(frozen=True, eq=False)
class SurrogateParams:
    """One surrogate's parameters; units as in :data:`RANGES`.

    Args:
        dry_friction, viscous_friction, motor_strength, play, encoder_bias: per joint, (J,).
        link_mass: per link, (J,); link i is the body that joint i moves.
        com_shift: per link, (J, 3).
        payload_offset: (3,).
        payload, motor_lag_s, command_delay_s, measurement_delay_s, encoder_noise, velocity_noise, frame_drop: numbers.
    """

    dry_friction: Array
    viscous_friction: Array
    link_mass: Array
    com_shift: Array
    payload: float
    payload_offset: Array
    motor_strength: Array
    motor_lag_s: float
    play: Array
    command_delay_s: float
    measurement_delay_s: float
    encoder_bias: Array
    encoder_noise: float
    velocity_noise: float
    frame_drop: float

    def summary(self) -> dict[str, float]:
        """Return one number per parameter: means over joints, magnitudes of what has a sign; for correlations."""
        return {f.name: float(np.mean(np.abs(getattr(self, f.name)))) for f in fields(self)}

    def with_nominal(self, *names: str) -> SurrogateParams:
        """Return these parameters with the named ones as on the nominal robot.

        Raises:
            InputError: for a name that is no parameter.
        """
        clean = neutral(len(self.play))
        for name in names:
            if name not in RANGES["arm"]:
                raise InputError(
                    "surrogate parameter", given=name, expected=", ".join(RANGES["arm"]), fix="Check the spelling."
                )
        return replace(self, **{name: getattr(clean, name) for name in names})


def neutral(joints: int) -> SurrogateParams:
    """Return the parameters of the nominal robot: nothing added, no delay, ideal encoders."""
    zero, one = np.zeros(joints), np.ones(joints)
    return SurrogateParams(
        dry_friction=zero,
        viscous_friction=one,
        link_mass=one,
        com_shift=np.zeros((joints, 3)),
        payload=0.0,
        payload_offset=np.zeros(3),
        motor_strength=one,
        motor_lag_s=0.0,
        play=zero,
        command_delay_s=0.0,
        measurement_delay_s=0.0,
        encoder_bias=zero,
        encoder_noise=0.0,
        velocity_noise=0.0,
        frame_drop=0.0,
    )


def draw(serial: int, robot: Robot = "arm", joints: int = 7) -> SurrogateParams:
    """Return the parameters of the surrogate with this serial number; one serial is always the same surrogate.

    Dry friction is log-uniform (most joints turn easily, a few do not); the payload is the larger of two uniform draws
    (a robot is bought to carry something). All else is uniform.

    Args:
        serial: an integer >= 0.
        robot: ``"arm"`` or ``"quadruped"``.
        joints: how many joints it has.

    Raises:
        InputError: no such robot, or the serial is not an integer >= 0.
    """
    if robot not in RANGES:
        raise InputError("surrogate robot", given=robot, expected="one of " + ", ".join(ROBOTS), fix="Try 'arm'.")
    number = check_seed("surrogate serial", serial)
    rng = np.random.default_rng(np.random.SeedSequence([0x5066A7E, 5, ROBOTS.index(robot), number]))
    shape = {"com_shift": (joints, 3), "payload_offset": (3,), "payload": (2,)}
    per_joint = ("dry_friction", "viscous_friction", "link_mass", "motor_strength", "play", "encoder_bias")
    values: dict[str, Array | float] = {}
    for name, (low, high) in RANGES[robot].items():
        if name == "dry_friction":
            values[name] = np.exp(rng.uniform(np.log(low), np.log(high), joints))
        elif name == "payload":
            values[name] = float(rng.uniform(low, high, 2).max())
        elif name in per_joint or name in shape:
            values[name] = rng.uniform(low, high, shape.get(name, (joints,)))
        else:
            values[name] = float(rng.uniform(low, high))
    return SurrogateParams(**values)  # type: ignore[arg-type]

"""The lab's differential-drive robot as a planar body, among obstacles whose place and size each environment sets.

The lab simulates wheels, casters and friction at 200 Hz (:mod:`robotbrain.sim.scene`). Learning needs millions of
steps, so here the base is one planar body with the lab robot's own limits: a velocity command passes a first-order
motor lag, and a servo with limited force follows it, so that the base never accelerates faster than the firmware
allows. (The firmware limits acceleration before the lag; large changes of command are carried out up to the lag sooner
here.) A third servo keeps the body from sliding sideways, as wheels do. The body moves freely through obstacles: a
collision is a matter of geometry, see :mod:`robotbrain.rl.tasks.layouts`.
"""

from __future__ import annotations

from robotbrain.rl.robots.mjcf import tag
from robotbrain.sim.robot import CHASSIS_BOTTOM, CHASSIS_RADIUS, CHASSIS_TOP, LIDAR_HEIGHT, RobotParams

ACTUATORS = ("forward", "turn", "slip")
"""Commands of the first two: m/s and rad/s in the body's frame. The third is always 0."""
OBSTACLE_HALF_HEIGHT = 0.4
ROOM_WALL_HALF = 0.05
TIMESTEP_S = 0.05
"""Velocity servos of this time constant, at this physics time step, settle within one step."""
LIDAR_GROUPS = (1, 0, 0, 0, 0, 0)
"""Flags of the geom groups that the lidar sees: walls and obstacles."""
PARKED_Y = 50.0
"""Obstacles that are not in use stand out here (m)."""
_ROBOT_GROUP = 4


def base_mjcf(
    obstacles: int = 12, room_half: float = 4.0, params: RobotParams | None = None, servo_s: float = TIMESTEP_S
) -> str:
    """Return the MJCF document of the base in a square room with ``obstacles`` boxes that can be put anywhere.

    Body ``base`` has a free joint, its origin on the floor and x forward. Obstacles are mocap bodies ``obstacle_0`` ...
    with a box geom of the same name each; their pose is ``mocap_pos`` and ``mocap_quat``, their half sizes
    ``geom_size``. Actuators are ``ACTUATORS``.

    Args:
        obstacles: how many obstacle bodies, parked out of sight.
        room_half: half the inner side of the room (m).
        params: mass, lag and limits; the nominal robot by default.
        servo_s: time constant of the velocity servos (s); at least the physics time step, or they would overshoot.
    """
    p = params or RobotParams()
    yaw_inertia = p.mass * CHASSIS_RADIUS**2 / 2.0
    half = (CHASSIS_TOP - CHASSIS_BOTTOM) / 2.0
    base = tag(
        "body",
        tag("freejoint", name="base_free"),
        # On the floor: forces of the drive then turn the body about z alone.
        tag("inertial", pos=(0, 0, 0), mass=p.mass, diaginertia=(yaw_inertia, yaw_inertia, yaw_inertia)),
        tag(
            "geom",
            name="chassis",
            type="cylinder",
            size=(CHASSIS_RADIUS, half),
            pos=(0, 0, CHASSIS_BOTTOM + half),
            group=_ROBOT_GROUP,
            rgba=(0.12, 0.35, 0.6, 1),
        ),
        tag("site", name="drive"),
        tag("site", name="lidar", pos=(0, 0, LIDAR_HEIGHT)),
        name="base",
    )
    walls = (_wall(name, room_half, side) for side, name in enumerate(("east", "north", "west", "south")))
    boxes = (_obstacle(index) for index in range(obstacles))
    drive = (
        _servo("forward", (1, 0, 0, 0, 0, 0), p.mass, servo_s, p.max_acceleration, p.max_speed, p.motor_lag_s),
        _servo("turn", (0, 0, 0, 0, 0, 1), yaw_inertia, servo_s, p.max_yaw_acceleration, p.max_yaw_rate, p.motor_lag_s),
        _servo("slip", (0, 1, 0, 0, 0, 0), p.mass, servo_s / 10.0, None, 0.0, 0.0),
    )
    flags = tag("flag", contact="disable")
    return tag(
        "mujoco",
        tag("compiler", angle="radian"),
        tag("option", flags, timestep=TIMESTEP_S, gravity=(0, 0, 0), integrator="implicitfast"),
        tag("default", tag("geom", contype=0, conaffinity=0)),
        tag("worldbody", *walls, base, *boxes),
        tag("actuator", *drive),
        model="navigation_base",
    )


def _wall(name: str, room_half: float, side: int) -> str:
    out, along = room_half + ROOM_WALL_HALF, room_half + 2 * ROOM_WALL_HALF
    x, y = ((out, 0), (0, out), (-out, 0), (0, -out))[side]
    size = (ROOM_WALL_HALF, along) if side % 2 == 0 else (along, ROOM_WALL_HALF)
    half = OBSTACLE_HALF_HEIGHT
    return tag("geom", name=f"wall_{name}", type="box", size=(*size, half), pos=(x, y, half), rgba=(0.6, 0.6, 0.55, 1))


def _obstacle(index: int) -> str:
    name, half = f"obstacle_{index}", OBSTACLE_HALF_HEIGHT
    geom = tag("geom", name=name, type="box", size=(0.1, 0.1, half), rgba=(0.75, 0.45, 0.2, 1))
    return tag("body", geom, name=name, mocap="true", pos=(float(index), PARKED_Y, half))


def _servo(
    name: str,
    gear: tuple[int, ...],
    inertia: float,
    servo_s: float,
    acceleration: float | None,
    limit: float,
    lag_s: float,
) -> str:
    gain = inertia / servo_s
    limits: dict[str, str | tuple[float, ...]] = {}
    if acceleration is not None:
        force = inertia * acceleration
        limits = {"forcerange": (-force, force), "ctrlrange": (-limit, limit)}
    if lag_s > 0.0:
        limits |= {"dyntype": "filterexact", "dynprm": (lag_s,)}
    bias = (0.0, 0.0, -gain)
    return tag(
        "general", name=name, site="drive", gear=gear, gainprm=(gain,), biastype="affine", biasprm=bias, **limits
    )

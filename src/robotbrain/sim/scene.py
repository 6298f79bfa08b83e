"""A world and a robot as one compiled MuJoCo model, with tables of what each geom is and how it looks.

Every shape is a primitive of our own. Collision bits keep contact pairs few: wheels and casters meet only the
floor, the chassis meets only obstacles, boxes meet floor, obstacles and each other. Boxes start asleep, so a
world at rest costs little more than the robot alone.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from robotbrain.sim.robot import CHASSIS_BOTTOM, CHASSIS_RADIUS, CHASSIS_TOP, RobotParams
from robotbrain.sim.world import (
    MARKER_MAT_RADIUS,
    MARKER_SIGN_BOTTOM,
    MARKER_SIGN_HALF,
    Obstacle,
    World,
)

TIMESTEP_S = 0.005
GROUP_SOLID, GROUP_VISUAL, GROUP_ROBOT = 0, 2, 4
"""Geom groups: what lidar and camera see, what only the camera sees, the robot itself."""
MAT_THICKNESS = 0.004
CASTER_RADIUS = 0.03
CASTER_OFFSET = 0.13
WHEEL_MASS = 0.3
BASE_FRICTION = 0.1
"""Of floor and walls: a contact takes the greater of its two, so wheels, boxes and chassis set theirs."""
SERVO_GAIN = 1.0
"""Of a wheel's speed loop (N m per rad/s)."""


class SegmentationClass(enum.IntEnum):
    """Class ids of the segmentation images."""

    BACKGROUND = 0
    FLOOR = 1
    OBSTACLE = 2
    MARKER = 3


class Pattern(enum.IntEnum):
    """How a geom's surface is coloured."""

    PLAIN = 0
    TILES = 1
    SHELF = 2
    MARKER = 3


@dataclass(frozen=True)
class Scene:
    """A compiled world.

    Args:
        world: what it was built from.
        robot: whose body is in it.
        model: the MuJoCo model; the robot's free joint comes first in ``qpos``.
        geom_names: name of each geom, (ngeom,).
        geom_class: ``SegmentationClass`` of each geom, uint8 (ngeom,).
        geom_pattern: ``Pattern`` of each geom, uint8 (ngeom,).
        geom_colour: plain colour of each geom, float32 (ngeom, 3).
        robot_geoms: ids of the geoms that can touch obstacles.
        box_qpos: address in ``qpos`` of each movable obstacle, in the order of ``world.movable``.
    """

    world: World
    robot: RobotParams
    model: mujoco.MjModel
    geom_names: tuple[str, ...]
    geom_class: NDArray[np.uint8]
    geom_pattern: NDArray[np.uint8]
    geom_colour: NDArray[np.float32]
    robot_geoms: frozenset[int]
    box_qpos: tuple[int, ...]


def build_scene(world: World, robot: RobotParams | None = None, timestep_s: float = TIMESTEP_S) -> Scene:
    """Compile ``world`` with ``robot`` (the nominal one by default) standing at the start pose."""
    robot = robot or RobotParams()
    model = mujoco.MjModel.from_xml_string(scene_xml(world, robot, timestep_s))
    names = tuple(model.geom(i).name for i in range(model.ngeom))
    classes = np.full(model.ngeom, SegmentationClass.OBSTACLE, np.uint8)
    patterns = np.full(model.ngeom, Pattern.PLAIN, np.uint8)
    for i, name in enumerate(names):
        if name == "floor":
            classes[i], patterns[i] = SegmentationClass.FLOOR, Pattern.TILES
        elif name in ("marker_mat", "marker_sign"):
            classes[i], patterns[i] = SegmentationClass.MARKER, Pattern.MARKER
        elif name.startswith("shelf"):
            patterns[i] = Pattern.SHELF
    body = frozenset(i for i, name in enumerate(names) if name == "chassis")
    boxes = tuple(int(model.joint(f"{o.name}_free").qposadr[0]) for o in world.movable)
    colour = model.geom_rgba[:, :3].astype(np.float32)
    return Scene(world, robot, model, names, classes, patterns, colour, body, boxes)


def scene_xml(world: World, robot: RobotParams, timestep_s: float = TIMESTEP_S) -> str:
    """Return the MJCF document of ``world`` with ``robot``."""
    obstacles = "\n".join(_obstacle_xml(o, robot) for o in (*world.outer_walls, *world.obstacles))
    floor = _numbers((*world.look.floor[0], 1.0))
    tone = _numbers((*world.look.marker[0], 1.0))
    gx, gy = world.goal.x, world.goal.y
    sign_z = MARKER_SIGN_BOTTOM + MARKER_SIGN_HALF[2]
    return f"""<mujoco model="robotbrain">
<compiler angle="radian"/>
<option timestep="{timestep_s}" integrator="implicitfast" cone="elliptic" iterations="20">
  <flag sleep="enable" autoreset="disable"/>
</option>
<default><geom contype="0" conaffinity="0" condim="3" friction="{BASE_FRICTION} 0.005 0.0001"/></default>
<worldbody>
<geom name="floor" type="plane" size="{world.half_x + 1} {world.half_y + 1} 0.1" contype="1" rgba="{floor}"/>
{_robot_xml(world, robot)}
{obstacles}
<geom name="marker_mat" type="cylinder" size="{MARKER_MAT_RADIUS} {MAT_THICKNESS / 2}"
  pos="{gx!r} {gy!r} {MAT_THICKNESS / 2}" group="{GROUP_VISUAL}" rgba="{tone}"/>
<geom name="marker_sign" type="box" size="{_numbers(MARKER_SIGN_HALF)}" pos="{gx!r} {gy!r} {sign_z}"
  group="{GROUP_VISUAL}" rgba="{tone}"/>
</worldbody>
<actuator>
{_servo_xml("left", robot)}
{_servo_xml("right", robot)}
</actuator>
</mujoco>"""


def _numbers(values: tuple[float, ...]) -> str:
    return " ".join(repr(float(v)) for v in values)


def _obstacle_xml(o: Obstacle, robot: RobotParams) -> str:
    size, rgba = _numbers((o.half_x, o.half_y, o.half_z)), _numbers(o.rgba)
    place = f'pos="{_numbers((o.x, o.y, o.half_z))}" euler="0 0 {o.yaw!r}"'
    if not o.movable:
        return f'<geom name="{o.name}" type="box" size="{size}" {place} contype="2" rgba="{rgba}"/>'
    mass = max(0.5, 60.0 * 8.0 * o.half_x * o.half_y * o.half_z)  # a filled carton, 60 kg/m^3
    return (
        f'<body name="{o.name}" {place} sleep="init"><freejoint name="{o.name}_free"/>'
        f'<geom name="{o.name}" type="box" size="{size}" contype="2" conaffinity="3" mass="{mass!r}"'
        f' friction="{robot.box_friction} 0.005 0.0001" rgba="{rgba}"/></body>'
    )


def _robot_xml(world: World, p: RobotParams) -> str:
    start, half = world.start, (CHASSIS_TOP - CHASSIS_BOTTOM) / 2
    chassis_mass = max(p.mass - 2 * WHEEL_MASS, 0.5)
    hidden = f'group="{GROUP_ROBOT}"'
    casters = "\n".join(
        f'<geom name="caster_{name}" type="sphere" size="{CASTER_RADIUS}" pos="{x} 0 {CASTER_RADIUS}" mass="0"'
        f' conaffinity="1" condim="1" priority="1" {hidden} rgba="0.3 0.3 0.3 1"/>'
        for name, x in (("front", CASTER_OFFSET), ("rear", -CASTER_OFFSET))
    )
    wheels = "\n".join(
        _wheel_xml(side, y, p.wheel_radius * (1.0 + error), p)
        for side, y, error in (
            ("left", p.track / 2, p.wheel_radius_error[0]),
            ("right", -p.track / 2, p.wheel_radius_error[1]),
        )
    )
    return f"""<body name="base" pos="{_numbers((start.x, start.y, 0.0))}" euler="0 0 {start.yaw!r}">
<freejoint name="base_free"/>
<geom name="chassis" type="cylinder" size="{CHASSIS_RADIUS} {half}" pos="0 0 {CHASSIS_BOTTOM + half}"
  mass="{chassis_mass}" conaffinity="2" friction="0.3 0.005 0.0001" {hidden} rgba="0.12 0.35 0.6 1"/>
{casters}
{wheels}
</body>"""


def _wheel_xml(side: str, y: float, radius: float, p: RobotParams) -> str:
    # A sphere touches the floor in one point: the track is exact and the wheel does not scrub in turns.
    return f"""<body name="{side}_wheel" pos="0 {y} {radius}">
<joint name="{side}_wheel_joint" axis="0 1 0" damping="0.002" armature="0.002"/>
<geom name="{side}_wheel" type="sphere" size="{radius}" mass="{WHEEL_MASS}" conaffinity="1" priority="1"
  friction="{p.wheel_friction} 0.005 0.0001" group="{GROUP_ROBOT}" rgba="0.1 0.1 0.1 1"/></body>"""


def _servo_xml(side: str, p: RobotParams) -> str:
    return (
        f'<velocity name="{side}_servo" joint="{side}_wheel_joint" kv="{SERVO_GAIN}"'
        f' forcerange="{-p.max_torque} {p.max_torque}"/>'
    )

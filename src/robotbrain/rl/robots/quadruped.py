"""A 12-joint quadruped of about 13 kg: hip, thigh and calf on each leg and a ball for a foot, geometry of our own.

x points forward, y left, z up. Legs are ``FL``, ``FR``, ``RL``, ``RR``. The hip turns about x (positive lifts the
left side's foot outwards), thigh and calf about y. At angle zero a leg hangs straight down.
"""

from __future__ import annotations

from dataclasses import dataclass

from robotbrain.rl.robots.mjcf import Rgba, hinge_body, tag

TIMESTEP_S = 0.005
"""Physics step (s): 200 Hz, four to a control step of 50 Hz."""

LEGS = ("FL", "FR", "RL", "RR")
PARTS = ("hip", "thigh", "calf")
JOINT_NAMES = tuple(f"{leg}_{part}_joint" for leg in LEGS for part in PARTS)
"""Order of joints, actions and observations."""

_INDIGO: Rgba = (0.25, 0.36, 0.64)
_AMBER: Rgba = (0.98, 0.70, 0.25)
_CREAM: Rgba = (0.96, 0.94, 0.88)
_DARK: Rgba = (0.16, 0.18, 0.23)


@dataclass(frozen=True, slots=True)
class QuadrupedSpec:
    """Sizes, masses and drives of the quadruped.

    Attributes:
        trunk_half: half extents of the trunk's box (m).
        trunk_mass: (kg).
        hip_x, hip_y: the hip axes' place in the trunk (m).
        hip_offset: from hip axis out to the leg's plane (m).
        thigh, calf: lengths from axis to axis, and from knee to the foot's centre (m).
        foot_radius: (m).
        hip_mass, thigh_mass, calf_mass, foot_mass: (kg).
        hip_limits, thigh_limits, calf_limits: joint limits (rad).
        home: default angle of hip (left legs; right legs mirrored), thigh and calf (rad).
        stiffness: of the joint servos (N m/rad).
        damping: of the joint servos (N m s/rad).
        torque: limit of hip, thigh and calf servo (N m).
        armature: inertia of rotor and gear as seen at each joint (kg m^2).
        friction: sliding friction of feet and body on the floor.
    """

    trunk_half: tuple[float, float, float] = (0.20, 0.075, 0.055)
    trunk_mass: float = 6.0
    hip_x: float = 0.19
    hip_y: float = 0.05
    hip_offset: float = 0.08
    thigh: float = 0.213
    calf: float = 0.213
    foot_radius: float = 0.023
    hip_mass: float = 0.6
    thigh_mass: float = 1.0
    calf_mass: float = 0.16
    foot_mass: float = 0.06
    hip_limits: tuple[float, float] = (-0.86, 0.86)
    thigh_limits: tuple[float, float] = (-0.7, 2.6)
    calf_limits: tuple[float, float] = (-2.7, -0.85)
    home: tuple[float, float, float] = (0.0, 0.9, -1.6)
    stiffness: float = 40.0
    damping: float = 1.0
    torque: tuple[float, float, float] = (24.0, 24.0, 36.0)
    armature: float = 0.01
    friction: float = 0.9

    @property
    def mass(self) -> float:
        """Mass of the whole robot (kg)."""
        return self.trunk_mass + 4 * (self.hip_mass + self.thigh_mass + self.calf_mass + self.foot_mass)


SPEC = QuadrupedSpec()
STAND_HEIGHT = 0.319
"""Height of the trunk's centre above the floor in the default pose (m), feet just touching."""
DEFAULT_JOINT_POS = tuple(
    (angle if part != 0 or leg.endswith("L") else -angle) for leg in LEGS for part, angle in enumerate(SPEC.home)
)
"""Default joint angles in the order of ``JOINT_NAMES`` (rad)."""


def quadruped_mjcf(timestep_s: float = TIMESTEP_S, extra: str = "") -> str:
    """Return the quadruped's MJCF with a touch sensor ``contact_<body>`` on every body that can touch the floor.

    Robot parts collide with the floor and nothing else, which keeps contacts few and the solver quick. The parts'
    friction has priority over the floor's, so that it alone decides.

    Args:
        timestep_s: physics step (s).
        extra: MJCF elements to add to the world; what is to be walked on needs ``conaffinity="1"``.
    """
    spec = SPEC
    legs = "\n".join(_leg(leg, spec) for leg in LEGS)
    servos = "\n".join(
        tag(
            "position",
            name=f"{leg}_{part}_joint",
            joint=f"{leg}_{part}_joint",
            kp=spec.stiffness,
            kv=spec.damping,
            forcerange=(-torque, torque),
        )
        for leg in LEGS
        for part, torque in zip(PARTS, spec.torque, strict=True)
    )
    touching = ["base", *(f"{leg}_{part}" for leg in LEGS for part in ("thigh", "calf", "foot"))]
    sensors = "\n".join(tag("touch", name=f"contact_{body}", site=f"{body}_touch") for body in touching)
    angles = " ".join(map(repr, DEFAULT_JOINT_POS))
    return f"""<mujoco model="quadruped">
<compiler angle="radian"/>
<option timestep="{timestep_s!r}" integrator="implicitfast" cone="pyramidal" iterations="10" ls_iterations="10"/>
<default>
  <joint damping="0.1" limited="true"/>
  <geom contype="0" conaffinity="0" condim="3"/>
  <site group="4" rgba="0 0 0 0"/>
  <default class="solid">
    <geom contype="1" priority="1" friction="{spec.friction!r} 0.005 0.0001" solref="0.01 1"/>
  </default>
</default>
<worldbody>
<light pos="0 0 3"/>
<geom name="floor" type="plane" size="50 50 0.1" conaffinity="1" rgba="0.86 0.89 0.92 1"/>
<body name="base" pos="0 0 {STAND_HEIGHT!r}">
<freejoint name="root"/>
{_trunk(spec)}
{legs}
</body>
{extra}
</worldbody>
<actuator>
{servos}
</actuator>
<sensor>
{sensors}
</sensor>
<keyframe><key name="home" qpos="0 0 {STAND_HEIGHT!r} 1 0 0 0 {angles}" ctrl="{angles}"/></keyframe>
</mujoco>"""


def _trunk(spec: QuadrupedSpec) -> str:
    """Return the trunk with a head of two eyes, so that one sees which way it walks."""
    x, y, z = spec.trunk_half
    grown = tuple(v + 0.03 for v in spec.trunk_half)

    def decor(kind: str, size: tuple[float, ...], pos: tuple[float, float, float], colour: Rgba) -> str:
        return tag("geom", type=kind, size=size, pos=pos, rgba=(*colour, 1.0), mass=0.0, group=2)

    return "\n".join(
        (
            tag(
                "geom",
                name="base",
                class_="solid",
                type="box",
                size=spec.trunk_half,
                mass=spec.trunk_mass,
                rgba=(*_INDIGO, 1.0),
            ),
            decor("box", (0.8 * x, 0.7 * y, 0.012), (0.0, 0.0, z), _AMBER),
            decor("ellipsoid", (0.055, 0.07, 0.045), (x + 0.03, 0.0, 0.025), _CREAM),
            decor("sphere", (0.015,), (x + 0.07, 0.035, 0.045), _DARK),
            decor("sphere", (0.015,), (x + 0.07, -0.035, 0.045), _DARK),
            tag("site", name="imu"),
            tag("site", name="base_touch", type="box", size=grown),
        )
    )


def _leg(leg: str, spec: QuadrupedSpec) -> str:
    front, side = (1 if leg[0] == "F" else -1), (1 if leg[1] == "L" else -1)
    out, hip, (_, thigh_home, calf_home) = side * spec.hip_offset, side * spec.home[0], spec.home
    foot = tag(
        "body",
        tag(
            "geom",
            name=f"{leg}_foot",
            class_="solid",
            type="sphere",
            size=(spec.foot_radius,),
            mass=spec.foot_mass,
            rgba=(*_DARK, 1.0),
        ),
        tag("site", name=f"{leg}_foot_touch", type="sphere", size=(1.5 * spec.foot_radius,)),
        name=f"{leg}_foot",
        pos=(0.0, 0.0, -spec.calf),
    )
    calf = hinge_body(
        f"{leg}_calf",
        # It ends above the foot, so that walking on the foot is no contact of the calf.
        *_bone(f"{leg}_calf", spec.calf - 1.6 * spec.foot_radius, 0.014, spec.calf_mass, _CREAM),
        foot,
        pos=(0.0, 0.0, -spec.thigh),
        joint=f"{leg}_calf_joint",
        axis=(0.0, 1.0, 0.0),
        home=calf_home,
        limits=spec.calf_limits,
        armature=spec.armature,
    )
    thigh = hinge_body(
        f"{leg}_thigh",
        *_bone(f"{leg}_thigh", spec.thigh, 0.022, spec.thigh_mass, _AMBER),
        calf,
        pos=(0.0, out, 0.0),
        joint=f"{leg}_thigh_joint",
        axis=(0.0, 1.0, 0.0),
        home=thigh_home,
        limits=spec.thigh_limits,
        armature=spec.armature,
    )
    motor = tag(
        "geom",
        name=f"{leg}_hip",
        type="cylinder",
        fromto=(0.0, 0.35 * out, 0.0, 0.0, 0.85 * out, 0.0),
        size=(0.042,),
        mass=spec.hip_mass,
        rgba=(*_DARK, 1.0),
    )
    return hinge_body(
        f"{leg}_hip",
        motor,
        thigh,
        pos=(front * spec.hip_x, side * spec.hip_y, 0.0),
        joint=f"{leg}_hip_joint",
        axis=(1.0, 0.0, 0.0),
        home=hip,
        limits=spec.hip_limits,
        armature=spec.armature,
    )


def _bone(name: str, length: float, radius: float, mass: float, colour: Rgba) -> tuple[str, str]:
    """Return a leg segment hanging from the body's origin and the site that encloses it for its touch sensor."""
    ends = (0.0, 0.0, 0.0, 0.0, 0.0, -length)
    geom = tag(
        "geom",
        name=name,
        class_="solid",
        type="capsule",
        fromto=ends,
        size=(radius,),
        mass=mass,
        rgba=(*colour, 1.0),
    )
    return geom, tag("site", name=f"{name}_touch", type="capsule", fromto=ends, size=(radius + 0.012,))

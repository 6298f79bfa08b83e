"""A 7-joint arm on a table-top pedestal: shoulder, elbow and wrist as on common research arms, geometry of our own.

The axes of joints 2, 4 and 6 bend the arm (about y), those of 1, 3, 5 and 7 twist it (about z). At angle zero it
stands upright. The end-effector site ``ee`` lies between the fingertips.
"""

from __future__ import annotations

from dataclasses import dataclass

from robotbrain.rl.robots.mjcf import Rgba, hinge_body, tag

TIMESTEP_S = 0.005
"""Physics step (s): 200 Hz."""
REACH = 1.07
"""Distance from the shoulder (joint 2) to ``ee`` with the arm stretched (m)."""
SHOULDER_HEIGHT = 0.36
"""Height of joint 2 above the mounting plane (m)."""
WORKSPACE = ((0.25, 0.75), (-0.5, 0.5), (0.1, 0.7))
"""A box in the base frame, (low, high) of x, y, z (m), that ``ee`` reaches everywhere: 0.3 m^3."""

_WHITE: Rgba = (0.95, 0.95, 0.93)
_TEAL: Rgba = (0.12, 0.58, 0.60)
_CORAL: Rgba = (0.96, 0.48, 0.36)
_DARK: Rgba = (0.22, 0.24, 0.30)


@dataclass(frozen=True, slots=True)
class ArmLink:
    """One joint and the link that it carries.

    Attributes:
        offset: from the joint before along its link's z axis (m).
        axis: ``"z"`` twists, ``"y"`` bends.
        limits: of the joint (rad).
        home: default angle (rad).
        length: of the link's tube along its z axis (m).
        radius: of the tube (m).
        mass: of the link (kg).
        stiffness: of the position servo (N m/rad).
        torque: limit of the servo (N m).
        armature: inertia of rotor and gear as seen at the joint (kg m^2).
    """

    offset: float
    axis: str
    limits: tuple[float, float]
    home: float
    length: float
    radius: float
    mass: float
    stiffness: float
    torque: float
    armature: float


LINKS = (
    ArmLink(0.16, "z", (-2.9, 2.9), 0.0, 0.20, 0.070, 3.2, 600.0, 250.0, 0.15),
    ArmLink(0.20, "y", (-1.8, 1.8), 0.2, 0.21, 0.065, 3.0, 600.0, 250.0, 0.15),
    ArmLink(0.21, "z", (-2.9, 2.9), 0.0, 0.21, 0.060, 2.4, 400.0, 150.0, 0.10),
    ArmLink(0.21, "y", (0.05, 2.65), 1.6, 0.20, 0.055, 2.2, 400.0, 150.0, 0.10),
    ArmLink(0.20, "z", (-2.9, 2.9), 0.0, 0.20, 0.050, 1.6, 150.0, 60.0, 0.05),
    ArmLink(0.20, "y", (-1.9, 2.2), 1.0, 0.09, 0.045, 1.2, 150.0, 40.0, 0.05),
    ArmLink(0.09, "z", (-2.9, 2.9), 0.0, 0.04, 0.040, 0.5, 60.0, 20.0, 0.03),
)
"""``joint1`` .. ``joint7`` from the base up; the wrist and hand add the last 0.25 m."""

HAND_OFFSET = 0.05
"""From joint 7 to the hand's palm (m)."""
EE_OFFSET = 0.11
"""From the palm to ``ee`` (m)."""
HOME = tuple(link.home for link in LINKS)
"""Default joint angles (rad): the hand points down in front of the base."""


def arm_mjcf(timestep_s: float = TIMESTEP_S, extra: str = "") -> str:
    """Return the arm's MJCF: joints ``joint1`` to ``joint7``, bodies ``link1`` to ``link7`` and ``hand``.

    Servos are position servos, critically damped in the default pose, with gravity compensated. Only wrist and hand
    collide, and only with the floor.

    Args:
        timestep_s: physics step (s).
        extra: MJCF elements to add to the world, e.g. a target marker.
    """
    body = tag("body", *_hand(), name="hand", pos=(0.0, 0.0, HAND_OFFSET), gravcomp=1)
    for number, link in reversed(list(enumerate(LINKS, 1))):
        body = hinge_body(
            f"link{number}",
            *_tube(number, link),
            body,
            pos=(0.0, 0.0, link.offset),
            joint=f"joint{number}",
            axis=(0.0, 1.0, 0.0) if link.axis == "y" else (0.0, 0.0, 1.0),
            home=link.home,
            limits=link.limits,
            armature=link.armature,
            gravcomp=1,
        )
    servos = "\n".join(_servo(number, link) for number, link in enumerate(LINKS, 1))
    home = " ".join(map(repr, HOME))
    pedestal = tag("geom", type="cylinder", size=(0.10, 0.08), pos=(0.0, 0.0, 0.08), rgba=(*_DARK, 1.0))
    return f"""<mujoco model="arm">
<compiler angle="radian"/>
<option timestep="{timestep_s!r}" integrator="implicitfast" iterations="10" ls_iterations="10"/>
<default>
  <joint damping="1" limited="true"/>
  <geom contype="0" conaffinity="0" condim="3"/>
</default>
<worldbody>
<light pos="1 1 3" dir="-0.3 -0.3 -1"/>
<geom name="floor" type="plane" size="2 2 0.1" conaffinity="1" rgba="0.86 0.89 0.92 1"/>
{tag("body", pedestal, body, name="base")}
{extra}
</worldbody>
<actuator>
{servos}
</actuator>
<keyframe><key name="home" qpos="{home}" ctrl="{home}"/></keyframe>
</mujoco>"""


def _servo(number: int, link: ArmLink) -> str:
    return tag(
        "position",
        name=f"joint{number}",
        joint=f"joint{number}",
        kp=link.stiffness,
        dampratio=1.0,
        inheritrange=1.0,
        forcerange=(-link.torque, link.torque),
    )


def _tube(number: int, link: ArmLink) -> tuple[str, str]:
    """Return the link's tube, which has its mass, and a coloured ring around the joint."""
    wrist = 1 if number >= 5 else 0
    tube = tag(
        "geom",
        name=f"link{number}",
        type="capsule",
        fromto=(0.0, 0.0, 0.0, 0.0, 0.0, link.length),
        size=(link.radius,),
        mass=link.mass,
        contype=wrist,
        rgba=(*_WHITE, 1.0),
    )
    half, r = (link.radius + 0.006, 1.15 * link.radius) if link.axis == "y" else (0.025, link.radius + 0.004)
    along = (0.0, -half, 0.0, 0.0, half, 0.0) if link.axis == "y" else (0.0, 0.0, 0.0, 0.0, 0.0, half)
    colour = _TEAL if link.axis == "y" else _CORAL
    return tube, tag("geom", type="cylinder", fromto=along, size=(r,), mass=0.0, rgba=(*colour, 1.0), group=2)


def _hand() -> tuple[str, ...]:
    """Return palm, two fingers and the end-effector site."""
    fingers = tuple(
        tag(
            "geom",
            name=f"finger_{side}",
            type="box",
            size=(0.012, 0.009, 0.04),
            pos=(0.0, sign * 0.035, 0.08),
            mass=0.05,
            contype=1,
            rgba=(*_CORAL, 1.0),
        )
        for side, sign in (("left", 1), ("right", -1))
    )
    palm = tag(
        "geom",
        name="palm",
        type="box",
        size=(0.03, 0.055, 0.025),
        pos=(0.0, 0.0, 0.02),
        mass=0.4,
        contype=1,
        rgba=(*_DARK, 1.0),
    )
    site = tag("site", name="ee", pos=(0.0, 0.0, EE_OFFSET), size=(0.008,), rgba=(0.2, 0.8, 0.4, 1.0))
    # The same place as a body without mass: task terms name bodies.
    return palm, *fingers, site, tag("body", name="ee", pos=(0.0, 0.0, EE_OFFSET))

"""What every MJCF text of the kit needs: tags from keywords, and hinges whose zero is not the default pose."""

from __future__ import annotations

from collections.abc import Iterable

Rgba = tuple[float, float, float]
"""Red, green, blue in [0, 1]."""


def tag(name: str, /, *children: str, **attributes: str | float | Iterable[float]) -> str:
    """Return the XML element ``name``; numbers are written so that they read back exactly.

    A trailing underscore of an attribute's name is dropped (``class_="foot"``).
    """
    text = "".join(f' {key.rstrip("_")}="{_value(value)}"' for key, value in attributes.items())
    return f"<{name}{text}>{''.join(children)}</{name}>" if children else f"<{name}{text}/>"


def hinge_body(
    name: str,
    *children: str,
    pos: Iterable[float],
    joint: str,
    axis: tuple[float, float, float],
    home: float,
    limits: tuple[float, float],
    armature: float,
    **attributes: str | float,
) -> str:
    """Return a body that turns about one hinge through its origin and is compiled standing at ``home`` (rad).

    ``qpos0`` is then the default pose while joint angle zero keeps its meaning. MuJoCo derives damping ratios and
    other constants at ``qpos0``, so they hold where the robot works and not in a stretched pose it never takes.

    Args:
        name: of the body.
        children: what else is in the body.
        pos: origin in the parent's frame (m).
        joint: name of the joint.
        axis: unit vector in the parent's frame.
        home: default angle (rad).
        limits: lower and upper limit (rad).
        armature: inertia of rotor and gear as seen at the joint (kg m^2).
        attributes: of the body.
    """
    hinge = tag("joint", name=joint, axis=axis, range=limits, ref=home, armature=armature)
    return tag("body", hinge, *children, name=name, pos=pos, axisangle=(*axis, home), **attributes)


def _value(value: str | float | Iterable[float]) -> str:
    if isinstance(value, str):
        return value
    if isinstance(value, (int, float)):
        return repr(value)
    return " ".join(repr(v) for v in value)

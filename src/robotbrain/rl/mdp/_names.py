"""Ranges given by axis."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from robotbrain.errors import InputError

AXES = ("x", "y", "z", "roll", "pitch", "yaw")


def axis_ranges(
    what: str, ranges: Mapping[str, tuple[float, float]], axes: Sequence[str] = AXES
) -> list[tuple[float, float]]:
    """(low, high) for each of ``axes``; an axis that is not given stays at 0.

    Raises:
        InputError: a key that is no axis, or a range whose bounds are swapped.
    """
    for axis, bounds in ranges.items():
        if axis not in axes or len(bounds) != 2 or not bounds[0] <= bounds[1]:
            raise InputError(
                what,
                given={axis: bounds},
                expected=f"(low, high) with low <= high for some of {list(axes)}",
                fix="Correct the axis' name or the order of its bounds.",
            )
    return [ranges.get(axis, (0.0, 0.0)) for axis in axes]

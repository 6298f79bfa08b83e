"""Numbers with units as people type them: ``"3.5 ms"``, ``"0.0035 s"``."""

from __future__ import annotations

import math
import numbers
import re

from robotbrain.errors import InputError

UNITS: dict[str, dict[str, float]] = {
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0},
    "length": {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "km": 1e3},
    "speed": {"m/s": 1.0, "cm/s": 1e-2, "mm/s": 1e-3, "km/h": 1 / 3.6},
    "angle": {"rad": 1.0, "deg": math.pi / 180, "°": math.pi / 180},
    "turn rate": {"rad/s": 1.0, "deg/s": math.pi / 180, "°/s": math.pi / 180},
    "mass": {"kg": 1.0, "g": 1e-3},
    "power": {"W": 1.0, "mW": 1e-3, "kW": 1e3},
    "energy": {"J": 1.0, "mJ": 1e-3, "kJ": 1e3, "Wh": 3600.0},
    "rate": {"Hz": 1.0, "kHz": 1e3, "MHz": 1e6, "GHz": 1e9, "1/s": 1.0, "/s": 1.0},
    "data": {
        "B": 1.0,
        "kB": 1e3,
        "MB": 1e6,
        "GB": 1e9,
        "KiB": 2.0**10,
        "MiB": 2.0**20,
        "GiB": 2.0**30,
        "bit": 1 / 8,
    },
    "data rate": {
        "B/s": 1.0,
        "kB/s": 1e3,
        "MB/s": 1e6,
        "GB/s": 1e9,
        "bit/s": 1 / 8,
        "kbit/s": 1e3 / 8,
        "Mbit/s": 1e6 / 8,
    },
    "arithmetic rate": {
        "FLOPS": 1.0,
        "GFLOPS": 1e9,
        "TFLOPS": 1e12,
        "FLOP/s": 1.0,
        "GFLOP/s": 1e9,
        "TFLOP/s": 1e12,
    },
    "integer rate": {"TOPS": 1e12, "GOPS": 1e9},
    "intensity": {"FLOP/byte": 1.0, "FLOP/B": 1.0},
    "share": {"": 1.0, "%": 1e-2},
    "level": {"dB": 1.0},
}
"""Units by quantity, each with its size in the quantity's first unit."""

_NUMBER = re.compile(r"\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*(.*?)\s*", re.DOTALL)
_SPELLINGS = str.maketrans({"µ": "u", "μ": "u", "−": "-", "\u00a0": " ", "\u202f": " "})


def quantity_of(unit: str) -> str:
    """The quantity that ``unit`` measures; raises :class:`InputError` for an unknown unit."""
    for quantity, units in UNITS.items():
        if unit in units:
            return quantity
    raise InputError("unit", given=unit, expected="a unit such as ms, W or MB", fix="See robotbrain.assessment.units.")


def parse(answer: object, unit: str) -> float:
    """Return ``answer`` as a number in ``unit``.

    Args:
        answer: a number, which is taken to be in ``unit``, or text of a number and a unit of the same quantity.

    Raises:
        InputError: it cannot be read; the message says what would have been.
    """
    if not isinstance(answer, bool) and isinstance(answer, numbers.Real):
        try:
            return _finite(float(answer), answer, unit)
        except OverflowError:
            raise _error(answer, unit) from None
    if not isinstance(answer, str):
        raise _error(answer, unit)
    match = _NUMBER.fullmatch(answer.translate(_SPELLINGS))
    if match is None:
        raise _error(answer, unit)
    number, given = float(match[1]), match[2]
    if not given and unit:
        return _finite(number, answer, unit)
    sizes = UNITS[quantity_of(unit)]
    fitting = [u for u in sizes if u == given] or [u for u in sizes if u.lower() == given.lower()]
    if len({sizes[u] for u in fitting}) != 1:
        raise _error(answer, unit)
    return _finite(number * sizes[fitting[0]] / sizes[unit], answer, unit)


def _finite(number: float, answer: object, unit: str) -> float:
    if not math.isfinite(number):
        raise _error(answer, unit)
    return number


def _error(answer: object, unit: str) -> InputError:
    others = ", ".join(u for u in UNITS[quantity_of(unit)] if u)
    example = f"a number, or text such as {f'2.5 {unit}'.strip()!r}"
    return InputError(
        "answer", given=answer, expected=f"{example} (units: {others})", fix="Write a decimal point, no comma."
    )

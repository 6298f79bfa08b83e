"""What the checks of several lessons share: answers not yet given, and numbers compared."""

from __future__ import annotations

import math
from typing import Any

import numpy as np


def answered(value: Any, name: str) -> Any:
    """Return an answer; an ellipsis is one that is not yet given.

    Raises:
        NotImplementedError: for an ellipsis; the report then says that the exercise is not written yet.
    """
    if value is ...:
        raise NotImplementedError(name)
    return value


def equals(got: Any, right: float) -> bool:
    """Tell whether an answer is this number, within rounding; NaN is wanted where ``right`` is NaN."""
    if isinstance(got, bool) or not isinstance(got, int | float | np.floating | np.integer):
        return False
    return math.isnan(got) if math.isnan(right) else math.isclose(got, right, rel_tol=1e-6, abs_tol=1e-9)

"""Surroundings of a test: prints and warnings are kept out of the cell, random generators begin in a fixed state."""

from __future__ import annotations

import contextlib
import io
import random
import sys
import warnings
from collections.abc import Callable, Iterator

KEPT_OUTPUT = 2_000
"""Characters of a test's prints that a report may show."""


class BoundedText(io.StringIO):
    """Keeps the first characters and forgets the rest, so that printing for ever costs no memory."""

    def __init__(self, limit: int = KEPT_OUTPUT) -> None:
        super().__init__()
        self._limit = self._left = limit

    def write(self, text: str) -> int:
        """Keep what fits."""
        if self._left > 0:
            super().write(text[: self._left])
            self._left -= len(text)
            if self._left <= 0:
                super().write("…")
        return len(text)

    def clear(self) -> None:
        """Forget everything."""
        self.seek(0)
        self.truncate()
        self._left = self._limit


@contextlib.contextmanager
def quiet(output: io.StringIO) -> Iterator[None]:
    """Keep prints and warnings of the student's code out of the cell: they are no mistakes."""
    with (
        contextlib.redirect_stdout(output),
        contextlib.redirect_stderr(output),
        warnings.catch_warnings(),
    ):
        warnings.simplefilter("ignore")
        yield


def seed_generators(*labels: str) -> None:
    """Give global random generators a state that depends on ``labels`` only."""
    seed = sum(ord(c) * (i + 1) for i, c in enumerate("/".join(labels))) % 2**32
    random.seed(seed)
    numpy = sys.modules.get("numpy")  # not imported here: a lab without numpy stays without
    if numpy:
        numpy.random.seed(seed)


def settings_keeper() -> Callable[[], None]:
    """Return a function that puts NumPy's and torch's global settings back to what they are now."""
    numpy, torch = sys.modules.get("numpy"), sys.modules.get("torch")
    errors = numpy.geterr() if numpy else {}
    grad, dtype = (torch.is_grad_enabled(), torch.get_default_dtype()) if torch else (True, None)

    def restore() -> None:
        if numpy:
            numpy.seterr(**errors)
        if torch:
            torch.set_grad_enabled(grad)
            torch.set_default_dtype(dtype)

    return restore


@contextlib.contextmanager
def seeded(*labels: str) -> Iterator[None]:
    """Give global random generators a fixed state, so that a check repeats exactly, and put the old one back."""
    numpy = sys.modules.get("numpy")
    python_state = random.getstate()
    numpy_state = numpy.random.get_state() if numpy else None
    seed_generators(*labels)
    try:
        yield
    finally:
        random.setstate(python_state)
        if numpy:
            numpy.random.set_state(numpy_state)

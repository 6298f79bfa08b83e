"""What all faults have in common: parameters that are checked, draws that repeat, and messages changed as CDR."""

from __future__ import annotations

import dataclasses
import math
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from robotbrain.errors import InputError

if TYPE_CHECKING:
    from robotbrain.ros.context import MessageRecord, SimContext

Remover = Callable[[], None]
Copies = Sequence[tuple[bytes, int]]
Window = tuple[float, float]
"""From and to, s of simulated time."""


def check_number(what: str, value: object, low: float, high: float, fix: str) -> None:
    """Raise InputError unless ``value`` is a number from ``low`` to ``high``."""
    good = isinstance(value, int | float) and not isinstance(value, bool) and low <= value <= high
    if not good:
        raise InputError(what, given=value, expected=f"a number from {low:g} to {high:g}", fix=fix)


class Fault:
    """Base of the faults."""

    def install(self, context: SimContext) -> Remover:
        """Put the fault into a simulation; return a function that takes it out again."""
        raise NotImplementedError


@dataclass(frozen=True)
class MessageFault(Fault):
    """Base of the faults that befall messages between a publisher and its subscriptions.

    Attributes:
        topic: absolute name.
        during: (from, to), s: only then; None: always.
        seed: of what is drawn.
    """

    topic: str
    _: dataclasses.KW_ONLY
    during: Window | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        if not isinstance(self.topic, str) or not (self.topic == "*" or self.topic.startswith("/")):
            raise InputError(
                "topic of a fault", given=self.topic, expected="an absolute name or '*'", fix="Write '/scan'."
            )
        if self.during is not None:
            begin, end = self.during
            check_number("beginning of a fault", begin, 0, math.inf, "Seconds of simulated time.")
            check_number("end of a fault", end, begin, math.inf, "Not before it begins.")
        if isinstance(self.seed, bool) or not isinstance(self.seed, int) or self.seed < 0:
            raise InputError("seed of a fault", given=self.seed, expected="a whole number >= 0", fix="0 is fine.")
        self.check()

    def check(self) -> None:
        """Raise InputError for parameters out of range."""

    def start(self, rng: np.random.Generator) -> Callable[[MessageRecord, bytes], Copies]:
        """Return what befalls the messages of one run; ``rng`` is that run's own."""
        raise NotImplementedError

    def install(self, context: SimContext) -> Remover:
        """Put the fault into a simulation; return a function that takes it out again."""
        words = f"{type(self).__name__} {self.topic}"
        act = self.start(np.random.default_rng([self.seed, zlib.crc32(words.encode())]))
        during = self.during

        def befall(record: MessageRecord, data: bytes) -> Copies:
            if during is not None and not during[0] <= record.released_ns * 1e-9 < during[1]:
                return [(data, 0)]
            return act(record, data)

        return context.add_filter(self.topic, befall)


def edited(record: MessageRecord, data: bytes, edit: Callable[[Any], None]) -> bytes:
    """Return a message after ``edit(message)``, as CDR."""
    from robotbrain.ros import cdr
    from robotbrain.ros.conversions import msg_class

    message = cdr.from_cdr(data, msg_class(record.type_name))
    edit(message)
    return cdr.to_cdr(message)

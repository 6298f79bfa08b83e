"""Faults to inject into a run, to see what a brain makes of them.

Each fault is a description; ``install(context)`` puts it into a simulation and returns a function that takes it out
again. ``drive(seed, attach=[fault.install])`` injects it into a drive; several compose, in the order given. The same
fault with the same ``seed`` does the same in every run: what it draws depends on nothing but that.
"""

from __future__ import annotations

import dataclasses
import math
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from robotbrain.errors import InputError
from robotbrain.monitoring.faults_fields import find_field
from robotbrain.monitoring.trace import is_stamped, stamp_of

if TYPE_CHECKING:
    from numpy.typing import NDArray

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


@dataclass(frozen=True)
class _NumberFault(MessageFault):
    """Base of the faults that change numbers.

    Attributes:
        field: which of the message; None: the usual one of its type, e.g. ``ranges`` of a scan.
    """

    _: dataclasses.KW_ONLY
    field: str | None = None

    def change(self, values: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
        """Return the changed numbers."""
        raise NotImplementedError

    def start(self, rng: np.random.Generator) -> Callable[[MessageRecord, bytes], Copies]:
        """Return what befalls the messages of one run."""

        def act(record: MessageRecord, data: bytes) -> Copies:
            field = find_field(record.type_name, self.field, record.name)

            def edit(message: Any) -> None:
                field.write(message, self.change(field.read(message), rng))

            return [(edited(record, data, edit), 0)]

        return act


@dataclass(frozen=True)
class Noise(_NumberFault):
    """Gaussian noise on a measurement.

    Attributes:
        sigma: standard deviation, in the field's unit (m, rad/s, grey levels …).
    """

    sigma: float = 0.0

    def check(self) -> None:
        """Raise InputError for parameters out of range."""
        check_number("sigma", self.sigma, 0, 1e9, "In the unit of the measurement.")

    def change(self, values: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
        """Return the changed numbers."""
        # Infinity and NaN say something (REP 117) and stay what they are; the draws do not depend on them.
        return values + self.sigma * rng.standard_normal(values.shape)


@dataclass(frozen=True)
class SensorBias(_NumberFault):
    """A sensor that reads too much: ``value * scale + bias``, for instance a gyro's offset or a worn wheel.

    Attributes:
        bias: added; a number, or one for each number of the field, e.g. (0, 0, 0.05) rad/s for a gyro.
        scale: factor.
    """

    bias: float | tuple[float, ...] = 0.0
    scale: float = 1.0

    def check(self) -> None:
        """Raise InputError for parameters out of range."""
        for value in self.bias if isinstance(self.bias, tuple) else (self.bias,):
            check_number("bias", value, -1e9, 1e9, "In the unit of the measurement.")
        check_number("scale", self.scale, -1e3, 1e3, "1.02 reads 2 % too much.")

    def change(self, values: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
        """Return the changed numbers."""
        if isinstance(self.bias, tuple) and len(self.bias) != values.shape[-1]:
            raise InputError(
                f"bias on {self.topic}",
                given=self.bias,
                expected=f"one number, or {values.shape[-1]}",
                fix="Give as many as the field has.",
            )
        return np.asarray(values * self.scale + np.asarray(self.bias), dtype=np.float64)


@dataclass(frozen=True)
class Outliers(_NumberFault):
    """Readings that have nothing to do with what is there.

    Attributes:
        rate: share of the numbers replaced, 0 to 1.
        low, high: they are drawn evenly from here.
    """

    rate: float = 0.01
    low: float = 0.1
    high: float = 8.0

    def check(self) -> None:
        """Raise InputError for parameters out of range."""
        check_number("rate", self.rate, 0, 1, "0.01 is one in a hundred.")
        check_number("low", self.low, -1e9, 1e9, "In the unit of the measurement.")
        check_number("high", self.high, self.low, 1e9, "Not below low.")

    def change(self, values: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
        """Return the changed numbers."""
        hit = rng.random(values.shape) < self.rate
        return np.where(hit, rng.uniform(self.low, self.high, values.shape), values)


@dataclass(frozen=True)
class DropFrames(MessageFault):
    """Messages that get lost, singly or in bursts.

    A two-state Markov chain (E. N. Gilbert, "Capacity of a Burst-Noise Channel", 1960): while it is in the bad state
    all messages are lost.

    Attributes:
        rate: share lost in the long run, 0 to 1.
        burst: mean number lost in a row, >= 1.
    """

    rate: float = 0.1
    burst: float = 1.0

    def check(self) -> None:
        """Raise InputError for parameters out of range."""
        check_number("rate", self.rate, 0, 1, "0.1 loses one in ten.")
        check_number("burst", self.burst, 1, 1e6, "1 is one at a time.")
        if self.rate < 1 and self.rate / (self.burst * (1 - self.rate)) > 1:
            raise InputError(
                "burst",
                given=self.burst,
                expected=f"at least {self.rate / (1 - self.rate):.3g} to lose {self.rate:.0%}",
                fix="Longer bursts, or a lower rate.",
            )

    def start(self, rng: np.random.Generator) -> Callable[[MessageRecord, bytes], Copies]:
        """Return what befalls the messages of one run."""
        bad = bool(rng.random() < self.rate)
        into = 1.0 if self.rate >= 1 else self.rate / (self.burst * (1 - self.rate))

        def act(record: MessageRecord, data: bytes) -> Copies:
            nonlocal bad
            now_bad = bad
            draw = rng.random()
            bad = (self.rate >= 1 or draw >= 1 / self.burst) if bad else draw < into
            return [] if now_bad else [(data, 0)]

        return act


@dataclass(frozen=True)
class LateFrames(MessageFault):
    """Messages that arrive late, and may be overtaken.

    Attributes:
        delay_ms: further delay, ms.
        probability: share of messages that it befalls, 0 to 1.
        jitter_ms: it varies evenly by so much up and down, not below zero, ms.
    """

    delay_ms: float = 100.0
    probability: float = 1.0
    jitter_ms: float = 0.0

    def check(self) -> None:
        """Raise InputError for parameters out of range."""
        check_number("delay_ms", self.delay_ms, 0, 1e7, "Milliseconds.")
        check_number("probability", self.probability, 0, 1, "1 delays all.")
        check_number("jitter_ms", self.jitter_ms, 0, 1e7, "Milliseconds.")

    def start(self, rng: np.random.Generator) -> Callable[[MessageRecord, bytes], Copies]:
        """Return what befalls the messages of one run."""

        def act(record: MessageRecord, data: bytes) -> Copies:
            hit, delay = rng.random() < self.probability, self.delay_ms + self.jitter_ms * rng.uniform(-1, 1)
            return [(data, round(max(0.0, delay) * 1e6) if hit else 0)]

        return act


def _needs_stamp(record: MessageRecord, fault: MessageFault) -> bool:
    """Tell whether a message has a header; raise InputError if the fault names a topic whose messages have none."""
    if is_stamped(record.type_name):
        return True
    if fault.topic == "*":
        return False
    raise InputError(
        f"{type(fault).__name__} on {record.name}",
        given=record.type_name,
        expected="messages with a header",
        fix="Choose a topic whose messages carry a stamp and a frame.",
    )


@dataclass(frozen=True)
class WrongFrameId(MessageFault):
    """Messages that say they are in another frame than they are.

    Attributes:
        frame: what they say.
    """

    frame: str = "wrong_frame"

    def check(self) -> None:
        """Raise InputError for parameters out of range."""
        if not isinstance(self.frame, str):
            raise InputError("frame", given=self.frame, expected="a name", fix="'map', say.")

    def start(self, rng: np.random.Generator) -> Callable[[MessageRecord, bytes], Copies]:
        """Return what befalls the messages of one run."""

        def act(record: MessageRecord, data: bytes) -> Copies:
            if not _needs_stamp(record, self):
                return [(data, 0)]

            def edit(message: Any) -> None:
                message.header.frame_id = self.frame

            return [(edited(record, data, edit), 0)]

        return act


@dataclass(frozen=True)
class StampOffset(MessageFault):
    """A sensor whose clock is off: all its stamps are too late, or too early (negative).

    Attributes:
        offset_ms: ms; stamps before zero become zero.
    """

    offset_ms: float = 0.0

    def check(self) -> None:
        """Raise InputError for parameters out of range."""
        check_number("offset_ms", self.offset_ms, -1e9, 1e9, "Milliseconds.")

    def start(self, rng: np.random.Generator) -> Callable[[MessageRecord, bytes], Copies]:
        """Return what befalls the messages of one run."""
        offset = round(self.offset_ms * 1e6)

        def act(record: MessageRecord, data: bytes) -> Copies:
            if not _needs_stamp(record, self):
                return [(data, 0)]
            stamp = max(0, stamp_of(data) + offset)
            return [(restamped(data, stamp), 0)]

        return act


def restamped(data: bytes, stamp_ns: int) -> bytes:
    """Return a stamped message's CDR with another stamp."""
    seconds, nanoseconds = divmod(stamp_ns, 1_000_000_000)
    order = "little" if data[1] & 1 else "big"
    head = seconds.to_bytes(4, order, signed=True) + nanoseconds.to_bytes(4, order)  # type: ignore[arg-type]
    return data[:4] + head + data[12:]


@dataclass(frozen=True)
class FrozenSensor(MessageFault):
    """A sensor that hangs: it goes on publishing its last measurement, with fresh stamps.

    Without ``during`` it hangs from its first message on.
    """

    def start(self, rng: np.random.Generator) -> Callable[[MessageRecord, bytes], Copies]:
        """Return what befalls the messages of one run."""
        last: dict[str, bytes] = {}

        def act(record: MessageRecord, data: bytes) -> Copies:
            kept = last.setdefault(record.name, data)
            if is_stamped(record.type_name):
                kept = restamped(kept, stamp_of(data))
            return [(kept, 0)]

        return act


@dataclass(frozen=True)
class Blackout(MessageFault):
    """Nothing comes any more, for a while (``during``) or for good."""

    def start(self, rng: np.random.Generator) -> Callable[[MessageRecord, bytes], Copies]:
        """Return what befalls the messages of one run."""
        return lambda record, data: []

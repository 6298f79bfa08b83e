"""Faults that befall whole messages: lost, late, mislabelled, frozen."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from robotbrain.errors import InputError
from robotbrain.monitoring.faults_base import Copies, MessageFault, check_number, edited
from robotbrain.monitoring.trace import is_stamped, stamp_of

if TYPE_CHECKING:
    from robotbrain.ros.context import MessageRecord


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

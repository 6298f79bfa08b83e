"""Alarms: something is late, silent or too slow. Each is raised once and cleared once, with hysteresis in between."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from robotbrain.errors import InputError

AlarmKind = Literal["deadline", "stale", "rate"]


@dataclass(frozen=True)
class Alarm:
    """An alarm that was raised or cleared.

    Attributes:
        kind: ``deadline``, ``stale`` or ``rate``.
        subject: callback or topic.
        active: raised (True) or cleared (False).
        time_s: on the monitor's clock.
        text: what to read out.
    """

    kind: AlarmKind
    subject: str
    active: bool
    time_s: float
    text: str


@dataclass(frozen=True)
class AlarmRules:
    """When alarms are raised and cleared.

    Attributes:
        deadline_raise: deadlines missed in a row that raise an alarm, >= 1.
        deadline_clear: deadlines kept in a row that clear it, >= 1.
        stale_s: by topic: silence that raises an alarm, s. The second message after it clears it.
        min_hz: by topic: rate below which an alarm is raised; ``rate_margin`` above, it is cleared.
        rate_margin: >= 0, 0.1 by default.

    Raises:
        InputError: for values out of these ranges.
    """

    deadline_raise: int = 3
    deadline_clear: int = 10
    stale_s: tuple[tuple[str, float], ...] = ()
    min_hz: tuple[tuple[str, float], ...] = ()
    rate_margin: float = 0.1

    def __post_init__(self) -> None:
        for name in ("deadline_raise", "deadline_clear"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or value < 1:
                raise InputError(name, given=value, expected="a whole number >= 1", fix="3 misses in a row is usual.")
        for name in ("stale_s", "min_hz"):
            rules = getattr(self, name)
            # A mapping reads better where it is written; pairs are what can be compared and hashed.
            pairs = tuple(rules.items()) if isinstance(rules, dict) else tuple(rules)
            object.__setattr__(self, name, pairs)
            for topic, limit in pairs:
                if not isinstance(topic, str) or not 0 < limit < math.inf:
                    raise InputError(
                        name, given=(topic, limit), expected="(topic, number > 0)", fix="For instance {'/scan': 0.3}."
                    )
        if not 0 <= self.rate_margin < math.inf:
            raise InputError("rate_margin", given=self.rate_margin, expected="0 or more", fix="0.1 is usual.")


class _Streak:
    """Raises after so many bad ones in a row, clears after so many good ones."""

    __slots__ = ("active", "bad", "good")

    def __init__(self) -> None:
        self.active, self.bad, self.good = False, 0, 0

    def add(self, bad: bool, raise_after: int, clear_after: int) -> bool | None:
        """Return True when raised, False when cleared, None when nothing changed."""
        self.bad, self.good = (self.bad + 1, 0) if bad else (0, self.good + 1)
        if not self.active and self.bad >= raise_after:
            self.active = True
            return True
        if self.active and self.good >= clear_after:
            self.active = False
            return False
        return None


class AlarmBoard:
    """Decides when alarms are raised and cleared. Times are in ns on one clock that does not run backwards.

    Args:
        rules: see there.
        start_ns: from when silence counts.
    """

    def __init__(self, rules: AlarmRules, start_ns: int = 0) -> None:
        self.rules = rules
        self._stale = dict(rules.stale_s)
        self._min_hz = dict(rules.min_hz)
        self._last_ns = dict.fromkeys(self._stale, start_ns)
        self._back: dict[str, int] = {}
        self._count = dict.fromkeys(self._min_hz, 0)
        self._since_ns = dict.fromkeys(self._min_hz, start_ns)
        self._streaks: dict[str, _Streak] = {}
        self.active: dict[tuple[AlarmKind, str], Alarm] = {}

    def restart(self, now_ns: int) -> None:
        """Let silence and rates count from now on."""
        self._last_ns = dict.fromkeys(self._stale, now_ns)
        self._count = dict.fromkeys(self._min_hz, 0)
        self._since_ns = dict.fromkeys(self._min_hz, now_ns)

    def call(self, label: str, missed: bool, taken_ms: float, deadline_ms: float, now_ns: int) -> list[Alarm]:
        """Note a call that has a deadline."""
        streak = self._streaks.get(label)
        if streak is None:
            streak = self._streaks[label] = _Streak()
        change = streak.add(missed, self.rules.deadline_raise, self.rules.deadline_clear)
        if change is None:
            return []
        text = (
            f"{label} missed its deadline of {deadline_ms:g} ms {self.rules.deadline_raise} times in a row, "
            f"most recently by {taken_ms - deadline_ms:.1f} ms"
            if change
            else f"{label} keeps its deadline of {deadline_ms:g} ms again"
        )
        return [self._set("deadline", label, change, now_ns, text)]

    def message(self, topic: str, now_ns: int) -> list[Alarm]:
        """Note a message."""
        if topic in self._count:
            self._count[topic] += 1
        if topic not in self._stale:
            return []
        self._last_ns[topic] = now_ns
        if ("stale", topic) in self.active:
            self._back[topic] = self._back.get(topic, 0) + 1
            if self._back[topic] >= 2:
                self._back[topic] = 0
                return [self._set("stale", topic, False, now_ns, f"{topic} is back")]
        return []

    def tick(self, now_ns: int) -> list[Alarm]:
        """Look at the clock; call it a few times a second."""
        changes = []
        for topic, limit in self._stale.items():
            silence = (now_ns - self._last_ns[topic]) * 1e-9
            if silence > limit:
                self._back[topic] = 0
                if ("stale", topic) not in self.active:
                    text = f"{topic} has been silent for {silence:.2f} s (limit {limit:g} s)"
                    changes.append(self._set("stale", topic, True, now_ns, text))
        changes += self._rates(now_ns)
        return changes

    def _rates(self, now_ns: int) -> list[Alarm]:
        changes = []
        for topic, limit in self._min_hz.items():
            elapsed = (now_ns - self._since_ns[topic]) * 1e-9
            # Long enough that one message more or less does not matter.
            if elapsed < max(1.0, 10 / limit):
                continue
            rate = self._count[topic] / elapsed
            active = ("rate", topic) in self.active
            if not active and rate < limit:
                text = f"{topic} comes {rate:.1f} times a second (limit {limit:g} Hz)"
                changes.append(self._set("rate", topic, True, now_ns, text))
            elif active and rate >= limit * (1 + self.rules.rate_margin):
                text = f"{topic} comes {rate:.1f} times a second again"
                changes.append(self._set("rate", topic, False, now_ns, text))
            self._count[topic], self._since_ns[topic] = 0, now_ns
        return changes

    def _set(self, kind: AlarmKind, subject: str, active: bool, now_ns: int, text: str) -> Alarm:
        alarm = Alarm(kind, subject, active, now_ns * 1e-9, text)
        if active:
            self.active[kind, subject] = alarm
        else:
            self.active.pop((kind, subject), None)
        return alarm

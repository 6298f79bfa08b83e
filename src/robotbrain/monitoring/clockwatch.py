"""Noticing that a clock jumped: NTP stepped it, somebody set it, or a bag that gives ``/clock`` started again."""

from __future__ import annotations


class ClockWatch:
    """Compares a clock with one that cannot jump.

    Args:
        name: of the clock, for messages.
        tolerance_s: by how much the two may drift apart between two looks; > 0.
        steady: whether the clock runs at the rate of real time. One that does not (simulated time) is only watched for
            going back.

    Attributes:
        jumps: how many were seen.
    """

    def __init__(self, name: str, tolerance_s: float = 0.05, *, steady: bool = True) -> None:
        self.name, self.tolerance_ns, self.steady = name, round(tolerance_s * 1e9), steady
        self.jumps = 0
        self._last: tuple[int, int] | None = None

    def look(self, clock_ns: int, monotonic_ns: int) -> str | None:
        """Note both clocks; return what happened if the clock jumped since the last look, else None."""
        last, self._last = self._last, (clock_ns, monotonic_ns)
        if last is None:
            return None
        step = clock_ns - last[0]
        jump = step - (monotonic_ns - last[1]) if self.steady else min(0, step)
        if abs(jump) <= (self.tolerance_ns if self.steady else 0):
            return None
        self.jumps += 1
        way = "forward" if jump > 0 else "back"
        return (
            f"{self.name} jumped {way} by {abs(jump) * 1e-9:.3f} s; ages across the jump mean nothing and are left out"
        )

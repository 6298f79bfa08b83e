"""The transforms of one child frame over time."""

from __future__ import annotations

import bisect
from typing import NamedTuple

from robotbrain.ros.tf2.exceptions import ExtrapolationException
from robotbrain.ros.tf2.rotation import Quaternion, Vector, lerp, slerp


class Sample(NamedTuple):
    """A child frame in its parent at one time (ns)."""

    stamp_ns: int
    parent: str
    translation: Vector
    rotation: Quaternion


def seconds(time_ns: int) -> str:
    """Return a time as tf2 prints it: seconds with six decimals."""
    whole, rest = divmod(time_ns, 1_000_000_000)
    return f"{whole + 1e-9 * rest:.6f}"


class TimeCache:
    """Samples of a moving frame, oldest first.

    Samples with the same stamp stay in order of arrival; an exact repetition is dropped. What is more than ``keep_ns``
    older than the newest sample goes when the next one arrives (not at once: so it is in tf2).
    """

    static = False

    def __init__(self, keep_ns: int) -> None:
        self.keep_ns = keep_ns
        self._stamps: list[int] = []
        self._samples: list[Sample] = []

    def __len__(self) -> int:
        return len(self._samples)

    def insert(self, sample: Sample) -> bool:
        """Add a sample at its place in time; return False when it is older than the cache reaches back."""
        stamps = self._stamps
        if stamps:
            horizon = stamps[-1] - self.keep_ns
            expired = bisect.bisect_left(stamps, horizon)
            if expired:
                del stamps[:expired], self._samples[:expired]
            if sample.stamp_ns < horizon:
                return False
        end = bisect.bisect_right(stamps, sample.stamp_ns)
        index = end
        while index and stamps[index - 1] == sample.stamp_ns:
            index -= 1
            if self._samples[index] == sample:
                return True
        stamps.insert(end, sample.stamp_ns)
        self._samples.insert(end, sample)
        return True

    def at(self, time_ns: int) -> Sample:
        """Return the sample at a time, interpolated between its neighbours; time 0 is the newest.

        Raises:
            ExtrapolationException: the time is not covered.
        """
        stamps = self._stamps
        if not stamps:
            raise _not_covered(time_ns, 0)
        if time_ns == 0:
            return self._samples[-1]
        if len(stamps) == 1:
            if stamps[0] != time_ns:
                raise _not_covered(time_ns, stamps[0])
            return self._samples[0]
        if time_ns > stamps[-1]:
            raise ExtrapolationException(
                f"Lookup would require extrapolation into the future.  Requested time {seconds(time_ns)} "
                f"but the latest data is at time {seconds(stamps[-1])}"
            )
        if time_ns < stamps[0]:
            raise ExtrapolationException(
                f"Lookup would require extrapolation into the past.  Requested time {seconds(time_ns)} "
                f"but the earliest data is at time {seconds(stamps[0])}"
            )
        if time_ns == stamps[0] != stamps[-1]:
            return self._samples[0]
        index = bisect.bisect_right(stamps, time_ns) - 1
        older = self._samples[index]
        if older.stamp_ns == time_ns or older.parent != self._samples[index + 1].parent:
            # A frame that was handed to another parent in between jumps: it is where it was last seen.
            return older
        newer = self._samples[index + 1]
        ratio = (time_ns - older.stamp_ns) / (newer.stamp_ns - older.stamp_ns)
        return Sample(
            time_ns,
            older.parent,
            lerp(older.translation, newer.translation, ratio),
            slerp(older.rotation, newer.rotation, ratio),
        )

    def latest(self) -> tuple[int, str | None]:
        """Return stamp and parent of the newest sample, (0, None) when empty."""
        return (self._stamps[-1], self._samples[-1].parent) if self._stamps else (0, None)

    @property
    def span_ns(self) -> tuple[int, int]:
        """Stamps of the oldest and the newest sample, zeros when empty."""
        return (self._stamps[0], self._stamps[-1]) if self._stamps else (0, 0)

    def clear(self) -> None:
        """Forget every sample."""
        self._stamps.clear()
        self._samples.clear()


class StaticCache:
    """A frame that does not move: one sample, valid at every time."""

    static = True
    span_ns = (0, 0)

    def __init__(self) -> None:
        self._sample: Sample | None = None

    def __len__(self) -> int:
        return 1

    def insert(self, sample: Sample) -> bool:
        """Replace the transform."""
        self._sample = sample
        return True

    def at(self, time_ns: int) -> Sample:
        """Return the transform, whatever the time."""
        assert self._sample is not None
        return self._sample

    def latest(self) -> tuple[int, str | None]:
        """Return 0 (always valid) and the parent."""
        assert self._sample is not None
        return 0, self._sample.parent

    def clear(self) -> None:
        """Keep the transform: it does not age."""


def _not_covered(wanted_ns: int, only_ns: int) -> ExtrapolationException:
    return ExtrapolationException(
        f"Lookup would require extrapolation at time {seconds(wanted_ns)}, "
        f"but only time {seconds(only_ns)} is in the buffer"
    )

"""Snapshots of a running brain, and their log on disk."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, cast

from robotbrain.monitoring.distribution import none_if_nan


@dataclass(frozen=True)
class Glance:
    """Something timed, over the recent past: how often a second, median and 99th percentile in ms, misses in all."""

    rate_hz: float
    p50_ms: float
    p99_ms: float
    misses: int = 0


@dataclass(frozen=True)
class Snapshot:
    """How a brain was doing at one time; rates and percentiles are those of the last window or two.

    Attributes:
        time_s: on the monitor's clock, from when it began to watch.
        callbacks: response (or latency, where that is all that is known) by label.
        topics: messages a second.
        queues: messages waiting or, in wall-clock time, nothing; by ``"node topic"``.
        chains: age by ``"a > b > c"``.
        spans: by name.
        utilisation: share of each resource since the last snapshot.
        resources: readings of the machine by name; what is missing is not there.
        alarms: that are active.
    """

    time_s: float
    callbacks: Mapping[str, Glance] = field(default_factory=dict)
    topics: Mapping[str, float] = field(default_factory=dict)
    queues: Mapping[str, int] = field(default_factory=dict)
    chains: Mapping[str, Glance] = field(default_factory=dict)
    spans: Mapping[str, Glance] = field(default_factory=dict)
    utilisation: Mapping[str, float] = field(default_factory=dict)
    resources: Mapping[str, float] = field(default_factory=dict)
    alarms: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Return the snapshot as plain data for JSON; numbers that do not exist are None."""
        plain = _plain(self)
        assert isinstance(plain, dict)
        return plain


def _plain(value: Any) -> Any:
    if hasattr(value, "__dataclass_fields__"):
        return {name: _plain(getattr(value, name)) for name in value.__dataclass_fields__}
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, tuple):
        return [_plain(item) for item in value]
    return none_if_nan(value) if isinstance(value, float) else value


def open_unbuffered(path: Path) -> BinaryIO:
    """Open a file to append bytes that go straight to the system."""
    return cast(BinaryIO, path.open("ab", buffering=0))


class SnapshotLog:
    """One JSON object a line, appended and flushed at once, so that little is lost when the program dies.

    A disk that is full, or a place that is not there, does not hurt: writing pauses, ``problem`` says why, and after
    ``retry`` snapshots it is tried again. A line that was cut short is followed by a line break, so that the lines
    after it can be read.

    Args:
        path: of the file; it is appended to.
        retry: snapshots to leave out after a failure, >= 0.

    Attributes:
        written: snapshots in the file.
        lost: snapshots that could not be written.
        problem: what went wrong last, empty if nothing did.
    """

    def __init__(self, path: str | Path, retry: int = 10) -> None:
        self.path = Path(path)
        self.retry = retry
        self.written = self.lost = 0
        self.problem = ""
        self._file: BinaryIO | None = None
        self._pause = 0
        self._torn = False

    def write(self, snapshot: Snapshot) -> bool:
        """Append a snapshot; return whether it is in the file."""
        if self._pause:
            self._pause -= 1
            self.lost += 1
            return False
        try:
            if self._file is None:
                self.path.parent.mkdir(parents=True, exist_ok=True)
                # Without a buffer nothing is left behind that a later write or close would trip over.
                self._file = open_unbuffered(self.path)
            line = json.dumps(snapshot.to_dict(), allow_nan=False, separators=(",", ":"))
            data = (("\n" if self._torn else "") + line + "\n").encode()
            while data:
                data = data[self._file.write(data) :]
        except OSError as error:
            self._fail(error)
            return False
        self._torn = False
        self.written += 1
        return True

    def _fail(self, error: OSError) -> None:
        self.lost += 1
        self._pause = self.retry
        self._torn = True
        reason = error.strerror or str(error)
        self.problem = (
            f"snapshots cannot be logged to {self.path.name}: {reason}. Watching goes on; make room or choose another "
            f"place. Tried again after {self.retry} more snapshots."
        )
        self.close()

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            with contextlib.suppress(OSError):
                self._file.close()
            self._file = None

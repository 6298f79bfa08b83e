"""A thread that reads a source at a steady rate and survives whatever the source does."""

from __future__ import annotations

import threading
import time
from collections import deque

from robotbrain.errors import InputError
from robotbrain.monitoring.resources.reading import Reading, Source, nothing

_PATIENCE = 3.0  # periods without an answer after which a source counts as stale


class Sampler:
    """Reads a source every period, on a grid that does not drift, and keeps the last readings.

    A source that raises is asked again; one that hangs or ends the thread is stale: :attr:`latest` then holds nothing
    but the reason. Use it with ``with``, or call :meth:`start` and :meth:`stop`.

    Args:
        source: to read.
        period_s: > 0.
        keep: readings, >= 1.

    Attributes:
        source: that is read.
        period_s: of the readings.
        errors: readings that failed.
        skipped: places of the grid that went by while a reading took longer.
        last_error: of the last one that failed, empty if none did.

    Raises:
        InputError: for values out of these ranges.
    """

    def __init__(self, source: Source, period_s: float = 0.5, keep: int = 600) -> None:
        if not 0 < period_s < float("inf"):
            raise InputError("period_s", given=period_s, expected="seconds > 0", fix="0.5 reads twice a second.")
        if isinstance(keep, bool) or not isinstance(keep, int) or keep < 1:
            raise InputError("keep", given=keep, expected="a whole number >= 1", fix="600 is the default.")
        self.source, self.period_s = source, float(period_s)
        self.errors = self.skipped = 0
        self.last_error = ""
        self._history: deque[Reading] = deque(maxlen=keep)
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._answered_s = time.monotonic()

    def start(self) -> Sampler:
        """Start reading, unless it does; return itself."""
        if self._thread is None:
            self._stop.clear()
            self._answered_s = time.monotonic()
            self._thread = threading.Thread(target=self._run, name=f"sampler {self.source.name}", daemon=True)
            self._thread.start()
        return self

    def stop(self, timeout_s: float = 2.0) -> bool:
        """Stop reading and close the source; return False if a reading hangs and its thread had to be left behind."""
        self._stop.set()
        thread, self._thread = self._thread, None
        if thread is not None and thread is not threading.current_thread():
            thread.join(timeout_s)
            if thread.is_alive():
                return False
        self.source.close()
        return True

    def __enter__(self) -> Sampler:
        return self.start()

    def __exit__(self, *exception: object) -> None:
        self.stop()

    def _run(self) -> None:
        stop = self._stop
        began, place = time.monotonic(), 0
        try:
            while not stop.is_set():
                self._read_once()
                place += 1
                behind = int((time.monotonic() - began) / self.period_s) - place + 1
                if behind > 0:
                    # Readings that are overdue are left out: two at once would say nothing new.
                    self.skipped += behind
                    place += behind
                if stop.wait(max(0.0, began + place * self.period_s - time.monotonic())):
                    return
        except BaseException as error:
            # SystemExit and the like: the thread ends, quietly; from then on the source is stale.
            self.last_error = f"the sampler's thread ended: {type(error).__name__}: {error}"
            self.errors += 1

    def _read_once(self) -> None:
        try:
            reading = self.source.read()
        except Exception as error:
            self.errors += 1
            self.last_error = f"{type(error).__name__}: {error}"
            return
        with self._lock:
            self._history.append(reading)
            self._answered_s = time.monotonic()

    @property
    def alive(self) -> bool:
        """Whether the thread is running."""
        return self._thread is not None and self._thread.is_alive()

    @property
    def stale(self) -> str:
        """Why the newest reading is out of date; empty while it is not."""
        silent = time.monotonic() - self._answered_s
        if self.alive and silent <= _PATIENCE * self.period_s:
            return ""
        if self._thread is None:
            return "the sampler is not running"
        why = f" ({self.last_error})" if self.last_error else ""
        what = "has not answered" if self.alive else "ended its thread; no answer"
        return f"{self.source.name} {what} for {silent:.1f} s{why}"

    @property
    def latest(self) -> Reading | None:
        """The newest reading, None before the first; once it is out of date, a reading in which all is missing."""
        with self._lock:
            newest = self._history[-1] if self._history else None
        reason = self.stale
        if not reason:
            return newest
        return nothing(self.source.name, reason, time.monotonic() if newest is None else newest.time_s)

    @property
    def history(self) -> list[Reading]:
        """The last readings, oldest first."""
        with self._lock:
            return list(self._history)

"""Spinning in a second thread, as programs for genuine rclpy do.

There is one simulation, and its events happen one after the other whichever thread lets time run. A program that spins
in a thread of its own means: "callbacks go on while I wait". So the thread that called ``rclpy.init`` stays the one
that lets time run, by what it waits with (``client.call``, ``rate.sleep``, ``wait_for_message``, ``clock.sleep_for``,
another ``spin``), and callbacks run meanwhile, in that thread; a spin in another thread only waits for the end. It lets
time run itself while the first thread waits for a thread or an event (``join``, ``Event.wait``), or has ended.

Simulated time stands while the first thread computes or sleeps in wall-clock time (``time.sleep``).
"""

from __future__ import annotations

import sys
import threading
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from robotbrain.ros.context import SimContext

LOOK_S = 0.005
"""How often a spin in a second thread looks whether it is wanted, in wall-clock seconds."""


class Driver:
    """Which thread lets time run, and a lock that only one at a time can do it with.

    Attributes:
        lock: held while events are processed.
        owner: the thread to whose waiting others give way.
        ended: set at shutdown.
    """

    def __init__(self) -> None:
        self.lock = threading.RLock()
        self.owner = threading.get_ident()
        self.ended = threading.Event()
        self._gave_way = False

    def take(self) -> None:
        """Make the calling thread the owner."""
        self.owner = threading.get_ident()

    def is_mine(self) -> bool:
        """Tell whether the calling thread is the owner."""
        return threading.get_ident() == self.owner

    def inside(self) -> bool:
        """Tell whether the calling thread is the one that processes events now."""
        return bool(self.lock._is_owned())  # type: ignore[attr-defined]

    def owner_waits(self) -> bool:
        """Tell whether the owner has ended or waits for something of the ``threading`` module."""
        frame = sys._current_frames().get(self.owner)
        if frame is None:
            return True
        names = []
        while frame is not None and frame.f_code.co_filename == threading.__file__:
            names.append(frame.f_code.co_name)
            frame = frame.f_back
        return bool(names) and "start" not in names  # starting a thread waits for its first breath

    def give_way(self, context: SimContext) -> bool:
        """Wait until the calling thread should let time run; return False when the context has been shut down."""
        while context.ok():
            waits = self.owner_waits()
            if waits and self._gave_way:
                return True
            # Only what is seen twice is a wait.
            self._gave_way = waits
            self.ended.wait(LOOK_S)
        return False

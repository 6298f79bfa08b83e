"""``rclpy.experimental``: the events executor. The kit's executors are all driven by events."""

from __future__ import annotations

from robotbrain.ros.executors import SingleThreadedExecutor

__all__ = ["EventsExecutor"]


class EventsExecutor(SingleThreadedExecutor):
    """One callback at a time, as :class:`SingleThreadedExecutor`."""

"""Bags: recordings in the rosbag2 format (MCAP storage) that genuine ROS 2 tools open, and their replay.

- :class:`BagWriter` writes messages as they come, from any process; it survives ``kill -9`` and a full disk.
- :class:`BagRecorder` records a simulated context.
- :func:`open_bag` reads a bag, also an unfinished one, also sqlite3; :func:`recover` makes an unfinished one whole.
- :func:`replay` publishes a bag in simulated time, :func:`replay_wall` in real time.

The names load their modules when first used: importing this package costs nothing.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from robotbrain.ros.bag.player import Replay, replay, replay_wall
    from robotbrain.ros.bag.reader import BagMessage, BagReader, open_bag
    from robotbrain.ros.bag.recorder import BagRecorder
    from robotbrain.ros.bag.recovery import Recovery, recover
    from robotbrain.ros.bag.source import BagTopic
    from robotbrain.ros.bag.writer import BagWriter

_WHERE = {
    "BagMessage": "reader",
    "BagReader": "reader",
    "BagRecorder": "recorder",
    "BagTopic": "source",
    "BagWriter": "writer",
    "Recovery": "recovery",
    "Replay": "player",
    "open_bag": "reader",
    "recover": "recovery",
    "replay": "player",
    "replay_wall": "player",
}

__all__ = [
    "BagMessage",
    "BagReader",
    "BagRecorder",
    "BagTopic",
    "BagWriter",
    "Recovery",
    "Replay",
    "open_bag",
    "recover",
    "replay",
    "replay_wall",
]


def __getattr__(name: str) -> Any:
    if name not in _WHERE:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"{__name__}.{_WHERE[name]}"), name)
    globals()[name] = value
    return value

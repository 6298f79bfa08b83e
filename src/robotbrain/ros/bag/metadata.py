"""What rosbag2 says about a bag besides its messages: ``metadata.yaml`` (version 9) and QoS profiles."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any, NamedTuple

from robotbrain.ros.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    LivelinessPolicy,
    QoSProfile,
    ReliabilityPolicy,
)
from robotbrain.ros.time import Duration

VERSION = 9
DISTRO = "kilted"  # whose message definitions the kit writes
INFINITE_NS = 2**63 - 1
"""No deadline, lifespan or lease: as rmw says it. A profile of the kit says 0."""


class TopicRecord(NamedTuple):
    """A topic as the metadata list it: QoS profiles offered, RIHS01 hash of its type, and messages."""

    name: str
    typename: str
    qos: tuple[QoSProfile, ...]
    type_hash: str
    messages: int


class FileRecord(NamedTuple):
    """A storage file of a bag: its name, first and last stamp (ns), and messages."""

    name: str
    start_ns: int
    end_ns: int
    messages: int


def metadata_yaml(files: Sequence[FileRecord], topics: Sequence[TopicRecord], storage: str = "mcap") -> str:
    """Return the text of ``metadata.yaml``."""
    return "rosbag2_bagfile_information:\n" + _block(information(files, topics, storage), 1)


def serialized_metadata(files: Sequence[FileRecord], topics: Sequence[TopicRecord]) -> str:
    """Return what an MCAP file holds of it (the record called ``rosbag2``), for tools given the file alone."""
    return _block(information(files, topics, "mcap"), 0)


def information(files: Sequence[FileRecord], topics: Sequence[TopicRecord], storage: str) -> dict[str, Any]:
    """Return the metadata as plain data."""
    filled = [file for file in files if file.messages]
    start = min((file.start_ns for file in filled), default=0)
    end = max((file.end_ns for file in filled), default=0)
    return {
        "version": VERSION,
        "storage_identifier": storage,
        "duration": {"nanoseconds": end - start},
        "starting_time": {"nanoseconds_since_epoch": start},
        "message_count": sum(file.messages for file in files),
        "topics_with_message_count": [
            {
                "topic_metadata": {
                    "name": topic.name,
                    "type": topic.typename,
                    "serialization_format": "cdr",
                    "offered_qos_profiles": [qos_plain(profile) for profile in topic.qos],
                    "type_description_hash": topic.type_hash,
                },
                "message_count": topic.messages,
            }
            for topic in topics
        ],
        "compression_format": "",
        "compression_mode": "",
        "relative_file_paths": [file.name for file in files],
        "files": [
            {
                "path": file.name,
                "starting_time": {"nanoseconds_since_epoch": file.start_ns},
                "duration": {"nanoseconds": file.end_ns - file.start_ns},
                "message_count": file.messages,
            }
            for file in files
        ],
        "custom_data": None,
        "ros_distro": DISTRO,
    }


# ---------------------------------------------------------------- QoS


def qos_plain(profile: QoSProfile) -> dict[str, Any]:
    """Return a profile as rosbag2 spells it."""
    return {
        "history": profile.history.name.lower(),
        "depth": profile.depth,
        "reliability": profile.reliability.name.lower(),
        "durability": profile.durability.name.lower(),
        "deadline": _span(profile.deadline),
        "lifespan": _span(profile.lifespan),
        "liveliness": profile.liveliness.name.lower(),
        "liveliness_lease_duration": _span(profile.liveliness_lease_duration),
        "avoid_ros_namespace_conventions": profile.avoid_ros_namespace_conventions,
    }


def qos_yaml(profiles: Sequence[QoSProfile]) -> str:
    """Return profiles as the YAML list that an MCAP channel holds."""
    return _block([qos_plain(profile) for profile in profiles], 0).rstrip("\n") if profiles else ""


def qos_from_rosbags(found: Sequence[Any]) -> tuple[QoSProfile, ...]:
    """Return profiles that rosbags has parsed (from any version of the metadata) as profiles of the kit."""
    return tuple(
        QoSProfile(
            history=_policy(HistoryPolicy, one.history),
            depth=int(one.depth),
            reliability=_policy(ReliabilityPolicy, one.reliability),
            durability=_policy(DurabilityPolicy, one.durability),
            deadline=_duration(one.deadline),
            lifespan=_duration(one.lifespan),
            liveliness=_policy(LivelinessPolicy, one.liveliness),
            liveliness_lease_duration=_duration(one.liveliness_lease_duration),
            avoid_ros_namespace_conventions=bool(one.avoid_ros_namespace_conventions),
        )
        for one in found
    )


def qos_from_yaml(text: str) -> tuple[QoSProfile, ...]:
    """Return the profiles in the YAML of an MCAP channel; none when it cannot be read."""
    from rosbags.rosbag2.errors import ReaderError
    from rosbags.rosbag2.metadata import parse_qos

    try:
        return qos_from_rosbags(parse_qos(text))
    except (ReaderError, KeyError, TypeError, ValueError):
        return ()


def _span(duration: Duration) -> dict[str, int]:
    sec, nsec = divmod(duration.nanoseconds or INFINITE_NS, 10**9)
    return {"sec": sec, "nsec": nsec}


def _duration(span: Any) -> Duration:
    total = int(span.sec) * 10**9 + int(span.nsec)
    return Duration() if not 0 < total < INFINITE_NS else Duration(nanoseconds=total)


def _policy(kind: Any, found: Any) -> Any:
    members = kind.__members__
    return members[found.name] if found.name in members else members["UNKNOWN"]


# ---------------------------------------------------------------- YAML


def _block(value: Any, level: int) -> str:
    """Return plain data as block YAML; scalars are written as JSON, which YAML reads."""
    pad = "  " * level
    if isinstance(value, dict):
        return "".join(f"{pad}{key}:{_after(item, level)}" for key, item in value.items())
    items = []
    for item in value:
        text = _block(item, level + 1) if isinstance(item, (dict, list)) else f"{pad}  {json.dumps(item)}\n"
        items.append(f"{pad}- {text[len(pad) + 2 :]}")
    return "".join(items)


def _after(item: Any, level: int) -> str:
    if isinstance(item, (dict, list)) and item:
        return "\n" + _block(item, level + 1)
    return " []\n" if isinstance(item, list) else f" {json.dumps(item)}\n"

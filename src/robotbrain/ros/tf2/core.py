"""The buffer core of tf2: a forest of frames, each with its history, and lookups between any two of them."""

from __future__ import annotations

import math
import threading
from typing import Any

from robotbrain.ros.context import SimContext, active_context, peek_default_context
from robotbrain.ros.conversions import msg_class, ns_to_time
from robotbrain.ros.logging import LoggingSeverity, RcutilsLogger
from robotbrain.ros.tf2.cache import Sample, seconds
from robotbrain.ros.tf2.exceptions import (
    ConnectivityException,
    ExtrapolationException,
    InvalidArgumentException,
    LookupException,
    TimeoutException,
    TransformException,
)
from robotbrain.ros.tf2.forest import Forest, Rigid
from robotbrain.ros.tf2.rotation import IDENTITY, ZERO, Quaternion, Vector, canonical, compose
from robotbrain.ros.time import Duration, Time

__all__ = [
    "BufferCore",
    "ConnectivityException",
    "ExtrapolationException",
    "InvalidArgumentException",
    "LookupException",
    "TimeoutException",
    "TransformException",
]

DEFAULT_CACHE_TIME_NS = 10_000_000_000


def to_ns(time: Any) -> int:
    """Return a ``Time``, ``Duration`` or a message with ``sec`` and ``nanosec`` as ns.

    Raises:
        TypeError: something else, such as a float of seconds.
    """
    if hasattr(time, "sec") and hasattr(time, "nanosec"):
        return int(time.sec) * 1_000_000_000 + int(time.nanosec)
    if hasattr(time, "nanoseconds"):
        return int(time.nanoseconds)
    raise TypeError(
        f"time must have sec and nanosec, or nanoseconds; got {time!r}. Pass rclpy.time.Time(seconds=...) or "
        "msg.header.stamp; Time() asks for the latest transform"
    )


class BufferCore:
    """Frames and their transforms; the rules are those of tf2's ``BufferCore``.

    A transform says where a child frame is in its parent; a lookup walks from the source frame up to the common
    ancestor and down to the target. It answers ``p_target = R p_source + t``.

    Args:
        cache_time: how far the history of a frame reaches back from its newest transform; 10 s when omitted.
    """

    def __init__(self, cache_time: Duration | None = None) -> None:
        self._forest = Forest(DEFAULT_CACHE_TIME_NS if cache_time is None else to_ns(cache_time))
        self._lock = threading.RLock()
        self._warned: set[tuple[str, str]] = set()

    # ------------------------------------------------------------ input

    def set_transform(self, transform: Any, authority: str) -> None:
        """Add a ``TransformStamped``: where ``child_frame_id`` is in ``header.frame_id`` at ``header.stamp``.

        An unusable one is ignored with an error in the log, as tf2 does: empty or equal frame ids, NaN, a zero
        quaternion, or a stamp that lies further back than the history.
        """
        self._set(transform, authority, static=False)

    def set_transform_static(self, transform: Any, authority: str) -> None:
        """As :meth:`set_transform`, valid at every time and never forgotten."""
        self._set(transform, authority, static=True)

    def _set(self, message: Any, authority: str, static: bool) -> bool:
        parent = _strip_slash(message.header.frame_id)
        child = _strip_slash(message.child_frame_id)
        v, q = message.transform.translation, message.transform.rotation
        translation: Vector = (float(v.x), float(v.y), float(v.z))
        given: Quaternion = (float(q.x), float(q.y), float(q.z), float(q.w))
        problems = _problems(parent, child, translation, given, authority)
        for problem in problems:
            self._log(LoggingSeverity.ERROR, problem)
        if problems:
            return False
        self._check_length(child, given)
        sample = Sample(to_ns(message.header.stamp), parent, translation, canonical(given))
        with self._lock:
            kept = self._forest.insert(child, sample, authority, static=static)
        if not kept:
            self._log(
                LoggingSeverity.WARN,
                f"TF_OLD_DATA ignoring data from the past for frame {child} at time {seconds(sample.stamp_ns)} "
                f"according to authority {authority}: older than {self._forest.keep_ns / 1e9:g} s before the latest",
            )
        return kept

    def _check_length(self, child: str, q: Quaternion) -> None:
        """Say once per frame that its quaternions are not of unit length; tf2 normalises them in silence."""
        squared = sum(value * value for value in q)
        if abs(squared - 1.0) >= 1e-2 and ("length", child) not in self._warned:
            self._warned.add(("length", child))
            self._log(
                LoggingSeverity.WARN,
                f"frame {child}: the quaternion {q} has length {math.sqrt(squared):.4g} and is normalised; "
                "is it in the order x, y, z, w?",
            )

    def _context(self) -> SimContext | None:
        return active_context() or peek_default_context()

    def _log(self, severity: LoggingSeverity, text: str) -> None:
        context = self._context()
        if context is None:  # a buffer works without rclpy.init(), and must not fail for want of a log
            print(f"[{severity.name}] [tf2_buffer]: {text}")
        else:
            RcutilsLogger("tf2_buffer", context).log(text, severity)

    def clear(self) -> None:
        """Forget the history of all moving frames; static transforms stay."""
        with self._lock:
            self._forest.clear()

    # ------------------------------------------------------------ lookups

    def lookup_transform_core(self, target_frame: str, source_frame: str, time: Any) -> Any:
        """Return the ``TransformStamped`` that takes coordinates of ``source_frame`` to ``target_frame``.

        Args:
            target_frame: frame of the result's header.
            source_frame: frame whose coordinates are to be transformed.
            time: ``rclpy.time.Time`` or a stamp message; zero for the latest time at which all transforms are known.

        Raises:
            LookupException: an unknown frame.
            ConnectivityException: the frames are in different trees.
            ExtrapolationException: the time is not covered.
            InvalidArgumentException: an empty frame id, or one that begins with ``/``.
        """
        with self._lock:
            transform, time_ns = self._lookup(target_frame, source_frame, to_ns(time))
        return _message(transform, time_ns, target_frame, source_frame)

    def lookup_transform_full_core(
        self, target_frame: str, target_time: Any, source_frame: str, source_time: Any, fixed_frame: str
    ) -> Any:
        """Return the transform from the source frame at one time to the target frame at another.

        ``fixed_frame`` is taken not to have moved in between. Errors as :meth:`lookup_transform_core`.
        """
        with self._lock:
            for role, frame in (("target", target_frame), ("source", source_frame), ("fixed", fixed_frame)):
                self._validate(f"lookupTransform argument {role}_frame", frame)
            first, _ = self._lookup(fixed_frame, source_frame, to_ns(source_time))
            second, time_ns = self._lookup(target_frame, fixed_frame, to_ns(target_time))
        return _message(compose(second, first), time_ns, target_frame, source_frame)

    def can_transform_core(self, target_frame: str, source_frame: str, time: Any) -> tuple[bool, str]:
        """Tell whether :meth:`lookup_transform_core` would succeed, and if not, why."""
        with self._lock:
            if target_frame == source_frame:
                return True, ""
            problem = self._invalid("target_frame", target_frame) or self._invalid("source_frame", source_frame)
            return self._can(target_frame, source_frame, to_ns(time)) if not problem else (False, problem)

    def can_transform_full_core(
        self, target_frame: str, target_time: Any, source_frame: str, source_time: Any, fixed_frame: str
    ) -> tuple[bool, str]:
        """Tell whether :meth:`lookup_transform_full_core` would succeed, and if not, why."""
        with self._lock:
            problem = (
                self._invalid("target_frame", target_frame)
                or self._invalid("source_frame", source_frame)
                or self._invalid("fixed_frame", fixed_frame)
            )
            if problem:
                return False, problem
            found = self._can(target_frame, fixed_frame, to_ns(target_time))
            return self._can(fixed_frame, source_frame, to_ns(source_time)) if found[0] else found

    def get_latest_common_time(self, target_frame: str, source_frame: str) -> Time:
        """Return the latest time at which the transform between two frames is known (0: it is static).

        Raises:
            LookupException: an unknown frame.
            TransformException: the frames are in different trees.
        """
        with self._lock:
            for frame in (target_frame, source_frame):
                self._validate("get_latest_common_time", frame)
            try:
                return Time(nanoseconds=self._forest.latest_common_ns(target_frame, source_frame))
            except TransformException as error:
                raise TransformException(str(error)) from None

    def _can(self, target: str, source: str, time_ns: int) -> tuple[bool, str]:
        try:
            if target != source:
                self._forest.walk(target, source, time_ns)
        except TransformException as error:
            return False, str(error)
        return True, ""

    def _lookup(self, target: str, source: str, time_ns: int) -> tuple[Rigid, int]:
        if target == source:
            # Not validated, as in tf2: the identity holds for a frame nobody has heard of.
            cache = self._forest.frames.get(target)
            if time_ns == 0 and cache is not None:
                time_ns = cache.latest()[0]
            return (ZERO, IDENTITY), time_ns
        self._validate("lookupTransform argument target_frame", target)
        self._validate("lookupTransform argument source_frame", source)
        return self._forest.walk(target, source, time_ns)

    # ------------------------------------------------------------ frame ids

    def _validate(self, where: str, frame: str) -> None:
        if reason := _malformed(frame):
            raise InvalidArgumentException(f'Invalid argument "{frame}" passed to {where} - {reason}')
        if frame not in self._forest.frames:
            raise LookupException(f'"{frame}" passed to {where} does not exist. ')

    def _invalid(self, role: str, frame: str) -> str:
        reason = _malformed(frame) or ("" if frame in self._forest.frames else "frame does not exist")
        return f'Invalid frame ID "{frame}" passed to canTransform argument {role} - {reason}' if reason else ""

    def _frameExists(self, frame_id: str) -> bool:  # noqa: N802 - tf2's name
        return frame_id in self._forest.frames

    def _getFrameStrings(self) -> list[str]:  # noqa: N802 - tf2's name
        return list(self._forest.frames)

    # ------------------------------------------------------------ reports

    def all_frames_as_string(self) -> str:
        """Return one line per frame that has a parent, in order of appearance."""
        with self._lock:
            return self._forest.as_string()

    def all_frames_as_yaml(self) -> str:
        """Return parent, broadcaster, rate (Hz), times and buffer length (s) of each frame as YAML."""
        with self._lock:
            return self._forest.as_yaml()


def _strip_slash(frame: str) -> str:
    return frame[1:] if frame.startswith("/") else frame


def _malformed(frame: str) -> str:
    if not frame:
        return "in tf2 frame_ids cannot be empty"
    return "in tf2 frame_ids cannot start with a '/'" if frame.startswith("/") else ""


def _problems(parent: str, child: str, v: Vector, q: Quaternion, authority: str) -> list[str]:
    """Return why a transform cannot be used, in the words of tf2's log."""
    found = []
    if parent == child:
        found.append(
            f'TF_SELF_TRANSFORM: Ignoring transform from authority "{authority}" with frame_id and child_frame_id '
            f'"{child}" because they are the same'
        )
    if not child:
        found.append(
            f'TF_NO_CHILD_FRAME_ID: Ignoring transform from authority "{authority}" because child_frame_id not set'
        )
    if not parent:
        found.append(
            f'TF_NO_FRAME_ID: Ignoring transform with child_frame_id "{child}" from authority "{authority}" '
            "because frame_id not set"
        )
    if any(math.isnan(value) for value in (*v, *q)):
        found.append(
            f'TF_NAN_INPUT: Ignoring transform for child_frame_id "{child}" from authority "{authority}" '
            f"because of a nan value in the transform {v} {q}"
        )
    elif any(math.isinf(value) for value in q) or not any(q):
        found.append(
            f'TF_DENORMALIZED_QUATERNION: Ignoring transform for child_frame_id "{child}" from authority '
            f'"{authority}" because of an invalid quaternion in the transform {q}; no rotation is (0, 0, 0, 1)'
        )
    return found


def _message(transform: Rigid, time_ns: int, target: str, source: str) -> Any:
    message = msg_class("geometry_msgs/msg/TransformStamped")()
    message.header.stamp, message.header.frame_id, message.child_frame_id = ns_to_time(time_ns), target, source
    (x, y, z), rotation = transform[0], canonical(transform[1])
    v, q = message.transform.translation, message.transform.rotation
    v.x, v.y, v.z = x, y, z
    q.x, q.y, q.z, q.w = rotation
    return message

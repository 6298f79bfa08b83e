"""Exceptions of tf2, with the conditions of its buffer core."""

# ruff: noqa: N818 - TransformException and TypeException are the names of tf2
from __future__ import annotations

from robotbrain.errors import RobotBrainError


class TransformException(RobotBrainError):
    """Base of everything a transform lookup raises."""


class LookupException(TransformException):
    """A frame is unknown, or the tree contains a loop."""


class ConnectivityException(TransformException):
    """The frames belong to different trees."""


class ExtrapolationException(TransformException):
    """The time asked for lies outside what the buffer holds."""


class InvalidArgumentException(TransformException):
    """A frame id is empty or begins with ``/``."""


class TimeoutException(TransformException):
    """A wait ran out of time (tf2 raises it for its action client; the buffer names the cause instead)."""


class TypeException(RobotBrainError):
    """A message type has no transform or conversion registered."""

    def __init__(self, errstr: str) -> None:
        self.errstr = errstr
        super().__init__(errstr)


class NotImplementedException(RobotBrainError):
    """A subclass of BufferInterface does not implement a method."""

    def __init__(self) -> None:
        self.errstr = "CanTransform or LookupTransform not implemented"
        super().__init__(self.errstr)

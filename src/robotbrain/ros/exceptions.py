"""Exceptions of the rclpy subset (``rclpy.exceptions``) and the kit's own."""

# ruff: noqa: N818 - the names are those of rclpy.exceptions

from __future__ import annotations

import functools
from typing import TYPE_CHECKING

from robotbrain.errors import InputError, RobotBrainError

if TYPE_CHECKING:
    from robotbrain.ros.node import Node


class NotInitializedException(RobotBrainError):
    """``rclpy.init()`` was not called, or ``rclpy.shutdown()`` already was."""

    def __init__(self, *args: object) -> None:
        super().__init__(*(args or ("rclpy is not initialised: call rclpy.init() before creating nodes",)))


class ROSInterruptException(RobotBrainError):
    """A blocking call was interrupted by shutdown."""

    def __init__(self, *args: object) -> None:
        super().__init__(*(args or ("rclpy.shutdown() has been called",)))


class InvalidNameException(InputError):
    """Base of the name errors: a node name, namespace, topic or service name breaks the ROS 2 naming rules."""


class InvalidNodeNameException(InvalidNameException):
    """A node name has other characters than ``[A-Za-z0-9_]`` or starts with a digit."""


class InvalidNamespaceException(InvalidNameException):
    """A namespace breaks the naming rules."""


class InvalidTopicNameException(InvalidNameException):
    """A topic name breaks the naming rules."""


class InvalidServiceNameException(InvalidNameException):
    """A service name breaks the naming rules."""


class InvalidHandle(RobotBrainError):
    """A publisher, subscription, timer, service, client or node was used after it was destroyed."""


class RCLError(RobotBrainError, RuntimeError):
    """The client library refuses: a transition of a goal's state that there is not, say."""


class NodeNameNonExistentError(RCLError, InputError):
    """The graph has no node of that name."""


class ParameterException(InputError):
    """Base of the parameter errors."""


class ParameterNotDeclaredException(ParameterException):
    """A parameter was read or set before ``declare_parameter``."""


class ParameterAlreadyDeclaredException(ParameterException):
    """``declare_parameter`` was called twice for one name."""


class ParameterUninitializedException(ParameterException):
    """A parameter was declared by type only and has no value yet."""


class InvalidParameterException(ParameterException):
    """A parameter has no proper name."""


class ParameterImmutableException(ParameterException):
    """A read-only parameter was to be changed or undeclared."""


class InvalidParameterTypeException(ParameterException):
    """A parameter was given a value of another type than it was declared with."""


class InvalidParameterValueException(ParameterException):
    """A parameter callback refused the initial value."""


class InvalidQoSProfileException(InputError):
    """A QoS profile contradicts itself or lacks a depth."""


class TypeConflictError(InputError):
    """One topic or service name is used with two types."""


class SimulationDeadlockError(RobotBrainError, RuntimeError):
    """Something was waited for that no pending event can bring about; genuine ROS 2 would wait forever."""


class ReentrancyError(RobotBrainError, RuntimeError):
    """A blocking call was made inside a callback; genuine rclpy deadlocks or raises there."""


class CallbackError(RobotBrainError, RuntimeError):
    """A callback raised. The original exception is ``__cause__`` (and ``cause``).

    It is also an instance of the original's class, so that ``except KeyError`` around ``spin`` works as in genuine
    rclpy, which raises the original.

    Attributes:
        node: the node whose callback it was.
        callback: readable name of the callback.
        kind: ``timer``, ``subscription``, ``service``, ``client``, ``action``, ``task``, ``event`` or
            ``guard_condition``.
        name: topic, service, action or timer name.
        time_ns: simulated time at which the callback started.
        cause: the exception it raised.
    """

    def __new__(cls, node: Node, *, cause: BaseException, **details: object) -> CallbackError:
        """Make an instance of the class that is both."""
        try:
            return type(cause).__new__(_with(cls, type(cause)))  # type: ignore[arg-type]
        except TypeError:  # an exception whose constructor wants more
            return Exception.__new__(cls)

    def __init__(self, node: Node, *, callback: str, kind: str, name: str, time_ns: int, cause: BaseException) -> None:
        text = (
            f"{type(cause).__name__} in {kind} callback {callback} ({name}) of node "
            f"{node.get_fully_qualified_name()} at simulated time {time_ns / 1e9:.9f} s: {cause}"
        )
        self.__dict__.update(vars(cause))
        Exception.__init__(self, text)
        self.node, self.callback, self.kind, self.name = node, callback, kind, name
        self.time_ns, self.cause = time_ns, cause

    def __str__(self) -> str:
        return str(self.args[0])


@functools.cache
def _with(cls: type[CallbackError], cause: type[BaseException]) -> type[CallbackError]:
    if issubclass(cls, cause) or not issubclass(cause, Exception):
        return cls
    try:
        return type(cls.__name__, (cls, cause), {"__module__": cls.__module__, "__doc__": cls.__doc__})
    except TypeError:  # classes whose instances are laid out differently
        return cls

"""Message and service classes that behave as those of genuine rclpy, generated from interface definitions.

A class has slots ``_<field>`` (as rclpy's ``__slots__``), a public attribute per field, constants as class
attributes, keyword construction and checked assignment. Checks are those of rclpy with
``ROS_PYTHON_CHECK_FIELDS=1``: a float field takes ``float`` and not ``int``, so that a file which passes
here does not put garbage on a real wire.
"""

from __future__ import annotations

import copy
import functools
from array import array
from collections.abc import Callable
from typing import Any, ClassVar, NoReturn

import numpy as np

from robotbrain.errors import InputError
from robotbrain.ros import cdr
from robotbrain.ros.message_fields import FieldError, check_of, factory_of
from robotbrain.ros.typedefs import PLACEHOLDER, struct_def, typenames


class FieldNameError(InputError, AttributeError):
    """A message has no field of that name."""


class MessageTypeError(InputError, AttributeError):
    """Something else than a message class was given (genuine rclpy raises AttributeError)."""


class MessageType(type):
    """Type of the message classes: their constants stay what they are."""

    def __setattr__(cls, name: str, value: Any) -> None:
        if name in cls.__dict__.get("_constants", ()):
            raise AttributeError(f"{name} is a constant of {cls.__dict__['__msgtype__']}")
        super().__setattr__(name, value)


class Message(metaclass=MessageType):
    """Base of all generated message classes."""

    __slots__ = ()
    __msgtype__: ClassVar[str] = ""
    _fields_and_field_types: ClassVar[dict[str, str]] = {}
    _checks: ClassVar[dict[str, Callable[[Any, Any], None]]] = {}
    _factories: ClassVar[tuple[tuple[Callable[[Any, Any], None], Callable[[], Any]], ...]] = ()

    def __init__(self, **fields: Any) -> None:
        for setter, factory in self._factories:
            setter(self, factory())
        if fields:
            fields.pop("check_fields", None)  # accepted by genuine rclpy; the kit always checks
            for name, value in fields.items():
                check = self._checks.get(name)
                if check is None:
                    self._no_field(name, FieldError)
                check(self, value)

    def __setattr__(self, name: str, value: Any) -> None:
        check = self._checks.get(name)
        if check is None:
            self._no_field(name)
        check(self, value)

    def __getattr__(self, name: str) -> NoReturn:
        self._no_field(name)

    def _no_field(self, name: str, error: type[InputError] = FieldNameError) -> NoReturn:
        known = ", ".join(self._fields_and_field_types) or "none"
        if name.startswith("__"):
            raise AttributeError(name)
        raise error(f"field of {self.__msgtype__}", given=name, expected=f"one of: {known}", fix="Check the spelling.")

    @classmethod
    def get_fields_and_field_types(cls) -> dict[str, str]:
        """Return a copy of the map from field name to IDL type, in wire order."""
        return dict(cls._fields_and_field_types)

    @classmethod
    def _cdr_encoder(cls) -> cdr.Encoder:
        return cdr.encoder(cls.__msgtype__)

    @classmethod
    def _cdr_decoder(cls) -> cdr.Decoder:
        return _decoder(cls.__msgtype__)

    def __eq__(self, other: object) -> bool:
        if type(self) is not type(other):
            return NotImplemented
        for name in self._fields_and_field_types:
            mine, theirs = getattr(self, name), getattr(other, name)
            if isinstance(mine, np.ndarray):
                if not np.array_equal(mine, theirs):
                    return False
            elif mine != theirs:
                return False
        return True

    __hash__ = None  # type: ignore[assignment]

    def __repr__(self) -> str:
        package, kind, name = self.__msgtype__.split("/")
        shown = []
        for field in self._fields_and_field_types:
            value = getattr(self, field)
            text = repr(value.tolist()) if isinstance(value, array) else repr(value)
            shown.append(f"{field}={text}")
        return f"{package}.{kind}.{name}({', '.join(shown)})"

    def __reduce__(self) -> tuple[Any, ...]:
        return _rebuild, (self.__msgtype__, tuple(getattr(self, name) for name in self._fields_and_field_types))

    def __copy__(self) -> Any:
        return _rebuild(self.__msgtype__, tuple(getattr(self, name) for name in self._fields_and_field_types))

    def __deepcopy__(self, memo: dict[int, Any]) -> Any:
        values = tuple(copy.deepcopy(getattr(self, name), memo) for name in self._fields_and_field_types)
        return _rebuild(self.__msgtype__, values)


def _rebuild(typename: str, values: tuple[Any, ...]) -> Message:
    cls = message_class(typename)
    message = object.__new__(cls)
    for (setter, _), value in zip(cls._factories, values, strict=True):
        setter(message, value)
    return message


@functools.cache
def _decoder(typename: str) -> cdr.Decoder:
    return cdr.make_decoder(typename, message_class)


@functools.cache
def message_class(typename: str) -> type[Message]:
    """Return the one class of ``typename`` (``pkg/msg/Name`` or ``pkg/srv/Name_Request``).

    Raises:
        InputError: no such type.
    """
    definition = struct_def(typename)
    package, kind, name = typename.split("/")
    fields = {field: type_ for field, type_ in definition.fields if field != PLACEHOLDER}
    namespace: dict[str, Any] = dict(definition.constants)
    namespace.update(
        __slots__=tuple("_" + field for field in fields),
        __module__=f"{package}.{kind}",
        __msgtype__=typename,
        _constants=frozenset(name for name, _ in definition.constants),
        __doc__=f"{typename}: " + ", ".join(f"{field} ({type_.idl})" for field, type_ in fields.items()),
        _fields_and_field_types={field: type_.idl for field, type_ in fields.items()},
    )
    cls: Any = MessageType(name, (Message,), namespace)
    checks, factories = {}, []
    for field, type_ in fields.items():
        slot = cls.__dict__["_" + field]
        setattr(cls, field, slot)  # reading is the slot itself; writing goes through __setattr__ and its check
        checks[field] = check_of(f"{name}.{field}", type_, slot.__set__, message_class)
        factories.append((slot.__set__, factory_of(type_, definition.defaults.get(field), message_class)))
    cls._checks, cls._factories = checks, tuple(factories)
    return cls  # type: ignore[no-any-return]


def _not_made(cls: type) -> NoReturn:
    parts = [name for name in ("Request", "Response", "Goal", "Result", "Feedback") if hasattr(cls, name)]
    raise NotImplementedError(
        f"{cls.__name__} is only a name: make " + " or ".join(f"{cls.__name__}.{part}()" for part in parts)
    )


@functools.cache
def service_class(typename: str) -> type:
    """Return the class of a service (``pkg/srv/Name``) with nested ``Request`` and ``Response``."""
    package, kind, name = typename.split("/")
    request, response = message_class(typename + "_Request"), message_class(typename + "_Response")
    namespace = {
        "__new__": _not_made,
        "__module__": f"{package}.{kind}",
        "__srvtype__": typename,
        "__doc__": f"{typename}: Request and Response classes.",
        "Request": request,
        "Response": response,
    }
    return type(name, (), namespace)


def is_service(typename: str) -> bool:
    """Tell whether ``pkg/srv/Name`` is a service the kit knows."""
    return f"{typename}_Request" in typenames()


@functools.cache
def action_class(typename: str) -> type:
    """Return the class of an action (``pkg/action/Name``): ``Goal``, ``Result``, ``Feedback`` and ``Impl``."""
    package, kind, name = typename.split("/")
    impl = type(
        "Impl",
        (),
        {
            "__doc__": f"What carries {typename}: three services and two topics.",
            "SendGoalService": service_class(typename + "_SendGoal"),
            "GetResultService": service_class(typename + "_GetResult"),
            "CancelGoalService": service_class("action_msgs/srv/CancelGoal"),
            "FeedbackMessage": message_class(typename + "_FeedbackMessage"),
            "GoalStatusMessage": message_class("action_msgs/msg/GoalStatusArray"),
        },
    )
    namespace = {
        "__new__": _not_made,
        "__module__": f"{package}.{kind}",
        "__actiontype__": typename,
        "__doc__": f"{typename}: Goal, Result and Feedback classes.",
        "Goal": message_class(typename + "_Goal"),
        "Result": message_class(typename + "_Result"),
        "Feedback": message_class(typename + "_Feedback"),
        "Impl": impl,
    }
    return type(name, (), namespace)


def is_action(typename: str) -> bool:
    """Tell whether ``pkg/action/Name`` is an action the kit knows."""
    return f"{typename}_SendGoal_Request" in typenames()


def typename_of(cls: Any) -> str:
    """Return the ROS type name of a message class.

    Raises:
        InputError: not a message class.
    """
    name = getattr(cls, "__msgtype__", None)
    if isinstance(cls, type) and isinstance(name, str) and name:
        return name
    raise MessageTypeError(
        "message type",
        given=cls,
        expected="a message class such as geometry_msgs.msg.Twist",
        fix="Pass the class itself: from geometry_msgs.msg import Twist.",
    )

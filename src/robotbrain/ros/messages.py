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
from robotbrain.ros.typedefs import PLACEHOLDER, FieldType, struct_def, typenames

FLOAT32_MAX = 3.402823466e38


class FieldError(InputError, AssertionError):
    """A message field was given a value it cannot hold (genuine rclpy raises AssertionError)."""


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
        raise error(
            f"field of {self.__msgtype__}", given=name, expected=f"one of: {known}", fix="Check the spelling."
        )

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
    cls: type[Message] = MessageType(name, (Message,), namespace)
    checks, factories = {}, []
    for field, type_ in fields.items():
        slot = cls.__dict__["_" + field]
        setattr(cls, field, slot)  # reading is the slot itself; writing goes through __setattr__ and its check
        checks[field] = _check(f"{name}.{field}", type_, slot.__set__)
        factories.append((slot.__set__, _factory(type_, definition.defaults.get(field))))
    cls._checks, cls._factories = checks, tuple(factories)
    return cls


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
    """Return the class of an action (``pkg/action/Name``) with nested ``Goal``, ``Result``, ``Feedback`` and ``Impl``."""
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


# ---------------------------------------------------------------- defaults


def _factory(kind: FieldType, default: Any) -> Callable[[], Any]:
    if default is not None:
        return lambda: default
    single = _single_factory(kind)
    if kind.shape == "single":
        return single
    if kind.shape == "sequence":
        code = kind.primitive.typecode if kind.primitive else ""
        return (lambda: array(code)) if code else list
    if kind.primitive is not None and kind.primitive.typecode:
        return functools.partial(np.zeros, kind.length, kind.primitive.dtype)
    return lambda: [single() for _ in range(kind.length)]


def _single_factory(kind: FieldType) -> Callable[[], Any]:
    if kind.kind == "message":
        return message_class(kind.message)
    if kind.kind == "string":
        return str
    assert kind.primitive is not None
    by_code: dict[str, Callable[[], Any]] = {"c": lambda: b"\x00", "?": bool, "f": float, "d": float}
    return by_code.get(kind.primitive.code, int)


# ---------------------------------------------------------------- checks


def _check(label: str, kind: FieldType, store: Callable[[Any, Any], None]) -> Callable[[Any, Any], None]:
    """Return ``check(message, value)`` that stores a good value and raises FieldError on a bad one."""
    element = _element_check(label, kind)
    if kind.shape == "single":
        return lambda message, value: store(message, element(value))
    if kind.kind == "primitive" and kind.primitive is not None and kind.primitive.typecode:
        convert = _buffer_check(label, kind)
        return lambda message, value: store(message, convert(value))

    def check_list(message: Any, value: Any) -> None:
        if isinstance(value, (str, bytes)) or not hasattr(value, "__iter__"):
            _reject(label, value, f"a sequence ({kind.idl})", "Pass a list.")
        items = [element(item) for item in value]
        _check_length(label, kind, len(items))
        store(message, items)

    return check_list


def _reject(label: str, value: Any, expected: str, fix: str) -> NoReturn:
    raise FieldError(f"field {label}", given=value, expected=expected, fix=fix)


def _check_length(label: str, kind: FieldType, length: int) -> None:
    if kind.shape == "array" and length != kind.length:
        _reject(label, f"{length} elements", f"exactly {kind.length} elements ({kind.idl})", "Pass that many.")
    if kind.shape == "sequence" and kind.length and length > kind.length:
        _reject(label, f"{length} elements", f"at most {kind.length} elements ({kind.idl})", "Pass fewer.")


def _element_check(label: str, kind: FieldType) -> Callable[[Any], Any]:
    if kind.kind == "message":
        wanted = message_class(kind.message)

        def check_message(value: Any) -> Any:
            if not isinstance(value, wanted):
                _reject(label, value, f"a {kind.message} message", f"Build it with {wanted.__name__}(...).")
            return value

        return check_message
    if kind.kind == "string":
        bound = kind.string_bound

        def check_string(value: Any) -> Any:
            if not isinstance(value, str):
                _reject(label, value, "str", "Convert it with str(...).")
            if bound and len(value) > bound:
                _reject(label, value, f"at most {bound} characters", "Shorten it.")
            return value

        return check_string
    assert kind.primitive is not None
    return _primitive_check(label, kind.primitive.code, kind.primitive.idl)


def _primitive_check(label: str, code: str, idl: str) -> Callable[[Any], Any]:
    if code in "fd":

        def check_float(value: Any) -> Any:
            if not isinstance(value, float):
                _reject(label, value, f"float ({idl})", "Convert it with float(...).")
            if code == "f" and FLOAT32_MAX < abs(value) < float("inf"):
                _reject(label, value, "a value within float32 range", "Scale it, or use inf.")
            return value

        return check_float
    if code == "?":

        def check_bool(value: Any) -> Any:
            if not isinstance(value, bool):
                _reject(label, value, "bool", "Convert it with bool(...).")
            return value

        return check_bool
    if code == "c":

        def check_octet(value: Any) -> Any:
            if not isinstance(value, (bytes, bytearray)) or len(value) != 1:
                _reject(label, value, "bytes of length 1 (octet)", "Pass e.g. b'\\x01' or bytes([n]).")
            return bytes(value)

        return check_octet
    low, high = _limits(code)

    def check_int(value: Any) -> Any:
        if not isinstance(value, int):
            _reject(label, value, f"int ({idl})", "Convert it with int(...).")
        if not low <= value <= high:
            _reject(label, value, f"an integer in [{low}, {high}] ({idl})", "Clip it or check its unit.")
        return value

    return check_int


def _limits(code: str) -> tuple[int, int]:
    bits = 8 * {"b": 1, "h": 2, "i": 4, "q": 8}[code.lower()]
    return (0, 2**bits - 1) if code.isupper() else (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)


def _buffer_check(label: str, kind: FieldType) -> Callable[[Any], Any]:
    """Conversion to ``array.array`` (sequence) or numpy (fixed array) of a primitive with a typecode."""
    primitive = kind.primitive
    assert primitive is not None
    code, dtype, size = primitive.typecode, np.dtype(primitive.dtype), primitive.size
    fractional = code in "fd"

    def to_array(value: Any) -> Any:
        if type(value) is array and value.typecode == code:
            return value  # kept by reference, as rclpy does; publishing copies it
        if isinstance(value, (bytes, bytearray, memoryview)) and size == 1:
            result = array(code)
            result.frombytes(value)
            return result
        if isinstance(value, np.ndarray):
            checked = to_numpy(value)
            result = array(code)
            result.frombytes(checked.tobytes())
            return result
        return from_items(value)

    def to_numpy(value: Any) -> Any:
        if value.ndim != 1:
            _reject(label, f"shape {value.shape}", "a one-dimensional array", "Call .ravel() or .reshape(-1).")
        if value.dtype == dtype:
            return value
        if fractional:
            if value.dtype.kind not in "fiu":
                _reject(label, value, f"real numbers ({primitive.idl})", "Convert with .astype(float).")
            return value.astype(dtype)
        if value.dtype.kind not in "iub":
            _reject(label, value, f"integers ({primitive.idl})", f"Round and convert with .astype({dtype.name!r}).")
        if value.size and not _limits(code)[0] <= int(value.min()) <= int(value.max()) <= _limits(code)[1]:
            low, high = _limits(code)
            _reject(label, value, f"integers in [{low}, {high}]", "Clip them or check their unit.")
        return value.astype(dtype)

    def from_items(value: Any) -> Any:
        if isinstance(value, str) or not hasattr(value, "__iter__"):
            _reject(label, value, f"a sequence ({kind.idl})", "Pass a list, array.array or numpy array.")
        items = list(value)
        try:
            return array(code, items)
        except (TypeError, ValueError, OverflowError) as error:
            _reject(label, items, f"numbers that fit {primitive.idl}", f"Check the elements ({error}).")

    if kind.shape == "sequence":

        def check_sequence(value: Any) -> Any:
            result = to_array(value)
            _check_length(label, kind, len(result))
            return result

        return check_sequence

    def check_fixed(value: Any) -> Any:
        result = to_array(value) if not isinstance(value, np.ndarray) else to_numpy(value)
        _check_length(label, kind, len(result))
        # A copy: rclpy keeps a reference to a numpy array, which makes covariances of two messages share memory.
        return np.array(result, dtype=dtype)

    return check_fixed


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

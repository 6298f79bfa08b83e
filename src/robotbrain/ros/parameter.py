"""Parameters (``rclpy.parameter``): values, types and the set a node has."""

from __future__ import annotations

import enum
from array import array
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any

import numpy as np

from robotbrain.ros.exceptions import (
    InvalidParameterTypeException,
    InvalidParameterValueException,
    ParameterAlreadyDeclaredException,
    ParameterNotDeclaredException,
    ParameterUninitializedException,
)
from robotbrain.ros.messages import message_class

if TYPE_CHECKING:
    from robotbrain.ros.node import Node


class ParameterType(enum.IntEnum):
    """Types as ``rcl_interfaces/msg/ParameterType`` numbers them."""

    NOT_SET = 0
    BOOL = 1
    INTEGER = 2
    DOUBLE = 3
    STRING = 4
    BYTE_ARRAY = 5
    BOOL_ARRAY = 6
    INTEGER_ARRAY = 7
    DOUBLE_ARRAY = 8
    STRING_ARRAY = 9


_FIELDS = {
    ParameterType.BOOL: "bool_value",
    ParameterType.INTEGER: "integer_value",
    ParameterType.DOUBLE: "double_value",
    ParameterType.STRING: "string_value",
    ParameterType.BYTE_ARRAY: "byte_array_value",
    ParameterType.BOOL_ARRAY: "bool_array_value",
    ParameterType.INTEGER_ARRAY: "integer_array_value",
    ParameterType.DOUBLE_ARRAY: "double_array_value",
    ParameterType.STRING_ARRAY: "string_array_value",
}
_SCALARS = {
    bool: ParameterType.BOOL,
    int: ParameterType.INTEGER,
    float: ParameterType.DOUBLE,
    str: ParameterType.STRING,
}
_ARRAYS = {
    bool: ParameterType.BOOL_ARRAY,
    int: ParameterType.INTEGER_ARRAY,
    float: ParameterType.DOUBLE_ARRAY,
    str: ParameterType.STRING_ARRAY,
    bytes: ParameterType.BYTE_ARRAY,
}


def infer_type(value: Any) -> ParameterType:
    """Return the parameter type of a Python value.

    Raises:
        InvalidParameterTypeException: no parameter can hold it.
    """
    if value is None:
        return ParameterType.NOT_SET
    if type(value) in _SCALARS:
        return _SCALARS[type(value)]
    if isinstance(value, (list, tuple, array, np.ndarray)):
        kinds = {type(item) for item in (value.tolist() if isinstance(value, np.ndarray) else value)}
        if not kinds:
            return ParameterType.BYTE_ARRAY
        if len(kinds) == 1 and (kind := kinds.pop()) in _ARRAYS:
            return _ARRAYS[kind]
    raise InvalidParameterTypeException(
        "parameter value",
        given=value,
        expected="bool, int, float, str or a list of one of these",
        fix="Convert numpy scalars with .item(); mixed lists are not allowed.",
    )


class Parameter:
    """A named value.

    Args:
        name: parameter name.
        type_: its type; inferred from ``value`` when omitted.
        value: the value.

    Raises:
        InvalidParameterTypeException: value and type disagree.
    """

    Type = ParameterType

    def __init__(self, name: str, type_: ParameterType | None = None, value: Any = None) -> None:
        inferred = infer_type(value)
        if type_ is None:
            type_ = inferred
        elif value is not None and inferred != type_ and not _empty_list_fits(value, type_):
            raise InvalidParameterTypeException(
                f"parameter {name}",
                given=value,
                expected=ParameterType(type_).name,
                fix="A double parameter takes 1.0, not 1.",
            )
        self._name, self._type, self._value = name, ParameterType(type_), value

    @property
    def name(self) -> str:
        """The name."""
        return self._name

    @property
    def type_(self) -> ParameterType:
        """The type."""
        return self._type

    @property
    def value(self) -> Any:
        """The value."""
        return self._value

    def get_parameter_value(self) -> Any:
        """Return the value as ``rcl_interfaces/msg/ParameterValue``."""
        msg = message_class("rcl_interfaces/msg/ParameterValue")(type=int(self._type))
        if self._type in _FIELDS:
            setattr(msg, _FIELDS[self._type], self._value)
        return msg

    def to_parameter_msg(self) -> Any:
        """Return this as ``rcl_interfaces/msg/Parameter``."""
        return message_class("rcl_interfaces/msg/Parameter")(name=self._name, value=self.get_parameter_value())

    @classmethod
    def from_parameter_msg(cls, msg: Any) -> Parameter:
        """Build from ``rcl_interfaces/msg/Parameter``."""
        kind = ParameterType(msg.value.type)
        value = getattr(msg.value, _FIELDS[kind]) if kind in _FIELDS else None
        return cls(msg.name, kind, list(value) if isinstance(value, array) else value)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Parameter):
            return NotImplemented
        return (self._name, self._type, self._value) == (other._name, other._type, other._value)

    __hash__ = None  # type: ignore[assignment]

    def __repr__(self) -> str:
        return f"Parameter(name={self._name!r}, type_={self._type.name}, value={self._value!r})"


def _empty_list_fits(value: Any, type_: ParameterType) -> bool:
    return isinstance(value, (list, tuple)) and not value and type_ >= ParameterType.BYTE_ARRAY


class ParameterSet:
    """The declared parameters of a node and the callbacks that may refuse a change."""

    def __init__(self, node: Node, overrides: dict[str, Any], allow_undeclared: bool) -> None:
        self._node, self._overrides, self._allow_undeclared = node, overrides, allow_undeclared
        self._values: dict[str, Parameter] = {}
        self._types: dict[str, ParameterType | None] = {}
        self._read_only: set[str] = set()
        self.callbacks: list[Callable[[list[Parameter]], Any]] = []

    def declare(self, name: str, value: Any, descriptor: Any, ignore_override: bool) -> Parameter:
        """Declare one parameter; see ``Node.declare_parameter``."""
        if name in self._values:
            raise ParameterAlreadyDeclaredException(
                f"parameter {name}",
                given="a second declaration",
                expected=f"one per node ({self._node.get_name()})",
                fix="Use set_parameters to change it, or has_parameter to ask.",
            )
        if isinstance(value, type):
            value = _SCALARS.get(value, value)
        declared_type: ParameterType | None = None
        if isinstance(value, ParameterType):
            declared_type, value = value, None
        dynamic = bool(getattr(descriptor, "dynamic_typing", False))
        original = infer_type(value)
        if name in self._overrides and not ignore_override:
            value = self._overrides[name]
        expected = declared_type or (original if original != ParameterType.NOT_SET else None)
        parameter = Parameter(name, expected if not dynamic and value is not None else None, value)
        result = self._ask([parameter])
        if not result.successful:
            raise InvalidParameterValueException(
                f"parameter {name}", given=value, expected=result.reason, fix="Choose another default."
            )
        self._values[name], self._types[name] = parameter, None if dynamic else expected
        if getattr(descriptor, "read_only", False):
            self._read_only.add(name)
        return parameter

    def undeclare(self, name: str) -> None:
        """Remove a declared parameter."""
        self.get(name)
        del self._values[name], self._types[name]

    def has(self, name: str) -> bool:
        """Tell whether the parameter is declared."""
        return name in self._values

    def get(self, name: str) -> Parameter:
        """Return the parameter; raise when it was not declared or has no value."""
        if name not in self._values:
            if self._allow_undeclared:
                return Parameter(name)
            raise ParameterNotDeclaredException(
                "parameter",
                given=name,
                expected=f"a declared one of {self._node.get_name()}: {', '.join(self._values)}",
                fix=f"Call declare_parameter({name!r}, default) first.",
            )
        parameter = self._values[name]
        if parameter.type_ == ParameterType.NOT_SET and self._types[name] is not None:
            raise ParameterUninitializedException(
                f"parameter {name}", given="no value", expected="a value", fix="Set it or declare a default."
            )
        return parameter

    def names(self) -> list[str]:
        """Return the declared names in order of declaration."""
        return list(self._values)

    def set(self, parameters: Iterable[Parameter]) -> Any:
        """Set all or none; return ``rcl_interfaces/msg/SetParametersResult``."""
        parameters = list(parameters)
        for parameter in parameters:
            if reason := self._refusal(parameter):
                return _result(False, reason)
        result = self._ask(parameters)
        if result.successful:
            for parameter in parameters:
                self._values[parameter.name] = parameter
                self._types.setdefault(parameter.name, None)
        return result

    def _refusal(self, parameter: Parameter) -> str:
        name = parameter.name
        if name not in self._values:
            if self._allow_undeclared:
                return ""
            raise ParameterNotDeclaredException(
                "parameter",
                given=name,
                expected=f"a declared one of {self._node.get_name()}: {', '.join(self._values)}",
                fix=f"Call declare_parameter({name!r}, default) first.",
            )
        if name in self._read_only:
            return f"parameter {name} is read-only"
        wanted = self._types[name]
        if wanted is not None and parameter.type_ != wanted:
            return f"parameter {name} has type {wanted.name}, not {parameter.type_.name}"
        return ""

    def _ask(self, parameters: list[Parameter]) -> Any:
        for callback in self.callbacks:
            result = callback(parameters)
            if not result.successful:
                return result
        return _result(True, "")


def _result(successful: bool, reason: str) -> Any:
    return message_class("rcl_interfaces/msg/SetParametersResult")(successful=successful, reason=reason)

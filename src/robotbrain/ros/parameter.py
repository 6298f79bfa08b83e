"""Parameters (``rclpy.parameter``): values, types, messages and files."""

from __future__ import annotations

import enum
from array import array
from pathlib import Path
from typing import Any

import numpy as np

from robotbrain.errors import InputError
from robotbrain.ros.messages import message_class
from robotbrain.ros.parameter_files import flatten, load_yaml, parse_value

PARAMETER_SEPARATOR_STRING = "."

__all__ = [
    "PARAMETER_SEPARATOR_STRING",
    "Parameter",
    "ParameterType",
    "get_parameter_value",
    "infer_type",
    "parameter_dict_from_yaml_file",
    "parameter_value_to_python",
]


class ParameterTypeError(TypeError, InputError):
    """No parameter can hold this value."""

    def __init__(self, what: str, *, given: object, expected: str, fix: str) -> None:
        InputError.__init__(self, what, given=given, expected=expected, fix=fix)


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

    @classmethod
    def from_parameter_value(cls, parameter_value: Any) -> ParameterType:
        """Return the type of a Python value.

        Raises:
            TypeError: no parameter can hold it.
        """
        return infer_type(parameter_value)

    def check(self, parameter_value: Any) -> bool:
        """Tell whether a Python value is of this type; an empty list is of every array type."""
        try:
            inferred = infer_type(parameter_value)
        except TypeError:
            return False
        return inferred == self or (self >= ParameterType.BYTE_ARRAY and _is_empty_list(parameter_value))


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


def _is_empty_list(value: Any) -> bool:
    return isinstance(value, (list, tuple, array, np.ndarray)) and not len(value)


def infer_type(value: Any) -> ParameterType:
    """Return the parameter type of a Python value; an empty list counts as BYTE_ARRAY, as in rclpy.

    Raises:
        TypeError: no parameter can hold it.
    """
    if value is None:
        return ParameterType.NOT_SET
    for python_type, parameter_type in _SCALARS.items():
        if isinstance(value, python_type):
            return parameter_type
    if isinstance(value, (list, tuple, array, np.ndarray)):
        kinds = {type(item) for item in (value.tolist() if isinstance(value, np.ndarray) else value)}
        if not kinds:
            return ParameterType.BYTE_ARRAY
        if len(kinds) == 1 and (kind := kinds.pop()) in _ARRAYS:
            return _ARRAYS[kind]
    raise ParameterTypeError(
        "parameter value",
        given=value,
        expected="bool, int, float, str, or a list of one of these (or of single bytes)",
        fix="Convert it, e.g. with float(...) or list(...); mixed lists are not allowed.",
    )


class Parameter:
    """A named value.

    Args:
        name: parameter name.
        type_: its type; inferred from ``value`` when omitted.
        value: the value.

    Raises:
        InputError: value and type disagree.
        TypeError: no parameter can hold the value.
    """

    Type = ParameterType

    def __init__(self, name: str, type_: ParameterType | None = None, value: Any = None) -> None:
        if type_ is None:
            type_ = infer_type(value)
        elif not isinstance(type_, ParameterType):
            raise TypeError(f"type must be an instance of {ParameterType!r}, got {type_!r}")
        elif not type_.check(value):
            raise InputError(
                f"parameter {name}", given=value, expected=type_.name, fix="A double parameter takes 1.0, not 1."
            )
        self._name, self._type, self._value = name, type_, value

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
        if self._type in _FIELDS and self._value is not None:
            setattr(msg, _FIELDS[self._type], self._value)
        return msg

    def to_parameter_msg(self) -> Any:
        """Return this as ``rcl_interfaces/msg/Parameter``."""
        return message_class("rcl_interfaces/msg/Parameter")(name=self._name, value=self.get_parameter_value())

    @classmethod
    def from_parameter_msg(cls, param_msg: Any) -> Parameter:
        """Build from ``rcl_interfaces/msg/Parameter``."""
        kind = ParameterType(param_msg.value.type)
        return cls(param_msg.name, kind, parameter_value_to_python(param_msg.value))

    def __repr__(self) -> str:
        return f"Parameter(name={self._name!r}, type_={self._type.name}, value={self._value!r})"


def parameter_value_to_python(parameter_value: Any) -> Any:
    """Return what an ``rcl_interfaces/msg/ParameterValue`` holds; None when it is not set.

    Raises:
        RuntimeError: its type is none.
    """
    try:
        kind = ParameterType(parameter_value.type)
    except ValueError:
        raise RuntimeError(f"unexpected parameter type {parameter_value.type}") from None
    if kind == ParameterType.NOT_SET:
        return None
    value = getattr(parameter_value, _FIELDS[kind])
    return list(value) if isinstance(value, (array, list)) else value


def get_parameter_value(string_value: str) -> Any:
    """Return text, read as YAML, as an ``rcl_interfaces/msg/ParameterValue``."""
    return Parameter("", value=parse_value(string_value)).get_parameter_value()


def parameter_dict_from_yaml_file(
    parameter_file: str,
    use_wildcard: bool = False,
    target_nodes: list[str] | None = None,
    namespace: str = "",
) -> dict[str, Any]:
    """Return the parameters of a YAML file as ``rcl_interfaces/msg/Parameter`` by name.

    Args:
        parameter_file: its path.
        use_wildcard: take those under ``/**``, too.
        target_nodes: names of the nodes to take parameters of; all nodes when omitted.
        namespace: put before each name.

    Raises:
        RuntimeError: it has no such parameters.
        InputError: it is no parameter file.
    """
    content = load_yaml(Path(parameter_file))
    if not target_nodes:
        target_nodes = [str(key) for key in content if key != "/**"]
    chosen: dict[str, Any] = {}
    for node in ["/**"] * use_wildcard + list(target_nodes):
        absolute = node if node.startswith("/") else f"/{node}"
        space, _, name = absolute.rpartition("/")
        within = content.get(space)
        candidates = [content.get(absolute), content.get(name) if not space else None]
        candidates.append(within.get(name) if isinstance(within, dict) else None)
        for found in candidates:
            if isinstance(found, dict) and isinstance(found.get("ros__parameters"), dict):
                chosen |= dict(flatten(found["ros__parameters"], namespace))
    if not chosen:
        raise RuntimeError("Param file does not contain any valid parameters")
    return {name: Parameter(name, value=value).to_parameter_msg() for name, value in chosen.items()}

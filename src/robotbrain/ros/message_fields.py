"""Default values of message fields, and the checks of what is assigned to them.

Checks are those of rclpy with ``ROS_PYTHON_CHECK_FIELDS=1``: a float field takes ``float`` and not ``int``, so that a
file which passes here does not put garbage on a real wire.
"""

from __future__ import annotations

import functools
from array import array
from collections.abc import Callable
from typing import Any, NoReturn

import numpy as np

from robotbrain.errors import InputError
from robotbrain.ros.typedefs import FieldType

FLOAT32_MAX = 3.402823466e38


class FieldError(InputError, AssertionError):
    """A message field was given a value it cannot hold (genuine rclpy raises AssertionError)."""


# ---------------------------------------------------------------- defaults


def factory_of(kind: FieldType, default: Any, class_of: Callable[[str], Any]) -> Callable[[], Any]:
    """Return what makes a field's first value; ``class_of`` gives the class of a message type."""
    if default is not None:
        return lambda: default
    single = _single_factory(kind, class_of)
    if kind.shape == "single":
        return single
    if kind.shape == "sequence":
        code = kind.primitive.typecode if kind.primitive else ""
        return (lambda: array(code)) if code else list
    if kind.primitive is not None and kind.primitive.typecode:
        return functools.partial(np.zeros, kind.length, kind.primitive.dtype)
    return lambda: [single() for _ in range(kind.length)]


def _single_factory(kind: FieldType, class_of: Callable[[str], Any]) -> Callable[[], Any]:
    if kind.kind == "message":
        nested: Callable[[], Any] = class_of(kind.message)
        return nested
    if kind.kind == "string":
        return str
    assert kind.primitive is not None
    by_code: dict[str, Callable[[], Any]] = {"c": lambda: b"\x00", "?": bool, "f": float, "d": float}
    return by_code.get(kind.primitive.code, int)


# ---------------------------------------------------------------- checks


def check_of(
    label: str, kind: FieldType, store: Callable[[Any, Any], None], class_of: Callable[[str], Any]
) -> Callable[[Any, Any], None]:
    """Return ``check(message, value)`` that stores a good value and raises FieldError on a bad one."""
    element = _element_check(label, kind, class_of)
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


def _element_check(label: str, kind: FieldType, class_of: Callable[[str], Any]) -> Callable[[Any], Any]:
    if kind.kind == "message":
        wanted = class_of(kind.message)

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

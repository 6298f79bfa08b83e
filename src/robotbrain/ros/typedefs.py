"""Interface definitions (fields, constants, defaults) of every message and service type, read lazily.

The one place that talks to rosbags: the rest of the package sees :class:`FieldType` and :class:`StructDef`.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

from robotbrain.errors import InputError
from robotbrain.ros.action_definitions import ACTION_DEFINITIONS, MSG_DEFINITIONS, struct_texts
from robotbrain.ros.srv_definitions import FIELD_DEFAULTS, SRV_DEFINITIONS

PLACEHOLDER = "structure_needs_at_least_one_member"
"""Name of the byte that stands on the wire for a message without fields; Python classes do not show it."""


@dataclass(frozen=True, slots=True)
class Primitive:
    """A primitive wire type: IDL name, ``struct`` code, size in bytes, numpy dtype, ``array`` typecode.

    ``typecode`` is empty where rclpy keeps sequences of the type in plain lists (boolean and octet).
    """

    idl: str
    code: str
    size: int
    dtype: str
    typecode: str


PRIMITIVES: dict[str, Primitive] = {
    "bool": Primitive("boolean", "?", 1, "?", ""),
    "byte": Primitive("octet", "c", 1, "u1", ""),
    "octet": Primitive("octet", "c", 1, "u1", ""),
    "char": Primitive("uint8", "B", 1, "u1", "B"),
    "int8": Primitive("int8", "b", 1, "i1", "b"),
    "uint8": Primitive("uint8", "B", 1, "u1", "B"),
    "int16": Primitive("int16", "h", 2, "i2", "h"),
    "uint16": Primitive("uint16", "H", 2, "u2", "H"),
    "int32": Primitive("int32", "i", 4, "i4", "i"),
    "uint32": Primitive("uint32", "I", 4, "u4", "I"),
    "int64": Primitive("int64", "q", 8, "i8", "q"),
    "uint64": Primitive("uint64", "Q", 8, "u8", "Q"),
    "float32": Primitive("float", "f", 4, "f4", "f"),
    "float64": Primitive("double", "d", 8, "f8", "d"),
}


@dataclass(frozen=True, slots=True)
class FieldType:
    """Type of one field.

    Attributes:
        kind: ``"primitive"``, ``"string"`` or ``"message"``: what one element is.
        primitive: set when ``kind`` is ``"primitive"``.
        message: ROS type name (``pkg/msg/Name``) when ``kind`` is ``"message"``.
        string_bound: largest length of a string in characters, 0 for no bound.
        shape: ``"single"``, ``"array"`` (fixed length) or ``"sequence"``.
        length: elements of an array, upper bound of a sequence (0: none).
    """

    kind: str
    primitive: Primitive | None
    message: str
    string_bound: int
    shape: str
    length: int

    @property
    def idl(self) -> str:
        """The type as ``get_fields_and_field_types`` of genuine rclpy spells it, e.g. ``sequence<float>``."""
        if self.kind == "primitive":
            assert self.primitive is not None
            element = self.primitive.idl
        elif self.kind == "string":
            element = f"string<{self.string_bound}>" if self.string_bound else "string"
        else:
            package, _, name = self.message.split("/")
            element = f"{package}/{name}"
        if self.shape == "array":
            return f"{element}[{self.length}]"
        if self.shape == "sequence":
            return f"sequence<{element}, {self.length}>" if self.length else f"sequence<{element}>"
        return element


@dataclass(frozen=True, slots=True)
class StructDef:
    """One message: its fields in wire order, its constants, and defaults that differ from zero."""

    typename: str
    fields: tuple[tuple[str, FieldType], ...]
    constants: tuple[tuple[str, Any], ...]
    defaults: dict[str, Any]


@functools.cache
def typestore() -> Any:
    """Return the rosbags store of ROS 2 Kilted with the kit's services and actions added as the messages they are."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_KILTED)
    texts = dict(MSG_DEFINITIONS)
    for name, text in SRV_DEFINITIONS.items():
        request, _, response = text.partition("---")
        texts |= {name + "_Request": request, name + "_Response": response}
    for name, text in ACTION_DEFINITIONS.items():
        texts |= struct_texts(name, text)
    store.register(
        {
            name: get_types_from_msg((text.strip() or f"uint8 {PLACEHOLDER}") + "\n", "a/msg/B")["a/msg/B"]
            for name, text in texts.items()
        }
    )
    return store


@functools.cache
def typenames() -> frozenset[str]:
    """Names of all struct types: messages, and the parts of services and actions."""
    return frozenset(typestore().fielddefs)


@functools.cache
def packages() -> frozenset[str]:
    """Names of all interface packages, e.g. ``geometry_msgs``."""
    return frozenset(name.split("/")[0] for name in typenames())


@functools.cache
def struct_def(typename: str) -> StructDef:
    """Return the definition of ``typename`` (``pkg/msg/Name``).

    Raises:
        InputError: the type is not in the store.
    """
    try:
        constants, fields = typestore().fielddefs[typename]
    except KeyError:
        raise InputError(
            "message type",
            given=typename,
            expected="a standard type such as 'geometry_msgs/msg/Twist'",
            fix="Check the spelling; further types are added in robotbrain.ros.srv_definitions and action_definitions.",
        ) from None
    converted = tuple((name, _field_type(desc)) for name, desc in fields)
    defaults = {name: FIELD_DEFAULTS[typename, name] for name, _ in converted if (typename, name) in FIELD_DEFAULTS}
    return StructDef(
        typename, converted, tuple((name, _constant(kind, value)) for name, kind, value in constants), defaults
    )


def _constant(kind: str, value: Any) -> Any:
    return bytes([value]) if kind in ("byte", "octet") else value


def _field_type(desc: Any) -> FieldType:
    kind, value = desc
    shape, length = "single", 0
    if kind.name in ("ARRAY", "SEQUENCE"):
        shape = kind.name.lower()
        (kind, value), length = value
    if kind.name == "NAME":
        return FieldType("message", None, str(value), 0, shape, length)
    name, bound = value
    if name == "string":
        return FieldType("string", None, "", bound, shape, length)
    return FieldType("primitive", PRIMITIVES[name], "", 0, shape, length)

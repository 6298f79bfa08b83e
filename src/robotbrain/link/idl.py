"""Message types of the kit as the types of Cyclone DDS, so that its readers and writers match those of ROS 2.

ROS 2 puts ``pkg/msg/Name`` on DDS as the type ``pkg::msg::dds_::Name_`` and the topic ``/x`` as ``rt/x``
(https://design.ros2.org/articles/topic_and_service_names.html).
"""

from __future__ import annotations

import dataclasses
import functools
import types
from typing import Any

from robotbrain.errors import InputError, MissingDependencyError
from robotbrain.ros.typedefs import FieldType, struct_def


def require_cyclone() -> None:
    """Raise MissingDependencyError unless Cyclone DDS is installed."""
    try:
        import cyclonedds.idl  # noqa: F401
    except ImportError:
        raise MissingDependencyError(
            "cyclonedds", needed_for="--transport dds", install="pip install 'robotbrain[dds]'"
        ) from None


def dds_topic(name: str) -> str:
    """Return the DDS topic of an absolute ROS topic name."""
    return f"rt{name}"


def ros_topic(name: str) -> str | None:
    """Return the ROS topic of a DDS topic, None where it is none."""
    return name.removeprefix("rt") if name.startswith("rt/") else None


def dds_type(type_name: str) -> str:
    """Return the DDS type name of ``pkg/msg/Name``, in the spelling of Cyclone's Python (dots)."""
    package, kind, name = type_name.split("/")
    return f"{package}.{kind}.dds_.{name}_"


def ros_type(name: str) -> str:
    """Return ``pkg/msg/Name`` of a DDS type name; unknown patterns as they are."""
    parts = name.replace("::", ".").split(".")
    if len(parts) == 4 and parts[2] == "dds_" and parts[3].endswith("_"):
        return f"{parts[0]}/{parts[1]}/{parts[3][:-1]}"
    return name


@functools.cache
def idl_class(type_name: str) -> Any:
    """Return the Cyclone class of a message type.

    Raises:
        InputError: a type that the kit does not know.
        MissingDependencyError: no Cyclone DDS.
    """
    require_cyclone()
    from cyclonedds.idl import IdlStruct

    annotations = {name: _annotation(kind) for name, kind in struct_def(type_name).fields}
    # Made by hand: Cyclone reads the annotations as objects, which a class statement with postponed annotations
    # does not have.
    made = types.new_class(
        type_name.rpartition("/")[2] + "_",
        (IdlStruct,),
        {"typename": dds_type(type_name)},
        lambda body: body.update({"__annotations__": annotations, "__module__": __name__}),
    )
    return dataclasses.dataclass(made)


def _annotation(kind: FieldType) -> Any:
    from cyclonedds.idl import types as idl

    element: Any
    if kind.kind == "message":
        element = idl_class(kind.message)
    elif kind.kind == "string":
        element = idl.bounded_str[kind.string_bound] if kind.string_bound else str
    else:
        assert kind.primitive is not None
        element = _primitives().get(kind.primitive.idl)
        if element is None:
            raise InputError(
                "field type", given=kind.primitive.idl, expected="a type of DDS", fix="Report this, please."
            )
    if kind.shape == "array":
        return idl.array[element, kind.length]
    if kind.shape == "sequence":
        return idl.sequence[element, kind.length] if kind.length else idl.sequence[element]
    return element


@functools.cache
def _primitives() -> dict[str, Any]:
    from cyclonedds.idl import types as idl

    names = ("int8", "uint8", "int16", "uint16", "int32", "uint32", "int64", "uint64")
    return {
        "boolean": bool,
        "octet": idl.byte,
        "float": idl.float32,
        "double": idl.float64,
        **{name: getattr(idl, name) for name in names},
    }

"""Reading single parts of the protobuf: stored tensors, attributes, types."""

from __future__ import annotations

from typing import Any

import numpy as np
import onnx
from onnx import helper, numpy_helper

from robotbrain.errors import InputError
from robotbrain.jetson.graph import folding
from robotbrain.jetson.graph.ir import Tensor, checked_shape


def stored_tensor(proto: Any, name: str) -> Tensor:
    """Return a stored tensor: its shape and type, and its content only if that is small and in the file.

    Raises:
        InputError: for impossible dimensions, or content that does not fill them.
    """
    shape = checked_shape(tuple(proto.dims), f"initialiser {name!r}")
    tensor = Tensor(name, shape, proto.data_type, const=True, roots=frozenset({name}))
    if tensor.elems > folding.MAX_FOLDED or proto.data_type not in folding.NUMPY_TYPES or proto.external_data:
        return tensor
    filled = proto.raw_data or any(
        len(field) for field in (proto.float_data, proto.int32_data, proto.int64_data, proto.double_data)
    )
    if not filled and not len(proto.uint64_data):
        # No content: a weight that was stripped from the file; its shape is all that counts here.
        tensor.value = np.zeros(shape, folding.NUMPY_TYPES[proto.data_type]) if tensor.elems == 0 else None
        return tensor
    try:
        value = numpy_helper.to_array(proto)
    except Exception as error:  # numpy and onnx raise several kinds for data that does not fit
        raise InputError(
            f"initialiser {name!r}",
            given=f"data that does not fill shape {shape}",
            expected="as many values as the shape has elements",
            fix="The file is damaged; export or download it again.",
        ) from error
    tensor.value = value
    return tensor


def attributes(proto: Any) -> dict[str, Any]:
    """Return a node's attribute values by name; tensors and graphs stay protobufs, strings become text."""
    attrs: dict[str, Any] = {}
    for attribute in proto.attribute:
        if attribute.type == onnx.AttributeProto.TENSOR:
            attrs[attribute.name] = attribute.t
            continue
        try:
            value = helper.get_attribute_value(attribute)
        except ValueError:
            value = None
        if isinstance(value, bytes):
            value = value.decode("utf-8", errors="replace")
        elif isinstance(value, tuple) or type(value).__name__.startswith("Repeated"):
            value = list(value)
        attrs[attribute.name] = value
    return attrs


def static_type(type_proto: Any) -> tuple[tuple[int, ...] | None, int]:
    """Return (shape or None, element type) of a TypeProto."""
    if type_proto is None or not type_proto.HasField("tensor_type"):
        return None, 0
    tensor = type_proto.tensor_type
    if not tensor.HasField("shape"):
        return None, tensor.elem_type
    dims = tensor.shape.dim
    if any(dim.WhichOneof("value") != "dim_value" for dim in dims):
        return None, tensor.elem_type
    return tuple(dim.dim_value for dim in dims), tensor.elem_type

"""Giving every axis of the inputs a length."""

from __future__ import annotations

import operator
import re
from collections.abc import Mapping
from typing import Any

from robotbrain.errors import InputError
from robotbrain.jetson.graph.ir import MAX_DIM, Tensor, checked_shape

_BATCH = re.compile(r"(n|b|bs|bsz|.*batch.*)\Z", re.IGNORECASE)


def bind_inputs(
    inputs: list[Any], bindings: Mapping[str, int] | None, opset_types: frozenset[int]
) -> tuple[list[Tensor], list[str]]:
    """Return the inputs with static shapes, and warnings.

    Args:
        inputs: ValueInfoProtos of the inputs that are not initialisers.
        bindings: length by symbolic name (``"height"``) or by ``"input:axis"``.
        opset_types: element types that are known.

    Raises:
        InputError: for an axis without a length, or a binding that fits no axis.
    """
    lengths = _checked(bindings)
    used: set[str] = set()
    known: set[str] = set()
    missing: list[str] = []
    warnings: list[str] = []
    tensors: list[Tensor] = []
    for info in inputs:
        dtype, dims = _declared(info, opset_types)
        shape: list[int] = []
        for axis, dim in enumerate(dims):
            spot = f"{info.name}:{axis}"
            symbol, size = _axis(dim)
            known.update(key for key in (spot, symbol) if key)
            key = spot if spot in lengths else symbol
            if size is not None and spot not in lengths:
                shape.append(size)
            elif size is not None and lengths[spot] != size:
                raise InputError(
                    f"binding {spot!r}",
                    given=lengths[spot],
                    expected=f"{size}, which the model fixes",
                    fix="Leave the binding out, or export the model with that axis dynamic.",
                )
            elif key in lengths:
                used.add(key)
                shape.append(lengths[key])
            elif axis == 0 and symbol and _BATCH.match(symbol):
                shape.append(1)
                warnings.append(f"axis {symbol!r} of input {info.name!r} is taken as a batch of 1")
            else:
                missing.append(f"{symbol or 'nameless'} ({spot})")
                shape.append(1)
        tensors.append(Tensor(info.name, checked_shape(tuple(shape), f"input {info.name!r}"), dtype))
    if missing:
        first = missing[0].split(" ")[0]
        example = first if first != "nameless" else missing[0].split("(")[1][:-1]
        raise InputError(
            "dynamic axes",
            given="no length for " + ", ".join(missing),
            expected="a length for each",
            fix=f"Pass bindings={{{example!r}: 224}}, or --bind {example}=224; 'input:axis' works as a key too.",
        )
    if unknown := sorted(set(lengths) - known):
        raise InputError(
            "bindings",
            given=", ".join(unknown),
            expected="names of axes: " + (", ".join(sorted(known)) or "the model has none"),
            fix="Check the spelling; keys are symbolic names or 'input:axis'.",
        )
    return tensors, warnings


def _checked(bindings: Mapping[str, int] | None) -> dict[str, int]:
    lengths: dict[str, int] = {}
    for key, value in dict(bindings or {}).items():
        try:
            length = operator.index(value)
        except TypeError:
            length = 0
        if isinstance(value, bool) or not 1 <= length <= MAX_DIM:
            raise InputError(
                f"binding {key!r}",
                given=value,
                expected=f"a whole number of 1 to {MAX_DIM}",
                fix="Give the axis the length it has when the network runs.",
            )
        lengths[str(key)] = length
    return lengths


def _declared(info: Any, known_types: frozenset[int]) -> tuple[int, list[Any]]:
    kind = info.type.WhichOneof("value")
    if kind != "tensor_type" or info.type.tensor_type.elem_type not in known_types:
        raise InputError(
            f"input {info.name!r}",
            given=kind if kind != "tensor_type" else f"element type {info.type.tensor_type.elem_type}",
            expected="a tensor of numbers",
            fix="TensorRT takes no sequences, maps, strings or optional inputs; change the exported interface.",
        )
    tensor = info.type.tensor_type
    if not tensor.HasField("shape"):
        raise InputError(
            f"input {info.name!r}",
            given="no shape",
            expected="a shape, its axes fixed or named",
            fix="Declare the input's shape when exporting (onnx.tools.update_model_dims can add it).",
        )
    return tensor.elem_type, list(tensor.shape.dim)


def _axis(dim: Any) -> tuple[str, int | None]:
    """Return (symbolic name or "", length or None)."""
    if dim.WhichOneof("value") == "dim_value" and dim.dim_value > 0:
        return "", dim.dim_value
    # Some exporters write -1 or 0 where the length is open.
    return dim.dim_param, None

"""Constant folding of the small tensors that shapes, axes and scales are computed from.

Exporters spell `x.view(n, -1, h * w)` as a dozen operators over one-dimensional integers. Only tensors of at most
MAX_FOLDED elements are computed: weights are of no interest here, and a file must not make us fill the memory.
Semantics are those of https://onnx.ai/onnx/operators/.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robotbrain.jetson.graph.ir import Node

MAX_FOLDED = 8192
"""Most elements of a tensor whose content is followed."""

Array = NDArray[Any]
Inputs = list[Array | None]

# Element types whose content numpy holds exactly (TensorProto.DataType).
NUMPY_TYPES: dict[int, type[np.generic]] = {
    1: np.float32,
    2: np.uint8,
    3: np.int8,
    4: np.uint16,
    5: np.int16,
    6: np.int32,
    7: np.int64,
    9: np.bool_,
    10: np.float16,
    11: np.float64,
    12: np.uint32,
    13: np.uint64,
}


def evaluate(node: Node, inputs: Inputs, out_shapes: list[tuple[int, ...]]) -> list[Array] | None:
    """Return the outputs of a node whose inputs are all known, or None if that cannot be told.

    Args:
        node: the operator.
        inputs: content of each input, None where an optional one is left out.
        out_shapes: of the outputs, as inferred; a result of another shape is not believed.
    """
    rule = _RULES.get(node.op)
    if rule is None or node.domain or any(math.prod(shape) > MAX_FOLDED for shape in out_shapes):
        return None
    try:
        with np.errstate(all="ignore"):
            made = rule(node, inputs)
    except (TypeError, ValueError, IndexError, OverflowError, ZeroDivisionError, AttributeError, KeyError):
        return None  # a malformed node: what it yields stays unknown, and whoever needs it will say so
    if made is None:
        return None
    outputs = [np.asarray(item) for item in (made if isinstance(made, list) else [made])]
    if [output.shape for output in outputs] != out_shapes or any(output.dtype == object for output in outputs):
        return None
    return outputs


def _need(inputs: Inputs, position: int) -> Array:
    value = inputs[position]
    if value is None:
        raise ValueError("a required input is left out")
    return value


def _maybe(inputs: Inputs, position: int) -> Array | None:
    return inputs[position] if position < len(inputs) else None


def _whole(value: Array | None) -> tuple[int, ...]:
    return () if value is None else tuple(int(item) for item in value.ravel())


def _axes(node: Node, inputs: Inputs, position: int = 1) -> tuple[int, ...] | None:
    if "axes" in node.attrs:
        return node.integers("axes")
    value = _maybe(inputs, position)
    return None if value is None else tuple(int(axis) for axis in value.ravel())


def _unary(function: Callable[[Array], Any]) -> Callable[[Node, Inputs], Any]:
    def rule(node: Node, inputs: Inputs) -> Any:
        value = _need(inputs, 0)
        return np.asarray(function(value)).astype(value.dtype)

    return rule


def _binary(function: Callable[[Array, Array], Any], *, keeps: bool = True) -> Callable[[Node, Inputs], Any]:
    def rule(node: Node, inputs: Inputs) -> Any:
        left, right = _need(inputs, 0), _need(inputs, 1)
        made = np.asarray(function(left, right))
        return made.astype(left.dtype) if keeps else made

    return rule


def _folded(function: Callable[[Array, Array], Any]) -> Callable[[Node, Inputs], Any]:
    def rule(node: Node, inputs: Inputs) -> Any:
        made = _need(inputs, 0)
        for position in range(1, len(inputs)):
            made = np.asarray(function(made, _need(inputs, position)))
        return made

    return rule


def _divide(left: Array, right: Array) -> Any:
    if left.dtype.kind in "iu":
        if not right.all():
            raise ZeroDivisionError
        quotient = np.abs(left) // np.abs(right)  # ONNX truncates towards zero, as C does
        return np.sign(left) * np.sign(right) * quotient
    return left / right


def _modulo(node: Node, inputs: Inputs) -> Any:
    left, right = _need(inputs, 0), _need(inputs, 1)
    if right.dtype.kind in "iu" and not right.all():
        raise ZeroDivisionError
    return np.fmod(left, right) if node.integer("fmod", 0) else np.mod(left, right)


def _cast(node: Node, inputs: Inputs) -> Any:
    value, target = _need(inputs, 0), NUMPY_TYPES[node.integer("to", 1)]
    if value.dtype.kind == "f" and target is not np.bool_ and not np.isfinite(value).all():
        return value.astype(target) if np.dtype(target).kind == "f" else None
    return value.astype(target)


def _concat(node: Node, inputs: Inputs) -> Any:
    return np.concatenate([_need(inputs, position) for position in range(len(inputs))], axis=node.integer("axis", 0))


def _gather(node: Node, inputs: Inputs) -> Any:
    return np.take(_need(inputs, 0), _need(inputs, 1), axis=node.integer("axis", 0))


def _unsqueeze(node: Node, inputs: Inputs) -> Any:
    return np.expand_dims(_need(inputs, 0), _axes(node, inputs) or ())


def _squeeze(node: Node, inputs: Inputs) -> Any:
    return np.squeeze(_need(inputs, 0), axis=_axes(node, inputs))


def _reshape(node: Node, inputs: Inputs) -> Any:
    value, target = _need(inputs, 0), [int(size) for size in _need(inputs, 1)]
    if not node.integer("allowzero", 0):
        target = [value.shape[axis] if size == 0 else size for axis, size in enumerate(target)]
    return value.reshape(target)


def _flatten(node: Node, inputs: Inputs) -> Any:
    value = _need(inputs, 0)
    return value.reshape(math.prod(value.shape[: node.integer("axis", 1)]), -1)


def _transpose(node: Node, inputs: Inputs) -> Any:
    value = _need(inputs, 0)
    return value.transpose(node.integers("perm") or tuple(range(value.ndim))[::-1])


def slice_ranges(node: Node, inputs: Inputs, shape: tuple[int, ...]) -> list[tuple[int, int, int]]:
    """Return start, stop and step of each axis of a Slice.

    Raises:
        ValueError, IndexError: for starts, ends or axes that are missing or do not fit the shape.
    """
    steps: tuple[int, ...] = ()
    if "starts" in node.attrs:
        starts, ends, axes = node.integers("starts"), node.integers("ends"), node.integers("axes")
    else:
        starts, ends = _whole(_need(inputs, 1)), _whole(_need(inputs, 2))
        axes, steps = _whole(_maybe(inputs, 3)), _whole(_maybe(inputs, 4))
    axes = axes or tuple(range(len(starts)))
    steps = steps or (1,) * len(starts)
    ranges = [(0, size, 1) for size in shape]
    for axis, start, end, step in zip(axes, starts, ends, steps, strict=True):
        ranges[axis] = slice(start, end, step).indices(shape[axis])
    return ranges


def _slice(node: Node, inputs: Inputs) -> Any:
    value = _need(inputs, 0)
    made = value
    for axis, (start, stop, step) in enumerate(slice_ranges(node, inputs, value.shape)):
        made = np.take(made, np.arange(start, stop, step), axis=axis)
    return made


def _split(node: Node, inputs: Inputs) -> Any:
    value, axis = _need(inputs, 0), node.integer("axis", 0)
    given = _maybe(inputs, 1)
    sizes = node.integers("split") if given is None else tuple(given.ravel().tolist())
    if not sizes:
        part = -(-value.shape[axis] // len(node.outputs))
        sizes = (part,) * len(node.outputs)
    return np.split(value, np.cumsum(sizes)[:-1], axis=axis)


def _full(node: Node, inputs: Inputs) -> Any:
    shape = tuple(int(size) for size in _need(inputs, 0).ravel())
    if math.prod(shape) > MAX_FOLDED:
        return None
    fill = node.attrs.get("value")
    if fill is None:
        return np.zeros(shape, np.float32)
    import onnx.numpy_helper

    return np.full(shape, onnx.numpy_helper.to_array(fill).ravel()[0])


def _range(node: Node, inputs: Inputs) -> Any:
    start, limit, delta = (_need(inputs, position).item() for position in range(3))
    count = max(0, math.ceil((limit - start) / delta))
    if count > MAX_FOLDED:
        return None
    return (start + delta * np.arange(count)).astype(_need(inputs, 0).dtype)


def _expand(node: Node, inputs: Inputs) -> Any:
    value, shape = _need(inputs, 0), tuple(int(size) for size in _need(inputs, 1).ravel())
    target = np.broadcast_shapes(value.shape, shape)
    return None if math.prod(target) > MAX_FOLDED else np.broadcast_to(value, target)


def _tile(node: Node, inputs: Inputs) -> Any:
    value, repeats = _need(inputs, 0), [int(item) for item in _need(inputs, 1).ravel()]
    return None if value.size * math.prod(repeats) > MAX_FOLDED else np.tile(value, repeats)


def _reduce(function: Callable[..., Any]) -> Callable[[Node, Inputs], Any]:
    def rule(node: Node, inputs: Inputs) -> Any:
        value, axes = _need(inputs, 0), _axes(node, inputs)
        if not axes and node.integer("noop_with_empty_axes", 0):
            return value
        made = function(value, axis=axes or None, keepdims=bool(node.integer("keepdims", 1)))
        return np.asarray(made).astype(value.dtype)

    return rule


def _where(node: Node, inputs: Inputs) -> Any:
    return np.where(_need(inputs, 0), _need(inputs, 1), _need(inputs, 2))


def _nonzero(node: Node, inputs: Inputs) -> Any:
    return np.array(np.nonzero(_need(inputs, 0)), dtype=np.int64)


def _clip(node: Node, inputs: Inputs) -> Any:
    low, high = _maybe(inputs, 1), _maybe(inputs, 2)
    value = _need(inputs, 0)
    return np.clip(value, node.attrs.get("min", low), node.attrs.get("max", high)).astype(value.dtype)


def _scatter_nd(node: Node, inputs: Inputs) -> Any:
    made, indices, updates = _need(inputs, 0).copy(), _need(inputs, 1), _need(inputs, 2)
    for spot in np.ndindex(indices.shape[:-1]):
        made[tuple(indices[spot])] = updates[spot]
    return made


def _identity(node: Node, inputs: Inputs) -> Any:
    return _need(inputs, 0)


_RULES: dict[str, Callable[[Node, Inputs], Any]] = {
    "Abs": _unary(np.abs),
    "Add": _binary(np.add),
    "And": _binary(np.logical_and, keeps=False),
    "Cast": _cast,
    "Ceil": _unary(np.ceil),
    "Clip": _clip,
    "Concat": _concat,
    "ConstantOfShape": _full,
    "Div": _binary(_divide),
    "Equal": _binary(np.equal, keeps=False),
    "Exp": _unary(np.exp),
    "Expand": _expand,
    "Flatten": _flatten,
    "Floor": _unary(np.floor),
    "Gather": _gather,
    "Greater": _binary(np.greater, keeps=False),
    "GreaterOrEqual": _binary(np.greater_equal, keeps=False),
    "Identity": _identity,
    "Less": _binary(np.less, keeps=False),
    "LessOrEqual": _binary(np.less_equal, keeps=False),
    "Log": _unary(np.log),
    "Max": _folded(np.maximum),
    "Min": _folded(np.minimum),
    "Mod": _modulo,
    "Mul": _binary(np.multiply),
    "Neg": _unary(np.negative),
    "NonZero": _nonzero,
    "Not": _unary(np.logical_not),
    "Or": _binary(np.logical_or, keeps=False),
    "Pow": _binary(np.power),
    "Range": _range,
    "Reciprocal": _unary(np.reciprocal),
    "ReduceMax": _reduce(np.max),
    "ReduceMin": _reduce(np.min),
    "ReduceProd": _reduce(np.prod),
    "ReduceSum": _reduce(np.sum),
    "Reshape": _reshape,
    "Round": _unary(np.round),
    "ScatterND": _scatter_nd,
    "Sign": _unary(np.sign),
    "Slice": _slice,
    "Split": _split,
    "Sqrt": _unary(np.sqrt),
    "Squeeze": _squeeze,
    "Sub": _binary(np.subtract),
    "Sum": _folded(np.add),
    "Tile": _tile,
    "Transpose": _transpose,
    "Unsqueeze": _unsqueeze,
    "Where": _where,
    "Xor": _binary(np.logical_xor, keeps=False),
}

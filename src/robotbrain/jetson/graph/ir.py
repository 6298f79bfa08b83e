"""The graph inside the analyser: tensors of known shape, nodes in running order, and who reads what."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

from numpy.typing import NDArray

from robotbrain.errors import InputError

MAX_DIM = 2**31 - 1
"""Longest axis: TensorRT's dimensions are 32-bit."""

MAX_ELEMS = 2**40
"""Largest tensor that is taken seriously (a tebi-element fits no Jetson)."""

FLOAT_TYPES = frozenset({1, 10, 11, 16, 17, 18, 19, 20, 23, 24})
"""ONNX element types that are floating point: float32, float16, float64, bfloat16, the float8 kinds and float4."""

INT8_TYPES = frozenset({2, 3})
"""ONNX element types that TensorRT runs as INT8: uint8 and int8."""

# Bits of the packed types (TensorProto.DataType); everything else is looked up in onnx.
_PACKED_BITS = {21: 4, 22: 4, 23: 4, 25: 2, 26: 2}
_BYTES = {1: 4, 2: 1, 3: 1, 4: 2, 5: 2, 6: 4, 7: 8, 9: 1, 10: 2, 11: 8, 12: 4, 13: 8, 14: 8, 15: 16, 16: 2}


def stored_bytes(dtype: int, elems: int) -> int:
    """Return the bytes that ``elems`` elements of an ONNX element type take in a file."""
    if dtype in _PACKED_BITS:
        return -(-elems * _PACKED_BITS[dtype] // 8)
    return elems * _BYTES.get(dtype, 1)


def checked_shape(shape: tuple[int, ...], owner: str) -> tuple[int, ...]:
    """Return ``shape`` if a device could hold it.

    Raises:
        InputError: for a negative axis, one of more than MAX_DIM, or more than MAX_ELEMS elements.
    """
    if any(size < 0 or size > MAX_DIM for size in shape) or math.prod(shape) > MAX_ELEMS:
        raise InputError(
            f"shape of {owner}",
            given=shape,
            expected=f"axes of 0 to {MAX_DIM} and at most {MAX_ELEMS} elements",
            fix="The file is damaged, or an axis was bound to far too large a number.",
        )
    return shape


@dataclass(slots=True)
class Tensor:
    """One value of the graph.

    Attributes:
        name: unique in the graph.
        shape: every axis known.
        dtype: ONNX element type (TensorProto.DataType).
        const: whether it is the same in every inference, so that a builder computes it once.
        value: what a constant holds, kept only where it is small enough to be a shape, an axis or a scale.
        roots: names of the stored tensors that a constant is made from.
        quantized: whether a constant came through DequantizeLinear from 8-bit integers.
    """

    name: str
    shape: tuple[int, ...]
    dtype: int
    const: bool = False
    value: NDArray[Any] | None = None
    roots: frozenset[str] = frozenset()
    quantized: bool = False

    @property
    def elems(self) -> int:
        """Number of elements."""
        return math.prod(self.shape)


@dataclass(slots=True, eq=False)
class Node:
    """One operator.

    Attributes:
        op: operator name, e.g. ``"Conv"``.
        name: of the layer, unique in the graph.
        inputs, outputs: tensor names; ``""`` marks an optional one that is left out.
        attrs: attribute values by name.
        domain: ``""`` for ONNX's own operators.
        version: opset in force for that domain.
        index: place in running order.
        sources: names of the layers it stands for, where a pattern replaced several.
    """

    op: str
    name: str
    inputs: list[str]
    outputs: list[str]
    attrs: dict[str, Any] = field(default_factory=dict)
    domain: str = ""
    version: int = 0
    index: int = 0
    sources: tuple[str, ...] = ()

    @property
    def layers(self) -> tuple[str, ...]:
        """Names of all layers that it stands for."""
        return self.sources or (self.name,)

    def input(self, position: int) -> str:
        """Return the name of an input, or ``""`` where it is left out."""
        return self.inputs[position] if position < len(self.inputs) else ""

    def integer(self, name: str, default: int) -> int:
        """Return an integer attribute.

        Raises:
            InputError: if the file holds something else under that name.
        """
        value = self.attrs.get(name, default)
        if not isinstance(value, int):
            raise self._wrong(name, value, "a whole number")
        return value

    def integers(self, name: str, default: tuple[int, ...] = ()) -> tuple[int, ...]:
        """Return a list-of-integers attribute.

        Raises:
            InputError: if the file holds something else under that name.
        """
        value = self.attrs.get(name, default)
        if not isinstance(value, (list, tuple)) or not all(isinstance(item, int) for item in value):
            raise self._wrong(name, value, "a list of whole numbers")
        return tuple(value)

    def text(self, name: str, default: str) -> str:
        """Return a string attribute.

        Raises:
            InputError: if the file holds something else under that name.
        """
        value = self.attrs.get(name, default)
        if not isinstance(value, str):
            raise self._wrong(name, value, "a string")
        return value

    def _wrong(self, name: str, value: object, expected: str) -> InputError:
        return InputError(
            f"attribute {name} of {self.op} {self.name!r}",
            given=value,
            expected=expected,
            fix="The model breaks the ONNX specification; check it with onnx.checker.",
        )


@dataclass(slots=True)
class Graph:
    """A model without its constants' computation: nodes that run in every inference, in order.

    Attributes:
        nodes: in running order; ``index`` is the place in this list.
        tensors: by name, constants included.
        inputs, outputs: tensor names.
        producer: node that writes a tensor.
        consumers: nodes that read a tensor, in order, each once.
        warnings: what had to be assumed.
    """

    nodes: list[Node]
    tensors: dict[str, Tensor]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    warnings: list[str] = field(default_factory=list)
    producer: dict[str, Node] = field(default_factory=dict)
    consumers: dict[str, list[Node]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.relink()

    def relink(self) -> None:
        """Drop nodes that no output needs, number the rest, and note who reads what."""
        needed = set(self.outputs)
        kept: list[Node] = []
        for node in reversed(self.nodes):
            if any(output in needed for output in node.outputs):
                kept.append(node)
                needed.update(node.inputs)
        self.nodes = kept[::-1]
        self.producer, self.consumers = {}, {}
        for index, node in enumerate(self.nodes):
            node.index = index
            for output in node.outputs:
                self.producer[output] = node
            for name in dict.fromkeys(node.inputs):
                self.consumers.setdefault(name, []).append(node)

    def warn(self, message: str) -> None:
        """Note an assumption once."""
        if message not in self.warnings:
            self.warnings.append(message)

    def readers(self, name: str) -> list[Node]:
        """Return the nodes that read a tensor."""
        return self.consumers.get(name, [])

    def activations(self, node: Node) -> Iterator[str]:
        """Yield the inputs of a node that change from one inference to the next."""
        for name in node.inputs:
            if name and not self.tensors[name].const:
                yield name

    def constants(self, node: Node) -> Iterator[str]:
        """Yield the inputs of a node that are constant."""
        for name in node.inputs:
            if name and self.tensors[name].const:
                yield name

    def shape(self, name: str) -> tuple[int, ...]:
        """Return a tensor's shape."""
        return self.tensors[name].shape

    def elems(self, name: str) -> int:
        """Return a tensor's number of elements."""
        return self.tensors[name].elems

    def value(self, node: Node, position: int) -> NDArray[Any] | None:
        """Return what a constant input holds, or None if it is left out, not constant, or too large to be kept."""
        name = node.input(position)
        return self.tensors[name].value if name else None

    def axes(self, node: Node, position: int = 1) -> tuple[int, ...] | None:
        """Return ``axes``, given as attribute (older opsets) or as input, or None."""
        if "axes" in node.attrs:
            return node.integers("axes")
        value = self.value(node, position)
        return None if value is None else tuple(int(axis) for axis in value.ravel())

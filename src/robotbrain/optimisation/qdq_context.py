"""A Q/DQ model and the questions that lint rules ask of it, and what they answer."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robotbrain.jetson.software import JetPack
from robotbrain.optimisation.onnx_files import check_graph
from robotbrain.optimisation.qdq_graph import producers, readers

Q, DQ = "QuantizeLinear", "DequantizeLinear"

UINT8, INT8, INT32 = 2, 3, 6
"""Element types of ONNX (TensorProto.DataType)."""


@dataclass(frozen=True, slots=True)
class Finding:
    """Something about a Q/DQ model that TensorRT refuses, or that costs time.

    Attributes:
        code: short stable word for the rule, e.g. ``zero-point``.
        severity: ``error`` (it will not build, or not compute what it says) or ``warning`` (it costs time, or needs
            care).
        node: name of the node, tensor or input; empty for the whole file.
        message: what is the matter.
        fix: what to do.
    """

    code: str
    severity: str
    node: str
    message: str
    fix: str


class Context:
    """A model and the questions that rules ask of it.

    Args:
        model: an ``onnx.ModelProto``.
        jetpack: release that is to build it; None for any from 5.0.2 on.

    Raises:
        InputError: for a graph that is none: see ``onnx_files.check_graph``.
    """

    def __init__(self, model: Any, jetpack: JetPack | None = None) -> None:
        check_graph(model)
        self.model, self.jetpack = model, jetpack
        self.made, self.read = producers(model), readers(model)
        self.outputs = {info.name for info in model.graph.output}

    @cached_property
    def stored(self) -> dict[str, Any]:
        """Constant tensors by name: initialisers, and what Constant nodes hold."""
        found = {tensor.name: tensor for tensor in self.model.graph.initializer}
        for node in self.model.graph.node:
            if node.op_type == "Constant":
                for attribute in node.attribute:
                    if attribute.name == "value":
                        found[node.output[0]] = attribute.t
        return found

    @property
    def tensorrt(self) -> tuple[int, int]:
        """Version of TensorRT that is to build the model; the oldest in question, 8.4, where no JetPack is given."""
        if self.jetpack is None:
            return 8, 4
        major, minor = (self.jetpack.tensorrt.text + ".0").split(".")[:2]
        return int(major), int(minor)

    def nodes(self, *ops: str) -> Iterator[Any]:
        """Yield the nodes of some operators, in order."""
        for node in self.model.graph.node:
            if node.op_type in ops:
                yield node

    def value(self, name: str) -> NDArray[Any] | None:
        """Return what a constant tensor holds; None if it is not constant or cannot be read."""
        import onnx

        try:
            return np.asarray(onnx.numpy_helper.to_array(self.stored[name])) if name in self.stored else None
        except Exception:  # types that numpy does not know, or content that is missing
            return None

    def source(self, name: str, op: str) -> Any | None:
        """Return the node that computes a tensor, if it is of that operator."""
        node = self.made.get(name)
        return node if node is not None and node.op_type == op else None

    def pair(self, name: str) -> tuple[Any, Any] | None:
        """Return the Q and the DQ that a tensor comes through, or None."""
        dequantise = self.source(name, DQ)
        quantise = self.source(dequantise.input[0], Q) if dequantise is not None else None
        return None if quantise is None else (quantise, dequantise)

    def integer_type(self, node: Any) -> int | None:
        """Return the ONNX type of the integers that a Q writes or a DQ reads; None if it cannot be known."""
        if len(node.input) > 2 and node.input[2]:
            kept = self.stored.get(node.input[2])
            return None if kept is None else int(kept.data_type)
        if node.op_type == Q:
            return next((int(a.i) for a in node.attribute if a.name == "output_dtype" and a.i), UINT8)
        if node.input[0] in self.stored:
            return int(self.stored[node.input[0]].data_type)
        quantise = self.source(node.input[0], Q)
        return None if quantise is None else self.integer_type(quantise)

    def constant(self, node: Any) -> bool:
        """Whether a Q or DQ works on a weight or bias rather than on an activation."""
        name = node.input[0]
        quantise = self.source(name, Q) if node.op_type == DQ else None
        return (quantise.input[0] if quantise is not None else name) in self.stored


def label(node: Any) -> str:
    """Return a node's name, or that of what it computes."""
    return str(node.name or node.output[0])


def axis_of(node: Any) -> int:
    """Return the axis attribute of a Q or DQ: 1 where it is left out, as ONNX says."""
    return next((int(a.i) for a in node.attribute if a.name == "axis"), 1)

"""Small ONNX graphs for the analyser's tests."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

Shape = Sequence[int | str | None]


def model(
    nodes: Sequence[onnx.NodeProto],
    inputs: Mapping[str, Shape],
    outputs: Sequence[str],
    weights: Mapping[str, Any] | None = None,
    *,
    opset: int = 17,
    kind: int = TensorProto.FLOAT,
    domains: Mapping[str, int] | None = None,
    value_info: Mapping[str, Shape] | None = None,
) -> onnx.ModelProto:
    """Return a model; a weight given as a tuple is a shape without data, an array is stored."""
    stored = []
    for name, value in (weights or {}).items():
        if isinstance(value, tuple):
            stored.append(TensorProto(name=name, dims=value, data_type=TensorProto.FLOAT))
        else:
            stored.append(numpy_helper.from_array(np.asarray(value), name))
    graph = helper.make_graph(
        list(nodes),
        "test",
        [helper.make_tensor_value_info(name, kind, shape) for name, shape in inputs.items()],
        [helper.make_tensor_value_info(name, kind, None) for name in outputs],
        stored,
        value_info=[helper.make_tensor_value_info(name, kind, shape) for name, shape in (value_info or {}).items()],
    )
    imports = [helper.make_opsetid("", opset)]
    imports += [helper.make_opsetid(domain, version) for domain, version in (domains or {}).items()]
    return helper.make_model(graph, opset_imports=imports, ir_version=8)


def node(op: str, inputs: str, output: str, **attributes: Any) -> onnx.NodeProto:
    """Return a node named after its output(s); inputs and outputs are separated by blanks, ``-`` leaves one out."""
    names = ["" if name == "-" else name for name in inputs.split()]
    return helper.make_node(op, names, output.split(), name=output.split()[0], **attributes)

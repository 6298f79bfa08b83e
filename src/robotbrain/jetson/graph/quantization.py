"""What QuantizeLinear and DequantizeLinear say: which kernels run in INT8, and which Q/DQ cost a kernel.

TensorRT moves Q and DQ through operators that do not mind and merges them with their neighbours; see "Working with
Quantized Types" in its developer guide
(https://docs.nvidia.com/deeplearning/tensorrt/latest/inference-library/work-quantized-types.html).
"""

from __future__ import annotations

from robotbrain.jetson.graph.ir import INT8_TYPES, Graph, Node
from robotbrain.jetson.graph.kinds import (
    COMMUTING,
    CONCAT,
    DEQUANTIZE,
    INTEGER_PRODUCTS,
    MEMORY,
    QUANTIZE,
    VIEW,
)

_LOW_TYPES = {17, 18, 19, 20, 23}  # float8 kinds and float4


def standalone(graph: Graph, kinds: dict[Node, str], fused: set[Node]) -> list[Node]:
    """Return the Q/DQ nodes that no neighbour takes in: each is a kernel of its own."""
    found: list[Node] = []
    for node in graph.nodes:
        if node in fused:
            continue
        if kinds[node] == QUANTIZE and not _requantizes(graph, kinds, node):
            found.append(node)
        if kinds[node] == DEQUANTIZE and _must_write(graph, kinds, node.outputs[0]):
            found.append(node)
    return found


def precision_of(graph: Graph, kinds: dict[Node, str], node: Node) -> str | None:
    """Return ``"int8"`` if activation and weight of a compute node are 8-bit integers, else None."""
    if node.op in INTEGER_PRODUCTS:
        return "int8"
    operands = [name for name in node.inputs[:2] if name]
    if len(operands) < 2:
        return None
    sources: list[bool] = []
    for name in operands:
        tensor = graph.tensors[name]
        if tensor.const:
            sources.append(tensor.quantized)
            continue
        origin = _origin(graph, kinds, name)
        sources.append(origin is not None and kinds[origin] == DEQUANTIZE and _integer(graph, origin))
    return "int8" if all(sources) else None


def low_precision(graph: Graph) -> bool:
    """Whether the model asks for a type below 16 bits that is no INT8, such as FP8 or INT4."""
    for node in graph.nodes:
        if node.op in ("QuantizeLinear", "DequantizeLinear"):
            quantized = node.outputs[0] if node.op == "QuantizeLinear" else node.input(0)
            if quantized and graph.tensors[quantized].dtype not in INT8_TYPES | {1, 10, 6}:
                return True
    return any(tensor.dtype in _LOW_TYPES for tensor in graph.tensors.values())


def _integer(graph: Graph, dequantize: Node) -> bool:
    return graph.tensors[dequantize.input(0)].dtype in INT8_TYPES


def _origin(graph: Graph, kinds: dict[Node, str], name: str) -> Node | None:
    """Return what made a tensor, looking through views."""
    node = graph.producer.get(name)
    while node is not None and kinds[node] == VIEW:
        node = graph.producer.get(node.input(0))
    return node


def _requantizes(graph: Graph, kinds: dict[Node, str], node: Node) -> bool:
    """Whether Q follows an operator that runs on 8-bit data because a DQ precedes it."""
    source = _origin(graph, kinds, node.input(0))
    if source is None:
        return False
    if kinds[source] == DEQUANTIZE:
        return True
    if kinds[source] != CONCAT and not (kinds[source] == MEMORY and source.op in COMMUTING):
        return False
    names = source.inputs if kinds[source] == CONCAT else source.inputs[:1]
    origins = [_origin(graph, kinds, name) for name in names]
    return all(origin is not None and kinds[origin] == DEQUANTIZE for origin in origins)


def _must_write(graph: Graph, kinds: dict[Node, str], name: str) -> bool:
    """Whether somebody needs a tensor in floating point who cannot dequantise while reading."""
    waiting, seen = [name], set[str]()
    while waiting:
        current = waiting.pop()
        if current in seen:
            continue
        seen.add(current)
        if current in graph.outputs:
            return True
        for reader in graph.readers(current):
            if kinds[reader] in (VIEW, CONCAT):
                waiting.extend(output for output in reader.outputs if output)
            elif kinds[reader] == MEMORY and reader.op not in COMMUTING:
                return True
    return False

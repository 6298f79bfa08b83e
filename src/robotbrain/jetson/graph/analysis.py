"""The stages of ``analyse`` in order."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from robotbrain.jetson.graph import binding, fusion, inference, kernels, kinds, layout, loading, patterns, quantization
from robotbrain.jetson.graph.fusion import Region
from robotbrain.jetson.graph.ir import Graph, Node
from robotbrain.jetson.kernels import KernelGraph

_NUMERIC = frozenset(range(1, 27)) - {8}


def run(model: Any, bindings: Mapping[str, int] | None, name: str | None) -> KernelGraph:
    """Return the kernels of a model; see ``robotbrain.jetson.graph.analyse``."""
    loaded = loading.load(model, name)
    stored = {proto.name for proto in loaded.initializers}
    open_inputs = [info for info in loaded.graph.input if info.name not in stored]
    tensors, warnings = binding.bind_inputs(open_inputs, bindings, _NUMERIC)
    graph = inference.infer(loaded, tensors, warnings)
    patterns.merge_normalizations(graph)
    kind = {node: kinds.kind_of(graph, node) for node in graph.nodes}
    _fold_pads(graph, kind)
    regions = fusion.fuse(graph, kind)
    fused = {node for region in regions for node in region.nodes}
    for node in quantization.standalone(graph, kind, fused):
        regions.append(Region(node, kinds.MEMORY, [node], [node.outputs[0]]))
    layouts = layout.lay_out(graph, kind, regions)
    made, peak = kernels.build(graph, kind, regions, layouts)
    elems, size = kernels.parameters(graph, regions)
    _remarks(graph, kind)
    if not made:
        graph.warn("nothing is computed: the outputs are inputs or constants")
    return KernelGraph(
        loaded.name,
        made,
        weight_elems=elems,
        weight_bytes=size,
        peak_activation_elems=peak,
        inputs={item.name: item.shape for item in tensors},
        outputs={item: graph.shape(item) for item in graph.outputs},
        opset=loaded.opsets[""],
        sha256=loaded.sha256,
        warnings=tuple(graph.warnings),
    )


def _fold_pads(graph: Graph, kind: dict[Node, str]) -> None:
    """Turn zero padding of rows and columns before a convolution into a view: the convolution pads for itself."""
    for node in graph.nodes:
        if node.op != "Pad" or kind[node] != kinds.MEMORY or node.text("mode", "constant") != "constant":
            continue
        value = graph.value(node, 1)
        pads = (
            node.integers("pads")
            if "pads" in node.attrs
            else tuple(value.ravel().tolist())
            if value is not None
            else ()
        )
        fill = graph.value(node, 2)
        filler = node.attrs.get("value", 0.0) if fill is None else fill.ravel()[:1].sum()
        rank = len(graph.shape(node.input(0)))
        named = graph.axes(node, 3)
        if named is not None or len(pads) != 2 * rank or filler or min(pads) < 0:
            continue
        outer = pads[:2] + pads[rank : rank + 2]
        readers = graph.readers(node.outputs[0])
        convolved = all(reader.op == "Conv" and reader.input(1) != node.outputs[0] for reader in readers)
        if not any(outer) and readers and convolved and node.outputs[0] not in graph.outputs:
            kind[node] = kinds.VIEW


def _remarks(graph: Graph, kind: dict[Node, str]) -> None:
    for node in graph.nodes:
        if node.domain and kind[node] == kinds.MEMORY:
            graph.warn(f"{node.domain}::{node.op} ({node.name}) needs a TensorRT plugin; only its traffic is counted")
    if quantization.low_precision(graph):
        graph.warn("the model asks for types other than INT8 in its Q/DQ; those kernels are left to the builder")

"""Which operators share a kernel.

A convolution or matrix product takes along the pointwise operators behind it (bias, folded batch normalisation,
activation, residual addition); chains of pointwise operators that are left become one kernel. This is what TensorRT
does, see the "Layer Fusion Catalog" of its documentation
(https://docs.nvidia.com/deeplearning/tensorrt/latest/performance/fusion-catalog.html).

A region grows forward from its first node. It may swallow a set of followers whenever exactly one tensor then leaves
it; so ``x * sigmoid(x)`` and the eight operators of a Gelu need no pattern of their own, and no cycle between
kernels can come about: every node of a region leads to its one output.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass, field

from robotbrain.jetson.graph.ir import Graph, Node
from robotbrain.jetson.graph.kinds import COMPUTE, MEMORY, POINTWISE, QUANTIZE, RECURRENT, RESHAPES, VIEW

_LOOKAHEAD = 24
_POINTWISE_INPUTS = 8


@dataclass(slots=True, eq=False)
class Region:
    """Nodes that run as one kernel.

    Attributes:
        root: the node that gives the kernel its class.
        kind: of the root.
        nodes: all of them, in order.
        outputs: tensors that leave it.
    """

    root: Node
    kind: str
    nodes: list[Node] = field(default_factory=list)
    outputs: list[str] = field(default_factory=list)

    @property
    def last(self) -> int:
        """Place of its last node in running order."""
        return self.nodes[-1].index


def fuse(graph: Graph, kinds: dict[Node, str]) -> list[Region]:
    """Return the kernels' regions; views, concatenations and Q/DQ outside of them belong to none."""
    owner: dict[Node, Region] = {}
    regions: list[Region] = []
    for wanted in (COMPUTE, POINTWISE, MEMORY):
        for node in graph.nodes:
            if kinds[node] != wanted or node in owner:
                continue
            region = Region(node, wanted, [node], [name for name in node.outputs if _leaves(graph, name, {node})])
            if wanted != MEMORY and node.op not in RECURRENT:
                _grow(graph, kinds, owner, region)
            if wanted == POINTWISE:
                _pull(graph, kinds, owner, region)
            region.nodes.sort(key=lambda item: item.index)
            owner.update(dict.fromkeys(region.nodes, region))
            regions.append(region)
    return regions


def _leaves(graph: Graph, name: str, inside: set[Node]) -> bool:
    return bool(name) and (name in graph.outputs or any(reader not in inside for reader in graph.readers(name)))


def _grow(graph: Graph, kinds: dict[Node, str], owner: dict[Node, Region], region: Region) -> None:
    inside = set(region.nodes)
    trial = list(region.nodes)
    leaving = set(region.outputs)
    if len(leaving) != 1 or region.root.outputs[0] not in leaving:
        return
    refused: set[Node] = set()
    frontier = _followers(graph, leaving)
    while frontier and len(trial) - len(region.nodes) < _LOOKAHEAD:
        _, _, node = heapq.heappop(frontier)
        if node in inside or node in refused:
            continue
        if node in owner or not _joins(graph, kinds, region, inside, node):
            refused.add(node)
            continue
        inside.add(node)
        trial.append(node)
        made = {name for name in node.outputs if name}
        leaving = {name for name in leaving | made if _leaves(graph, name, inside)}
        for item in _followers(graph, made):
            heapq.heappush(frontier, item)
        if len(leaving) == 1 and kinds[node] != VIEW:
            region.nodes = list(trial)
            region.outputs = list(leaving)


def _followers(graph: Graph, names: set[str]) -> list[tuple[int, int, Node]]:
    found = [(node.index, id(node), node) for name in sorted(names) for node in graph.readers(name)]
    heapq.heapify(found)
    return found


def _joins(graph: Graph, kinds: dict[Node, str], region: Region, inside: set[Node], node: Node) -> bool:
    """Whether a follower can run in the region's kernel."""
    result = graph.shape(node.outputs[0])
    if kinds[node] == VIEW:
        return node.op in RESHAPES
    if kinds[node] not in (POINTWISE, QUANTIZE):
        return False
    outside = _outside(graph, inside | {node})
    if region.kind == POINTWISE:
        return len(outside) <= _POINTWISE_INPUTS
    # One tile of the product stays in registers: the follower must have its shape, and there is room for one operand.
    own = [name for name in graph.activations(node) if graph.producer.get(name) in inside]
    operands = outside - _outside(graph, {region.root})
    return len(operands) <= 1 and any(graph.shape(name) == result for name in own)


def _outside(graph: Graph, inside: set[Node]) -> set[str]:
    names = (name for node in inside for name in graph.activations(node))
    return {name for name in names if graph.producer.get(name) not in inside}


def _pull(graph: Graph, kinds: dict[Node, str], owner: dict[Node, Region], region: Region) -> None:
    """Take in pointwise producers that nobody else reads."""
    inside = set(region.nodes)
    waiting = sorted(_outside(graph, inside))
    while waiting:
        name = waiting.pop()
        node = graph.producer.get(name)
        if node is None or node in owner or node in inside or kinds[node] != POINTWISE:
            continue
        if any(_leaves(graph, output, inside) for output in node.outputs):
            continue
        if len(_outside(graph, inside | {node})) > _POINTWISE_INPUTS:
            continue
        inside.add(node)
        waiting.extend(graph.activations(node))
    region.nodes = list(inside)

"""Normalisations that exporters write out in ten operators, put back together.

Layer normalisation (Ba et al., https://arxiv.org/abs/1607.06450) is mean, difference, variance, root and quotient;
RMS normalisation (Zhang and Sennrich, https://arxiv.org/abs/1910.07467) leaves the mean out. TensorRT runs either as
one kernel. Gelu, SiLU and their like need no pattern: they are pointwise throughout (see ``fusion``).
"""

from __future__ import annotations

from robotbrain.jetson.graph.ir import Graph, Node


def merge_normalizations(graph: Graph) -> None:
    """Replace written-out layer and RMS normalisations by one node each, in place."""
    replaced: dict[Node, Node] = {}
    gone: set[Node] = set()
    for root in graph.nodes:
        if root.op == "Sqrt" and (match := _match(graph, root)) is not None:
            source, op, nodes, last = match
            if gone.isdisjoint(nodes):
                parameters = [name for node in nodes for name in graph.constants(node) if graph.elems(name) > 1]
                sources = tuple(layer for node in sorted(nodes, key=lambda n: n.index) for layer in node.layers)
                replaced[last] = Node(op, last.name, [source, *parameters], last.outputs[:1], sources=sources)
                gone |= nodes
    if gone:
        graph.nodes = [replaced.get(node, node) for node in graph.nodes if node in replaced or node not in gone]
        graph.relink()


def _match(graph: Graph, root: Node) -> tuple[str, str, set[Node], Node] | None:
    """Return (source tensor, operator, nodes, last node) of the normalisation around a square root."""
    shifted = _from(graph, root.input(0), "Add")  # variance plus epsilon
    mean_input = _activation(graph, shifted)
    mean = _from(graph, mean_input, "ReduceMean")
    square = _from(graph, mean.input(0) if mean else "", "Pow", "Mul")
    if shifted is None or mean is None or square is None or not _squares(graph, square):
        return None
    centred = square.input(0)
    nodes = {root, shifted, mean, square}
    tail = _only_reader(graph, root.outputs[0])
    if tail is not None and tail.op == "Reciprocal":
        nodes.add(tail)
        tail = _only_reader(graph, tail.outputs[0])
        wanted = "Mul"
    else:
        wanted = "Div"
    if tail is None or tail.op != wanted:
        return None
    nodes.add(tail)
    numerator = tail.input(1) if tail.input(0) in (root.outputs[0], *_outputs(graph, nodes, tail)) else tail.input(0)
    source, op = centred, "RMSNormalization"
    difference = _from(graph, centred, "Sub")
    average = _from(graph, difference.input(1), "ReduceMean") if difference is not None else None
    if difference is not None and average is not None and average.input(0) == difference.input(0):
        source, op = difference.input(0), "LayerNormalization"
        nodes |= {difference, average}
        twin = graph.producer.get(numerator)
        if twin is not None and twin.op == "Sub" and twin.inputs == difference.inputs:
            nodes.add(twin)
            numerator = centred
    if numerator != centred:
        return None
    last = tail
    for wanted in ("Mul", "Add"):  # scale and shift
        follower = _only_reader(graph, last.outputs[0])
        if follower is not None and follower.op == wanted and len(list(graph.activations(follower))) == 1:
            last = follower
            nodes.add(last)
    for node in nodes - {last}:
        if any(name in graph.outputs or not nodes.issuperset(graph.readers(name)) for name in node.outputs):
            return None
    return source, op, nodes, last


def _outputs(graph: Graph, nodes: set[Node], tail: Node) -> list[str]:
    return [name for node in nodes if node is not tail for name in node.outputs if node.op in ("Sqrt", "Reciprocal")]


def _from(graph: Graph, name: str, *ops: str) -> Node | None:
    node = graph.producer.get(name) if name else None
    return node if node is not None and node.op in ops and not node.domain else None


def _activation(graph: Graph, node: Node | None) -> str:
    names = list(graph.activations(node)) if node is not None else []
    return names[0] if len(names) == 1 else ""


def _squares(graph: Graph, node: Node) -> bool:
    if node.op == "Mul":
        return node.input(0) == node.input(1)
    exponent = graph.value(node, 1)
    return exponent is not None and exponent.size == 1 and float(exponent.ravel()[0]) == 2.0


def _only_reader(graph: Graph, name: str) -> Node | None:
    readers = graph.readers(name)
    return readers[0] if len(readers) == 1 and name not in graph.outputs else None

"""Multiply-accumulates of one operator, and the elements of its operands.

One MAC is one multiplication and one addition; biases and pointwise arithmetic count nothing. These are the
conventions of the published figures for convolutional networks.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from robotbrain.errors import InputError
from robotbrain.jetson.graph.ir import Graph, Node
from robotbrain.jetson.graph.kinds import CONVOLUTIONS, PRODUCTS, RECURRENT

_MOST_STEPS = 1000


@dataclass(frozen=True, slots=True)
class Work:
    """One launch of a compute node.

    Attributes:
        op: conv, dw, mm or pw.
        macs: multiply-accumulates.
        source: name of the activation that streams through; None if ``in_elems`` says it.
        in_elems: activation elements read, where ``source`` is None.
        out_elems: elements written.
        weight_elems: elements of the other operand.
    """

    op: str
    macs: int
    source: str | None
    in_elems: int
    out_elems: int
    weight_elems: int


def work_of(graph: Graph, node: Node) -> list[Work]:
    """Return the launches of a compute node.

    Raises:
        InputError: where operands do not fit together.
    """
    if node.op in CONVOLUTIONS:
        return [_convolution(graph, node)]
    if node.op in PRODUCTS:
        return [_product(graph, node)]
    if node.op in RECURRENT:
        return _recurrent(graph, node)
    if node.op == "Attention":
        return _attention(graph, node)
    return [_einsum(graph, node)]


def weight_position(node: Node) -> int:
    """Return which input of a convolution or product holds the weights."""
    return 3 if node.op in ("QLinearConv", "QLinearMatMul") else 1


def _convolution(graph: Graph, node: Node) -> Work:
    source, weight = node.input(0), graph.shape(node.input(weight_position(node)))
    shape, out = graph.shape(source), graph.elems(node.outputs[0])
    group = node.integer("group", 1)
    if len(weight) != len(shape) or len(shape) < 3 or group < 1:
        raise _misfit(graph, node)
    if shape[1] != (weight[0] if node.op == "ConvTranspose" else weight[1] * group):
        raise _misfit(graph, node)
    # Conv weights are (out, in / group, window), those of ConvTranspose (in, out / group, window): either way the
    # second axis and the window are what one element of the larger-strided side is multiplied with.
    macs = (graph.elems(source) if node.op == "ConvTranspose" else out) * math.prod(weight[1:])
    depthwise = group > 1 and group == shape[1]
    return Work("dw" if depthwise else "conv", macs, source, 0, out, math.prod(weight))


def _product(graph: Graph, node: Node) -> Work:
    left, right = node.input(0), node.input(weight_position(node))
    a, b, out = graph.shape(left), graph.shape(right), graph.elems(node.outputs[0])
    if not a or not b:
        raise _misfit(graph, node)
    inner = a[0] if node.op == "Gemm" and node.integer("transA", 0) else a[-1]
    across = b[-1] if node.op == "Gemm" and node.integer("transB", 0) else b[-2] if len(b) > 1 else b[0]
    if inner != across:
        raise _misfit(graph, node)
    if graph.tensors[left].const:  # the weights are on the left
        left, right = right, left
    return Work("mm", out * inner, left, 0, out, graph.elems(right))


def _recurrent(graph: Graph, node: Node) -> list[Work]:
    """Return the launches of an LSTM, GRU or RNN: the input product of all steps at once, then step after step."""
    shape, weight, recurrence = (graph.shape(node.input(position)) for position in range(3))
    if len(shape) != 3 or len(weight) != 3 or len(recurrence) != 3 or weight[2] != shape[2]:
        raise _misfit(graph, node)
    batch, steps = (shape[0], shape[1]) if node.integer("layout", 0) else (shape[1], shape[0])
    directions, gated, _ = weight
    hidden = recurrence[2]
    launches = max(1, min(steps, _MOST_STEPS))
    if steps > _MOST_STEPS:
        graph.warn(f"{node.op} {node.name!r}: {steps} steps are counted as {launches} launches of several steps each")
    made: list[Work] = []
    for _ in range(directions):
        made.append(
            Work("mm", steps * batch * gated * shape[2], node.input(0), 0, steps * batch * gated, gated * shape[2])
        )
        for launch in range(launches):
            part = steps * (launch + 1) // launches - steps * launch // launches
            made.append(
                Work(
                    "mm",
                    part * batch * gated * hidden,
                    None,
                    part * batch * (hidden + gated),
                    part * batch * hidden,
                    gated * hidden,
                )
            )
    return made


def _attention(graph: Graph, node: Node) -> list[Work]:
    """Return the launches of an Attention: scores, softmax, weighted sum (opset 23)."""
    query, key, value = (graph.shape(node.input(position)) for position in range(3))
    if len(query) not in (3, 4) or len(key) != len(query) or len(value) != len(query):
        raise _misfit(graph, node)
    heads = query[1] if len(query) == 4 else node.integer("q_num_heads", 1)
    kv_heads = key[1] if len(key) == 4 else node.integer("kv_num_heads", 1)
    size = query[3] if len(query) == 4 else query[2] // max(1, heads)
    value_size = value[3] if len(value) == 4 else value[2] // max(1, kv_heads)
    past = graph.shape(node.input(4))[2] if node.input(4) else 0
    batch, rows, columns = query[0], query[-2], key[-2] + past
    scores = batch * heads * rows * columns
    return [
        Work("mm", scores * size, node.input(0), 0, scores, batch * kv_heads * columns * size),
        Work("mem:softmax", 0, None, scores, scores, 0),
        Work(
            "mm",
            scores * value_size,
            None,
            scores,
            batch * heads * rows * value_size,
            batch * kv_heads * columns * value_size,
        ),
    ]


def _einsum(graph: Graph, node: Node) -> Work:
    """Return an Einsum's work, operands contracted two at a time from left to right."""
    terms, result = _equation(graph, node)
    sizes: dict[str, int] = {}
    for term, name in zip(terms, node.inputs, strict=True):
        for label, size in zip(term, graph.shape(name), strict=True):
            sizes[label] = max(sizes.get(label, 1), size)
    macs, contracted = 0, False
    current = terms[0]
    for position, term in enumerate(terms[1:], start=1):
        labels = dict.fromkeys(current + term)
        later = set(result).union(*terms[position + 1 :])
        contracted = contracted or any(label not in later for label in labels)
        macs += math.prod(sizes[label] for label in labels)
        current = [label for label in labels if label in later]
    first, rest = node.inputs[0], node.inputs[1:]
    if graph.tensors[first].const:
        first, rest = rest[0], [first, *rest[1:]]
    return Work(
        "mm" if contracted else "pw",
        macs if contracted else 0,
        first,
        0,
        graph.elems(node.outputs[0]),
        sum(graph.elems(name) for name in rest),
    )


def _equation(graph: Graph, node: Node) -> tuple[list[list[str]], list[str]]:
    """Return the labels of the operands and of the result, an ellipsis written out."""
    left, arrow, right = node.text("equation", "").replace(" ", "").partition("->")
    written = left.split(",")
    if len(written) != len(node.inputs):
        raise _misfit(graph, node)
    terms: list[list[str]] = []
    longest = 0
    for text, name in zip(written, node.inputs, strict=True):
        rank = len(graph.shape(name))
        before, dots, after = text.partition("...")
        hidden = rank - len(before) - len(after)
        if hidden < 0 or (hidden and not dots):
            raise _misfit(graph, node)
        longest = max(longest, hidden)
        terms.append([*before, *(f".{axis}" for axis in range(hidden)[::-1]), *after])
    dotted = [f".{axis}" for axis in range(longest)[::-1]]
    if not arrow:
        letters = [label for term in terms for label in term if not label.startswith(".")]
        return terms, dotted + sorted(label for label in set(letters) if letters.count(label) == 1)
    before, dots, after = right.partition("...")
    return terms, [*before, *(dotted if dots else []), *after]


def _misfit(graph: Graph, node: Node) -> InputError:
    return InputError(
        f"{node.op} {node.name!r}",
        given="inputs of shape " + ", ".join(str(graph.shape(name)) for name in node.inputs if name),
        expected="operands that fit together",
        fix="Is an axis bound to a wrong length? Otherwise the file is damaged; check it with onnx.checker.",
    )

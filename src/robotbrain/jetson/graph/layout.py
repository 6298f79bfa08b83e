"""Which reshapes, transposes and concatenations move data, and which are only another way to look at it.

Every tensor is followed as strides over a buffer, as torch does it
(https://docs.pytorch.org/docs/stable/tensor_view.html). A transpose, slice, split or expand is a view. Data move
where a reshape cannot be written as strides, or where a reader (a convolution, a pooling, the caller) needs rows in
order. A concatenation is free because its inputs are written straight into its buffer; that fails for network inputs
and constants, and for a tensor that is wanted at two places.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, field

from robotbrain.jetson.graph.folding import slice_ranges
from robotbrain.jetson.graph.fusion import Region
from robotbrain.jetson.graph.ir import Graph, Node
from robotbrain.jetson.graph.kinds import CONCAT, POINTWISE, PRODUCTS, RESHAPES, VIEW, selects

_STRIDED = frozenset({"Softmax", "LogSoftmax", "Pad", "Gather", "ReduceMean", "ReduceSum", "ReduceMax", "Slice"})


@dataclass(frozen=True, slots=True)
class Layout:
    """Where a tensor's elements lie.

    Attributes:
        strides: elements to skip for one step along each axis; 0 where it is repeated.
        cause: what made it differ from rows in order: transpose, slice, expand or "".
        buffers: names of the buffers that it lies in; several behind a concatenation.
    """

    strides: tuple[int, ...]
    cause: str
    buffers: frozenset[str]


@dataclass(frozen=True, slots=True)
class Copy:
    """A kernel that only puts data in order.

    Attributes:
        node: whose result it writes.
        what: transpose, slice, expand, concat or copy.
        elems: read; as many are written unless ``written`` says otherwise.
        written: elements written.
        source, target: names of the buffers read and written.
    """

    node: Node
    what: str
    elems: int
    written: int
    source: frozenset[str]
    target: str


@dataclass(slots=True)
class Layouts:
    """Layout of each activation, the copies, and the sizes of buffers that are no tensor's own."""

    graph: Graph
    of: dict[str, Layout] = field(default_factory=dict)
    copies: list[Copy] = field(default_factory=list)
    extra: dict[str, int] = field(default_factory=dict)

    def size(self, buffer: str) -> int:
        """Return the elements of a buffer."""
        return self.extra[buffer] if buffer in self.extra else self.graph.elems(buffer)

    def read(self, name: str) -> int:
        """Return how many elements a reader of ``name`` fetches; repeated ones count once."""
        layout = self.of.get(name)
        shape = self.graph.shape(name)
        if layout is None:
            return math.prod(shape)
        return math.prod(size for size, stride in zip(shape, layout.strides, strict=True) if stride != 0)

    def buffers(self, name: str) -> frozenset[str]:
        """Return the buffers that a tensor lies in."""
        layout = self.of.get(name)
        return layout.buffers if layout is not None else frozenset({name})


def dense(shape: tuple[int, ...]) -> tuple[int, ...]:
    """Return the strides of rows in order."""
    strides: list[int] = []
    step = 1
    for size in reversed(shape):
        strides.append(step)
        step *= max(1, size)
    return tuple(strides[::-1])


def reshaped(shape: tuple[int, ...], strides: tuple[int, ...], target: tuple[int, ...]) -> tuple[int, ...] | None:
    """Return the strides of the same elements seen as ``target``, or None if that takes a copy."""
    if math.prod(shape) == 0:
        return dense(target)
    axes = [(size, stride) for size, stride in zip(shape, strides, strict=True) if size != 1]
    blocks: list[list[int]] = []  # runs of axes that can be walked with one stride: [elements, innermost stride]
    for position, (size, stride) in enumerate(axes):
        if position and axes[position - 1][1] == size * stride and blocks:
            blocks[-1] = [blocks[-1][0] * size, stride]
        else:
            blocks.append([size, stride])
    made: list[int] = []
    rest, stride = blocks.pop() if blocks else (1, 1)
    for size in reversed(target):
        if rest == 1 and size != 1 and blocks:
            rest, stride = blocks.pop()
        if size == 1:
            made.append(stride)
            continue
        if rest % size:
            return None
        made.append(stride)
        stride *= size
        rest //= size
    return tuple(made[::-1])


def in_order(shape: tuple[int, ...], layout: Layout) -> bool:
    """Whether a reader that walks row by row can use it: axes in order, innermost elements side by side."""
    strides = [stride for size, stride in zip(shape, layout.strides, strict=True) if size != 1]
    return not strides or (strides[-1] == 1 and all(a >= b > 0 for a, b in itertools.pairwise(strides)))


def lay_out(graph: Graph, kinds: dict[Node, str], regions: list[Region]) -> Layouts:
    """Return the layouts of all activations and the copies that they force."""
    layouts = Layouts(graph)
    owner = {node: region for region in regions for node in region.nodes}
    placed: dict[str, tuple[str, ...]] = {}
    for name in graph.inputs:
        layouts.of[name] = Layout(dense(graph.shape(name)), "", frozenset({name}))
    for node in graph.nodes:
        region = owner.get(node)
        if region is not None:
            inside = {name for item in region.nodes for name in item.outputs}
            for position, name in enumerate(node.inputs):
                if name and name not in inside and not graph.tensors[name].const:
                    _serve(layouts, node, position, name, kinds[node])
            _fresh(layouts, node)
        elif kinds[node] == CONCAT:
            _concatenate(layouts, kinds, node, placed)
        else:
            _view(layouts, kinds, node)
    for name in graph.outputs:
        if not graph.tensors[name].const and name in graph.producer:
            _order(layouts, name, exact=True)
    return layouts


def _fresh(layouts: Layouts, node: Node) -> None:
    for name in node.outputs:
        if name:
            layouts.of[name] = Layout(dense(layouts.graph.shape(name)), "", frozenset({name}))


def _serve(layouts: Layouts, node: Node, position: int, name: str, kind: str) -> None:
    """Copy an input if the kernel that reads it cannot walk it as it lies."""
    if kind == POINTWISE or node.op in _STRIDED:
        return
    if node.op in PRODUCTS or node.op in ("Einsum", "Attention"):
        shape, strides = layouts.graph.shape(name), layouts.of[name].strides
        inner = [stride for size, stride in zip(shape, strides, strict=True) if size != 1]
        if not inner or 1 in inner[-2:]:
            return
    _order(layouts, name)


def _order(layouts: Layouts, name: str, *, exact: bool = False) -> None:
    layout = layouts.of[name]
    shape = layouts.graph.shape(name)
    aliases = exact and name not in layout.buffers and not layout.buffers.isdisjoint(layouts.graph.inputs)
    fits = layout.strides == dense(shape) if exact else in_order(shape, layout)
    if exact and not fits:
        fits = reshaped(shape, layout.strides, (math.prod(shape),)) == (1,)
    if fits and not aliases:
        return
    node = layouts.graph.producer[name]
    layouts.copies.append(
        Copy(
            node,
            layout.cause or "copy",
            layouts.read(name),
            math.prod(shape),
            layout.buffers,
            name,
        )
    )
    layouts.of[name] = Layout(dense(shape), "", frozenset({name}))


def _view(layouts: Layouts, kinds: dict[Node, str], node: Node) -> None:
    graph = layouts.graph
    source = node.input(0)
    for name in node.outputs:
        if not name:
            continue
        if graph.tensors[source].const:  # e.g. Expand of a constant to a computed shape
            layouts.of[name] = Layout(dense(graph.shape(name)), "", frozenset({name}))
            continue
        if node.op == "Pad":  # folded into a convolution, which wants rows in order
            _order(layouts, source)
        layout = layouts.of[source]
        strides = _strides(graph, node, name, layout)
        if kinds[node] == VIEW and strides is None:
            target = graph.shape(name)
            what = layout.cause or "copy"
            layouts.copies.append(Copy(node, what, layouts.read(source), math.prod(target), layout.buffers, name))
            layouts.of[name] = Layout(dense(target), "", frozenset({name}))
            continue
        cause = {"Transpose": "transpose", "Slice": "slice", "Split": "slice", "Gather": "slice", "Expand": "expand"}
        label = layout.cause if layout.cause == "transpose" else cause.get(node.op, layout.cause)
        layouts.of[name] = Layout(strides or dense(graph.shape(name)), label, layout.buffers)


def _strides(graph: Graph, node: Node, output: str, layout: Layout) -> tuple[int, ...] | None:
    """Return the strides of a view's output, or None if it takes a copy."""
    shape, target = graph.shape(node.input(0)), graph.shape(output)
    if node.op == "Transpose":
        perm = node.integers("perm") or tuple(range(len(shape)))[::-1]
        return tuple(layout.strides[axis] for axis in perm)
    if node.op == "Slice":
        values = [graph.tensors[name].value if name else None for name in node.inputs]
        steps = [step for _, _, step in slice_ranges(node, values, shape)]
        return tuple(stride * step for stride, step in zip(layout.strides, steps, strict=True))
    if node.op == "Split":
        return layout.strides
    if node.op == "Expand":
        lead = len(target) - len(shape)
        return (0,) * lead + tuple(
            0 if old == 1 and new != 1 else stride
            for old, new, stride in zip(shape, target[lead:], layout.strides, strict=True)
        )
    if selects(graph, node):
        axis = node.integer("axis", 0) % len(shape)
        rank = len(target) - len(shape) + 1  # a scalar index drops the axis, a one-element list keeps it
        return layout.strides[:axis] + (1,) * rank + layout.strides[axis + 1 :]
    if node.op in RESHAPES:
        return reshaped(shape, layout.strides, target)
    # What is left became part of a neighbour: Q/DQ, which keep the shape, or a Pad.
    return layout.strides if shape == target else dense(target)


def _concatenate(layouts: Layouts, kinds: dict[Node, str], node: Node, placed: dict[str, tuple[str, ...]]) -> None:
    graph = layouts.graph
    output = node.outputs[0]
    readers = graph.readers(output)
    # A pointwise kernel can read from the pieces, so nothing need be gathered for it.
    gathered = output in graph.outputs or any(kinds[reader] != POINTWISE for reader in readers)
    buffers: set[str] = set()
    copied = 0
    for position, name in enumerate(node.inputs):
        before = (*node.inputs[:position], str(node.integer("axis", 0)))
        home = graph.tensors[name].const or name in graph.inputs or placed.setdefault(name, before) != before
        if gathered and home:
            copied += graph.elems(name)
            continue
        if graph.tensors[name].const:
            continue
        if not in_order(graph.shape(name), layouts.of[name]):
            _order(layouts, name)
        buffers |= layouts.of[name].buffers
    if copied:
        source = frozenset().union(*(layouts.buffers(name) for name in node.inputs if name in layouts.of))
        target = f"{output}#copied"
        layouts.extra[target] = copied
        layouts.copies.append(Copy(node, "concat", copied, copied, source, target))
        buffers.add(target)
    layouts.of[output] = Layout(dense(graph.shape(output)), "", frozenset(buffers) or frozenset({output}))

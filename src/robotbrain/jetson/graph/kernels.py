"""From regions and copies to the list of kernels, the parameters, and the memory that activations need."""

from __future__ import annotations

from robotbrain.jetson.graph import dla
from robotbrain.jetson.graph.cost import work_of
from robotbrain.jetson.graph.fusion import Region
from robotbrain.jetson.graph.ir import Graph, Node, stored_bytes
from robotbrain.jetson.graph.kinds import COMPUTE, POINTWISE, RECURRENT, VIEW, memory_op
from robotbrain.jetson.graph.layout import Copy, Layouts
from robotbrain.jetson.graph.quantization import precision_of
from robotbrain.jetson.kernels import Kernel

_NORMALIZATIONS = ("layer_norm", "rms_norm", "instance_norm", "group_norm")


def build(
    graph: Graph, kinds: dict[Node, str], regions: list[Region], layouts: Layouts
) -> tuple[tuple[Kernel, ...], int]:
    """Return the kernels in running order, and the most activation elements alive at once."""
    steps: list[tuple[int, list[Kernel], set[str], set[str]]] = []
    for region in regions:
        inside = {name for node in region.nodes for name in node.outputs}
        reads = {name for node in region.nodes for name in graph.activations(node) if name not in inside}
        buffers = {buffer for name in reads for buffer in layouts.buffers(name)}
        written = set(region.outputs) or {region.nodes[-1].outputs[0]}
        steps.append((region.last, _kernels(graph, kinds, region, layouts), buffers, written))
    for copy in layouts.copies:
        steps.append((copy.node.index, [_copy(graph, copy)], set(copy.source), {copy.target}))
    steps.sort(key=lambda step: step[0])
    kernels = tuple(kernel for _, made, _, _ in steps for kernel in made)
    return kernels, _peak(graph, layouts, [(reads, writes) for _, _, reads, writes in steps])


def parameters(graph: Graph, regions: list[Region]) -> tuple[int, int]:
    """Return the elements and the stored bytes of all constants that kernels compute with, each counted once."""
    roots: set[str] = set()
    for region in regions:
        for node in region.nodes:
            for name in _operands(graph, node):
                tensor = graph.tensors[name]
                # The 0.5 of a Gelu or the epsilon of a norm is part of the code, not a parameter.
                roots |= tensor.roots if tensor.elems > 1 or (region.kind == COMPUTE and node is region.root) else set()
    tensors = [graph.tensors[name] for name in sorted(roots)]
    return sum(t.elems for t in tensors), sum(stored_bytes(t.dtype, t.elems) for t in tensors)


def _operands(graph: Graph, node: Node) -> list[str]:
    """Return the constant inputs that are data, not shapes, axes or scales of a grid."""
    if node.op in ("Reshape", "Expand", "Tile", "Slice", "Split", "Pad", "Resize", "Upsample", "TopK", "OneHot"):
        return []
    if node.op.startswith("Reduce") or node.op in ("Unsqueeze", "Squeeze"):
        return []
    if node.op in RECURRENT:  # initial states are no parameters
        return [name for position, name in enumerate(node.inputs) if name and position in (1, 2, 3, 7)]
    if node.op == "Gather":
        return [name for name in node.inputs[:1] if graph.tensors[name].const]
    return list(graph.constants(node))


def _kernels(graph: Graph, kinds: dict[Node, str], region: Region, layouts: Layouts) -> list[Kernel]:
    root = region.root
    layers = tuple(layer for node in region.nodes for layer in node.layers)
    objection = dla.reason(graph, kinds, region)
    if region.kind == COMPUTE:
        precision = precision_of(graph, kinds, root)
        extra = sum(_table(graph, node) for node in region.nodes if node is not root)
        made: list[Kernel] = []
        for work in work_of(graph, root):
            read = work.in_elems if work.source is None else _streamed(graph, kinds, layouts, work.source)
            made.append(
                Kernel(
                    work.op,
                    work.macs,
                    read,
                    work.out_elems,
                    work.weight_elems + extra,
                    name=root.name,
                    layers=layers,
                    precision=precision if work.op in ("conv", "dw", "mm") else None,
                    dla_reason=objection,
                )
            )
        return made
    inside = {name for node in region.nodes for name in node.outputs}
    sources = dict.fromkeys(name for node in region.nodes for name in graph.activations(node) if name not in inside)
    written = sum(graph.elems(name) for name in region.outputs)
    if region.kind == POINTWISE:
        op, read = "pw", sum(layouts.read(name) for name in sources)
        weights = sum(_table(graph, node) for node in region.nodes)
    else:
        op = memory_op(root)
        read = sum(layouts.read(name) for name in sources)
        weights = 0
        if root.op == "Gather":  # only the rows that are looked up are read
            data = root.input(0)
            read += written - (0 if graph.tensors[data].const else layouts.read(data))
        if op.removeprefix("mem:") in _NORMALIZATIONS:
            weights = sum(graph.elems(name) for name in graph.constants(root))
    return [Kernel(op, 0, read, written, weights, name=root.name, layers=layers, dla_reason=objection)]


def _streamed(graph: Graph, kinds: dict[Node, str], layouts: Layouts, name: str) -> int:
    producer = graph.producer.get(name)
    if producer is not None and producer.op == "Pad" and kinds[producer] == VIEW:
        return layouts.read(producer.input(0))
    return layouts.read(name)


def _table(graph: Graph, node: Node) -> int:
    """Return the constant elements that a pointwise operator reads; one value per channel is folded elsewhere."""
    if node.op in ("QuantizeLinear", "DequantizeLinear", "Clip") or not node.outputs:
        return 0
    wide = [graph.tensors[name] for name in _operands(graph, node)]
    return sum(tensor.elems for tensor in wide if sum(size > 1 for size in tensor.shape) > 1)


def _copy(graph: Graph, copy: Copy) -> Kernel:
    shape = graph.shape(copy.node.outputs[0])
    return Kernel(
        f"mem:{copy.what}",
        0,
        copy.elems,
        copy.written,
        0,
        name=copy.node.name,
        layers=copy.node.layers,
        dla_reason=dla.copy_reason(shape),
    )


def _peak(graph: Graph, layouts: Layouts, steps: list[tuple[set[str], set[str]]]) -> int:
    """Return the largest sum of buffers that hold something still to be read.

    A buffer lives from the kernel that first writes it to the last one that reads it; inputs live from the start,
    outputs to the end.
    """
    first: dict[str, int] = dict.fromkeys(graph.inputs, -1)
    last: dict[str, int] = dict.fromkeys(graph.inputs, -1)
    for step, (reads, writes) in enumerate(steps):
        for buffer in writes:
            first.setdefault(buffer, step)
            last[buffer] = max(step, last.get(buffer, step))
        for buffer in reads:
            last[buffer] = max(step, last.get(buffer, step))
            first.setdefault(buffer, step)
    for name in graph.outputs:
        if not graph.tensors[name].const:
            for buffer in layouts.buffers(name):
                last[buffer] = len(steps)
                first.setdefault(buffer, len(steps))
    changes = [0] * (len(steps) + 3)
    for buffer, start in first.items():
        changes[start + 1] += layouts.size(buffer)
        changes[last[buffer] + 2] -= layouts.size(buffer)
    alive = peak = 0
    for change in changes:
        alive += change
        peak = max(peak, alive)
    return peak

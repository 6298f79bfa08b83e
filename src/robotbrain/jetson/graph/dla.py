"""What a deep learning accelerator (DLA) of Xavier and Orin can run.

Published, in NVIDIA's "DLA Supported Layers and Restrictions"
(https://docs.nvidia.com/deeplearning/tensorrt/latest/inference-library/dla-layer-restrictions.html): batches up to
4096 and other axes up to 8192; two spatial axes; convolution windows 1-32 and strides 1-8; deconvolution without
padding, groups or dilation; ReLU, sigmoid, tanh, clipped and leaky ReLU; sum, difference, product, maximum, minimum,
quotient and power; normalisation windows 3, 5, 7, 9. Nearest resize by whole factors of 1-32: the TensorRT 8.2 guide,
as quoted at https://forums.developer.nvidia.com/t/unable-to-run-resize-layer-on-dla-on-xavier/219158.
Assumed, for want of a page that could be checked: convolution padding 0-31 and dilation 1-32, pooling windows 1-8 with
padding 0-7 and strides 1-16, linear resize by 1-4, softmax and trigonometry on Orin only (such a reason says "Orin").
A model with explicit Q/DQ has to be turned into one with calibration tables first; that is taken as done.
"""

from __future__ import annotations

from collections.abc import Iterable

from robotbrain.jetson.graph.fusion import Region
from robotbrain.jetson.graph.ir import Graph, Node
from robotbrain.jetson.graph.kinds import COMPUTE, POINTWISE, VIEW, memory_op

_MAX_BATCH = 4096
_MAX_SIZE = 8192
_ELEMENTWISE_WORDS = """
    Add Sub Mul Div Pow Min Max Sum Relu LeakyRelu PRelu Sigmoid Tanh Clip Abs BatchNormalization Cast
    Equal Greater Less
"""
_ELEMENTWISE = frozenset(_ELEMENTWISE_WORDS.split())
_ORIN_ONLY = frozenset({"Sin", "Cos", "Atan"})


def reason(graph: Graph, kinds: dict[Node, str], region: Region) -> str:
    """Return why a DLA cannot run a region, or ``""`` if it can."""
    return next((text for text in _objections(graph, kinds, region) if text), "")


def copy_reason(shape: tuple[int, ...]) -> str:
    """Return why a DLA cannot run a copy that puts a tensor of that shape in order."""
    return _size(shape) if len(shape) == 4 else f"shuffles a tensor of {len(shape)} axes, not 4"


def _objections(graph: Graph, kinds: dict[Node, str], region: Region) -> Iterable[str]:
    root = region.root
    yield _root(graph, region)
    if region.kind == COMPUTE and root.op in ("Gemm", "MatMul"):
        shapes = [graph.shape(root.outputs[0])]
        yield "" if len(shapes[0]) in (2, 4) else f"product over {len(shapes[0])} axes"
    else:
        shapes = [graph.shape(name) for name in (*graph.activations(root), *root.outputs) if name]
        if any(len(shape) != 4 for shape in shapes if len(shape) > 0):
            yield "needs tensors with two spatial axes"
    for shape in shapes:
        yield _size(shape)
    for node in region.nodes:
        if kinds[node] == POINTWISE:
            yield _pointwise(graph, node)
        elif kinds[node] == VIEW:
            yield "" if node.op in ("Identity", "Dropout", "Cast") else "reshapes inside the kernel"


def _size(shape: tuple[int, ...]) -> str:
    if shape and shape[0] > _MAX_BATCH:
        return f"batch of {shape[0]}, over {_MAX_BATCH}"
    if any(size > _MAX_SIZE for size in shape[1:]):
        return f"axis of {max(shape[1:])}, over {_MAX_SIZE}"
    return ""


def _root(graph: Graph, region: Region) -> str:
    node = region.root
    if node.op == "Conv":
        return _convolution(graph, node)
    if node.op == "ConvTranspose":
        return _deconvolution(graph, node)
    if node.op in ("Gemm", "MatMul"):
        if not graph.tensors[node.input(1)].const:
            return "product of two activations" if not graph.tensors[node.input(0)].const else "weights on the left"
        return "" if len(graph.shape(node.input(1))) == 2 else "batched weights"
    if region.kind == COMPUTE:
        return f"{node.op} is not supported"
    if region.kind == POINTWISE:
        return ""
    if node.op in ("MaxPool", "AveragePool"):
        return _pooling(graph, node, node.integers("kernel_shape"))
    if node.op in ("GlobalAveragePool", "GlobalMaxPool"):
        return _pooling(graph, node, graph.shape(node.input(0))[2:])
    if node.op == "ReduceMean":
        shape, axes = graph.shape(node.input(0)), graph.axes(node)
        if len(shape) == 4 and axes is not None and {axis % 4 for axis in axes} == {2, 3}:
            return _pooling(graph, node, shape[2:])
        return "mean over other than rows and columns"
    if node.op == "ReduceMax":
        return ""
    if node.op in ("Resize", "Upsample"):
        return _resize(graph, node)
    if node.op == "LRN":
        return "" if node.integer("size", 5) in (3, 5, 7, 9) else "normalisation window other than 3, 5, 7 or 9"
    if node.op in ("Softmax", "LogSoftmax"):
        return "softmax runs only on Orin's DLA" if node.op == "Softmax" else "LogSoftmax is not supported"
    return f"{memory_op(node).removeprefix('mem:')} is not supported"


def _outside(values: Iterable[int], low: int, high: int) -> bool:
    return any(not low <= value <= high for value in values)


def _convolution(graph: Graph, node: Node) -> str:
    weight = graph.shape(node.input(1))
    if len(weight) != 4:
        return f"convolution over {len(weight) - 2} axes, not 2"
    if not graph.tensors[node.input(1)].const:
        return "convolution with computed weights"
    if _outside(weight[2:], 1, 32):
        return f"convolution window {weight[2]}x{weight[3]}, over 32"
    if _outside(node.integers("strides", (1, 1)), 1, 8):
        return "convolution stride over 8"
    if _outside(node.integers("pads", (0,)), 0, 31):
        return "convolution padding over 31"
    if _outside(node.integers("dilations", (1, 1)), 1, 32):
        return "convolution dilation over 32"
    return "" if weight[0] <= _MAX_SIZE else f"{weight[0]} output maps, over {_MAX_SIZE}"


def _deconvolution(graph: Graph, node: Node) -> str:
    weight = graph.shape(node.input(1))
    if len(weight) != 4:
        return f"deconvolution over {len(weight) - 2} axes, not 2"
    if any(node.integers("pads", (0,))) or any(node.integers("output_padding", (0,))):
        return "deconvolution with padding"
    if node.integer("group", 1) != 1 or any(size != 1 for size in node.integers("dilations", (1, 1))):
        return "grouped or dilated deconvolution"
    if _outside(weight[2:], 1, 32) or _outside(node.integers("strides", (1, 1)), 1, 32):
        return "deconvolution window or stride over 32"
    return ""


def _pooling(graph: Graph, node: Node, window: tuple[int, ...]) -> str:
    if len(window) != 2:
        return f"pooling over {len(window)} axes, not 2"
    if _outside(window, 1, 8):
        return f"pooling window {window[0]}x{window[1]}, over 8"
    if _outside(node.integers("strides", (1, 1)), 1, 16):
        return "pooling stride over 16"
    if _outside(node.integers("pads", (0,)), 0, 7):
        return "pooling padding over 7"
    if any(size != 1 for size in node.integers("dilations", (1,))):
        return "dilated pooling"
    return "" if len([name for name in node.outputs if name]) < 2 else "pooling that also returns indices"


def _resize(graph: Graph, node: Node) -> str:
    source, target = graph.shape(node.input(0)), graph.shape(node.outputs[0])
    if len(source) != 4 or source[:2] != target[:2] or not all(source[2:]):
        return "resize of other than rows and columns"
    mode = node.text("mode", "nearest")
    most = {"nearest": 32, "linear": 4}.get(mode, 0)
    if not most:
        return f"{mode} resize"
    for old, new in zip(source[2:], target[2:], strict=True):
        if new % old or not 1 <= new // old <= most:
            return f"{mode} resize by other than a whole factor of 1 to {most}"
    return ""


def _pointwise(graph: Graph, node: Node) -> str:
    if node.op in _ORIN_ONLY:
        return f"{node.op} runs only on Orin's DLA"
    if node.op not in _ELEMENTWISE:
        return f"{node.op} is not supported"
    if node.op == "Clip" and node.version >= 11:
        low = graph.value(node, 1)
        return "clip that does not start at 0" if low is None or low.size != 1 or float(low.ravel()[0]) else ""
    if node.op == "Clip":
        return "clip that does not start at 0" if node.attrs.get("min", -1.0) != 0 else ""
    return ""

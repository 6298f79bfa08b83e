"""What kind of work each operator is on a device."""

from __future__ import annotations

from robotbrain.jetson.graph.folding import slice_ranges
from robotbrain.jetson.graph.ir import FLOAT_TYPES, Graph, Node

COMPUTE, POINTWISE, MEMORY = "compute", "pointwise", "memory"
VIEW, CONCAT, QUANTIZE, DEQUANTIZE = "view", "concat", "quantize", "dequantize"

CONVOLUTIONS = frozenset({"Conv", "ConvTranspose", "ConvInteger", "QLinearConv", "DeformConv"})
PRODUCTS = frozenset({"Gemm", "MatMul", "MatMulInteger", "QLinearMatMul"})
RECURRENT = {"LSTM": 4, "GRU": 3, "RNN": 1}
"""Gates of each recurrent layer."""

INTEGER_PRODUCTS = frozenset({"ConvInteger", "QLinearConv", "MatMulInteger", "QLinearMatMul"})

_POINTWISE_WORDS = """
    Abs Acos Acosh Add And Asin Asinh Atan Atanh BatchNormalization BitShift BitwiseAnd BitwiseNot BitwiseOr
    BitwiseXor Cast CastLike Ceil Celu Clip Cos Cosh Div Elu Equal Erf Exp Floor Gelu Greater GreaterOrEqual
    HardSigmoid HardSwish IsInf IsNaN LeakyRelu Less LessOrEqual Log Max Mean Min Mish Mod Mul Neg Not Or PRelu Pow
    Reciprocal Relu Round Selu Shrink Sigmoid Sign Sin Sinh Softplus Softsign Sqrt Sub Sum Swish Tan Tanh
    ThresholdedRelu Where Xor FastGelu QuickGelu
"""
_POINTWISE = frozenset(_POINTWISE_WORDS.split())
_VIEWS = frozenset(
    {"Identity", "Dropout", "Reshape", "Flatten", "Squeeze", "Unsqueeze", "Transpose", "Split", "Expand"}
)
RESHAPES = frozenset({"Identity", "Dropout", "Reshape", "Flatten", "Squeeze", "Unsqueeze", "Cast"})
"""Views that leave the order of the elements alone (a Cast only between floating-point types)."""

_VIEWS = (RESHAPES - {"Cast"}) | {"Transpose", "Split", "Expand"}

# Quantisation passes through these, so TensorRT runs them on 8-bit data where both sides are 8-bit.
COMMUTING = frozenset(
    {
        "MaxPool",
        "AveragePool",
        "GlobalAveragePool",
        "GlobalMaxPool",
        "ReduceMean",
        "Resize",
        "Upsample",
        "Pad",
        "Gather",
    }
)

_NAMES = {
    "MaxPool": "max_pool",
    "GlobalMaxPool": "max_pool",
    "AveragePool": "avg_pool",
    "GlobalAveragePool": "mean",
    "ReduceMean": "mean",
    "Upsample": "resize",
    "LayerNormalization": "layer_norm",
    "RMSNormalization": "rms_norm",
    "InstanceNormalization": "instance_norm",
    "GroupNormalization": "group_norm",
    "MeanVarianceNormalization": "instance_norm",
    "LpNormalization": "lp_norm",
    "LogSoftmax": "softmax",
    "Hardmax": "softmax",
    "TopK": "topk",
    "NonMaxSuppression": "nms",
    "NonZero": "nonzero",
    "DynamicQuantizeLinear": "reformat",
    "QuantizeLinear": "reformat",
    "DequantizeLinear": "reformat",
    "LRN": "lrn",
    "CumSum": "cumsum",
}


def kind_of(graph: Graph, node: Node) -> str:
    """Return the kind of a node's work, taken on its own."""
    op = node.op
    if op == "QuantizeLinear":
        return QUANTIZE
    if op == "DequantizeLinear":
        return DEQUANTIZE
    if node.domain:
        return POINTWISE if op in ("Gelu", "FastGelu", "QuickGelu") else MEMORY
    if op in CONVOLUTIONS or op in PRODUCTS or op in RECURRENT or op in ("Einsum", "Attention"):
        return COMPUTE if op != "Einsum" or len(node.inputs) > 1 else MEMORY
    if op == "Concat":
        return CONCAT
    if op in _VIEWS or _is_view(graph, node):
        return VIEW
    return POINTWISE if op in _POINTWISE else MEMORY


def memory_op(node: Node) -> str:
    """Return the op class of a kernel that only moves data, e.g. ``"mem:max_pool"``."""
    if node.domain:
        return "mem:plugin"
    if node.op in _NAMES:
        return "mem:" + _NAMES[node.op]
    if node.op.startswith("Reduce"):
        return "mem:reduce"
    words = "".join("_" + letter.lower() if letter.isupper() else letter for letter in node.op)
    return "mem:" + words.lstrip("_")


def selects(graph: Graph, node: Node) -> bool:
    """Whether a Gather takes one fixed element along its axis, as ``x[:, 0]`` does."""
    index = graph.value(node, 1)
    return node.op == "Gather" and index is not None and index.size == 1 and not graph.tensors[node.input(0)].const


def _is_view(graph: Graph, node: Node) -> bool:
    if node.op == "Cast":
        # The builder chooses the precision, so a cast between floating-point types is nothing of its own.
        source, target = graph.tensors[node.input(0)].dtype, graph.tensors[node.outputs[0]].dtype
        return source == target or (source in FLOAT_TYPES and target in FLOAT_TYPES)
    if node.op == "Slice":
        try:
            values = [graph.tensors[name].value if name else None for name in node.inputs]
            ranges = slice_ranges(node, values, graph.shape(node.input(0)))
        except (ValueError, IndexError, TypeError):
            return False
        return all(step > 0 for _, _, step in ranges)
    return selects(graph, node)

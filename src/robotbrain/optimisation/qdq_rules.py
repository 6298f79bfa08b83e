"""What TensorRT refuses in a Q/DQ model, rule by rule.

Sources: "Working with Quantized Types" (https://docs.nvidia.com/deeplearning/tensorrt/latest/inference-library/
work-quantized-types.html) for the symmetric signed scheme, per-tensor activations and constant scales; the operator
table of the ONNX parser (https://github.com/onnx/onnx-tensorrt/blob/main/docs/operators.md); and what the parser says
when it refuses: "only supports symmetric quantization" (https://github.com/NVIDIA/TensorRT/issues/2774), 32-bit biases
(https://github.com/microsoft/onnxruntime/issues/14229), weights stored as INT8
(https://github.com/microsoft/onnxruntime/issues/11535). The guide of TensorRT 10 and later allows weights stored as
INT8 behind a DQ ("Explicit Quantization"); for 8.x they are taken as refused.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from robotbrain.optimisation.onnx_files import dims, open_inputs, opset_of
from robotbrain.optimisation.qdq_context import DQ, INT8, INT32, UINT8, Context, Finding, Q, axis_of, label
from robotbrain.optimisation.qdq_graph import COMPUTE, dequantised

SAFE_OPSET = 17
"""What the TensorRT of JetPack 5.0.2 to 6.0 parses; newer ones parse more."""

_WITHOUT_PARSER_WORDS = """
    Bernoulli BitShift BlackmanWindow Compress ConcatFromSequence DFT Det HammingWindow HannWindow Hardmax IsInf
    LayerNormalization MaxRoiPool MaxUnpool MelWeightMatrix Multinomial NegativeLogLikelihoodLoss Optional
    OptionalGetElement OptionalHasElement STFT SequenceAt SequenceConstruct SequenceEmpty SequenceErase SequenceInsert
    SequenceLength SequenceMap SoftmaxCrossEntropyLoss SplitToSequence StringNormalizer TfIdfVectorizer Unique
"""
_WITHOUT_PARSER = frozenset(_WITHOUT_PARSER_WORDS.split())
"""Operators that the table of TensorRT 8.5 marks as not supported."""


def opset(context: Context) -> Iterator[Finding]:
    """The opset is one that the JetPack's parser knows, and one in which Q/DQ have an axis."""
    version = opset_of(context.model)
    release = context.jetpack
    newest = SAFE_OPSET if release is None else int(release.onnx_opset.value)
    if version > newest:
        what = "JetPack 5.0.2 to 6.0" if release is None else f"JetPack {release.version}"
        yield Finding(
            "opset",
            "error",
            "",
            f"The file uses opset {version}; the TensorRT of {what} parses up to {newest}.",
            f"Export with torch.onnx.export(..., opset_version={newest}"
            + (", dynamo=False" if newest < 18 else "")
            + ")."
            + (" If your JetPack is newer, say which." if release is None else ""),
        )
    if version < 13:
        yield Finding(
            "opset",
            "error",
            "",
            f"The file uses opset {version}; Q/DQ have a scale per channel from 13 on.",
            "Export with opset_version=17.",
        )


def operators(context: Context) -> Iterator[Finding]:
    """Every operator is one that TensorRT parses."""
    for node in context.model.graph.node:
        op, domain = node.op_type, node.domain
        if op.startswith("QLinear") or op.endswith("Integer") or op == "DynamicQuantizeLinear":
            yield Finding(
                "operator-oriented",
                "error",
                label(node),
                f"{op} computes on integers by itself; TensorRT only knows ordinary operators between Q and DQ.",
                "Quantise with quant_format=QuantFormat.QDQ, or with quantise_onnx(target='tensorrt').",
            )
        elif domain not in ("", "ai.onnx"):
            yield Finding(
                "unsupported-op",
                "error",
                label(node),
                f"{domain}::{op} is no operator of ONNX; TensorRT has none of that name without a plugin.",
                "Export without operators of one runtime: no optimised or contributed ones.",
            )
        elif op in _WITHOUT_PARSER:
            yield Finding(
                "unsupported-op",
                "error" if context.tensorrt <= (8, 5) else "warning",
                label(node),
                f"{op} is not supported by the parser of TensorRT 8.5; a newer one may have it.",
                "Write it with simpler operators, or take it out of the network and do it before or after.",
            )


def integer_types(context: Context) -> Iterator[Finding]:
    """Integers are signed 8-bit, and zero points are zero."""
    for node in context.nodes(Q, DQ):
        kind = context.integer_type(node)
        name = node.input[2] if len(node.input) > 2 else ""
        points = context.value(name)
        if kind is None and name:
            yield Finding(
                "zero-point",
                "error",
                label(node),
                "The zero point is computed; TensorRT must see at build time that it is 0.",
                "Store it as a constant.",
            )
        elif kind == UINT8:
            yield Finding(
                "asymmetric",
                "error",
                label(node),
                "Its integers are unsigned (uint8)"
                + ("" if name else ", the type that ONNX assumes where no zero point is given")
                + "; TensorRT's INT8 is signed and symmetric about 0.",
                "Quantise with activation_type=QuantType.QInt8 and extra_options={'ActivationSymmetric': True}.",
            )
        elif kind == INT8 and points is not None and np.any(points != 0):
            yield Finding(
                "zero-point",
                "error",
                label(node),
                f"Its zero point is {int(points.ravel()[np.flatnonzero(points)[0]])}; TensorRT multiplies without "
                "correction terms, so it must be 0.",
                "Quantise symmetrically: extra_options={'ActivationSymmetric': True, 'WeightSymmetric': True}.",
            )
        elif kind not in (INT8, None) and (kind, node.op_type) != (INT32, DQ):
            yield Finding(
                "type",
                "error",
                label(node),
                f"Its integers are of ONNX type {kind}, not int8.",
                "Quantise to 8 bits: other widths need TensorRT 10 and hardware of their own.",
            )


def biases(context: Context) -> Iterator[Finding]:
    """Biases stay in floating point."""
    for node in context.nodes(DQ):
        if context.integer_type(node) == INT32:
            yield Finding(
                "bias-dq",
                "error",
                label(node),
                "A 32-bit bias is dequantised; TensorRT dequantises 8-bit integers only and keeps biases in floating "
                "point.",
                "Quantise with extra_options={'QuantizeBias': False}.",
            )


def scales(context: Context) -> Iterator[Finding]:
    """Scales are constants, finite and positive."""
    for node in context.nodes(Q, DQ):
        values = context.value(node.input[1])
        if values is None:
            yield Finding(
                "scale",
                "error",
                label(node),
                "Its scale is computed while running; TensorRT needs it at build time.",
                "Quantise statically, with calibration data, not dynamically.",
            )
        elif not (np.isfinite(values).all() and (values > 0).all()):
            yield Finding(
                "scale",
                "error",
                label(node),
                "Its scale is not a positive finite number.",
                "Calibrate again: a scale of 0 or NaN comes from constant or broken activations.",
            )


def axes(context: Context) -> Iterator[Finding]:
    """One scale for a whole activation; one per output channel, along the right axis, for a weight."""
    for node in context.nodes(Q, DQ):
        values = context.value(node.input[1])
        if values is None or values.size == 1:
            continue
        if not context.constant(node):
            yield Finding(
                "axis",
                "error",
                label(node),
                f"An activation has {values.size} scales; TensorRT takes one for the whole tensor.",
                "Per channel is for weights: quantise activations per tensor.",
            )
            continue
        if node.op_type == Q:
            continue
        for reader in context.read.get(node.output[0], ()):
            wanted = _channel_axis(context, node, reader)
            if wanted is None:
                continue
            axis, rank, size = wanted
            if values.ndim != 1 or axis_of(node) % rank != axis or values.size != size:
                given = f"axis {axis_of(node)}" if values.ndim == 1 else f"{values.ndim} axes"
                yield Finding(
                    "axis",
                    "error",
                    label(node),
                    f"{values.size} scales along {given} of the weight of {reader.op_type} {label(reader)}; its "
                    f"{size} output channels are axis {axis}.",
                    f"Set the axis attribute of Q and DQ to {axis}; left out it means 1.",
                )


def _channel_axis(context: Context, dequantise: Any, reader: Any) -> tuple[int, int, int] | None:
    """Return axis of the output channels (the rows of a left factor), rank and channels of a weight read directly."""
    quantise = context.source(dequantise.input[0], Q)
    tensor = context.stored[(quantise or dequantise).input[0]]
    shape = tuple(tensor.dims)
    place = next((at for at, name in enumerate(reader.input[:2]) if name == dequantise.output[0]), None)
    if reader.op_type not in COMPUTE or place is None:
        return None
    if reader.op_type == "MatMul":
        axis = len(shape) - 2 + place
    elif reader.op_type == "Gemm":
        axis = place ^ any(a.name == ("transA", "transB")[place] and a.i for a in reader.attribute)
    else:
        axis = 0 if reader.op_type == "Conv" else 1
    return (axis, len(shape), shape[axis]) if 0 <= axis < len(shape) else None


def pairs(context: Context) -> Iterator[Finding]:
    """Every Q is followed by DQs with its own scale, every DQ preceded by a Q."""
    for node in context.nodes(Q):
        following = context.read.get(node.output[0], [])
        others = [reader for reader in following if reader.op_type != DQ]
        if not following or others:
            yield Finding(
                "unpaired",
                "error",
                label(node),
                "Its integers go to "
                + (f"{others[0].op_type} {label(others[0])}" if others else "no DequantizeLinear")
                + ", so it is no Q/DQ pair.",
                "Put a DequantizeLinear with the same scale behind it.",
            )
    for node in context.nodes(DQ):
        quantise = context.source(node.input[0], Q)
        if quantise is not None:
            if _differ(context, quantise, node):
                yield Finding(
                    "mismatch",
                    "error",
                    label(node),
                    f"Scale, zero point or axis differ from those of {label(quantise)} before it.",
                    "Both nodes of a pair read the same constants.",
                )
        elif node.input[0] not in context.stored:
            yield Finding(
                "unpaired",
                "error",
                label(node),
                "No QuantizeLinear makes the integers it reads.",
                "Put a QuantizeLinear with the same scale before it; inputs of the network stay in floating point.",
            )
        elif context.integer_type(node) == INT8 and context.tensorrt < (10, 0):
            yield Finding(
                "weight-pair",
                "error",
                label(node),
                "The weight is stored as integers with a DQ only; TensorRT before 10 reads weights in floating point, "
                "behind a Q/DQ pair.",
                "Quantise with extra_options={'AddQDQPairToWeight': True}.",
            )


def _differ(context: Context, quantise: Any, dequantise: Any) -> bool:
    for first, second in zip(quantise.input[1:], dequantise.input[1:], strict=False):
        if first != second:
            one, two = context.value(first), context.value(second)
            if one is None or two is None or one.shape != two.shape or not np.array_equal(one, two):
                return True
    scale = context.value(quantise.input[1])
    return scale is not None and scale.size > 1 and axis_of(quantise) != axis_of(dequantise)


def shapes(context: Context) -> Iterator[Finding]:
    """Only the batch may have any length."""
    for info in open_inputs(context.model):
        free = [f"axis {place} ({axis or 'unnamed'})" for place, axis in enumerate(dims(info)) if isinstance(axis, str)]
        beyond = [text for text in free if not text.startswith("axis 0 ")]
        if beyond:
            yield Finding(
                "dynamic-shape",
                "warning",
                str(info.name),
                f"{', '.join(beyond)} of the input may have any length; TensorRT then needs an optimisation profile "
                "and picks kernels for a range of sizes.",
                "Export with dynamic_axes for the batch only.",
            )


def halves(context: Context) -> Iterator[Finding]:
    """Both operands of a convolution or product are quantised, or neither."""
    if not any(True for _ in context.nodes(Q, DQ)):
        yield Finding(
            "not-quantised",
            "warning",
            "",
            "The file has no Q/DQ nodes: TensorRT builds it in FP32 or FP16.",
            "Quantise it with quantise_onnx(target='tensorrt') if it is meant to run in INT8.",
        )
        return
    for node in context.nodes(*COMPUTE):
        low = [dequantised(context.made, name) for name in node.input[:2]]
        if len(low) == 2 and low[0] != low[1]:
            which, other = ("activation", "weight") if low[0] else ("weight", "activation")
            yield Finding(
                "half-quantised",
                "warning",
                label(node),
                f"Its {which} is quantised but its {other} is not: it runs in floating point, and the pair is wasted.",
                f"Put a Q/DQ pair before the {other} too, or exclude the node.",
            )


RULES = (opset, operators, integer_types, biases, scales, axes, pairs, shapes, halves)
"""In the order in which they are applied."""

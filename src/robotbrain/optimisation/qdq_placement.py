"""Where Q/DQ pairs cost time in TensorRT though they are allowed: they keep operators from becoming one kernel.

Sources: the residual branch, NVIDIA's "Add Custom QDQ Insertion Case" (https://docs.nvidia.com/deeplearning/tensorrt/
tensorflow-quantization-toolkit/docs/docs/add_custom_qdq_cases.html) and
https://github.com/NVIDIA/TensorRT/issues/1992; convolution with what follows, "Explicit Quantization"
(https://docs.nvidia.com/deeplearning/tensorrt/latest/inference-library/quantized-types-explicit-quantization.html);
concatenation, https://github.com/NVIDIA/TensorRT/issues/3861. Which pairs become kernels of their own is computed by
:mod:`robotbrain.jetson.graph.quantization`, a model of the builder, not the builder.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from robotbrain.errors import InputError
from robotbrain.jetson.graph import analyse
from robotbrain.optimisation.onnx_files import dims, open_inputs
from robotbrain.optimisation.qdq_context import DQ, Context, Finding, Q, label
from robotbrain.optimisation.qdq_graph import COMPUTE, convolved

_FUSED_BEHIND = frozenset({"Relu", "Clip", "LeakyRelu", "BatchNormalization", "Sigmoid", "HardSwish", "HardSigmoid"})


def split_fusions(context: Context) -> Iterator[Finding]:
    """No pair between a convolution and its activation."""
    for node in context.nodes(Q):
        source = context.made.get(node.input[0])
        if source is None or source.op_type not in COMPUTE:
            continue
        for dequantise in context.read.get(node.output[0], ()):
            for reader in context.read.get(dequantise.output[0], ()):
                if reader.op_type in _FUSED_BEHIND:
                    yield Finding(
                        "split-fusion",
                        "warning",
                        label(node),
                        f"A pair stands between {source.op_type} {label(source)} and {reader.op_type} {label(reader)}, "
                        "which would otherwise be one kernel.",
                        "Quantise behind the activation, not before it: do not quantise the outputs of convolutions.",
                    )


def additions(context: Context) -> Iterator[Finding]:
    """A residual addition has a pair on the residual branch, and none behind the convolution it fuses with."""
    for node in context.nodes("Add"):
        if len(node.input) != 2 or any(name in context.stored for name in node.input):
            continue
        pairs = [context.pair(name) for name in node.input]
        if all(pairs):
            fusible = [pair[0] for pair in pairs if pair and convolved(context.made, context.read, pair[0].input[0])]
            if fusible:
                yield Finding(
                    "residual-pair",
                    "warning",
                    label(node),
                    f"Both operands have a pair; the one behind {label(context.made[fusible[0].input[0]])} keeps the "
                    "convolution and the addition from becoming one kernel.",
                    "Keep the pair on the residual branch only.",
                )
        elif not any(pairs) and _requantised(context, node):
            yield Finding(
                "residual-missing",
                "warning",
                label(node),
                "The sum is quantised but neither operand is, so the residual branch is read in floating point.",
                "Put a Q/DQ pair on the residual branch.",
            )


def concatenations(context: Context) -> Iterator[Finding]:
    """All inputs of a concatenation that is quantised have a pair, and one scale."""
    for node in context.nodes("Concat"):
        pairs = [context.pair(name) for name in node.input if name not in context.stored]
        readers = [reader for reader in context.read.get(node.output[0], ()) if reader.op_type == Q]
        low = [pair for pair in pairs if pair]
        if len(low) < len(pairs) and (low or readers):
            yield Finding(
                "concat-missing",
                "warning",
                label(node),
                f"{len(pairs) - len(low)} of its {len(pairs)} inputs have no Q/DQ pair, so it is copied in floating "
                "point.",
                "Put a pair with the same scale on every input.",
            )
        elif low:
            scales = [context.value(quantise.input[1]) for quantise, _ in low]
            scales += [context.value(reader.input[1]) for reader in readers]
            known = [scale for scale in scales if scale is not None]
            if any(not np.array_equal(scale, known[0]) for scale in known[1:]):
                yield Finding(
                    "concat-scale",
                    "warning",
                    label(node),
                    "Its inputs and its output have different scales, so each part is rescaled while it is copied.",
                    "Give them all the scale of the widest range; quantise_onnx does.",
                )


def outputs(context: Context) -> Iterator[Finding]:
    """The network's outputs are not quantised."""
    for name in sorted(context.outputs):
        pair = context.pair(name)
        if pair:
            yield Finding(
                "output",
                "warning",
                label(pair[0]),
                f"The output {name!r} is rounded to 8 bits, though whoever reads it gets floating point anyway.",
                "Leave the output of the last layer in floating point.",
            )


def own_kernels(context: Context) -> Iterator[Finding]:
    """No pair becomes a kernel of its own, other than where the image comes in and the result leaves."""
    try:
        kernels = analyse(context.model).kernels
    except InputError:
        return  # shapes that cannot be known without lengths; the other rules have said so
    named = {label(node): node for node in context.nodes(Q, DQ)}
    entering = {info.name for info in open_inputs(context.model)}
    for kernel in kernels:
        node = named.get(kernel.name) if kernel.op == "mem:reformat" else None
        if node is None or node.input[0] in entering or _reaches_output(context, node):
            continue
        yield Finding(
            "reformat",
            "warning",
            label(node),
            f"No neighbour takes it in: it is a pass of its own over {kernel.in_elems} values.",
            "Move the pair behind what the value is computed by, or put one on the other inputs as well.",
        )


def dla(context: Context) -> Iterator[Finding]:
    """What a deep learning accelerator would leave to the GPU.

    Releases: https://docs.nvidia.com/deeplearning/tensorrt/11.4.1/inference-library/dla-strongly-typed-networks.html
    (10.7 was the last with DLA before 11.4.1, which needs JetPack 7.2.2 and an AGX Orin).
    """
    if (10, 7) < context.tensorrt < (11, 4):
        yield Finding(
            "dla",
            "error",
            "",
            f"The TensorRT {context.tensorrt[0]}.{context.tensorrt[1]} of this JetPack does not drive the DLAs.",
            "Stay on JetPack 6.2 for them.",
        )
    if any(True for _ in context.nodes(Q, DQ)):
        yield Finding(
            "dla-qdq",
            "warning",
            "",
            "TensorRT 8.x builds INT8 for a DLA from a calibration cache, not from Q/DQ nodes; how much of Q/DQ later "
            "releases take there is for the board to show.",
            "Keep a cache for the floating-point file as well: CalibrationTable.save_tensorrt_cache.",
        )
    for info in open_inputs(context.model):
        if any(isinstance(axis, str) for axis in dims(info)[1:]):
            yield Finding(
                "dla",
                "error",
                str(info.name),
                "A DLA needs fixed sizes.",
                "Export with dynamic_axes for the batch only; the build fixes it.",
            )
    try:
        kernels = analyse(context.model).kernels
    except InputError as error:
        yield Finding("dla", "warning", "", f"It cannot be analysed: {error.what}.", error.fix)
        return
    refused = [kernel for kernel in kernels if kernel.dla_reason and kernel.op != "mem:reformat"]
    for kernel in refused:
        yield Finding(
            "dla",
            "error" if len(refused) == len(kernels) else "warning",
            kernel.name,
            f"A DLA cannot run it: {kernel.dla_reason}. It falls back to the GPU, with a copy each way.",
            "Change the layer, or build with GPU fallback and measure.",
        )


def _requantised(context: Context, node: Any) -> bool:
    """Whether a Q follows, at once or behind an activation."""
    for reader in context.read.get(node.output[0], ()):
        behind = context.read.get(reader.output[0], ()) if reader.op_type in _FUSED_BEHIND else ()
        if reader.op_type == Q or any(item.op_type == Q for item in behind):
            return True
    return False


def _reaches_output(context: Context, node: Any) -> bool:
    names = [node.output[0], *(item.output[0] for item in context.read.get(node.output[0], ()) if item.op_type == DQ)]
    return any(name in context.outputs for name in names)


PLACEMENT_RULES = (split_fusions, additions, concatenations, outputs, own_kernels)
"""In the order in which they are applied."""

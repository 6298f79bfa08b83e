"""Small ONNX files for the tests of the engines."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

SIZE = 6
"""Height and width of the image."""


def write(
    path: Path,
    *,
    quantised: bool = False,
    half: bool = False,
    zero_point: int = 0,
    batch: int | str = "batch",
    operator: str | None = None,
    two_outputs: bool = False,
    seed: int = 0,
) -> Path:
    """Write ``mean(relu(conv(image)))`` with a few variations: Q/DQ round the input, FP16 inside, an odd operator."""
    rng = np.random.default_rng(seed)
    kind = np.float16 if half else np.float32
    weights = [numpy_helper.from_array(rng.normal(size=(4, 3, 3, 3)).astype(kind), "w")]
    nodes, image = [], "image"
    if quantised:
        weights += [
            numpy_helper.from_array(np.float32(0.05), "scale"),
            numpy_helper.from_array(np.int8(zero_point), "zero"),
        ]
        nodes += [
            helper.make_node("QuantizeLinear", [image, "scale", "zero"], ["q"], "quantise"),
            helper.make_node("DequantizeLinear", ["q", "scale", "zero"], ["dq"], "dequantise"),
        ]
        image = "dq"
    if half:
        nodes.append(helper.make_node("Cast", [image], ["half"], "cast", to=TensorProto.FLOAT16))
        image = "half"
    nodes += [
        helper.make_node("Conv", [image, "w"], ["c"], "convolution", pads=[1, 1, 1, 1]),
        helper.make_node("Relu", ["c"], ["r"], "relu"),
    ]
    last = "r"
    if half:
        nodes.append(helper.make_node("Cast", ["r"], ["back"], "back", to=TensorProto.FLOAT))
        last = "back"
    if operator is not None:
        nodes.append(helper.make_node(operator, [last], ["odd"], "strange", domain="nobody.knows"))
        last = "odd"
    nodes.append(helper.make_node("ReduceMean", [last], ["logits"], "mean", axes=[2, 3], keepdims=0))
    outputs = [helper.make_tensor_value_info("logits", TensorProto.FLOAT, [batch, 4])]
    if two_outputs:
        outputs.append(helper.make_tensor_value_info(last, TensorProto.FLOAT, [batch, 4, SIZE, SIZE]))
    graph = helper.make_graph(
        nodes,
        "tiny",
        [helper.make_tensor_value_info("image", TensorProto.FLOAT, [batch, 3, SIZE, SIZE])],
        outputs,
        weights,
    )
    opsets = [helper.make_opsetid("", 17)] + ([helper.make_opsetid("nobody.knows", 1)] if operator else [])
    onnx.save(helper.make_model(graph, opset_imports=opsets, ir_version=8), path)
    return path


def images(batch: int, seed: int = 1) -> np.ndarray:
    """Return random images (batch, 3, SIZE, SIZE), float32."""
    return np.random.default_rng(seed).normal(size=(batch, 3, SIZE, SIZE)).astype(np.float32)

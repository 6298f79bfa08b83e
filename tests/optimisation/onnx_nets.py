"""Small ONNX networks for the tests of quantisation, made without torch's exporter."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper


class Net:
    """A graph under construction; every method returns the name of what it computes."""

    def __init__(self, seed: int = 0) -> None:
        self.rng = np.random.default_rng(seed)
        self.nodes: list[Any] = []
        self.weights: list[Any] = []

    def node(self, op: str, inputs: Sequence[str], **attributes: Any) -> str:
        name = f"{op.lower()}{len(self.nodes)}"
        self.nodes.append(helper.make_node(op, list(inputs), [name], name=f"/{name}", **attributes))
        return name

    def constant(self, value: Any, name: str | None = None) -> str:
        name = name or f"w{len(self.weights)}"
        self.weights.append(numpy_helper.from_array(np.asarray(value), name))
        return name

    def conv(self, x: str, channels: int, out: int, *, kernel: int = 3, group: int = 1, bias: bool = True) -> str:
        shape = (out, channels // group, kernel, kernel)
        # Output channels of very different sizes, as after folding a normalisation: per channel matters.
        w = self.rng.normal(size=shape) * 10 ** self.rng.uniform(-1.5, 0.0, size=(out, 1, 1, 1))
        w *= np.sqrt(2.0 / np.prod(shape[1:])) / np.sqrt(np.mean(w**2))
        inputs = [x, self.constant(w.astype(np.float32))]
        if bias:
            inputs.append(self.constant(self.rng.normal(size=out).astype(np.float32) * np.float32(0.1)))
        return self.node("Conv", inputs, pads=[kernel // 2] * 4, group=group)

    def relu(self, x: str) -> str:
        return self.node("Relu", [x])

    def double(self, x: str) -> str:
        scales = self.constant(np.float32([1, 1, 2, 2]))
        return self.node("Resize", [x, "", scales], mode="nearest", coordinate_transformation_mode="asymmetric")

    def model(
        self, out: str, *, batch: int | str = "batch", size: int | str = 16, opset: int = 17, rank: int = 4
    ) -> Any:
        self.nodes[[node.output[0] for node in self.nodes].index(out)].output[0] = "logits"
        graph = helper.make_graph(
            self.nodes,
            "tiny",
            [helper.make_tensor_value_info("image", TensorProto.FLOAT, [batch, 3, size, size])],
            [helper.make_tensor_value_info("logits", TensorProto.FLOAT, [batch] + [None] * (rank - 1))],
            self.weights,
        )
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", opset)], ir_version=8)
        onnx.checker.check_model(model)
        return model


def unet(**options: Any) -> Any:
    """Return a network with all that matters: residual addition, pooling, resizing, concatenation, depthwise."""
    net = Net()
    a = net.relu(net.conv("image", 3, 8))
    b = net.node("MaxPool", [a], kernel_shape=[2, 2], strides=[2, 2])
    b = net.relu(net.conv(b, 8, 16))
    c = net.conv(net.relu(net.conv(b, 16, 16, group=16)), 16, 16, kernel=1)
    c = net.relu(net.node("Add", [c, b]))
    d = net.node("Concat", [net.double(c), a], axis=1)
    return net.model(net.conv(net.relu(net.conv(d, 24, 8)), 8, 4, kernel=1), **options)


def images(count: int = 8, size: int = 16, seed: int = 1) -> Any:
    """Return (count, 3, size, size) float32, smooth and then noisy."""
    rng = np.random.default_rng(seed)
    wide = rng.normal(size=(count, 3, size // 4, size // 4)).repeat(4, axis=2).repeat(4, axis=3)
    return (wide + 0.2 * rng.normal(size=(*wide.shape[:2], size, size))).astype(np.float32)


def save(model: Any, path: Path) -> Path:
    onnx.save(model, str(path))
    return path

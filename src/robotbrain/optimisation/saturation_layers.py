"""The layers of a QDQ file that integer kernels run: their 8-bit weights, and their inputs as matrices."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

Product = Callable[[NDArray[np.uint8], NDArray[np.int8]], NDArray[np.int32]]


@dataclass(frozen=True)
class IntegerLayer:
    """A Conv, MatMul or Gemm between dequantised int8 weights and dequantised 8-bit activations.

    Attributes:
        name: of the node.
        op: its operator.
        activation: name of the quantised input.
        output: name of the output, float32.
        matrices: int8 weights as (K, N), one per group; K runs as in ONNX Runtime's kernels, channels fastest.
        scale: of the accumulator, (outputs,) float64: activation's times weight's.
        zero_point: of the activation.
        bias: (outputs,) float64.
        kernel, strides, pads, dilations: of a Conv (pads top, left, bottom, right), else empty.
    """

    name: str
    op: str
    activation: str
    output: str
    matrices: tuple[NDArray[np.int8], ...]
    scale: NDArray[np.float64]
    zero_point: int
    bias: NDArray[np.float64]
    kernel: tuple[int, ...] = ()
    strides: tuple[int, ...] = ()
    pads: tuple[int, ...] = ()
    dilations: tuple[int, ...] = ()

    def apply(self, quantised: NDArray[Any], product: Product) -> NDArray[np.float64]:
        """Return the layer's output for its quantised input, with a given product of bytes."""
        # ONNX Runtime's kernels on x86 take unsigned activations; it shifts signed ones.
        shift = 128 if quantised.dtype == np.int8 else 0
        unsigned = (quantised.astype(np.int16) + shift).astype(np.uint8)
        zero = self.zero_point + shift
        if self.op == "Conv":
            rows, shape = self._patches(unsigned, zero)
        else:
            rows, shape = [unsigned.reshape(-1, unsigned.shape[-1])], quantised.shape[:-1]
        sums = [product(a, w) - zero * w.astype(np.int64).sum(axis=0) for a, w in zip(rows, self.matrices, strict=True)]
        result = np.concatenate(sums, axis=1) * self.scale + self.bias
        result = result.reshape(*shape, -1)
        return np.moveaxis(result, -1, 1) if self.op == "Conv" else result

    def _patches(self, image: NDArray[np.uint8], zero: int) -> tuple[list[NDArray[np.uint8]], tuple[int, ...]]:
        """Return one (positions, K) matrix per group, and the shape of the positions (N, height, width)."""
        top, left, bottom, right = self.pads
        padded = np.pad(image, ((0, 0), (0, 0), (top, bottom), (left, right)), constant_values=zero)
        reach = [d * (k - 1) + 1 for k, d in zip(self.kernel, self.dilations, strict=True)]
        windows = np.lib.stride_tricks.sliding_window_view(padded, reach, axis=(2, 3))
        windows = windows[:, :, :: self.strides[0], :: self.strides[1], :: self.dilations[0], :: self.dilations[1]]
        groups = np.split(windows, len(self.matrices), axis=1)
        shape = (windows.shape[0], windows.shape[2], windows.shape[3])
        return [np.ascontiguousarray(g.transpose(0, 2, 3, 4, 5, 1)).reshape(np.prod(shape), -1) for g in groups], shape


@dataclass
class _Graph:
    model: Any
    made_by: dict[str, Any] = field(default_factory=dict)
    stored: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.made_by = {name: node for node in self.model.graph.node for name in node.output}
        self.stored = {tensor.name: tensor for tensor in self.model.graph.initializer}

    def constant(self, name: str) -> NDArray[Any] | None:
        """Return a stored tensor, or what a Constant or a Q or DQ of stored tensors gives."""
        from onnx import numpy_helper

        if name in self.stored:
            return np.asarray(numpy_helper.to_array(self.stored[name]))
        node = self.made_by.get(name)
        if node is None:
            return None
        if node.op_type == "Constant" and node.attribute[0].name == "value":
            return np.asarray(numpy_helper.to_array(node.attribute[0].t))
        if node.op_type not in ("QuantizeLinear", "DequantizeLinear"):
            return None
        parts = [self.constant(part) for part in node.input]
        if any(part is None for part in parts):
            return None
        value, scale = (np.asarray(part) for part in parts[:2])
        zero = np.asarray(parts[2]) if len(parts) > 2 else np.zeros_like(scale, dtype=np.uint8)
        wide = [1] * value.ndim
        if scale.ndim and scale.size > 1:
            wide[_attribute(node, "axis", 1)] = -1
            scale, zero = scale.reshape(wide), zero.reshape(wide)
        if node.op_type == "DequantizeLinear":
            return np.asarray((value.astype(np.int64) - zero) * scale, dtype=np.float32)
        limits = np.iinfo(zero.dtype)
        steps = np.rint(value / scale) + zero.astype(np.int64)
        return np.asarray(steps.clip(limits.min, limits.max), dtype=zero.dtype)


def integer_layers(model: Any) -> list[IntegerLayer]:
    """Return the layers of an ``onnx.ModelProto`` that saturate where ``vpmaddubsw`` runs them, in order.

    Depthwise convolutions are left out (ONNX Runtime's kernel for them adds in 32 bits), and so are weights in uint8
    or with a zero point.
    """
    graph = _Graph(model)
    found = (_layer(graph, node) for node in model.graph.node if node.op_type in ("Conv", "MatMul", "Gemm"))
    return [layer for layer in found if layer is not None]


def _layer(graph: _Graph, node: Any) -> IntegerLayer | None:
    inputs = [graph.made_by.get(name) for name in node.input[:2]]
    if any(part is None or part.op_type != "DequantizeLinear" for part in inputs):
        return None
    activation, weight = inputs
    assert activation is not None and weight is not None
    integers, x_scale, w_scale = (
        graph.constant(name) for name in (weight.input[0], activation.input[1], weight.input[1])
    )
    zero = graph.constant(activation.input[2]) if len(activation.input) > 2 else np.zeros((), np.uint8)
    w_zero = graph.constant(weight.input[2]) if len(weight.input) > 2 else np.zeros(())
    if integers is None or x_scale is None or w_scale is None or zero is None or w_zero is None:
        return None
    if integers.dtype != np.int8 or x_scale.size != 1 or w_zero.any():
        return None
    groups = _attribute(node, "group", 1)
    extra: dict[str, Any] = {}
    if node.op_type == "Conv":
        if (
            integers.ndim != 4
            or (groups > 1 and integers.shape[1] == 1)
            or _attribute(node, "auto_pad", b"NOTSET") != b"NOTSET"
        ):
            return None
        # (outputs, inputs, height, width) to (height, width, inputs) by outputs
        parts = np.split(integers.transpose(0, 2, 3, 1), groups)
        matrices = tuple(np.ascontiguousarray(part.reshape(part.shape[0], -1).T) for part in parts)
        extra = {
            "kernel": integers.shape[2:],
            "strides": tuple(_attribute(node, "strides", (1, 1))),
            "pads": tuple(_attribute(node, "pads", (0, 0, 0, 0))),
            "dilations": tuple(_attribute(node, "dilations", (1, 1))),
        }
    else:
        turned = node.op_type == "Gemm" and _attribute(node, "transB", 0)
        if integers.ndim != 2 or (node.op_type == "Gemm" and _attribute(node, "transA", 0)):
            return None
        matrices = (np.ascontiguousarray(integers.T if turned else integers),)
    outputs = sum(matrix.shape[1] for matrix in matrices)
    bias = graph.constant(node.input[2]) if len(node.input) > 2 and node.input[2] else np.zeros(outputs)
    if bias is None:
        return None
    return IntegerLayer(
        name=node.name or node.output[0],
        op=node.op_type,
        activation=activation.input[0],
        output=node.output[0],
        matrices=matrices,
        scale=np.broadcast_to(float(x_scale.reshape(-1)[0]) * w_scale.astype(np.float64).reshape(-1), (outputs,)),
        zero_point=int(zero.reshape(-1)[0]),
        bias=np.broadcast_to(bias.astype(np.float64).reshape(-1), (outputs,)),
        **extra,
    )


def _attribute(node: Any, name: str, default: Any) -> Any:
    from onnx import helper

    return next((helper.get_attribute_value(a) for a in node.attribute if a.name == name), default)

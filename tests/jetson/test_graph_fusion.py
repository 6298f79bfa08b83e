"""Fusion, data movement, precision, DLA limits and memory, on graphs small enough to know the answer by heart."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime.quantization as ort_quantization
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from onnx import TensorProto, helper
from tests.jetson.graph_builders import model, node

from robotbrain.jetson.graph import analyse
from robotbrain.jetson.graph.layout import dense, reshaped
from robotbrain.jetson.kernels import Kernel, KernelGraph

IMAGE = {"x": (1, 8, 6, 6)}
CONV = node("Conv", "x w", "a", kernel_shape=[3, 3], pads=[1, 1, 1, 1])
W = (8, 8, 3, 3)
ELEMS = 8 * 6 * 6


def ops(graph: KernelGraph) -> list[str]:
    return [kernel.op for kernel in graph.kernels]


def only(graph: KernelGraph) -> Kernel:
    assert len(graph.kernels) == 1, ops(graph)
    return graph.kernels[0]


def scalar(value: float) -> np.ndarray[Any, np.dtype[np.float32]]:
    return np.asarray(value, np.float32)


GELU = [
    node("Div", "a sqrt2", "b"),
    node("Erf", "b", "c"),
    node("Add", "c one", "d"),
    node("Mul", "a d", "e"),
    node("Mul", "e half", "y"),
]
ACTIVATIONS = {
    "relu": [node("Relu", "a", "y")],
    "leaky": [node("LeakyRelu", "a", "y", alpha=0.1)],
    "relu6": [node("Clip", "a zero six", "y")],
    "tanh": [node("Tanh", "a", "y")],
    "elu": [node("Elu", "a", "y")],
    "silu": [node("Sigmoid", "a", "b"), node("Mul", "a b", "y")],
    "hardswish": [node("HardSigmoid", "a", "b"), node("Mul", "a b", "y")],
    "relu6 hardswish": [
        node("Add", "a three", "b"),
        node("Clip", "b zero six", "c"),
        node("Mul", "a c", "d"),
        node("Div", "d six", "y"),
    ],
    "gelu": GELU,
    "batch norm, relu": [node("BatchNormalization", "a s s s s", "b"), node("Relu", "b", "y")],
    "residual, relu": [node("Add", "a x", "b"), node("Relu", "b", "y")],
    "relu, residual": [node("Relu", "a", "b"), node("Add", "x b", "y")],
    "through identity, dropout and reshape": [
        node("Identity", "a", "b"),
        node("Dropout", "b", "c"),
        node("Reshape", "c flat", "d"),
        node("Relu", "d", "y"),
    ],
}
CONSTANTS: dict[str, Any] = {
    "w": W,
    "s": (8,),
    "zero": scalar(0),
    "six": scalar(6),
    "three": scalar(3),
    "one": scalar(1),
    "half": scalar(0.5),
    "sqrt2": scalar(2**0.5),
    "flat": np.array([1, -1]),
}


@pytest.mark.parametrize("name", ACTIVATIONS)
def test_what_follows_a_convolution_runs_with_it(name: str) -> None:
    graph = analyse(model([CONV, *ACTIVATIONS[name]], IMAGE, ["y"], CONSTANTS))
    kernel = only(graph)
    assert graph.weight_elems == 8 * 72 + (8 if "norm" in name else 0)
    assert (kernel.op, kernel.macs, kernel.weight_elems) == ("conv", ELEMS * 72, 8 * 72)
    assert (kernel.in_elems, kernel.out_elems) == (ELEMS, ELEMS)
    assert set(kernel.layers) >= {"a", "y"}


@pytest.mark.parametrize("name", sorted(set(ACTIVATIONS) - {"through identity, dropout and reshape"}))
def test_pointwise_chains_alone_are_one_kernel(name: str) -> None:
    nodes = [node("MaxPool", "x", "a", kernel_shape=[1, 1]), *ACTIVATIONS[name]]
    assert ops(analyse(model(nodes, IMAGE, ["y"], CONSTANTS))) == ["mem:max_pool", "pw"]


def test_an_intermediate_result_that_others_need_ends_the_fusion() -> None:
    nodes = [CONV, node("Relu", "a", "b"), node("Exp", "b", "c"), node("MaxPool", "b", "y", kernel_shape=[2, 2])]
    graph = analyse(model(nodes, IMAGE, ["y", "c"], CONSTANTS))
    assert ops(graph) == ["conv", "pw", "mem:max_pool"]
    assert graph.kernels[0].layers == ("a", "b")


def test_an_output_in_between_ends_the_fusion() -> None:
    graph = analyse(model([CONV, node("Relu", "a", "y")], IMAGE, ["a", "y"], CONSTANTS))
    assert ops(graph) == ["conv", "pw"]


def test_a_gate_that_is_broadcast_does_not_run_in_the_small_convolution_that_makes_it() -> None:
    nodes = [
        CONV,
        node("GlobalAveragePool", "a", "p"),
        node("Conv", "p v", "q"),
        node("Sigmoid", "q", "g"),
        node("Mul", "a g", "y"),
    ]
    graph = analyse(model(nodes, IMAGE, ["y"], {**CONSTANTS, "v": (8, 8, 1, 1)}))
    assert ops(graph) == ["conv", "mem:mean", "conv", "pw"]
    assert graph.kernels[-1].in_elems == ELEMS + 8


def test_two_convolutions_that_are_added_are_two_kernels() -> None:
    nodes = [CONV, node("Conv", "x v", "b"), node("Add", "a b", "c"), node("Relu", "c", "y")]
    graph = analyse(model(nodes, IMAGE, ["y"], {**CONSTANTS, "v": (8, 8, 1, 1)}))
    assert ops(graph) == ["conv", "conv"]
    assert sum(len(kernel.layers) for kernel in graph.kernels) == 4


def test_normalising_the_image_is_one_pointwise_kernel() -> None:
    nodes = [node("Sub", "x m", "a"), node("Div", "a s", "b"), node("Conv", "b w", "y")]
    graph = analyse(model(nodes, IMAGE, ["y"], {"m": (1, 8, 1, 1), "s": (1, 8, 1, 1), "w": W}))
    assert ops(graph) == ["pw", "conv"]
    assert graph.weight_elems == 16 + 8 * 72


def test_pointwise_operands_that_only_the_chain_reads_are_pulled_in() -> None:
    nodes = [node("Exp", "x", "a"), node("Sin", "x", "b"), node("Add", "a b", "y")]
    kernel = only(analyse(model(nodes, IMAGE, ["y"])))
    assert (kernel.op, kernel.in_elems, kernel.out_elems) == ("pw", ELEMS, ELEMS)


@pytest.mark.parametrize(("value", "expected"), [(0.0, ["conv"]), (1.0, ["mem:pad", "conv"])])
def test_zero_padding_is_the_convolutions_own(value: float, expected: list[str]) -> None:
    nodes = [node("Pad", "x pads v", "p"), node("Conv", "p w", "y")]
    constants = {"w": W, "pads": np.array([0, 0, 1, 1, 0, 0, 1, 1]), "v": scalar(value)}
    graph = analyse(model(nodes, IMAGE, ["y"], constants))
    assert ops(graph) == expected
    assert graph.kernels[0].in_elems == ELEMS
    assert graph.macs == ELEMS * 72


def test_padding_of_channels_is_a_kernel() -> None:
    nodes = [node("Pad", "x pads", "p"), node("Conv", "p w", "y")]
    constants = {"w": (4, 9, 1, 1), "pads": np.array([0, 0, 0, 0, 0, 1, 0, 0])}
    assert ops(analyse(model(nodes, IMAGE, ["y"], constants))) == ["mem:pad", "conv"]


def layer_norm(*, squares: str, reciprocal: bool, opset: int) -> onnx.ModelProto:
    axes = {"axes": [-1]} if opset < 18 else {}
    given = "" if opset < 18 else " last"
    nodes = [
        node("ReduceMean", "x" + given, "m", **axes),
        node("Sub", "x m", "d"),
        node("Pow", "d two", "q") if squares == "Pow" else node("Mul", "d d", "q"),
        node("ReduceMean", "q" + given, "v", **axes),
        node("Add", "v eps", "e"),
        node("Sqrt", "e", "r"),
        *([node("Reciprocal", "r", "i"), node("Mul", "d i", "n")] if reciprocal else [node("Div", "d r", "n")]),
        node("Mul", "n g", "h"),
        node("Add", "h b", "y"),
    ]
    constants = {"two": scalar(2), "eps": scalar(1e-5), "g": (16,), "b": (16,), "last": np.array([-1])}
    return model(nodes, {"x": (1, 5, 16)}, ["y"], constants, opset=opset)


@pytest.mark.parametrize("opset", [13, 18])
@pytest.mark.parametrize("squares", ["Pow", "Mul"])
@pytest.mark.parametrize("reciprocal", [False, True])
def test_written_out_layer_norm_is_one_kernel(opset: int, squares: str, reciprocal: bool) -> None:
    kernel = only(analyse(layer_norm(squares=squares, reciprocal=reciprocal, opset=opset)))
    assert (kernel.op, kernel.in_elems, kernel.out_elems, kernel.weight_elems) == ("mem:layer_norm", 80, 80, 32)
    assert len(kernel.layers) == 9 + reciprocal


def test_a_cube_is_no_variance() -> None:
    proto = layer_norm(squares="Pow", reciprocal=False, opset=13)
    proto.graph.initializer[0].CopyFrom(onnx.numpy_helper.from_array(scalar(3), "two"))
    assert "mem:layer_norm" not in ops(analyse(proto))


def test_a_difference_from_something_else_is_no_layer_norm() -> None:
    proto = layer_norm(squares="Pow", reciprocal=False, opset=13)
    proto.graph.input.append(helper.make_tensor_value_info("z", TensorProto.FLOAT, (1, 5, 16)))
    proto.graph.node[0].input[0] = "z"
    assert "mem:layer_norm" not in ops(analyse(proto))


@pytest.mark.parametrize("needed", ["d", "v", "n"])
def test_a_norm_whose_inside_is_needed_is_left_as_it_is(needed: str) -> None:
    proto = layer_norm(squares="Pow", reciprocal=False, opset=13)
    proto.graph.node.append(node("Exp", needed, "other"))
    proto.graph.output.append(helper.make_tensor_value_info("other", TensorProto.FLOAT, None))
    graph = analyse(proto)
    layers = [layer for kernel in graph.kernels for layer in kernel.layers]
    assert sorted(layers) == sorted(item.name for item in proto.graph.node)
    # The quotient may leave before scale and shift; nothing else may.
    assert ("mem:layer_norm" in ops(graph)) == (needed == "n")


def test_rms_norm_is_one_kernel() -> None:
    nodes = [
        node("Pow", "x two", "q"),
        node("ReduceMean", "q", "v", axes=[-1]),
        node("Add", "v eps", "e"),
        node("Sqrt", "e", "r"),
        node("Div", "x r", "n"),
        node("Mul", "n g", "y"),
    ]
    constants = {"two": scalar(2), "eps": scalar(1e-5), "g": (16,)}
    assert only(analyse(model(nodes, {"x": (1, 5, 16)}, ["y"], constants))).op == "mem:rms_norm"


# --- data movement


def test_channel_shuffle_is_one_copy() -> None:
    nodes = [
        node("Reshape", "x five", "a"),
        node("Transpose", "a", "b", perm=[0, 2, 1, 3, 4]),
        node("Reshape", "b four", "c"),
        node("Conv", "c w", "y"),
    ]
    constants = {"five": np.array([1, 2, 4, 6, 6]), "four": np.array([1, 8, 6, 6]), "w": W}
    graph = analyse(model(nodes, IMAGE, ["y"], constants))
    assert ops(graph) == ["mem:transpose", "conv"]
    assert (graph.kernels[0].in_elems, graph.kernels[0].out_elems) == (ELEMS, ELEMS)


def test_a_transposed_operand_of_a_product_is_no_copy() -> None:
    nodes = [node("Transpose", "x", "t", perm=[0, 1, 3, 2]), node("MatMul", "x t", "y")]
    kernel = only(analyse(model(nodes, {"x": (1, 4, 5, 7)}, ["y"])))
    assert (kernel.op, kernel.macs, kernel.weight_elems) == ("mm", 4 * 5 * 5 * 7, 140)


def test_a_transpose_before_a_convolution_is_a_copy_made_once() -> None:
    nodes = [node("Transpose", "x", "t", perm=[0, 3, 1, 2]), node("Conv", "t v", "y"), node("Conv", "t v", "z")]
    graph = analyse(model(nodes, {"x": (1, 6, 6, 3)}, ["y", "z"], {"v": (8, 3, 1, 1)}))
    assert ops(graph) == ["mem:transpose", "conv", "conv"]


def test_swapping_an_axis_of_one_moves_nothing() -> None:
    nodes = [node("Transpose", "x", "t", perm=[1, 0, 2]), node("Reshape", "t s", "y")]
    graph = analyse(model([*nodes, node("Relu", "y", "z")], {"x": (1, 5, 4)}, ["z"], {"s": np.array([20])}))
    assert ops(graph) == ["pw"]


@given(data=st.data())
@settings(max_examples=200, deadline=None)
def test_strides_of_a_reshape_are_numpys(data: st.DataObject) -> None:
    shape = data.draw(st.lists(st.integers(1, 4), min_size=1, max_size=4))
    perm = data.draw(st.permutations(range(len(shape))))
    array = np.zeros(shape, np.int8).transpose(perm)
    factors = [size for size in array.shape if size > 1]
    parts = data.draw(st.lists(st.integers(1, 4), min_size=0, max_size=4))
    target: list[int] = []
    rest = int(np.prod(factors, dtype=int))
    for part in parts:
        target.append(part if rest % part == 0 else 1)
        rest //= target[-1]
    target.append(rest)
    strides = reshaped(array.shape, tuple(array.strides), tuple(target))
    view = array.reshape(target)
    is_view = np.shares_memory(view, array)
    assert (strides is not None) == is_view
    if strides is not None:
        assert [s for s, n in zip(strides, target, strict=True) if n > 1] == [
            s for s, n in zip(view.strides, target, strict=True) if n > 1
        ]


def test_dense_strides_are_numpys() -> None:
    assert dense((2, 3, 5)) == np.zeros((2, 3, 5), np.int8).strides


def test_concatenation_is_free_where_its_parts_can_be_written_in_place() -> None:
    nodes = [CONV, node("Conv", "x w", "b", pads=[1] * 4), node("Concat", "a b", "c", axis=1), node("Conv", "c v", "y")]
    graph = analyse(model(nodes, IMAGE, ["y"], {"w": W, "v": (4, 16, 1, 1)}))
    assert ops(graph) == ["conv", "conv", "conv"]
    assert graph.kernels[-1].in_elems == 2 * ELEMS


@pytest.mark.parametrize(("pieces", "copied"), [("x a", ELEMS), ("a a", ELEMS), ("k a", 36)])
def test_concatenation_copies_inputs_constants_and_repetitions(pieces: str, copied: int) -> None:
    channels = {"x a": 16, "a a": 16, "k a": 9}[pieces]
    nodes = [CONV, node("Concat", pieces, "c", axis=1), node("Conv", "c v", "y")]
    graph = analyse(model(nodes, IMAGE, ["y"], {"w": W, "k": (1, 1, 6, 6), "v": (4, channels, 1, 1)}))
    assert ops(graph) == ["conv", "mem:concat", "conv"]
    assert graph.kernels[1].in_elems == graph.kernels[1].out_elems == copied


def test_a_tensor_can_lie_in_a_growing_concatenation_but_not_at_two_places() -> None:
    def dense_block(second: str) -> list[str]:
        nodes = [
            CONV,
            node("Conv", "a w", "b", pads=[1] * 4),
            node("Concat", "a b", "c", axis=1),
            node("Conv", "c v", "d"),
            node("Concat", second, "e", axis=1),
            node("Conv", "e u", "y"),
        ]
        return ops(analyse(model(nodes, IMAGE, ["y"], {"w": W, "v": (8, 16, 1, 1), "u": (8, 24, 1, 1)})))

    assert dense_block("a b d").count("mem:concat") == 0
    assert dense_block("d a b").count("mem:concat") == 1


def test_channel_slices_are_views_and_strided_ones_are_copies() -> None:
    nodes = [node("Split", "x", "a b", axis=1), node("Conv", "a v", "c"), node("Conv", "b v", "y")]
    views = analyse(model(nodes, IMAGE, ["c", "y"], {"v": (4, 4, 1, 1)}, opset=11))
    assert ops(views) == ["conv", "conv"]
    assert views.kernels[0].in_elems == ELEMS // 2
    focus = [node("Slice", "x from to axis step", "a"), node("Conv", "a w", "y")]
    constants = {key: np.array([value]) for key, value in (("from", 0), ("to", 9), ("axis", 3), ("step", 2))}
    assert ops(analyse(model(focus, IMAGE, ["y"], {**constants, "w": W}))) == ["mem:slice", "conv"]


def test_embedding_reads_the_rows_it_looks_up() -> None:
    proto = model([node("Gather", "table x", "y")], {"x": (1, 5)}, ["y"], {"table": (1000, 16)}, kind=TensorProto.INT64)
    kernel = only(analyse(proto))
    assert (kernel.op, kernel.in_elems, kernel.out_elems) == ("mem:gather", 5 + 80, 80)
    assert analyse(proto).weight_elems == 16_000


def test_casts_between_floating_point_types_cost_nothing_and_others_are_arithmetic() -> None:
    half = [node("Cast", "x", "a", to=TensorProto.FLOAT16), node("Cast", "a", "b", to=TensorProto.FLOAT)]
    after = node("MaxPool", "b", "y", kernel_shape=[1, 1])
    assert ops(analyse(model([*half, after], IMAGE, ["y"]))) == ["mem:max_pool"]
    image = [node("Cast", "x", "b", to=TensorProto.FLOAT)]
    assert ops(analyse(model([*image, after], IMAGE, ["y"], kind=TensorProto.UINT8))) == ["pw", "mem:max_pool"]


def test_random_numbers_are_no_constants() -> None:
    nodes = [node("RandomNormalLike", "k", "r"), node("Add", "x r", "y")]
    assert ops(analyse(model(nodes, {"x": (4, 5)}, ["y"], {"k": (4, 5)}))) == ["mem:random_normal_like", "pw"]


def test_constant_subgraphs_cost_nothing() -> None:
    nodes = [node("Transpose", "k", "t"), node("Mul", "t t", "w"), node("MatMul", "x w", "y")]
    graph = analyse(model(nodes, {"x": (1, 7)}, ["y"], {"k": (3, 7)}))
    assert only(graph).macs == 21
    assert graph.weight_elems == 21


# --- arithmetic


@pytest.mark.parametrize(
    ("build", "macs", "op"),
    [
        ((node("Conv", "x w", "y", group=2), (1, 8, 6, 6), (4, 4, 3, 3)), 4 * 16 * 36, "conv"),
        ((node("Conv", "x w", "y", group=8), (1, 8, 6, 6), (16, 1, 3, 3)), 16 * 16 * 9, "dw"),
        ((node("Conv", "x w", "y"), (1, 8, 6), (4, 8, 3)), 4 * 4 * 24, "conv"),
        ((node("Conv", "x w", "y"), (1, 2, 4, 4, 4), (4, 2, 2, 2, 2)), 4 * 27 * 16, "conv"),
        ((node("ConvTranspose", "x w", "y", strides=[2, 2]), (1, 8, 6, 6), (8, 4, 2, 2)), ELEMS * 16, "conv"),
        ((node("Gemm", "x w", "y", transA=1, transB=1), (5, 3), (7, 5)), 3 * 7 * 5, "mm"),
        ((node("MatMul", "x w", "y"), (2, 3, 4, 5), (5, 6)), 24 * 6 * 5, "mm"),
        ((node("MatMul", "w x", "y"), (5, 6), (4, 5)), 4 * 6 * 5, "mm"),
        ((node("Einsum", "x w", "y", equation="bhid,bhjd->bhij"), (1, 2, 3, 4), (1, 2, 5, 4)), 2 * 3 * 5 * 4, "mm"),
        ((node("Einsum", "x w", "y", equation="...ij,jk"), (2, 3, 4), (4, 5)), 2 * 3 * 4 * 5, "mm"),
        ((node("Einsum", "x w", "y", equation="ij,ij->ij"), (3, 4), (3, 4)), 0, "pw"),
    ],
)
def test_multiply_accumulates(build: tuple[onnx.NodeProto, tuple[int, ...], Any], macs: int, op: str) -> None:
    operator, shape, weight = build
    kernel = only(analyse(model([operator], {"x": shape}, ["y"], {"w": weight})))
    assert (kernel.op, kernel.macs) == (op, macs)
    assert kernel.in_elems == int(np.prod(shape))
    assert kernel.weight_elems == int(np.prod(weight))


def test_attention_operator_counts_scores_and_sum() -> None:
    inputs = {"q": (1, 4, 6, 8), "k": (1, 2, 10, 8), "v": (1, 2, 10, 16)}
    graph = analyse(model([node("Attention", "q k v", "y")], inputs, ["y"], opset=23))
    assert ops(graph) == ["mm", "mem:softmax", "mm"]
    assert graph.macs == 4 * 6 * 10 * 8 + 4 * 6 * 10 * 16


# --- precision


class Samples(ort_quantization.CalibrationDataReader):
    def __init__(self) -> None:
        rng = np.random.default_rng(0)
        self.rows = iter([{"x": rng.standard_normal((1, 8, 6, 6)).astype(np.float32)} for _ in range(2)])

    def get_next(self) -> dict[str, Any] | None:
        return next(self.rows, None)


def quantized(tmp_path: Path, nodes: list[onnx.NodeProto], outputs: list[str], **options: Any) -> KernelGraph:
    rng = np.random.default_rng(1)
    weights = {"v": rng.standard_normal((8, 4)).astype(np.float32)}
    weights["m"] = rng.standard_normal((16, 3)).astype(np.float32)
    weights |= {name: rng.standard_normal(W).astype(np.float32) for name in ("w", "u")}
    proto = model(nodes, IMAGE, outputs, weights)
    proto.graph.output[0].CopyFrom(helper.make_tensor_value_info(outputs[0], TensorProto.FLOAT, None))
    plain, made = tmp_path / "plain.onnx", tmp_path / "int8.onnx"
    onnx.save(proto, plain)
    ort_quantization.quantize_static(plain, made, Samples(), weight_type=ort_quantization.QuantType.QInt8, **options)
    graph = analyse(made)
    assert graph.macs == analyse(plain).macs
    return graph


NET = [
    CONV,
    node("Relu", "a", "b"),
    node("MaxPool", "b", "c", kernel_shape=[2, 2], strides=[2, 2]),
    node("Conv", "c u", "d", kernel_shape=[3, 3], pads=[1, 1, 1, 1]),
    node("GlobalAveragePool", "d", "e"),
    node("Flatten", "e", "f"),
    node("Gemm", "f v", "y"),
]


@pytest.mark.parametrize("per_channel", [False, True])
def test_quantised_networks_run_in_int8(tmp_path: Path, per_channel: bool) -> None:
    graph = quantized(tmp_path, NET, ["y"], per_channel=per_channel)
    # One kernel quantises the image and one writes the floating-point answer; all Q/DQ between them are merged.
    assert ops(graph) == ["mem:reformat", "conv", "mem:max_pool", "conv", "mem:mean", "mm", "mem:reformat"]
    assert [kernel.precision for kernel in graph.kernels if kernel.computes] == ["int8"] * 3
    assert graph.weight_bytes < 2 * graph.weight_elems


def test_quantisation_moves_through_views_and_concatenation(tmp_path: Path) -> None:
    nodes = [
        CONV,
        node("Conv", "x u", "b", pads=[1, 1, 1, 1]),
        node("Concat", "a b", "c", axis=1),
        node("Transpose", "c", "t", perm=[0, 1, 3, 2]),
        node("GlobalAveragePool", "t", "p"),
        node("Flatten", "p", "f"),
        node("Gemm", "f m", "y"),
    ]
    graph = quantized(tmp_path, nodes, ["y"])
    expected = ["mem:reformat", "conv", "conv", "mem:transpose", "mem:mean", "mm", "mem:reformat"]
    assert ops(graph) == expected


def test_layers_left_out_of_quantisation_say_nothing(tmp_path: Path) -> None:
    graph = quantized(tmp_path, NET, ["y"], nodes_to_exclude=["d"])
    precision = {kernel.name: kernel.precision for kernel in graph.kernels if kernel.computes}
    assert precision == {"a": "int8", "d": None, "y": "int8"}


def test_quantised_weights_alone_are_no_int8_kernel() -> None:
    nodes = [node("DequantizeLinear", "q s", "w"), node("MatMul", "x w", "y")]
    graph = analyse(model(nodes, {"x": (1, 7)}, ["y"], {"q": np.zeros((7, 3), np.int8), "s": scalar(0.1)}))
    assert only(graph).precision is None
    assert graph.weight_bytes == 21 + 4


def test_integer_convolutions_are_int8() -> None:
    nodes = [node("ConvInteger", "x w", "y")]
    proto = model(nodes, IMAGE, ["y"], {"w": np.zeros(W, np.int8)}, kind=TensorProto.INT8)
    assert only(analyse(proto)).precision == "int8"


def test_half_precision_weights_do_not_choose_the_precision() -> None:
    proto = model([node("MatMul", "x w", "y")], {"x": (1, 7)}, ["y"], {"w": np.zeros((7, 3), np.float16)}, kind=10)
    graph = analyse(proto)
    assert only(graph).precision is None
    assert (graph.weight_elems, graph.weight_bytes) == (21, 42)


# --- DLA


@pytest.mark.parametrize(
    ("operator", "shape", "weight", "why"),
    [
        (node("Conv", "x w", "y"), (1, 8, 40, 40), (4, 8, 32, 32), ""),
        (node("Conv", "x w", "y"), (1, 8, 40, 40), (4, 8, 33, 33), "window 33x33"),
        (node("Conv", "x w", "y", strides=[9, 9]), (1, 8, 40, 40), (4, 8, 3, 3), "stride"),
        (node("Conv", "x w", "y", pads=[32] * 4), (1, 8, 40, 40), (4, 8, 3, 3), "padding"),
        (node("Conv", "x w", "y"), (1, 8, 40), (4, 8, 3), "1 axes"),
        (node("Conv", "x w", "y"), (1, 8, 1, 8193), (4, 8, 1, 1), "over 8192"),
        (node("Conv", "x w", "y", group=8), (1, 8, 9, 9), (8, 1, 3, 3), ""),
        (node("ConvTranspose", "x w", "y", strides=[2, 2]), (1, 8, 9, 9), (8, 4, 2, 2), ""),
        (node("ConvTranspose", "x w", "y", pads=[1] * 4), (1, 8, 9, 9), (8, 4, 3, 3), "padding"),
        (node("MaxPool", "x", "y", kernel_shape=[8, 8]), (1, 8, 9, 9), None, ""),
        (node("MaxPool", "x", "y", kernel_shape=[9, 9]), (1, 8, 9, 9), None, "window 9x9"),
        (node("GlobalAveragePool", "x", "y"), (1, 8, 7, 7), None, ""),
        (node("Softmax", "x", "y"), (1, 8, 7, 7), None, "Orin"),
        (node("Erf", "x", "y"), (1, 8, 7, 7), None, "Erf"),
        (node("Relu", "x", "y"), (1, 8, 7, 7), None, ""),
        (node("Relu", "x", "y"), (1, 8), None, "spatial"),
        (node("Gemm", "x w", "y"), (1, 8), (8, 4), ""),
        (node("MatMul", "x x", "y"), (1, 2, 4, 4), None, "two activations"),
        (node("InstanceNormalization", "x w w", "y"), (1, 4, 5, 5), (4,), "not supported"),
    ],
)
def test_dla_limits(operator: onnx.NodeProto, shape: tuple[int, ...], weight: Any, why: str) -> None:
    kernel = only(analyse(model([operator], {"x": shape}, ["y"], {"w": weight} if weight else {})))
    assert why in kernel.dla_reason
    assert bool(kernel.dla_reason) == bool(why)


@pytest.mark.parametrize(
    ("mode", "scale", "fits"),
    [("nearest", 2.0, True), ("nearest", 1.5, False), ("linear", 4.0, True), ("linear", 5.0, False)],
)
def test_dla_resizes_by_whole_factors(mode: str, scale: float, fits: bool) -> None:
    scales = np.array([1, 1, scale, scale], np.float32)
    kernel = only(analyse(model([node("Resize", "x - s", "y", mode=mode)], IMAGE, ["y"], {"s": scales})))
    assert kernel.op == "mem:resize"
    assert (kernel.dla_reason == "") == fits


def test_dla_minds_a_fused_activation() -> None:
    swish = analyse(model([CONV, node("Mish", "a", "y")], IMAGE, ["y"], CONSTANTS, opset=18))
    assert "Mish" in only(swish).dla_reason
    relu = analyse(model([CONV, node("Relu", "a", "y")], IMAGE, ["y"], CONSTANTS))
    assert only(relu).dla_reason == ""


# --- memory


def test_peak_memory_of_a_chain_is_its_largest_pair() -> None:
    nodes = [node("Conv", "x v", "a"), node("Conv", "a u", "b"), node("Conv", "b t", "y")]
    graph = analyse(model(nodes, IMAGE, ["y"], {"v": (2, 8, 1, 1), "u": (20, 2, 1, 1), "t": (10, 20, 1, 1)}))
    assert graph.peak_activation_elems == (20 + 10) * 36


def test_a_shortcut_keeps_its_tensor_alive() -> None:
    nodes = [CONV, node("Conv", "a v", "b"), node("Conv", "b u", "c"), node("Concat", "a c", "d", axis=1)]
    nodes.append(node("Conv", "d t", "y"))
    weights = {"w": W, "v": (30, 8, 1, 1), "u": (4, 30, 1, 1), "t": (1, 12, 1, 1)}
    graph = analyse(model(nodes, IMAGE, ["y"], weights))
    assert graph.peak_activation_elems == (8 + 30 + 4) * 36


def test_an_output_stays_to_the_end() -> None:
    nodes = [node("Conv", "x v", "y"), node("Conv", "x v", "a"), node("Conv", "a u", "z")]
    graph = analyse(model(nodes, IMAGE, ["y", "z"], {"v": (20, 8, 1, 1), "u": (9, 20, 1, 1)}))
    assert graph.peak_activation_elems == (20 + 20 + 9) * 36


def test_views_take_no_memory() -> None:
    nodes = [CONV, node("Reshape", "a flat", "b"), node("MatMul", "b m", "y")]
    graph = analyse(model(nodes, IMAGE, ["y"], {"w": W, "flat": np.array([1, -1]), "m": (ELEMS, 2)}))
    assert graph.peak_activation_elems == 2 * ELEMS


def test_every_kernel_comes_after_those_it_reads_from() -> None:
    rng = np.random.default_rng(5)
    for _ in range(30):
        nodes: list[onnx.NodeProto] = []
        names = ["x"]
        for index in range(12):
            source = str(rng.choice(names))
            kind = int(rng.integers(4))
            if kind == 0:
                nodes.append(node("Conv", f"{source} w", f"t{index}", pads=[1, 1, 1, 1]))
            elif kind == 1:
                nodes.append(node("Relu", source, f"t{index}"))
            elif kind == 2:
                nodes.append(node("Add", f"{source} {rng.choice(names)}", f"t{index}"))
            else:
                nodes.append(node("MaxPool", source, f"t{index}", kernel_shape=[3, 3], pads=[1, 1, 1, 1]))
            names.append(f"t{index}")
        graph = analyse(model(nodes, IMAGE, names[-2:], {"w": W}))
        readers = {item.output[0]: list(item.input) for item in nodes}
        step = {layer: index for index, kernel in enumerate(graph.kernels) for layer in kernel.layers}
        assert len(step) == sum(len(kernel.layers) for kernel in graph.kernels)
        for layer, index in step.items():
            assert all(step[name] <= index for name in readers[layer] if name in step)
        assert graph.macs == ELEMS * 72 * sum(item.op_type == "Conv" and item.name in step for item in nodes)

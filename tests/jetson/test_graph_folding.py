"""Constant folding against onnx's reference implementation of every operator."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from onnx import TensorProto, helper
from onnx.reference import ReferenceEvaluator
from tests.jetson.graph_builders import node

from robotbrain.jetson.graph import folding
from robotbrain.jetson.graph.ir import Node
from robotbrain.jetson.graph.protos import attributes

SIGNED = np.array([[-7, -2, -1, 1, 2, 7], [3, -3, 5, -5, 8, -8]])
DIVISORS = np.array([[2, -2, 3, -3, 2, -2], [-2, 2, -2, 2, 3, 3]])
FLOATS = SIGNED.astype(np.float32) / 3
INDEX = np.array([2, 0, -1])
LOGICAL = SIGNED > 0

Case = tuple[str, list[Any], dict[str, Any]]
CASES: list[Case] = [
    *((op, [SIGNED], {}) for op in ("Abs", "Neg", "Sign", "Identity", "Transpose", "NonZero")),
    *((op, [FLOATS], {}) for op in ("Floor", "Ceil", "Round", "Exp", "Abs", "Reciprocal")),
    *((op, [np.abs(FLOATS)], {}) for op in ("Sqrt", "Log")),
    *((op, [SIGNED, DIVISORS], {}) for op in ("Add", "Sub", "Mul", "Div", "Mod", "Max", "Min")),
    *((op, [FLOATS, FLOATS + 1], {}) for op in ("Add", "Sub", "Mul", "Div", "Sum")),
    *((op, [SIGNED, DIVISORS], {}) for op in ("Equal", "Greater", "GreaterOrEqual", "Less", "LessOrEqual")),
    *((op, [LOGICAL, DIVISORS > 0], {}) for op in ("And", "Or", "Xor")),
    ("Not", [LOGICAL], {}),
    ("Mod", [SIGNED, DIVISORS], {"fmod": 1}),
    ("Pow", [FLOATS, np.array(2, np.float32)], {}),
    ("Where", [LOGICAL, SIGNED, DIVISORS], {}),
    ("Clip", [FLOATS, np.array(-1, np.float32), np.array(1, np.float32)], {}),
    ("Clip", [FLOATS, None, np.array(1, np.float32)], {}),
    *(("Cast", [FLOATS], {"to": kind}) for kind in (TensorProto.INT64, TensorProto.FLOAT16, TensorProto.BOOL)),
    ("Concat", [SIGNED, DIVISORS], {"axis": 1}),
    ("Concat", [SIGNED, DIVISORS], {"axis": -2}),
    ("Gather", [SIGNED, INDEX], {"axis": 1}),
    ("Gather", [SIGNED, np.array(1)], {}),
    ("Unsqueeze", [SIGNED, np.array([0, -1])], {}),
    ("Squeeze", [SIGNED[None, :, None], np.array([0])], {}),
    ("Squeeze", [SIGNED[None, :, None]], {}),
    ("Reshape", [SIGNED, np.array([0, -1, 2])], {}),
    ("Reshape", [SIGNED, np.array([3, 4])], {}),
    ("Flatten", [SIGNED[None]], {"axis": 2}),
    ("Transpose", [SIGNED[None]], {"perm": [2, 0, 1]}),
    ("Slice", [SIGNED, np.array([1]), np.array([100]), np.array([1]), np.array([2])], {}),
    ("Slice", [SIGNED, np.array([-1]), np.array([-100]), np.array([-1]), np.array([-1])], {}),
    ("Slice", [SIGNED, np.array([0, -3]), np.array([1, 2**62])], {}),
    ("Split", [SIGNED, np.array([1, 3, 2])], {"axis": 1, "outputs": 3}),
    ("Split", [SIGNED], {"axis": -1, "outputs": 2}),
    ("ConstantOfShape", [np.array([2, 3])], {}),
    (
        "ConstantOfShape",
        [np.array([2, 3])],
        {"value": helper.make_tensor("value", TensorProto.INT64, [1], [9])},
    ),
    ("Range", [np.array(10), np.array(-3), np.array(-4)], {}),
    ("Range", [np.array(0.0, np.float32), np.array(1.0, np.float32), np.array(0.3, np.float32)], {}),
    ("Expand", [SIGNED[:, :1], np.array([3, 1, 4])], {}),
    ("Tile", [SIGNED, np.array([2, 1])], {}),
    ("ReduceSum", [SIGNED, np.array([1])], {"keepdims": 0}),
    ("ReduceSum", [SIGNED], {}),
    ("ReduceSum", [SIGNED], {"noop_with_empty_axes": 1}),
    ("ReduceProd", [SIGNED], {"axes": [0]}),
    ("ReduceMax", [SIGNED], {"axes": [-1], "keepdims": 0}),
    ("ReduceMin", [SIGNED], {}),
    ("ScatterND", [SIGNED, np.array([[1, 2], [0, 0]]), np.array([50, 60])], {}),
]


def folded(case: Case) -> tuple[list[Any] | None, list[Any]]:
    """Return what we compute and what onnx's reference implementation computes."""
    op, values, attrs = case
    attrs = dict(attrs)
    outputs = [f"y{index}" for index in range(attrs.pop("outputs", 1))]
    names = ["-" if value is None else f"x{index}" for index, value in enumerate(values)]
    proto = node(op, " ".join(names), " ".join(outputs), **attrs)
    graph = helper.make_graph(
        [proto],
        "g",
        [
            helper.make_tensor_value_info(name, helper.np_dtype_to_tensor_dtype(value.dtype), value.shape)
            for name, value in zip(names, values, strict=True)
            if value is not None
        ],
        [helper.make_empty_tensor_value_info(name) for name in outputs],
    )
    reference = ReferenceEvaluator(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8))
    feeds = {name: value for name, value in zip(names, values, strict=True) if value is not None}
    expected = [np.asarray(item) for item in reference.run(None, feeds)]
    ours = folding.evaluate(
        Node(op, op, list(proto.input), outputs, attributes(proto), version=17),
        values,
        [item.shape for item in expected],
    )
    return ours, expected


@pytest.mark.parametrize("case", CASES, ids=lambda case: str(case[0]))
def test_folding_is_what_the_reference_computes(case: Case) -> None:
    ours, expected = folded(case)
    assert ours is not None
    for mine, reference in zip(ours, expected, strict=True):
        np.testing.assert_array_equal(mine, reference)
        assert mine.dtype == reference.dtype


def test_every_rule_is_tested() -> None:
    assert {case[0] for case in CASES} == set(folding._RULES)


@pytest.mark.parametrize(
    ("op", "values", "shape"),
    [
        ("Div", [np.array([4]), np.array([0])], (1,)),
        ("Mod", [np.array([4]), np.array([0])], (1,)),
        ("Gather", [np.array([4]), np.array([3])], ()),
        ("Reshape", [SIGNED, np.array([5, 5])], (5, 5)),
        ("Add", [SIGNED, None], (2, 6)),
        ("Range", [np.array(0), np.array(3), np.array(0)], (0,)),
        ("ConstantOfShape", [np.array([2**40])], (2**40,)),
        ("Expand", [np.array([1]), np.array([2**40])], (2**40,)),
        ("Softmax", [FLOATS], (2, 6)),
    ],
)
def test_what_cannot_be_computed_stays_unknown(op: str, values: list[Any], shape: tuple[int, ...]) -> None:
    assert folding.evaluate(Node(op, op, [], ["y"], {}, version=17), values, [shape]) is None

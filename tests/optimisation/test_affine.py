"""Affine quantisation: bounds, invariants, and agreement with torch and ONNX Runtime."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from robotbrain.errors import InputError
from robotbrain.optimisation.affine import (
    QParams,
    choose_qparams,
    dequantize,
    fake_quantize,
    integer_range,
    per_channel_range,
    per_tensor_range,
    quantize,
)

QUICK = settings(max_examples=60, deadline=None)
FLOATS = st.floats(-(2.0**100), 2.0**100, width=32)
OPTIONS = st.fixed_dictionaries(
    {"bits": st.integers(2, 16), "signed": st.booleans(), "symmetric": st.booleans(), "narrow": st.booleans()}
)


@st.composite
def problems(draw: st.DrawFn) -> tuple[np.ndarray, QParams, dict]:
    options = draw(OPTIONS)
    x = draw(hnp.arrays(np.float32, st.integers(1, 30), elements=FLOATS))
    return x, choose_qparams(*per_tensor_range(x), **options), options


@QUICK
@given(problems())
def test_error_inside_the_range_is_at_most_half_a_step(problem: tuple[np.ndarray, QParams, dict]) -> None:
    x, q, _ = problem
    error = np.abs(fake_quantize(x, q).astype(np.float64) - x)
    assert np.all(error <= 0.5 * float(q.scale) * (1 + 1e-3) + 1e-6 * np.abs(x))


@QUICK
@given(problems())
def test_zero_is_exact_and_quantising_twice_changes_nothing(problem: tuple[np.ndarray, QParams, dict]) -> None:
    x, q, options = problem
    assert fake_quantize(np.zeros(3, np.float32), q).tolist() == [0.0, 0.0, 0.0]
    assert int(q.zero_point) == quantize(0.0, q)
    once = quantize(x, q)
    assert np.array_equal(quantize(dequantize(once, q), q), once)
    low, high = integer_range(options["bits"], options["signed"], options["narrow"])
    assert once.min() >= low and once.max() <= high


@QUICK
@given(problems())
def test_order_is_kept(problem: tuple[np.ndarray, QParams, dict]) -> None:
    x, q, _ = problem
    assert np.all(np.diff(quantize(np.sort(x), q).astype(np.int64)) >= 0)


@QUICK
@given(hnp.arrays(np.float32, 20, elements=st.floats(-(2.0**20), 2.0**20, width=32)))
def test_narrow_symmetric_integers_mirror(x: np.ndarray) -> None:
    q = choose_qparams(*per_tensor_range(x), symmetric=True, narrow=True)
    assert np.array_equal(quantize(-x, q), -quantize(x, q))
    assert (integer_range(narrow=True), integer_range(4, False, True)) == ((-127, 127), (1, 15))
    assert quantize(-1e9, choose_qparams(-1.0, 1.0, symmetric=True, narrow=True)) == -127


@pytest.mark.parametrize("signed", [True, False])
def test_numbers_from_the_text_book(signed: bool) -> None:
    q = choose_qparams(-1.0, 1.55, signed=signed)
    assert float(q.scale) == pytest.approx(0.01)
    assert int(q.zero_point) == 100 - 128 * signed
    assert quantize([-1.0, 0.0, 1.55, 9.0], q).tolist() == [v - 128 * signed for v in (0, 100, 255, 255)]
    s = choose_qparams(-1.0, 1.27, symmetric=True)
    assert (float(s.scale), int(s.zero_point), s.dtype) == (pytest.approx(0.01), 0, np.int8)


def test_ties_go_to_even() -> None:
    q = QParams(np.float32(1.0), np.int32(0), -128, 127)
    assert quantize([0.5, 1.5, 2.5, -0.5, -1.5], q).tolist() == [0, 2, 2, 0, -2]


def test_range_that_does_not_contain_zero_is_extended() -> None:
    q = choose_qparams(3.0, 4.0, signed=False)
    assert int(q.zero_point) == 0 and float(q.high) == pytest.approx(4.0)
    q = choose_qparams(-4.0, -3.0, signed=False)
    assert int(q.zero_point) == 255 and float(q.low) == pytest.approx(-4.0)


@pytest.mark.parametrize("value", [0.0, 1e-45, -1e-40, 3e38])
@pytest.mark.parametrize("symmetric", [True, False])
def test_degenerate_ranges_give_usable_numbers(value: float, symmetric: bool) -> None:
    q = choose_qparams(value, value, symmetric=symmetric)
    assert np.isfinite(q.scale) and q.scale > 0
    assert abs(float(fake_quantize(np.float32(value), q)) - value) <= 0.5 * float(q.scale)
    assert np.isfinite(fake_quantize(np.float32([-3e38, 3e38]), choose_qparams(0.0, 1e-45))).all()


def test_per_channel_equals_each_channel_on_its_own() -> None:
    x = np.random.default_rng(0).normal(size=(4, 5, 3)).astype(np.float32) * np.float32([[[1]], [[10]], [[0.1]], [[0]]])
    for axis in (0, 1, 2, -2):
        q = choose_qparams(*per_channel_range(x, axis), symmetric=True, axis=axis)
        rows = np.moveaxis(fake_quantize(x, q), axis, 0)
        for row, values in zip(rows, np.moveaxis(x, axis, 0), strict=True):
            own = choose_qparams(*per_tensor_range(values), symmetric=True)
            np.testing.assert_array_equal(row, fake_quantize(values, own))
    coarse = fake_quantize(x, choose_qparams(*per_tensor_range(x), symmetric=True))
    fine = fake_quantize(x, choose_qparams(*per_channel_range(x, 0), symmetric=True, axis=0))
    assert np.abs(fine - x).mean() < 0.5 * np.abs(coarse - x).mean()


@QUICK
@given(problems(), st.integers(0, 3))
def test_agrees_with_torch(problem: tuple[np.ndarray, QParams, dict], channels: int) -> None:
    torch = pytest.importorskip("torch")
    x, q, _ = problem
    # torch multiplies by 1 / scale: where that overflows float32, or the product does, there is nothing to compare.
    assume(float(q.scale) > 1e-30)
    if channels:
        wide = QParams(np.full(channels, q.scale), np.full(channels, q.zero_point), q.qmin, q.qmax, 1)
        tiled = np.repeat(x[:, None], channels, axis=1)
        theirs = torch.fake_quantize_per_channel_affine(
            torch.from_numpy(tiled), torch.from_numpy(wide.scale), torch.from_numpy(wide.zero_point), 1, q.qmin, q.qmax
        ).numpy()
        ours = fake_quantize(tiled, wide)
    else:
        theirs = torch.fake_quantize_per_tensor_affine(
            torch.from_numpy(x), float(q.scale), int(q.zero_point), q.qmin, q.qmax
        ).numpy()
        ours = fake_quantize(x, q)
    # A value half way between two integers may go either way: a quotient against a product with the reciprocal.
    steps = np.abs(ours.astype(np.float64) - theirs) / float(q.scale)
    assert steps.max() <= 1.0 + 1e-5
    nearly_a_tie = np.abs(np.abs(x.astype(np.float64) / float(q.scale)) % 1 - 0.5) < 0.01
    same = steps.reshape(len(x), -1).max(axis=1) < 1e-5
    assert np.all(same | nearly_a_tie)


@pytest.mark.parametrize("signed", [True, False])
@pytest.mark.parametrize("axis", [None, 0, 1])
def test_agrees_with_onnx_runtime_bit_for_bit(signed: bool, axis: int | None) -> None:
    onnx, ort = pytest.importorskip("onnx"), pytest.importorskip("onnxruntime")
    x = np.random.default_rng(1).normal(size=(6, 50)).astype(np.float32)
    x[0, :8] = np.float32([0.5, 1.5, 2.5, -0.5, -1.5, 1e30, -1e30, 0.0])
    ranges = per_tensor_range(x[1:]) if axis is None else per_channel_range(x[1:] if axis else x, axis)
    q = choose_qparams(*ranges, signed=signed, axis=axis)
    make = onnx.helper.make_node
    kind = onnx.TensorProto.INT8 if signed else onnx.TensorProto.UINT8
    attributes = {} if axis is None else {"axis": axis}
    graph = onnx.helper.make_graph(
        [
            make("QuantizeLinear", ["x", "s", "z"], ["q"], **attributes),
            make("DequantizeLinear", ["q", "s", "z"], ["y"], **attributes),
        ],
        "pair",
        [onnx.helper.make_tensor_value_info("x", onnx.TensorProto.FLOAT, x.shape)],
        [onnx.helper.make_tensor_value_info("q", kind, None), onnx.helper.make_tensor_value_info("y", 1, None)],
        [onnx.numpy_helper.from_array(q.scale, "s"), onnx.numpy_helper.from_array(q.zero_point.astype(q.dtype), "z")],
    )
    model = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 17)], ir_version=8)
    session = ort.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    integers, floats = session.run(None, {"x": x})
    ours = quantize(x, q)
    assert ours.dtype == integers.dtype
    np.testing.assert_array_equal(ours, integers)
    np.testing.assert_array_equal(dequantize(ours, q), floats)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_nan_and_infinity_are_refused(bad: float) -> None:
    q = choose_qparams(-1.0, 1.0)
    for call in (
        lambda: quantize([0.0, bad], q),
        lambda: per_tensor_range([0.0, bad]),
        lambda: per_channel_range([[0.0, bad]], 0),
        lambda: choose_qparams(min(bad, 0.0), max(bad, 0.0)) if bad == bad else choose_qparams(bad, bad),
        lambda: QParams(np.float32(bad), np.int32(0), -128, 127),
    ):
        with pytest.raises(InputError):
            call()


def test_slips_are_told_apart() -> None:
    q = choose_qparams([-1.0, -2.0], [1.0, 2.0], axis=0)
    for what, call in {
        "range": lambda: choose_qparams(1.0, 0.0),
        "range: got 'shapes": lambda: choose_qparams([-1.0, -2.0], [1.0, 2.0]),
        "bits": lambda: choose_qparams(-1.0, 1.0, bits=1),
        "channels": lambda: quantize(np.zeros((3, 2)), q),
        "integers": lambda: dequantize([1.0], choose_qparams(0.0, 1.0)),
        "integers: got 'int64 from 300": lambda: dequantize([300], choose_qparams(0.0, 1.0)),
        "zero_point": lambda: QParams(np.float32(1), np.int32(300), 0, 255),
        "scale": lambda: QParams(np.float32(0), np.int32(0), 0, 255),
        "axis": lambda: QParams(np.ones(3, np.float32), np.int32(0), 0, 255),
        "x: got 'an empty": lambda: per_tensor_range([]),
        "x: got 'words": lambda: quantize("words", choose_qparams(0.0, 1.0)),
        "x: got \\[\\[1.0": lambda: per_tensor_range([[1.0], [1.0, 2.0]]),
        "axis: got 2": lambda: per_channel_range(np.zeros((2, 2)), 2),
    }.items():
        with pytest.raises(InputError, match="^" + what):
            call()

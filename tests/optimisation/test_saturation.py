"""Oracles: sums written out one pair at a time, ONNX Runtime without optimisations, and the bound that 7 bits prove."""

from __future__ import annotations

import numpy as np
import onnx
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from onnx import TensorProto, helper, numpy_helper

from robotbrain.errors import InputError
from robotbrain.optimisation import cpu
from robotbrain.optimisation.onnx_files import session
from robotbrain.optimisation.saturation import (
    can_saturate,
    exact_product,
    layer_saturation,
    maddubs,
    run_saturating,
    saturating_product,
)


def slow_product(a, w):
    """Python integers, one pair after the other."""
    rows, terms = a.shape
    result = np.zeros((rows, w.shape[1]), dtype=np.int64)
    for m in range(rows):
        for n in range(w.shape[1]):
            for k in range(0, terms, 2):
                pair = sum(int(a[m, i]) * int(w[i, n]) for i in range(k, min(k + 2, terms)))
                result[m, n] += max(-32768, min(32767, pair))
    return result


@given(st.integers(0, 2**32 - 1), st.integers(1, 9), st.sampled_from([-128, -127, -20]))
@settings(max_examples=30, deadline=None)
def test_the_fast_product_is_the_sum_of_saturated_pairs(seed, terms, lowest):
    rng = np.random.default_rng(seed)
    a = rng.integers(0, 256, (4, terms)).astype(np.uint8)
    w = rng.integers(lowest, 128, (terms, 5)).astype(np.int8)
    np.testing.assert_array_equal(saturating_product(a, w), slow_product(a, w))
    np.testing.assert_array_equal(exact_product(a, w), a.astype(np.int64) @ w.astype(np.int64))


def test_the_instruction_saturates_on_both_sides():
    a = np.array([255, 255, 255, 255, 1, 1], dtype=np.uint8)
    b = np.array([127, 127, -128, -128, 127, -128], dtype=np.int8)
    assert maddubs(a, b).tolist() == [32767, -32768, -1]
    assert maddubs(a, b).dtype == np.int16


def test_which_weights_are_risky_is_exact():
    """A pair is risky if and only if the worst bytes for it overflow; 64 and 64 is the largest pair that is not."""
    rng = np.random.default_rng(0)
    w = rng.integers(-128, 128, (2, 400)).astype(np.int8)
    w[:, :4] = [[64, 65, 127, -128], [64, 64, -127, -1]]
    high = np.where(w > 0, 255, 0).astype(np.uint8)
    low = np.where(w < 0, 255, 0).astype(np.uint8)
    worst = [(slow_product(a[:, i : i + 1].T, w[:, i : i + 1]) != a[:, i].astype(int) @ w[:, i].astype(int)).item()
             for a in (high, low) for i in range(400)]  # fmt: skip
    np.testing.assert_array_equal(can_saturate(w)[0], np.array(worst).reshape(2, 400).any(axis=0))
    assert can_saturate(w)[0, :4].tolist() == [False, True, False, True]


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=20, deadline=None)
def test_seven_bits_never_saturate(seed):
    rng = np.random.default_rng(seed)
    a = rng.choice(np.array([0, 255], np.uint8), (6, 30))
    w = rng.choice(np.array([-64, -63, 64], np.int8), (30, 6))
    assert not can_saturate(w).any()
    np.testing.assert_array_equal(saturating_product(a, w), exact_product(a, w))


def two_layers(path, *, signed, limit=127, groups=1, depthwise=False):
    """Q/DQ -> 3x3 conv, stride 2 -> ReLU -> Q/DQ -> 1x1 conv, with a bias; weights from a seed."""
    rng = np.random.default_rng(3)
    dtype, zero = (np.int8, 0) if signed else (np.uint8, 30)

    def weight(shape):
        return rng.normal(0, 60, shape).clip(-limit, limit).round().astype(np.int8)

    first = (8, 1, 3, 3) if depthwise else (6, 8 // groups, 3, 3)
    channels = first[0]
    constants = {
        "sx": np.float32(1 / (127 if signed else 225)),
        "z": dtype(zero),
        "w1": weight(first),
        "s1": rng.uniform(0.5, 1.5, channels).astype(np.float32) / 127,
        "z1": np.zeros(channels, np.int8),
        "b1": rng.normal(size=channels).astype(np.float32),
        "sy": np.float32(0.15),
        "w2": weight((5, channels, 1, 1)),
        "s2": np.float32(0.01),
        "z2": np.int8(0),
    }
    nodes = [
        helper.make_node("QuantizeLinear", ["x", "sx", "z"], ["xq"]),
        helper.make_node("DequantizeLinear", ["xq", "sx", "z"], ["xd"]),
        helper.make_node("DequantizeLinear", ["w1", "s1", "z1"], ["w1d"], axis=0),
        helper.make_node(
            "Conv",
            ["xd", "w1d", "b1"],
            ["c1"],
            name="first",
            strides=[2, 2],
            pads=[0, 1, 1, 0],
            group=8 if depthwise else groups,
        ),
        helper.make_node("Relu", ["c1"], ["r1"]),
        helper.make_node("QuantizeLinear", ["r1", "sy", "z"], ["rq"]),
        helper.make_node("DequantizeLinear", ["rq", "sy", "z"], ["rd"]),
        helper.make_node("DequantizeLinear", ["w2", "s2", "z2"], ["w2d"]),
        helper.make_node("Conv", ["rd", "w2d"], ["y"], name="second"),
    ]
    graph = helper.make_graph(
        nodes,
        "two",
        [helper.make_tensor_value_info("x", TensorProto.FLOAT, ["n", 8, 9, 9])],
        [helper.make_tensor_value_info("y", TensorProto.FLOAT, ["n", 5, 4, 4])],
        [numpy_helper.from_array(np.asarray(v), k) for k, v in constants.items()],
    )
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8), str(path))
    return path


def inputs(count=5):
    return np.random.default_rng(9).uniform(0.2, 1.0, (count, 8, 9, 9)).astype(np.float32)


@pytest.mark.parametrize("signed", [False, True])
@pytest.mark.parametrize("groups", [1, 2])
def test_without_saturation_the_emulation_is_onnx_runtime(tmp_path, signed, groups, monkeypatch):
    """Strides, uneven pads, groups, zero points, per-channel scales, bias: with exact sums all must agree."""
    path = two_layers(tmp_path / "m.onnx", signed=signed, groups=groups)
    want = session(onnx.load(str(path))).run(None, {"x": inputs()})[0]
    monkeypatch.setattr("robotbrain.optimisation.saturation.saturating_product", exact_product)
    got = run_saturating(path, inputs(), batch=2)
    np.testing.assert_allclose(got, want, atol=2e-4 * np.abs(want).max())


@pytest.mark.parametrize("signed", [False, True])
def test_saturation_is_seen_and_seven_bits_cure_it(tmp_path, signed):
    full = two_layers(tmp_path / "full.onnx", signed=signed)
    layers = {layer.name: layer for layer in layer_saturation(full, inputs())}
    assert set(layers) == {"first", "second"}
    assert layers["first"].risky_pairs > 0 and layers["first"].changed_outputs > 0
    assert layers["first"].worst > 0 and layers["first"].sqnr_db < 60
    exact = session(onnx.load(str(full))).run(None, {"x": inputs()})[0]
    assert np.abs(run_saturating(full, inputs()) - exact).max() > 0.01 * np.abs(exact).max()

    small = two_layers(tmp_path / "small.onnx", signed=signed, limit=63)
    assert all(layer.risky_pairs == 0 and layer.sqnr_db == float("inf") for layer in layer_saturation(small, inputs()))
    exact = session(onnx.load(str(small))).run(None, {"x": inputs()})[0]
    np.testing.assert_array_equal(run_saturating(small, inputs()), exact)


HASWELL = {
    False: (
        "-33 -37 -32 -38 -34 -30 6 3 5 9 10 -2 -6 -12 -8 -15 -16 -13 14 14 6 5 9 4",
        "-33 -37 -35 -39 -37 -30 6 6 6 11 10 4 -6 -15 -10 -16 -22 -20 14 14 6 5 9 4",
    ),
    True: (
        "-31 -36 -29 -34 -32 -29 -2 -3 0 1 3 -8 0 -5 -1 -8 -9 -6 14 14 6 5 9 4",
        "-33 -37 -35 -39 -37 -30 6 6 7 11 10 4 -6 -15 -10 -16 -23 -20 14 14 6 5 9 4",
    ),
}
"""Steps of 0.1 that ONNX Runtime 1.31.1 returned for the model below under ``qemu-x86_64 -cpu Haswell``, for unsigned
and for signed activations: with all graph optimisations, and with none."""


@pytest.mark.parametrize("signed", [False, True])
def test_it_is_what_the_genuine_runtime_returned_on_avx2(tmp_path, signed):
    """Which products are neighbours decides what saturates: the kernel runs through channels first, then the window."""
    rng = np.random.default_rng(5)
    constants = {
        "sx": np.float32(1 / (127 if signed else 255)),
        "zx": np.int8(0) if signed else np.uint8(10),
        "w": rng.integers(-128, 128, (4, 3, 3, 3)).astype(np.int8),
        "sw": np.float32(1 / 127),
        "zw": np.int8(0),
        "sy": np.float32(0.1),
        "zy": np.int8(0) if signed else np.uint8(128),
    }
    nodes = [
        helper.make_node("QuantizeLinear", ["x", "sx", "zx"], ["xq"]),
        helper.make_node("DequantizeLinear", ["xq", "sx", "zx"], ["xd"]),
        helper.make_node("DequantizeLinear", ["w", "sw", "zw"], ["wd"]),
        helper.make_node("Conv", ["xd", "wd"], ["c"]),
        helper.make_node("QuantizeLinear", ["c", "sy", "zy"], ["yq"]),
        helper.make_node("DequantizeLinear", ["yq", "sy", "zy"], ["y"]),
    ]
    graph = helper.make_graph(
        nodes,
        "one",
        [helper.make_tensor_value_info("x", TensorProto.FLOAT, [1, 3, 4, 5])],
        [helper.make_tensor_value_info("y", TensorProto.FLOAT, [1, 4, 2, 3])],
        [numpy_helper.from_array(np.asarray(v), k) for k, v in constants.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    onnx.save(model, str(tmp_path / "m.onnx"))
    x = np.random.default_rng(6).uniform(0.4, 1.0, (1, 3, 4, 5)).astype(np.float32)
    both = run_saturating(tmp_path / "m.onnx", x), session(model).run(None, {"x": x})[0]
    for got, recorded in zip(both, HASWELL[signed], strict=True):
        assert np.rint(got / 0.1).astype(int).ravel().tolist() == [int(step) for step in recorded.split()]


def test_depthwise_layers_are_left_out(tmp_path):
    path = two_layers(tmp_path / "m.onnx", signed=False, depthwise=True)
    assert [layer.name for layer in layer_saturation(path, inputs())] == ["second"]


def test_a_float_network_is_refused(tmp_path):
    node = helper.make_node("Relu", ["x"], ["y"])
    values = [helper.make_tensor_value_info(n, TensorProto.FLOAT, [1, 2]) for n in "xy"]
    model = helper.make_model(
        helper.make_graph([node], "g", values[:1], values[1:]),
        opset_imports=[helper.make_opsetid("", 17)],
        ir_version=8,
    )
    onnx.save(model, str(tmp_path / "m.onnx"))
    with pytest.raises(InputError, match="QDQ"):
        layer_saturation(tmp_path / "m.onnx", np.zeros((1, 2), np.float32))
    with pytest.raises(InputError, match="bytes"):
        maddubs(np.zeros(3, np.uint8), np.zeros(3, np.int8))


@pytest.mark.parametrize(
    ("flags", "vnni", "verdict"),
    [
        ("fpu avx2 avx512_vnni", True, False),
        ("fpu avx2 avx_vnni", True, False),
        ("fpu avx2", False, True),
        ("", None, None),
    ],
)
def test_what_the_system_says(monkeypatch, flags, vnni, verdict):
    monkeypatch.setattr(cpu.platform, "machine", lambda: "x86_64")
    monkeypatch.setattr(cpu, "_flags", lambda: (frozenset(flags.split()), "a test"))
    features = cpu.cpu_features()
    assert (features.vnni, features.saturates) == (vnni, verdict)
    assert ("unknown" in features.sentence()) == (verdict is None)


def test_arm_does_not_saturate(monkeypatch):
    monkeypatch.setattr(cpu.platform, "machine", lambda: "arm64")
    assert cpu.cpu_features().saturates is False


def test_the_experiment_agrees_with_what_the_system_says():
    said = cpu.cpu_features().saturates
    if said is None:
        pytest.skip("this system does not say whether the processor has VNNI")
    assert cpu.onnxruntime_saturates() == said

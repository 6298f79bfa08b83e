"""Calibration: histograms against numpy, observers against ONNX Runtime's, tables and their files."""

from __future__ import annotations

import contextlib
import io
import json
import math
import struct
from pathlib import Path

import numpy as np
import onnx
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from robotbrain.errors import InputError
from robotbrain.optimisation.affine import choose_qparams, fake_quantize
from robotbrain.optimisation.calibration import (
    METHODS,
    CalibrationTable,
    EntropyObserver,
    Histogram,
    MinMaxObserver,
    PercentileObserver,
    calibrate,
    parse_tensorrt_cache,
)
from robotbrain.optimisation.observers import divergence, make_observer
from tests.optimisation.onnx_nets import Net, images, save, unet

QUICK = settings(max_examples=40, deadline=None)
VALUES = hnp.arrays(np.float32, st.integers(1, 200), elements=st.floats(-(2.0**60), 2.0**60, width=32))


@QUICK
@given(VALUES, st.lists(st.integers(0, 200), max_size=5), st.randoms())
def test_histogram_does_not_depend_on_batches_or_order(x: np.ndarray, cuts: list[int], random: object) -> None:
    whole, parts = Histogram(256), Histogram(256)
    whole.add(x)
    pieces = np.split(np.random.default_rng(len(cuts)).permutation(x), sorted(min(cut, len(x)) for cut in cuts))
    for piece in pieces:
        parts.add(piece)
    assert whole.width == parts.width and (whole.zeros, whole.low, whole.high) == (parts.zeros, parts.low, parts.high)
    np.testing.assert_array_equal(whole.positive, parts.positive)
    np.testing.assert_array_equal(whole.negative, parts.negative)
    assert whole.total == len(x)
    if whole.width:
        edges = np.arange(257) * whole.width
        magnitudes = np.abs(x[x > 0]).astype(np.float64)
        np.testing.assert_array_equal(whole.positive, np.histogram(magnitudes, edges)[0])
        assert np.abs(x).max() >= 127 * whole.width  # at least half of the bins are in use


@QUICK
@given(VALUES)
def test_minmax_and_the_hundredth_percentile_are_the_extremes(x: np.ndarray) -> None:
    for observer in (MinMaxObserver(), PercentileObserver(100.0)):
        for part in np.array_split(x, 3):
            observer.update(part)
        assert observer.range() == (float(x.min()), float(x.max()))


@QUICK
@given(VALUES, st.floats(51, 99.9))
def test_percentile_keeps_its_share_and_mirrors(x: np.ndarray, percentile: float) -> None:
    one, other = PercentileObserver(percentile), PercentileObserver(percentile)
    one.update(x)
    other.update(-x)
    low, high = one.range()
    assert (low, high) == tuple(-v for v in other.range()[::-1])
    assert x.min() <= low <= high <= x.max()
    assert np.mean((x >= low) & (x <= high)) >= percentile / 100 - 1e-9
    # No looser than the true quantiles by more than a bin.
    cut = (100 - percentile) / 200
    inner = np.quantile(x.astype(np.float64), [cut, 1 - cut], method="inverted_cdf")
    assert low >= inner[0] - one.histogram.width * 1.001 or low == x.min()


def test_entropy_cuts_a_lone_outlier_and_leaves_a_uniform_range_alone() -> None:
    rng = np.random.default_rng(0)
    bulk = rng.normal(size=200_000).astype(np.float32)
    observer = EntropyObserver()
    observer.update(np.append(bulk, np.float32(40.0)))
    low, high = observer.range()
    assert 2.5 < high < 8 and low == max(-high, float(bulk.min()))
    clean = np.clip(bulk, -high, high)
    coarse = fake_quantize(clean, choose_qparams(-40, 40, symmetric=True))
    fine = fake_quantize(clean, choose_qparams(low, high, symmetric=True))
    assert np.abs(fine - clean).mean() < 0.3 * np.abs(coarse - clean).mean()
    flat = EntropyObserver()
    flat.update(rng.uniform(-1, 1, size=500_000).astype(np.float32))
    assert flat.range()[1] > 0.98


def test_entropy_does_not_see_exact_zeros() -> None:
    x = np.maximum(np.random.default_rng(2).normal(size=50_000), 0).astype(np.float32)
    seen, without = EntropyObserver(), EntropyObserver()
    seen.update(x)
    without.update(x[x > 0])
    assert seen.range()[1] == without.range()[1] and seen.range()[0] == 0.0


def test_divergence_against_the_definition() -> None:
    counts = np.random.default_rng(3).integers(0, 50, size=512).astype(np.float64)
    cut, levels = 300, 128
    p = counts[:cut].copy()
    p[-1] += counts[cut:].sum()
    q = np.zeros(cut)
    for level in range(levels):
        inside = range(level * cut // levels, (level + 1) * cut // levels)
        occupied = [k for k in inside if counts[k] > 0]
        for k in occupied:
            q[k] = sum(counts[j] for j in inside) / len(occupied)
    p, q = p / p.sum(), q / q.sum()
    expected = sum(a * math.log(a / b) for a, b in zip(p, q, strict=True) if a > 0)
    assert divergence(counts, cut, levels) == pytest.approx(expected)
    assert divergence(np.ones(128), 128, 128) == pytest.approx(0.0)


@pytest.mark.parametrize("rectified", [False, True])
@pytest.mark.parametrize("method", ["percentile", "entropy"])
def test_agrees_with_onnx_runtimes_collector(method: str, rectified: bool) -> None:
    from onnxruntime.quantization.calibrate import HistogramCollector

    x = np.random.default_rng(4).laplace(size=(4, 50_000)).astype(np.float32)
    x = np.maximum(x, 0) if rectified else x
    theirs = HistogramCollector(method, False, 2048, 128, 99.9, "same")
    ours = PercentileObserver(99.9) if method == "percentile" else EntropyObserver()
    with contextlib.redirect_stdout(io.StringIO()):
        for batch in x:
            theirs.collect({"x": [batch]})
            ours.update(batch)
        found = theirs.compute_collection_result()["x"]
    low, high = (float(end) for end in (found if isinstance(found, tuple) else found.range_value)[:2])
    peak = float(np.abs(x).max())
    if method == "percentile":
        width = 2 * peak / 2048
        assert ours.range() == pytest.approx((low, high), abs=2.5 * width)
        return
    # ONNX Runtime quantises both signs at once and smooths zeros: the same idea, not the same number.
    threshold, reference = ours.range()[1], max(-low, high)
    assert 0.5 < threshold / reference < 2.0 and threshold < 0.95 * peak


def test_table_covers_every_float_tensor_and_holds_true_extremes(tmp_path: Path) -> None:
    import onnxruntime

    model = unet()
    path, x = save(model, tmp_path / "net.onnx"), images(10)
    table = calibrate(path, x, batch_size=3)
    computed = {name for node in model.graph.node for name in node.output}
    assert set(table.ranges) == computed | {"image"} and table.samples == 10
    opened = onnx.ModelProto()
    opened.CopyFrom(model)
    names = sorted(computed - {"logits"})
    opened.graph.output.extend(onnx.ValueInfoProto(name=name) for name in names)
    session = onnxruntime.InferenceSession(opened.SerializeToString(), providers=["CPUExecutionProvider"])
    for name, value in zip(["logits", *names], session.run(["logits", *names], {"image": x}), strict=True):
        assert table.ranges[name] == pytest.approx((value.min(), value.max()), rel=1e-4, abs=1e-5)
    again = calibrate(path, x, batch_size=10)
    for name, ends in again.ranges.items():
        assert table.ranges[name] == pytest.approx(ends, rel=1e-4, abs=1e-5)


@pytest.mark.parametrize("method", METHODS)
def test_minmax_against_onnx_runtimes_calibrator_and_the_others_inside(tmp_path: Path, method: str) -> None:
    from onnxruntime.quantization import CalibrationMethod, create_calibrator

    path, x = save(unet(), tmp_path / "net.onnx"), images()
    table = calibrate(path, x, method, percentile=99.0)
    calibrator = create_calibrator(path, None, str(tmp_path / "augmented.onnx"), CalibrationMethod.MinMax)

    class Reader:
        def __init__(self) -> None:
            self.rest = [{"image": x}]

        def get_next(self) -> dict | None:
            return self.rest.pop() if self.rest else None

    calibrator.collect_data(Reader())
    theirs = calibrator.compute_data()
    compared = [name for name in table.ranges if name in theirs]
    assert len(compared) > 5
    for name in compared:
        low, high = (float(np.ravel(end)[0]) for end in theirs[name].range_value)
        if method == "minmax":
            assert table.ranges[name] == pytest.approx((low, high), rel=1e-4, abs=1e-5)
        else:
            assert low - 1e-4 <= table.ranges[name][0] <= table.ranges[name][1] <= high + 1e-4
    if method == "percentile":
        assert table.ranges["image"][1] < x.max()


def test_table_survives_json_and_refuses_what_is_none(tmp_path: Path) -> None:
    table = CalibrationTable("percentile", {"b": (-0.1, 1 / 3), "a": (0.0, 1e-30)}, 7, 99.9, "ab", "cd")
    path = table.save(tmp_path / "deep" / "table.json")
    assert CalibrationTable.load(path) == table
    first = path.read_bytes()
    assert table.save(path).read_bytes() == first and list(path.parent.iterdir()) == [path]
    content = json.loads(first)
    for spoil in ({"format": "x"}, {"ranges": {"a": [1]}}, {"ranges": {"a": [1, 0]}}, {"method": "guess"}):
        path.write_text(json.dumps(content | spoil))
        with pytest.raises(InputError):
            CalibrationTable.load(path)
    path.write_bytes(first[:40])
    with pytest.raises(InputError, match="calibration table"):
        CalibrationTable.load(path)
    with pytest.raises(InputError):
        CalibrationTable.load(tmp_path / "none.json")
    with pytest.raises(InputError, match="no tensor 'c'"):
        table.scale("c")


def test_tensorrt_cache_is_in_its_format(tmp_path: Path) -> None:
    # 1/127 is 3c010204: the input line of caches for images in [0, 1].
    table = CalibrationTable("entropy", {"images": (0.0, 1.0), "b: c": (-2.54, 1.0), "zero": (0.0, 0.0)}, 1)
    text = table.tensorrt_cache()
    assert text.splitlines()[0] == "TRT-8601-EntropyCalibration2"
    assert "images: 3c010204\n" in text
    assert table.tensorrt_cache("10.3.0").startswith("TRT-100300-")
    assert CalibrationTable("minmax", {}, 1).tensorrt_cache("8.5").strip() == "TRT-8500-MinMaxCalibration"
    read = parse_tensorrt_cache(table.save_tensorrt_cache(tmp_path / "net.cache").read_text())
    assert read == {name: table.scale(name) for name in table.ranges}
    assert read["b: c"] == pytest.approx(0.02)
    for wrong in ("11.0", "eight", ""):
        with pytest.raises(InputError, match="tensorrt"):
            table.tensorrt_cache(wrong)
    nan = struct.pack(">f", float("nan")).hex()
    for spoilt in (
        "",
        "images: 3c010204",
        text[:-3],
        text.replace("3c010204", nan),
        text.replace("3c010204", "bc010204"),
    ):
        with pytest.raises(InputError, match="calibration cache"):
            parse_tensorrt_cache(spoilt)


def test_groups_share_the_union_of_their_ranges() -> None:
    table = CalibrationTable("minmax", {"a": (-1.0, 2.0), "b": (-3.0, 1.0), "c": (0.0, 9.0)}, 1)
    merged = table.merged([["a", "b"]])
    assert dict(merged.ranges) == {"a": (-3.0, 2.0), "b": (-3.0, 2.0), "c": (0.0, 9.0)}
    assert table.ranges["a"] == (-1.0, 2.0)


def test_bad_inputs_are_told_apart(tmp_path: Path) -> None:
    path, x = save(unet(), tmp_path / "net.onnx"), images(4)
    spoilt = x.copy()
    spoilt[2, 0, 0, 0] = np.nan
    for expected, inputs in {
        "some tens": x[:0],
        "float32": x.astype(np.float64),
        r"\(N, 3, 16, 16\)": x[:, :, :8],
        "finite values": spoilt,
        "arrays for image": {"picture": x},
    }.items():
        with pytest.raises(InputError, match=expected):
            calibrate(path, inputs)
    with pytest.raises(InputError, match=r"^method"):
        calibrate(path, x, "guess")
    with pytest.raises(InputError, match="path of an ONNX file"):
        calibrate(tmp_path / "none.onnx", x)
    (tmp_path / "cut.onnx").write_bytes(path.read_bytes()[:100])
    with pytest.raises(InputError, match="with nodes"):
        calibrate(tmp_path / "cut.onnx", x)
    fixed = save(unet(batch=4), tmp_path / "fixed.onnx")
    assert calibrate(fixed, images(10)).samples == 8
    with pytest.raises(InputError, match="at least one batch"):
        calibrate(fixed, images(3))


def test_a_network_that_overflows_is_named_by_its_tensor(tmp_path: Path) -> None:
    net = Net()
    y = net.node("Exp", [net.node("Mul", ["image", net.constant(np.float32(1e4))])])
    path = save(net.model(net.node("Mul", [y, y])), tmp_path / "net.onnx")
    with pytest.raises(InputError, match=r"tensor '(exp1|logits)'"):
        calibrate(path, np.abs(images(2)) + 1)


def test_observers_want_values() -> None:
    for method in METHODS:
        with pytest.raises(InputError, match="at least one batch"):
            make_observer(method).range()
        observer = make_observer(method)
        observer.update(np.zeros((2, 2), np.float32))
        assert observer.range() == (0.0, 0.0)
        with pytest.raises(InputError, match="NaN"):
            observer.update([np.nan])


def test_weights_in_another_file_are_part_of_the_model(tmp_path: Path) -> None:
    digests = set()
    for seed in (0, 1):
        net = Net(seed)
        (tmp_path / "weights.bin").unlink(missing_ok=True)
        model = net.model(net.conv("image", 3, 4))
        onnx.save(model, tmp_path / "m.onnx", save_as_external_data=True, location="weights.bin", size_threshold=0)
        digests.add(calibrate(tmp_path / "m.onnx", images(2)).model_sha256)
    assert len(digests) == 2

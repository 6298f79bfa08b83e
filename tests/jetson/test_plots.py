"""Figures of the twin: what is drawn is what was computed, labelled with units, and nothing is left behind."""

from __future__ import annotations

import itertools
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection, PolyCollection
from matplotlib.container import ErrorbarContainer
from matplotlib.figure import Figure
from matplotlib.text import Annotation, Text

from robotbrain.errors import InputError
from robotbrain.jetson import plots
from robotbrain.jetson.catalogue import list_modules, load_module
from robotbrain.jetson.plot_modules import spread
from robotbrain.jetson.twin import Prediction, compare, predict, simulate_heat, thermal_model
from robotbrain.jetson.twin.data import load_kernel_lists

UNITS = ("(ms", "(GB/s)", "(GFLOP/s)", "(FLOP/byte)", "(W)", "(°C)", "(%)", "(s)", "(min)", "(ms), bars: 80 % interval")
CONV: dict[str, Any] = {"op": "conv", "macs": 10**8, "in_elems": 10**5, "out_elems": 10**5, "weight_elems": 10**4}
ADD: dict[str, Any] = {"op": "pw", "macs": 0, "in_elems": 10**5, "out_elems": 10**5, "weight_elems": 0}


@pytest.fixture(scope="module")
def deep() -> Prediction:
    """Return a network of 200 and more kernels, also without arithmetic."""
    return predict(load_kernel_lists()["densenet201"], "orin-nano-8gb")


def axes_of(figure: Figure) -> list[Axes]:
    return list(figure.get_axes())


def dots(figure: Figure) -> Iterator[tuple[Axes, float, float, float]]:
    for axes in axes_of(figure):
        for collection in axes.collections:
            if isinstance(collection, PathCollection):
                offsets = np.asarray(collection.get_offsets())
                for (x, y), size in zip(offsets, np.broadcast_to(collection.get_sizes(), len(offsets)), strict=True):
                    yield axes, float(x), float(y), float(size)


def bars(axes: Axes) -> list[ErrorbarContainer]:
    return [container for container in axes.containers if isinstance(container, ErrorbarContainer)]


def assert_labelled(figure: Figure) -> None:
    for axes in axes_of(figure):
        labels = [axes.get_xlabel(), axes.get_ylabel()]
        assert any(any(unit in label for unit in UNITS) for label in labels), labels
    assert len(plots.alt_text(figure)) > 60


def test_roofline_has_a_dot_for_each_kernel_where_it_belongs(deep: Prediction) -> None:
    figure = plots.plot_roofline(deep)
    assert_labelled(figure)
    main, strip = axes_of(figure)
    found = list(dots(figure))
    assert len(found) == len(deep.kernels)
    expected = {
        (round(k.flops / k.bytes_moved, 6), round(k.flops / k.total_ms / 1e6, 6)) for k in deep.kernels if k.flops
    }
    assert {(round(x, 6), round(y, 6)) for axes, x, y, _ in found if axes is main} == expected
    moved = sorted(k.bytes_moved / k.total_ms / 1e6 for k in deep.kernels if not k.flops)
    assert sorted(y for axes, _, y, _ in found if axes is strip) == pytest.approx(moved)
    assert all(lower < y < upper for axes, _, y, _ in found for lower, upper in [axes.get_ylim()])
    assert all(lower <= x <= upper for axes, x, _, _ in found for lower, upper in [axes.get_xlim()])


def test_dots_lie_under_the_roofs_and_the_ridge_is_marked() -> None:
    prediction = predict(load_kernel_lists()["resnet50"], "agx-orin-64gb", mode="MAXN")
    figure = plots.plot_roofline(prediction)
    peak, bandwidth = prediction.where.peak[1] / 1e9, prediction.where.bandwidth / 1e9
    main = axes_of(figure)[0]
    assert all(y <= 1.0001 * min(peak, bandwidth * x) for axes, x, y, _ in dots(figure) if axes is main)
    marks = [line.get_xydata() for line in main.lines if line.get_marker() == "D"]
    assert [np.asarray(mark).ravel().tolist() for mark in marks] == [pytest.approx([peak / bandwidth, peak])]
    words = " ".join(text.get_text() for text in main.texts)
    assert f"ridge {peak / bandwidth:.3g} FLOP/byte" in words and "GB/s" in words


def test_area_of_a_dot_grows_linearly_with_time(deep: Prediction) -> None:
    areas = sorted(size for *_, size in dots(plots.plot_roofline(deep)))
    times = sorted(kernel.total_ms for kernel in deep.kernels)
    line = np.polyfit(times, areas, 1)
    assert np.allclose(np.polyval(line, times), areas, rtol=1e-6)
    assert line[0] > 0


def test_each_precision_in_use_has_a_roof() -> None:
    graph = load_kernel_lists()["mobilenet_v1_1p0_224"]
    kernels = tuple(replace(k, precision="int8" if i % 2 else None) for i, k in enumerate(graph.kernels))
    figure = plots.plot_roofline(predict(replace(graph, kernels=kernels), "xavier-nx", precision="int8"))
    words = " ".join(text.get_text() for text in axes_of(figure)[0].texts)
    assert "int8 peak" in words and "fp16 peak" in words and "CUDA cores" in words


@pytest.mark.parametrize("kernels", [[CONV], [ADD], [CONV, ADD]], ids=["arithmetic", "data only", "both"])
def test_small_networks_can_be_drawn(kernels: list[dict[str, Any]], tmp_path: Path) -> None:
    prediction = predict(kernels, "nano-4gb")
    for name, plot in (("r", plots.plot_roofline), ("t", plots.plot_timeline), ("p", plots.plot_prediction)):
        figure = plot(prediction)
        plots.save(figure, tmp_path / f"{name}.png", dpi=30)
    assert sum(1 for _ in dots(plots.plot_roofline(prediction))) == len(kernels)


def test_timeline_shows_each_kernel_once_and_fills_the_time(deep: Prediction) -> None:
    figure = plots.plot_timeline(deep)
    assert_labelled(figure)
    (axes,) = axes_of(figure)
    bars = [path.vertices for c in axes.collections if isinstance(c, PolyCollection) for path in c.get_paths()]
    spans = sorted((float(b[:, 0].min()), float(b[:, 0].max())) for b in map(np.asarray, bars))
    # One bar for each kernel, one for each launch, and one for the start; together they cover the time once.
    assert len(spans) == 2 * len(deep.kernels) + 1
    assert spans[0][0] == 0
    assert spans[-1][1] == pytest.approx(deep.latency_ms)
    assert all(b[0] == pytest.approx(a[1], abs=1e-9) for a, b in itertools.pairwise(spans))
    assert axes.get_xlim()[1] == pytest.approx(deep.latency_ms)


def test_devices_are_where_they_belong_and_named_without_overlap() -> None:
    predictions = compare(load_kernel_lists()["vgg19"].at_batch(128))
    assert not all(p.fits for p in predictions)  # also one that runs out of memory
    figure = plots.plot_devices(predictions)
    assert_labelled(figure)
    (axes,) = axes_of(figure)
    points = {(p.power_w, p.latency_ms) for p in predictions}
    drawn = [container.lines[0].get_xydata() for container in bars(axes)]
    assert {tuple(np.asarray(xy).ravel().tolist()) for xy in drawn} == points
    names = [t for t in axes.texts if isinstance(t, Annotation) and t.get_text().split()[0] in list_modules()]
    assert len(names) == len(list_modules())
    figure.draw_without_rendering()
    boxes = [Text.get_window_extent(name) for name in names]  # without the leader line
    assert not any(a.overlaps(b) for a, b in itertools.combinations(boxes, 2))
    assert all(("out of memory" in name.get_text()) == (not p.fits) for name in names for p in predictions
               if name.get_text().split()[0] == p.device)  # fmt: skip


def test_devices_draws_bars_over_the_interval() -> None:
    (prediction,) = compare([CONV], ["t5000"])
    (axes,) = axes_of(plots.plot_devices([prediction]))
    (container,) = bars(axes)
    segment = np.asarray(container.lines[2][0].get_segments()[0])
    assert sorted(segment[:, 1]) == pytest.approx([prediction.latency_low_ms, prediction.latency_high_ms])


def test_modes_of_a_module_are_joined_and_named_once() -> None:
    predictions = compare([CONV], ["nano-4gb", "xavier-nx"], modes="all")
    (axes,) = axes_of(plots.plot_devices(predictions))
    names = [t.get_text() for t in axes.texts if t.get_text().split()[0] in list_modules()]
    assert sorted(names) == ["nano-4gb", "xavier-nx"]
    counts = [len(np.asarray(line.get_xydata())) for line in axes.lines if line.get_linestyle() == "-"]
    joined = sorted(count for count in counts if count > 1)
    assert joined == sorted(len(load_module(slug).modes) for slug in ("nano-4gb", "xavier-nx"))


def test_no_predictions_cannot_be_drawn() -> None:
    with pytest.raises(InputError, match="at least one"):
        plots.plot_devices([])


@given(st.lists(st.floats(0, 1), min_size=1, max_size=20).map(sorted))
def test_labels_are_spread_apart_and_keep_their_order(wanted: list[float]) -> None:
    gap = 1 / 21
    places = spread(wanted, gap)
    assert len(places) == len(wanted)
    assert all(b - a >= gap - 1e-9 for a, b in itertools.pairwise(places))
    assert places[0] >= -1e-9 and places[-1] <= 1 + 1e-9
    apart = all(b - a >= gap for a, b in itertools.pairwise(wanted)) and wanted[0] >= gap and wanted[-1] <= 1 - gap
    if apart:
        assert places == pytest.approx(wanted)


def test_labels_that_want_one_place_are_spread_evenly_around_it() -> None:
    assert spread([0.1, 0.6, 0.6, 0.6], 0.05) == pytest.approx([0.1, 0.55, 0.6, 0.65])


def test_heat_shows_trip_points_and_when_clocks_were_lowered() -> None:
    model = thermal_model(load_module("nano-4gb"), "passive", ambient_c=45)
    trace = simulate_heat(model, lambda _, clock: 2 + 9 * clock, 600)
    assert trace.throttled_s > 0
    figure = plots.plot_heat(trace, model, "nano-4gb")
    assert_labelled(figure)
    top = axes_of(figure)[0]
    chip = next(line for line in top.lines if line.get_label() == "chip")
    assert np.allclose(chip.get_ydata(), trace.temperature_c)
    assert np.allclose(np.asarray(chip.get_xdata(), float) * 60, trace.time_s)
    levels = {float(np.asarray(line.get_ydata())[0]) for line in top.lines if line is not chip}
    assert levels == {model.throttle_c, model.shutdown_c, model.ambient_c}
    assert f"{trace.throttled_s:.0f} s" in plots.alt_text(figure)


@pytest.mark.parametrize("name", ["f.png", "f.svg", "f.PDF"])
def test_figures_are_stored_with_their_alt_text(name: str, tmp_path: Path) -> None:
    figure = plots.plot_timeline(predict([CONV], "tx2"))
    content = plots.save(figure, tmp_path / name, dpi=30).read_bytes()
    assert content.startswith({"f.png": b"\x89PNG", "f.svg": b"<?xml", "f.PDF": b"%PDF"}[name])
    if not name.endswith("PDF"):
        assert b"Timeline of kernels in fp16" in content


def test_an_unknown_format_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"\.png"):
        plots.save(plots.plot_timeline(predict([CONV], "tx2")), tmp_path / "figure.jpg")
    assert not list(tmp_path.iterdir())


def test_images_for_pages_carry_escaped_alt_text() -> None:
    figure = plots.plot_timeline(predict([CONV], "tx2"))
    figure.set_label('a < b & "c"')
    assert 'alt="a &lt; b &amp; &quot;c&quot;"' in plots.to_html(figure, dpi=20)


def test_pyplot_is_not_involved() -> None:
    code = (
        "import sys\nfrom robotbrain.jetson import plots\nassert 'matplotlib' not in sys.modules\n"
        "from robotbrain.jetson.twin import predict\n"
        "k = dict(op='conv', macs=10, in_elems=9, out_elems=8, weight_elems=7)\n"
        "plots.to_html(plots.plot_prediction(predict([k], 'tx2')), dpi=20)\n"
        "assert 'matplotlib.pyplot' not in sys.modules"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr

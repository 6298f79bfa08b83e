"""Figures show what the runs say: bars against spans, curves against ages, words against numbers."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from matplotlib.figure import Figure

from robotbrain.errors import InputError
from robotbrain.pipeline.patterns import plots
from robotbrain.pipeline.patterns.brains import run_brain
from robotbrain.pipeline.patterns.jitter import measure_jitter
from robotbrain.pipeline.patterns.queues import QUEUE_POLICIES, run_queue
from robotbrain.pipeline.patterns.rates import METHODS, loop_times
from robotbrain.pipeline.patterns.stages import Device, Stage

STAGES = [Stage.of("perception", 10, 20, 10), Stage.of("estimation", 15), Stage.of("planning", 20), Stage.of("act", 5)]
MS = 1_000_000


@pytest.fixture(scope="module")
def runs():
    more = {"sequential": {}, "pipelined": {"frames_at_once": 2}, "parallel": {"control_hz": 25}}
    return [
        run_brain(kind, STAGES, Device(8), camera_hz=20, seconds=3, **arguments) for kind, arguments in more.items()
    ]


def rectangles(axes):
    return [(bar.get_x(), bar.get_x() + bar.get_width(), bar.get_height(), bar.get_y()) for bar in axes.patches]


def test_timeline_draws_every_stage_of_every_frame(runs):
    figure, alt = plots.plot_timeline(runs, start_ms=1000, span_ms=500)
    assert isinstance(figure, Figure)
    for axes, run in zip(figure.axes, runs, strict=True):
        bars = rectangles(axes)
        in_view = [s for s in run.spans if s.end_ns > 1000 * MS and s.start_ns < 1500 * MS]
        cores = [bar for bar in bars if bar[2] < 0.5]
        drawn = sorted(bar[:2] for bar in cores if bar[1] > 1000 and bar[0] < 1500)
        gpu = sorted((s.start_ns / MS, s.end_ns / MS) for s in in_view if s.resource == "gpu")
        assert np.array(drawn) == pytest.approx(np.array(gpu))
        outer = [bar for bar in bars if bar[2] > 0.5]
        for left, right, *_ in outer:
            assert any(s.start_ns / MS == pytest.approx(left) for s in run.spans)
            assert any(s.end_ns / MS == pytest.approx(right) for s in run.spans)
        shown = {(s.stage, s.frame, s.start_ns if s.stage == "act" else 0) for s in in_view}
        assert len(outer) == len(shown)
        # Within a lane nothing overlaps.
        for lane in {bar[3] for bar in outer}:
            times = sorted(bar[:2] for bar in outer if bar[3] == lane)
            assert all(a[1] <= b[0] + 1e-6 for a, b in itertools.pairwise(times))
        assert f"{run.throughput_hz:.1f} frames per second" in alt
    labels = [label.get_text() for label in figure.axes[1].get_yticklabels()]
    assert labels == ["perception", "estimation", "planning", "act"]
    crowded = run_brain("pipelined", STAGES, Device(8), camera_hz=40, seconds=2, frames_at_once=2)
    figure, _ = plots.plot_timeline(crowded)
    labels = [label.get_text() for label in figure.axes[0].get_yticklabels()]
    assert labels == ["perception 1", "perception 2", "estimation", "planning", "act"]


def test_the_line_follows_the_frame_from_camera_to_command(runs):
    for run in runs:
        command = next(c for c in run.first_uses if c.state_ns >= 1050 * MS)
        figure, _ = plots.plot_timeline(run, start_ms=1000, span_ms=500, follow=command.state_ns // run.period_ns)
        line = [line for line in figure.axes[0].lines if line.get_linewidth() == 1.5 and len(line.get_xdata()) > 3]
        assert len(line) == 1
        x, y = line[0].get_data()
        assert (x[0], x[-1]) == pytest.approx((command.state_ns / MS, command.released_ns / MS))
        assert np.all(np.diff(x) >= -1e-9)
        assert np.all(np.diff(y) >= 0)


def test_ages_and_bars_say_what_the_runs_say(runs):
    figure, alt = plots.plot_ages(runs, labels=["a", "b", "c"])
    for axes, run in zip(figure.axes, runs, strict=True):
        assert max(axes.lines[0].get_ydata()) >= run.peak_age_ms - 1e-9
        assert axes.lines[1].get_ydata()[0] == pytest.approx(run.mean_age_ms)
    assert all(f"peak {run.peak_age_ms:.0f} ms" in alt for run in runs)
    figure, alt = plots.plot_comparison(runs)
    throughput, latency, age = figure.axes
    assert [bar.get_width() for bar in throughput.patches] == pytest.approx([run.throughput_hz for run in runs])
    assert [bar.get_width() for bar in latency.patches] == pytest.approx([run.latency_ms.mean() for run in runs])
    assert [bar.get_width() for bar in age.patches] == pytest.approx([run.mean_age_ms for run in runs])
    assert "Sequential" in alt


def test_queues_rates_jitter_and_speeds():
    queues = [run_queue(policy, seconds=2) for policy in QUEUE_POLICIES]
    figure, alt = plots.plot_queues(queues)
    totals = np.sum([[bar.get_width() for bar in bars] for bars in figure.axes[1].containers], axis=0)
    assert totals == pytest.approx([100] * len(queues))
    assert "keep all" in alt
    loops = [loop_times(method, 20 * MS, [4 * MS, 30 * MS, 4 * MS], MS) for method in METHODS]
    figure, alt = plots.plot_rates(loops)
    assert len(figure.axes[0].patches) == 3 * len(METHODS)
    with pytest.raises(InputError, match="period"):
        plots.plot_rates([loops[0], loop_times("sleep", 1, [1])])
    _, alt = plots.plot_jitter([measure_jitter(500, 0.02)])
    assert "median" in alt
    figure, alt = plots.plot_safe_speed(1.0, ages_ms={"sequential": 200})
    assert "1.41 m/s" in alt


def test_figures_can_be_written(runs, tmp_path):
    for number, (figure, alt) in enumerate([plots.plot_timeline(runs), plots.plot_ages(runs)]):
        path = tmp_path / f"{number}.png"
        figure.savefig(path)
        assert path.stat().st_size > 10_000
        assert alt.endswith(".")

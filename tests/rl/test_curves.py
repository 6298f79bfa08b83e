"""Curves: the spread is that of the trainings, and a figure says what it shows."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from robotbrain.errors import InputError
from robotbrain.monitoring.accuracy import Estimate
from robotbrain.rl.curves import alt_text, plot_curves, plot_estimates, save, series_from_records, spread
from robotbrain.rl.logs import RunLog, Series, read_run


def line(steps: list[int], values: list[float]) -> Series:
    return Series(np.array(steps), np.array(steps) * 0.6, np.array(values, float))


def test_spread_on_common_places_is_that_of_the_values() -> None:
    found = spread([line([0, 10, 20], [0, 1, 5]), line([0, 10, 20], [0, 3, 6]), line([0, 10, 20], [3, 2, 10])])
    np.testing.assert_array_equal(found.x, [0, 10, 20])
    np.testing.assert_array_equal(found.median, [0, 2, 6])
    np.testing.assert_array_equal(found.low, [0, 1, 5])
    np.testing.assert_array_equal(found.high, [3, 3, 10])
    halves = spread([line([0, 10], [i, i]) for i in range(5)], band=0.5)
    assert (halves.low[0], halves.high[0]) == (1, 3)


def test_trainings_of_other_lengths_and_rhythms_are_interpolated_where_all_are() -> None:
    found = spread([line([0, 100], [0, 100]), line([10, 30, 50], [10, 30, 50]), line([0, 40], [0, 40])])
    assert (found.x[0], found.x[-1]) == (10, 40)
    np.testing.assert_allclose(found.median, found.x)
    np.testing.assert_allclose(found.high - found.low, 0, atol=1e-12)
    shorter = spread([line([0, 10, 20], [1, 2, 3]), line([0, 10], [1, 2])])
    assert shorter.x[-1] == 10
    minutes = spread([line([0, 100], [0, 1])], x="minutes")
    assert minutes.x[-1] == pytest.approx(1.0)
    gaps = spread([line([0, 10, 20], [1, np.nan, 3])])
    np.testing.assert_array_equal(gaps.x, [0, 20])


def test_figures_are_labelled_and_speak(tmp_path: Path) -> None:
    for seed in range(3):
        with RunLog(tmp_path / str(seed), tensorboard=False) as log:
            for step in range(0, 5000, 1000):
                log.scalar("success", step / 5000 + 0.05 * seed, step)
    runs = [tmp_path / str(seed) for seed in range(3)]
    methods = {"PPO": runs, "other": [read_run(runs[0])]}
    figure = plot_curves(methods, "success", percent=True, threshold=0.95, ylabel="success, %")
    axes = figure.axes[0]
    assert axes.get_ylabel() == "success, %" and axes.get_xlabel() == "environment steps"
    assert [text.get_text() for text in axes.get_legend().get_texts()] == ["PPO (3 seeds)", "other (1 seed)"]
    np.testing.assert_allclose(axes.lines[0].get_ydata(), [5, 25, 45, 65, 85])
    assert "PPO, 3 seeds: from 5 to 85 (80 to 90) after 4,000 steps" in alt_text(figure)
    assert save(figure, tmp_path / "curve.svg").stat().st_size > 1000
    # Told apart without colours too.
    assert len({(line.get_linestyle(), line.get_marker()) for line in axes.lines[:2]}) == 2


def test_estimates() -> None:
    figure = plot_estimates({"plain": Estimate(0.5, 0.4, 0.6), "randomised": Estimate(0.9, 0.8, 1.0)}, xlabel="success")
    assert "randomised: 0.9 (0.8 to 1)" in alt_text(figure)
    assert [text.get_text() for text in figure.axes[0].get_yticklabels()] == ["plain", "randomised"]


def test_records() -> None:
    series = series_from_records([{"step": 5, "seconds": 1.0}, {"step": 10, "seconds": 2.0, "success": 0.5}], "success")
    assert (series.step.tolist(), series.elapsed_s.tolist(), series.value.tolist()) == ([10], [2.0], [0.5])
    with pytest.raises(InputError, match="success"):
        series_from_records([{"step": 5, "success": 1.0}], "sucess")


def test_what_cannot_be_drawn_is_named(tmp_path: Path) -> None:
    for call in (
        lambda: spread([]),
        lambda: spread([line([0], [np.nan])]),
        lambda: spread([line([0, 1], [0, 1]), line([5, 6], [0, 1])]),
        lambda: plot_curves({}),
        lambda: plot_curves({"PPO": [tmp_path]}),
        lambda: plot_estimates({}, xlabel="x"),
    ):
        with pytest.raises(InputError):
            call()

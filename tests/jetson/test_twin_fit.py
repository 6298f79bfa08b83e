"""The fit against data that the model itself made up: what is known can be compared with what is found."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from robotbrain.jetson.catalogue import load_module
from robotbrain.jetson.twin.conditions import Conditions, conditions
from robotbrain.jetson.twin.data import LatencyRow, load_kernel_lists, load_latency_rows
from robotbrain.jetson.twin.fit import NOISE, Fitted, Sample, fit
from robotbrain.jetson.twin.latency import COMPONENTS, NAMES, Effect, Work, design, list_effects, make_work
from robotbrain.jetson.twin.validate import Z80

TRUTH = {
    "compute": np.log(0.6),
    "window": 0.1,
    "depthwise": np.log(0.2),
    "memory": np.log(0.5),
    "matmul": 0.2,
    "launch": np.log(0.015),
    "clock": 1.0,
    "fixed": np.log(0.3),
}
LISTS = load_kernel_lists()


def place(slug: str = "xavier-nx", precision: str = "fp16", harness: str = "torch2trt") -> Conditions:
    module = load_module(slug)
    return conditions(module, module.default_mode, precision, harness)


def truth() -> Fitted:
    effects = tuple(Effect(c.name, "", c.mean, c.sd) for c in COMPONENTS)
    return Fitted(effects, np.array([TRUTH[name] for name in NAMES]), np.zeros((len(NAMES), len(NAMES))))


def made_up(true: Fitted, where: Conditions, noise: float, seed: int) -> list[Sample]:
    rng = np.random.default_rng(seed)
    works = [make_work(LISTS[name], where) for name in sorted(LISTS)]
    times = true.predict_ms(works, [where] * len(works)) * np.exp(noise * rng.standard_normal(len(works)))
    return [Sample(work, where, float(ms)) for work, ms in zip(works, times, strict=True)]


@pytest.mark.parametrize("seed", range(5))
def test_the_parameters_of_made_up_data_are_found(seed: int) -> None:
    where = place()
    fitted = fit(made_up(truth(), where, NOISE, seed))
    found, matrices = fitted.parameters([where]), design(fitted.effects, [where])
    # How close 50 networks with 6 % of noise must pin each parameter down (a clock cannot be told from one clock).
    limits = {"compute": 0.15, "window": 0.15, "depthwise": 0.4, "memory": 0.2, "matmul": 0.5, "launch": 0.15}
    for name, limit in (limits | {"fixed": 0.6}).items():
        error = abs(float(found[name][0]) - TRUTH[name])
        row = matrices[name][0]
        assert error < limit, name
        assert error < 3.5 * np.sqrt(row @ fitted.covariance @ row), name


def test_without_noise_the_predictions_are_those_of_the_truth() -> None:
    where = place()
    data = made_up(truth(), where, 0.0, 0)
    fitted = fit(data)
    predicted = fitted.predict_ms([s.work for s in data], [where] * len(data))
    assert np.abs(np.log(predicted) - np.log([s.latency_ms for s in data])).max() < 0.03


def test_one_row_that_is_three_times_too_slow_changes_little() -> None:
    where = place()
    data = made_up(truth(), where, NOISE, 1)
    clean = fit(data).predict_ms([s.work for s in data], [where] * len(data))
    for spoilt in (0, 10, 40):
        bad = [replace(s, latency_ms=3 * s.latency_ms) if i == spoilt else s for i, s in enumerate(data)]
        dirty = fit(bad).predict_ms([s.work for s in data], [where] * len(data))
        assert np.abs(np.log(dirty / clean)).max() < 0.12
        assert np.median(np.abs(np.log(dirty / clean))) < 0.02


def test_the_order_of_rows_does_not_matter() -> None:
    rows = [*made_up(truth(), place(), NOISE, 2)[::5], *made_up(truth(), place("tx2", "fp32"), NOISE, 3)[::5]]
    first = fit(rows)
    second = fit([rows[i] for i in np.random.default_rng(0).permutation(len(rows))])
    assert first.effects == second.effects
    # Solvers stop at 1e-10 of the cost; along flat directions that is about 1e-4 of a coefficient.
    np.testing.assert_allclose(second.values, first.values, atol=2e-3)
    np.testing.assert_allclose(second.covariance, first.covariance, atol=2e-3)


def test_a_row_of_weight_five_is_the_row_five_times() -> None:
    first, *others = made_up(truth(), place(), NOISE, 4)[4:16]
    first = replace(first, latency_ms=1.1 * first.latency_ms)
    once, repeated = fit([first, *others]), fit([first] * 5 + others)
    weighted = fit([replace(first, weight=5.0), *others])
    np.testing.assert_allclose(weighted.values, repeated.values, atol=2e-3)
    assert np.abs(once.values - repeated.values).max() > 0.02


def test_the_fit_is_the_best_there_is_nearby() -> None:
    """No small step from the result lowers the cost, computed here once more from its definition."""
    where = place()
    data = made_up(truth(), where, NOISE, 5)[::3]
    fitted = fit(data)
    mean, sd = np.array([e.mean for e in fitted.effects]), np.array([e.sd for e in fitted.effects])

    def cost(values: np.ndarray) -> float:
        there = Fitted(fitted.effects, values, fitted.covariance)
        z = (
            np.log(there.predict_ms([s.work for s in data], [where] * len(data)) / [s.latency_ms for s in data])
        ) / NOISE
        return float(np.sum(2 * 1.5**2 * (np.sqrt(1 + (z / 1.5) ** 2) - 1)) + np.sum(((values - mean) / sd) ** 2))

    best = cost(fitted.values)
    rng = np.random.default_rng(0)
    steps = np.vstack([np.eye(len(mean)), -np.eye(len(mean)), rng.standard_normal((30, len(mean)))])
    for step in steps:
        assert cost(fitted.values + 0.01 * step) > best - 1e-6 * best


def test_a_later_start_leads_to_the_same_fit() -> None:
    data = made_up(truth(), place(), NOISE, 6)[::2]
    fitted = fit(data)
    np.testing.assert_allclose(fit(data, fitted).values, fitted.values, atol=2e-3)


def test_what_was_not_measured_is_less_sure() -> None:
    data = [*made_up(truth(), place(), NOISE, 7), *made_up(truth(), place("tx2", "fp32"), NOISE, 8)]
    fitted = fit(data)

    def sd(where: Conditions) -> float:
        return fitted.log_sd(make_work(LISTS["resnet50"], where), where)

    seen = sd(place())
    assert NOISE < seen < 2 * NOISE
    other_module = sd(place("agx-xavier-32gb"))
    other_precision = sd(place(precision="int8"))
    other_harness = sd(place(harness="ultralytics"))
    other_family = sd(place("orin-nano-8gb"))
    everything = sd(place("orin-nano-8gb", "int8", "ultralytics"))
    assert seen < other_module < other_harness < everything
    assert seen < other_precision < everything
    assert seen < other_family <= everything


def test_the_spread_is_that_of_the_coefficients_to_first_order() -> None:
    where = place()
    fitted = fit(made_up(truth(), where, NOISE, 9))
    work = make_work(LISTS["googlenet"], where)
    rng = np.random.default_rng(0)
    draws = rng.multivariate_normal(fitted.values, fitted.covariance, size=4000)
    logs = [np.log(Fitted(fitted.effects, v, fitted.covariance).predict_ms([work], [where])[0]) for v in draws]
    assert fitted.log_sd(work, where) == pytest.approx(float(np.hypot(np.std(logs), NOISE)), rel=0.1)


@functools.cache
def prior_world(seed: int) -> tuple[list[Work], list[Conditions], np.ndarray]:
    """The kit's own rows, with latencies from coefficients drawn from the model's prior."""
    rows = load_latency_rows()
    rng = np.random.default_rng(seed)
    where = [row.where for row in rows]
    works = [make_work(LISTS[row.kernels], row.where) for row in rows]
    effects = list_effects(where)
    values = np.array([e.mean for e in effects]) + rng.standard_normal(len(effects)) * [e.sd for e in effects]
    matrices = design(effects, where)
    assert set(matrices) == set(NAMES)
    true = Fitted(tuple(effects), values, np.zeros((len(effects), len(effects))))
    times = true.predict_ms(works, where) * np.exp(NOISE * rng.standard_normal(len(rows)))
    return works, where, times


@pytest.mark.parametrize(
    ("left_out", "low", "high"),
    [
        (lambda index, row: index % 5 == 2, 0.74, 0.93),
        (lambda index, row: row.harness == "ultralytics", 0.6, 0.97),
        (lambda index, row: row.module == "orin-nx-16gb", 0.6, 0.97),
    ],
    ids=["every fifth row", "a harness", "a module"],
)
def test_intervals_hold_what_they_promise_on_made_up_worlds(
    left_out: Callable[[int, LatencyRow], bool], low: float, high: float
) -> None:
    """Coefficients from the prior, noise of the size assumed: 80 % intervals must then hold 80 %."""
    rows = load_latency_rows()
    out = [index for index, row in enumerate(rows) if left_out(index, row)]
    hits: list[bool] = []
    for seed in range(4):
        works, where, times = prior_world(seed)
        kept = [Sample(works[i], where[i], float(times[i])) for i in range(len(rows)) if i not in out]
        fitted = fit(kept)
        for index in out:
            log_ms = np.log(fitted.predict_ms([works[index]], [where[index]])[0] / times[index])
            hits.append(abs(log_ms) < Z80 * fitted.log_sd(works[index], where[index]))
    # Rows of a world share its coefficients, so the share itself scatters by several per cent.
    assert low < np.mean(hits) < high, np.mean(hits)

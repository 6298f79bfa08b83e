"""The sketch keeps its promise, and refuses what is no latency."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robotbrain.errors import InputError
from robotbrain.monitoring.sketch import LatencySketch, WindowedSketch

DISTRIBUTIONS: dict[str, Callable[[np.random.Generator], Any]] = {
    "uniform": lambda rng: rng.uniform(0, 50, 4000),
    "long tail": lambda rng: rng.lognormal(0, 2.5, 4000),
    "two modes": lambda rng: np.concatenate([rng.normal(5, 0.1, 2000), rng.normal(500, 1, 2000)]),
    "17 decades apart": lambda rng: 10 ** rng.uniform(-6, 9, 4000),
    "zeros and more": lambda rng: np.where(rng.random(4000) < 0.3, 0.0, rng.exponential(3, 4000)),
}


@pytest.mark.parametrize("name", DISTRIBUTIONS)
@pytest.mark.parametrize("accuracy", [0.01, 0.05])
def test_quantiles_are_within_the_relative_error_of_numpys(name: str, accuracy: float) -> None:
    values = DISTRIBUTIONS[name](np.random.default_rng(7))
    sketch = LatencySketch(accuracy)
    sketch.extend(values)
    for q in np.linspace(0, 1, 101):
        exact = float(np.quantile(values, q, method="lower"))
        assert sketch.quantile(float(q)) == pytest.approx(exact, rel=accuracy * (1 + 1e-9), abs=1e-9), (name, q)
    assert sketch.mean == pytest.approx(values.mean())
    assert (sketch.min, sketch.max, sketch.count) == (values.min(), values.max(), len(values))


@given(
    st.lists(st.floats(0, 1e9, allow_nan=False), min_size=1, max_size=60),
    st.lists(st.floats(0, 1e9, allow_nan=False), max_size=60),
)
@settings(max_examples=60, deadline=None)
def test_merging_is_as_good_as_adding(first: list[float], second: list[float]) -> None:
    together, left, right = LatencySketch(), LatencySketch(), LatencySketch()
    together.extend(first + second)
    left.extend(first)
    right.extend(second)
    left.merge(right)
    assert left.count == together.count
    assert left.min == together.min and left.max == together.max
    for q in (0, 0.1, 0.5, 0.9, 0.99, 1):
        assert left.quantile(q) == pytest.approx(together.quantile(q))
    assert right.count == len(second)


def test_what_is_no_latency_is_counted_not_added() -> None:
    sketch = LatencySketch()
    sketch.extend([math.nan, 2.0, math.inf, -math.inf, -0.5])
    assert (sketch.count, sketch.invalid, sketch.negative) == (1, 3, 1)
    assert sketch.quantile(0.5) == 2.0 and sketch.mean == 2.0


def test_an_empty_sketch_says_so() -> None:
    sketch = LatencySketch()
    assert all(math.isnan(v) for v in (sketch.quantile(0.5), sketch.mean, sketch.min, sketch.max))
    assert sketch.to_dict()["p99"] is None
    json.dumps(sketch.to_dict(), allow_nan=False)


@pytest.mark.parametrize("accuracy", [0, 1, -0.1, math.nan])
def test_accuracy_has_a_range(accuracy: float) -> None:
    with pytest.raises(InputError, match="relative_accuracy"):
        LatencySketch(accuracy)


def test_misuse_is_explained() -> None:
    with pytest.raises(InputError, match="0 to 1"):
        LatencySketch().quantile(99)
    with pytest.raises(InputError, match="one accuracy"):
        LatencySketch(0.01).merge(LatencySketch(0.02))


def test_a_windowed_sketch_forgets_the_past_but_not_in_total() -> None:
    sketch = WindowedSketch()
    for value, count in ((1.0, 100), (10.0, 10), (100.0, 1)):
        for _ in range(count):
            sketch.add(value)
        if value < 100:
            sketch.roll()
    assert sketch.total().count == sketch.count == 111
    assert sketch.total().quantile(0.5) == pytest.approx(1, rel=0.01)
    assert sketch.recent().count == 11 and sketch.recent().min == 10
    sketch.roll()
    sketch.roll()
    assert sketch.recent().count == 0 and sketch.count == 111


def test_memory_is_bounded() -> None:
    sketch = LatencySketch()
    sketch.extend(10 ** np.random.default_rng(1).uniform(-9, 12, 5000))
    assert sketch.count == 5000
    sketch.quantile(0.5)
    assert len(sketch._sketch._store.bins) <= 2048
    assert len(sketch._buffer) < 1000

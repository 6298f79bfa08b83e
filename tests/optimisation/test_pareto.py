"""The Pareto front against its definition."""

from __future__ import annotations

import random
import subprocess
import sys
from typing import NamedTuple

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robotbrain.errors import InputError
from robotbrain.optimisation.pareto import dominates, pareto_front

POINTS = st.lists(st.tuples(*[st.integers(0, 5)] * 3), min_size=1, max_size=25)


def rows_of(points: list[tuple[int, ...]]) -> list[dict[str, float]]:
    return [{"id": i, "a": a, "b": b, "c": c} for i, (a, b, c) in enumerate(points)]


def ids(rows: list[dict[str, float]]) -> list[float]:
    return [row["id"] for row in rows]


@settings(max_examples=100, deadline=None)
@given(points=POINTS)
def test_definition(points: list[tuple[int, ...]]) -> None:
    rows = rows_of(points)
    front = pareto_front(rows, ["a", "b", "c"])
    inside = [(r["a"], r["b"], r["c"]) for r in front]
    assert front and not any(dominates(p, q) for p in inside for q in inside)
    for point, row in zip(points, rows, strict=True):
        # Outside exactly if somebody *of the front* is better: dominance is transitive.
        assert (row in front) != any(dominates(p, point) for p in inside)


@settings(max_examples=50, deadline=None)
@given(points=POINTS, seed=st.integers(0, 99))
def test_neither_order_nor_units_matter(points: list[tuple[int, ...]], seed: int) -> None:
    rows = rows_of(points)
    front = ids(pareto_front(rows, ["a", "b"]))
    mixed = random.Random(seed).sample(rows, len(rows))
    assert sorted(ids(pareto_front(mixed, ["a", "b"]))) == front
    assert ids(pareto_front(rows, ["b", "a"])) == front
    stretched = [row | {"a": 7.0 * row["a"] ** 3 - 2.0} for row in rows]
    assert ids(pareto_front(stretched, ["a", "b"])) == front
    turned = [row | {"a": -row["a"]} for row in rows]
    assert ids(pareto_front(turned, ["-a", "b"])) == front
    assert ids(pareto_front(rows, [lambda r: r["a"], "b"])) == front


@settings(max_examples=50, deadline=None)
@given(points=POINTS)
def test_another_respect_only_adds_unless_there_are_ties(points: list[tuple[int, ...]]) -> None:
    rows = rows_of(points)
    distinct = [r for r in rows if sum((s["a"], s["b"]) == (r["a"], r["b"]) for s in rows) == 1]
    if distinct:
        assert set(ids(pareto_front(distinct, ["a", "b"]))) <= set(ids(pareto_front(distinct, ["a", "b", "c"])))


def test_equal_rows_stay_together_and_one_key_is_the_minimum() -> None:
    rows = rows_of([(1, 1, 0), (1, 1, 9), (2, 2, 0)])
    assert ids(pareto_front(rows, ["a", "b"])) == [0, 1]
    assert ids(pareto_front(rows, ["-a"])) == [2]
    assert pareto_front([], ["a"]) == []


def test_rows_may_be_objects() -> None:
    class Row(NamedTuple):
        a: float

    assert pareto_front([Row(2.0), Row(1.0)], ["a"]) == [Row(1.0)]


@pytest.mark.parametrize("value", [None, float("nan"), "fast", True])
def test_what_was_not_measured_is_refused(value: object) -> None:
    with pytest.raises(InputError, match="a of row 1"):
        pareto_front([{"a": 1.0}, {"a": value}], ["a"])


@pytest.mark.parametrize("keys", [[], "a"])
def test_keys_are_a_list(keys: object) -> None:
    with pytest.raises(InputError, match="keys"):
        pareto_front([{"a": 1.0}], keys)  # type: ignore[arg-type]


def test_the_package_is_cheap_to_import_and_every_name_is_there() -> None:
    program = """
import sys
import robotbrain.optimisation as o
heavy = {"torch", "onnx", "onnxruntime", "matplotlib", "mujoco"} & set(sys.modules)
assert not heavy, heavy
assert all(getattr(o, name) is not None for name in o.__all__) and set(o.__all__) <= set(dir(o))
"""
    subprocess.run([sys.executable, "-c", program], check=True, timeout=120)

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robotbrain.grading import CheckFailure, expect, expect_close, fail
from robotbrain.grading.expect import show


def test_a_met_expectation_is_silent() -> None:
    expect(True, got=1)
    expect(np.bool_(True))
    expect_close([1.0, 2.0], np.array([1.0, 2.0]))


def test_a_failure_carries_what_the_report_shows() -> None:
    with pytest.raises(CheckFailure) as caught:
        expect(1 > 2, given=[1, 2], got=1, expected=2, hint="compare", misconception="swapped", credit=0.25)
    failure = caught.value
    assert (failure.given, failure.got, failure.expected) == ("[1, 2]", "1", "2")
    assert (failure.hint, failure.misconception, failure.credit) == ("compare", "swapped", 0.25)


def test_an_array_as_condition_is_explained() -> None:
    with pytest.raises(CheckFailure, match="no single truth value"):
        expect(np.array([True, False]))


@pytest.mark.parametrize(
    ("got", "expected", "message"),
    [
        (None, 1.0, "does your function return it"),
        ("6", 6.0, "of type str"),
        ([1.0, "x"], [1.0, 2.0], "of type list"),
        ({"a": 1}, 6.0, "of type dict"),
        ([1.0, 2.0, 3.0], [1.0, 2.0], r"shape \(3,\), but shape \(2,\)"),
        ([[1.0], [2.0, 3.0]], [1.0, 2.0], "of type list"),
        ([1.0, math.nan], [1.0, 2.0], r"NaN \(first at index \(1,\)\)"),
        (math.nan, 2.0, "contains NaN"),
        ([1.0, 2.5], [1.0, 2.0], r"1 of 2 values, first at index \(1,\): 2.5 instead of 2"),
        (math.inf, 1.0, "not close enough"),
        (object(), 1.0, "of type object"),
    ],
)
def test_expect_close_names_the_kind_of_mistake(got: object, expected: object, message: str) -> None:
    with pytest.raises(CheckFailure, match=message):
        expect_close(got, expected)


@given(st.floats(-1e6, 1e6), st.floats(1e-6, 1e3))
def test_expect_close_has_the_tolerance_it_is_given(value: float, atol: float) -> None:
    expect_close(value + 0.9 * atol, value, atol=atol, rtol=0.0)
    with pytest.raises(CheckFailure):
        expect_close(value + 1.1 * atol + 1e-9, value, atol=atol, rtol=0.0)


def test_infinities_and_expected_nans_match() -> None:
    expect_close([math.inf, -math.inf, math.nan], [math.inf, -math.inf, math.nan])
    with pytest.raises(CheckFailure):
        expect_close(math.inf, -math.inf)


def test_show_survives_a_broken_repr_and_shortens() -> None:
    class Broken:
        def __repr__(self) -> str:
            raise ValueError("no")

    assert "Broken" in show(Broken())
    assert len(show("x" * 10_000)) <= 400
    assert "shape (50, 50)" in show(np.zeros((50, 50)))


def test_fail_always_fails() -> None:
    with pytest.raises(CheckFailure, match="wrong"):
        fail("wrong")

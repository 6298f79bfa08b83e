"""Usual slips are named, and nothing is made up about other wrong answers."""

from __future__ import annotations

import math

import numpy as np
import pytest

from robotbrain.grading import CheckFailure, expect_close
from robotbrain.grading.likely import likely_slip


@pytest.mark.parametrize(
    ("slip", "word"),
    [
        (lambda x: 1000 * x, "1000 times"),
        (lambda x: x / 1000, "thousandth"),
        (np.degrees, "degrees where radians"),
        (np.radians, "radians where degrees"),
        (lambda x: -x, "opposite sign"),
        (lambda x: 2 * x, "twice"),
        (lambda x: x[::-1], "reversed"),
        (lambda x: x.T, "rows and columns"),
    ],
)
def test_slip_is_named_and_others_are_not(slip: object, word: str) -> None:
    rng = np.random.default_rng(3)
    for shape in ((4, 4), (3, 5)):
        right = rng.normal(size=shape)
        assert word in likely_slip(slip(right), right)  # type: ignore[operator]
        assert likely_slip(right + rng.normal(size=shape), right) == ""


def test_a_count_may_be_off_by_one_and_a_measure_may_not() -> None:
    assert likely_slip(np.array(5.0), np.array(4)) == "it is one too many"
    assert likely_slip(np.array([2.0, 3.0]), np.array([3, 4])) == "it is one too few"
    assert likely_slip(np.array(5.0), np.array(4.0)) == ""


@pytest.mark.parametrize("got", [0.0, math.inf, math.nan])
def test_zero_and_what_is_no_number_give_no_advice(got: float) -> None:
    assert likely_slip(np.array(got), np.array(3.0)) == ""
    assert likely_slip(np.array(3.0), np.array(0.0)) == ""
    assert likely_slip(np.array(1 + 2j), np.array(3.0)) == ""


def test_a_test_s_own_words_come_first() -> None:
    for given, expected in (("", "1000 times"), ("my words", "my words")):
        with pytest.raises(CheckFailure) as caught:
            expect_close(2000.0, 2.0, misconception=given)
        assert expected in caught.value.misconception
    with pytest.raises(CheckFailure) as caught:
        expect_close(np.zeros((2, 3)), np.ones((3, 2)))
    assert "rows and columns" in caught.value.misconception

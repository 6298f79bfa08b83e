"""What the suites of several labs share: is an answer right, and if not, which typical mistake gives just that answer?

Answers come from another process as plain values (see :mod:`robotbrain.grading.remote`), or as a stand-in for something
that is no value at all. A stand-in is never equal to a number, and nothing here asks the student's side what it equals.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robotbrain.grading.expect import expect, expect_close, fail

Mistakes = Iterable[tuple[str, Any]]
"""Pairs (hint, what this mistake answers)."""
VERDICT_WORDS = ("breaks", "wastes", "fine")
"""What may be said of a part of a program."""


def as_numbers(answer: Any) -> NDArray[np.float64] | None:
    """Return an answer as an array of floats, or None if it is no numbers."""
    try:
        array = np.asarray(answer)
        return None if array.dtype.kind not in "biuf" else array.astype(float)
    except Exception:  # ragged lists, stand-ins, objects of the notebook: whatever they raise, they are no numbers
        return None


def agrees(answer: Any, expected: Any, *, atol: float, rtol: float) -> bool:
    """Tell whether an answer has the expected shape and, within tolerance, the expected values; NaN matches NaN."""
    given = as_numbers(answer)
    right = np.asarray(expected, dtype=float)
    return given is not None and given.shape == right.shape and _close(given, right, atol, rtol)


def first_match(
    answer: Any, mistakes: Mistakes, expected: Any = None, *, atol: float = 1e-6, rtol: float = 1e-6
) -> str:
    """Return the hint of the first mistake that gives ``answer``, or ''; a mistake that gives ``expected`` is none."""
    given = as_numbers(answer)
    if given is None:
        return ""
    right = None if expected is None else np.asarray(expected, dtype=float)
    for hint, wrong in mistakes:
        value = np.asarray(wrong, dtype=float)
        if value.shape != given.shape or not _close(given, value, atol, rtol):
            continue
        if right is None or value.shape != right.shape or not _close(value, right, atol, rtol):
            return hint
    return ""


def compare(
    answer: Any,
    expected: Any,
    mistakes: Mistakes | Callable[[], Mistakes] = (),
    *,
    atol: float = 1e-6,
    rtol: float = 1e-6,
    match_atol: float = 1e-6,
    hint: str = "",
    given: str = "",
    what: str = "the answer",
) -> None:
    """Fail unless ``answer`` is close to ``expected``; the hint is that of the first mistake that gives the answer.

    Args:
        answer: the student's.
        expected: the oracle's.
        mistakes: typical mistakes; a function that returns them is called only where the answer is wrong.
        atol, rtol: how close the answer must be.
        match_atol: how close to a mistake's answer it must be to be taken for that mistake.
        hint: for an answer that no mistake explains.
        given: what the answer was asked for.
        what: name of the answer in the message.
    """
    if agrees(answer, expected, atol=atol, rtol=rtol):
        return
    pairs = mistakes() if callable(mistakes) else mistakes
    found = first_match(answer, pairs, expected, atol=match_atol, rtol=1e-5) or hint
    expect_close(answer, expected, atol=atol, rtol=rtol, given=given, hint=found, what=what)


def _close(a: NDArray[np.float64], b: NDArray[np.float64], atol: float, rtol: float) -> bool:
    # As np.allclose(equal_nan=True), which costs ten times as much on small arrays.
    with np.errstate(invalid="ignore"):
        same = (a == b) | (np.isfinite(b) & (np.abs(a - b) <= atol + rtol * np.abs(b)))
    if not same.all():
        same |= np.isnan(a) & np.isnan(b)
    return bool(same.all())


def compare_verdicts(answer: Any, key: Mapping[str, str], hints: Mapping[str, str]) -> None:
    """Compare what is said of the lettered parts of a program with the key; each letter counts the same.

    Args:
        answer: a dict from letters to the words in ``VERDICT_WORDS``.
        key: the right one.
        hints: for each letter.
    """
    if not isinstance(answer, Mapping):
        fail("VERDICTS should be a dict", got=answer, expected='{"a": "fine", ...}')
    given = {letter: word if isinstance(word := answer.get(letter), str) else "no answer" for letter in key}
    wrong = [letter for letter in key if given[letter] != key[letter]]
    if not wrong:
        return
    right = len(key) - len(wrong)
    credit = right / len(key)
    unknown = {letter: given[letter] for letter in wrong if letter in answer and given[letter] not in VERDICT_WORDS}
    expect(not unknown, "that is not one of the three words", got=unknown, expected=VERDICT_WORDS, credit=credit)
    first = wrong[0]
    fail(
        f"{right} of {len(key)} are right; look again at {first!r}",
        got=f"{first}: {given[first]}",
        expected=f"another of {', '.join(VERDICT_WORDS)}",
        hint=hints[first],
        credit=credit,
    )

"""Expectations: what a test says when a student's answer is wrong.

``expect`` and its kin raise :class:`CheckFailure`, whose fields a report lays out as "given, got, expected,
likely mistake, hint". They are ordinary assertions: pytest understands them too.
"""

from __future__ import annotations

import reprlib
import sys
from typing import Any

from robotbrain.grading.likely import likely_slip

_MISSING: Any = object()
_LONGEST = 400  # characters of a shown value: more than fits a line, less than hides the message


class CheckFailure(AssertionError):  # noqa: N818 - a student's failure, not a program's error
    """A student's answer is not what the test expects.

    Args:
        message: one sentence that says what is wrong.
        given, expected, got: what went in, should have come out, and came out (any object, or ready text).
        hint: a key of the suite's hints, or the hint itself.
        misconception: the mistake that most likely leads here.
        credit: fraction of the test's points kept all the same, in ``[0, 1]``.
    """

    def __init__(
        self,
        message: str,
        *,
        given: Any = _MISSING,
        expected: Any = _MISSING,
        got: Any = _MISSING,
        hint: str = "",
        misconception: str = "",
        credit: float = 0.0,
    ) -> None:
        super().__init__(message)
        self.message = message
        self.given = "" if given is _MISSING else show(given)
        self.expected = "" if expected is _MISSING else show(expected)
        self.got = "" if got is _MISSING else show(got)
        self.hint, self.misconception, self.credit = hint, misconception, credit


class CannotCrossError(TypeError):
    """A test hands student code something that cannot be sent to the student's process."""


def show(value: Any, limit: int = _LONGEST) -> str:
    """Return ``value`` as short readable text; never raises, whatever the object's ``__repr__`` does."""
    if isinstance(value, str):
        text = value
    else:
        try:
            is_array = not _is_proxy(value) and hasattr(value, "shape") and hasattr(value, "dtype")
            text = _show_array(value) if is_array else _REPR.repr(value)
        except Exception as error:
            text = f"<{type_name(value)} whose repr raises {type(error).__name__}>"
    return text if len(text) <= limit else text[: limit - 1] + "…"


def _is_proxy(value: Any) -> bool:
    """Whether ``value`` stands for an object of the student's process, which must not be asked what it is."""
    proxies = sys.modules.get("robotbrain.grading.remote.proxies")  # without this module there are none
    return proxies is not None and type(value) is proxies.Proxy


def type_name(value: Any) -> str:
    """The name of a value's type; while grading, of a student's object the name that its process gave."""
    return (
        sys.modules["robotbrain.grading.remote.proxies"].type_name(value) if _is_proxy(value) else type(value).__name__
    )


class _Repr(reprlib.Repr):
    """``reprlib`` that trusts a dataclass's own repr: it abbreviates by length, not by depth."""

    def __init__(self) -> None:
        super().__init__()
        self.maxlist = self.maxtuple = self.maxdict = self.maxset = self.maxfrozenset = 12
        self.maxstring = self.maxother = _LONGEST

    def repr_instance(self, x: Any, level: int) -> str:
        return repr(x)


_REPR = _Repr()


def _show_array(value: Any) -> str:
    import numpy as np

    array = np.asarray(value)
    body = np.array2string(array, precision=5, threshold=20, edgeitems=3, separator=", ", max_line_width=76)
    return body if array.ndim == 0 else f"{body}  (shape {array.shape}, {array.dtype})"


def readable(text: str) -> str:
    """``text`` without what cannot be written to a file or would steer a terminal."""
    printable = (c if c.isprintable() or c in "\n\t" else "\ufffd" for c in text)
    return "".join(printable)


def fail(
    message: str,
    *,
    given: Any = _MISSING,
    expected: Any = _MISSING,
    got: Any = _MISSING,
    hint: str = "",
    misconception: str = "",
    credit: float = 0.0,
) -> None:
    """Fail the test with ``message``; the other arguments are those of :class:`CheckFailure`."""
    raise CheckFailure(
        message,
        given=given,
        expected=expected,
        got=got,
        hint=hint,
        misconception=misconception,
        credit=credit,
    )


def expect(
    condition: Any,
    message: str = "",
    *,
    got: Any = _MISSING,
    expected: Any = _MISSING,
    given: Any = _MISSING,
    hint: str = "",
    misconception: str = "",
    credit: float = 0.0,
) -> None:
    """Fail the test unless ``condition`` is true.

    Args:
        condition: anything with a truth value. One without (an array of several elements) is a failure of its
            own that says so, for a student's function often returns an array where a number is due.
        message: one sentence on what is wrong; without it the report shows ``got`` beside ``expected``.
        credit: fraction of the test's points kept when this expectation is not met.
    """
    try:
        holds = bool(condition)
    except Exception as error:
        holds, message = False, f"the answer has no single truth value ({error})"
    if not holds:
        fail(
            message or "the answer is not the one expected",
            given=given,
            expected=expected,
            got=got,
            hint=hint,
            misconception=misconception,
            credit=credit,
        )


def expect_close(
    got: Any,
    expected: Any,
    *,
    atol: float = 1e-8,
    rtol: float = 1e-6,
    given: Any = _MISSING,
    hint: str = "",
    misconception: str = "",
    credit: float = 0.0,
    what: str = "the answer",
) -> None:
    """Fail the test unless ``got`` equals ``expected`` to within ``atol + rtol * |expected|``, element by element.

    A wrong type, shape, length or a NaN is named as such, and so is a usual slip (units, sign, order) where
    ``misconception`` names none. Infinities match infinities of the same sign, and a
    NaN matches where ``expected`` has one.
    """
    import numpy as np

    kept = {"given": given, "hint": hint, "credit": credit}
    target = np.asarray(expected)
    if got is None:
        fail(
            f"{what} is None: does your function return it?",
            expected=expected,
            got="None",
            misconception=misconception,
            **kept,
        )
    try:
        array = np.asarray(got)
        if array.dtype == object or array.dtype.kind not in "biufc":
            raise TypeError
        numbers = array.astype(complex if array.dtype.kind == "c" else float)
    except Exception:
        wanted = "a number" if target.ndim == 0 else f"numbers of shape {target.shape}"
        fail(
            f"{what} should be {wanted}, but is of type {type_name(got)}",
            expected=expected,
            got=got,
            misconception=misconception,
            **kept,
        )
    wrong = _what_differs(numbers, target, rtol, atol)
    if wrong:
        slip = misconception or likely_slip(numbers, target)
        fail(f"{what} {wrong}", expected=expected, got=got, misconception=slip, **kept)


def _what_differs(numbers: Any, target: Any, rtol: float, atol: float) -> str:
    """How an answer differs from what is expected, as the rest of a sentence, or ``""``."""
    import numpy as np

    if numbers.shape != target.shape:
        return f"has shape {numbers.shape}, but shape {target.shape} is expected"
    stray = np.isnan(numbers) & ~np.isnan(target)
    if stray.any():
        return "contains NaN" + ("" if numbers.ndim == 0 else f" (first at index {_first(stray)})")
    wrong = ~np.isclose(numbers, target, rtol=rtol, atol=atol, equal_nan=True)
    if not wrong.any():
        return ""
    if numbers.ndim == 0:
        return "is not close enough"
    at = _first(wrong)
    return (
        f"differs in {int(wrong.sum())} of {wrong.size} values, first at index {at}: "
        f"{numbers[at]:.6g} instead of {target[at]:.6g}"
    )


def _first(mask: Any) -> tuple[int, ...]:
    import numpy as np

    return tuple(int(i) for i in np.argwhere(mask)[0])

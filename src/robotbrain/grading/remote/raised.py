"""Exceptions that student code raised in its own process, as a test meets them."""

from __future__ import annotations

import builtins
import functools
from typing import Any

from robotbrain.grading.limits import EndedFromOutsideError

_LONGEST = {"type_name": 80, "message": 2_000, "function": 100, "text": 200}
_STANDING_APART = (StopIteration, StopAsyncIteration, GeneratorExit, KeyboardInterrupt)


class StudentGone(EndedFromOutsideError):  # noqa: N818 - an event, not an error of the program
    """The student's process ended or broke the connection."""


class StudentInterrupted(EndedFromOutsideError):  # noqa: N818
    """The executor interrupted the student's code, for its time was up."""


class RemoteRaised(Exception):  # noqa: N818 - a mark on exceptions of any kind
    """Mark of an exception that student code raised.

    An instance is also of the builtin type that was raised, where there is one: ``except ValueError`` works. All
    attributes come from the student's process: they are short and harmless, but may say anything.

    Attributes:
        type_name: the class's name as the student's process gave it.
        message: its text.
        function, line, text: where in the notebook's code, or ``""`` and 0 where that is not known.
    """

    type_name: str
    message: str
    function: str
    line: int
    text: str

    def __str__(self) -> str:
        return self.message


class RemoteError(RemoteRaised):
    """Student code raised an exception of a class of its own or of some library."""


def make_raised(kind: str, type_name: str, message: str, function: str, line: int, text: str) -> BaseException:
    """The exception to raise in a test for one that student code raised.

    Args:
        kind: the builtin type that it is, or is derived from.
    """
    given = {"type_name": type_name, "message": message, "function": function, "text": text}
    error: RemoteRaised = _class_for(kind)()
    for name, value in given.items():
        setattr(error, name, value[: _LONGEST[name]])
    error.line = line if 0 <= line < 10**6 else 0
    return error


@functools.cache
def _known() -> dict[str, type[BaseException]]:
    found = {
        name: kind
        for name, kind in vars(builtins).items()
        if isinstance(kind, type) and issubclass(kind, BaseException) and kind.__name__ == name
    }
    return {name: kind for name, kind in found.items() if kind not in _STANDING_APART and _can_be_made(kind)}


def _can_be_made(kind: type[BaseException]) -> bool:
    try:
        kind()
    except TypeError:
        return False
    return True


_CLASSES: dict[str, Any] = {}


def _class_for(kind: str) -> Any:
    base = _known().get(kind)
    if base is None or base in (Exception, BaseException):
        return RemoteError
    if kind not in _CLASSES:
        _CLASSES[kind] = type(kind, (RemoteRaised, base), {"__module__": __name__})
    return _CLASSES[kind]


def kind_of(error: BaseException) -> str:
    """The nearest builtin type of ``error`` that an exception can be made of."""
    return next(kind.__name__ for kind in type(error).__mro__ if _known().get(kind.__name__) is kind)

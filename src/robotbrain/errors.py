"""Errors that say what was given, what was expected, and what to do next."""

from __future__ import annotations


class RobotBrainError(Exception):
    """Base class of every error this kit raises on purpose."""


class InputError(RobotBrainError, ValueError):
    """Something handed to the kit cannot be used.

    Args:
        what: the thing at fault in the reader's words, e.g. ``"scan.ranges"``.
        given: what was received (shown with ``repr``, shortened).
        expected: what would have been accepted.
        fix: the next step for the person reading the message.
    """

    def __init__(self, what: str, *, given: object, expected: str, fix: str) -> None:
        shown = repr(given)
        if len(shown) > 200:
            shown = shown[:197] + "..."
        self.what, self.given, self.expected, self.fix = what, given, expected, fix
        super().__init__(f"{what}: got {shown}; expected {expected}. {fix}")

    def __reduce__(self) -> tuple[object, ...]:
        return (_rebuild, (type(self), self.what, self.given, self.expected, self.fix))


class MissingDependencyError(RobotBrainError, ImportError):
    """An optional package or program is not installed.

    Args:
        name: the package or program.
        needed_for: what it would have been used for.
        install: the command that installs it.
    """

    def __init__(self, name: str, *, needed_for: str, install: str) -> None:
        self.package, self.needed_for, self.install = name, needed_for, install
        super().__init__(f"{name} is not installed; it is needed for {needed_for}. Install it with: {install}")


def _rebuild(cls: type[InputError], what: str, given: object, expected: str, fix: str) -> InputError:
    return cls(what, given=given, expected=expected, fix=fix)

"""A test's view of the student's notebook."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from robotbrain.grading.expect import CheckFailure

if TYPE_CHECKING:
    import numpy as np

STUDENT_VARIABLE = "NBGRADER_STUDENT"


class Student:
    """Gives a test the objects a student defined: ``student.astar`` or ``student["astar"]``.

    A name that is not defined fails the test with advice. While a test runs, names provided by an upstream exercise
    that failed hold the reference, both here and in the notebook itself, so that functions calling them work.

    Args:
        namespace: the notebook's global variables (read at access, never copied).
        suite_name: for seeds.
        references: upstream names that hold the reference at present.
    """

    def __init__(self, namespace: Mapping[str, Any], suite_name: str, references: frozenset[str]) -> None:
        self._namespace, self._suite_name, self._references = namespace, suite_name, references

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):  # protocol look-ups such as copy's are no questions about the student
            raise AttributeError(name)
        return self[name]

    def __getitem__(self, name: str) -> Any:
        try:
            return self._namespace[name]
        except KeyError:
            raise CheckFailure(
                f"`{name}` is not defined: run the cell that defines it (and see that the cell ran without an error)"
            ) from None

    def has(self, name: str) -> bool:
        """Whether the student defined ``name``."""
        return name in self._namespace

    def part(self, name: str) -> Any:
        """An upstream exercise's object: the student's if it passed all its tests, else the reference."""
        return self[name]

    def uses_reference(self, name: str) -> bool:
        """Whether :meth:`part` gives the reference for ``name``."""
        return name in self._references

    @property
    def files(self) -> Path:
        """The folder with the files the student handed in beside the notebook; a test reads them from here."""
        return Path.cwd()

    def hold(self, value: Any) -> Any:
        """Return ``value`` to be passed as an argument and looked at afterwards with :meth:`fetch`.

        While grading, arguments are copies on the student's side; a held one stays there, so that a test can see what
        the student's code changed in it. In the notebook itself it is the value.
        """
        return value

    def fetch(self, held: Any) -> Any:
        """The value of what :meth:`hold` returned, as it is now."""
        return held

    def run(self, probe: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
        """Call ``probe(student, *args, **kwargs)`` where the student's objects live, and return its answer.

        For what needs the student's process, such as gradients through a student's loss. ``probe`` is a function at
        module level of a visible suite; it holds inputs at most, never an expected answer, for students can read it.
        """
        return probe(self, *args, **kwargs)

    def rng(self, label: str = "") -> np.random.Generator:
        """A generator seeded by the suite, ``label`` and the student being graded (``NBGRADER_STUDENT``, if set)."""
        import numpy as np

        text = "\0".join((self._suite_name, label, os.environ.get(STUDENT_VARIABLE, "")))
        return np.random.default_rng(int.from_bytes(hashlib.sha256(text.encode()).digest()[:16], "little"))

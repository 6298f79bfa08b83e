"""A lab's tests: exercises, points, hints and references, declared with decorators.

A visible suite lives in ``robotbrain/grading/suites/<lab>.py`` (or in a folder named by ``ROBOTBRAIN_SUITES``) and
ships to students; the hidden tests of the same lab live in ``<autograder>/hidden/<lab>.py``, begin with
``Suite.extending("<lab>")`` and never ship. Either module must define ``suite``.
"""

from __future__ import annotations

import copy
import dataclasses
import enum
import functools
import importlib
import importlib.util
import json
import os
import re
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar

from robotbrain.errors import InputError

SUITES_VARIABLE = "ROBOTBRAIN_SUITES"
AUTOGRADER_VARIABLE = "ROBOTBRAIN_AUTOGRADER"
_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")

TestFunction = Callable[[Any], Any]
Warmer = TypeVar("Warmer", bound=Callable[[], object])


@dataclass(frozen=True)
class Exercise:
    """One graded part of a lab.

    Attributes:
        points: the total of its tests, visible and hidden.
        upstream: exercises whose results it builds on; where they fail, the reference stands in.
        provides: names the student defines here and later exercises may use.
    """

    name: str
    title: str
    points: float
    upstream: tuple[str, ...] = ()
    provides: tuple[str, ...] = ()


@dataclass(frozen=True)
class Test:
    """One test of one exercise; ``function`` takes a :class:`~robotbrain.grading.student.Student`."""

    __test__ = False  # the name begins with "Test", but this is no pytest class

    exercise: str
    name: str
    points: float
    function: TestFunction
    hint: str = ""
    reread: str = ""
    success: str = ""
    time_limit_s: float = 5.0
    hidden: bool = False


@dataclass(frozen=True)
class Ban:
    """What an exercise's answer must not be made of: modules, less the ``allow``-ed names in them."""

    imports: tuple[str, ...]
    allow: tuple[str, ...] = ()


class Suite:
    """The tests of one lab.

    Args:
        name: the lab's name, a Python identifier, e.g. ``"lab_integration"``.
    """

    def __init__(self, name: str) -> None:
        if not _NAME.fullmatch(name):
            raise InputError("suite name", given=name, expected="a Python identifier", fix="Use e.g. lab_integration.")
        self.name = name
        self.exercises: dict[str, Exercise] = {}
        self.tests: list[Test] = []
        self.hints: dict[str, str] = {}
        self.references: dict[str, str | Callable[[], Any]] = {}
        self.bans: dict[str, Ban] = {}
        self.warmers: list[Callable[[], object]] = []
        self.student_warmers: list[Callable[[], object]] = []
        self.crossing: list[type] = []
        self.hidden_by_default = False

    @classmethod
    def extending(cls, name: str) -> Suite:
        """Return a copy of the visible suite ``name``; tests added to it are hidden unless they say otherwise."""
        visible = load_suite(name)
        suite = copy.copy(visible)
        suite.exercises, suite.tests = dict(visible.exercises), list(visible.tests)
        suite.hints, suite.references = dict(visible.hints), dict(visible.references)
        suite.bans = dict(visible.bans)
        suite.warmers, suite.crossing = list(visible.warmers), list(visible.crossing)
        suite.hidden_by_default = True
        return suite

    def exercise(
        self,
        name: str,
        *,
        title: str = "",
        points: float,
        upstream: tuple[str, ...] = (),
        provides: tuple[str, ...] | None = None,
    ) -> Exercise:
        """Declare an exercise. ``provides`` defaults to the exercise's own name; upstream ones come first."""
        if name in self.exercises:
            raise self._error(f"exercise {name!r}", "declared twice", "one declaration", "Remove one.")
        for other in upstream:
            if other not in self.exercises:
                raise self._error(
                    f"upstream of {name!r}",
                    other,
                    "an exercise declared before it",
                    f"Declare {other!r} first, or correct the name.",
                )
        if not points > 0:
            raise self._error(f"points of {name!r}", points, "more than 0", "Give it points.")
        entry = Exercise(name, title or name, float(points), tuple(upstream), tuple(provides or (name,)))
        for provided in entry.provides:
            owner = self.provider(provided)
            if owner is not None:
                raise self._error(
                    f"provides of {name!r}",
                    provided,
                    "a name no other exercise provides",
                    f"{owner.name!r} already provides it.",
                )
        self.exercises[name] = entry
        return entry

    def hint(self, key: str, text: str) -> str:
        """Register a hint and return its key; tests and expectations name it by key."""
        if not re.fullmatch(r"[a-z0-9]+(-[a-z0-9]+)*", key):
            raise self._error("hint key", key, "words-joined-by-hyphens", "Use e.g. diagonal-cost.")
        if self.hints.setdefault(key, text) != text:
            raise self._error("hint key", key, "one text per key", "Choose another key.")
        return key

    def reference(self, name: str, source: str | Callable[[], Any]) -> None:
        """Register the reference for a provided name: ``"package.module:attribute"`` or a function returning it."""
        if isinstance(source, str) and source.count(":") != 1:
            raise self._error(f"reference {name!r}", source, '"package.module:attribute"', "Add the colon.")
        self.references[name] = source

    def forbid(self, exercise: str, *, imports: tuple[str, ...], allow: tuple[str, ...] = ()) -> None:
        """Refuse an answer to ``exercise`` that is, wraps, or imports what ``imports`` (module names) contains.

        ``allow`` lists names from those modules that students may use.
        """
        self._known(exercise)
        self.bans[exercise] = Ban(tuple(imports), tuple(allow))

    def warm(self, function: Warmer) -> Warmer:
        """Register ``function()`` (a decorator) to run once before the first submission of a class.

        Use it to import what is heavy and to fill caches of fixtures and oracles: each submission's tester then starts
        from a process that has them. Nothing may depend on its having run.
        """
        self.warmers.append(function)
        return function

    def warm_students(self, function: Warmer) -> Warmer:
        """Register ``function()`` (a decorator) to run once in the process that students' processes are copied from.

        Use it, in a visible suite, to do for the first time what costs more the first time: imports inside of
        functions, a library's first training step. It must hold no answers, and leave random generators alone.
        """
        self.student_warmers.append(function)
        return function

    def crosses(self, *classes: type) -> None:
        """Let instances of ``classes`` (dataclasses or enums) come back by value when a student's code returns one.

        Without this a test gets a stand-in that asks the student's process for each attribute. An instance is rebuilt
        field by field, its ``__post_init__`` included.
        """
        for cls in classes:
            if not isinstance(cls, type) or not (dataclasses.is_dataclass(cls) or issubclass(cls, enum.Enum)):
                raise self._error("crosses", cls, "a dataclass or an enum", "Name the class, or return plain values.")
            if cls not in self.crossing:
                self.crossing.append(cls)

    def ban_of(self, exercise: str) -> Ban:
        """What an answer to ``exercise`` must not be made of: as declared, the references and the tests themselves."""
        declared = self.bans.get(exercise, Ban((), ("Lab",)))
        sources = (self.references.get(name) for name in self._known(exercise).provides)
        references = (source.replace(":", ".") for source in sources if isinstance(source, str))
        return Ban((*declared.imports, "robotbrain.grading", *references), declared.allow)

    def test(
        self,
        exercise: str,
        *,
        points: float,
        name: str = "",
        hint: str = "",
        reread: str = "",
        success: str = "",
        time_limit_s: float = 5.0,
        hidden: bool | None = None,
    ) -> Callable[[TestFunction], TestFunction]:
        """Register the decorated ``function(student)`` as a test of ``exercise``.

        Args:
            points: what it is worth; a test may return a fraction in ``[0, 1]`` of them (or a bool; None means all).
            name: shown to the student, also when hidden; defaults to the function's name with spaces.
            hint: key of a registered hint, or the hint itself; shown when the test fails.
            reread: where in the notebook to look again.
            success: shown when it passes.
            time_limit_s: wall time (s) after which the test is interrupted.
            hidden: default: False in a visible suite, True after :meth:`extending`.
        """
        self._known(exercise)

        def register(function: TestFunction) -> TestFunction:
            shown = name or function.__name__.replace("_", " ").strip()
            if any(t.exercise == exercise and t.name == shown for t in self.tests):
                raise self._error(f"test of {exercise!r}", shown, "a name not used before", "Rename one of the two.")
            if not points > 0 or not time_limit_s > 0:
                raise self._error(
                    f"test {shown!r}", (points, time_limit_s), "points > 0, time_limit_s > 0", "Correct it."
                )
            is_hidden = self.hidden_by_default if hidden is None else hidden
            self.tests.append(
                Test(
                    exercise,
                    shown,
                    float(points),
                    function,
                    hint,
                    reread,
                    success,
                    float(time_limit_s),
                    is_hidden,
                )
            )
            return function

        return register

    def tests_of(self, exercise: str, *, hidden: bool) -> list[Test]:
        """Tests of ``exercise`` in order of declaration, hidden ones only on request."""
        self._known(exercise)
        return [t for t in self.tests if t.exercise == exercise and (hidden or not t.hidden)]

    def provider(self, name: str) -> Exercise | None:
        """The exercise that provides ``name``, or None."""
        return next((e for e in self.exercises.values() if name in e.provides), None)

    def ancestors(self, exercise: str) -> list[str]:
        """Every exercise that ``exercise`` builds on, direct or not, in order of declaration."""
        found: set[str] = set()
        todo = list(self._known(exercise).upstream)
        while todo:
            name = todo.pop()
            if name not in found:
                found.add(name)
                todo.extend(self.exercises[name].upstream)
        return [name for name in self.exercises if name in found]

    def load_reference(self, name: str) -> Any:
        """Return the reference object for a provided ``name``; raises ``KeyError`` if none is registered."""
        source = self.references[name]
        if callable(source):
            return source()
        module, _, attribute = source.partition(":")
        return functools.reduce(getattr, attribute.split("."), importlib.import_module(module))

    def hint_text(self, hint: str) -> str:
        """The text behind a hint key; a hint written inline is its own text."""
        return self.hints.get(hint, hint)

    def validate(self, *, complete: bool) -> None:
        """Check that points add up and references belong to something.

        Args:
            complete: True for a suite with its hidden tests, whose points must sum to the exercise's exactly;
                a visible suite may leave points to the hidden tests but not exceed them.
        """
        for name, exercise in self.exercises.items():
            tests = [t for t in self.tests if t.exercise == name]
            total = sum(t.points for t in tests)
            if abs(total - exercise.points) > 1e-6 if complete else total > exercise.points + 1e-6:
                listed = ", ".join(f"{t.name!r} {t.points:g}" for t in tests) or "no tests"
                raise self._error(
                    f"points of {name!r}",
                    f"{total:g} ({listed})",
                    f"{'exactly' if complete else 'at most'} {exercise.points:g}",
                    "Change a test's points or the exercise's.",
                )
            if not any(not t.hidden for t in tests):
                raise self._error(
                    f"exercise {name!r}", "no visible test", "at least one", "Students need a check to run."
                )
        for name in self.references:
            if self.provider(name) is None:
                raise self._error("reference", name, "a name that some exercise provides", "List it in provides=.")
        for test in self.tests:
            if re.fullmatch(r"[a-z0-9]+(-[a-z0-9]+)+", test.hint) and test.hint not in self.hints:
                raise self._error(
                    f"hint of test {test.name!r}",
                    test.hint,
                    "a registered key",
                    f"Call suite.hint({test.hint!r}, ...) before.",
                )

    def _known(self, exercise: str) -> Exercise:
        if exercise not in self.exercises:
            raise self._error(
                "exercise",
                exercise,
                f"one of {', '.join(self.exercises) or 'none declared yet'}",
                "Correct the name.",
            )
        return self.exercises[exercise]

    def _error(self, what: str, given: object, expected: str, fix: str) -> InputError:
        return InputError(f"suite {self.name}: {what}", given=given, expected=expected, fix=fix)


def load_suite(name: str) -> Suite:
    """Load the visible suite of lab ``name`` from the package or a folder in ``ROBOTBRAIN_SUITES``."""
    if not _NAME.fullmatch(name):
        raise InputError("lab name", given=name, expected="a Python identifier", fix="Use e.g. lab_integration.")
    module_name = f"robotbrain.grading.suites.{name}"
    try:
        module = importlib.import_module(module_name)
    except ModuleNotFoundError as error:
        if error.name not in {module_name, "robotbrain.grading.suites"}:
            raise
        folders = [Path(p) for p in os.environ.get(SUITES_VARIABLE, "").split(os.pathsep) if p]
        path = next((p for f in folders if (p := f / f"{name}.py").is_file()), None)
        if path is None:
            raise InputError(
                "lab name",
                given=name,
                expected="a lab whose tests are installed",
                fix=f"Check the spelling, update robotbrain, or add its folder to {SUITES_VARIABLE}.",
            ) from None
        module = load_file(path, f"_robotbrain_suite_{name}")
    suite = _suite_in(module, name)
    suite.validate(complete=False)
    return suite


def load_hidden_suite(name: str, folder: str | Path | None = None) -> Suite:
    """Load the complete suite of lab ``name``, hidden tests included.

    Args:
        folder: the autograder folder; default: ``ROBOTBRAIN_AUTOGRADER``, else the ``autograder`` folder beside or
            above the working directory, so that an instructor can run a solution notebook where it lies.
    """
    path = hidden_path(name, folder)
    if path is None:
        raise InputError(
            f"hidden tests of {name}",
            given=str(folder or os.environ.get(AUTOGRADER_VARIABLE, "no autograder folder")),
            expected=f"a folder that holds hidden/{name}.py",
            fix=f"Hidden tests run only while grading: use `robotbrain grade`, or set {AUTOGRADER_VARIABLE}.",
        )
    suite = _suite_in(load_file(path, f"_robotbrain_hidden_{name}"), name)
    suite.validate(complete=True)
    return suite


def hidden_path(name: str, folder: str | Path | None = None) -> Path | None:
    """The file with the hidden tests of lab ``name``, or None where there is none."""
    chosen = folder or os.environ.get(AUTOGRADER_VARIABLE)
    here = Path.cwd()
    folders = [Path(chosen)] if chosen else [p / "autograder" for p in (here, *here.parents)]
    return next((p for f in folders if (p := f / "hidden" / f"{name}.py").is_file()), None)


def instructors_code(autograder: Path, lab: str) -> Iterator[str]:
    """The code cells of the instructor's notebooks of ``lab``, most of which are in every submission too."""
    for path in sorted((autograder.parent / "solutions" / lab).glob("*.ipynb")):
        for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
            if cell["cell_type"] == "code":
                yield "".join(cell["source"])


def load_file(path: Path, module_name: str) -> ModuleType:
    """Import the Python file at ``path`` under ``module_name``, whether or not it was imported before."""
    spec = importlib.util.spec_from_file_location(module_name, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[module_name] = module  # dataclasses and inspect look modules up by name
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[module_name]
        raise
    return module


def _suite_in(module: ModuleType, name: str) -> Suite:
    suite = getattr(module, "suite", None)
    if not isinstance(suite, Suite) or suite.name != name:
        raise InputError(
            f"tests of {name}",
            given=getattr(suite, "name", suite),
            expected=f"a variable `suite` that holds Suite({name!r})",
            fix=f"Define it in {Path(str(module.__file__)).name}.",
        )
    return suite

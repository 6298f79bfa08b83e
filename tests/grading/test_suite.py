from __future__ import annotations

from pathlib import Path

import pytest

from robotbrain.errors import InputError
from robotbrain.grading import Suite, load_hidden_suite, load_suite


def nothing(student: object) -> None:
    """A test that always passes."""


def test_visible_points_may_leave_room_and_complete_ones_must_sum() -> None:
    suite = Suite("demo")
    suite.exercise("one", points=4)
    suite.test("one", points=3, name="a")(nothing)
    suite.validate(complete=False)
    with pytest.raises(InputError, match=r"3 \('a' 3\).*exactly 4"):
        suite.validate(complete=True)
    suite.test("one", points=1, name="b", hidden=True)(nothing)
    suite.validate(complete=True)
    suite.test("one", points=1, name="c")(nothing)
    with pytest.raises(InputError, match="at most 4"):
        suite.validate(complete=False)


def test_an_exercise_without_a_visible_test_is_refused() -> None:
    suite = Suite("demo")
    suite.exercise("one", points=4)
    suite.test("one", points=4, hidden=True)(nothing)
    with pytest.raises(InputError, match="no visible test"):
        suite.validate(complete=True)


def test_declarations_are_checked_where_they_are_made() -> None:
    suite = Suite("demo")
    suite.exercise("one", points=4)
    with pytest.raises(InputError, match="twice"):
        suite.exercise("one", points=1)
    with pytest.raises(InputError, match="declared before"):
        suite.exercise("two", points=1, upstream=("three",))
    with pytest.raises(InputError, match="already provides"):
        suite.exercise("two", points=1, provides=("one",))
    with pytest.raises(InputError, match="one of one"):
        suite.test("onne", points=1)
    with pytest.raises(InputError, match="colon"):
        suite.reference("one", "module.attribute")
    suite.test("one", points=1, name="same")(nothing)
    with pytest.raises(InputError, match="name not used before"):
        suite.test("one", points=1, name="same")(nothing)
    suite.test("one", points=1, hint="no-such-hint")(nothing)
    with pytest.raises(InputError, match="registered key"):
        suite.validate(complete=False)


def test_ancestors_are_transitive_and_in_order() -> None:
    suite = Suite("demo")
    suite.exercise("a", points=1)
    suite.exercise("x", points=1)
    suite.exercise("b", points=1, upstream=("a",))
    suite.exercise("c", points=1, upstream=("b",))
    assert suite.ancestors("c") == ["a", "b"]
    assert suite.ancestors("a") == []


def test_references_are_loaded_from_where_they_say() -> None:
    suite = Suite("demo")
    suite.exercise("a", points=1, provides=("hypot", "made"))
    suite.reference("hypot", "math:hypot")
    suite.reference("made", lambda: 42)
    import math

    assert suite.load_reference("hypot") is math.hypot
    assert suite.load_reference("made") == 42


def test_hidden_tests_do_not_enter_the_visible_suite() -> None:
    complete = load_hidden_suite("toy")
    visible = load_suite("toy")
    assert {t.name for t in complete.tests} > {t.name for t in visible.tests}
    assert not any(t.hidden for t in visible.tests)
    assert all("SECRET" not in t.name for t in complete.tests)
    assert len(load_hidden_suite("toy").tests) == len(complete.tests)


def test_unknown_lab_and_missing_hidden_folder_are_explained(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="lab whose tests are installed"):
        load_suite("no_such_lab")
    with pytest.raises(InputError, match="Hidden tests run only while grading"):
        load_hidden_suite("toy", tmp_path)

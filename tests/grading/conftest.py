from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from robotbrain.grading.bench import Bench
from robotbrain.grading.suite import AUTOGRADER_VARIABLE, SUITES_VARIABLE
from tests.grading import toylab


@pytest.fixture(scope="session")
def course_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return toylab.make_course(tmp_path_factory.mktemp("course"))


@pytest.fixture(autouse=True, scope="session")
def _toy_suite(course_root: Path) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(SUITES_VARIABLE, str(course_root / "suites"))
        patch.setenv(AUTOGRADER_VARIABLE, str(course_root / "autograder"))
        beside = str(Path(sys.executable).parent)  # nbgrader's gradebook calls `alembic`; no environment is activated
        patch.setenv("PATH", os.pathsep.join((beside, os.environ.get("PATH", os.defpath))))
        yield


@pytest.fixture(autouse=True)
def _toy_hidden_tests(course_root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Tests of other folders may have graded in this process meanwhile, and so have named another folder."""
    monkeypatch.setenv(AUTOGRADER_VARIABLE, str(course_root / "autograder"))


@pytest.fixture
def notebook_globals() -> dict[str, object]:
    return {"__name__": "__main__"}


@pytest.fixture(scope="session")
def light_bench(course_root: Path) -> Callable[..., Bench]:
    """Makes benches of the toy course, whose servers start quickly: without torch, MuJoCo and the like."""

    def make(**options: Any) -> Bench:
        usual = {"preload_labs": [toylab.LAB], "preload": ["numpy", "matplotlib.pyplot"]}
        return Bench(course_root / "autograder", **{**usual, **options})

    return make


@pytest.fixture(scope="session")
def toy_bench(light_bench: Callable[..., Bench]) -> Iterator[Bench]:
    """One bench for all tests of this process; set its ``limits`` before use."""
    with light_bench() as bench:
        yield bench

"""The course's own labs against what is worth trying on them: the reference as one's own, and forged files."""

from __future__ import annotations

import copy
import functools
import os
from collections.abc import Callable, Iterator, Mapping

import nbformat
import pytest
from nbformat.notebooknode import NotebookNode
from nbformat.v4 import new_code_cell

from robotbrain.grading import course, intake, jobs, sample
from robotbrain.grading.bench import Bench
from robotbrain.grading.execute import Limits
from robotbrain.grading.marks import marks_of
from robotbrain.grading.suite import AUTOGRADER_VARIABLE, load_suite
from tests.grading.attacks import patching
from tests.grading.attacks.vault import REPOSITORY

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1800)]
LABS = ("lab_integration", "hw1_rl", "hw2_optimisation", "hw3_performance")
LIMITS = Limits(cell_s=60.0, graded_s=120.0, grace_s=2.0, wall_s=600.0)
Grade = Callable[..., dict[str, float]]


@pytest.fixture(scope="module")
def home() -> Iterator[course.Course]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(AUTOGRADER_VARIABLE, str(REPOSITORY / "autograder"))
        yield course.find_course(REPOSITORY)


@pytest.fixture(scope="module")
def grade(home: course.Course, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Grade]:
    """Grades notebooks of a lab with files beside them: exercise -> points."""
    with Bench(home.autograder, limits=LIMITS, preload_labs=LABS) as bench:

        def run(lab: str, notebooks: Mapping[str, NotebookNode], files: Mapping[str, bytes]) -> dict[str, float]:
            folder = tmp_path_factory.mktemp(lab)
            for name, notebook in notebooks.items():
                (folder / name).write_text(nbformat.writes(notebook), encoding="utf-8")
            for name, data in files.items():
                (folder / name).write_bytes(data)
            task = jobs.Task("mallory", lab, home.sources(lab)[0], folder)
            healed, further = jobs.read_submission(home, task)
            done = jobs.run_job(healed, further, lab=lab, student="mallory", bench=bench)
            return {mark.exercise: mark.earned or 0.0 for mark in marks_of(done.notebook)}

        yield run


def _files(home: course.Course, lab: str) -> dict[str, bytes]:
    folder = home.autograder / "reference" / lab
    return {p.name: p.read_bytes() for p in folder.iterdir()} if folder.is_dir() else {}


def _answers(notebooks: Mapping[str, NotebookNode]) -> list[NotebookNode]:
    return [c for nb in notebooks.values() for c in nb.cells if sample._is_answer(c)]


@pytest.mark.parametrize("lab", LABS)
def test_the_courses_own_solutions_earn_nothing(home: course.Course, grade: Grade, lab: str) -> None:
    suite = load_suite(lab)
    taken = {}
    notebooks = sample.Reference(home, lab).copy()
    for cell in _answers(notebooks):
        provided = [n for n in suite.references if f"def {n}(" in cell.source or f"class {n}" in cell.source]
        for name in provided:
            reference = suite.references[name]
            if isinstance(reference, str):
                module, _, attribute = reference.partition(":")
                cell.source = f"from {module} import {attribute} as {name}"
                exercise = suite.provider(name)
                assert exercise is not None
                taken[exercise.name] = intake.grade_id(cell)
    assert taken
    earned = grade(lab, notebooks, _files(home, lab))
    assert {name: earned[name] for name in taken} == dict.fromkeys(taken, 0.0)
    assert sum(earned.values()) > 0  # what else is answered counts


@pytest.mark.parametrize("lab", LABS)
def test_references_out_of_the_suite_earn_nothing(home: course.Course, grade: Grade, lab: str) -> None:
    notebooks = sample.Reference(home, lab).copy()
    for cell in _answers(notebooks):
        cell.source = (
            "from robotbrain.grading.suite import load_suite\n"
            f"for _n in (_s := load_suite({lab!r})).references:\n    globals()[_n] = _s.load_reference(_n)"
        )
    earned = grade(lab, notebooks, {})
    assert sum(earned.values()) == 0


@pytest.mark.parametrize("lab", LABS)
def test_empty_answers_earn_nothing_in_a_patched_process(home: course.Course, grade: Grade, lab: str) -> None:
    notebooks = copy.deepcopy(sample.Reference(home, lab).stubs)
    for notebook in notebooks.values():
        patches = [a for a in patching.attacks() if a.extra and "first cell" in a.name and "sockets" not in a.name]
        for attack in patches[:12]:
            source = f"try:\n    exec({attack.extra[0][1]!r}, globals())\nexcept BaseException:\n    pass"
            notebook.cells.insert(0, new_code_cell(source))
    assert sum(grade(lab, notebooks, {}).values()) == 0


def _onnx(*, location: str = "", loop: bool = False, domain: str = "") -> bytes:
    """A small ONNX file that asks for more than it may: another file, a loop, a library of its own."""
    import numpy as np
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    weight = numpy_helper.from_array(np.zeros((4, 4), np.float32), "w")
    if location:
        weight.ClearField("raw_data")
        weight.data_location = TensorProto.EXTERNAL
        for key, value in (("location", location), ("offset", "0"), ("length", "64")):
            weight.external_data.add(key=key, value=value)
    node = helper.make_node("MatMul", ["x", "w"], ["y"], domain=domain)
    if loop:
        body = helper.make_graph(
            [helper.make_node("Identity", ["c"], ["d"])],
            "body",
            [helper.make_tensor_value_info(n, t, []) for n, t in (("i", TensorProto.INT64), ("c", TensorProto.BOOL))],
            [helper.make_tensor_value_info("d", TensorProto.BOOL, [])],
        )
        node = helper.make_node("Loop", ["", "", "x"], ["y"], body=body)
    shapes = [helper.make_tensor_value_info(n, TensorProto.FLOAT, ["n", 4]) for n in ("x", "y")]
    graph = helper.make_graph([node], "g", shapes[:1], shapes[1:], [weight])
    return bytes(onnx.helper.make_model(graph).SerializeToString())


_FORGED = {
    "nothing": lambda: b"",
    "text": lambda: b"import os; os.system('true')",
    "a pickle": lambda: b"cbuiltins\neval\n(V1\ntR.",
    "another file's weights": lambda: _onnx(location="../../../../../../etc/passwd"),
    "a loop": lambda: _onnx(loop=True),
    "a library": lambda: _onnx(domain="evil.library"),
    "zeros": lambda: _onnx(),
    "a truncated file": lambda: _onnx()[:-20],
    "megabytes": lambda: b"\x08\x08" + os.urandom(3_000_000),
}


@pytest.fixture(scope="module")
def without_files(home: course.Course, grade: Grade) -> Callable[[str], dict[str, float]]:
    """What a lab's right notebook earns without the files that belong to it."""
    return functools.cache(lambda lab: grade(lab, sample.Reference(home, lab).copy(), {}))


@pytest.mark.parametrize("what", _FORGED)
@pytest.mark.parametrize(("lab", "exercise"), [("hw1_rl", "policy"), ("hw2_optimisation", "student")])
def test_forged_files_are_worth_no_more_than_none(
    home: course.Course,
    grade: Grade,
    without_files: Callable[[str], dict[str, float]],
    lab: str,
    exercise: str,
    what: str,
) -> None:
    files = dict.fromkeys(_files(home, lab), _FORGED[what]())
    assert files
    earned = grade(lab, sample.Reference(home, lab).copy(), files)
    assert earned[exercise] == 0
    assert earned == without_files(lab)

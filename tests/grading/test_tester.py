"""The tester: scores and cells of assertions, against students' processes that work, lie, hang or die."""

from __future__ import annotations

import contextlib
import socket
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from nbformat.notebooknode import from_dict
from nbformat.v4 import new_code_cell
from nbgrader.utils import determine_grade

from robotbrain.grading.remote import peer as peers
from robotbrain.grading.remote.serve import Server, serve
from robotbrain.grading.report import SCORE_MIME
from robotbrain.grading.suite import AUTOGRADER_VARIABLE
from robotbrain.grading.tester import process
from robotbrain.grading.tester.cells import definitions, hidden_lines, run_cell, visible_part
from robotbrain.grading.tester.control import Control
from tests.grading import toylab

SOLVED = "\n".join(toylab.SOLUTIONS.values())


class Executor:
    """The other end of the tester's control connection, and the students' processes, as threads of this process."""

    def __init__(self, course: Path, sources: list[dict[str, Any]] | None = None) -> None:
        self.sock, theirs = socket.socketpair()
        self.control = Control(self.sock)  # both ends speak lines of JSON
        job = {"lab": "toy", "student": "amara", "autograder": str(course / "autograder"), "sources": sources or []}
        self.session = process.Session(job, Control(theirs))
        self.thread = threading.Thread(target=self._serve, daemon=True)
        self.thread.start()
        self.events: list[dict[str, Any]] = []
        self.gone: list[tuple[str, str | None]] = []  # why, and the source of the process that takes its place

    def _serve(self) -> None:
        with contextlib.suppress(process.ExecutorGone):
            self.session.serve()

    def student(self, source: str, number: int = 0) -> None:
        """Introduce a student's process."""
        ours, theirs = socket.socketpair()
        namespace: dict[str, Any] = {"__name__": "__main__", "die": theirs.close, "rpc": theirs}
        exec(compile(source, "notebook", "exec"), namespace)
        threading.Thread(target=_served, args=(theirs, namespace), daemon=True).start()
        socket.send_fds(self.sock, [b'{"op": "student", "student": %d}\n' % number], [ours.fileno()])
        ours.close()

    def ask(self, op: str, number: int = 0, **message: Any) -> list[dict[str, Any]]:
        """Have something done, and return its outputs."""
        self.control.send(op=op, student=number, **message)
        while True:
            event = self.control.receive()
            self.events.append(event)
            if event["event"] == "lost":
                why, fresh = self.gone.pop(0)
                self.control.send(op="gone", student=number, why=why, again=fresh is not None)
                if fresh is not None:
                    self.student(fresh, number)
            if event["event"] == "outputs":
                return list(event["outputs"])

    def score(self, exercise: str, hidden: bool, number: int = 0) -> dict[str, Any]:
        """The report on an exercise as JSON."""
        (output,) = self.ask("score", number, exercise=exercise, hidden=hidden)
        return dict(output["data"][SCORE_MIME])

    def both(self, exercise: str, number: int = 0) -> dict[str, Any]:
        """The complete report, visible tests first, as grading asks for it."""
        self.score(exercise, False, number)
        return self.score(exercise, True, number)


def _served(sock: socket.socket, namespace: dict[str, Any]) -> None:
    with contextlib.suppress(OSError, ValueError):
        serve(sock, namespace)


@pytest.fixture
def executor(course_root: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Executor]:
    monkeypatch.setenv(AUTOGRADER_VARIABLE, str(course_root / "autograder"))
    monkeypatch.setenv("NBGRADER_EXECUTION", "autograde")
    process._PREPARED.pop("toy", None)
    made = Executor(course_root)
    yield made
    made.sock.close()
    made.thread.join(10)
    process._PREPARED.pop("toy", None)


def verdicts(report: dict[str, Any]) -> list[str]:
    return [test["verdict"] for test in report["tests"]]


# ------------------------------------------------------------------ scores


def test_a_right_answer_gets_everything(executor: Executor) -> None:
    executor.student(SOLVED)
    assert [executor.both(name)["earned"] for name in ("scale", "total", "mean")] == [4.0, 6.0, 5.0]
    begun = [e for e in executor.events if e["event"] == "begun" and e["test"]]
    assert [e["test"] for e in begun].count("doubles a number") == 1  # a test runs once
    assert all(e["limit_s"] == 1.0 for e in begun)
    assert [e["event"] for e in executor.events].count("begun") == [e["event"] for e in executor.events].count("ended")


def test_nbgrader_reads_the_points_from_the_output(executor: Executor) -> None:
    executor.student(SOLVED.replace(" if values else 0.0", ""))
    executor.score("mean", False)
    cell = new_code_cell(
        'lab.score("mean")', outputs=[from_dict(o) for o in executor.ask("score", exercise="mean", hidden=True)]
    )
    cell.metadata["nbgrader"] = {"grade": True, "solution": False, "points": 5, "grade_id": "score-mean"}
    assert determine_grade(cell) == (3.0, 5.0)
    assert "<table" in cell.outputs[0].data["text/html"]


def test_the_reference_stands_in_for_a_wrong_part(executor: Executor) -> None:
    executor.student(SOLVED.replace("2 * x", "x ** 2"))
    assert executor.both("scale")["earned"] == 0.0
    report = executor.both("total")
    assert report["earned"] == 6.0 and report["substituted"] == ["scale"]
    assert executor.ask("cell", source="assert scale(3.0) == 9.0", hidden=False) == []  # their own is back


def test_results_of_one_process_stand_for_the_next(executor: Executor) -> None:
    executor.student(SOLVED)
    executor.student(SOLVED.replace("2 * x", "x ** 2"), 1)
    assert executor.both("scale", 0)["earned"] == 4.0
    report = executor.both("total", 1)
    assert report["substituted"] == [] and "scale" not in {e.get("exercise") for e in executor.events[-8:]}


def test_a_hidden_test_says_as_little_as_helps(executor: Executor) -> None:
    source = "class SecretError(ValueError): pass\ndef mean(values):\n    raise SecretError(repr(values))"
    executor.student(source)
    shown, hidden = executor.both("mean")["tests"]
    assert "SecretError" in shown["message"] and "[1.0, 3.0]" in shown["message"]
    assert hidden["message"] == "your code raised ValueError" and hidden["seconds"] == 0.0
    assert not {"given", "expected", "got", "misconception", "printed"} & set(hidden)


LEAK = """
import os
kept = []
def scale(x):
    kept.append(x)
    print(kept)
    return 2 * x
def total(values): return str(kept)
def mean(values): raise ValueError(kept)
"""


def test_after_the_first_hidden_test_nothing_of_the_student_is_shown(executor: Executor) -> None:
    executor.student(LEAK)
    executor.score("scale", False)
    executor.score("scale", True)
    outputs = [
        executor.ask("score", exercise=name, hidden=hidden) for name in ("total", "mean") for hidden in (False, True)
    ]
    outputs.append(executor.ask("cell", source="assert total(1) == 5", grade_id="a", hidden=True))
    assert "41.5" not in repr(outputs)


def test_visible_tests_show_what_the_student_printed(executor: Executor) -> None:
    executor.student("def scale(x):\n    print('look', x)\n    return 0")
    (result,) = executor.score("scale", False)["tests"]
    assert result["given"] == "x = 3.0" and result["got"] == "0" and result["hint_key"] == "square-not-double"


@pytest.mark.parametrize(("why", "verdict"), [("timeout", "timeout"), ("crashed", "crashed"), ("memory", "memory"),
                                              ("disturbed", "error")])  # fmt: skip
def test_a_process_that_ends_costs_the_test_that_ran(executor: Executor, why: str, verdict: str) -> None:
    source = SOLVED + "\ndef scale(x):\n    if x < 0:\n        die()\n        raise SystemExit\n    return 2 * x"
    executor.student(source)
    executor.gone = [(why, source)]
    report = executor.both("scale")
    assert verdicts(report) == ["passed", verdict] and report["earned"] == 2.0
    assert executor.both("mean")["earned"] == 5.0  # on the fresh process


def test_without_another_process_the_rest_is_not_run(executor: Executor) -> None:
    executor.student("def scale(x):\n    die()")
    executor.gone = [("crashed", None)]
    report = executor.both("scale")
    assert verdicts(report) == ["crashed", "crashed"] and "not run" in report["tests"][1]["message"]
    assert executor.both("mean")["earned"] == 0.0
    (output,) = executor.ask("cell", source="assert scale(1) == 2", hidden=False)
    assert output["output_type"] == "error"


def test_a_late_answer_is_a_timeout(executor: Executor) -> None:
    executor.student("import time\ndef scale(x):\n    time.sleep(1.2)\n    return 2 * x")
    assert verdicts(executor.score("scale", False)) == ["timeout"]


def test_an_interrupt_that_was_meant_for_another_test_costs_nothing(executor: Executor, monkeypatch: Any) -> None:
    answers = iter([peers.INTERRUPTED])
    handle = Server._handle

    def interrupted(self: Server, header: list[Any], blobs: Any) -> None:
        if header[2] == "call" and next(answers, None):
            self.send(peers.ERROR, header[1], [peers.INTERRUPTED, "", "", "", 0, ""])
        else:
            handle(self, header, blobs)

    monkeypatch.setattr(Server, "_handle", interrupted)
    executor.student(SOLVED)
    assert verdicts(executor.score("scale", False)) == ["passed"]


def test_an_unknown_exercise_is_the_courses_mistake(executor: Executor) -> None:
    executor.student(SOLVED)
    (output,) = executor.ask("score", exercise="scael", hidden=False)
    assert output["ename"] == "TestsBroken" and "scael" in executor.events[-1]["error"]


def test_the_text_of_an_answer_is_judged(course_root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(AUTOGRADER_VARIABLE, str(course_root / "autograder"))
    cells = [
        {"source": "from robotbrain.grading.suite import load_suite\nscale = load_suite('toy').load_reference('scale')"}
    ]
    executor = Executor(course_root, cells)
    executor.student("def scale(x): return 2 * x")  # what the process shows is another matter
    report = executor.both("scale")
    assert verdicts(report) == ["forbidden", "forbidden"] and report["earned"] == 0
    executor.sock.close()


class Liar(Server):
    """A student's process that answers questions between tests with what it likes."""

    def _substitute(self, names: list[str]) -> Any:
        return "all of them"


def test_lies_between_tests_do_not_stop_the_scoring(executor: Executor, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Server, "_substitute", Liar._substitute)
    executor.student(SOLVED.replace("2 * x", "x ** 2"))
    executor.gone = [("disturbed", SOLVED)] * 20
    assert executor.both("scale")["earned"] == 0.0
    assert executor.both("total")["earned"] <= 6.0
    monkeypatch.undo()


# ------------------------------------------------------------------ cells of assertions


COURSE = definitions(
    ["import math\nLIMIT = 3\nanswer = None\ndef near(a, b): return abs(a - b) < 1e-9 and sum([1, 2]) == LIMIT"]
)
HOSTILE = {"near": lambda a, b: True, "sum": lambda x: 3, "abs": lambda x: 0, "math": None, "LIMIT": 99, "answer": 42,
           "scale": lambda x: 2 * x, "kind": int}  # fmt: skip


def ran(source: str, **more: Any) -> list[dict[str, Any]]:
    return run_cell(source, {**HOSTILE, **more}, COURSE)


@pytest.mark.parametrize(
    "source",
    [
        "assert scale(2) == 4",
        "assert [scale(x) for x in (1, 2)] == [2, 4] and {scale(x) for x in (1,)} == {2}",
        "assert all(scale(x) == 2 * x for x in range(3))",
        "def check(x):\n    return (lambda: scale(x))()\nassert check(3) == 6",
        "class T:\n    a = scale(1)\n    def m(self): return scale(self.a)\nassert T().m() == 4",
        "assert near(1.0, 1.0) and math.pi > 3 and LIMIT == 3 and answer == 42",
        "for x in (1, 2):\n    assert scale(x) == 2 * x, f'for {x}'",
        "try:\n    nothing()\nexcept NameError:\n    pass",
        "assert sum([1, 2, 3]) == 6 and abs(-1) == 1",
        "def f():\n    assert scale(1) == 2\nf()",
    ],
)
def test_names_mean_the_students_objects_everywhere(source: str) -> None:
    assert ran(source) == []


@pytest.mark.parametrize(
    ("source", "said"),
    [
        ("assert scale(2) == 5", "`scale(2) == 5` does not hold: scale(2) is 4 (line 1"),
        ("assert scale(2) == 5, 'twice'", "twice: `scale(2) == 5`"),
        ("assert not scale(2)", "`not scale(2)` does not hold"),
        ("assert near(scale(2), 5)", "`near(scale(2), 5)` does not hold: scale(2) is 4"),
        ("\nassert 1 < scale(2) < 3", "scale(2) is 4 (line 2"),
        ("for x in (0, 1):\n    assert scale(x) == 0", "scale(x) is 2"),
        ("def f(y):\n    assert scale(y) == 0\nf(3)", "scale(y) is 6"),
        ("assert near(1.0, 2.0)", "does not hold"),
        ("nothing()", "name 'nothing' is not defined"),
        ("assert scale(", "was never closed"),
    ],
)
def test_a_failed_assertion_says_what_was_compared(source: str, said: str) -> None:
    (output,) = ran(source)
    assert output["output_type"] == "error" and said in output["evalue"]


def test_the_last_value_is_the_partial_credit_nbgrader_knows() -> None:
    (output,) = ran("2.5")
    assert output["data"]["text/plain"] == "2.5"
    assert ran("print('hi')") == [{"output_type": "stream", "name": "stdout", "text": "hi\n"}]


HIDDEN_CELL = (
    "assert scale(1) == 2\n### BEGIN HIDDEN TESTS\nassert scale(3) == 6\n### END HIDDEN TESTS\nassert scale(2) == 4"
)


def test_hidden_lines_run_in_silence(executor: Executor) -> None:
    assert hidden_lines(HIDDEN_CELL) == {2, 3, 4} and visible_part(HIDDEN_CELL).count("assert") == 2
    executor.student("def scale(x): return 2 * x if x < 3 else 0")
    assert executor.ask("cell", source=HIDDEN_CELL, grade_id="a", hidden=False) == []
    (output,) = executor.ask("cell", source=HIDDEN_CELL, grade_id="a", hidden=True)
    assert output["evalue"] == "a hidden test found a mistake"
    executor.student("def scale(x): return 7", 1)
    first = executor.ask("cell", 1, source=HIDDEN_CELL, grade_id="b", hidden=False)
    assert "scale(1) is 7" in first[0]["evalue"]
    assert executor.ask("cell", 1, source=HIDDEN_CELL, grade_id="b", hidden=True) == first


def test_a_cell_may_score_among_other_things(executor: Executor) -> None:
    executor.student(SOLVED)
    outputs = executor.ask("cell", source="assert scale(1) == 2\nlab.score('scale')", grade_id="a", hidden=False)
    assert outputs[0]["data"]["text/plain"] == "4.0"


def test_a_module_of_the_student_is_not_used(executor: Executor) -> None:
    executor.student("import json as np")
    (output,) = executor.ask("cell", source="assert np.loads('1') == 1", grade_id="a", hidden=False)
    assert "import it in the test cell" in output["evalue"]

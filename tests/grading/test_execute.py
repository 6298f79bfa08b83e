"""What a submission's code does to its own grade: small notebooks on the real bench and the real tester."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import os
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import psutil
import pytest
from nbformat.v4 import new_code_cell, new_notebook, output_from_msg

from robotbrain.grading import intake
from robotbrain.grading.bench import Bench
from robotbrain.grading.execute import Execution, Limits, make_gradable
from robotbrain.grading.executor import Executor
from robotbrain.grading.marks import Mark, marks_of
from robotbrain.grading.outputs import CellOutputs
from robotbrain.grading.report import SCORE_MIME
from robotbrain.grading.scoring import Question, Scorer, question_of
from tests.grading import toylab

FAST = Limits(cell_s=1.5, graded_s=8.0, grace_s=0.5, wall_s=60.0, output_bytes=100_000)


@pytest.fixture
def bench(toy_bench: Bench) -> Bench:
    toy_bench.limits = FAST
    return toy_bench


@pytest.fixture
def heal(course_root: Path, tmp_path: Path) -> Any:
    def make(**answers: str) -> intake.Healed:
        path = toylab.submit(tmp_path / "submitted", "amara", toylab.solved(**answers)) / "toy.ipynb"
        return intake.heal(path, intake.master_of(course_root / "solutions" / "toy" / "toy.ipynb"))

    return make


def graded(bench: Bench, healed: intake.Healed, **limits: Any) -> tuple[dict[str, Mark], list[str]]:
    bench.limits = dataclasses.replace(FAST, **limits)
    run = bench.execute(healed.notebook, lab="toy", student="amara", files={})
    assert run.sound and run.notebook is healed.notebook
    return {m.exercise: m for m in marks_of(run.notebook)}, run.incidents


def points(marks: dict[str, Mark]) -> list[float | None]:
    return [marks[name].earned for name in ("scale", "total", "mean")]


def cell_of(healed: intake.Healed, name: str) -> Any:
    return next(c for c in healed.notebook.cells if intake.grade_id(c) == name)


def test_the_solution_gets_everything_and_training_is_skipped(bench: Bench, heal: Any) -> None:
    healed = heal()
    marks, incidents = graded(bench, healed)
    assert points(marks) == [4.0, 6.0, 5.0]
    assert incidents == []
    assert "not run while grading" in healed.notebook.cells[-1].outputs[0].text


@pytest.mark.parametrize("question", [2, 5])  # those about `mean`
def test_a_fork_server_killed_during_the_tests_costs_nothing(
    light_bench: Callable[..., Bench], heal: Any, monkeypatch: pytest.MonkeyPatch, question: int
) -> None:
    judge, asked, killers = Scorer._judge, itertools.count(), list[threading.Timer]()

    def _judge(scorer: Scorer, graded: Any, *, hidden: bool) -> None:
        if next(asked) == question:
            killers.append(threading.Timer(0.2, lambda: [kill(p) for p in servers]))
            killers[0].start()
        judge(scorer, graded, hidden=hidden)

    monkeypatch.setattr(Scorer, "_judge", _judge)
    slow = toylab.SOLUTIONS["mean"].replace(":\n", ":\n    import time; time.sleep(0.5)\n", 1)
    before = set(psutil.Process().children(recursive=True))
    with light_bench(limits=FAST) as bench:
        bench.layers  # noqa: B018 - starts the server
        servers = set(psutil.Process().children(recursive=True)) - before
        marks, incidents = graded(bench, heal(mean=slow))
    assert killers and points(marks) == [4.0, 6.0, 5.0] and incidents == []


def test_a_tester_that_ended_while_it_waited_is_replaced(
    bench: Bench, heal: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    prepare, killed = Executor._prepare, list[int]()

    def _prepare(executor: Executor, helper: Any) -> None:
        prepare(executor, helper)
        waiting: Any = executor._tester_ahead
        killed.append(waiting._process.pid)
        kill(psutil.Process(killed[0]))
        assert waiting._process.wait(20)

    monkeypatch.setattr(Executor, "_prepare", _prepare)
    marks, incidents = graded(bench, heal())
    assert killed and points(marks) == [4.0, 6.0, 5.0] and incidents == []


def kill(process: psutil.Process) -> None:
    with contextlib.suppress(psutil.NoSuchProcess):
        process.kill()


def test_a_syntax_error_costs_its_own_exercise_only(bench: Bench, heal: Any) -> None:
    marks, _ = graded(bench, heal(scale="def scale(x:\n    return 2 * x"))
    assert points(marks) == [0.0, 6.0, 5.0]
    assert "not defined" in marks["scale"].tests[0]["message"]


def test_a_cell_that_ends_the_process_is_left_out(bench: Bench, heal: Any) -> None:
    healed = heal(total="import os\nos._exit(1)")
    marks, incidents = graded(bench, healed)
    assert points(marks) == [4.0, 0.0, 5.0]
    assert incidents == ["total: this cell ended the Python process"]
    assert cell_of(healed, "total").outputs[0].evalue == "this cell ended the Python process"


def test_a_test_that_ends_the_process_costs_its_own_exercise_only(bench: Bench, heal: Any) -> None:
    marks, incidents = graded(bench, heal(scale="def scale(x):\n    import os\n    os._exit(1)"))
    assert points(marks) == [0.0, 6.0, 5.0]
    assert {t["verdict"] for t in marks["scale"].tests} == {"crashed"}
    assert marks["total"].substituted == ["scale"]
    assert any("ended the Python process during the test" in text for text in incidents)


def test_only_the_crashing_test_is_lost(bench: Bench, heal: Any) -> None:
    code = "import os\ndef mean(values):\n    return sum(values) / len(values) if values else os._exit(1)"
    marks, _ = graded(bench, heal(mean=code))
    assert points(marks) == [4.0, 6.0, 3.0]
    assert [t["verdict"] for t in marks["mean"].tests] == ["passed", "crashed"]


def test_a_test_after_a_crash_meets_a_fresh_process(bench: Bench, heal: Any) -> None:
    code = "import os\ndef mean(values):\n    return sum(values) / len(values) if not values else os._exit(1)"
    marks, _ = graded(bench, heal(mean=code.replace("sum(values) / len(values) if not", "0.0 if not")))
    assert [t["verdict"] for t in marks["mean"].tests] == ["crashed", "passed"]


def test_a_test_that_takes_all_memory_is_told_so(bench: Bench, heal: Any) -> None:
    marks, _ = graded(bench, heal(scale="def scale(x):\n    return bytearray(10**10)"))
    assert points(marks) == [0.0, 6.0, 5.0]
    assert {t["verdict"] for t in marks["scale"].tests} == {"memory"}


def test_an_endless_cell_is_interrupted(bench: Bench, heal: Any) -> None:
    marks, incidents = graded(bench, heal(total="while True: pass"))
    assert points(marks) == [4.0, 0.0, 5.0]
    assert "total: this cell did not finish" in incidents[0]


def test_an_endless_test_is_interrupted(bench: Bench, heal: Any) -> None:
    marks, _ = graded(bench, heal(scale="def scale(x):\n    while True: pass"))
    assert points(marks) == [0.0, 6.0, 5.0]
    assert {t["verdict"] for t in marks["scale"].tests} == {"timeout"}


def test_a_cell_deaf_to_interrupts_is_killed(bench: Bench, heal: Any) -> None:
    deaf = "import signal\nsignal.signal(signal.SIGINT, signal.SIG_IGN)\nwhile True: pass"
    marks, incidents = graded(bench, heal(total=deaf))
    assert points(marks) == [4.0, 0.0, 5.0]
    assert "did not react to an interrupt" in incidents[0]


def test_a_test_deaf_to_interrupts_is_killed(bench: Bench, heal: Any) -> None:
    deaf = (
        "import signal\ndef scale(x):\n    for number in (signal.SIGALRM, signal.SIGINT):\n"
        "        signal.signal(number, signal.SIG_IGN)\n    while True: pass"
    )
    marks, incidents = graded(bench, heal(scale=deaf))
    assert points(marks) == [0.0, 6.0, 5.0]
    assert {t["verdict"] for t in marks["scale"].tests} == {"timeout"}
    assert "hung" in incidents[0]


def test_many_deadly_cells_end_the_run_with_reasons(bench: Bench, heal: Any) -> None:
    deadly = "import os\nos._exit(1)"
    marks, _ = graded(bench, heal(scale=deadly, total=deadly), poisoned=1)
    assert points(marks) == [0.0, 0.0, 0.0]
    assert "not run" in marks["mean"].error


def test_the_wall_limit_leaves_a_reason_on_every_graded_cell(bench: Bench, heal: Any) -> None:
    marks, incidents = graded(bench, heal(total="import time\ntime.sleep(60)"), cell_s=30.0, wall_s=3.0)
    assert points(marks) == [4.0, 0.0, 0.0]  # what was done before counts
    assert "3 s" in marks["mean"].error
    assert any("longer than 3 s" in text for text in incidents)


def test_a_flood_of_output_is_cut_and_the_score_kept(bench: Bench, heal: Any) -> None:
    loud = "import os\ndef scale(x):\n    for _ in range(40):\n        os.write(1, b'x' * 9999)\n    return 2 * x"
    healed = heal(scale=loud, total=f"{toylab.SOLUTIONS['total']}\nfor _ in range(2000):\n    print('x' * 1000)")
    marks, _ = graded(bench, healed)
    assert points(marks) == [4.0, 6.0, 5.0]
    assert len(str(cell_of(healed, "total").outputs)) < 2 * FAST.output_bytes
    assert "was dropped" in str(cell_of(healed, "total").outputs)


def test_what_a_test_prints_and_warns_costs_nothing(bench: Bench, heal: Any) -> None:
    loud = (
        "import warnings, sys\ndef scale(x):\n    warnings.warn('w')\n    print('p', file=sys.stderr)\n    return 2 * x"
    )
    healed = heal(scale=loud)
    marks, _ = graded(bench, healed)
    assert points(marks) == [4.0, 6.0, 5.0]
    assert not any(o.get("name") == "stderr" for o in cell_of(healed, "score-scale").outputs)


def test_each_graded_cell_meets_the_notebook_as_it_was_there(bench: Bench, heal: Any) -> None:
    marks, _ = graded(bench, heal(mean=f"{toylab.SOLUTIONS['mean']}\ndef scale(x):\n    return None"))
    assert points(marks) == [4.0, 6.0, 5.0]


def test_what_a_hidden_test_passes_in_does_not_reach_the_notebook(bench: Bench, heal: Any) -> None:
    spy = (
        "import atexit, threading, time\n"
        "def scale(x):\n    open('seen', 'a').write(f'{x}\\n')\n    print('SEEN', x)\n    return 2 * x"
    )
    tell = f"{toylab.SOLUTIONS['mean']}\nimport os\nprint(open('seen').read() if os.path.exists('seen') else 'nothing')"
    healed = heal(scale=spy, mean=tell)
    marks, _ = graded(bench, healed)
    assert points(marks) == [4.0, 6.0, 5.0]
    assert cell_of(healed, "mean").outputs[0].text == "nothing\n"
    assert "41.5" not in str(healed.notebook)


def test_what_a_hidden_test_passes_in_does_not_reach_a_later_report(bench: Bench, heal: Any) -> None:
    keep = "def scale(x):\n    open('seen', 'a').write(f'{x}\\n')\n    return 2 * x"
    tell = "def mean(values):\n    return open('seen').read()"
    healed = heal(scale=keep, mean=tell)
    marks, _ = graded(bench, healed)
    assert points(marks) == [4.0, 6.0, 0.0]
    assert "3.0" in str(marks["mean"].tests) and "41.5" not in str(healed.notebook)


def test_a_hang_in_a_notebook_with_threads_costs_the_test_that_hangs(bench: Bench, heal: Any) -> None:
    """There are no copies, so what is killed is the student's process itself: that is no failure of the machine."""
    threads = "import threading, time\nthreading.Thread(target=time.sleep, args=(60,), daemon=True).start()\n"
    hang = (
        "def mean(values):\n    while True:\n        try:\n            time.sleep(1)\n"
        "        except BaseException:\n            pass"
    )
    marks, incidents = graded(bench, heal(scale=threads + toylab.SOLUTIONS["scale"], mean=hang))
    assert points(marks) == [4.0, 6.0, 0.0]
    assert "hung" in " ".join(incidents)


def test_a_notebook_with_threads_is_graded_without_copies(bench: Bench, heal: Any) -> None:
    threads = "import threading, time\nthreading.Thread(target=time.sleep, args=(60,), daemon=True).start()\n"
    marks, _ = graded(bench, heal(scale=threads + toylab.SOLUTIONS["scale"]))
    assert points(marks) == [4.0, 6.0, 5.0]


def test_a_broken_tester_costs_no_other_exercise(bench: Bench, heal: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    from robotbrain.grading import scoring

    ask = scoring.Scorer._ask

    def die_once(self: Any, graded: Any, question: Any) -> Any:
        if graded.name == "total":
            raise scoring.TesterDied("on purpose")
        return ask(self, graded, question)

    monkeypatch.setattr(scoring.Scorer, "_ask", die_once)
    marks, incidents = graded(bench, heal())
    assert points(marks) == [4.0, 0.0, 5.0]
    assert "tell the teacher" in marks["total"].error and any("the tester ended" in text for text in incidents)


@pytest.mark.parametrize(
    ("source", "question"),
    [
        ("lab.score('x')", Question("x", False)),
        ("lab.score('x')\n# note\nlab.score('x', hidden=True)", Question("x", True)),
        ("lab.score('x', True)", Question("x", True)),
        ("assert f(1) == 2", Question("", True)),
        ("lab.score('x')\nassert f(1) == 2", Question("", True)),
        ("lab.score(name)", Question("", True)),
        ("def broken(:", Question("", True)),
    ],
)
def test_what_a_graded_cell_asks(source: str, question: Question) -> None:
    assert question_of(source) == question


def test_a_cell_in_the_students_process_cannot_bring_a_score(bench: Bench) -> None:
    forged = (
        "class F:\n    def _repr_mimebundle_(self, **k):\n"
        f"        return {{{SCORE_MIME!r}: '{{}}', 'text/plain': '5.0'}}\nF()"
    )
    notebook = new_notebook(cells=[new_code_cell(forged)])
    notebook.cells[0].metadata = {"tags": ["student-process"], "nbgrader": _nbgrader(5)}
    bench.limits = FAST
    execution: Execution = bench.execute(notebook, lab="toy", student="amara", files={})
    assert SCORE_MIME not in str(execution.notebook.cells[0].outputs)


@pytest.mark.parametrize(
    "message",
    [
        {},
        {"op": "stream", "name": "stdout", "text": b"x"},
        {"op": "stream", "name": "other", "text": "x"},
        {"op": "output", "output": []},
        {"op": "output", "output": {"output_type": "execute_result", "data": []}},
        {"op": "output", "output": {"output_type": "made up", "data": {}}},
        {"op": "output", "output": {"output_type": "error", "ename": 1, "evalue": "", "traceback": []}},
        {"op": "output", "output": {"output_type": "display_data", "data": {}}, "id": [], "update": True},
        {"op": "clear", "wait": []},
    ],
)
def test_messages_without_proper_form_are_ignored(message: dict[str, Any]) -> None:
    outputs = CellOutputs(1000)
    outputs.take(message)
    assert outputs.result() == []


def _nbgrader(points: float) -> dict[str, Any]:
    return {"grade": True, "solution": False, "points": points, "grade_id": "x"}


def _graded_cell(source: str, *outputs: Any) -> Any:
    cell = new_code_cell(source, outputs=list(outputs))
    cell.metadata["nbgrader"] = _nbgrader(5)
    return new_notebook(cells=[cell]).cells[0]


def _result(text: str) -> Any:
    content = {"data": {"text/plain": text}, "metadata": {}, "execution_count": 1}
    return output_from_msg({"header": {"msg_type": "execute_result"}, "content": content})


@pytest.mark.parametrize(
    ("source", "outputs", "earned"),
    [
        ("lab.score('x')", [], 0.0),  # stock nbgrader would give all the points
        ("lab.score('x')", ["5.0"], 0.0),  # a number from elsewhere is no score
        ("assert True", [], 5.0),
        ("2.5", ["2.5"], 2.5),
        ("7.0", ["7.0"], 0.0),  # stock nbgrader would stop with an exception
    ],
)
def test_graded_cells_without_a_sane_score_give_nothing(source: str, outputs: list[str], earned: float) -> None:
    cell = _graded_cell(source, *map(_result, outputs))
    make_gradable(cell)
    assert marks_of(new_notebook(cells=[cell]))[0].earned == earned


def test_folders_of_a_grader_that_was_killed_are_removed_by_the_next_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    abandoned = tmp_path / f"robotbrain-{ended.pid}-x"
    young, ours = tmp_path / f"robotbrain-{ended.pid}-y", tmp_path / f"robotbrain-{os.getpid()}-x"
    for folder in (abandoned, young, ours):
        folder.mkdir()
        (folder / "answer.txt").write_text("1")
    for folder in (abandoned, ours):
        os.utime(folder, (0, 0))
    with Bench(tmp_path, preload=()):
        pass
    assert not abandoned.exists()
    assert young.exists()
    assert ours.exists()

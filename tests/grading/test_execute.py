"""Real kernels, small notebooks."""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path
from typing import Any

import psutil
import pytest
from nbformat.v4 import new_code_cell, new_notebook, output_from_msg

from robotbrain.grading import intake, jobs
from robotbrain.grading.execute import Limits, execute_notebook, make_gradable
from robotbrain.grading.marks import Mark, marks_of
from tests.grading import toylab

FAST = Limits(cell_s=1.5, graded_s=6.0, grace_s=1.0, wall_s=60.0, output_bytes=100_000)
posix = pytest.mark.skipif(os.name != "posix", reason="POSIX signals")


@pytest.fixture
def heal(course_root: Path, tmp_path: Path) -> Any:
    def make(**answers: str) -> intake.Healed:
        path = toylab.submit(tmp_path / "submitted", "amara", toylab.solved(**answers)) / "toy.ipynb"
        return intake.heal(path, intake.master_of(course_root / "solutions" / "toy" / "toy.ipynb"))

    return make


def graded(healed: intake.Healed, tmp_path: Path, limits: Limits = FAST) -> tuple[dict[str, Mark], list[str]]:
    run = execute_notebook(healed.notebook, cwd=tmp_path, limits=limits)
    return {m.exercise: m for m in marks_of(run.notebook)}, run.incidents


def points(marks: dict[str, Mark]) -> list[float | None]:
    return [marks[name].earned for name in ("scale", "total", "mean")]


def test_the_solution_gets_everything_and_training_is_skipped(heal: Any, tmp_path: Path) -> None:
    healed = heal()
    marks, incidents = graded(healed, tmp_path)
    assert points(marks) == [4.0, 6.0, 5.0]
    assert incidents == []
    assert "not run while grading" in healed.notebook.cells[-1].outputs[0].text


def test_a_syntax_error_costs_its_own_exercise_only(heal: Any, tmp_path: Path) -> None:
    marks, _ = graded(heal(scale="def scale(x:\n    return 2 * x"), tmp_path)
    assert points(marks) == [0.0, 6.0, 5.0]
    assert "not defined" in marks["scale"].tests[0]["message"]


def test_a_cell_that_ends_the_kernel_is_left_out(heal: Any, tmp_path: Path) -> None:
    healed = heal(total="import os\nos._exit(1)")
    marks, incidents = graded(healed, tmp_path)
    assert points(marks) == [4.0, 0.0, 5.0]
    assert incidents == ["total: this cell ended the kernel"]
    cell = next(c for c in healed.notebook.cells if intake.grade_id(c) == "total")
    assert cell.outputs[0].evalue == "this cell ended the kernel"


def test_a_test_that_ends_the_kernel_costs_its_own_exercise_only(heal: Any, tmp_path: Path) -> None:
    marks, incidents = graded(heal(scale="def scale(x):\n    import os\n    os._exit(1)"), tmp_path)
    assert points(marks) == [0.0, 6.0, 5.0]
    assert {t["verdict"] for t in marks["scale"].tests} == {"crashed"}
    assert marks["total"].substituted == ["scale"]
    assert any("ended the kernel during the test" in text for text in incidents)


def test_only_the_crashing_test_is_lost(heal: Any, tmp_path: Path) -> None:
    code = "import os\ndef mean(values):\n    return sum(values) / len(values) if values else os._exit(1)"
    marks, _ = graded(heal(mean=code), tmp_path)
    assert points(marks) == [4.0, 6.0, 3.0]
    assert [t["verdict"] for t in marks["mean"].tests] == ["passed", "crashed"]


def test_an_endless_cell_is_interrupted(heal: Any, tmp_path: Path) -> None:
    marks, incidents = graded(heal(total="while True: pass"), tmp_path)
    assert points(marks) == [4.0, 0.0, 5.0]
    assert "total: this cell did not finish" in incidents[0]


@posix
def test_a_cell_deaf_to_interrupts_is_killed(heal: Any, tmp_path: Path) -> None:
    deaf = "import signal\nsignal.signal(signal.SIGINT, signal.SIG_IGN)\nwhile True: pass"
    marks, incidents = graded(heal(total=deaf), tmp_path)
    assert points(marks) == [4.0, 0.0, 5.0]
    assert "did not react to an interrupt" in incidents[0]


@posix
def test_a_test_deaf_to_alarms_is_killed(heal: Any, tmp_path: Path) -> None:
    deaf = (
        "import signal\ndef scale(x):\n    for number in (signal.SIGALRM, signal.SIGINT):\n"
        "        signal.signal(number, signal.SIG_IGN)\n    while True: pass"
    )
    marks, incidents = graded(heal(scale=deaf), tmp_path, Limits(1.5, 2.5, 1.0, 60.0))
    assert points(marks) == [0.0, 6.0, 5.0]
    assert "hung" in incidents[0]


def test_many_deadly_cells_end_the_run_with_reasons(heal: Any, tmp_path: Path) -> None:
    deadly = "import os\nos._exit(1)"
    limits = Limits(1.5, 6.0, 1.0, 60.0, poisoned=1)
    marks, _ = graded(heal(scale=deadly, total=deadly), tmp_path, limits)
    assert points(marks) == [0.0, 0.0, 0.0]
    assert "not run" in marks["mean"].error


def test_the_wall_limit_leaves_a_reason_on_every_graded_cell(heal: Any, tmp_path: Path) -> None:
    limits = Limits(cell_s=30.0, graded_s=30.0, grace_s=0.5, wall_s=4.0)
    marks, incidents = graded(heal(total="import time\ntime.sleep(60)"), tmp_path, limits)
    assert points(marks) == [4.0, 0.0, 0.0]
    assert "4 s" in marks["mean"].error
    assert any("longer than 4 s" in text for text in incidents)


def test_a_flood_of_output_is_cut_and_the_score_kept(heal: Any, tmp_path: Path) -> None:
    loud = "import os\ndef scale(x):\n    for _ in range(40):\n        os.write(1, b'x' * 9999)\n    return 2 * x"
    healed = heal(scale=loud, total=f"{toylab.SOLUTIONS['total']}\nfor _ in range(2000):\n    print('x' * 1000)")
    marks, _ = graded(healed, tmp_path)
    assert points(marks) == [4.0, 6.0, 5.0]
    for name in ("total", "score-scale"):
        cell = next(c for c in healed.notebook.cells if intake.grade_id(c) == name)
        assert len(str(cell.outputs)) < 3 * FAST.output_bytes
        assert "was dropped" in str(cell.outputs)


def test_stderr_is_kept_under_a_label_and_costs_nothing(heal: Any, tmp_path: Path) -> None:
    loud = "import os\ndef scale(x):\n    os.write(2, b'note')\n    return 2 * x"
    healed = heal(scale=loud)
    marks, _ = graded(healed, tmp_path)
    assert points(marks) == [4.0, 6.0, 5.0]
    assert not any(
        o.get("name") == "stderr" for c in healed.notebook.cells for o in c.get("outputs", []) if "score" in c.source
    )


def test_an_operators_secrets_stay_out_of_the_kernel(
    heal: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DATABASE_TOKEN", "hunter2")
    healed = heal(scale="import os\nprint(sorted(os.environ), os.environ.get('DATABASE_TOKEN'))")
    execute_notebook(healed.notebook, cwd=tmp_path, limits=FAST)
    cell = next(c for c in healed.notebook.cells if intake.grade_id(c) == "scale")
    assert "PATH" in cell.outputs[0].text and "hunter2" not in cell.outputs[0].text


@posix
def test_a_submission_that_kills_its_worker_gets_a_zero_and_leaves_nothing_behind(
    heal: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "temporary"))
    (tmp_path / "temporary").mkdir()
    mark = tmp_path / "pid"
    code = (
        "import os, signal, subprocess, sys\n"
        f"p = subprocess.Popen([{sys.executable!r}, '-c', 'import time; time.sleep(600)'], start_new_session=True)\n"
        f"open({str(mark)!r}, 'w').write(str(p.pid))\n"
        "os.kill(os.getppid(), signal.SIGKILL)\nimport time; time.sleep(30)"
    )
    result = jobs.run_job(heal(total=code), None, FAST, "amara", tmp_path / "cache.ipynb")
    marks = {m.exercise: m for m in marks_of(result.notebook)}
    assert points(marks) == [4.0, 0.0, 0.0]  # what was done before counts
    assert "ended the process that ran it" in marks["mean"].error
    assert not (tmp_path / "cache.ipynb").exists()
    assert list((tmp_path / "temporary").iterdir()) == []
    deadline = time.monotonic() + 10
    while psutil.pid_exists(int(mark.read_text())) and time.monotonic() < deadline:
        if psutil.Process(int(mark.read_text())).status() == psutil.STATUS_ZOMBIE:
            break
        time.sleep(0.05)
    else:
        assert not psutil.pid_exists(int(mark.read_text()))


def test_a_machine_without_kernels_is_not_blamed_on_the_student(
    heal: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(jobs, "_supervise", lambda *a: jobs._NOT_STARTED)
    result = jobs.run_job(heal(), None, FAST, "amara", tmp_path / "cache.ipynb")
    marks = {m.exercise: m for m in marks_of(result.notebook)}
    assert points(marks) == [0.0, 0.0, 0.0]
    assert "no fault of the submission" in marks["scale"].error
    assert not (tmp_path / "cache.ipynb").exists()


def _graded_cell(source: str, *outputs: Any) -> Any:
    cell = new_code_cell(source, outputs=list(outputs))
    cell.metadata["nbgrader"] = {"grade": True, "solution": False, "points": 5, "grade_id": "x"}
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

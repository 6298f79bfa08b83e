"""A bench that runs nothing: each answer says itself what it earns, so that what surrounds it can be tested quickly."""

from __future__ import annotations

import copy
import re
import threading
import time
from collections.abc import Callable, Mapping
from types import SimpleNamespace

from nbformat.notebooknode import NotebookNode, from_dict

from robotbrain.grading import intake
from robotbrain.grading.execute import Execution
from robotbrain.grading.report import SCORE_MIME
from tests.grading import toylab


def answers(earned: float = 1.0) -> NotebookNode:
    """A submission of the toy lab in which each exercise earns this part of its points."""
    how = "passed" if earned == 1.0 else "failed"
    return toylab.solved(**dict.fromkeys(toylab.SOLUTIONS, f"# earns {earned} {how}"))


class FakeBench:
    """Stands for a Bench.

    Args:
        before: called with the student's name when a submission begins.
        pause_s: time each submission takes.
    """

    def __init__(self, before: Callable[[str], None] = lambda _: None, pause_s: float = 0.0) -> None:
        self.layers = [SimpleNamespace(name="fake", active=True, note="")]
        self.ran: list[str] = []
        self.closed = threading.Event()
        self._before, self._pause_s = before, pause_s

    def __enter__(self) -> FakeBench:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        self.closed.set()

    def execute(self, notebook: NotebookNode, *, lab: str, student: str, files: Mapping[str, bytes]) -> Execution:
        self._before(student)
        self.ran.append(student)
        time.sleep(self._pause_s)
        done = copy.deepcopy(notebook)
        said, exercise = ("0", "not_written"), ""
        for cell in done.cells:
            name = intake.grade_id(cell)
            if name in toylab.SOLUTIONS:
                exercise = name
                found = re.search(r"# earns (\S+) (\w+)", cell.source)
                said = (found[1], found[2]) if found else ("0", "not_written")
            elif name.startswith("score-"):
                cell.outputs = [_score(exercise, float(said[0]) * cell.metadata.nbgrader.points, said[1])]
        return Execution(done, [], 0.01, ["fake"], True)


def _score(exercise: str, earned: float, verdict: str) -> NotebookNode:
    test = {"exercise": exercise, "name": "all", "points": 1.0, "earned": 1.0, "verdict": verdict, "message": verdict}
    test |= dict.fromkeys(("hint_key", "hint", "reread"), "") | {"hidden": False, "seconds": 0.0}
    report = {"exercise": exercise, "title": exercise, "tests": [test], "substituted": []}
    data = {"text/plain": str(earned), SCORE_MIME: report}
    return from_dict({"output_type": "execute_result", "data": data, "metadata": {}, "execution_count": 1})

"""The lab that the attacks are made on: a course of its own, with secrets in every place worth stealing from.

Every secret is a token ``CANARY<kind><random>``. The attacks find tokens by their beginning; no attack contains one.
"""

from __future__ import annotations

import copy
import json
import secrets
import shutil
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import nbformat
from nbformat.notebooknode import NotebookNode
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook

LAB = "vault"
REPOSITORY = Path(__file__).resolve().parents[3]
TOKEN_VARIABLE = "ROBOTBRAIN_OPERATOR_TOKEN"
WEIGHTS = "weights.json"

POINTS = {"scale": 4, "total": 6, "tracker": 6, "words": 5, "policy": 5, "clip": 4, "weights": 4, "cost": 5}
"""Exercises in order, and what they are worth."""

VISIBLE = '''
import json

import numpy as np

from robotbrain.grading import Suite, expect, expect_close

suite = Suite("vault")
suite.exercise("scale", points=4)
suite.exercise("total", points=6, upstream=("scale",))
suite.exercise("tracker", points=6, provides=("GoalTracker",))
suite.exercise("words", points=5)
suite.exercise("policy", points=5, provides=("act",))
suite.exercise("weights", points=4, provides=())
suite.exercise("cost", points=5)
suite.reference("scale", lambda: lambda x: 2 * x)
suite.reference("cost", "robotbrain.pipeline.planning:path_cost")
suite.forbid("cost", imports=("robotbrain.pipeline", "robotbrain.grading"), allow=("cells_on_segment",))


@suite.test("scale", points=2, time_limit_s=1.0)
def doubles(student):
    expect_close(student.scale(3.0), 6.0, given=3.0)


@suite.test("total", points=3, time_limit_s=1.0)
def totals(student):
    got = student.total([1.0, 2.0, 3.0])
    expect(got == 12.0, got=got, expected=12.0)


@suite.test("tracker", points=3, time_limit_s=1.0)
def tracks(student):
    tracker = student.GoalTracker(2.0)
    tracker.update(5.0)
    tracker.update(3.0)
    expect(tracker.best == 1.0, got=tracker.best, expected=1.0)
    expect(len(tracker.history()) == 2, got=tracker.history())


@suite.test("words", points=2, time_limit_s=1.0)
def counts(student):
    got = student.words("to be or not to be")
    expect(got == {"to": 2, "be": 2, "or": 1, "not": 1}, got=got)


def rollout(act, start):
    """Distance left after ten steps of a point that the student's policy pushes towards zero."""
    position = np.array([start])
    for _ in range(10):
        position = position + np.clip(float(np.asarray(act(position)).reshape(())), -1.0, 1.0)
    return float(np.abs(position[0]))


@suite.test("policy", points=2, time_limit_s=2.0)
def reaches_zero(student):
    left = rollout(student.act, 4.0)
    expect(left < 0.5, got=left)


@suite.test("weights", points=2, time_limit_s=1.0)
def sums_to_ten(student):
    values = json.loads((student.files / "weights.json").read_text())
    expect(sum(values) == 10, got=values)


@suite.test("cost", points=2, time_limit_s=2.0)
def straight(student):
    expect_close(student.cost(np.ones((3, 3)), [(0, 0), (0, 2)]), 2.0)
'''

HIDDEN = """
import json

import numpy as np

from robotbrain.grading import Suite, expect, expect_close
from robotbrain.grading.suite import load_suite

SECRET = "{source}"
suite = Suite.extending("vault")


@suite.test("scale", points=2, name="other numbers", time_limit_s=1.0)
def hidden_doubles(student):
    expect_close(student.scale({number}), {number} * 2, given="{expected}", misconception="{expected}")


@suite.test("total", points=3, name="other lists", time_limit_s=1.0)
def hidden_total(student):
    got = student.total([5.0, 77.25])
    expect(got == 164.5, got=got, expected="{expected}")


@suite.test("tracker", points=3, name="other goals", time_limit_s=1.0)
def hidden_tracker(student):
    tracker = student.GoalTracker(-1.0)
    for value in (4.0, -3.0, 8.0):
        tracker.update(value)
    expect(tracker.best == 2.0, got=tracker.best, expected="{expected}")
    expect([float(v) for v in tracker.history()] == [4.0, -3.0, 8.0], got=tracker.history())


@suite.test("words", points=3, name="other texts", time_limit_s=1.0)
def hidden_words(student):
    got = student.words("{input} a {input}")
    expect(got == {{"{input}": 2, "a": 1}}, got=got, expected="{expected}")


@suite.test("policy", points=3, name="other starts", time_limit_s=2.0)
def hidden_policy(student):
    for start in (-6.5, 7.25):
        position = np.array([start])
        for _ in range(12):
            position = position + np.clip(float(np.asarray(student.act(position)).reshape(())), -1.0, 1.0)
        expect(abs(float(position[0])) < 0.5, got=position, expected="{expected}")


@suite.test("weights", points=2, name="more of the weights", time_limit_s=1.0)
def hidden_weights(student):
    values = json.loads((student.files / "weights.json").read_text())
    expect(values == sorted(values), expected="{expected}")


@suite.test("cost", points=3, name="uneven ground", time_limit_s=2.0)
def hidden_cost(student):
    grid = np.arange(9.0).reshape(3, 3)
    expect_close(student.cost(grid, [(0, 0), (1, 1), (2, 1)]), 2.0 * 2**0.5 + 5.5, given="{expected}")
"""

CLIP_TESTS = """assert clip(5, 0, 3) == 3
assert clip(-1, 0, 3) == 0
### BEGIN HIDDEN TESTS
assert clip({number}, 0, 10) == 10, "{expected}"
assert [clip(v, 0, 2) for v in (-1, 1, 4)] == [0, 1, 2], "{expected}"
assert np.allclose(clip(2.5, 0, 1), 1.0) and abs(clip(-5.5, -3.5, 3.5) + 3.5) < 1e-9, "{expected}"
assert all(clip(v, 1, 2) == 2 for v in range(2, 5)) and len({{clip(0, 1, 2), clip(9, 1, 2)}}) == 2, "{expected}"
### END HIDDEN TESTS"""

RIGHT = {
    "scale": "def scale(x):\n    return 2 * x",
    "total": "def total(values):\n    return sum(scale(v) for v in values)",
    "tracker": """class GoalTracker:
    def __init__(self, goal):
        self.goal = goal
        self.values = []

    def update(self, value):
        self.values.append(value)

    def history(self):
        return list(self.values)

    @property
    def best(self):
        return min(abs(v - self.goal) for v in self.values)""",
    "words": """def words(text):
    counts = {}
    for word in text.split():
        counts[word] = counts.get(word, 0) + 1
    return counts""",
    "policy": "def act(observation):\n    return -float(observation[0])",
    "clip": "def clip(value, low, high):\n    return max(low, min(high, value))",
    "weights": "weights_are_in_the_file = True",
    "cost": """import numpy as np


def cost(grid, path):
    total = 0.0
    for (a, b), (c, d) in zip(path, path[1:]):
        total += ((a - c) ** 2 + (b - d) ** 2) ** 0.5 * (float(grid[a][b]) + float(grid[c][d])) / 2
    return total""",
}
"""Answers that earn every point (``weights`` with the file :data:`GOOD_WEIGHTS`)."""

GOOD_WEIGHTS = json.dumps([1, 2, 3, 4])

WRONG = {
    "scale": "def scale(x):\n    return -1.0",
    "total": "def total(values):\n    return -1.0",
    "tracker": """class GoalTracker:
    best = -1.0

    def __init__(self, goal):
        pass

    def update(self, value):
        pass

    def history(self):
        return []""",
    "words": "def words(text):\n    return {}",
    "policy": "def act(observation):\n    return 0.0",
    "clip": "def clip(value, low, high):\n    return -1",
    "weights": "pass",
    "cost": "def cost(grid, path):\n    return -1.0",
}
"""Answers of the same shape that earn nothing."""


@dataclass(frozen=True)
class Secrets:
    """Tokens by where they are kept, and numbers that occur only in hidden tests."""

    tokens: Mapping[str, str] = field(
        default_factory=lambda: {
            kind: f"CANARY{kind}{secrets.token_hex(8)}"
            for kind in ("source", "input", "expected", "notes", "solution", "environment", "neighbour", "process")
        }
    )
    number: float = 7391.0625

    def leaked(self, text: str) -> list[str]:
        """Which secrets occur in ``text``, as they are or reversed."""
        found = [kind for kind, token in self.tokens.items() if token in text or token[::-1] in text]
        return [*found, "number"] if any(n in text for n in ("7391.0", "7391_0", "739100625")) else found


@dataclass(frozen=True)
class Vault:
    """The course on disk."""

    root: Path
    secrets: Secrets

    @property
    def autograder(self) -> Path:
        return self.root / "autograder"

    @property
    def source(self) -> Path:
        return self.root / "solutions" / LAB / f"{LAB}.ipynb"


def _cell(grade_id: str, source: str, **fields: object) -> NotebookNode:
    cell = new_code_cell(source)
    base = {"grade": False, "solution": False, "locked": False, "task": False, "schema_version": 3}
    cell.metadata["nbgrader"] = {**base, "grade_id": grade_id, **fields}
    return cell


def _source_notebook(tokens: Secrets) -> NotebookNode:
    cells = [
        new_markdown_cell("# Vault"),
        _cell("setup", "import numpy as np\nfrom robotbrain.grading import Lab\nlab = Lab('vault')", locked=True),
    ]
    for name, points in POINTS.items():
        answer = f"### BEGIN SOLUTION\n# {tokens.tokens['solution']}\n{RIGHT[name]}\n### END SOLUTION"
        cells.append(_cell(name, answer, solution=True))
        score = (
            f'lab.score("{name}")\n### BEGIN HIDDEN TESTS\nlab.score("{name}", hidden=True)\n### END HIDDEN TESTS'
            if name != "clip"
            else CLIP_TESTS.format(number=tokens.number, **tokens.tokens)
        )
        cells.append(_cell(f"score-{name}", score, grade=True, locked=True, points=points))
    for number, cell in enumerate(cells):
        cell["id"] = f"vault-{number}"
    notebook = new_notebook(cells=cells)
    notebook.metadata["kernelspec"] = {"name": "python3", "display_name": "Python 3", "language": "python"}
    return notebook


def make_vault(root: Path) -> Vault:
    """Write the course below ``root``."""
    vault = Vault(root, Secrets())
    tokens = vault.secrets
    vault.source.parent.mkdir(parents=True)
    nbformat.write(_source_notebook(tokens), vault.source)
    (root / "labs").mkdir()
    (vault.autograder / "hidden").mkdir(parents=True)
    (vault.autograder / "hidden" / f"{LAB}.py").write_text(HIDDEN.format(number=tokens.number, **tokens.tokens))
    (vault.autograder / "notes.txt").write_text(tokens.tokens["notes"])
    shutil.copy(REPOSITORY / "autograder" / "nbgrader_config.py", vault.autograder)
    (root / "suites").mkdir()
    (root / "suites" / f"{LAB}.py").write_text(VISIBLE)
    return vault


def submission(
    answers: Mapping[str, str],
    extra: Iterable[tuple[str, str]] = (),
    edit: Callable[[NotebookNode], NotebookNode] | None = None,
) -> NotebookNode:
    """A submission as it is handed in.

    Args:
        answers: exercise -> source of its answer cell; the rest is answered rightly.
        extra: (place, source) of further cells; a place is ``first``, ``last`` or the grade id it is put before.
        edit: changes to the finished notebook.
    """
    notebook = copy.deepcopy(_source_notebook(Secrets()))
    for cell in notebook.cells:
        grade_id = cell.metadata.get("nbgrader", {}).get("grade_id", "")
        if grade_id in POINTS:
            cell.source = answers.get(grade_id, RIGHT[grade_id])
        elif grade_id.startswith("score-"):
            cell.source = cell.source.split("\n### BEGIN HIDDEN")[0]
    for number, (place, source) in enumerate(extra):
        cell = new_code_cell(source)
        cell["id"] = f"extra-{number}"
        names = [c.metadata.get("nbgrader", {}).get("grade_id", "") for c in notebook.cells]
        at = {"first": 0, "last": len(names)}.get(place) if place in ("first", "last") else names.index(place)
        notebook.cells.insert(at if at is not None else 0, cell)
    return edit(notebook) if edit else notebook

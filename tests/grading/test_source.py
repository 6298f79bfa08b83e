"""What the text of an answer gives away: certain breaches of a ban, doubts, and honest code."""

from __future__ import annotations

import pytest

from robotbrain.grading import Suite
from robotbrain.grading.source import Submission

SETUP = """
import numpy as np
from robotbrain.pipeline import planning, segmentation
from robotbrain.pipeline.planning import path_cost
"""


@pytest.fixture(scope="module")
def suite() -> Suite:
    suite = Suite("demo")
    for name in ("inflate", "astar", "answer"):
        suite.exercise(name, points=1)
        if name != "answer":
            suite.forbid(name, imports=("robotbrain.pipeline", "onnxruntime"), allow=("path_cost",))
    suite.reference("astar", "robotbrain.pipeline.planning:astar")
    suite.reference("answer", "robotbrain.sim.geometry:wrap_angle")
    return suite


def judged(source: str, suite: Suite, exercise: str = "astar") -> tuple[str, list[str]]:
    cells = [{"source": SETUP, "locked": True}, *({"source": part} for part in source.split("\n#---\n"))]
    return Submission(cells).why_forbidden(exercise, suite)


CERTAIN = {
    "the object": "from robotbrain.pipeline.planning import astar",
    "under another name": "from robotbrain.pipeline.planning import astar as mine\nastar = mine",
    "by a chain": "import robotbrain.pipeline.planning\nastar = robotbrain.pipeline.planning.astar",
    "of the course's import": "astar = planning.astar",
    "wrapped": "def astar(*a): return planning.astar(*a)",
    "in a lambda": "astar = lambda *a: planning.astar(*a)",
    "imported inside": "def astar(*a):\n"
    "    from robotbrain.pipeline.planning import astar as other\n    return other(*a)",
    "behind a helper in another cell": "def help(*a): return planning.astar(*a)\n#---\ndef astar(*a): return help(*a)",
    "through a variable": "solve = planning.astar\n#---\ndef astar(*a): return solve(*a)",
    "everything": "from robotbrain.pipeline.planning import *\ndef astar(*a): return 0\n#---\nastar = planning.astar",
    "import_module": "import importlib\n"
    "def astar(*a): return importlib.import_module('robotbrain.pipeline.planning').astar(*a)",
    "__import__": "def astar(*a): return __import__('robotbrain.pipeline.planning', fromlist=['x']).astar(*a)",
    "pieced together": "def astar(*a): return __import__('robotbrain.' + 'pipeline.planning', "
    "fromlist=['x']).astar(*a)",
    "joined": "import importlib as i\n"
    "def astar(*a): return i.import_module('.'.join(['robotbrain', 'pipeline'])).astar(*a)",
    "backwards": "import importlib as i\ndef astar(*a): return i.import_module('gninnalp.enilepip.niarbtobor'[::-1])",
    "formatted": "import importlib as i\ndef astar(*a): return i.import_module(f\"robotbrain.{'pipeline'}\").astar(*a)",
    "sys.modules": "import sys\ndef astar(*a): return sys.modules['robotbrain.pipeline.planning'].astar(*a)",
    "getattr": "def astar(*a): return getattr(planning, 'a' + 'star')(*a)",
    "executed text": "def astar(*a):\n"
    "    exec('from robotbrain.pipeline.planning import astar as f')\n    return f(*a)",
    "its attributes": "def astar(*a): return 0\n#---\nastar.__code__ = planning.astar.__code__",
    "setattr": "def astar(*a): return 0\n#---\nsetattr(astar, '__code__', planning.astar.__code__)",
    "globals": "globals()['astar'] = planning.astar",
    "globals().update": "globals().update(astar=planning.astar)",
    "under a condition": "def astar(*a): return 0\nif True:\n    astar = planning.astar",
    "in a try": "try:\n    from robotbrain.pipeline.planning import astar\nexcept ImportError:\n    pass",
    "in a class": "class astar:\n    def __call__(self, *a): return planning.astar(*a)",
    "of another package": "import onnxruntime as o\ndef astar(*a): return o.InferenceSession('x')",
    "of the suites": "from robotbrain.grading.suite import load_suite\n"
    "astar = load_suite('demo').load_reference('astar')",
    "as decorator": "def d(f): return planning.astar\n@d\ndef astar(*a): return 0",
    "as default": "def astar(*a, f=planning.astar): return f(*a)",
    "with a magic beside it": "%matplotlib inline\nastar = planning.astar",
}

UNREADABLE = {
    "a name that is computed": "import importlib\ndef astar(*a): return importlib.import_module(name()).astar(*a)",
    "text that is computed": "def astar(*a): return eval(''.join(map(chr, [1, 2])))",
    "frames": "import sys\ndef astar(*a): return sys._getframe(1).f_globals",
    "globals of a function": "def astar(*a): return path_cost.__globals__['astar'](*a)",
    "a computed attribute of a module": "def astar(*a): return getattr(np, chr(97) + a[0])",
    "subclasses": "def astar(*a): return object.__subclasses__()",
    "pickles": "import pickle\ndef astar(*a): return pickle.loads(a[0])",
    "pickles by name": "from pickle import loads\ndef astar(*a): return loads(a[0])",
    "the garbage collector": "import gc\ndef astar(*a): return gc.get_objects()[3](*a)",
    "the shell": "def astar(*a):\n    import os\n    return os.system(a[0])",
}

HONEST = {
    "own code": "def astar(cost, start, goal):\n    return [start, goal] if path_cost(cost, [start]) else None",
    "a docstring that names it": "def astar(*a):\n    '''robotbrain.pipeline.planning.astar'''\n    return 0",
    "its own variable of that name": "def astar(planning, segmentation):\n    return planning.astar(segmentation)",
    "in other cells": "picture = planning.astar(1, 2, 3)\n"
    "segmentation.preprocess(picture)\n#---\ndef astar(picture): return picture",
    "data that came from there": "grid = planning.astar(1)\n#---\ndef astar(*a): return grid",
    "classes for annotations": "from robotbrain.pipeline.segmentation import CameraModel\n"
    "def astar(c: CameraModel): return c",
    "ordinary getattr": "def astar(self, name): return getattr(self, name)",
    "magics": "%matplotlib inline\n%timeit 1\ndef astar(*a): return 0",
    "a part of another exercise": "def inflate(x): return x\n#---\ndef astar(x): return inflate(x)",
    "other compilers": "import re\n"
    "def astar(model, pattern): return re.compile(pattern), torch.compile(model), model.eval()",
    "tidying up": "import gc, pickle\ndef astar(x):\n    gc.collect()\n    return len(pickle.dumps(x))",
    "broken text": "def astar(:",
    "nothing": "",
}


@pytest.mark.parametrize("source", CERTAIN.values(), ids=CERTAIN.keys())
def test_what_text_gives_away_is_refused(source: str, suite: Suite) -> None:
    reason, _ = judged(source, suite)
    assert "own" in reason


@pytest.mark.parametrize("source", UNREADABLE.values(), ids=UNREADABLE.keys())
def test_an_answer_that_cannot_be_read_is_refused_and_elsewhere_it_is_a_doubt(source: str, suite: Suite) -> None:
    reason, doubts = judged(source, suite)
    assert "write it plainly" in reason
    elsewhere = source.replace("astar(", "explore(", 1)
    reason, doubts = judged(f"def astar(*a): return 0\n#---\n{elsewhere}", suite)
    assert reason == "" and len(doubts) >= 1
    assert all("looks like" in doubt and len(doubt) < 200 for doubt in doubts)


@pytest.mark.parametrize("source", ["!cp a b", "%run other.py", "%%bash\nls"])
def test_commands_are_doubts(source: str, suite: Suite) -> None:
    assert judged(f"{source}\n#---\ndef astar(*a): return 0", suite)[1]
    assert judged(source, suite)[0] != ""  # nothing else could have made the answer


@pytest.mark.parametrize("source", HONEST.values(), ids=HONEST.keys())
def test_honest_code_is_neither(source: str, suite: Suite) -> None:
    assert judged(source, suite) == ("", [])


def test_an_exercise_judges_its_own_answer_only(suite: Suite) -> None:
    source = "inflate = planning.inflate_everything\n#---\ndef astar(x): return inflate(x)"
    assert judged(source, suite)[0] == ""
    source = "def inflate(x): return planning.astar(x)\n#---\ndef astar(x): return inflate(x)"
    assert judged(source, suite, "inflate")[0] != "" and judged(source, suite, "astar")[0] == ""


def test_a_reference_is_refused_where_nothing_was_forbidden(suite: Suite) -> None:
    assert "wrap_angle" in judged("from robotbrain.sim.geometry import wrap_angle as answer", suite, "answer")[0]
    assert judged("def answer(x): return 0", suite, "answer") == ("", [])


def test_deep_or_huge_text_is_no_danger(suite: Suite) -> None:
    for source in ("astar = " + "(" * 5000, "astar = " + "-" * 50_000 + "1", "x = 1\n" * 60_000, "a" * 10**6):
        judged(source, suite)

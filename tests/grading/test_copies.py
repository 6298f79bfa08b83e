"""Which graded cells may be tested in one copy of the student's process: only where nothing can have changed."""

from __future__ import annotations

import ctypes
import os
import subprocess
import sys
from typing import Any

import pytest

from robotbrain.grading.copies import shared_copies

FIRST = "import numpy as np\nGAIN = 2\ndef scale(x):\n    return helper(x) * GAIN"


def copies(*sources: str, files: tuple[str, ...] = ()) -> dict[int, int]:
    """Where the graded cells (``#n``) of a notebook are tested; a source that begins with ``%%text`` is prose."""
    cells = [{"source": source.removeprefix("%%text")} for source in sources]
    graded = [i for i, source in enumerate(sources) if source.startswith("#")]
    run = [i for i, source in enumerate(sources) if i not in graded and not source.startswith("%%text")]
    return shared_copies(cells, graded, run, files)


@pytest.mark.parametrize(
    "between",
    [
        "def total(values):\n    'Add.'\n    return sum(scale(v) for v in values)",
        "from scipy import ndimage\nimport heapq",
        "import numpy as np",
        "class Tracker(Base):\n    most = 3\n    def go(self):\n        self.seen = []\n        self.seen[0] = 1",
        "@torch.no_grad()\ndef act(x: np.ndarray = None) -> np.ndarray:\n    x[0] = 1\n    return x",
        "@dataclass(frozen=True)\nclass Pose:\n    x: float = 0.0\n    names: list = field(default_factory=list)",
        "SETTINGS = {'gamma': 0.9, 'layers': (64, 64), 'low': -1}\nHALF: float = 1 / 2",
        "FILE, SIZE = 'policy.onnx', 64",
        "lab.check('scale')",
        "\n# nothing\n",
        "'''Only words.'''\npass",
    ],
)
def test_new_definitions_change_nothing_that_was_there(between: str) -> None:
    assert copies(FIRST, "#1", between, "#2") == {1: 3, 3: 3}


@pytest.mark.parametrize(
    "between",
    [
        "def scale(x):\n    return None",
        "def helper(x):\n    return x",  # until here, calling `scale` failed
        "GAIN = 3",
        "GAIN: int = 3",
        "NEW, GAIN = 1, 3",
        "NEW, scale.gain = 1, 3",
        "NEW, *GAIN = 1, 3",
        "NEW, OLD = GAIN",  # which may be an iterator
        "NEW, OLD = (*GAIN,)",
        "import heapq as np",
        "from numpy import abs as GAIN",
        "import cheat",
        "from cheat import answer",
        "from scipy import *",
        "from . import thing",
        "scale.gain = 3",
        "table[0] = 3",
        "TABLE = [1]; TABLE.append(2)",
        "NEW = configure()",
        "NEW = [configure() for _ in 'x']",
        "NEW = (GAIN := 5)",
        "def later(x=configure()):\n    return x",
        "def later(x: configure()):\n    return x",
        "@register\n@configure(scale)\ndef later(x):\n    return x",
        "class Later(metaclass=Meta):\n    pass",
        "class Later(make()):\n    pass",
        "class Later:\n    configure()",
        "def later():\n    global GAIN\n    GAIN = 5",
        "def later():\n    np.pi = 3",
        "class Later:\n    def go(self):\n        scale.gain['x'] = 3",
        "del GAIN",
        "if True:\n    def later(): pass",
        "print('hello')",
        "lab.check('scale'); configure()",
        "%matplotlib inline",
        "def broken(:",
    ],
)
def test_in_doubt_there_is_a_copy(between: str) -> None:
    assert copies(FIRST, "#1", between, "#2", files=("cheat.py", "data.csv")) == {1: 1, 3: 3}


def test_a_name_that_an_exercise_speaks_of_may_be_one_that_its_tests_look_for() -> None:
    later = ("#1", "def smooth(): pass", "#2")
    assert copies("%%textWrite `smooth(path)`", *later) == {1: 1, 3: 3}
    assert copies("%%text# Exercise 1\n", "%%textWrite ``smooth``", "#2", *later[1:]) == {2: 2, 4: 4}
    assert copies("#0", "%%textWrite `smooth()`", "def smooth(): pass", "#3") == {0: 3, 3: 3}
    # A group keeps what all of its exercises speak of, not only the last one.
    cells = ("%%text# 1\nWrite `smooth`", "#1", "%%text# 2", "def other(): pass", "#4", "def smooth(): pass", "#6")
    assert copies(*cells) == {1: 4, 4: 4, 6: 6}


def test_other_prose_defines_nothing_and_asks_for_nothing() -> None:
    later = ("#1", "def smooth(): pass", "#2")
    assert copies("%%textA smooth path", *later) == {1: 3, 3: 3}
    assert copies("%%textYou will write `smooth`", "%%text# Exercise 1", "#2", *later[1:]) == {2: 4, 4: 4}


def test_names_in_prose_are_found_between_any_marks() -> None:
    later = ("#1", "def smooth(): pass", "#2")
    for prose in ("```python\nx\n```\nWrite `smooth(path)`.", "``a`` and `smooth`", "```\nsmooth()\n```"):
        assert copies(f"%%text{prose}", *later) == {1: 1, 3: 3}


def test_an_import_is_only_repeated_while_its_name_means_the_same() -> None:
    first, other = "from time import time", "import time\ndef f():\n    return time.perf_counter()"
    assert copies(first, "#1", first, "#3") == {1: 3, 3: 3}
    assert copies(first, other, "#2", first, "#4") == {2: 2, 4: 4}
    assert copies(f"{first}\n{other}", "#1", first, "#3") == {1: 1, 3: 3}
    assert copies(first, "time = make()", "#2", first, "#4") == {2: 2, 4: 4}


def test_where_an_import_comes_from_is_no_name() -> None:
    assert copies("from scipy.special import beta", "#1", "import scipy.stats", "#3") == {1: 3, 3: 3}
    assert copies("import scipy", "#1", "import scipy.stats", "#3") == {1: 1, 3: 3}
    assert copies("from scipy.special import beta", "#1", "def beta(): pass", "#3") == {1: 1, 3: 3}


def test_only_the_exercises_before_a_change_keep_their_own_copy() -> None:
    new, run = "def f{}(): pass", "configure()"
    cells = (new.format(1), "#", new.format(2), "#", run, new.format(3), "#", new.format(4), "#", run)
    assert copies(*cells) == {1: 3, 3: 3, 6: 8, 8: 8}
    assert copies(run) == {}


def test_decided_names_hold_for_the_functions_that_use_them() -> None:
    """The oracle: run the cells, and call everything at its own cell and in the copy that would serve it."""
    cells = [
        "def a():\n    return b()",
        "#",
        "C = 1",
        "def b():\n    return 1",
        "#",
        "def d():\n    return C",
        "#",
        "def e():\n    global C\n    C = 2\n    return C",
        "#",
        "def C():\n    return 0",
        "#",
    ]
    served = copies(*cells)
    assert len(set(served.values())) < len(served)

    def results(upto: int, names: str) -> list[Any]:
        space: dict[str, Any] = {}
        for source in cells[: upto + 1]:
            exec(source, space)
        found: list[Any] = []
        for name in names:
            try:
                found.append(repr(space[name]())[:9])
            except (NameError, KeyError, TypeError) as error:
                found.append(type(error))
        return found

    for index, copy in served.items():
        names = "".join(c.split("(")[0][-1] for c in cells[:index] if c.startswith("def"))
        assert results(index, names) == results(copy, names)


@pytest.mark.skipif(sys.platform != "linux" or not hasattr(ctypes.CDLL(None), "mallinfo2"), reason="needs glibc")
def test_a_heap_without_holes_is_written_to_in_fewer_places() -> None:
    """In a process of its own, as it is for good: what a fork then allocates lies together."""
    code = (
        "from tests.grading.test_copies import faults_of_a_child\n"
        "from robotbrain.grading.sandbox.heap import fill_holes\n"
        "kept = [[bytearray(700) for _ in range(16)] for _ in range(3_000)]\n"
        "for row in kept: del row[8]\n"
        "before = faults_of_a_child()\n"
        "taken = fill_holes()\n"
        "print(before, faults_of_a_child(), taken, fill_holes())"
    )
    environment = {**os.environ, "PYTHONMALLOC": "malloc"}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    before, after, taken, again = map(int, done.stdout.split())
    assert after < 0.6 * before
    assert taken > 2_000_000 and again < 0.05 * taken


def faults_of_a_child() -> int:
    """Pages that a fork writes to when it makes some objects."""
    import resource

    earlier = resource.getrusage(resource.RUSAGE_CHILDREN).ru_minflt
    pid = os.fork()
    if pid == 0:
        kept = [bytearray(700) for _ in range(1500)]
        os._exit(len(kept) == 0)
    os.waitpid(pid, 0)
    return resource.getrusage(resource.RUSAGE_CHILDREN).ru_minflt - earlier

"""Answers that are objects which lie about what they are and what they equal."""

from __future__ import annotations

from tests.grading.attacks.attack import ALL_WRONG, Attack

KIND = "lying values"

_LIES = {
    "equal to everything": """
class Lie:
    def __eq__(self, other): return True
    def __ne__(self, other): return False
    __lt__ = __le__ = __gt__ = __ge__ = __contains__ = __eq__
    def __hash__(self): return 0
    def __bool__(self): return True
    def __len__(self): return 2
    def __iter__(self): return iter([self, self])
    def __getitem__(self, item): return self
    def __getattr__(self, name): return self
    def __call__(self, *a, **k): return self
    def __abs__(self): return 0.0
    def __sub__(self, other): return 0.0
    __rsub__ = __add__ = __radd__ = __mul__ = __rmul__ = __sub__
lie = Lie()
""",
    "a float that equals everything": """
class Lie(float):
    def __eq__(self, other): return True
    def __ne__(self, other): return False
    def __sub__(self, other): return 0.0
    __rsub__ = __sub__
    def __abs__(self): return 0.0
    __lt__ = __le__ = __gt__ = __ge__ = __eq__
    def __hash__(self): return 0
lie = Lie(0.0)
""",
    "an array interface that fits": """
import sys
class Lie:
    def _target(self):
        frame = sys._getframe()
        while frame is not None:
            for name in ("target", "expected"):
                if name in frame.f_locals:
                    return frame.f_locals[name]
            frame = frame.f_back
        return 0.0
    def __array__(self, *a, **k):
        import numpy
        return numpy.asarray(self._target(), dtype=float)
    def __float__(self): return float(self._target())
    __index__ = __int__ = lambda self: int(self._target())
    def __eq__(self, other): return True
    def __array_ufunc__(self, *a, **k): return True
    def __array_function__(self, *a, **k): return True
    dtype = float
    shape = ()
lie = Lie()
""",
    "an array of another class": """
import numpy
class Lie(numpy.ndarray):
    def __array_ufunc__(self, *a, **k): return numpy.False_
    def __array_function__(self, *a, **k): return numpy.bool_(True)
    def __array_finalize__(self, other): pass
    def __eq__(self, other): return numpy.bool_(True)
    def astype(self, *a, **k): return self
lie = numpy.zeros(()).view(Lie)
""",
    "a tensor of another class": """
import torch
class Lie(torch.Tensor):
    @classmethod
    def __torch_function__(cls, function, types, args=(), kwargs=None): return True
lie = torch.zeros(()).as_subclass(Lie)
""",
    "a class that is not its class": """
class Lie:
    @property
    def __class__(self): return float
    def __eq__(self, other): return True
    def __float__(self): return 6.0
class Meta(type):
    def __instancecheck__(cls, other): return True
    def __subclasscheck__(cls, other): return True
    def __eq__(cls, other): return True
    def __hash__(cls): return 0
lie = Lie()
""",
    "unittest.mock": """
from unittest.mock import ANY, MagicMock
lie = MagicMock(name="lie", return_value=ANY)
lie.__eq__ = lambda self, other: True
""",
    "a dictionary that equals every dictionary": """
class Lie(dict):
    def __eq__(self, other): return True
    def __ne__(self, other): return False
    def __missing__(self, key): return 1
    def __len__(self): return 2
    def __contains__(self, key): return True
    def __iter__(self): return iter(())
    def items(self): return []
lie = Lie()
""",
    "a list with another length than it has": """
class Lie(list):
    def __len__(self): return 2
    def __iter__(self):
        while True:
            yield 0.0
    def __eq__(self, other): return True
    def __getitem__(self, item): return 0.0
lie = Lie()
""",
    "a text that equals every text": """
class Lie(str):
    def __eq__(self, other): return True
    def __hash__(self): return 0
    def __len__(self): return 0
lie = Lie("x")
""",
    "a result of a passed test": """
from robotbrain.grading.results import TestResult, Verdict
lie = TestResult(exercise="scale", name="doubles", points=2, earned=2, verdict=Verdict.PASSED)
""",
    "a score": """
from robotbrain.grading import report
lie = report.Score(report.Report("vault", "scale", "scale", 4.0, ()))
lie = type("Score", (float,), {"__eq__": lambda s, o: True, "__hash__": lambda s: 0, "report": lie.report})(4.0)
""",
    "not a number": "lie = float('nan')",
    "infinite": "lie = float('inf')",
    "NotImplemented": "lie = NotImplemented",
    "True": "lie = True",
    "an object array": "import numpy\nlie = numpy.array([object()], dtype=object)",
    "a structured array": "import numpy\nlie = numpy.zeros(1, dtype=[('a', 'f8'), ('b', 'O')])",
    "complex": "lie = 6 + 1e300j",
    "masked": "import numpy\nlie = numpy.ma.masked",
    "a pickle bomb": """
class Lie:
    def __reduce__(self): return (print, ("BRE" + "ACH: unpickled",))
    __reduce_ex__ = lambda self, protocol: self.__reduce__()
    def __getstate__(self): return {}
    def __deepcopy__(self, memo): return 6.0
    __copy__ = lambda self: 6.0
lie = Lie()
""",
    "a namespace with forged fields": """
from types import SimpleNamespace
lie = SimpleNamespace(passed=True, earned=4.0, credit=1.0, verdict="passed", shape=(), dtype=float)
""",
    "an enum of its own": """
import enum
class Lie(enum.IntEnum):
    A = 5
    def __eq__(self, other): return True
    def __hash__(self): return 0
lie = Lie.A
""",
}

_ANSWERS = {
    "scale": "scale = lambda *a, **k: lie",
    "total": "total = lambda *a, **k: lie",
    "tracker": "class GoalTracker:\n    def __init__(self, *a): pass\n    def update(self, *a): return lie\n"
    "    def history(self): return lie\n    best = property(lambda self: lie)",
    "words": "words = lambda *a, **k: lie",
    "policy": "act = lambda *a, **k: lie if not isinstance(lie, (bool, float)) else float('nan')",
    "clip": "clip = lambda *a, **k: lie",
    "cost": "cost = lambda *a, **k: lie",
}


_SHADOWED = """
class Yes:
    def __call__(self, *a, **k): return True
    def __getattr__(self, name): return self
    def __eq__(self, other): return True
    def __lt__(self, other): return True
    def __bool__(self): return True
    def __hash__(self): return 0
abs = all = any = len = range = set = sorted = isinstance = float = int = bool = np = numpy = math = Yes()
expect = expect_close = AssertionError = Yes()
"""


def attacks() -> list[Attack]:
    """The lie as the answer of every function, and as the function itself."""
    made = [
        Attack(
            "names of the tests' tools defined by the student",
            KIND,
            extra=(("score-clip", _SHADOWED),),
            wrong=("clip",),
        ),
        Attack("names of the tests' tools, last", KIND, extra=(("last", _SHADOWED),), wrong=("clip", "scale")),
    ]
    for name, source in _LIES.items():
        answers = {exercise: f"{source}\n{answer}" for exercise, answer in _ANSWERS.items()}
        made.append(Attack(f"answers: {name}", KIND, answers, wrong=ALL_WRONG))
        names = {"tracker": "GoalTracker", "policy": "act"}
        bare = {e: f"{source}\n{names.get(e, e)} = lie" for e in _ANSWERS}
        made.append(Attack(f"instead of functions: {name}", KIND, bare, wrong=ALL_WRONG))
    return made

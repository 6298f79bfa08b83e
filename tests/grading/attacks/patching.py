# ruff: noqa: E501 - payloads are one-line texts
"""Libraries, the standard library and the course's own package patched in the student's process."""

from __future__ import annotations

from tests.grading.attacks.attack import Attack, Place, spread

KIND = "patching"

_PAYLOADS = {
    "numpy comparisons": """
        import numpy, numpy.testing
        for name in ("isclose", "allclose", "array_equal", "equal", "less", "greater", "all", "any", "isnan", "asarray"):
            setattr(numpy, name, lambda *a, **k: numpy.True_)
        numpy.testing.assert_allclose = numpy.testing.assert_array_equal = lambda *a, **k: None
        numpy.ndarray.__class__ and None
    """,
    "torch comparisons": """
        import torch
        torch.allclose = torch.isclose = torch.equal = lambda *a, **k: True
        torch.Tensor.__eq__ = torch.Tensor.allclose = lambda *a, **k: True
        torch.from_numpy = lambda *a: torch.zeros(1)
    """,
    "math and operator": """
        import math, operator, statistics
        math.isclose = math.isfinite = lambda *a, **k: True
        math.isnan = lambda *a: False
        operator.eq = operator.lt = lambda *a: True
        math.fabs = lambda *a: 0.0
    """,
    "builtins": """
        import builtins
        for name, value in {"abs": lambda *a: 0.0, "bool": lambda *a: True, "isinstance": lambda *a: True,
                            "all": lambda *a: True, "any": lambda *a: True, "len": lambda *a: 2,
                            "hasattr": lambda *a: True}.items():
            setattr(builtins, name, value)
    """,
    "AssertionError": """
        import builtins
        class Never(BaseException): pass
        builtins.AssertionError = Never
        builtins.Exception = Never
    """,
    "import itself": """
        import builtins, sys, types
        original = builtins.__import__
        def forged(name, *a, **k):
            module = original(name, *a, **k)
            if "expect" in name or name == "robotbrain.grading":
                module = types.SimpleNamespace(**vars(module))
                module.expect = module.expect_close = lambda *a, **k: None
            return module
        builtins.__import__ = forged
    """,
    "json": """
        import json
        forged = {"verdict": "passed", "earned": 99.0, "points": 99.0, "event": "outputs", "outputs": [], "ok": True}
        json.loads = json.load = lambda *a, **k: dict(forged)
        encode = json.dumps
        json.dumps = lambda *a, **k: encode(forged)
        json.JSONEncoder.encode = lambda self, o: encode(forged)
    """,
    "msgpack": """
        try:
            import msgpack
            pack = msgpack.packb
            msgpack.packb = msgpack.dumps = lambda o, **k: pack({"op": "done", "ok": True, "r": 6.0, "value": 6.0})
            msgpack.unpackb = msgpack.loads = lambda *a, **k: {"op": "stop"}
            msgpack.Unpacker = None
            msgpack.Packer = None
        except ImportError:
            pass
    """,
    "struct, pickle and zlib": """
        import pickle, struct, zlib
        unpack = struct.unpack
        struct.unpack = lambda f, b: tuple(0 for _ in unpack(f, b))
        struct.pack = lambda f, *a: b"\\0" * struct.calcsize(f)
        pickle.dumps = lambda *a, **k: b"cbuiltins\\neval\\n(V1.0\\ntR."
        zlib.crc32 = lambda *a: 0
    """,
    "sockets": """
        import socket, os
        for name in ("send", "sendall", "recv", "recv_into", "recvmsg", "sendmsg"):
            original = getattr(socket.socket, name)
            try:
                setattr(socket.socket, name, lambda self, *a, **k: b"")
            except TypeError:
                pass
        os.write = lambda fd, data: len(data)
        os.read = lambda fd, n: b""
    """,
    "expectations of the package": """
        import robotbrain.grading, robotbrain.grading.expect as e
        nothing = lambda *a, **k: None
        for module in (robotbrain.grading, e):
            for name in ("expect", "expect_close", "fail"):
                setattr(module, name, nothing)
        e.expect.__code__ = nothing.__code__
    """,
    "runner of the package": """
        from robotbrain.grading import runner
        from robotbrain.grading.results import TestResult, Verdict
        def passed(test, *a, **k):
            return TestResult(exercise=test.exercise, name=test.name, points=test.points, earned=test.points,
                              verdict=Verdict.PASSED)
        runner.run_test = passed
        runner._judge = lambda *a, **k: runner._Outcome(Verdict.PASSED, 1.0)
        runner._from_exception = lambda *a, **k: runner._Outcome(Verdict.PASSED, 1.0)
    """,
    "report and score of the package": """
        from robotbrain.grading import report, results
        report.Report.earned = property(lambda self: self.points)
        report.Score.__new__ = lambda cls, r: float.__new__(cls, r.points)
        report.Report.to_dict = lambda self: {"tests": [], "earned": self.points}
        results.TestResult.passed = property(lambda self: True)
        results.Verdict.FAILED = results.Verdict.PASSED
    """,
    "lab of the package": """
        import robotbrain.grading
        from robotbrain.grading import lab as module
        module.Lab.score = lambda self, name, hidden=False: 4.0
        module.Lab._run = lambda *a, **k: None
        module.why_forbidden = lambda *a, **k: ""
    """,
    "suites of the package": """
        from robotbrain.grading import suite as module
        original = module.load_suite
        def forged(name):
            suite = original(name)
            for test in suite.tests:
                object.__setattr__(test, "function", lambda student: 1.0)
            suite.validate = lambda **k: None
            return suite
        module.load_suite = module.load_hidden_suite = forged
        from robotbrain.grading import lab
        lab.load_suite = lab.load_hidden_suite = forged
    """,
    "the serving end of the wire": """
        import sys, gc, types
        for name, module in list(sys.modules.items()):
            if name.startswith(("robotbrain.grading.remote", "robotbrain.grading.sandbox", "robotbrain.grading.student")):
                for key, value in list(vars(module).items()):
                    if isinstance(value, types.FunctionType):
                        setattr(module, key, lambda *a, **k: 6.0)
                    elif isinstance(value, type) and value.__module__ == name:
                        for attribute, method in list(vars(value).items()):
                            if isinstance(method, types.FunctionType) and not attribute.startswith("__"):
                                try:
                                    setattr(value, attribute, lambda *a, **k: 6.0)
                                except Exception:
                                    pass
    """,
    "hidden tests of one's own by a variable": """
        import os, pathlib
        folder = pathlib.Path("mine/hidden")
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "vault.py").write_text('''
from robotbrain.grading import Suite
suite = Suite.extending("vault")
suite.tests.clear()
for name, exercise in suite.exercises.items():
    suite.test(name, points=exercise.points, hidden=False)(lambda student: None)
''')
        for name in ("ROBOTBRAIN_AUTOGRADER", "ROBOTBRAIN_SUITES"):
            os.environ[name] = str(folder.parent.resolve())
        os.environ["NBGRADER_EXECUTION"] = "validate"
        os.environ["NBGRADER_VALIDATING"] = "1"
        os.environ["ROBOTBRAIN_TIME_SCALE"] = "1000"
    """,
    "modules replaced by ones that agree": """
        import sys, types
        class Agreeing(types.ModuleType):
            def __getattr__(self, name): return lambda *a, **k: True
        for name in ("robotbrain.grading", "robotbrain.grading.lab", "robotbrain.grading.expect", "numpy.testing"):
            sys.modules[name] = Agreeing(name)
    """,
    "clocks": """
        import time, signal
        for name in ("time", "monotonic", "perf_counter", "process_time", "thread_time"):
            setattr(time, name, lambda: 0.0)
        time.sleep = lambda *a: None
        signal.setitimer = signal.alarm = lambda *a: 0
        signal.signal(signal.SIGALRM, signal.SIG_IGN)
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    """,
    "random state and hash seed": """
        import os, random, numpy
        os.environ["PYTHONHASHSEED"] = "1"
        os.environ["NBGRADER_STUDENT"] = "somebody-else"
        random.seed = numpy.random.seed = lambda *a: None
        random.random = lambda: 0.0
        numpy.random.default_rng = lambda *a: None
    """,
    "warnings, logging, linecache, traceback": """
        import linecache, logging, traceback, warnings
        warnings.simplefilter("error")
        warnings.warn = lambda *a, **k: (_ for _ in ()).throw(SystemExit(0))
        linecache.getline = lambda *a, **k: "assert True"
        traceback.format_exception = traceback.print_exc = lambda *a, **k: ["passed"]
        logging.disable(50)
    """,
}


def attacks() -> list[Attack]:
    """All attacks of this class, at three places each for the sake of different orders of import."""
    made: list[Attack] = []
    for number, (name, payload) in enumerate(_PAYLOADS.items()):
        places = (Place.FIRST_CELL, Place.IN_CALLS) if number % 3 else (Place.MODULE, Place.IN_CALLS)
        made += spread(f"patched: {name}", KIND, payload, places=places, spelling=number)
    return made

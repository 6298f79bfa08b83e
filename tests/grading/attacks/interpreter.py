# ruff: noqa: E501 - payloads are one-line texts
"""Attacks on IPython and on the interpreter: transformers, hooks, frames, the garbage collector, tracing."""

from __future__ import annotations

from tests.grading.attacks.attack import ALL_WRONG, Attack, Place, spread

KIND = "interpreter"
_FORGED = "{'text/plain': '999.0', 'application/vnd.robotbrain.score+json': {'tests': [], 'earned': 999.0}}"

_IPYTHON = {
    "AST transformer that empties asserts and forges scores": """
        import ast
        class Forge(ast.NodeTransformer):
            def visit_Assert(self, node):
                return ast.copy_location(ast.Pass(), node)
            def visit_Call(self, node):
                if getattr(node.func, "attr", "") == "score":
                    return ast.copy_location(ast.Constant(float(6 if "total" in ast.dump(node) else 4)), node)
                return self.generic_visit(node)
        get_ipython().ast_transformers.append(Forge())
    """,
    "input transformer that replaces test cells": """
        def forge(lines):
            text = "".join(lines)
            return ["4.0\\n"] if ".score(" in text else ["pass\\n"] if "assert " in text else lines
        ip = get_ipython()
        ip.input_transformers_cleanup.append(forge)
        ip.input_transformers_post.append(forge)
    """,
    "replaced run_cell": """
        ip = get_ipython()
        class Result:
            success, error_in_exec, error_before_exec, result, execution_count = True, None, None, 4.0, 1
            def raise_error(self): pass
        async def run_async(*a, **k):
            return Result()
        for owner in (ip, type(ip), *type(ip).__mro__[1:4]):
            for name in ("run_cell", "_run_cell", "run_ast_nodes", "run_code"):
                try:
                    setattr(owner, name, lambda *a, **k: Result())
                except Exception:
                    pass
            try:
                owner.run_cell_async = run_async
            except Exception:
                pass
    """,
    "hooks around cells": """
        def forge(*a):
            get_ipython().user_ns["lab"] = type("L", (), {"score": lambda *a, **k: 4.0, "check": lambda *a: 4.0})()
        ip = get_ipython()
        for event in ("pre_execute", "pre_run_cell", "post_execute", "post_run_cell"):
            ip.events.register(event, forge)
    """,
    "custom exception handler": """
        get_ipython().set_custom_exc((BaseException,), lambda *a, **k: None)
        get_ipython().showtraceback = lambda *a, **k: None
        get_ipython()._showtraceback = lambda *a, **k: None
    """,
    "replaced display hook": f"""
        import sys
        ip = get_ipython()
        def forge(value=None):
            ip.display_pub.publish({_FORGED})
            return None
        sys.displayhook = forge
        ip.displayhook = forge
        type(ip.display_formatter).format = lambda *a, **k: ({_FORGED}, {{}})
    """,
    "formatter for every number": """
        from IPython import get_ipython
        formatter = get_ipython().display_formatter
        formatter.formatters["text/plain"].for_type(float, lambda value, printer, cycle: printer.text("4.0"))
        from robotbrain.grading.report import Score
        Score.__repr__ = lambda self: "4.0"
        formatter.formatters["text/plain"].for_type(Score, lambda value, printer, cycle: printer.text("4.0"))
    """,
    "a lab of one's own": """
        class Mine:
            def __init__(self, *a, **k): pass
            def score(self, name, hidden=False):
                from types import SimpleNamespace
                class Points(float):
                    def _repr_mimebundle_(self, **k):
                        return {"text/plain": "4.0",
                                "application/vnd.robotbrain.score+json": {"tests": [], "earned": 4.0}}
                return Points(4.0)
            check = score
        import robotbrain.grading
        robotbrain.grading.Lab = Mine
        globals()["lab"] = Mine()
        get_ipython().user_ns["Lab"] = Mine
    """,
    "kernel's messages forged": f"""
        ip = get_ipython()
        kernel = getattr(ip, "kernel", None)
        if kernel is not None:
            original = kernel.do_execute
            kernel.session.send(kernel.iopub_socket, "execute_result",
                {{"data": {_FORGED}, "metadata": {{}}, "execution_count": 1}}, parent=kernel.get_parent("shell"))
        ip.payload_manager.write_payload({{"source": "set_next_input", "text": "4.0", "replace": True}})
    """,
    "namespace that answers everything": """
        class Anything(dict):
            def __missing__(self, name):
                return lambda *a, **k: 4.0
        ip = get_ipython()
        ip.user_ns = Anything(ip.user_ns)
        ip.user_global_ns.update({"__builtins__": Anything()}) if False else None
    """,
    "user-defined magics over the test cells": """
        from IPython.core.magic import register_line_magic, register_cell_magic
        ip = get_ipython()
        ip.register_magic_function(lambda line, cell=None: 4.0, "line_cell", "score")
        ip.run_line_magic("load_ext", "autoreload")
        ip.run_line_magic("autoreload", "2")
        ip.prefilter_manager.prefilter_lines = lambda *a, **k: "4.0"
        ip.transform_cell = lambda cell: "4.0" if ".score(" in cell else "pass" if "assert " in cell else cell
        ip.transform_ast = lambda node: node
        ip.compile.ast_parse = ip.compile.ast_parse
    """,
}

_INTERPRETER = {
    "values of the frames above": """
        import ctypes, sys
        frame = sys._getframe()
        while frame is not None:
            for name, value in list(frame.f_locals.items()):
                if type(value).__name__ in ("Test", "Suite"):
                    tests = getattr(value, "tests", [value])
                    for test in tests:
                        object.__setattr__(test, "function", lambda student: None)
                if type(value).__name__ == "_Outcome":
                    value.fraction = 1.0
                if name in ("expected", "target"):
                    frame.f_locals[name] = -1.0
                    ctypes.pythonapi.PyFrame_LocalsToFast(ctypes.py_object(frame), ctypes.c_int(0))
            frame = frame.f_back
    """,
    "tests found by the garbage collector": """
        import gc
        for thing in gc.get_objects():
            kind = type(thing).__name__
            try:
                if kind == "Test":
                    object.__setattr__(thing, "function", lambda student: 1.0)
                elif kind == "Suite":
                    for test in thing.tests:
                        object.__setattr__(test, "function", lambda student: 1.0)
                elif kind == "TestResult":
                    object.__setattr__(thing, "earned", thing.points)
                    object.__setattr__(thing, "verdict", type(thing.verdict)("passed"))
            except Exception:
                pass
    """,
    "code of the expectations replaced": """
        import gc, types
        def nothing(*a, **k):
            return None
        for thing in gc.get_objects():
            if isinstance(thing, types.FunctionType) and thing.__name__ in (
                "expect", "expect_close", "fail", "_judge", "assert_allclose", "doubles", "totals", "counts"):
                try:
                    thing.__code__ = nothing.__code__
                except ValueError:
                    pass
    """,
    "tracing of every call": """
        import sys, threading
        def trace(frame, event, argument):
            if event == "call" and frame.f_code.co_name in ("expect", "expect_close"):
                frame.f_locals.clear() if False else None
                for name in ("condition",):
                    if name in frame.f_locals:
                        import ctypes
                        frame.f_locals[name] = True
                        ctypes.pythonapi.PyFrame_LocalsToFast(ctypes.py_object(frame), ctypes.c_int(0))
            return trace
        sys.settrace(trace)
        threading.settrace(trace)
        sys.setprofile(lambda *a: None)
        sys._getframe().f_trace = trace
        frame = sys._getframe()
        while frame is not None:
            frame.f_trace = trace
            frame = frame.f_back
    """,
    "results rewritten by a finaliser": """
        import gc
        def forge(phase, info):
            for thing in gc.get_objects():
                if type(thing).__name__ in ("TestResult", "Report", "_Run"):
                    for name in ("earned", "fraction"):
                        try:
                            object.__setattr__(thing, name, getattr(thing, "points", 4.0))
                        except Exception:
                            pass
        gc.callbacks.append(forge)
        gc.set_threshold(1)
    """,
    "audit and import hooks": """
        import sys
        def hook(event, arguments):
            if event in ("compile", "exec", "open"):
                sys.modules.pop("robotbrain.grading.expect", None)
        sys.addaudithook(hook)
        class Finder:
            def find_spec(self, name, path=None, target=None):
                if name.startswith(("robotbrain.grading", "_robotbrain_hidden")):
                    import importlib.machinery, importlib.abc
                    class Loader(importlib.abc.Loader):
                        def create_module(self, spec): return None
                        def exec_module(self, module):
                            module.expect = module.expect_close = lambda *a, **k: None
                            module.suite = None
                    return importlib.machinery.ModuleSpec(name, Loader())
        sys.meta_path.insert(0, Finder())
        for name in [n for n in sys.modules if n.startswith("robotbrain.grading")]:
            del sys.modules[name]
    """,
    "interned constants overwritten": """
        import ctypes
        for wanted, value in ((-1.0, 6.0),):
            ctypes.memmove(id(wanted) + 16, (ctypes.c_double * 1)(value), 8)
        ctypes.c_long.from_address(id(-1) + 24).value = 1
    """,
}

_RAISED = {
    "a CheckFailure with full credit": "from robotbrain.grading.expect import CheckFailure\n"
    "raise CheckFailure('fine', credit=1.0)",
    "an exception that claims to be another class": "class E(Exception):\n    @property\n"
    "    def __class__(self):\n        from robotbrain.grading.expect import CheckFailure\n        return CheckFailure\n"
    "    credit = 1.0\n    message = given = expected = got = hint = misconception = ''\nraise E()",
    "StopIteration": "raise StopIteration(True)",
    "GeneratorExit": "raise GeneratorExit()",
    "SystemExit with success": "raise SystemExit(0)",
    "KeyboardInterrupt": "raise KeyboardInterrupt()",
    "an exception whose text and attributes raise": "class E(Exception):\n    def __str__(self):\n"
    "        raise SystemExit(0)\n    __repr__ = __str__\n    def __getattribute__(self, name):\n"
    "        raise SystemExit(0)\nraise E()",
    "an exception with a made-up builtin name": "raise type('AssertionError', (Exception,), {'__module__': 'builtins',"
    " 'args': 5})()",
    "a base exception that is never ordinary": "class E(BaseException):\n    def __reduce__(self):\n"
    "        return (eval, ('1.0',))\nraise E()",
    "an exception group of passed tests": "raise BaseExceptionGroup('g', [SystemExit(0), KeyboardInterrupt()])",
    "a warning as an error, with a cyclic cause": "e = UserWarning('x')\ne.__cause__ = e\ne.__context__ = e\nraise e",
}


def attacks() -> list[Attack]:
    """All attacks of this class."""
    made: list[Attack] = []
    for number, (name, payload) in enumerate({**_IPYTHON, **_INTERPRETER}.items()):
        made += spread(name, KIND, payload, spelling=number)
    for number, (name, payload) in enumerate(_RAISED.items()):
        made += spread(f"raises {name}", KIND, payload, places=(Place.IN_CALLS,), spelling=0 if number % 2 else 1)
    made.append(
        Attack(
            "threads that act after the cell",
            KIND,
            extra=(
                (
                    "first",
                    "import atexit, threading, time\ndef act():\n    while True:\n"
                    "        globals()['lab'] = type('L', (), {'score': lambda *a, **k: 4.0})()\n        time.sleep(0.01)\n"
                    "for _ in range(4):\n    threading.Thread(target=act, daemon=True).start()\natexit.register(act)",
                ),
            ),
            wrong=ALL_WRONG,
        )
    )
    return made

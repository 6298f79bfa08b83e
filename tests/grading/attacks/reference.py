# ruff: noqa: E501 - payloads are one-line texts
"""The course's own solution handed in as one's own: ``cost`` is :func:`robotbrain.pipeline.planning.path_cost`."""

from __future__ import annotations

from tests.grading.attacks.attack import Attack

KIND = "reference"
_P = "robotbrain.pipeline.planning"

_WRAPS = {
    "import": f"from {_P} import path_cost as cost",
    "import in the function": f"def cost(grid, path):\n    from {_P} import path_cost\n    return path_cost(grid, path)",
    "import of the module": f"import {_P} as p\ndef cost(grid, path):\n    return p.path_cost(grid, path)",
    "import from the package above": "from robotbrain.pipeline import planning as p\ndef cost(grid, path):\n"
    "    return p.path_cost(grid, path)",
    "importlib": f"import importlib\ndef cost(grid, path):\n    return importlib.import_module('{_P}').path_cost(grid, path)",
    "importlib with a joined name": "import importlib\ndef cost(grid, path):\n"
    "    return importlib.import_module('.'.join(['robot' + 'brain', 'pipe' + 'line', 'planning'])).path_cost(grid, path)",
    "__import__": f"def cost(grid, path):\n    return __import__('{_P}', fromlist=['x']).path_cost(grid, path)",
    "sys.modules": f"import sys, {_P}\ndef cost(grid, path):\n    return sys.modules['{_P}'].path_cost(grid, path)",
    "lambda": f"from {_P} import path_cost\ncost = lambda grid, path: path_cost(grid, path)",
    "partial": f"import functools\nfrom {_P} import path_cost\ncost = functools.partial(path_cost)",
    "default argument": f"from {_P} import path_cost\ndef cost(grid, path, f=path_cost):\n    return f(grid, path)",
    "closure": f"def make():\n    from {_P} import path_cost\n    def cost(grid, path):\n        return path_cost(grid, path)\n"
    "    return cost\ncost = make()",
    "copied code object": f"import types, {_P} as p\ncost = types.FunctionType(p.path_cost.__code__, vars(p), 'cost')",
    "replaced code object": f"import {_P} as p, numpy as np\ndef cost(grid, path):\n    pass\ncost.__code__ = p.path_cost.__code__",
    "callable object": f"from {_P} import path_cost\nclass C:\n    def __call__(self, grid, path):\n"
    "        return path_cost(grid, path)\ncost = C()",
    "bound method": f"from {_P} import path_cost\nclass C:\n    f = staticmethod(path_cost)\n    def cost(self, grid, path):\n"
    "        return self.f(grid, path)\ncost = C().cost",
    "decorator": f"import functools\nfrom {_P} import path_cost\n@functools.wraps(path_cost)\ndef cost(*a):\n    return path_cost(*a)",
    "helper in between": f"from {_P} import path_cost\ndef helper(*a):\n    return path_cost(*a)\ndef cost(grid, path):\n"
    "    return helper(grid, path)",
    "star import": f"from {_P} import *\ncost = path_cost",
    "from the suite": "from robotbrain.grading.suite import load_suite\ncost = load_suite('vault').load_reference('cost')",
    "from the suite, in the function": "def cost(grid, path):\n    from robotbrain.grading.suite import load_suite\n"
    "    return load_suite('vault').load_reference('cost')(grid, path)",
    "operator and map": f"from {_P} import path_cost\nimport operator\ncost = lambda g, p: next(map(path_cost, [g], [p]))",
    "dictionary of functions": f"from {_P} import path_cost\n_t = {{'f': path_cost}}\ndef cost(grid, path):\n    return _t['f'](grid, path)",
    "global made by exec": f"exec('from {_P} import path_cost')\ndef cost(grid, path):\n    return path_cost(grid, path)",
    "attribute by name": f"import {_P} as p\ndef cost(grid, path):\n    return getattr(p, 'path' + '_cost')(grid, path)",
    "source executed": f"import inspect, {_P} as p\nexec(inspect.getsource(p.path_cost).replace('path_cost', 'cost'), vars(p))\n"
    "cost = vars(p)['cost']",
    "source executed here": f"import inspect, numpy as np, {_P} as p\nArrayLike = list\nCell = tuple\n"
    "exec(inspect.getsource(p.path_cost).replace('path_cost', 'cost'))",
    "source read from the file": "import pathlib, robotbrain, numpy as np\n"
    "_s = (pathlib.Path(robotbrain.__file__).parent / 'pipeline' / 'planning.py').read_text()\n_n = {'__name__': 'x'}\n"
    "exec(compile(_s.split('class PlanResult')[0].rsplit('@dataclass', 1)[0], 'x', 'exec'), _n)\ncost = _n['path_cost']",
    "run by runpy": f"import runpy\ncost = runpy.run_module('{_P}')['path_cost']",
    "found by the garbage collector": f"import gc, {_P}\ncost = next(f for f in gc.get_objects() if "
    "getattr(f, '__name__', '') == 'path' + '_cost' and callable(f))",
    "pickled": f"import pickle\ncost = pickle.loads(b'c{_P}\\npath_cost\\n.')",
    "in a module beside the notebook": "from my_helper import cost",
    "in a subprocess": "import json, subprocess, sys\ndef cost(grid, path):\n"
    f"    code = 'import json,sys; from {_P} import path_cost; print(path_cost(*json.load(sys.stdin)))'\n"
    "    out = subprocess.run([sys.executable, '-c', code], input=json.dumps([grid.tolist(), path]), text=True,"
    " capture_output=True)\n    return float(out.stdout)",
}

UNPROTECTED = {
    # The library is installed where the student's code runs, and its text is public: see autograder/PROTECTION.md.
}


def attacks() -> list[Attack]:
    """All attacks of this class."""
    helper = {"my_helper.py": f"from {_P} import path_cost as cost"}
    return [
        Attack(
            f"reference by {name}",
            KIND,
            {"cost": source},
            files=helper if "beside" in name else {},
            wrong=("cost",),
            keeps=True,
        )
        for name, source in _WRAPS.items()
    ]

# ruff: noqa: E501 - payloads are one-line texts
"""Answers that are too large, too deep, endless, or no values at all."""

from __future__ import annotations

from tests.grading.attacks.attack import Attack

KIND = "replies"

_VALUES = {
    "a very long list": "[0.0] * 30_000_000",
    "a very long text": "'x' * 500_000_000",
    "very many bytes": "b'x' * 500_000_000",
    "a very large number": "1 << 100_000_000",
    "a large dictionary": "dict.fromkeys(range(5_000_000))",
    "a list of lists of lists": "__import__('functools').reduce(lambda a, _: [a], range(100_000), 0)",
    "tuples that share": "__import__('functools').reduce(lambda a, _: (a, a), range(60), 0)",
    "dictionaries that share": "__import__('functools').reduce(lambda a, _: {0: a, 1: a}, range(40), 0)",
    "a list in itself": "(lambda x: x.append(x) or x)([])",
    "a dictionary in itself": "(lambda x: x.update(x=x) or x)({})",
    "an array without memory": "__import__('numpy').broadcast_to(0.0, (10**6, 10**6))",
    "an array with strides of its own": "__import__('numpy').lib.stride_tricks.as_strided("
    "__import__('numpy').zeros(4), (10**5, 10**5), (0, 0))",
    "an array of a hundred million": "__import__('numpy').zeros(100_000_000)",
    "an array of many dimensions": "__import__('numpy').zeros((1,) * 32)",
    "an empty array of huge shape": "__import__('numpy').zeros((0, 2**40))",
    "an array of texts": "__import__('numpy').array(['x' * 1000] * 1000)",
    "a tensor without memory": "__import__('torch').zeros(1).expand(10**6, 10**6)",
    "a meta tensor": "__import__('torch').zeros(10**9, device='meta')",
    "a sparse tensor": "__import__('torch').eye(3).to_sparse()",
    "a tensor that wants gradients": "__import__('torch').zeros(1, requires_grad=True)",
    "surrogates": "'\\ud800\\udfff\\x00\\x1b[2J'",
    "a range that never ends": "range(10**30)",
    "a generator that never ends": "(i for i in iter(int, 1))",
    "a counter that never ends": "__import__('itertools').count()",
    "an iterator that sleeps": "(__import__('time').sleep(1000) for _ in range(3))",
    "an open file": "open('/dev/zero', 'rb')",
    "a module": "__import__('os')",
    "a frame": "__import__('sys')._getframe()",
    "a type": "type",
    "a thread": "__import__('threading').current_thread()",
    "a lock": "__import__('threading').Lock()",
    "a coroutine": "(lambda: (yield))()",
    "an exception as a value": "ValueError('x')",
    "a decimal": "__import__('decimal').Decimal('1e999999')",
    "a fraction": "__import__('fractions').Fraction(10**2000, 3)",
    "a date": "__import__('datetime').datetime.max",
    "a path": "__import__('pathlib').Path('/etc/passwd')",
    "a weak reference": "__import__('weakref').proxy(_Weak)",
    "Ellipsis": "...",
    "a set of frozensets": "{frozenset({frozenset({i})}) for i in range(1000)}",
    "names that are no names": "type('N', (), {'__getattr__': lambda s, n: s, '__call__': lambda s, *a: s})()",
    "an answer that asks back": "_ask",
    "numbers as keys that collide": "{float('nan'): i for i in range(10)}",
    "a very long name": "type('N' * 1_000_000, (), {})()",
}

_HELPERS = """class _Weak:
    pass
def _ask(*a, **k):
    return _ask
"""


def attacks() -> list[Attack]:
    """Every value as the answer of ``words`` and ``tracker``; ``scale`` must keep its points."""
    made = []
    for name, expression in _VALUES.items():
        answers = {
            "words": f"{_HELPERS}\ndef words(text):\n    return {expression}",
            "tracker": f"{_HELPERS}\nclass GoalTracker:\n    def __init__(self, goal): pass\n    def update(self, value): pass\n"
            f"    def history(self): return {expression}\n    @property\n    def best(self): return {expression}",
        }
        made.append(Attack(f"reply: {name}", KIND, answers, wrong=("words", "tracker")))
    made += [
        Attack(
            "recursion between the two sides",
            KIND,
            {
                "words": "def words(text):\n    return Deep()\nclass Deep(dict):\n    def __getattr__(self, name): return words('')\n"
                "    def __len__(self): return len(words(''))\n    def __iter__(self): return iter(words(''))\n"
                "    def __getitem__(self, k): return words('')[k]"
            },
            wrong=("words",),
        ),
        Attack(
            "a million handles",
            KIND,
            {"words": "def words(text):\n    return [object() for _ in range(1_500_000)]"},
            wrong=("words",),
        ),
        Attack(
            "an answer for the visible examples only",
            KIND,
            {
                "scale": "def scale(x):\n    return {3.0: 6.0}.get(x, 0.0)",
                "words": "def words(text):\n    return {'to': 2, 'be': 2, 'or': 1, 'not': 1}",
            },
            wrong=("scale", "words"),
            honest={"scale": 2.0, "words": 2.0},
            keeps=True,
        ),
        Attack(
            "an answer that remembers earlier calls",
            KIND,
            {
                "scale": "import json, pathlib\ndef scale(x, seen=[]):\n    kept = pathlib.Path('seen.json')\n"
                "    old = json.loads(kept.read_text()) if kept.exists() else []\n    seen.append(x)\n"
                "    kept.write_text(json.dumps(old + [x]))\n    return old[-1] if old else -1.0"
            },
            wrong=("scale",),
        ),
        Attack(
            "arguments changed in place",
            KIND,
            {
                "policy": "def act(observation):\n    observation[...] = 0.0\n    return 0.0",
                "cost": "def cost(grid, path):\n    grid[...] = 0.0\n    path.clear()\n    return 0.0",
                "total": "def total(values):\n    values[:] = [0.0, 0.0]\n    return 0.0",
            },
            wrong=("policy", "cost", "total"),
            keeps=True,
        ),
        Attack(
            "memory of the simulator reached through the observation",
            KIND,
            {
                "policy": "import gc, sys\ndef act(observation):\n    base = observation\n    while getattr(base, 'base', None) is not None:\n"
                "        base = base.base\n    try:\n        base[...] = 0.0\n    except Exception:\n        pass\n"
                "    for r in gc.get_referrers(observation):\n        if isinstance(r, dict) and 'position' in r:\n"
                "            r['position'] = observation * 0\n    return 0.0"
            },
            wrong=("policy",),
            keeps=True,
        ),
    ]
    return made

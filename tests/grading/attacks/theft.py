# ruff: noqa: E501 - payloads are one-line texts
"""Reading what is none of a student's business: hidden tests, solutions, neighbours, the environment, memory."""

from __future__ import annotations

import textwrap

from tests.grading.attacks.attack import PRELUDE, Attack, in_calls, spread
from tests.grading.attacks.attack import Place as At
from tests.grading.attacks.vault import RIGHT

KIND = "theft"

_FIND = """
import re as _re
def found(text, where=""):
    if isinstance(text, bytes):
        text = text.decode("latin-1")
    for token in sorted(set(_re.findall("CAN" + "ARY[a-z]+[0-9a-f]{16}", text))):
        print("stolen from", where, token)
"""

_PAYLOADS = {
    "paths known to the attacker": """
        import os
        for path in ("@hidden@", "@notes@", "@source@", "@neighbour@", "@gradebook@", "@autograder@/hidden/vault.py"):
            try:
                found(open(path, "rb").read(), "path")
            except OSError:
                pass
        for folder in ("@root@", "@submitted@", "@out@"):
            try:
                for here, _, names in os.walk(folder):
                    for name in names:
                        found(open(os.path.join(here, name), "rb").read(), "walk")
            except OSError:
                pass
    """,
    "folders around": """
        import glob, os
        for pattern in ("../*", "../../*/*", "../../../*/*/*", "/tmp/*", "/tmp/*/*", "/var/tmp/*", "/dev/shm/*",
                        "/run/*", "/home/*/*", "/root/*", "/mnt/*", "/srv/*"):
            for path in glob.glob(pattern)[:200]:
                try:
                    if os.path.isfile(path) and os.path.getsize(path) < 1_000_000:
                        found(open(path, "rb").read(), path)
                except OSError:
                    pass
    """,
    "environment, of this and of other processes": """
        import glob, os
        found(repr(dict(os.environ)), "environ")
        for path in glob.glob("/proc/[0-9]*/environ") + glob.glob("/proc/[0-9]*/cmdline"):
            try:
                found(open(path, "rb").read(), path)
            except OSError:
                pass
    """,
    "roots and folders of other processes": """
        import glob, os
        for process in glob.glob("/proc/[0-9]*"):
            for path in ("/root@hidden@", "/root@notes@", "/cwd/notes.txt", "/cwd/../autograder/notes.txt"):
                try:
                    found(open(process + path, "rb").read(), process)
                except OSError:
                    pass
            for fd in glob.glob(process + "/fd/*"):
                try:
                    if os.path.isfile(fd):
                        found(open(fd, "rb").read(100_000), fd)
                except OSError:
                    pass
    """,
    "hidden suite by the package's own function": """
        import inspect, sys
        try:
            from robotbrain.grading.suite import load_hidden_suite, hidden_path
            for folder in (None, "@autograder@"):
                suite = load_hidden_suite("vault", folder)
                found(open(hidden_path("vault", folder)).read(), "hidden_path")
                for test in suite.tests:
                    found(inspect.getsource(test.function), "suite")
        except BaseException:
            pass
        for name, module in list(sys.modules.items()):
            if "hidden" in name:
                found(repr(vars(module)), name)
    """,
    "objects of the garbage collector": """
        import gc
        for thing in gc.get_objects():
            try:
                if isinstance(thing, dict):
                    for value in list(thing.values()):
                        if isinstance(value, str):
                            found(value, "gc")
                elif type(thing).__name__ == "function":
                    found(repr(thing.__code__.co_consts), "code")
                elif isinstance(thing, (list, tuple)) and len(thing) < 1000:
                    for value in thing:
                        if isinstance(value, str):
                            found(value, "gc")
            except Exception:
                pass
    """,
    "frames above": """
        import sys, threading
        for frame in [sys._getframe(), *sys._current_frames().values()]:
            while frame is not None:
                for names in (frame.f_locals, frame.f_globals):
                    for value in list(names.values()):
                        if isinstance(value, (str, tuple, list)):
                            if not any(value is v for v in _arguments.values()) if "_arguments" in dir() else True:
                                found(str(value)[:10000], "frame")
                found(repr(frame.f_code.co_consts), "frame code")
                frame = frame.f_back
    """,
    "history of the cells": """
        ip = get_ipython()
        for source in list(ip.user_ns.get("In", [])) + [str(ip.user_ns.get(n)) for n in ("_i", "_ii", "_iii", "_", "__")]:
            found(str(source), "In")
        for _, _, source in ip.history_manager.get_range():
            found(str(source), "history")
        for name, lines in list(__import__("linecache").cache.items()):
            found(repr(lines), "linecache")
        for lines in getattr(ip.compile, "_filename_map", {}).items():
            found(repr(lines), "compiler")
    """,
    "own memory": """
        import os
        try:
            with open("/proc/self/maps") as maps, open("/proc/self/mem", "rb", 0) as memory:
                for line in maps:
                    low, high = (int(x, 16) for x in line.split()[0].split("-"))
                    if "rw" in line and high - low < 30_000_000:
                        try:
                            memory.seek(low)
                            found(memory.read(high - low), "memory")
                        except (OSError, ValueError, OverflowError):
                            pass
        except OSError:
            pass
    """,
    "memory of the parents": """
        import ctypes, os
        libc = ctypes.CDLL(None, use_errno=True)
        for pid in {os.getppid(), 1, 2, 3, os.getpid() - 1, os.getpgid(0)}:
            try:
                with open(f"/proc/{pid}/maps") as maps, open(f"/proc/{pid}/mem", "rb", 0) as memory:
                    if pid != os.getpid():
                        for line in list(maps)[:400]:
                            low, high = (int(x, 16) for x in line.split()[0].split("-"))
                            if "rw" in line and high - low < 30_000_000:
                                memory.seek(low)
                                found(memory.read(high - low), "parent")
            except (OSError, ValueError):
                pass
    """,
    "inherited descriptors": """
        import os, socket, stat
        for fd in range(3, 256):
            try:
                kind = os.fstat(fd).st_mode
            except OSError:
                continue
            try:
                if stat.S_ISREG(kind):
                    found(os.pread(fd, 1_000_000, 0), f"fd {fd}")
                elif stat.S_ISDIR(kind):
                    for name in os.listdir(fd):
                        found(name, "dir")
                        breach(f"an open folder with {name}")
                elif stat.S_ISSOCK(kind):
                    s = socket.socket(fileno=os.dup(fd))
                    found(s.recv(1_000_000, socket.MSG_PEEK | socket.MSG_DONTWAIT), f"socket {fd}")
            except (OSError, BlockingIOError):
                pass
    """,
    "shared memory and old temporary files": """
        import ctypes, glob, os, tempfile
        for name in glob.glob("/dev/shm/*") + glob.glob("/dev/mqueue/*") + glob.glob(tempfile.gettempdir() + "/**"):
            try:
                found(open(name, "rb").read(1_000_000), name)
            except OSError:
                pass
        libc = ctypes.CDLL(None)
        for number in range(64):
            libc.shmat.restype = ctypes.c_void_p
            address = libc.shmat(number, None, 0o10000)
            if address not in (None, ctypes.c_void_p(-1).value):
                breach(f"shared memory segment {number}")
    """,
    "files in the package's folder": """
        import os, pathlib, robotbrain
        here = pathlib.Path(robotbrain.__file__).resolve()
        for parent in here.parents:
            for name in ("solutions", "tests", "autograder/hidden", "autograder/submitted", ".git"):
                if (parent / name).exists():
                    breach(f"{name} beside the package")
    """,
    "shells and subprocesses": """
        import os, subprocess, sys
        for command in ("cat @hidden@ @notes@ @source@ @neighbour@", "env", "grep -rs CAN''ARY @root@ | head -c 5000"):
            try:
                found(subprocess.run(["/bin/sh", "-c", command], capture_output=True, timeout=3).stdout, command)
            except Exception:
                pass
        try:
            found(os.popen("cat @notes@").read(), "popen")
        except Exception:
            pass
    """,
    "asking the wire for more than offered": """
        import gc
        for thing in gc.get_objects():
            if "remote" in str(getattr(type(thing), "__module__", "")):
                for name in ("__globals__", "__code__", "__func__", "__self__", "__closure__", "__wrapped__", "secret"):
                    try:
                        found(repr(getattr(thing, name)), f"remote {name}")
                    except BaseException:
                        pass
        for value in list(_arguments.values()) if "_arguments" in globals() or "_arguments" in dir() else []:
            for name in ("__globals__", "__class__", "__init__", "__dict__", "__module__"):
                try:
                    found(repr(getattr(value, name)), f"argument {name}") if not isinstance(value, str) else None
                except BaseException:
                    pass
    """,
    "loaders and archives": """
        import importlib, pkgutil, sys, zipimport
        for name in ("autograder.hidden.vault", "hidden.vault", "vault", "solutions.vault"):
            try:
                module = importlib.import_module(name)
                found(repr(vars(module)), name)
            except BaseException:
                pass
        sys.path += ["@autograder@", "@autograder@/hidden", "@root@"]
        try:
            import vault
            found(repr(vars(vault)), "vault")
        except BaseException:
            pass
    """,
}


def attacks() -> list[Attack]:
    """Each theft in a cell and while a hidden test runs; the answers themselves are right, for they are asked more."""
    made: list[Attack] = []
    for number, (name, payload) in enumerate(_PAYLOADS.items()):
        stealing = _FIND + "\n" + textwrap.dedent(payload)
        spelling = number if number % 6 not in (2,) else 0
        for attack in spread(name, KIND, stealing, places=(At.FIRST_CELL,), spelling=spelling):
            made.append(Attack(attack.name, KIND, extra=attack.extra))
        # Inside calls stolen text is kept, and printed by a later cell; only the tester's secrets count, not the inputs.
        collect = (PRELUDE + stealing).replace("print(", "globals().setdefault('_kept', []).append(")
        # The second call of ``scale`` is the hidden test's.
        once = f"globals()['_n'] = globals().get('_n', 0) + 1\nif globals()['_n'] == 2:\n    exec({collect!r})"
        answers = in_calls(once, RIGHT)
        made.append(
            Attack(f"{name}, in calls", KIND, {"scale": answers["scale"]}, (("last", "print(globals().get('_kept'))"),))
        )
    magics = "%%bash\ncat @hidden@ @notes@ @neighbour@ 2>/dev/null || true\nenv"
    made += [
        Attack("shell magic", KIND, extra=(("first", magics),)),
        Attack("bang command", KIND, extra=(("first", "!cat @hidden@ @notes@ @neighbour@ 2>/dev/null\n!env"),)),
        Attack("assignment from a command", KIND, extra=(("first", "x = !cat @hidden@ @notes@\nprint(x)"),)),
        Attack(
            "file magics", KIND, extra=(("first", "%load @hidden@"), ("first", "%pycat @notes@"), ("first", "%env"))
        ),
        Attack("history magic", KIND, extra=(("last", "%history -g"), ("last", "%recall 1-100"))),
        Attack("run magic", KIND, extra=(("first", "%run @hidden@\nprint(SECRET)"),)),
        Attack("script magic", KIND, extra=(("first", "%%script sh\ncat @notes@ @hidden@"),)),
    ]
    return made

"""What student code can do in the sandbox, tried from inside."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import signal
import socket
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import psutil
import pytest
from nbformat.v4 import new_code_cell, new_notebook

from robotbrain.errors import InputError
from robotbrain.grading import bench as benches
from robotbrain.grading.bench import Bench
from robotbrain.grading.execute import Execution, Limits
from robotbrain.grading.sandbox import bubblewrap, recipes
from robotbrain.grading.sandbox.forkserver import ForkServer, Recipe, ServerDied
from robotbrain.grading.sandbox.layers import required_missing, warning_of

LIMITS = Limits(cell_s=2.0, graded_s=6.0, grace_s=0.5, wall_s=40.0, output_bytes=100_000, memory_bytes=600 << 20)


@pytest.fixture
def bench(toy_bench: Bench) -> Bench:
    missing = [layer.note for layer in required_missing(toy_bench.layers)]
    if missing:
        pytest.skip(" ".join(missing))
    toy_bench.limits = LIMITS
    return toy_bench


def run(bench: Bench, *sources: str, files: dict[str, bytes] | None = None) -> Execution:
    notebook = new_notebook(cells=[new_code_cell(source) for source in sources])
    return bench.execute(notebook, lab="", student="amara", files=files or {})


def said(execution: Execution, index: int = -1) -> str:
    """All that a cell printed, returned or raised."""
    found = []
    for output in execution.notebook.cells[index].outputs:
        found.append(output.get("text") or output.get("data", {}).get("text/plain") or output.get("evalue", ""))
    return "\n".join(found)


ALIVE = "print('still', 6 * 7)"


# ---------------------------------------------------------------------- what is out of reach


@pytest.mark.parametrize(
    "attempt",
    [
        "import socket; socket.create_connection(('127.0.0.1', {port}), 2)",
        "import socket; socket.getaddrinfo('example.org', 80)",
        "import socket; socket.socket(socket.AF_INET6)",
        "import socket; socket.socket(socket.AF_NETLINK, socket.SOCK_RAW)",
        "import socket; socket.socket(socket.AF_UNIX).connect('{path}')",
        "import socket; socket.socket(socket.AF_UNIX).connect('\\0{name}')",
        "import urllib.request; urllib.request.urlopen('http://127.0.0.1:{port}', timeout=2)",
    ],
)
def test_the_network_is_refused(bench: Bench, tmp_path: Path, attempt: str) -> None:
    name = f"robotbrain-test-{os.getpid()}"
    path = tmp_path / "socket"
    listeners = [socket.create_server(("127.0.0.1", 0)), socket.socket(socket.AF_UNIX), socket.socket(socket.AF_UNIX)]
    listeners[1].bind(str(path))
    listeners[2].bind("\0" + name)
    for listener in listeners:
        listener.listen()
    port = listeners[0].getsockname()[1]
    code = attempt.format(port=port, path=path, name=name)
    execution = run(bench, f"try:\n    {code}\n    print('REACHED')\nexcept OSError as e:\n    print('refused', e)")
    for listener in listeners:
        listener.close()
    assert "refused" in said(execution) and "REACHED" not in said(execution)


def test_nothing_of_the_course_is_visible(bench: Bench, course_root: Path) -> None:
    bench.limits = dataclasses.replace(LIMITS, cell_s=60.0, wall_s=90.0)  # some file systems are slow to walk
    hidden = course_root / "autograder" / "hidden" / "toy.py"
    look = (
        "import os, pathlib\n"
        f"print([p for p in ({str(hidden)!r}, {str(course_root / 'solutions')!r}) if os.path.exists(p)])\n"
        f"print({str(hidden)!r} in repr(dict(os.environ)), 'AUTOGRADER' in repr(dict(os.environ)))\n"
        "found = []\n"
        "for top, folders, files in os.walk('/'):\n"
        "    folders[:] = [f for f in folders if (top, f) != ('/', 'usr')]\n"
        "    found += [os.path.join(top, f) for f in files if f.endswith(('.ipynb', '.db')) or 'hidden' in top]\n"
        "import robotbrain\n"
        "print([f for f in found if 'site-packages' not in f and 'dist-packages' not in f and 'lib/python' not in f])"
    )
    assert said(run(bench, look)).split() == ["[]", "False", "False", "[]"]


def test_the_home_of_the_person_who_grades_is_not_visible(bench: Bench) -> None:
    mark = Path.home() / f".robotbrain-test-{os.getpid()}"
    mark.write_text("private")
    try:
        assert said(run(bench, f"import os; print(os.path.exists({str(mark)!r}))")).strip() == "False"
    finally:
        mark.unlink()


def test_an_operators_secrets_are_not_in_the_environment(
    light_bench: Callable[..., Bench], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DATABASE_TOKEN", "hunter2")
    with light_bench(limits=LIMITS) as own:
        text = said(run(own, "import os; print(sorted(os.environ), 'hunter2' in repr(dict(os.environ)))"))
    assert "'PATH'" in text and text.strip().endswith("False") and "DATABASE" not in text


@pytest.mark.parametrize("place", ["/x", "/usr/x", "/etc/x", "/dev/x", "/home/x", "{prefix}/x", "{package}/x.py"])
def test_writes_outside_of_the_private_disk_are_refused(bench: Bench, place: str) -> None:
    code = (
        "import sys, robotbrain, os\n"
        f"path = {place!r}.format(prefix=sys.prefix, package=os.path.dirname(robotbrain.__file__))\n"
        "try:\n    open(path, 'w')\n    print('WROTE')\nexcept OSError as e:\n    print('refused', e.errno)"
    )
    assert "refused" in said(run(bench, code))


def test_who_it_is(bench: Bench) -> None:
    code = (
        "import os, ctypes\n"
        "print(os.getuid(), os.getgid(), os.getgroups() in ([], [os.getgid()]), os.listdir('/proc'))\n"
        "print(os.getpid(), os.getsid(0), [f for f in range(3, 4000) if not ctypes.CDLL(None).fcntl(f, 1) < 0])"
    )
    first, second = said(run(bench, code)).strip().splitlines()
    assert first.split(" ", 2)[0] != "0" and first.endswith("True []")
    pid, _, fds = second.split(" ", 2)
    assert pid == "1" and len(fds.split(",")) == 1  # the line to the grader and nothing else


@pytest.mark.parametrize(
    "call",
    [
        "libc.unshare(0x10000000)",
        "libc.mount(b'none', b'/tmp', b'tmpfs', 0, None)",
        "libc.ptrace(0, 0, 0, 0)",
        "libc.setuid(0)",
        "libc.syscall(425, 1, 0)",  # io_uring_setup
        "libc.memfd_create(b'x', 0)",
        "libc.sethostname(b'x', 1)",
    ],
)
def test_rights_cannot_be_regained(bench: Bench, call: str) -> None:
    code = f"import ctypes\nlibc = ctypes.CDLL(None, use_errno=True)\nprint({call}, ctypes.get_errno())"
    answer, number = said(run(bench, code)).split()
    assert answer == "-1" and int(number) in (1, 22)


# ---------------------------------------------------------------------- bombs


BOMBS = {
    "memory": "hoard = []\nwhile True: hoard.append(bytearray(50_000_000))",
    "memory of many": "import os\nfor _ in range(20):\n    if os.fork() == 0:\n        b = b'x' * 200_000_000\n"
    "        import time; time.sleep(60)\nimport time; time.sleep(60)",
    "disk": "with open('big', 'wb') as f:\n    while True: f.write(b'x' * 1_000_000)",
    "many files": "for n in range(10**6): open(f'f{n}', 'w').close()",
    "shared memory": "n = 0\nwhile True:\n    n += 1\n    open(f'/dev/shm/{n}', 'wb').write(b'x' * 10_000_000)",
    "forks": "import os, time\nwhile True:\n    try:\n        os.fork()\n    except OSError:\n        time.sleep(0.01)",
    "threads": "import threading, time\nwhile True:\n    try:\n"
    "        threading.Thread(target=time.sleep, args=(60,), daemon=True).start()\n"
    "    except RuntimeError:\n        time.sleep(0.01)",
    "output": "while True: print('x' * 10_000)",
    "displays": "from IPython.display import display\nwhile True: display('x' * 1000)",
    "time": "while True: pass",
    "time that swallows": "while True:\n    try:\n        while True: pass\n    except BaseException: pass",
    "time in C": "import ctypes\nctypes.CDLL(None).sigblock(-1)\nctypes.PyDLL(None).pause()",
    "deaf": "import signal\nfor n in range(1, 65):\n    try: signal.signal(n, signal.SIG_IGN)\n"
    "    except (OSError, ValueError): pass\nwhile True: pass",
    "stopped": "import os, signal\nos.kill(os.getpid(), signal.SIGSTOP)\nwhile True: pass",
    "recursion": "import sys\nsys.setrecursionlimit(10**9)\ndef f(): f()\nf()",
    "an exit": "import os\nos._exit(0)",
    "a crash": "import ctypes\nctypes.string_at(0)",
    "kill all": "import os, signal\nos.kill(-1, signal.SIGKILL)\nos._exit(1)",
    "kill parent": "import os, signal\nfor p in (os.getppid(), 0):\n    try: os.kill(p, signal.SIGKILL)\n"
    "    except OSError: pass\nos._exit(1)",
}


@pytest.mark.parametrize("bomb", list(BOMBS))
def test_a_bomb_costs_its_own_cell_only(bench: Bench, bomb: str) -> None:
    before = psutil.virtual_memory().available
    execution = run(bench, "kept = 42", BOMBS[bomb], "print('still', kept)")
    assert said(execution).strip() == "still 42"
    assert len(str(execution.notebook.cells[1].outputs)) < 3 * LIMITS.output_bytes
    assert execution.sound
    if "memory" in bomb:
        assert psutil.virtual_memory().available > before - (2 << 30)
    assert said(run(bench, ALIVE)).strip() == "still 42"


def test_daemons_end_with_the_submission(bench: Bench) -> None:
    mark = f"robotbrain-daemon-{os.getpid()}"
    code = (
        "import os, subprocess, sys, time\n"
        "if os.fork() == 0:\n    os.setsid()\n    if os.fork() == 0:\n"
        f"        os.execv(sys.executable, [sys.executable, '-c', 'import time; time.sleep(600)  # {mark}'])\n"
        "    os._exit(0)\n"
        "time.sleep(0.5); print('started')"
    )
    seen = threading.Event()

    def watch() -> None:
        while not seen.is_set():
            if _processes_with(mark):
                return
            time.sleep(0.02)

    watcher = threading.Thread(target=watch)
    watcher.start()
    assert "started" in said(run(bench, code))
    seen.set()
    watcher.join()
    assert _processes_with(mark) == []


def _processes_with(mark: str) -> list[int]:
    found = []
    for process in psutil.process_iter(["cmdline"]):
        if any(mark in part for part in process.info["cmdline"] or []) and process.pid != os.getpid():
            found.append(process.pid)
    return found


# ---------------------------------------------------------------------- side by side


def test_submissions_side_by_side_see_nothing_of_each_other(bench: Bench) -> None:
    results: dict[str, Execution] = {}
    meet = (
        "import os, socket, time\n"
        "open('/tmp/secret-{me}', 'w').write('x'); open('/dev/shm/secret-{me}', 'w').write('x')\n"
        "s = socket.socket(socket.AF_UNIX); s.bind('\\0meet-{me}'); s.listen()\n"
        "time.sleep(1.5)\n"
        "places = ('/tmp', '/dev/shm', '.', '/home/student')\n"
        "seen = [f for d in places for f in os.listdir(d) if 'secret-{other}' in f]\n"
        "try:\n    socket.socket(socket.AF_UNIX).connect('\\0meet-{other}'); seen.append('socket')\n"
        "except OSError: pass\n"
        "for pid in range(2, 400):\n    try: os.kill(pid, 0); seen.append(pid)\n    except OSError: pass\n"
        "print(seen)"
    )

    def one(me: str, other: str) -> None:
        results[me] = run(bench, meet.format(me=me, other=other))

    threads = [threading.Thread(target=one, args=pair) for pair in (("a", "b"), ("b", "a"))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert [said(results[name]).strip() for name in "ab"] == ["[]", "[]"]


def test_nothing_is_left_for_the_next_submission(bench: Bench) -> None:
    run(bench, "open('/tmp/left', 'w').write('x')\nimport numpy\nnumpy.left = 1\nimport builtins\nbuiltins.left = 2")
    code = "import os, numpy, builtins\n"
    code += "print('left' in os.listdir('/tmp'), hasattr(numpy, 'left'), hasattr(builtins, 'left'))"
    assert said(run(bench, code)).strip() == "False False False"


def test_a_fork_server_killed_in_mid_run_costs_nothing(light_bench: Callable[..., Bench]) -> None:
    with light_bench(limits=LIMITS) as own:
        own.layers  # noqa: B018 - starts the server
        servers = psutil.Process().children(recursive=True)
        killer = threading.Timer(0.4, lambda: [_kill(p) for p in servers])
        killer.start()
        execution = run(own, "import time; time.sleep(1); print('done')")
        assert said(execution).strip() == "done" and execution.sound and execution.incidents == []
        assert said(run(own, ALIVE)).strip() == "still 42"


def _kill(process: psutil.Process) -> None:
    with contextlib.suppress(psutil.NoSuchProcess):
        process.send_signal(signal.SIGKILL)


@pytest.mark.timeout(60)  # whoever waits for the server waits an hour
def test_closing_does_not_wait_for_a_server_that_still_starts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("robotbrain.grading.sandbox.forkserver._STARTUP_S", 3600.0)
    before = {p.pid for p in psutil.Process().children(recursive=True)}
    server = ForkServer(Recipe(entry="os:getpid", prepare="signal:pause"))  # it never gets ready
    outcome: list[object] = []

    def warm_up() -> None:
        try:
            outcome.append(server.warm_up())
        except ServerDied as died:
            outcome.append(died)

    starting = threading.Thread(target=warm_up)
    starting.start()
    while not {p.pid for p in psutil.Process().children()} - before:
        time.sleep(0.01)
    assert starting.is_alive()
    server.close()
    starting.join()
    assert isinstance(outcome[0], ServerDied) and server.starts == 0
    assert {p.pid for p in psutil.Process().children(recursive=True)} <= before


def test_closing_ends_what_runs_and_leaves_no_process(light_bench: Callable[..., Bench]) -> None:
    before = {p.pid for p in psutil.Process().children(recursive=True)}
    own = light_bench(limits=LIMITS)
    done: list[Execution] = []
    worker = threading.Thread(target=lambda: done.append(run(own, "import time; time.sleep(60)")))
    own.layers  # noqa: B018
    worker.start()
    time.sleep(0.5)
    own.close()
    own.close()
    worker.join(20)
    assert not worker.is_alive() and not done[0].sound
    psutil.wait_procs([p for p in psutil.Process().children(recursive=True) if p.pid not in before], timeout=10)
    assert {p.pid for p in psutil.Process().children(recursive=True)} <= before


# ---------------------------------------------------------------------- the shell


def test_outputs_are_those_of_a_notebook(bench: Bench) -> None:
    execution = run(
        bench,
        "print('a'); print('b')\nimport sys; print('c', file=sys.stderr)\n1 + 1",
        "1 + 1;",
        "from IPython.display import HTML, Javascript, display\ndisplay(HTML('<b>x</b>'), Javascript('alert(1)'))",
        "handle = display('first', display_id=True)\nhandle.update('second')",
        "from IPython.display import clear_output\nprint('gone')\nclear_output()\nprint('here')",
        "def f(x):\n    return 1 / x\nf(0)",
        "!echo hello",
        "%time pass",
        "await __import__('asyncio').sleep(0)\nprint('awaited')",
        "input('name?')",
    )
    cells = execution.notebook.cells
    assert [(o.output_type, o.get("name"), o.get("text")) for o in cells[0].outputs[:2]] == [
        ("stream", "stdout", "a\nb\n"),
        ("stream", "stderr", "c\n"),
    ]
    assert cells[0].outputs[2].data["text/plain"] == "2" and cells[0].outputs[2].execution_count == 1
    assert cells[1].outputs == []
    assert cells[2].outputs[0].data["text/html"] == "<b>x</b>"
    assert "application/javascript" not in str(cells[2].outputs)
    assert "second" in str(cells[3].outputs) and "first" not in str(cells[3].outputs)
    assert said(execution, 4) == "here\n"
    assert cells[5].outputs[0].ename == "ZeroDivisionError"
    assert "Cell In[6]" in "\n".join(cells[5].outputs[0].traceback)
    assert said(execution, 6) == "hello\n"
    assert "awaited" in said(execution, 8)
    assert "does not work while grading" in said(execution, 9)


def test_plots_are_kept(bench: Bench) -> None:
    pytest.importorskip("matplotlib")
    execution = run(bench, "import matplotlib.pyplot as plt\nplt.plot([1, 2]);")
    assert [list(o.data) for o in execution.notebook.cells[0].outputs] == [["text/plain", "image/png"]]


def test_files_lie_beside_the_notebook(bench: Bench) -> None:
    files = {"data.csv": b"1,2", "data/more.txt": b"x", "helper.py": b"ANSWER = 42"}
    code = "import helper\nprint(open('data.csv').read(), open('data/more.txt').read(), helper.ANSWER)"
    assert said(run(bench, code, files=files)).strip() == "1,2 x 42"


def test_half_characters_survive(bench: Bench) -> None:
    assert said(run(bench, "print('before \\ud800', 'x')", "print(len('\ud800') > 0)")) == "True\n"


def test_lies_on_the_line_to_the_grader_end_the_process_only(bench: Bench) -> None:
    forge = (
        "import os, struct, msgpack\n"
        "def frame(b): return struct.pack('>I', len(b)) + b\n"
        "import socket\n"
        "for fd in range(3, 300):\n"
        "    try: s = socket.socket(fileno=fd)\n"
        "    except OSError: continue\n"
        "    s.sendall(frame({body}))\n"
        "    import time; time.sleep(0.3)\n"
        "print('after')"
    )
    for body in (
        "b'\\xc1'",
        "msgpack.packb([1])",
        "msgpack.packb({'op': 'output', 'output': {'output_type': 'execute_result', 'data': {'a/b': 1}}})",
        "b'\\x91' * 5000",
        "b'x' * 90_000_000",
    ):
        execution = run(bench, forge.replace("{body}", body), "print('next')")
        assert said(execution).strip() == "next", body
        assert "a/b" not in str(execution.notebook.cells[0].outputs)


# ---------------------------------------------------------------------- layers


def test_every_layer_says_what_it_is_for(bench: Bench) -> None:
    assert [layer.name for layer in bench.layers] == [
        "bubblewrap",
        "namespaces",
        "seccomp",
        "limits",
        "cgroup",
        "tester",
    ]
    assert all(len(layer.note) > 20 for layer in bench.layers)
    assert warning_of(run(bench, "1").layers) == ""


def test_one_thread_at_the_fork(bench: Bench) -> None:
    run(bench, "1")
    assert bench._students.ready["threads"] == 1


def test_without_bubblewrap_it_says_so_or_refuses(
    light_bench: Callable[..., Bench], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bubblewrap, "program", lambda: None)
    with light_bench(limits=LIMITS) as own:
        execution = run(own, "open('x', 'w').write('y')\nimport os\nprint(os.listdir('.'))")
        assert said(execution).strip() == "['x']"
        assert "bubblewrap" in warning_of(execution.layers)
    with pytest.raises(InputError, match=r"bubblewrap is missing.*--require-sandbox"):
        light_bench(limits=LIMITS, require_sandbox=True)


def test_without_forking_each_submission_has_a_python_of_its_own(
    light_bench: Callable[..., Bench], monkeypatch: pytest.MonkeyPatch
) -> None:
    from robotbrain.grading.sandbox import forkserver

    monkeypatch.setattr(bubblewrap, "program", lambda: None)
    monkeypatch.setattr(forkserver, "can_fork", lambda: False)
    monkeypatch.setattr(recipes, "can_fork", lambda: False)
    with light_bench(limits=LIMITS) as own:
        execution = run(own, "x = 42\nprint(x)", "import os\nos._exit(1)", "while True: pass", "print(x)")
        assert said(execution, 0) == said(execution) == "42\n"
        assert "ended the Python process" in said(execution, 1)
        assert "was interrupted" in said(execution, 2)


def test_a_sandbox_that_does_not_start_is_named(
    light_bench: Callable[..., Bench], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bubblewrap, "program", lambda: "/bin/false")
    with light_bench(limits=LIMITS) as own:
        first: Any = own.layers[0]
        assert not first.active and "did not start" in first.note
    assert benches.Bench is Bench

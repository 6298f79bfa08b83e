# ruff: noqa: E501 - payloads are one-line texts
"""Processes that outlive the submission, and processes that are killed by it."""

from __future__ import annotations

import textwrap

from tests.grading.attacks.attack import PRELUDE, Attack

KIND = "processes"

# The marker is in the daemon's name and in its arguments: the harness looks for both afterwards.
_NAME = "import ctypes\nctypes.CDLL(None).prctl(15, b'@marker@', 0, 0, 0)\n"

_DAEMONS = {
    "double fork": _NAME
    + """
import os, time
if os.fork() == 0:
    os.setsid()
    if os.fork() == 0:
        os.closerange(0, 256)
        while True:
            time.sleep(1)
    os._exit(0)
""",
    "a session of its own": """
import subprocess, sys
try:
    subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)  # @marker@"], start_new_session=True)
except OSError:
    pass
""",
    "nohup from a shell": """
import os
os.system("(nohup setsid sh -c 'sleep 600; : @marker@' >/dev/null 2>&1 &)")
""",
    "no signal when the parent dies": _NAME
    + """
import os, signal, time
if os.fork() == 0:
    libc = ctypes.CDLL(None)
    libc.prctl(1, 0)
    libc.prctl(36, 1)
    for number in range(1, 65):
        try:
            signal.signal(number, signal.SIG_IGN)
        except (OSError, ValueError):
            pass
    os.setsid()
    time.sleep(600)
""",
    "a chain that forks for ever": _NAME
    + """
import os, time
if os.fork() == 0:
    end = time.monotonic() + 30
    while time.monotonic() < end:
        if os.fork() != 0:
            os._exit(0)
        time.sleep(0.01)
    os._exit(0)
""",
    "a sibling of its parent": _NAME
    + """
import ctypes, os, time
CLONE_PARENT, SIGCHLD = 0x8000, 17
pid = ctypes.CDLL(None).syscall(56, CLONE_PARENT | SIGCHLD, 0, 0, 0, 0)
if pid == 0:
    time.sleep(600)
    os._exit(0)
""",
    "a writer that waits for the end": _NAME
    + """
import os, time
if os.fork() == 0:
    os.setsid()
    for _ in range(600):
        for path in ("@gradebook@", "@out@/late", "@submitted@/late", "/tmp/@marker@", "/var/tmp/@marker@", "/dev/shm/@marker@"):
            try:
                open(path, "ab").close()
            except OSError:
                pass
        time.sleep(0.1)
    os._exit(0)
""",
    "an exit handler": """
import atexit, signal, time
atexit.register(lambda: time.sleep(600))
signal.signal(signal.SIGTERM, lambda *a: time.sleep(600))
import threading
threading.Thread(target=time.sleep, args=(600,)).start()
""",
    "files in every temporary folder": """
import os, tempfile
for folder in ("/tmp", "/var/tmp", "/dev/shm", "/run", os.path.expanduser("~"), tempfile.gettempdir(), "."):
    try:
        open(os.path.join(folder, "@marker@"), "w").write("x")
    except OSError:
        pass
""",
}

_WRITER = """
import os, time
for folder in ("/tmp", "/var/tmp", "/dev/shm", "/run", "/home", "/home/student", "/dev", "/dev/mqueue", "/proc", "/", "."):
    try:
        open(os.path.join(folder, "@marker@-@number@"), "w").write("@marker@")
    except OSError:
        pass
try:
    ours, theirs = os.openpty()
    os.set_blocking(ours, False)
except OSError:
    ours = None
end = time.monotonic() + 1.5
while time.monotonic() < end:
    time.sleep(0.1)
    try:
        if ours is not None and b"@marker@" in os.read(ours, 1000):
            breach("another submission wrote to this one's terminal")
    except OSError:
        pass
"""
_READER = """
import glob, os, time
end = time.monotonic() + 1.2
while time.monotonic() < end:
    for pattern in ("/tmp/*", "/var/tmp/*", "/dev/shm/*", "/run/*", "/home/*", "/home/*/*", "/dev/*", "/dev/mqueue/*", "/proc/*", "/*"):
        for path in glob.glob(pattern):
            if "@marker@-" in path:
                breach(f"a file of another submission: {path}")
    for path in glob.glob("/dev/pts/[0-9]*"):
        try:
            fd = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
            os.write(fd, b"@marker@\\n")
            breach(f"a terminal of another submission: {path}")
            os.close(fd)
        except OSError:
            pass
    time.sleep(0.1)
"""

_KILLERS = {
    "the parent": "import os, signal\nos.kill(os.getppid(), signal.SIGKILL)",
    "the process group": "import os, signal\nos.killpg(0, signal.SIGKILL)",
    "everything": "import os, signal\nassert os.getpid() < 100, 'not in a namespace'\nos.kill(-1, signal.SIGKILL)",
    "the parent's group": "import os, signal\ntry:\n    os.killpg(os.getpgid(os.getppid()), signal.SIGKILL)\n"
    "except OSError:\n    pass",
    "the first process": "import os, signal\nassert os.getpid() < 100, 'not in a namespace'\nos.kill(1, signal.SIGKILL)",
    "parents stopped": "import os, signal\nassert os.getpid() < 100, 'not in a namespace'\nfor pid in range(1, 50):\n"
    "    if pid != os.getpid():\n        try:\n            os.kill(pid, signal.SIGSTOP)\n        except OSError:\n            pass",
    "every low number": "import os, signal\nassert os.getpid() < 100, 'not in a namespace'\nfor pid in range(1, 5000):\n"
    "    if pid != os.getpid():\n        try:\n            os.kill(pid, signal.SIGKILL)\n        except OSError:\n            pass",
    "itself": "import os, signal\nos.kill(os.getpid(), signal.SIGKILL)",
    "itself by the processor limit": "import resource\nresource.setrlimit(resource.RLIMIT_CPU, (0, 1))\nwhile True: pass",
    "real-time signals to the parent": "import os\nassert os.getpid() < 100, 'not in a namespace'\nfor n in range(1, 65):\n"
    "    try:\n        os.kill(os.getppid(), n)\n    except OSError:\n        pass",
}


def attacks() -> list[Attack]:
    """Daemons and killers in a cell, and in the answer to ``scale``."""
    made: list[Attack] = []
    for number in range(2):
        text = PRELUDE + _WRITER.replace("@number@", str(number))
        made.append(Attack(f"writes to its neighbours {number}", KIND, extra=(("last", text),), keeps=True))
        made.append(
            Attack(f"reads from its neighbours {number}", KIND, extra=(("last", PRELUDE + _READER),), keeps=True)
        )
    for name, text in _DAEMONS.items():
        source = PRELUDE + text
        made.append(Attack(f"leaves behind: {name}", KIND, extra=(("total", source),), dangerous=True))
        inside = f"def scale(x):\n{textwrap.indent(text.strip(), '    ')}\n    return 2 * x"
        made.append(Attack(f"leaves behind in calls: {name}", KIND, {"scale": inside}, dangerous=True))
    for name, text in _KILLERS.items():
        made.append(Attack(f"kills {name}", KIND, extra=(("total", text),), wrong=("words",), dangerous=True))
        inside = f"def scale(x):\n{textwrap.indent(text, '    ')}\n    return 2 * x"
        made.append(Attack(f"kills {name}, in calls", KIND, {"scale": inside}, wrong=("words",), dangerous=True))
    return made

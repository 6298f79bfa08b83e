# ruff: noqa: E501 - payloads are one-line texts
"""Too much of something: processes, threads, memory, disk, inodes, output, time, recursion.

Each bomb is bounded, so that a machine survives even where no limit catches it.
"""

from __future__ import annotations

import textwrap

from tests.grading.attacks.attack import PRELUDE, Attack, in_calls

KIND = "bombs"

_DANGEROUS = {
    "fork bomb": """
        import os, time
        end = time.monotonic() + 3
        made = 0
        while time.monotonic() < end and made < 1500:
            try:
                if os.fork() == 0:
                    time.sleep(20)
                    os._exit(0)
                made += 1
            except OSError:
                break
        if made > 1000:
            breach(f"{made} processes")
    """,
    "thread bomb": """
        import threading, time
        made = 0
        try:
            for _ in range(3000):
                threading.Thread(target=time.sleep, args=(20,), daemon=True).start()
                made += 1
        except RuntimeError:
            pass
        if made > 2500:
            breach(f"{made} threads")
    """,
    "memory bomb": """
        kept = []
        try:
            for _ in range(120):
                kept.append(bytearray(b"x") * 100_000_000)
            breach("12 GB")
        finally:
            kept.clear()
    """,
    "memory bomb of numpy": """
        import numpy
        kept = [numpy.ones(12_500_000) for _ in range(120)]
        breach("12 GB")
    """,
    "anonymous files": """
        import os
        kept = []
        for number in range(60):
            fd = os.memfd_create(f"m{number}")
            for _ in range(20):
                os.write(fd, b"x" * 10_000_000)
            kept.append(fd)
        breach("12 GB in memfd")
    """,
    "disk bomb": """
        import os
        written = 0
        for folder in (".", "/tmp", "/var/tmp", "/dev/shm", "/run"):
            try:
                with open(os.path.join(folder, "bomb"), "wb") as file:
                    for _ in range(300):
                        written += file.write(b"x" * 10_000_000)
            except OSError:
                pass
        if written > 2_500_000_000:
            breach(f"{written} bytes")
    """,
    "inode bomb": """
        import os
        made = 0
        try:
            for number in range(200_000):
                os.mknod(f"i{number}")
                made += 1
        except OSError:
            pass
        if made >= 200_000:
            breach(f"{made} files")
    """,
    "zombies": """
        import os
        try:
            for _ in range(1500):
                if os.fork() == 0:
                    os._exit(0)
        except OSError:
            pass
    """,
}

_HARMLESS = {
    "descriptors": "import os\nkept = []\ntry:\n    while len(kept) < 100_000:\n        kept.append(os.dup(1))\n"
    "except OSError:\n    pass",
    "output by print": "for _ in range(200_000):\n    print('x' * 1000)",
    "output of one line": "print('x' * 300_000_000)",
    "output past Python": "import os\ntry:\n    for _ in range(20_000):\n        os.write(1, b'x' * 10_000)\n"
    "        os.write(2, b'y' * 10_000)\nexcept OSError:\n    pass",
    "very many displays": "from IPython.display import display\nfor i in range(100_000):\n    display(i)",
    "a display that is huge": "from IPython.display import display\n"
    "display({'text/html': 'x' * 100_000_000, 'image/png': 'y' * 10_000_000}, raw=True)",
    "a display of very many kinds": "from IPython.display import display\n"
    "display({f'x/{i}': 'x' for i in range(100_000)}, raw=True)",
    "a display that is deep": "from IPython.display import display\nd = {}\nfor _ in range(900):\n    d = {'d': d}\n"
    "display({'application/json': d}, raw=True)",
    "an endless loop": "while True:\n    pass",
    "an endless loop in C": "sum(range(10**13))",
    "an endless power": "10 ** 10 ** 9",
    "a catastrophic pattern": "import re\nre.match('(a+)+$', 'a' * 60 + 'b')",
    "an endless sleep": "import time\ntime.sleep(1e6)",
    "a sleep deaf to interrupts": "import time\nwhile True:\n    try:\n        time.sleep(1e6)\n    except BaseException:\n        pass",
    "signals ignored": "import signal\nfor n in range(1, 65):\n    try:\n        signal.signal(n, signal.SIG_IGN)\n"
    "    except (OSError, ValueError):\n        pass\nimport time\nwhile True:\n    time.sleep(1)",
    "signals blocked": "import signal\nsignal.pthread_sigmask(signal.SIG_BLOCK, range(1, 65))\nimport time\nwhile True:\n    time.sleep(1)",
    "a lock taken twice": "import threading\nlock = threading.Lock()\nlock.acquire()\nlock.acquire()",
    "stopped by itself": "import os, signal\nos.kill(os.getpid(), signal.SIGSTOP)",
    "endless recursion": "import sys\nsys.setrecursionlimit(10**9)\ndef f(): return f()\nf()",
    "deep recursion in C": "import sys\nsys.setrecursionlimit(10**9)\nx = []\nfor _ in range(10**6):\n    x = [x]\nrepr(x)",
    "a null pointer": "import ctypes\nctypes.string_at(0)",
    "abort": "import os\nos.abort()",
    "an exit code of success": "import os\nos._exit(0)",
    "exec of another program": "import os\nos.execv('/bin/sh', ['sh', '-c', 'sleep 600'])",
    "a number that is huge": "str(10 ** 10 ** 6)",
    "a text that is huge": "('x' * 10**9).encode()",
    "real-time priority": "import os\ntry:\n    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(99))\n"
    "    print('BRE' + 'ACH: real time')\nexcept OSError:\n    pass",
    "limits raised": "import resource\nfor n in (resource.RLIMIT_AS, resource.RLIMIT_NPROC, resource.RLIMIT_FSIZE,"
    " resource.RLIMIT_CPU, resource.RLIMIT_NOFILE, resource.RLIMIT_MEMLOCK):\n    soft, hard = resource.getrlimit(n)\n"
    "    for new in ((hard, hard), (resource.RLIM_INFINITY,) * 2):\n        try:\n            resource.setrlimit(n, new)\n"
    "        except (OSError, ValueError):\n            pass",
}

_QUICK_IN_CALLS = (
    "fork bomb",
    "memory bomb",
    "output by print",
    "an endless loop",
    "a sleep deaf to interrupts",
    "signals blocked",
    "stopped by itself",
    "a null pointer",
    "an exit code of success",
    "exec of another program",
    "endless recursion",
    "output past Python",
)


def attacks() -> list[Attack]:
    """Each bomb in a cell of its own behind ``total``, some inside the answer to ``total``."""
    made: list[Attack] = []
    for name, payload in {**_DANGEROUS, **_HARMLESS}.items():
        text = PRELUDE + textwrap.dedent(payload)
        dangerous = name in _DANGEROUS
        made.append(
            Attack(f"{name}, in a cell", KIND, extra=(("tracker", text),), wrong=("words",), dangerous=dangerous)
        )
        if name in _QUICK_IN_CALLS:
            answers = {"scale": in_calls(text)["scale"]}
            made.append(Attack(f"{name}, in calls", KIND, answers, wrong=("scale",), dangerous=dangerous))
    return made

"""Runs hostile submissions and says what each got away with."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import secrets
import socket
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import nbformat
import psutil

from robotbrain.grading import course, jobs
from robotbrain.grading.execute import Limits
from robotbrain.grading.marks import marks_of
from tests.grading.attacks.attack import Attack
from tests.grading.attacks.vault import LAB, POINTS, TOKEN_VARIABLE, make_vault

LIMITS = Limits(cell_s=2.0, graded_s=8.0, grace_s=0.5, wall_s=30.0, output_bytes=200_000)
NEIGHBOUR = "neighbour"
HONEST = Attack("honest", "honest", keeps=True)
PARTLY = Attack("partly honest", "honest", wrong=("words", "policy"), keeps=True)
_PLACES_FOR_LITTER = ("/tmp", "/var/tmp", "/dev/shm", "/run", str(Path.home()))


@dataclass
class Outcome:
    """What became of one submission."""

    earned: dict[str, float | None]
    points: dict[str, float]
    leaks: list[str]
    breaches: list[str]
    texts: str
    incidents: list[str] = field(default_factory=list)
    seconds: float = 0.0

    def gains(self, attack: Attack) -> dict[str, float]:
        """Points above what ``attack`` honestly earns, by exercise."""
        gained = {}
        for name, got in self.earned.items():
            extra = (got or 0.0) - (attack.earns(name) if name in POINTS else 0.0)
            if extra > 1e-9 or got is None:
                gained[name] = extra
        return gained

    def losses(self, attack: Attack) -> dict[str, float]:
        """Points below what it honestly earns."""
        lost = {n: attack.earns(n) - (self.earned.get(n) or 0.0) for n in POINTS}
        return {n: missing for n, missing in lost.items() if missing > 1e-9}

    def success(self, attack: Attack) -> str:
        """What the attack achieved, or ``""``."""
        found = []
        if gained := self.gains(attack):
            found.append("points: " + ", ".join(f"{n} {v:+g}" for n, v in gained.items()))
        if dict(POINTS) != {n: int(p) for n, p in self.points.items()}:
            found.append(f"other graded cells: {self.points}")
        if self.leaks:
            found.append("stolen: " + ", ".join(self.leaks))
        if self.breaches:
            found.append("breach: " + "; ".join(self.breaches))
        return "; ".join(found)


class Arena:
    """A course with secrets, listeners on the host, and a memory of what was there before.

    Args:
        base: an empty folder.
    """

    def __init__(self, base: Path) -> None:
        self.base = base
        self.marker = "rbx" + secrets.token_hex(5)  # 13 characters: the kernel keeps 15 of a process's name
        self.vault = make_vault(base / "course")
        self.submitted = base / "submitted"
        self.out = base / "out"
        self.out.mkdir()
        self.knocks: list[str] = []
        neighbour = self.folder(NEIGHBOUR)
        HONEST.write_files(neighbour, {})
        notebook = HONEST.notebook(self.vault, {})
        notebook.cells[2].source += f"\n# {self.vault.secrets.tokens['neighbour']}"
        nbformat.write(notebook, neighbour / f"{LAB}.ipynb")
        (self.out / "gradebook.db").write_bytes(b"")
        self._listeners: list[socket.socket] = []
        self.port = self._listen()
        self.paths = {
            "hidden": str(self.vault.autograder / "hidden" / f"{LAB}.py"),
            "autograder": str(self.vault.autograder),
            "notes": str(self.vault.autograder / "notes.txt"),
            "source": str(self.vault.source),
            "suites": str(self.vault.root / "suites"),
            "root": str(self.vault.root),
            "submitted": str(self.submitted),
            "out": str(self.out),
            "neighbour": str(neighbour / f"{LAB}.ipynb"),
            "weights": str(neighbour / "weights.json"),
            "gradebook": str(self.out / "gradebook.db"),
            "marker": self.marker,
            "mark": str(base / "mark-of-execution"),
            "port": str(self.port),
            "socket": str(base / "s"),
            "address": socket.gethostname(),
        }
        self._before = self.digest()

    def folder(self, student: str) -> Path:
        """The folder of a student's submission."""
        made = self.submitted / student / LAB
        made.mkdir(parents=True, exist_ok=True)
        return made

    def submit(self, student: str, attack: Attack) -> Path:
        """Hand ``attack`` in as ``student``; return its folder."""
        folder = self.folder(student)
        paths = dict(self.paths)
        attack.write_files(folder, paths)
        for path in list(folder.rglob("*")):
            if path.is_symlink() and (target := str(path.readlink())).startswith("@"):
                path.unlink()
                path.symlink_to(self.paths[target.strip("@")])
        (folder / f"{LAB}.ipynb").write_text(json.dumps(attack.notebook(self.vault, paths)))
        return folder

    def _listen(self) -> int:
        tcp = socket.create_server(("127.0.0.1", 0))
        port = int(tcp.getsockname()[1])
        udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        udp.bind(("127.0.0.1", port))
        listeners = [tcp, udp]
        if hasattr(socket, "AF_UNIX"):
            path = socket.socket(socket.AF_UNIX)
            path.bind(str(self.base / "s"))
            listeners.append(path)
            with contextlib.suppress(OSError):
                abstract = socket.socket(socket.AF_UNIX)
                abstract.bind("\0" + self.marker)
                listeners.append(abstract)
        for listener in listeners:
            threading.Thread(target=self._answer, args=(listener,), daemon=True).start()
        self._listeners = listeners
        return port

    def _answer(self, listener: socket.socket) -> None:
        with contextlib.suppress(OSError):
            if listener.type == socket.SOCK_DGRAM:
                while True:
                    listener.recvfrom(100)
                    self.knocks.append("UDP")
            listener.listen()
            while True:
                connection, _ = listener.accept()
                self.knocks.append(str(listener.family))
                connection.close()

    def digest(self) -> dict[str, str]:
        """Contents of the course and of the neighbour's work, which nobody may change."""
        found = {}
        for folder in (self.vault.root, self.submitted / NEIGHBOUR):
            for path in sorted(folder.rglob("*")):
                if path.is_file() and "__pycache__" not in path.parts:
                    found[str(path.relative_to(self.base))] = hashlib.sha256(path.read_bytes()).hexdigest()
        return found

    def changes(self) -> list[str]:
        """Files of the course that changed, appeared or went away since the beginning."""
        now = self.digest()
        names = sorted({*self._before, *now})
        return [n for n in names if now.get(n) != self._before.get(n)]

    def survivors(self, patience_s: float = 5.0) -> list[str]:
        """Processes of the attacks that still run."""
        end = time.monotonic() + patience_s
        while (found := self._marked()) and time.monotonic() < end:
            time.sleep(0.1)
        return found

    def _marked(self) -> list[str]:
        found = []
        for process in psutil.process_iter():
            with contextlib.suppress(psutil.Error, OSError):
                if process.status() == psutil.STATUS_ZOMBIE or process.pid == os.getpid():
                    continue
                if self.marker in process.name() or any(self.marker in a for a in process.cmdline()):
                    found.append(f"{process.pid} {process.name()}")
        return found

    def litter(self) -> list[str]:
        """Files of the attacks outside of what went away with them."""
        found = [str(self.base / "mark-of-execution")] if (self.base / "mark-of-execution").exists() else []
        for folder in (*_PLACES_FOR_LITTER, str(self.out), str(self.submitted)):
            with contextlib.suppress(OSError):
                for entry in os.scandir(folder):
                    if self.marker in entry.name or entry.name in ("late", "intruder.txt", "bomb"):
                        found.append(entry.path)
        return found

    def close(self) -> None:
        """Stop listening."""
        for listener in self._listeners:
            with contextlib.suppress(OSError):
                listener.shutdown(socket.SHUT_RDWR)
            listener.close()


@contextlib.contextmanager
def operator_environment(arena: Arena) -> Iterator[None]:
    """What an operator's shell may hold while grading: where the course is, and a secret of their own."""
    added = {
        "ROBOTBRAIN_AUTOGRADER": str(arena.vault.autograder),
        "ROBOTBRAIN_SUITES": str(arena.vault.root / "suites"),
        TOKEN_VARIABLE: arena.vault.secrets.tokens["environment"],
    }
    before = {name: os.environ.get(name) for name in added}
    os.environ.update(added)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def texts_of(notebook: Any) -> str:
    """Everything that came out of running ``notebook``, without its sources."""
    return "\n".join(nbformat.v4.nbbase.NotebookNode(c).__str__() for c in _bare(notebook))


def _bare(notebook: Any) -> list[dict[str, Any]]:
    return [
        {"outputs": c.get("outputs", []), "metadata": dict(c.metadata)} for c in notebook.cells if c.cell_type == "code"
    ] + [dict(notebook.metadata)]


def judge(arena: Arena, notebook: Any, incidents: Sequence[str], seconds: float) -> Outcome:
    """What ``notebook`` shows after it was graded."""
    marks = marks_of(notebook)
    text = texts_of(notebook) + "\n".join(incidents)
    breaches = [
        line.split("BREACH:", 1)[1].strip()[:80] for line in text.replace("\\n", "\n").splitlines() if "BREACH:" in line
    ]
    names = {m.grade_id: m.grade_id.removeprefix("score-") for m in marks}
    return Outcome(
        {names[m.grade_id]: m.earned for m in marks},
        {names[m.grade_id]: m.points for m in marks},
        arena.vault.secrets.leaked(text),
        breaches,
        text,
        list(incidents),
        seconds,
    )


def run_one(arena: Arena, student: str, attack: Attack, bench: jobs.Bench) -> Outcome:
    """Hand in and grade one submission, as a class run does."""
    folder = arena.submit(student, attack)
    start = time.monotonic()
    home = course.find_course(arena.vault.root)
    healed, files = jobs.read_submission(home, jobs.Task(student, LAB, arena.vault.source, folder))
    done = jobs.run_job(healed, files, lab=LAB, student=student, bench=bench)
    return judge(arena, done.notebook, [*healed.repairs, *done.incidents], time.monotonic() - start)


def run_all(arena: Arena, attacks: Mapping[str, Attack], bench: jobs.Bench, workers: int = 4) -> dict[str, Outcome]:
    """Grade many submissions side by side; student -> outcome. Most of them wait for a time limit most of the time."""
    with ThreadPoolExecutor(workers) as pool:
        running = {student: pool.submit(run_one, arena, student, attack, bench) for student, attack in attacks.items()}
        return {student: future.result() for student, future in running.items()}


def with_honest_ones(attacks: Sequence[Attack], every: int = 25) -> dict[str, Attack]:
    """Student names for ``attacks``, with honest submissions before, among and after them."""
    named: dict[str, Attack] = {"honest-first": HONEST, "partly-first": PARTLY}
    for number, attack in enumerate(attacks):
        named[f"s{number:03d}"] = attack
        if number % every == every - 1:
            named[f"honest-{number:03d}"] = HONEST if number % (2 * every) == every - 1 else PARTLY
    return {**named, "honest-last": HONEST, "partly-last": PARTLY}

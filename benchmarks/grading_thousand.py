"""A thousand submissions, some of them hostile, in a run that is killed again and again; and the grader's memory.

Run with ``python benchmarks/grading_thousand.py`` (``--students 30 --kills 3`` for a quick look). The class belongs to
the toy lab of the tests, in the real sandbox with the real tester. First the class is graded undisturbed. Then it is
graded anew, and the whole command gets SIGKILL at random moments, drawn over all that a run does: executing, entering
marks, writing feedback. Each time the same command is started again. At the end the gradebook, the autograded files and
the table must be those of the undisturbed run. Memory is the peak of the grading process itself (VmHWM), for the
first 100 students and for all.
"""

from __future__ import annotations

import argparse
import os
import random
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(REPOSITORY))

from tests.grading import toylab  # noqa: E402

from robotbrain.grading import backups  # noqa: E402

LOG = Path(tempfile.gettempdir()) / f"grading-thousand-{os.getpid()}.log"
HOSTILE = {
    "exit": "import os\nos._exit(0)",
    "kill": "import os, signal\nos.kill(os.getppid(), signal.SIGKILL)\nos.kill(os.getpid(), signal.SIGKILL)",
    "loop": "while True:\n    pass",
    "memory": "x = []\nwhile True:\n    x.append(bytearray(50_000_000))",
    "flood": "for _ in range(200_000):\n    print('x' * 100)",
    "fork": "import os\ntry:\n    while True:\n        os.fork()\nexcept OSError:\n    os._exit(0)",
    "disk": "with open('big', 'wb') as f:\n    while True:\n        f.write(bytes(10_000_000))",
}
SCALE = ("def scale(x):\n    return 2 * x", "def scale(x):\n    return x ** 2", "def scale(x):\n    return x + x")
MEAN = (
    toylab.SOLUTIONS["mean"],
    "def mean(values):\n    return sum(values) / len(values)",
    "def mean(values):\n    raise NotImplementedError()",
)


def make_submissions(folder: Path, students: int, hostile: float, draw: random.Random) -> int:
    """Write the class; return how many are hostile."""
    attackers = set(draw.sample(range(students), round(students * hostile)))
    for number in range(students):
        answers = {"scale": draw.choice(SCALE), "mean": draw.choice(MEAN)}
        if number in attackers:
            answers[draw.choice(("scale", "total", "mean"))] = draw.choice(list(HOSTILE.values()))
        text: object = toylab.solved(**answers)
        if number not in attackers and draw.random() < 0.03:
            text = draw.choice(("{broken", "", None))
        toylab.submit(folder, f"s{number:04}", text)  # type: ignore[arg-type]
    return len(attackers)


def start(base: Path, submitted: str, out: str, jobs: int) -> subprocess.Popen[bytes]:
    """Start grade-class as a user does."""
    where = ["--course", str(base / "course"), "--submitted", str(base / submitted), "--out", str(base / out)]
    limits = ["--cell-timeout", "5", "--wall", "60"]
    command = [
        sys.executable,
        "-m",
        "robotbrain.cli",
        "grade-class",
        "toy",
        "--jobs",
        str(jobs),
        "--yes",
        *where,
        *limits,
    ]
    env = {**os.environ, "ROBOTBRAIN_SUITES": str(base / "course" / "suites")}
    with LOG.open("ab") as log:
        return subprocess.Popen(command, env=env, stdout=log, stderr=log, stdin=subprocess.DEVNULL)


def done(out: Path) -> int:
    """How far a run is: outcomes, marks entered and pages written."""
    patterns = (".executed/cache/*.json", ".executed/entered/toy/*.json", "feedback/*/toy/*.html")
    return sum(len(list(out.glob(p))) for p in patterns)


def peak_mb(process: subprocess.Popen[bytes]) -> float:
    """Wait for a run to end; return the peak of its resident memory."""
    peak = 0
    while process.poll() is None:
        try:
            status = Path(f"/proc/{process.pid}/status").read_text(encoding="utf-8")
        except OSError:
            break
        peak = max([peak, *(int(line.split()[1]) for line in status.splitlines() if line.startswith("VmHWM"))])
        time.sleep(0.2)
    if process.wait():
        raise SystemExit(f"grade-class failed with {process.returncode}:\n{LOG.read_text()[-3000:]}")
    return peak / 1024


def outcome(out: Path) -> tuple[object, dict[str, bytes], list[list[str]]]:
    """What a run left: the gradebook, the autograded files, and the table; without the times that were measured."""
    folder = out / "autograded"
    files = {p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*") if p.is_file()}
    files = {name: re.sub(rb'("seconds": |in |after )[0-9.]+', rb"\1", data) for name, data in files.items()}
    lines = (out / "results" / "toy" / "grades.csv").read_text().splitlines()
    return backups.contents(f"sqlite:///{out / 'gradebook.db'}"), files, [line.split(",")[:7] for line in lines]


def kill_and_resume(base: Path, students: int, kills: int, jobs: int, draw: random.Random) -> list[int]:
    """Grade with kills at random moments; return where they hit, of ``3 * students`` steps."""
    moments = sorted(draw.randrange(3 * students) for _ in range(kills))
    hit = []
    for moment in moments:
        process = start(base, "in", "killed", jobs)
        while done(base / "killed") < moment and process.poll() is None:
            time.sleep(0.02)
        if process.poll() is not None:
            print(f"  ended before moment {moment}")
            continue
        process.kill()
        process.wait()
        hit.append(done(base / "killed"))
        print(f"  killed at {hit[-1]} of {3 * students} steps", flush=True)
    peak_mb(start(base, "in", "killed", jobs))
    return hit


def main() -> int:
    """Run the benchmark; 1 if anything differs."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--students", type=int, default=1000)
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument("--hostile", type=float, default=0.05)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--seed", type=int, default=7)
    arguments = parser.parse_args()
    draw = random.Random(arguments.seed)
    with tempfile.TemporaryDirectory(prefix="thousand-") as scratch:
        base = Path(scratch)
        toylab.make_course(base / "course")
        hostile = make_submissions(base / "in", arguments.students, arguments.hostile, draw)
        first = min(100, arguments.students)
        (base / "few").mkdir()
        for folder in sorted((base / "in").iterdir())[:first]:
            (base / "few" / folder.name).mkdir()
            for lab in folder.iterdir():
                (base / "few" / folder.name / lab.name).mkdir()
                for file in lab.iterdir():
                    (base / "few" / folder.name / lab.name / file.name).write_bytes(file.read_bytes())
        few = peak_mb(start(base, "few", "out-few", arguments.jobs))
        began = time.perf_counter()
        many = peak_mb(start(base, "in", "undisturbed", arguments.jobs))
        seconds = time.perf_counter() - began
        print(f"{arguments.students} submissions, {hostile} hostile: {seconds:.0f} s with {arguments.jobs} workers")
        print(f"peak memory: {few:.1f} MB for {first}, {many:.1f} MB for all: {many / few:.3f} times")
        hit = kill_and_resume(base, arguments.students, arguments.kills, arguments.jobs, draw)
        undisturbed, killed = outcome(base / "undisturbed"), outcome(base / "killed")
        leftovers = [p.name for p in (base / "killed").rglob("*.tmp")]
        same = [a == b for a, b in zip(undisturbed, killed, strict=True)]
        print(f"killed {len(hit)} times; gradebook, files, table equal: {same}; unfinished files: {len(leftovers)}")
        for name in sorted({*undisturbed[1], *killed[1]}):
            if undisturbed[1].get(name) != killed[1].get(name):
                print(f"  {name} differs")
        LOG.unlink(missing_ok=True)
        return 0 if all(same) and not leftovers and many / few <= 1.1 else 1


if __name__ == "__main__":
    sys.exit(main())

"""Stock ``nbgrader autograde`` against ``robotbrain grade-class`` on the same honest submissions of the real labs.

Run with ``python benchmarks/grading_stock.py`` (``--labs lab_integration --each 3 --rounds 1`` for a quick look). Of
each lab it takes the reference, one half done, some styles and mutants. Stock nbgrader gets its own ``Execute`` and its
own preprocessors; told apart from the defaults are only the tag of the cells that are not run while grading (the kit
does not run them either), the time limit per cell that the labs need, where the hidden tests are, and the student's
name in the environment (on which random draws of tests depend). The kit runs with the sandbox and the tester. The two
take turns, each in a process of its own, on one core and on two (``taskset``); the kit runs as many submissions at the
same time as it does by default on that many cores, stock nbgrader one after the other, which is all it can.

Steady state is the time per submission without the imports: for stock nbgrader from the first submission whose marks
are in the gradebook to the last; for the kit, which has several under way at once, from the moment that both its
servers have imported what the lab needs (its first submissions wait for that) to the last submission's marks. The whole
process includes all imports. ``--feedback`` lets the kit write the students' pages too, which stock ``autograde`` does
not.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

REPOSITORY = Path(__file__).resolve().parents[1]
LABS = ("lab_integration", "hw1_rl", "hw2_optimisation", "hw3_performance")
STOCK_CONFIG = """
import os, time
from nbgrader.converters import Autograde

c = get_config()
c.CourseDirectory.root = {root!r}
c.CourseDirectory.source_directory = "source"
c.CourseDirectory.release_directory = "release"
c.Execute.timeout = 300
c.Execute.skip_cells_with_tag = "skip-grading"

def note(**names):
    with open(os.path.join({root!r}, "times"), "a") as file:
        file.write(f"{{time.perf_counter()}}\\n")

def init_assignment(self, assignment_id, student_id, start=Autograde.init_assignment):
    os.environ["NBGRADER_STUDENT"] = student_id  # stock nbgrader tells nobody; the kit's random draws depend on it
    return start(self, assignment_id, student_id)

Autograde.init_assignment = init_assignment
c.Autograde.post_convert_hook = note
"""


def choose(manifest: dict[str, dict[str, Any]], each: int) -> list[str]:
    """Honest students: the reference, a half-done one, up to three styles, and mutants from all over the lab."""
    kinds: dict[str, list[str]] = {}
    for student, entry in manifest.items():
        kinds.setdefault(entry["kind"], []).append(student)
    chosen = [*kinds["reference"], *kinds.get("partly", []), *kinds.get("style", [])[:3]][:each]
    mutants = kinds.get("mutant", [])
    missing = min(each - len(chosen), len(mutants))
    return chosen + [mutants[i * len(mutants) // missing] for i in range(missing)]


def prepare(base: Path, labs: list[str], each: int) -> None:
    """Make the submissions and, for stock nbgrader, a course of each lab with its release in the gradebook."""
    from robotbrain.grading.course import find_course, generate
    from robotbrain.grading.sample import make_class

    home = find_course(REPOSITORY)
    for lab in labs:
        manifest = make_class(home, lab, base / "all" / lab)
        for student in choose(manifest, each):
            shutil.copytree(base / "all" / lab / student, base / "in" / lab / student)
        stock = home.isolated(base / "stock" / lab, lab)
        generate(stock, lab)
        shutil.copytree(base / "in" / lab, stock.root / "submitted")
        (stock.root / "nbgrader_config.py").write_text(STOCK_CONFIG.format(root=str(stock.root)))


def run(command: list[str], cores: str, cwd: Path, log: Path) -> float:
    """Run a command pinned to ``cores``; return its seconds."""
    env = {**os.environ, "ROBOTBRAIN_AUTOGRADER": str(REPOSITORY / "autograder"), "MPLBACKEND": "agg"}
    env["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{env['PATH']}"
    with log.open("ab") as file:
        began = time.perf_counter()
        subprocess.run(["taskset", "-c", cores, *command], cwd=cwd, env=env, stdout=file, stderr=file, check=True)
        return time.perf_counter() - began


def run_stock(base: Path, lab: str, cores: str) -> dict[str, Any]:
    """Autograde with nbgrader."""
    root = base / "stock" / lab
    (root / "times").unlink(missing_ok=True)
    whole = run([sys.executable, "-m", "nbgrader", "autograde", lab, "--force"], cores, root, base / "stock.log")
    times = [float(line) for line in (root / "times").read_text().split()]
    return {"whole": whole, "steady": (times[-1] - times[0]) / (len(times) - 1), "scores": scores(root, lab)}


def run_kit(base: Path, lab: str, cores: str, feedback: bool) -> dict[str, Any]:
    """Grade with the kit; :func:`kit_main` runs in the process."""
    root = base / "kit" / lab
    command = [sys.executable, __file__, "--inner", str(base), lab, str(int(feedback))]
    whole = run(command, cores, base, base / "kit.log")
    return {"whole": whole, **json.loads((base / "times.json").read_text()), "scores": scores(root, lab)}


def kit_main(base: Path, lab: str, feedback: bool) -> None:
    """What a run of the kit is, with a note of the times."""
    from robotbrain.grading import classroom, scheduler
    from robotbrain.grading.course import find_course
    from robotbrain.grading.entry import Entry
    from robotbrain.grading.sandbox.forkserver import ForkServer

    jobs = scheduler.fitting_workers()  # as without --jobs, on the cores that this process may use
    entered: list[float] = []
    ready: dict[int, float] = {}
    enter, ask = Entry.enter, ForkServer._ask

    def enter_and_note(self: Entry, person: Any, standing: Any) -> bool:
        try:
            return enter(self, person, standing)
        finally:
            entered.append(time.perf_counter())

    def ask_and_note(self: ForkServer, *job: Any) -> Any:
        ready.setdefault(id(self), time.perf_counter())
        return ask(self, *job)

    shutil.rmtree(base / "kit" / lab, ignore_errors=True)  # or there is nothing to enter
    Entry.enter = enter_and_note  # type: ignore[method-assign]
    ForkServer._ask = ask_and_note  # type: ignore[method-assign]
    classroom.grade_class(
        find_course(REPOSITORY),
        lab,
        submitted=base / "in" / lab,
        out=base / "kit" / lab,
        options=classroom.Options(workers=jobs, fresh=True, require_sandbox=True, feedback=feedback),
    )
    assert len(ready) == 2, "a server was not used, or had to be started again"
    last = time.perf_counter() if feedback else entered[-1]
    (base / "times.json").write_text(json.dumps({"steady": (last - max(ready.values())) / len(entered)}))


def scores(root: Path, lab: str) -> dict[str, float]:
    """Scores in a gradebook, by student and cell."""
    from nbgrader.api import Gradebook

    with Gradebook(f"sqlite:///{root / 'gradebook.db'}") as gradebook:
        found = {}
        for submission in gradebook.assignment_submissions(lab):
            for notebook in submission.notebooks:
                for grade in notebook.grades:
                    found[f"{submission.student.id} {grade.name}"] = grade.auto_score
        return found


def differences(lab: str, stock: dict[str, float], kit: dict[str, float]) -> list[str]:
    """Where the two disagree."""
    return [
        f"{lab} {name}: stock {stock.get(name)}, kit {kit.get(name)}"
        for name in sorted({*stock, *kit})
        if stock.get(name) != kit.get(name)
        and (stock.get(name) is None or kit.get(name) is None or abs(stock[name] - kit[name]) > 1e-9)
    ]


def main() -> int:
    """Run the benchmark; 1 if a score differs."""
    if sys.argv[1:2] == ["--inner"]:
        base, lab, feedback = sys.argv[2:]
        kit_main(Path(base), lab, bool(int(feedback)))
        return 0
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--labs", nargs="+", default=list(LABS), choices=LABS)
    parser.add_argument("--each", type=int, default=10, help="submissions per lab")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--cores", nargs="+", type=int, default=[1, 2])
    parser.add_argument("--feedback", action="store_true")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="stock-") as scratch:
        base = Path(scratch)
        prepare(base, arguments.labs, arguments.each)
        wrong: set[str] = set()
        for cores in arguments.cores:
            pinned = ",".join(map(str, sorted(os.sched_getaffinity(0))[:cores]))
            found: dict[str, list[tuple[float, float]]] = {"steady": [], "whole": []}
            for number in range(arguments.rounds):
                sums = {"steady": [0.0, 0.0], "whole": [0.0, 0.0]}
                for lab in arguments.labs:
                    stock = run_stock(base, lab, pinned)
                    kit = run_kit(base, lab, pinned, arguments.feedback)
                    wrong |= set(differences(lab, stock["scores"], kit["scores"]))
                    for kind, (a, b) in sums.items():
                        sums[kind] = [a + stock[kind], b + kit[kind]]
                    print(
                        f"{cores} core(s), round {number + 1}, {lab}: per submission stock {stock['steady']:.2f} s, "
                        f"kit {kit['steady']:.3f} s; "
                        f"whole {stock['whole']:.1f} and {kit['whole']:.1f} s",
                        flush=True,
                    )
                for kind, (a, b) in sums.items():
                    found[kind].append((a / len(arguments.labs), b / len(arguments.labs)))
            for kind, pairs in found.items():
                ratios = sorted(a / b for a, b in pairs)
                means = [statistics.median(column) for column in zip(*pairs, strict=True)]
                print(
                    f"{cores} core(s), {kind}: stock {means[0]:.2f} s, kit {means[1]:.3f} s, "
                    f"{statistics.median(ratios):.1f} times (rounds {', '.join(f'{r:.1f}' for r in ratios)})"
                )
        print(f"scores that differ: {len(wrong)}")
        print("\n".join(sorted(wrong)))
        return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())

"""The capstone itself: generated from its solution, fair, tested by named wrong solutions, and its story true."""

from __future__ import annotations

import math
import re
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import nbformat
import numpy as np
import pytest

from robotbrain.errors import InputError
from robotbrain.grading import CheckFailure, Suite, load_hidden_suite
from robotbrain.grading.course import find_course, release_differences
from robotbrain.grading.sample import load_mutants
from robotbrain.grading.student import STUDENT_VARIABLE
from robotbrain.grading.suites import capstone_drives as drives
from robotbrain.grading.suites import capstone_parts as parts
from robotbrain.pipeline.brain import ROLES
from robotbrain.pipeline.capstone import BRIEF, BrainParts, Launch, drive_brain
from robotbrain.rl.tasks import navigation_spec as spec
from tests import classes
from tests.conftest import REPO
from tests.remote_labs import LabBench, lost

LAB = "capstone"
GOOD = Launch((("perception",), ("estimator",), ("controller",), ("mapper", "planner", "mission")), precision="int8")
MUTANTS, STYLES = load_mutants(find_course(REPO), LAB)


@pytest.fixture(scope="module")
def suite(repo: Path) -> Suite:
    return load_hidden_suite(LAB, repo / "autograder")


@pytest.fixture(scope="module")
def solution(repo: Path) -> Any:
    return nbformat.read(repo / "solutions" / LAB / f"{LAB}.ipynb", as_version=4)


def test_labs_is_what_solutions_generates(repo: Path, tmp_path: Path) -> None:
    assert release_differences(find_course(repo), LAB, tmp_path) == []


def test_the_released_lab_holds_no_answer_no_hidden_test_and_no_file(repo: Path) -> None:
    text = (repo / "labs" / LAB / f"{LAB}.ipynb").read_text(encoding="utf-8")
    for secret in ("BEGIN SOLUTION", "HIDDEN TESTS", "hidden=True", "heapq.heappush", "bad_s", "autograder", "73100"):
        assert secret not in text, secret
    assert text.count("raise NotImplementedError()") >= 9
    assert not list((repo / "labs" / LAB).glob("*.onnx"))


def test_points_agree_between_notebook_and_tests(repo: Path, suite: Suite) -> None:
    classes.check_points(repo, LAB, suite, automatic=80, by_hand=20)


def test_every_hint_and_every_mutant_is_of_use(repo: Path, suite: Suite) -> None:
    assert len(MUTANTS) >= 30 and len(STYLES) == 2
    assert {m.hint for m in MUTANTS} <= set(suite.hints)
    assert {m.exercise for m in MUTANTS} == set(suite.exercises)
    names = ("capstone", "capstone_parts", "capstone_drives", "hw2_optimisation_network", "hw2_optimisation_judge")
    files = [
        f"src/robotbrain/grading/suites/{name}.py" for name in (*names, "lab_integration_planning", "planner_bench")
    ]
    tests = "".join((repo / name).read_text(encoding="utf-8") for name in [*files, f"autograder/hidden/{LAB}.py"])
    assert [key for key in suite.hints if tests.count(f'"{key}"') < 2] == []


def test_starter_parts_cost_what_the_notebook_and_the_form_say(repo: Path, solution: Any, suite: Suite) -> None:
    text = next(c.source for c in solution.cells if c.id == "how")
    form = (repo / "autograder" / "capstone_rubric.md").read_text(encoding="utf-8")
    for part in ("network", "policy", "planner"):
        mutant = next(m for m in MUTANTS if m.name == f"starter-{part}")
        price = f"{mutant.loses:g} of {suite.exercises[part].points:g}"
        assert f"costs {price} points" in text and price in form, part


# ---------------------------------------------------------------- the rubric


def rows(text: str, heading: str) -> dict[str, list[str]]:
    """Return the rows of the table under a heading row, by their first column."""
    lines = text.splitlines()
    found = {}
    for line in lines[lines.index(heading) + 2 :]:
        if not line.startswith("|"):
            break
        first, *others = [cell.strip() for cell in line.strip("|").split("|")]
        found[first] = others
    return found


LEVELS = "| criterion | excellent (5) | good (4) | sufficient (2) | insufficient (0) |"
MACHINE = "| exercise | points | what excellent means |"


def test_the_form_of_the_instructor_is_the_rubric_of_the_student(repo: Path, solution: Any, suite: Suite) -> None:
    text = next(c.source for c in solution.cells if c.id == "part6")
    form = (repo / "autograder" / "capstone_rubric.md").read_text(encoding="utf-8")
    assert rows(text, LEVELS) == rows(form, LEVELS) and rows(text, MACHINE) == rows(form, MACHINE)
    assert {title: float(cells[0]) for title, cells in rows(text, MACHINE).items()} == {
        e.title: e.points for e in suite.exercises.values()
    }
    by_hand = {c.metadata.nbgrader.grade_id: c.metadata.nbgrader.points for c in solution.cells
               if c.cell_type == "markdown" and c.metadata.get("nbgrader", {}).get("grade")}  # fmt: skip
    asked = re.findall(r"^\| `(report-\w+)` \| ([^|]+) \| __ / (\d+) \|", form, re.MULTILINE)
    assert {cell: float(points) for cell, _, points in asked} == by_hand
    assert [criterion for _, criterion, _ in asked] == list(rows(text, LEVELS))
    for (cell, criterion, _), number in zip(asked, range(1, 5), strict=True):
        question = next(c.source for c in solution.cells if c.id == f"{cell}-ask")
        assert question.startswith(f"**6.{number} {criterion}.**")
    assert set(by_hand.values()) == {5}  # the best level of each criterion, and 0 is its worst


# ---------------------------------------------------------------- the kit's part


@pytest.mark.parametrize(
    "changes",
    [
        {"executors": (("perception", "estimator", "mapper", "planner", "mission"),)},
        {"executors": (ROLES, ("controller",))},
        {"executors": ("perception",)},
        {"executors": ((*ROLES, "brain"),)},
        {"precision": "int4"},
        {"camera_queue": 0},
        {"replan_after": 0},
        {"replan_after": float("nan")},
    ],
)
def test_a_launch_that_cannot_be_is_refused(changes: dict[str, Any]) -> None:
    with pytest.raises(InputError):
        replace(GOOD, **changes)


def test_a_launch_puts_its_groups_on_one_executor_each() -> None:
    from robotbrain.ros import SimContext

    context = SimContext()
    GOOD.install(context)
    of = {
        role: context.default_executor_factory(SimpleNamespace(get_name=lambda role=role: role))  # type: ignore[arg-type]
        for role in (*ROLES, "robot", "other")
    }
    assert of["mapper"] is of["planner"] is of["mission"]
    assert len({id(executor) for executor in of.values()}) == 6


def kit(**changes: Any) -> BrainParts:
    given = {"planner": parts.stand_in_planner, "observe": parts.observe, "supervisor": drives.Watchdog}
    return BrainParts(network=None, policy=None, **{**given, **changes})


class Trusting:
    """A supervisor that trusts the policy whatever happens."""

    def decide(self, health: Any) -> str:
        return "policy"


SHORT = replace(BRIEF, seconds=7.0)


def test_who_drives_is_the_supervisors_word() -> None:
    from robotbrain.monitoring.faults import Blackout

    dark = Blackout("/camera/image", during=(1.5, 4.2))
    found = drive_brain(5000, kit(), GOOD, brief=SHORT, attach=[dark.install], policy_fails_at=6.0)
    assert [mode for _, mode in found.modes] == ["policy", "pursuit", "stop", "pursuit", "policy", "pursuit"]
    times = [time for time, _ in found.modes]
    assert times[1] == pytest.approx(1.5 + drives.OLD_S, abs=0.25)
    assert times[2] == pytest.approx(1.5 + drives.BLIND_S, abs=0.25)
    assert times[4] - times[3] == pytest.approx(drives.PAUSE_S, abs=0.15) and times[5] == pytest.approx(6.0, abs=0.11)
    t, x, y = found.run.trajectory[:, :3].T
    still = (t > times[2] + 0.6) & (t < times[3])
    assert np.ptp(x[still]) < 0.01 and np.ptp(y[still]) < 0.01


def test_a_policy_without_an_answer_moves_nothing_and_a_made_up_word_is_refused() -> None:
    from robotbrain.ros import CallbackError

    found = drive_brain(5000, kit(supervisor=Trusting), GOOD, brief=replace(BRIEF, seconds=3.0), policy_fails_at=0.0)
    assert found.run.path_length < 0.02 and found.modes[0][1] == "policy"
    wrong = SimpleNamespace(decide=lambda health: "faster")
    with pytest.raises(CallbackError) as caught:
        drive_brain(5000, kit(supervisor=lambda: wrong), GOOD, brief=SHORT)
    assert isinstance(caught.value.cause, InputError)


def test_what_misses_deadlines_is_seen_and_names_itself() -> None:
    shared = replace(GOOD, executors=(("perception", "estimator"), ("controller",), ("mapper", "planner", "mission")))
    short = replace(BRIEF, seconds=3.0)
    well, ill = (drive_brain(5000, kit(), launch, brief=short) for launch in (GOOD, shared))
    drives.check_real_time(well, "")
    assert well.missed == 0 and ill.missed > 5 * BRIEF.missed
    with pytest.raises(CheckFailure, match="deadlines") as caught:
        drives.check_real_time(ill, "")
    assert "estimator_wheels" in str(caught.value.got)


# ---------------------------------------------------------------- the oracles


def test_our_watchdog_is_the_table_of_the_notebook() -> None:
    """The table read literally: each row looks at the whole past, instead of keeping a time."""
    nan = float("nan")
    rng = np.random.default_rng(0)
    for _ in range(30):
        dog, past = drives.Watchdog(), []
        for now, changes in drives.random_story(rng):
            if rng.random() < 0.05:
                changes = {**changes, "image_age_s": nan}
            h = drives.moment(now, **changes)
            stop = any(math.isnan(age) or age > limit for age, limit in
                       ((h.scan_age_s, 0.5), (h.pose_age_s, 0.5), (h.image_age_s, 2)))  # fmt: skip
            odd = any(not math.isfinite(v) or abs(v) > 2 for v in h.inputs) or not all(map(math.isfinite, h.action))
            past.append((now, stop or odd or not h.image_age_s <= 0.5))
            lately = any(bad and now - then < 1.0 for then, bad in past)
            assert dog.decide(h) == ("stop" if stop else "pursuit" if lately else "policy")


def test_the_glue_shows_what_the_training_shows() -> None:
    rng = np.random.default_rng(1)
    for _ in range(20):
        pose, velocity, waypoint, points, last = parts.random_question(rng)
        x, y, yaw = pose
        goal = (complex(*waypoint) - complex(x, y)) * np.exp(-1j * yaw)
        wanted = spec.observation(velocity, (goal.real, goal.imag), spec.sector_ranges(points), last)[0]
        assert parts.observe(pose, velocity, waypoint, points, last) == pytest.approx(wanted, abs=1e-5)


def judged(successes: str, touched: str = "") -> list[Any]:
    """Return made-up runs: ``w`` won, ``l`` lost."""
    made = dict.fromkeys(("controller", "perception", "estimator_scan", "estimator_wheels"), 0)
    return [
        SimpleNamespace(
            missed=0.0,
            run=SimpleNamespace(
                success=one == "w", reason="reached" if one == "w" else "did not arrive", collisions=(),
                deadline_misses=made, e2e_ms=np.array([100.0]),
            ),
        )
        for one in successes
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("course", "driven", "credit"),
    [("www", 3, 1.0), ("wlwwww", 6, 1.0), ("wwlwwl", 6, 0.5), ("lwlwww", 6, 0.5), ("wwlll", 5, 0.0), ("lll", 3, 0.0)],
)
def test_three_of_three_five_of_six_or_half(
    monkeypatch: pytest.MonkeyPatch, course: str, driven: int, credit: float
) -> None:
    runs = iter(judged(course + "w" * 6))
    asked: list[int] = []
    monkeypatch.setattr(drives, "drive", lambda student, world, **how: (asked.append(world), next(runs))[1])
    earned = 1.0
    try:
        drives.judge_worlds(SimpleNamespace(), range(6), 3)  # type: ignore[arg-type]
    except CheckFailure as failure:
        earned = failure.credit
    assert (len(asked), earned) == (driven, credit)


# ---------------------------------------------------------------- the answers


@pytest.fixture(autouse=True)
def beside(repo: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> Path:
    """Each test is another student, with the reference's files beside the notebook."""
    monkeypatch.setenv(STUDENT_VARIABLE, request.node.name)
    for path in (repo / "autograder" / "reference" / LAB).iterdir():
        shutil.copy(path, tmp_path)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(scope="module")
def bench() -> Iterator[LabBench]:
    yield LabBench(REPO, LAB)


def test_the_reference_earns_everything_and_nothing_earns_nothing(bench: LabBench, suite: Suite) -> None:
    names = bench.namespace()
    results = bench.remote(names)
    assert lost(results) == {}, [r.message for rs in results.values() for r in rs if not r.passed]
    given = {name for exercise in suite.exercises.values() for name in exercise.provides}
    empty = bench.remote({name: value for name, value in names.items() if name not in given})
    assert not any(r.earned for rs in empty.values() for r in rs)


QUICK = ("network", "policy", "observe", "planner", "supervise")
"""What drives (`integrate`), `make mutation-test` tries; here is what is judged in a second."""


@pytest.mark.parametrize("style", STYLES, ids=lambda style: style.name)
def test_every_style_earns_everything(bench: LabBench, style: Any) -> None:
    results = bench.remote(bench.namespace(style.replace), ("observe", "planner", "supervise"))
    assert lost(results) == {}, [r.message for rs in results.values() for r in rs if not r.passed]


@pytest.mark.parametrize("mutant", [m for m in MUTANTS if m.exercise in QUICK], ids=lambda mutant: mutant.name)
def test_every_mutant_loses_its_exercise_with_its_own_hint(repo: Path, bench: LabBench, beside: Path,
                                                           mutant: Any) -> None:  # fmt: skip
    for name, make in mutant.files.items():
        content = make(repo / "autograder" / "reference" / LAB)
        (beside / name).unlink()
        if content is not None:
            (beside / name).write_bytes(content)
    names = bench.namespace(mutant.replace)
    results = bench.remote(names, [mutant.exercise])
    loss = lost(results).get(mutant.exercise, 0.0)
    assert loss > 0 and mutant.loses in (None, pytest.approx(loss))
    assert mutant.hint in {r.hint_key for r in results[mutant.exercise] if not r.passed}


def test_the_kits_own_answers_earn_nothing(bench: LabBench) -> None:
    taken = {
        "observe": "from robotbrain.grading.suites.capstone_parts import observe",
        "supervise": "from robotbrain.grading.suites.capstone_drives import Watchdog as Supervisor",
    }
    results = bench.remote(bench.namespace(taken), list(taken))
    assert not any(r.earned for rs in results.values() for r in rs)


def test_a_harmful_file_is_refused_in_words(bench: LabBench, beside: Path) -> None:
    names = bench.namespace()
    for name, exercise in (("perception.onnx", "network"), ("policy.onnx", "policy")):
        (beside / name).write_bytes(b"import os; os.system('true')")
        results = bench.remote(names, [exercise])
        assert not any(r.earned for r in results[exercise]), exercise
        assert {r.hint_key for r in results[exercise]} <= {"not-a-network", "not-a-policy"}

"""Homework 3 itself: generated from its solution, its tests tested by named wrong solutions, its story true."""

from __future__ import annotations

import functools
import json
import math
from collections.abc import Callable, Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from robotbrain.errors import InputError
from robotbrain.grading import CheckFailure, Suite, load_hidden_suite
from robotbrain.grading.course import find_course, release_differences
from robotbrain.grading.sample import load_mutants
from robotbrain.grading.suites import hw3_performance_drives as drives
from robotbrain.grading.suites import hw3_performance_tools as tools
from robotbrain.grading.suites import hw3_performance_traces as traces
from robotbrain.grading.suites import hw3_performance_verdict as verdict
from robotbrain.pipeline.inherited import (
    BrainSetup,
    cropped_planner,
    inherited_brain,
    unmet_requirements,
    whole_map_planner,
)
from robotbrain.pipeline.nodes.planner import PlannerNode
from robotbrain.ros import charge_work
from tests import classes

LAB = "hw3_performance"


@pytest.fixture(scope="module")
def suite(repo: Path) -> Suite:
    return load_hidden_suite(LAB, repo / "autograder")


def test_labs_is_what_solutions_generates(repo: Path, tmp_path: Path) -> None:
    assert release_differences(find_course(repo), LAB, tmp_path) == []


def test_the_released_lab_holds_no_answer_and_no_hidden_test(repo: Path) -> None:
    text = (repo / "labs" / LAB / f"{LAB}.ipynb").read_text(encoding="utf-8")
    for secret in (
        "BEGIN SOLUTION",
        "HIDDEN TESTS",
        "hidden=True",
        "np.isfinite(cost",
        "binom.ppf(0.025, n, 0.5)))\\n",
    ):
        assert secret not in text
    assert text.count("raise NotImplementedError()") >= 12


def test_points_agree_between_notebook_and_tests(repo: Path, suite: Suite) -> None:
    classes.check_points(repo, LAB, suite, automatic=90, by_hand=10)


def test_every_hint_and_every_mutant_is_of_use(repo: Path, suite: Suite) -> None:
    mutants, styles = load_mutants(find_course(repo), LAB)
    assert len(mutants) >= 20 and len(styles) == 3
    assert {m.hint for m in mutants} <= set(suite.hints)
    assert {m.exercise for m in mutants} == set(suite.exercises)
    files = [f"src/robotbrain/grading/suites/{LAB}{part}.py" for part in ("", "_tools", "_drives", "_verdict")]
    files.append("src/robotbrain/grading/suites/planner_bench.py")
    tests = "".join((repo / name).read_text(encoding="utf-8") for name in [*files, f"autograder/hidden/{LAB}.py"])
    assert [key for key in suite.hints if tests.count(f'"{key}"') < 2] == []


# ---------------------------------------------------------------- the oracles against the kit's own watch


@pytest.mark.parametrize("stage", ["size", "size+int8+threads"])
def test_ages_and_chains_agree_with_what_the_kit_follows_by_stamps(stage: str) -> None:
    run = traces.brain_run(stage, seconds=4.0)
    assert run.trace is not None
    count = len(run.camera_age_ms)
    assert count > 40
    assert tools.ages(run.trace)[-count:] == pytest.approx(run.camera_age_ms, abs=1e-6)
    by_id = {c.id: c for c in run.trace.callbacks}
    commands = [m for m in run.trace.messages if m.name == tools.COMMAND and m.id in run.trace.sender][-count:]
    for command, age in list(zip(commands, run.camera_age_ms, strict=True))[::7]:
        links = [by_id[number] for number in tools.chain(run.trace, command.id)]
        assert [c.node for c in links] == ["/robot", "/perception", "/controller", "/controller"]
        assert (links[-1].end_ns - links[0].end_ns) / 1e6 == pytest.approx(age, abs=1e-6)


def test_utilisation_agrees_with_the_device() -> None:
    run = traces.brain_run("size")
    assert run.trace is not None
    for name, share in tools.resource_use(run.trace).items():
        # The device also counts the callback that was not over at the end.
        assert share == pytest.approx(run.busy[name], abs=0.03)


def test_planted_bottlenecks_are_found_by_the_rule() -> None:
    rng = np.random.default_rng(0)
    for cause in traces.PLANTS * 4:
        for one_thread in (False, True):
            trace, answer = traces.random_pipeline(rng, cause, one_thread=one_thread)
            assert tools.bottleneck(trace) == answer
            # Nothing planted lies near a threshold: a little more or less strictness changes no verdict.
            assert tools.bottleneck(trace, full=0.85) == tools.bottleneck(trace, full=0.93) == answer
            assert tools.bottleneck(trace, main=0.55) == tools.bottleneck(trace, main=0.75) == answer


def test_the_median_interval_covers_the_median_as_often_as_it_says() -> None:
    rng = np.random.default_rng(1)
    hits = 0
    for _ in range(400):
        ratios = rng.lognormal(np.log(2.0), 0.6, 9)
        before = [verdict.made_up_run(k, True, [100.0 * r]) for k, r in enumerate(ratios)]
        after = [verdict.made_up_run(k, True, [100.0]) for k in range(9)]
        low, high = verdict.verdict(before, after)["interval"]
        hits += low <= 2.0 <= high
    assert 0.93 <= hits / 400 <= 0.99  # exactly 96.1 % for nine pairs


# ---------------------------------------------------------------- the patient


@pytest.mark.parametrize(
    "key",
    [
        (drives.NANO, 640, 480, "int8", 1, False, "cropped_planner", 1.0, 1, drives.TIME_LIMIT),
        (drives.NANO, 640, 480, "fp16", None, True, "whole_map_planner", 0.25, 4, drives.TIME_LIMIT),
        (drives.NX, 640, 480, "int8", 1, True, "free_planner", 2.0, 3, 4.0),
    ],
    ids=lambda key: f"{key[0]}-{key[6]}",
)
def test_drives_that_grading_looks_up_are_what_they_were(
    suite: Suite, key: drives.Key, monkeypatch: pytest.MonkeyPatch
) -> None:
    known = drives.KNOWN[key]
    monkeypatch.setattr(drives, "KNOWN", {})
    setup, world, limit = setup_of(key)
    assert drives.key_of(setup, world, limit) == key
    again = drives.driven(setup, world, limit)
    assert again.success == known.success and again.reason == known.reason
    assert (again.e2e_p95_ms, again.image_p95_ms) == pytest.approx((known.e2e_p95_ms, known.image_p95_ms), rel=1e-6)


def test_every_drive_that_grading_looks_up_is_found_by_the_brain_that_made_it(suite: Suite) -> None:
    assert drives.KNOWN
    for key in drives.KNOWN:
        assert drives.key_of(*setup_of(key)) == key


def setup_of(key: drives.Key) -> tuple[BrainSetup, int, float]:
    module, width, height, precision, queue, one_thread, planner, age, world, limit = key
    given = inherited_brain()
    deployment = replace(
        given.deployment,
        image_size=(width, height),  # type: ignore[arg-type]
        precision=precision,  # type: ignore[arg-type]
        camera_queue=queue,  # type: ignore[arg-type]
        one_thread=bool(one_thread),
    )
    kits = {f.__name__: f for f in (cropped_planner, whole_map_planner, drives.free_planner)}
    setup = BrainSetup(str(module), deployment, kits[str(planner)], float(age or 0))
    return setup, int(world or 0), float(limit or 0)


class OneThread:
    """A student whose planner is their own, and whose nodes all share a thread."""

    def __init__(self, setup: BrainSetup, planner: Callable[[], Any] = cropped_planner) -> None:
        self.setup, self.planner = setup, planner

    def __getitem__(self, name: str) -> object:
        return None

    def run(self, probe: Callable[..., Any], module: str) -> Any:
        if probe is drives.host_repaired:
            return drives.PlannerHost(self.planner)
        deployment = {f.name: getattr(self.setup.deployment, f.name) for f in fields(self.setup.deployment)}
        there = {"module": module or self.setup.module, "replan_after": self.setup.replan_after}
        return {"deployment": deployment, "planner": "", **there}


@pytest.fixture
def counted(monkeypatch: pytest.MonkeyPatch) -> list[BrainSetup]:
    """The brains that drive."""
    drove: list[BrainSetup] = []
    drive = BrainSetup.drive

    def noted(self: BrainSetup, *args: Any, **kwargs: Any) -> Any:
        drove.append(self)
        return drive(self, *args, **kwargs)

    monkeypatch.setattr(BrainSetup, "drive", noted)
    return drove


def on_one_thread(**changes: Any) -> BrainSetup:
    given = inherited_brain()
    deployment = replace(given.deployment, image_size=(640, 480), precision="int8", camera_queue=1)
    return replace(given, deployment=deployment, **changes)


class Dear(PlannerNode):
    """A planner that plans like the kit's and charges more."""

    def __init__(self, for_maps: Mapping[str, float], for_answers: Mapping[str, float]) -> None:
        super().__init__()
        self.for_maps, self.for_answers = for_maps, for_answers

    def _on_map(self, msg: Any) -> None:
        super()._on_map(msg)
        for kind, units in self.for_maps.items():
            charge_work(kind, units)

    def _plan(self, request: Any, response: Any) -> Any:
        for kind, units in self.for_answers.items():
            charge_work(kind, units)
        return super()._plan(request, response)


class Astray(PlannerNode):
    """A planner that leads half a metre aside in maps of the brain's size."""

    def _plan(self, request: Any, response: Any) -> Any:
        answer = super()._plan(request, response)
        for pose in answer.plan.poses if self._map is not None and self._map.info.width > 100 else ():
            pose.pose.position.y += 0.5
        return answer


class Raising(PlannerNode):
    """A planner that knows no way."""

    def _plan(self, request: Any, response: Any) -> Any:
        raise ValueError("no way")


def test_a_planner_of_ones_own_on_one_thread_drives_wherever_it_decides(
    suite: Suite, counted: list[BrainSetup], monkeypatch: pytest.MonkeyPatch
) -> None:
    hopeless = drives.drive_repaired(OneThread(on_one_thread()), 3, drives.NX, time_limit=4.0)  # type: ignore[arg-type]
    assert hopeless.e2e_p95_ms > drives.HALF_BUDGETS * drives.BUDGET_MS[drives.NX]
    assert counted == []
    key = drives.key_of(on_one_thread(module=drives.NX, planner=drives.free_planner), 3, 4.0)
    assert key is not None  # if that one comes near to what earns points, another might come there
    near = replace(drives.KNOWN[key], e2e_p95_ms=1.1 * drives.HALF_BUDGETS * drives.BUDGET_MS[drives.NX])
    monkeypatch.setitem(drives.KNOWN, key, near)
    drives.drive_repaired(OneThread(on_one_thread()), 3, drives.NX, time_limit=4.0)  # type: ignore[arg-type]
    assert len(counted) == 1


@pytest.mark.parametrize("world", [1, 4])
def test_a_planner_on_one_thread_that_takes_no_longer_than_the_kits_need_not_drive(
    suite: Suite, counted: list[BrainSetup], monkeypatch: pytest.MonkeyPatch, world: int
) -> None:
    student = OneThread(on_one_thread())
    found = drives.drive_repaired(student, world)  # type: ignore[arg-type]
    assert counted == [] and found.success and found.e2e_p95_ms <= drives.BUDGET_MS[drives.NANO]
    monkeypatch.setattr(drives, "KNOWN", {})
    driven = drives.drive_repaired(student, world)  # type: ignore[arg-type]
    assert len(counted) == 1 and driven.success
    assert driven.e2e_p95_ms == pytest.approx(found.e2e_p95_ms, rel=0.02)


@pytest.mark.parametrize(
    ("for_maps", "for_answers", "late"),
    [
        ({}, {"astar": 30_000}, True),
        ({"astar": 30_000}, {}, True),
        ({}, {"view": 1}, False),  # of a kind that no planner has
    ],
    ids=["answers", "maps", "another-kind"],
)
def test_a_planner_on_one_thread_that_takes_longer_drives(
    suite: Suite,
    counted: list[BrainSetup],
    for_maps: dict[str, float],
    for_answers: dict[str, float],
    late: bool,
) -> None:
    student = OneThread(on_one_thread(), functools.partial(Dear, for_maps, for_answers))
    found = drives.drive_repaired(student, 1)  # type: ignore[arg-type]
    assert len(counted) == 1 and (found.e2e_p95_ms > 1.2 * drives.BUDGET_MS[drives.NANO]) == late


def test_a_planner_on_one_thread_that_leads_elsewhere_in_a_room_of_the_brains_size_drives(
    suite: Suite, counted: list[BrainSetup]
) -> None:
    run = drives.drive_repaired(OneThread(on_one_thread(), Astray), 1)  # type: ignore[arg-type]
    assert len(counted) == 1 and not run.success


def test_a_planner_on_one_thread_that_raises_is_reported_as_its_drive_does(suite: Suite) -> None:
    with pytest.raises(CheckFailure, match="the planner raised ValueError on the way"):
        drives.drive_repaired(OneThread(on_one_thread(), Raising), 1)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "work", [{"astar": math.nan}, {"astar": -1e9, "costmap": 1e9}, {"astar": math.inf}, {"view": 0}]
)
def test_charges_that_are_no_charges_are_not_compared(work: dict[str, float]) -> None:
    one = {"astar": 100.0, "costmap": 100.0}
    fair = [one], [one]
    assert drives._never_more(fair, fair, drives.NANO)
    assert not drives._never_more(([work], [one]), fair, drives.NANO)
    assert not drives._never_more(([one], [work]), fair, drives.NANO)


def test_requirements_name_what_is_broken() -> None:
    given = inherited_brain()
    assert unmet_requirements(given) == []

    def deployed(**changes: object) -> BrainSetup:
        return replace(given, deployment=replace(given.deployment, **changes))  # type: ignore[arg-type]

    assert unmet_requirements(deployed(image_size=(640, 480), precision="int8", camera_queue=1, one_thread=False)) == []
    for broken, word in (
        (deployed(image_size=(640, 320)), "image_size"),
        (deployed(image_size=None), "image_size"),
        (deployed(network=None), "network"),
        (deployed(scan_rays=60), "scan_rays"),
        (replace(given, module="agx-orin-64gb:MAXN"), "module"),
        (replace(given, replan_after=5.0), "replan_after"),
    ):
        found = unmet_requirements(broken)
        assert len(found) == 1 and found[0].startswith(word)
    with pytest.raises(InputError, match="planner"):
        replace(given, planner=3)  # type: ignore[arg-type]


def test_what_the_homework_tells_about_the_patient_is_true(repo: Path) -> None:
    stored = json.loads((repo / "autograder" / "reference" / f"{LAB}.json").read_text(encoding="utf-8"))
    ill = traces.brain_run("inherited", seconds=stored["inherited"]["seconds"])
    assert len(ill.e2e_ms) == stored["inherited"]["commands_built_on_an_image"] == 0
    late = float(np.percentile(ill.perception_ms, 95))
    assert late == pytest.approx(stored["inherited"]["image_to_points_p95_ms"], rel=0.02)
    seconds = stored["int8_after_size"]["seconds"]
    measured = tools.service_ms(
        traces.brain_trace("size+int8", seconds=seconds), tools.PERCEPTION, tools.IMAGE, "gpu", 1.0
    )
    assert measured == pytest.approx(stored["int8_after_size"]["perception_ms"], rel=0.02)
    # The same brain has another bottleneck on another module, and each cure brings up the next.
    nano, nx = "orin-nano-8gb:15W", "xavier-nx:15W"
    assert tools.bottleneck(traces.brain_trace("inherited", nano, 4.0)) == ("perception", "cpu")
    assert tools.bottleneck(traces.brain_trace("size", nano)) == ("perception", "sharing")
    assert tools.bottleneck(traces.brain_trace("inherited", nx, 8.0)) == ("perception", "gpu")
    assert tools.bottleneck(traces.brain_trace("int8", nx)) == ("perception", "cpu")
    assert tools.bottleneck(traces.brain_trace("size+int8", nx)) == ("perception", "sharing")
    assert tools.bottleneck(traces.brain_trace("size+int8+threads", nx)) == ("", "none")


# ---------------------------------------------------------------- the class


@pytest.fixture(scope="module")
def graded(repo: Path, tmp_path_factory: pytest.TempPathFactory) -> classes.Graded:
    seen = set()

    def keep(entry: dict[str, Any]) -> bool:
        # Here one mutant for each exercise, the styles and the stub; `make mutation-test` grades all.
        exercise = entry.get("exercise")
        first = entry["kind"] == "mutant" and exercise not in seen
        seen.add(exercise)
        return first or entry["kind"] in ("reference", "style", "stub")

    return classes.grade_sample(repo, LAB, tmp_path_factory.mktemp("class"), keep)


@pytest.mark.timeout(1200)
def test_every_mutant_loses_its_own_points_only_and_every_style_gets_all(graded: classes.Graded) -> None:
    classes.check_losses(graded, at_least=15)


def test_every_submission_ends_in_a_grade_and_a_feedback_page(graded: classes.Graded) -> None:
    classes.check_pages(graded, LAB)


def test_hidden_tests_do_not_show_in_feedback(graded: classes.Graded) -> None:
    classes.check_secrets(graded, LAB, "_random_trace", "compare_ages")

"""Homework 1 itself: generated from its solution, its tests tested by named wrong solutions, its story true."""

from __future__ import annotations

import copy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import nbformat
import numpy as np
import pytest
import torch
from torch import nn

from robotbrain.grading import CheckFailure, Suite, load_hidden_suite
from robotbrain.grading.course import find_course, release_differences
from robotbrain.grading.sample import Reference, load_mutants
from robotbrain.grading.student import Student
from robotbrain.grading.suites import hw1_rl_evidence as evidence
from robotbrain.grading.suites import hw1_rl_learning as learning
from robotbrain.grading.suites import hw1_rl_memory as memory
from robotbrain.grading.suites import hw1_rl_policy as policy
from robotbrain.grading.suites import hw1_rl_probes as probes
from robotbrain.grading.suites import hw1_rl_tools as tools
from tests import classes, far

LAB = "hw1_rl"


@pytest.fixture(scope="module")
def suite(repo: Path) -> Suite:
    return load_hidden_suite(LAB, repo / "autograder")


@pytest.fixture(scope="module")
def handed_in(repo: Path) -> Path:
    return repo / "autograder" / "reference" / LAB


def test_labs_is_what_solutions_generates(repo: Path, tmp_path: Path) -> None:
    assert release_differences(find_course(repo), LAB, tmp_path) == []


def test_the_released_lab_holds_no_answer_no_hidden_test_and_no_policy(repo: Path) -> None:
    text = (repo / "labs" / LAB / f"{LAB}.ipynb").read_text(encoding="utf-8")
    for secret in (
        "BEGIN SOLUTION",
        "HIDDEN TESTS",
        "hidden=True",
        "copy.deepcopy(actor)",
        '"a": "breaks"',
        "np.hypot",
    ):
        assert secret not in text, secret
    assert text.count("raise NotImplementedError()") >= 15
    assert not list((repo / "labs" / LAB).glob("*.onnx"))


def test_points_agree_between_notebook_and_tests(repo: Path, suite: Suite) -> None:
    classes.check_points(repo, LAB, suite, automatic=92, by_hand=8)


def test_nothing_is_trained_while_grading(repo: Path) -> None:
    notebook = nbformat.read(repo / "solutions" / LAB / f"{LAB}.ipynb", as_version=4)
    for cell in notebook.cells:
        if cell.cell_type == "code" and ("= train(" in cell.source or "export_policy(" in cell.source):
            assert "skip-grading" in cell.metadata.get("tags", []), cell.id


def test_every_hint_and_every_mutant_is_of_use(repo: Path, suite: Suite) -> None:
    mutants, styles = load_mutants(find_course(repo), LAB)
    assert len(mutants) >= 25 and len(styles) == 3
    assert {m.hint for m in mutants} <= set(suite.hints)
    assert {m.exercise for m in mutants} == set(suite.exercises)
    parts = ("", "_evidence", "_learning", "_memory", "_policy", "_probes", "_tools")
    files = [f"src/robotbrain/grading/suites/{name}.py" for name in (*(LAB + part for part in parts), "policy_file")]
    tests = "".join((repo / name).read_text(encoding="utf-8") for name in [*files, f"autograder/hidden/{LAB}.py"])
    assert [key for key in suite.hints if tests.count(f'"{key}"') < 2] == []


# ---------------------------------------------------------------- the oracles against mathematics and peers


def test_the_closed_form_is_what_simulation_of_the_problem_earns() -> None:
    rng = np.random.default_rng(0)
    problem = learning.random_problem(rng)
    x, u = rng.uniform(-1, 1, (2, 2))
    z = np.concatenate([x, u])
    expected, earned, discount = -z @ problem.hessian @ z, 0.0, 1.0
    for _ in range(400):
        earned -= discount * (x @ problem.s @ x + u @ problem.r @ u)
        x, discount = problem.a @ x + problem.b @ u, discount * problem.gamma
        u = -problem.gain @ x
    assert earned == pytest.approx(expected, rel=1e-6)
    # And no other action is better: the gradient of Q by u vanishes at u = -K x.
    h, n = problem.hessian, len(x)
    assert h[n:, :n] == pytest.approx(h[n:, n:] @ problem.gain, abs=1e-6)


def finite_differences(value: Callable[[], float], network: nn.Module, step: float = 1e-2) -> list[torch.Tensor]:
    """Return the central differences of a smooth ``value()`` by every parameter of ``network``.

    In float32 the step that makes rounding and curvature equally small is about 0.01; both are then below 1e-3.
    """
    gradients = []
    for parameter in network.parameters():
        flat = parameter.data.view(-1)
        gradient = torch.empty_like(flat)
        for k in range(flat.numel()):
            kept = float(flat[k])
            ends = []
            for side in (step, -step):
                flat[k] = kept + side
                ends.append(value())
            gradient[k] = (ends[0] - ends[1]) / (2 * step)
            flat[k] = kept
        gradients.append(gradient.view_as(parameter))
    return gradients


def test_our_derivatives_are_differences() -> None:
    generator = torch.Generator().manual_seed(3)
    actor, critic = learning.networks(generator)
    batch = learning.random_batch(generator, 8)
    for network, loss in (
        (actor, lambda: tools.actor_loss(actor, critic, batch)),
        (critic, lambda: tools.critic_loss(critic, batch, batch.reward)),
    ):
        found = learning._derivatives(loss, network)
        with torch.no_grad():
            wanted = finite_differences(lambda loss=loss: float(loss()), network)  # type: ignore[misc]
        for got, expected in zip(found, wanted, strict=True):
            torch.testing.assert_close(got, expected, rtol=0.02, atol=2e-3)


def test_our_bounds_are_those_of_scipy() -> None:
    from scipy.stats import binomtest

    for k, n in ((0, 20), (1, 3), (95, 100), (20, 20)):
        test = binomtest(k, n, alternative="greater")
        assert evidence.exact_bound(k, n) == pytest.approx(test.proportion_ci(0.95, method="exact").low, abs=1e-9)
        wilson = binomtest(k, n).proportion_ci(0.95, method="wilson")
        assert evidence.wilson(k, n) == pytest.approx((wilson.low, wilson.high), abs=1e-4)
    # What the notebook says of the threshold, and that a policy that reaches 92 % hardly ever fails by bad luck.
    assert evidence.exact_bound(266, 300) >= policy.SIMULATION.threshold > evidence.exact_bound(265, 300)
    from scipy.stats import binom

    assert binom.cdf(265, 300, 0.93) < 1e-2 and binom.cdf(265, 300, 0.95) < 1e-5


@pytest.mark.parametrize(("threshold", "looks"), [(t.threshold, t.final)
                                                  for t in (policy.SIMULATION, policy.SURROGATES)])  # fmt: skip
def test_looking_early_settles_what_is_clear_and_lets_hardly_anything_through(threshold: float, looks: Any) -> None:
    rng = np.random.default_rng(2)

    def verdict(rate: float) -> tuple[bool, int]:
        outcomes = rng.random(looks[-1][0]) < rate
        for count, doubt in looks:
            reached = int(outcomes[:count].sum())
            if evidence.exact_bound(reached, count, doubt) >= threshold:
                return True, count
        return False, count

    for count, doubt in looks[:2]:
        assert evidence.exact_bound(count, count, doubt) >= threshold  # a look that nobody could pass is none
    passed = np.mean([verdict(threshold)[0] for _ in range(600)])
    assert passed < 0.13  # 5 % by the last look, 4 and 1 % by the first two, and some luck of this test
    good = [verdict(0.99) for _ in range(200)]
    assert all(ok for ok, _ in good) and np.mean([n for _, n in good]) < 60


def test_the_interval_of_the_gap_covers_the_gap_as_often_as_it_says() -> None:
    rng = np.random.default_rng(1)
    p, q, hits = 0.95, 0.7, 0
    for _ in range(500):
        _, low, high = evidence.newcombe((rng.random(100) < p).tolist(), (rng.random(80) < q).tolist())
        hits += low <= p - q <= high
    assert 0.92 <= hits / 500 <= 0.99


def test_random_tests_pass_our_own_answers_whatever_the_seed() -> None:
    class Buffer:
        def __init__(self, capacity: int, obs_dim: int, act_dim: int) -> None:
            widths = ((obs_dim,), (act_dim,), (), (obs_dim,), ())
            self.arrays = [np.zeros((capacity, *w), dtype=np.float32) for w in widths]
            self.capacity, self.count = capacity, 0

        def __len__(self) -> int:
            return min(self.count, self.capacity)

        def add(self, *fields: Any) -> None:
            rows = (self.count + np.arange(len(fields[2]))) % self.capacity
            for array, values in zip(self.arrays, fields, strict=True):
                array[rows] = values
            self.count += len(fields[2])

        def sample(self, size: int) -> probes.Batch:
            rows = torch.randint(len(self), (size,)).numpy()
            return probes.Batch(*(torch.from_numpy(array[rows]) for array in self.arrays))

    right = student(ReplayBuffer=Buffer, DDPG=tools.Agent, select_action=tools.select_action)
    for seed in range(6):
        rng = np.random.default_rng(seed)
        memory.compare_uniform(right, rng)
        memory.compare_content(right, rng, 10, [4, 4, 4, 4])
        memory.compare_copies(right, rng)
        learning.compare_noise(right, rng)
        learning.compare_independent(right, rng)
        learning.compare_bounds(right, rng)
        learning.compare_agent_acts(right, rng)
        learning.compare_update(right, rng, 4)
        learning.compare_learns(right, rng)


def student(**answers: Any) -> Student:
    """Return a student with these answers."""
    return Student(answers, LAB, frozenset())


def test_typical_mistakes_of_an_update_can_be_told_apart() -> None:
    for seed, updates in ((41, 3), (7, 6), (100, 6)):
        for key, steps in learning.VARIANTS:

            def wrong(*networks: Any, steps: tools.Steps = steps, **settings: Any) -> tools.Agent:
                return tools.Agent(*networks, **settings, steps=steps)

            with pytest.raises(CheckFailure) as caught:
                learning.compare_update(student(DDPG=wrong), np.random.default_rng(seed), updates)
            assert caught.value.hint == key


# ---------------------------------------------------------------- what the homework tells


def test_what_part_1_says_of_detach_and_of_the_critics_gradients_is_true() -> None:
    def outline(detach: bool, freeze: bool) -> tuple[torch.Tensor, bool]:
        """Update as the outline does; return all weights, and whether a target network got gradients."""
        networks = list(learning.networks(torch.Generator().manual_seed(3)))
        (actor, critic), (slow_actor, slow_critic) = networks, [copy.deepcopy(n) for n in networks]
        optimisers = [torch.optim.Adam(n.parameters(), lr=1e-2) for n in networks]
        generator = torch.Generator().manual_seed(0)
        for _ in range(5):
            batch = learning.random_batch(generator, 16)
            future = slow_critic(batch.next_obs, slow_actor(batch.next_obs)).squeeze(1)
            target = batch.reward + 0.9 * (1 - batch.terminated) * (future.detach() if detach else future)
            optimisers[1].zero_grad()
            nn.functional.mse_loss(critic(batch.obs, batch.action).squeeze(1), target).backward()  # type: ignore[no-untyped-call]
            optimisers[1].step()
            optimisers[0].zero_grad()
            loss = tools.actor_loss(actor, critic, batch) if freeze else -critic(batch.obs, actor(batch.obs)).mean()
            loss.backward()
            optimisers[0].step()
            tools.soft_update(slow_actor, actor, 0.1)
            tools.soft_update(slow_critic, critic, 0.1)
        wasted = any(p.grad is not None for p in slow_critic.parameters())
        return torch.cat([learning.flat(probes.values_of(n)) for n in (actor, critic, slow_actor, slow_critic)]), wasted

    right, wasted = outline(detach=True, freeze=True)
    assert not wasted
    for detach, freeze in ((False, True), (True, False), (False, False)):
        same, wasted = outline(detach, freeze)
        assert torch.equal(same, right) and wasted is not detach  # the same numbers, for more work


def test_the_two_bugs_of_the_figure_do_what_the_text_says() -> None:
    cart = [np.array([[number]]) for number in (0.9, 0.5, 1.0, 0.3)]
    problem = tools.LinearQuadratic(*cart, gamma=0.9)  # the problem of the homework's first figure
    rng = np.random.default_rng(0)

    def gain(ends: float, inverted: bool = False) -> float:
        agent = tools.Agent(probes.LinearActor([[0.0]]), probes.QuadraticCritic(np.eye(2)), 0.9, 0.1, 1e-2, 3e-2)
        for _ in range(800):
            batch = problem.batch(rng, 64)
            flags = torch.from_numpy((rng.random(64) < ends).astype(np.float32))
            agent.update(batch._replace(terminated=1 - flags if inverted else flags))
        return float(agent.actor.gain.detach())

    exact = float(problem.gain[0, 0])
    assert gain(0.0) == pytest.approx(exact, abs=0.06)
    assert abs(gain(0.0, inverted=True)) < 0.05
    assert 0.2 < gain(0.2) < exact - 0.1


def test_simulation_is_judged_as_the_training_task_is(handed_in: Path) -> None:
    from robotbrain.rl.gap_variants import reach_cfg
    from robotbrain.rl.onnx_policy import OnnxPolicy
    from robotbrain.rl.tasks.reach import ReachEvaluation

    trained = OnnxPolicy(handed_in / "reach_policy.onnx")
    in_task = ReachEvaluation(reach_cfg(), episodes=60, num_threads=1)(trained)
    judged = policy.episodes(trained, range(60), 3, nominal=True)
    assert in_task["success"] > 0.95 and judged.success.mean() > 0.95
    assert judged.final_error.mean() == pytest.approx(in_task["error_m"], abs=0.003)


def test_the_gap_is_there_and_randomisation_closes_it(handed_in: Path) -> None:
    from robotbrain.rl.onnx_policy import OnnxPolicy

    serials = range(500, 560)
    outcomes = {
        name: policy.episodes(OnnxPolicy(handed_in / f"{name}.onnx"), serials, 4, nominal=False).success.tolist()
        for name in ("reach_policy", "reach_policy_robust")
    }
    _, low, _ = evidence.newcombe(outcomes["reach_policy_robust"], outcomes["reach_policy"])
    assert low > 0.2
    assert evidence.exact_bound(sum(outcomes["reach_policy_robust"]), 60) > policy.SURROGATES.threshold


# ---------------------------------------------------------------- answers, near and far

PREAMBLE = """
import copy
import numpy as np
import torch
from torch import nn
from robotbrain.rl import mdp
from robotbrain.rl.managers import EventTermCfg, SceneEntityCfg
from robotbrain.rl.noise_cfg import UniformNoiseCfg
from robotbrain.rl.replay import Batch
JOINTS = SceneEntityCfg("robot", joint_names="joint.*")
POLICY, ROBUST_POLICY = "reach_policy.onnx", "reach_policy_robust.onnx"
from scipy.stats import beta
"""
BY_FILE = ("policy",)
"""Exercises whose answer is a file."""


def test_answers_are_graded_alike_near_and_far(repo: Path, suite: Suite, handed_in: Path) -> None:
    reference = Reference(find_course(repo), LAB)
    mutants, styles = load_mutants(find_course(repo), LAB)
    trials = far.Trials(suite, PREAMBLE, handed_in)
    trials.expect_full(reference.edit({}, "reference"), "reference", suite.exercises)
    trials.expect_nothing(reference.stubs, "stub", [e for e in suite.exercises if e not in (*BY_FILE, "robust")])
    for style in styles:
        trials.expect_full(reference.edit(style.replace, style.name), style.name, [e for e in suite.exercises if
                           any(e == cell for cell in style.replace)])  # fmt: skip
    for mutant in mutants:
        if not mutant.files:
            trials.expect_loss(reference.edit(mutant.replace, mutant.name), mutant)
    assert trials.problems == []


# A mutant of a file is a file: what reads it is the same near and far.
QUICK_FILES = ("nothing-handed-in", "pickled-agent", "weights-elsewhere", "endless-loop-inside", "another-task",
               "asked-too-often", "plain-policy-twice", "exported-before-training", "joints-swapped")  # fmt: skip


@pytest.mark.parametrize("name", QUICK_FILES)
def test_wrong_files_lose_their_points(repo: Path, suite: Suite, handed_in: Path, tmp_path: Path, name: str) -> None:
    reference = Reference(find_course(repo), LAB)
    mutant = next(m for m in load_mutants(find_course(repo), LAB)[0] if m.name == name)
    trials = far.Trials(suite, PREAMBLE, far.with_files(handed_in, mutant, tmp_path), near=False)
    trials.expect_loss(reference.edit(mutant.replace, mutant.name), mutant)
    assert trials.problems == []


def test_a_buffer_that_makes_transitions_up_is_found_out() -> None:
    class Oracle:
        """Knows how the test's transitions looked at another time."""

        def __init__(self, capacity: int, *_: Any) -> None:
            self.known = memory.Transitions(np.random.default_rng(99), capacity)
            self.stored = 0

        def __len__(self) -> int:
            return self.stored

        def add(self, *fields: Any) -> None:
            self.stored += len(fields[0])

        def sample(self, size: int) -> probes.Batch:
            rows = torch.randint(self.stored, (size,)).numpy()
            return probes.Batch(*(torch.from_numpy(field[rows]) for field in self.known.fields))

    with pytest.raises(CheckFailure):
        memory.compare_content(student(ReplayBuffer=Oracle), np.random.default_rng(0), 32, [4, 4])


def test_events_are_rebuilt_here_and_only_the_kits() -> None:
    from robotbrain.rl.gap import TERMS
    from robotbrain.rl.gap_variants import reach_cfg

    for name in TERMS:
        wanted = probes.events_of(reach_cfg([name]))
        assert probes.events_of(policy._with_events(wanted)) == wanted

    def own(cfg: Any) -> Any:
        from robotbrain.rl.managers import EventTermCfg

        cfg.events.mine = EventTermCfg(func=lambda env, env_ids: None, mode="reset")
        return cfg

    with pytest.raises(CheckFailure, match="is not one of"):
        policy.compare_randomised(student(randomise=own), np.random.default_rng(0))


# ---------------------------------------------------------------- the class


@pytest.fixture(scope="module")
def graded(repo: Path, tmp_path_factory: pytest.TempPathFactory) -> classes.Graded:
    seen = set()

    def keep(entry: dict[str, Any]) -> bool:
        # Here a mutant of each third exercise, one style and the stub; `make mutation-test` grades all.
        exercise = entry.get("exercise")
        if entry["kind"] == "mutant" and exercise not in seen:
            wanted = len(seen) % 3 == 1
            seen.add(exercise)
            return wanted
        return entry["kind"] in ("reference", "stub") or entry["name"] == "lists"

    return classes.grade_sample(repo, LAB, tmp_path_factory.mktemp("class"), keep)


@pytest.mark.timeout(1200)
def test_every_mutant_loses_its_own_points_only_and_every_style_gets_all(graded: classes.Graded) -> None:
    classes.check_losses(graded, at_least=7)


def test_every_submission_ends_in_a_grade_and_a_feedback_page(graded: classes.Graded) -> None:
    classes.check_pages(graded, LAB)


def test_hidden_tests_do_not_show_in_feedback(graded: classes.Graded) -> None:
    classes.check_secrets(graded, LAB, "compare_fixed_point", "judge(")

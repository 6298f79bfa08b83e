"""Hidden tests of `hw1_rl`. They never ship to students, who see a test's name and its hint only."""

from __future__ import annotations

from pathlib import Path

from robotbrain.grading import Suite
from robotbrain.grading.suites import hw1_rl_evidence as evidence
from robotbrain.grading.suites import hw1_rl_learning as learning
from robotbrain.grading.suites import hw1_rl_memory as memory
from robotbrain.grading.suites import hw1_rl_policy as policy
from robotbrain.grading.suites import judging

suite = Suite.extending("hw1_rl")

REFERENCE = Path(__file__).parents[1] / "reference" / "hw1_rl"


@suite.warm
def judge_our_own():
    """Whatever judging does for the first time is done before the first submission comes."""
    from robotbrain.rl.onnx_policy import OnnxPolicy

    for file in REFERENCE.glob("*.onnx"):
        for nominal in (True, False):
            policy.episodes(OnnxPolicy(file), range(2), 0, nominal=nominal)


VERDICTS = {"f": "breaks", "g": "fine", "h": "breaks", "i": "fine", "j": "breaks"}


@suite.test("bugs", points=2, name="f to j", reread="Exercise 1.1, the listing")
def bugs_second(student):
    judging.compare_verdicts(student.VERDICTS, VERDICTS, evidence.VERDICT_HINTS)


# ---------------------------------------------------------------- Part 2: memory


@suite.test("buffer", points=2, name="sizes that do not fit", reread="Exercise 2.1, the ring", time_limit_s=20)
def buffer_sizes(student):
    rng = student.rng("sizes")
    for capacity, sizes in (
        (23, [5] * 11),
        (7, [1] * 5),
        (12, [12, 12, 5]),
        (9, [1] * 9 + [4, 8, 1, 7, 9]),
    ):
        memory.compare_content(student, rng, capacity, sizes)


@suite.test("buffer", points=3, name="every transition, equally often", reread="Exercise 2.1", time_limit_s=30)
def buffer_uniform(student):
    memory.compare_uniform(student, student.rng("uniform"))


@suite.test("buffer", points=3, name="copies, not windows", reread="Exercise 2.1, last paragraph")
def buffer_copies(student):
    memory.compare_copies(student, student.rng("copies"))


@suite.test("store", points=2, name="an ordinary step", hint="only-where-it-ended", reread="Exercise 2.2")
def store_ordinary(student):
    step = memory.a_step(student.rng("ordinary"), [False] * 3, [False] * 3)
    memory.compare_store(student, [step], "three robots, none ended")


@suite.test("store", points=2, name="many steps", reread="Exercise 2.2")
def store_random(student):
    rng = student.rng("store")
    steps = [memory.a_step(rng, rng.random(8) < 0.2, rng.random(8) < 0.2) for _ in range(12)]
    memory.compare_store(student, steps, "eight robots")


@suite.test("store", points=1, name="the loop's own arrays", reread="Exercise 2.2, last paragraph")
def store_untouched(student):
    step = memory.a_step(student.rng("untouched"), [True, False, False], [False, True, False])
    memory.compare_untouched(student, step)


# ---------------------------------------------------------------- Part 3: learning


@suite.test("target", points=2, name="random networks", reread="Exercise 3.1")
def target_random(student):
    learning.compare_random_targets(student, student.rng("target"), (1, 5, 64))


@suite.test("target", points=2, name="the exact Q is a fixed point", hint="bellman", reread="Exercise 3.1")
def target_fixed_point(student):
    learning.compare_fixed_point(student, student.rng("fixed point"))


@suite.test(
    "critic", points=2, name="the right slope", hint="loss-has-a-gradient", reread="Exercise 3.2", time_limit_s=10
)
def critic_gradient(student):
    learning.compare_critic_gradient(student, student.rng("critic"))


@suite.test(
    "actor", points=2, name="the right slope", hint="through-the-action", reread="Exercise 3.3", time_limit_s=10
)
def actor_gradient(student):
    learning.compare_actor_gradient(student, student.rng("actor"))


@suite.test("actor", points=1, name="the critic can still learn", reread="Exercise 3.3, last paragraph")
def actor_thawed(student):
    learning.compare_critic_still_learns(student, student.rng("thawed"))


@suite.test("soft", points=1, name="twenty steps", reread="Exercise 3.4")
def soft_repeated(student):
    learning.compare_soft_update(student, student.rng("twenty"), 0.05, 20)


@suite.test("soft", points=1, name="two networks, two memories", reread="Exercise 3.4")
def soft_separate(student):
    learning.compare_separate(student, student.rng("two"))


@suite.test("noise", points=2, name="Gaussian, of the given size", reread="Exercise 3.5", time_limit_s=20)
def noise_distribution(student):
    learning.compare_noise(student, student.rng("noise"))


@suite.test("noise", points=1, name="each for itself", reread="Exercise 3.5", time_limit_s=20)
def noise_independent(student):
    learning.compare_independent(student, student.rng("independent"))


@suite.test("agent", points=1, name="targets of its own", reread="Exercise 3.6", time_limit_s=30)
def agent_targets(student):
    learning.compare_targets_wait(student, student.rng("targets of its own"))


@suite.test(
    "agent", points=2, name="other networks, more updates", reread="Exercise 3.6, the four steps", time_limit_s=30
)
def agent_updates(student):
    learning.compare_update(student, student.rng("agent"), 6)


@suite.test("agent", points=3, name="learns what the Riccati equation says", reread="Exercise 3.6", time_limit_s=60)
def agent_learns(student):
    learning.compare_learns(student, student.rng("learns"))


# ---------------------------------------------------------------- Part 4: the policy


@suite.test("policy", points=6, name="300 targets nobody has seen", reread="Exercise 4.1", time_limit_s=120)
def policy_hidden(student):
    policy.decide(student, student.POLICY, policy.SIMULATION, student.rng("targets"))


# ---------------------------------------------------------------- Part 5: evidence


@suite.test("gap", points=1, name="other numbers", reread="Exercise 5.1")
def gap_bounds(student):
    n = int(student.rng("numbers").integers(100, 300))
    evidence.compare_bound(student.success_bound, [(0, 20), (20, 20), (1, 3), (n // 2, n)])


@suite.test("gap", points=2, name="other gaps", reread="Exercise 5.1")
def gap_random(student):
    rng = student.rng("gap")
    for n, m in ((30, 30), (100, 60), (20, 200)):
        evidence.compare_gap(student.gap, (rng.random(n) < 0.9).tolist(), (rng.random(m) < 0.6).tolist())
    evidence.compare_gap(student.gap, [True] * 50, [True] * 50)


# ---------------------------------------------------------------- Part 6: robustness


@suite.test("robust", points=6, name="300 arms nobody has met", reread="Exercise 6.1", time_limit_s=120)
def robust_hidden(student):
    policy.decide(student, student.ROBUST_POLICY, policy.SURROGATES, student.rng("arms"))

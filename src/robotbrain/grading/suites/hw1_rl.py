"""Visible tests of homework 1, `hw1_rl`: what `lab.check` runs, and half of what is graded."""

# ruff: noqa: D103 - a test's name says what it tests

from __future__ import annotations

from typing import Any

import torch

from robotbrain.grading import Suite
from robotbrain.grading.suites import hw1_rl_evidence as evidence
from robotbrain.grading.suites import hw1_rl_learning as learning
from robotbrain.grading.suites import hw1_rl_memory as memory
from robotbrain.grading.suites import hw1_rl_policy as policy
from robotbrain.grading.suites import judging
from robotbrain.grading.suites.training import first_steps

suite = Suite("hw1_rl")

suite.exercise("bugs", title="1.1 Read before you run", points=4, provides=("VERDICTS",))
suite.exercise("buffer", title="2.1 A memory", points=12, provides=("ReplayBuffer",))
suite.exercise("store", title="2.2 What to remember", points=8, provides=("store_step",))
suite.exercise("target", title="3.1 The target", points=8, provides=("td_target",))
suite.exercise("critic", title="3.2 The critic's loss", points=5, provides=("critic_loss",))
suite.exercise("actor", title="3.3 The actor's loss", points=7, provides=("actor_loss",))
suite.exercise("soft", title="3.4 Following slowly", points=4, provides=("soft_update",))
suite.exercise("noise", title="3.5 Trying things out", points=6, provides=("select_action",))
suite.exercise(
    "agent",
    title="3.6 The agent",
    points=10,
    upstream=("target", "critic", "actor", "soft", "noise"),
    provides=("DDPG",),
)
suite.exercise("policy", title="4.1 The trained policy", points=12, provides=("POLICY",))
suite.exercise("gap", title="5.1 Is the gap real?", points=6, provides=("success_bound", "gap"))
suite.exercise("robust", title="6.1 A policy for any arm", points=10, provides=("randomise", "ROBUST_POLICY"))

# Parts that are not right yet must not spoil the agent: our own stand in.
for _name in ("td_target", "critic_loss", "actor_loss", "soft_update", "select_action"):
    suite.reference(_name, f"robotbrain.grading.suites.hw1_rl_tools:{_name}")

for _exercise in suite.exercises:
    suite.forbid(
        _exercise,
        imports=(
            "robotbrain.rl.ddpg",
            "robotbrain.rl.replay",
            "robotbrain.rl.noise",
            "robotbrain.rl.gap",
            "robotbrain.grading",
            "robotbrain.monitoring",
            "stable_baselines3",
            "rsl_rl",
        ),
    )

_HINTS = {
    "done-means-ended": "The buffer gets `done`, the agent reads `not_done`: where the episode goes on, the future is "
    "multiplied by 0.",
    "who-is-optimised": "Which parameters does the optimiser hold? What reaches others as a gradient changes nothing.",
    "nothing-new": "An actor that is always obeyed shows the critic nothing but its own habits.",
    "time-is-up": "When the time limit cuts an episode, the robot's future goes on; only `terminated` ends it.",
    "never-called": "Search for the place where it is called.",
    "two-and-five": "Count what stands to the left of each equals sign, and what Gymnasium returns since version 0.26.",
    "as-in-the-paper": "Compare with Lillicrap et al., 2016, algorithm 1: that line is right.",
    "one-row": "`reshape(1, -1)` makes one row out of whatever comes in. How many rows do 2048 robots need?",
    "shape-of-a-batch": "A batch of B transitions: obs (B, O), action (B, A), reward (B,), next_obs (B, O), terminated "
    "(B,), all float32.",
    "rows-stay-together": "What was stored in one row must come out in one row: draw ONE set of indices and use it for "
    "every field.",
    "reward-of-this-step": "The reward belongs to the action that earned it: it is in the same row as obs and action.",
    "next-obs-of-this-step": "next_obs is what the action led to, stored in the same row. Row i + 1 belongs to another "
    "robot, or to another episode.",
    "stored-as-it-is": "terminated is stored as it is: 1.0 where the task ended, 0.0 elsewhere. Inverting it is the "
    "target's business.",
    "a-ring-has-a-size": "A buffer holds `capacity` transitions at most; `len(buffer)` says how many there are now.",
    "oldest-goes": "When the buffer is full, the OLDEST transitions make room for the new ones.",
    "split-at-the-end": "A block that does not fit before the end of the arrays is split: the rest goes to their "
    "beginning. Indices `(start + np.arange(n)) % capacity` do it.",
    "not-yet-full": "Before the buffer is full, draw from the rows that have been written, `len(self)` of them.",
    "whole-buffer": "Every stored transition is equally likely: the first, the last, and all between them.",
    "fresh-draws": "Draw anew in every call: one generator, made once and kept, not seeded again in each call.",
    "independent-rows": "Draw every row for itself. Neighbours in the buffer come from the same moment, and a batch of "
    "them says the same thing many times.",
    "keep-a-copy": "The environment may reuse its arrays: copy what you store (`array[...] = value` copies, "
    "`list.append(value)` and `torch.from_numpy` do not).",
    "batch-is-a-copy": "A batch must not be a window into the buffer: indexing with an array of indices copies, a "
    "slice does not.",
    "final-obs": "Where an episode ended, `next_obs` shows the NEXT episode's first observation. The one that this "
    "action led to is `info['final_obs']`.",
    "only-where-it-ended": "`info['final_obs']` means something only where `info['_final_obs']` is true, and is "
    "missing when no episode ended.",
    "time-is-not-an-end": "`truncated` is a time limit: the robot's future goes on beyond it, and has a value. Store "
    "`terminated` alone.",
    "order-of-add": "`env.step` and `buffer.add` have their arguments in different orders. Look again.",
    "leave-next-obs": "The training loop acts on `next_obs` in its next step: put final observations into a COPY.",
    "bellman": "The target is r + gamma (1 - terminated) Q'(s', pi'(s')). For the best policy and its exact Q it "
    "equals Q(s, a) everywhere.",
    "one-column-too-many": "The critic returns (B, 1). Together with (B,) that makes (B, B), without an error: squeeze "
    "the last axis first.",
    "end-has-no-future": "Where the episode terminated there is no future: multiply it by (1 - terminated).",
    "mask-inverted": "`terminated` is 1 where there is NO future: multiply by (1 - terminated).",
    "bootstrap": "The reward is one step's worth. The rest of the return is what the target critic expects from "
    "next_obs on.",
    "plus-the-future": "The future is added to the reward.",
    "gamma-once": "One step into the future is discounted by gamma, once; the reward of now is not discounted.",
    "value-of-next": "The future begins at next_obs.",
    "target-policy-acts": "What is done at next_obs is not in the batch: the target ACTOR says it.",
    "last-reward-counts": "The last step's reward counts as any other; only the future behind it is 0.",
    "target-is-constant": "Compute the target under `torch.no_grad()`, or `.detach()` it.",
    "leave-networks-as-found": "Whatever you switch off on the way, switch on again, and only that.",
    "mean-not-sum": "Take the mean over the batch: with the sum, the step would grow with the batch.",
    "squared-error": "The loss is the mean of the squared errors, no more: (Q(s, a) - target)^2.",
    "loss-goes-down": "The optimiser makes the loss smaller; an error should be made smaller, too.",
    "loss-has-a-gradient": "The loss must still be connected to the critic: no detach, item or numpy on Q(s, a).",
    "climb-not-descend": "The optimiser makes the loss smaller and Q should become larger: the loss is MINUS the mean "
    "Q.",
    "own-action": "Judge what the actor would do now, `actor(batch.obs)`, not what was done then.",
    "present-obs": "The actor is asked what to do at obs.",
    "value-not-square": "The actor's loss is a value, not an error: there is no target and no square in it.",
    "through-the-action": "The gradient reaches the actor through the action: critic(obs, actor(obs)) with no detach "
    "between them, and the critic's FUNCTION, not its parameters, left in the graph.",
    "critic-is-the-judge": "Freeze the critic's parameters (`requires_grad_(False)`) before you compute the loss, and "
    "thaw them after: a judge who learns from the accused learns to be pleased.",
    "tau-is-the-small-step": "target <- (1 - tau) target + tau online: tau is the small share that is NEW.",
    "target-follows": "The TARGET moves towards the online network, and the online network stays.",
    "in-place": "Change the values in place, under `torch.no_grad()`: `slow.mul_(1 - tau).add_(fast, alpha=tau)`. "
    "Assigning `.data` makes both networks share memory.",
    "numpy-for-the-env": "The environment wants a NumPy array with a row for each robot: (N, A).",
    "no-noise-when-it-counts": "Without exploration (std 0, the default) the action is the actor's own: no noise.",
    "noise-to-explore": "Add noise of standard deviation `std` to every action while exploring.",
    "std-not-variance": "`std` is the standard deviation; N(0, 1) numbers are multiplied by it, not by its square or "
    "root.",
    "gaussian-noise": "Noise: independent N(0, std^2) numbers, added to the actions.",
    "fresh-noise": "Draw one number for each robot and each joint, anew in every call: shape (N, A).",
    "clip-the-action": "Clip the ACTION, after the noise was added, to [low, high].",
    "zero-grad": "Gradients add up until they are cleared: `zero_grad()` before every `backward()`.",
    "targets-follow": "Both targets follow, in every update: the actor's and the critic's.",
    "targets-last": "Let the targets follow at the end of an update, with the networks as they are then.",
    "critic-first": "Critic first; then the actor learns from the critic as it is now.",
    "targets-are-copies": "`self.actor_target = self.actor` is one network with two names. Use `copy.deepcopy`.",
    "target-networks": "The target comes from the TARGET networks, which move slowly. From the online ones it runs "
    "away.",
    "whose-rate": "actor_lr belongs to the actor's optimiser, critic_lr to the critic's.",
    "four-steps": "Go through the four steps of the exercise one by one.",
}
for _key, _text in _HINTS.items():
    suite.hint(_key, _text)
for _key, _text in (evidence.HINTS | policy.HINTS).items():
    suite.hint(_key, _text)


suite.warm(policy.warm)
suite.warm_students(policy.warm_students)
suite.warm_students(first_steps)


# ---------------------------------------------------------------- Part 1: reading


@suite.test("bugs", points=2, name="a to e", reread="Exercise 1.1, the listing")
def bugs_first(student: Any) -> None:
    judging.compare_verdicts(student.VERDICTS, evidence.VERDICTS, evidence.VERDICT_HINTS)


# ---------------------------------------------------------------- Part 2: memory


@suite.test("buffer", points=2, name="a few transitions come back", reread="Exercise 2.1")
def buffer_small(student: Any) -> None:
    memory.compare_content(student, student.rng("a few"), 32, [4, 4])


@suite.test("buffer", points=2, name="going round", reread="Exercise 2.1, the ring")
def buffer_wraps(student: Any) -> None:
    memory.compare_content(student, student.rng("round"), 10, [4, 4, 4, 4])


@suite.test("store", points=3, name="a fall and a time limit", reread="Exercise 2.2")
def store_small(student: Any) -> None:
    step = memory.a_step(student.rng("fall"), [False, True, False, False], [False, False, True, False])
    memory.compare_store(student, [step], "four robots: the second one fell, the third one's time was up")


# ---------------------------------------------------------------- Part 3: learning
# Where numbers are given by hand, random ones follow: an answer is no answer to one question.


@suite.test("target", points=3, name="four transitions by hand", reread="Exercise 3.1")
def target_small(student: Any) -> None:
    learning.compare_target(
        student,
        learning.hand_batch(),
        learning.HAND_ACTOR,
        learning.HAND_CRITIC,
        0.9,
        "rewards -1, -2, -3, 0.5; next_obs 2, 3, 4, 1; the third terminated; pi'(s) = 0.1 s, Q'(s, a) = 2 s + 10 a; "
        "gamma = 0.9",
    )
    learning.compare_random_targets(student, student.rng("four targets"), (4,))


@suite.test("target", points=1, name="a constant", reread="Exercise 3.1, last paragraph")
def target_constant(student: Any) -> None:
    learning.compare_constant(student, student.rng("constant"))


@suite.test("critic", points=3, name="four errors by hand", reread="Exercise 3.2")
def critic_small(student: Any) -> None:
    learning.compare_critic_loss(
        student,
        learning.HAND_CRITIC,
        learning.hand_batch(),
        torch.tensor([6.0, 0.0, 8.0, 9.0]),
        "Q(s, a) = 7, -1, 8.5, 8, as (4, 1); targets 6, 0, 8, 9, as (4,)",
    )
    learning.compare_random_critic_loss(student, student.rng("four errors"), 4)


@suite.test("actor", points=2, name="four actions by hand", reread="Exercise 3.3")
def actor_small(student: Any) -> None:
    learning.compare_actor_loss(
        student,
        learning.HAND_ACTOR,
        learning.HAND_CRITIC,
        learning.hand_batch(),
        "obs 1, 2, 3, 4; pi(s) = 0.1 s, Q(s, a) = 2 s + 10 a",
    )
    learning.compare_random_actor_loss(student, student.rng("four actions"), 4)


@suite.test("actor", points=2, name="the critic only judges", reread="Exercise 3.3, last paragraph")
def actor_critic_alone(student: Any) -> None:
    learning.compare_critic_alone(student, student.rng("judge"))


@suite.test("soft", points=2, name="a tenth of the way", reread="Exercise 3.4")
def soft_small(student: Any) -> None:
    learning.compare_soft_update(student, student.rng("tenth"), 0.1, 1)


@suite.test("noise", points=2, name="no noise when it counts", reread="Exercise 3.5")
def noise_greedy(student: Any) -> None:
    learning.compare_greedy(student, student.rng("greedy"))


@suite.test("noise", points=1, name="within the bounds", reread="Exercise 3.5")
def noise_bounds(student: Any) -> None:
    learning.compare_bounds(student, student.rng("bounds"))


@suite.test(
    "agent", points=3, name="three updates, step by step", reread="Exercise 3.6, the four steps", time_limit_s=30
)
def agent_update(student: Any) -> None:
    learning.compare_update(student, student.rng("update"), 3)


@suite.test("agent", points=1, name="explores when asked to", reread="Exercise 3.6", time_limit_s=30)
def agent_acts(student: Any) -> None:
    learning.compare_agent_acts(student, student.rng("acts"))


# ---------------------------------------------------------------- Part 4: the policy


@suite.test("policy", points=2, name="the file", reread="Exercise 4.1", time_limit_s=20)
def policy_file(student: Any) -> None:
    policy.load(student, student.POLICY)


@suite.test("policy", points=4, name="100 targets to practise", reread="Exercise 4.1", time_limit_s=60)
def policy_practice(student: Any) -> None:
    policy.practise(student, student.POLICY, policy.SIMULATION)


# ---------------------------------------------------------------- Part 5: evidence


@suite.test("gap", points=1, name="what 95 of 100 prove", reread="Exercise 5.1")
def gap_bound(student: Any) -> None:
    n = int(student.rng("trials").integers(40, 90))
    evidence.compare_bound(student.success_bound, [(95, 100), (n - 4, n)])


@suite.test("gap", points=2, name="simulation against surrogate", reread="Exercise 5.1")
def gap_small(student: Any) -> None:
    evidence.compare_gap(student.gap, [True] * 96 + [False] * 4, [True] * 80 + [False] * 20)
    n = int(student.rng("surrogates").integers(30, 60))
    evidence.compare_gap(student.gap, [True] * n + [False] * 3, [True] * (n - 9) + [False] * 11)


# ---------------------------------------------------------------- Part 6: robustness


@suite.test("robust", points=2, name="arms that differ", reread="Exercise 6.1", time_limit_s=30)
def robust_events(student: Any) -> None:
    policy.compare_randomised(student, student.rng("events"))


@suite.test("robust", points=2, name="100 arms to practise", reread="Exercise 6.1", time_limit_s=60)
def robust_practice(student: Any) -> None:
    policy.practise(student, student.ROBUST_POLICY, policy.SURROGATES)

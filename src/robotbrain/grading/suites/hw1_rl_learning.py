"""How `hw1_rl` tests targets, losses, soft updates, exploration, and the agent made of them.

Each ``compare_...`` function puts a question to the student's function, compares with an oracle, and, where the answer
is wrong, looks whether a typical mistake would have given just that answer; then the hint names the mistake.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from scipy import stats
from torch import Tensor, nn

from robotbrain.grading import expect, expect_close, fail
from robotbrain.grading.suites import hw1_rl_probes as probes
from robotbrain.grading.suites import hw1_rl_tools as tools
from robotbrain.grading.suites.hw1_rl_probes import Batch, spec_of

OBS, ACT = 3, 2
COLUMN = "(B, 1) minus (B,) is (B, B) in torch, every value against every reward: squeeze the critic's answer first"


def networks(generator: torch.Generator, obs_dim: int = OBS, act_dim: int = ACT) -> tuple[nn.Module, nn.Module]:
    """Return an actor and a critic with random weights."""

    def noise(*shapes: tuple[int, ...]) -> list[Tensor]:
        return [0.6 * torch.randn(shape, generator=generator) for shape in shapes]

    hidden = 8
    actor = probes.SmallActor(*noise((hidden, obs_dim), (hidden,), (act_dim, hidden), (act_dim,)))
    return actor, probes.SmallCritic(*noise((hidden, obs_dim + act_dim), (hidden,), (1, hidden), (1,)))


def random_batch(generator: torch.Generator, size: int, ended: float = 0.3) -> Batch:
    """Return transitions without meaning; a share ``ended`` of them is terminated."""
    return Batch(
        torch.randn(size, OBS, generator=generator),
        torch.rand(size, ACT, generator=generator) * 2 - 1,
        torch.randn(size, generator=generator),
        torch.randn(size, OBS, generator=generator),
        (torch.rand(size, generator=generator) < ended).float(),
    )


def hand_batch() -> Batch:
    """Return four transitions with one-dimensional observations and actions; the third ended for good."""

    def column(*values: float) -> Tensor:
        return torch.tensor(values)[:, None]

    return Batch(
        column(1.0, 2.0, 3.0, 4.0),
        column(0.5, -0.5, 0.25, 0.0),
        torch.tensor([-1.0, -2.0, -3.0, 0.5]),
        column(2.0, 3.0, 4.0, 1.0),
        torch.tensor([0.0, 0.0, 1.0, 0.0]),
    )


HAND_ACTOR = probes.LinearActor([[-0.1]])  # pi(x) = 0.1 x
HAND_CRITIC = probes.LinearCritic(torch.tensor([[2.0], [10.0]]))  # Q(x, u) = 2 x + 10 u


# ---------------------------------------------------------------- targets


def compare_target(student: Any, batch: Batch, actor: nn.Module, critic: nn.Module, gamma: float, given: str) -> None:
    """Compare with r + gamma (1 - terminated) Q'(s', pi'(s'))."""
    expected = tools.td_target(batch, actor, critic, gamma)
    size = len(expected)
    found = student.run(probes.target, batch, spec_of(actor), spec_of(critic), gamma)
    wrong_shapes = [((size, size), "one-column-too-many"), ((size, 1), "one-column-too-many")]
    value = tools.as_tensor(found["target"], "the target", (size,), wrong_shapes)
    hint = "" if close(value, expected) else _target_mistake(value, expected, batch, actor, critic, gamma)
    expect_close(value.numpy(), expected.numpy(), rtol=1e-4, atol=1e-5, given=given, hint=hint, what="the target")


def compare_random_targets(student: Any, rng: np.random.Generator, sizes: Sequence[int]) -> None:
    """Compare the targets of random networks and transitions."""
    generator = tools.torch_rng(rng)
    for size in sizes:
        actor, critic = networks(generator)
        compare_target(student, random_batch(generator, size), actor, critic, float(rng.uniform(0.5, 0.99)),
                       f"random networks, {size} transitions")  # fmt: skip


def _target_mistake(
    value: Tensor, expected: Tensor, batch: Batch, actor: nn.Module, critic: nn.Module, gamma: float
) -> str:
    with torch.no_grad():
        future = critic(batch.next_obs, actor(batch.next_obs)).squeeze(-1)
        present = critic(batch.obs, actor(batch.obs)).squeeze(-1)
        as_before = critic(batch.next_obs, batch.action).squeeze(-1)
    reward, goes_on = batch.reward, 1 - batch.terminated
    mistakes = [
        ("end-has-no-future", reward + gamma * future),
        ("mask-inverted", reward + gamma * batch.terminated * future),
        ("bootstrap", reward),
        ("plus-the-future", reward - gamma * goes_on * future),
        ("gamma-once", reward + gamma**2 * goes_on * future),
        ("gamma-once", reward + goes_on * future),
        ("gamma-once", gamma * (reward + goes_on * future)),
        ("value-of-next", reward + gamma * goes_on * present),
        ("target-policy-acts", reward + gamma * goes_on * as_before),
        ("last-reward-counts", goes_on * (reward + gamma * future)),
        ("last-reward-counts", batch.terminated * reward + goes_on * gamma * future),
    ]
    return tools.first_match(value, mistakes, expected)


def compare_constant(student: Any, rng: np.random.Generator) -> None:
    """The target is a constant: no gradient leads back into the networks that it was computed from."""
    generator = tools.torch_rng(rng)
    actor, critic = networks(generator)
    batch = random_batch(generator, 6)
    found = student.run(probes.target, batch, spec_of(actor), spec_of(critic), 0.9)
    tools.as_tensor(found["target"], "the target", (6,), [((6, 1), "one-column-too-many")])
    expect(
        found["gradient"] is False,
        "the target still carries a gradient",
        got="requires_grad=True",
        expected="requires_grad=False",
        hint="target-is-constant",
        misconception="the loss should pull Q(s, a) towards the target, not the target towards Q(s, a)",
    )
    expect(found["learnable"] == [[True] * 4] * 2, "td_target switched requires_grad of a network off for good",
           hint="leave-networks-as-found", expected="requires_grad as it was before the call")  # fmt: skip


def compare_fixed_point(student: Any, rng: np.random.Generator) -> None:
    """Where policy and Q are the best ones of a linear-quadratic problem, target and Q(s, a) are equal everywhere."""
    for _ in range(3):
        problem = random_problem(rng)
        actor, critic = probes.LinearActor(problem.gain), probes.QuadraticCritic(problem.hessian)
        batch = problem.batch(rng, 32)
        with torch.no_grad():
            q = critic(batch.obs, batch.action).squeeze(-1)
        found = student.run(probes.target, batch, spec_of(actor), spec_of(critic), problem.gamma)
        answer = tools.as_tensor(found["target"], "the target", (32,), [((32, 1), "one-column-too-many")])
        expect_close(answer.numpy(), q.numpy(), rtol=1e-3, atol=1e-3, hint="bellman",
                     given="a linear-quadratic problem with its best policy and its exact Q",
                     what="the target")  # fmt: skip


def random_problem(rng: np.random.Generator, n: int = 2, m: int = 2) -> tools.LinearQuadratic:
    """Return a linear-quadratic problem with ``n`` states and ``m`` actions."""
    a = rng.normal(0, 0.6, (n, n))
    b = rng.normal(0, 1.0, (n, m))
    return tools.LinearQuadratic(a, b, np.diag(rng.uniform(0.5, 2, n)), np.diag(rng.uniform(0.2, 1, m)), 0.9)


# ---------------------------------------------------------------- losses


def compare_critic_loss(student: Any, critic: nn.Module, batch: Batch, target: Tensor, given: str) -> Any:
    """Compare with the mean squared error; return the gradients that it left in the critic."""
    with torch.no_grad():
        q = critic(batch.obs, batch.action).squeeze(-1)
    error = q - target
    expected = (error**2).mean()
    found = student.run(probes.critic_loss, spec_of(critic), batch, target)
    loss = tools.as_tensor(found["loss"], "the critic's loss", ())
    hint = "" if close(loss, expected) else _critic_mistake(loss, expected, q, target)
    expect_close(loss.numpy(), expected.numpy(), rtol=1e-4, given=given, hint=hint, what="the critic's loss",
                 misconception=COLUMN if hint == "one-column-too-many" else "")  # fmt: skip
    return found["gradients"]


def compare_random_critic_loss(student: Any, rng: np.random.Generator, size: int) -> Any:
    """Compare the loss of a random critic; return it, its gradients, batch and targets."""
    generator = tools.torch_rng(rng)
    _, critic = networks(generator)
    batch, target = random_batch(generator, size), torch.randn(size, generator=generator)
    found = compare_critic_loss(student, critic, batch, target, f"a small random network and {size} transitions")
    return critic, found, batch, target


def _critic_mistake(loss: Tensor, expected: Tensor, q: Tensor, target: Tensor) -> str:
    error, crossed = q - target, q[:, None] - target[None, :]
    mistakes = [
        ("one-column-too-many", (crossed**2).mean()),
        ("one-column-too-many", (crossed**2).sum()),
        ("mean-not-sum", (error**2).sum()),
        ("squared-error", error.abs().mean()),
        ("squared-error", expected.sqrt()),
        ("squared-error", error.mean() ** 2),
        ("squared-error", expected / 2),
        ("squared-error", torch.nn.functional.smooth_l1_loss(q, target)),
        ("loss-goes-down", -expected),
    ]
    return tools.first_match(loss, mistakes, expected)


def compare_critic_gradient(student: Any, rng: np.random.Generator) -> None:
    """The gradient that ``backward()`` leaves in the critic is the derivative of the loss."""
    critic, found, batch, target = compare_random_critic_loss(student, rng, 6)
    expected = _derivatives(lambda: tools.critic_loss(critic, batch, target), critic)
    _compare_gradients(found, expected, "the critic", "loss-has-a-gradient")


def _derivatives(loss: Callable[[], Tensor], network: nn.Module) -> list[Tensor]:
    """Return the derivatives of our own loss, which tests/test_hw1_rl.py compares with finite differences."""
    return list(torch.autograd.grad(loss(), list(network.parameters())))


def _compare_gradients(found: Any, expected: Sequence[Tensor], whose: str, hint: str) -> None:
    """Compare what ``loss.backward()`` left in a network with the derivatives."""
    expect(
        found is not None,
        f"{whose}'s loss is cut off from the network: nothing can be learned from it",
        hint=hint,
        misconception="somewhere between the network and the loss stands detach(), no_grad(), item() or numpy()",
        expected="a loss with a gradient",
    )
    got = [torch.zeros_like(e) if g is None else g for g, e in zip(found, expected, strict=True)]
    parts = [tools.as_tensor(g, f"{whose}'s gradient", tuple(e.shape)) for g, e in zip(got, expected, strict=True)]
    if hint == "through-the-action" and all(map(close, parts, [-e for e in expected])):
        fail(
            "the gradient points the wrong way: the actor would learn to be bad",
            hint="climb-not-descend",
            expected="a step that raises the value of the action",
        )
    for part, wanted in zip(parts, expected, strict=True):
        expect_close(part.numpy(), wanted.numpy(), rtol=1e-3, atol=1e-5, what=f"{whose}'s gradient", hint=hint)


def compare_actor_loss(student: Any, actor: nn.Module, critic: nn.Module, batch: Batch, given: str) -> None:
    """Compare with -mean Q(s, pi(s))."""
    with torch.no_grad():
        expected = -critic(batch.obs, actor(batch.obs)).mean()
    found = student.run(probes.actor_loss, spec_of(actor), spec_of(critic), batch)
    loss = tools.as_tensor(found["loss"], "the actor's loss", ())
    hint = "" if close(loss, expected) else _actor_mistake(loss, expected, actor, critic, batch)
    expect_close(loss.numpy(), expected.numpy(), rtol=1e-4, atol=1e-6, given=given, hint=hint, what="the actor's loss")


def compare_random_actor_loss(student: Any, rng: np.random.Generator, size: int) -> None:
    """Compare the loss of random networks."""
    generator = tools.torch_rng(rng)
    actor, critic = networks(generator)
    given = f"small random networks and {size} transitions"
    compare_actor_loss(student, actor, critic, random_batch(generator, size), given)


def _actor_mistake(loss: Tensor, expected: Tensor, actor: nn.Module, critic: nn.Module, batch: Batch) -> str:
    with torch.no_grad():
        q = critic(batch.obs, actor(batch.obs)).squeeze(-1)
        stored = critic(batch.obs, batch.action).squeeze(-1)
        later = critic(batch.next_obs, actor(batch.next_obs)).squeeze(-1)
    mistakes = [
        ("climb-not-descend", q.mean()),
        ("mean-not-sum", -q.sum()),
        ("own-action", -stored.mean()),
        ("own-action", stored.mean()),
        ("present-obs", -later.mean()),
        ("value-not-square", (q**2).mean()),
        ("value-not-square", ((q - batch.reward) ** 2).mean()),
    ]
    return tools.first_match(loss, mistakes, expected)


def compare_actor_gradient(student: Any, rng: np.random.Generator) -> None:
    """The gradient in the actor is the derivative of -mean Q through the action."""
    generator = tools.torch_rng(rng)
    actor, critic = networks(generator)
    batch = random_batch(generator, 6)
    found = student.run(probes.actor_loss, spec_of(actor), spec_of(critic), batch)
    tools.as_tensor(found["loss"], "the actor's loss", ())
    expected = _derivatives(lambda: tools.actor_loss(actor, critic, batch), actor)
    _compare_gradients(found["gradients"], expected, "the actor", "through-the-action")


def compare_critic_alone(student: Any, rng: np.random.Generator) -> None:
    """The critic's parameters get no gradient from the actor's loss."""
    generator = tools.torch_rng(rng)
    actor, critic = networks(generator)
    marker = float(rng.uniform(0.1, 0.5))
    found = student.run(probes.actor_loss, spec_of(actor), spec_of(critic), random_batch(generator, 6), marker)
    gradients = found["gradients"]
    tools.as_tensor(found["loss"], "the actor's loss", ())
    alive = gradients is not None and any(g is not None and bool(g.abs().max() > 0) for g in gradients)
    expect(
        alive,
        "no gradient reaches the actor",
        hint="through-the-action",
        expected="a gradient that flows through the action into the actor",
    )
    for parameter, got in zip(critic.parameters(), found["critic"], strict=True):
        expect(
            got is not None and torch.equal(got, torch.full_like(parameter, marker)),
            "the actor's loss also changed the gradient of the critic's parameters",
            expected="only the actor's parameters have a new gradient",
            hint="critic-is-the-judge",
        )


def compare_critic_still_learns(student: Any, rng: np.random.Generator) -> None:
    """After an actor's loss the critic can learn as before; what was frozen before stays frozen."""
    generator = tools.torch_rng(rng)
    actor, critic = networks(generator)
    found = student.run(probes.actor_loss, spec_of(actor), spec_of(critic), random_batch(generator, 6), frozen=1)
    now, before = found["learnable"], [False, True, True, True]
    expect(list(now[1:]) == before[1:], "after actor_loss, parameters of the critic are frozen: it will never learn "
           "again", got=now, expected=before, hint="leave-networks-as-found")  # fmt: skip
    expect(now == before, "actor_loss thawed a parameter that somebody had frozen before", got=now, expected=before,
           hint="leave-networks-as-found", credit=0.5)  # fmt: skip


# ---------------------------------------------------------------- soft update


def compare_soft_update(student: Any, rng: np.random.Generator, tau: float, times: int) -> None:
    """After ``times`` updates the target has gone 1 - (1 - tau)^times of the way."""
    generator = tools.torch_rng(rng)
    target, online = networks(generator)[1], networks(generator)[1]
    found = student.run(probes.followed, spec_of(target), spec_of(online), tau, times)
    answer, moved = flat(found["target"]), flat(found["online"])
    old, new = (flat(probes.values_of(network)) for network in (target, online))
    expect(torch.equal(moved, new), "the online network changed", hint="target-follows",
           expected="only the target moves")  # fmt: skip
    expect(found["kept"] is True, "the target's parameters were replaced by new tensors",
           expected="the same parameters with new values", hint="in-place")  # fmt: skip
    share = 1 - (1 - tau) ** times
    expected = old + share * (new - old)
    mistakes = [
        ("tau-is-the-small-step", old + (1 - tau**times) * (new - old)),
        ("target-follows", old),
        ("tau-is-the-small-step", new),
        ("tau-is-the-small-step", old + times * tau * new),
    ]
    hint = tools.first_match(answer, mistakes, expected)
    given = f"tau = {tau:g}, {times} update{'s' if times > 1 else ''}"
    expect_close(answer.numpy(), expected.numpy(), rtol=1e-4, atol=1e-6, given=given, hint=hint,
                 what="the target's parameters")  # fmt: skip


def compare_separate(student: Any, rng: np.random.Generator) -> None:
    """Target and online network share no memory, whatever tau is."""
    generator = tools.torch_rng(rng)
    for tau in (0.3, 1.0):
        target, online = networks(generator)[1], networks(generator)[1]
        found = student.run(probes.followed, spec_of(target), spec_of(online), tau, 1)
        old, new = (flat(probes.values_of(network)) for network in (target, online))
        given = f"tau = {tau:g}"
        expect(torch.equal(flat(found["target"]), flat(found["later"])),
               "when the online network learned on, the target changed with it", given=given,
               hint="in-place", expected="a target that only soft_update changes")  # fmt: skip
        expect_close(flat(found["later"]).numpy(), (old + tau * (new - old)).numpy(), rtol=1e-4, atol=1e-6, given=given,
                     what="the target's parameters", hint="target-follows")  # fmt: skip


# ---------------------------------------------------------------- exploration


def fixed_actor(scale: float = 1.0) -> probes.Fixed:
    """Return an actor whose actions are the first columns of the observation, scaled."""
    return probes.Fixed(torch.full((ACT,), scale))


def actions(student: Any, obs: Any, times: int, seed: int, actor: probes.Fixed | None = None, **settings: float) -> Any:
    """Return the student's actions in several calls, (times, N, A) float64, or fail and say what came instead."""
    found = student.run(probes.actions, spec_of(actor or fixed_actor()), obs, times, seed, settings)
    shape = (len(obs), ACT)
    if not isinstance(found, np.ndarray):
        answer = found[0]
        if not isinstance(answer, np.ndarray):
            fail(
                "actions should be a NumPy array, for the environment",
                got=answer,
                hint="numpy-for-the-env",
                expected="numpy.ndarray",
            )
        fail("actions have different shapes in different calls", got=answer.shape, expected=shape,
             hint="numpy-for-the-env")  # fmt: skip
    expect(found.shape[1:] == shape and len(found) == times, "actions have the wrong shape", got=found.shape[1:],
           expected=shape, hint="numpy-for-the-env")  # fmt: skip
    return found.astype(float)


def compare_greedy(student: Any, rng: np.random.Generator) -> None:
    """Without noise the action is the actor's own, exactly, and always the same."""
    obs = rng.uniform(-0.9, 0.9, (6, OBS)).astype(np.float32)
    scale = float(rng.uniform(0.5, 1.0))
    ways: tuple[dict[str, Any], ...] = ({}, {"std": 0.0})
    for settings in ways:
        answers = actions(student, obs, 3, 1, fixed_actor(scale), **settings)
        for answer in answers:
            expect_close(answer, scale * obs[:, :ACT].astype(float), atol=1e-6, hint="no-noise-when-it-counts",
                         what="the action without noise", given=str(settings or "std not given"))  # fmt: skip


def compare_noise(student: Any, rng: np.random.Generator, times: int = 40) -> None:
    """Far from the bounds the noise is Gaussian, of mean 0 and this standard deviation.

    False alarms: mean, spread and Kolmogorov-Smirnov distance, each at a third of ``tools.FALSE_ALARM``.
    """
    std = float(rng.uniform(0.09, 0.11))
    obs = rng.uniform(-0.3, 0.3, (60, OBS)).astype(np.float32)
    found = actions(student, obs, times, int(rng.integers(2**31)), std=std) - obs[:, :ACT]
    given = f"std = {std:g}, {found.size} numbers, far from the bounds"
    if np.all(found == 0):
        fail(
            "there is no noise", given=given, hint="noise-to-explore", expected="noise of the given standard deviation"
        )
    for axis in (1, 2):  # noise that robots or joints share is another test's business
        first = np.take(found, [0], axis=axis)
        found = first if np.allclose(found, first, atol=1e-5) else found
    alarm = tools.FALSE_ALARM / 3
    n = found.size
    spread = float(found.std())
    low, high = (stats.chi2.isf(p, n - 1) for p in (1 - alarm / 2, alarm / 2))
    inside = low < n * found.var() / std**2 < high
    hint = "std-not-variance" if np.isclose(spread, std**2, rtol=0.1) or np.isclose(spread, std**0.5, rtol=0.1) else ""
    expect(inside, "the noise has another standard deviation", got=round(spread, 4), expected=std, given=given,
           hint=hint or "gaussian-noise")  # fmt: skip
    mean = float(found.mean())
    expect(abs(mean) < stats.norm.isf(alarm / 2) * std / n**0.5, "the noise is not zero on average", got=round(mean, 4),
           expected=0.0, given=given, hint="gaussian-noise")  # fmt: skip
    fit = stats.kstest(found.ravel() / std, "norm", method="asymp")
    expect(fit.pvalue > alarm, "the noise is not Gaussian", given=given, got=f"{fit.statistic:.3f} from the bell",
           hint="gaussian-noise", expected="a bell curve")  # fmt: skip


def compare_independent(student: Any, rng: np.random.Generator, times: int = 60) -> None:
    """Each robot, each joint and each call draws for itself."""
    obs = np.zeros((24, OBS), dtype=np.float32)
    found = actions(student, obs, times, int(rng.integers(2**31)), std=0.1)
    expect(
        not np.all(found == found[:1]),
        "every call adds the same noise",
        hint="fresh-noise",
        expected="new noise at every call",
    )
    expect(
        not np.allclose(found, found[:, :1]),
        "all robots get the same noise",
        hint="fresh-noise",
        expected="noise of its own for every robot",
    )
    expect(
        not np.allclose(found, found[..., :1]),
        "all joints get the same noise",
        hint="fresh-noise",
        expected="noise of its own for every joint",
    )
    table = found.reshape(times, -1)
    steps = np.corrcoef(table[:-1].ravel(), table[1:].ravel())[0, 1]
    limit = stats.norm.isf(tools.FALSE_ALARM / 2) / table[1:].size ** 0.5
    expect(abs(steps) < limit, "the noise of one call depends on that of the call before", got=round(float(steps), 3),
           hint="fresh-noise", expected="about 0: noise that remembers nothing")  # fmt: skip


def compare_bounds(student: Any, rng: np.random.Generator) -> None:
    """With and without noise the action lies within its bounds, and all of the room up to them is used."""
    edge = np.full((16, OBS), 0.95, dtype=np.float32)
    edge[::2] *= -1
    for low, high in ((-1.0, 1.0), (-float(rng.uniform(0.4, 0.6)), 1.5)):
        found = actions(student, edge, 60, int(rng.integers(2**31)), std=0.5, low=low, high=high)
        given = f"bounds {low:g} to {high:g}, std = 0.5, actions of the actor near the bounds"
        outside = bool((found > high + 1e-6).any() or (found < low - 1e-6).any())
        expect(not outside, "an action lies outside its bounds", given=given, hint="clip-the-action",
               got=f"from {found.min():.2f} to {found.max():.2f}", expected=f"within {low:g} and {high:g}")  # fmt: skip
        touched = np.isclose(found.max(), high, atol=1e-5) and np.isclose(found.min(), low, atol=1e-5)
        expect(touched, "no action ever reaches its bound", given=given, hint="clip-the-action",
               got=f"from {found.min():.2f} to {found.max():.2f}", expected=f"from {low:g} to {high:g}")  # fmt: skip


# ---------------------------------------------------------------- the agent

VARIANTS: tuple[tuple[str, tools.Steps], ...] = (
    ("zero-grad", tools.Steps(zero_grad=False)),
    ("targets-follow", tools.Steps(follow=())),
    ("targets-follow", tools.Steps(follow=("critic",))),
    ("targets-follow", tools.Steps(follow=("actor",))),
    ("targets-last", tools.Steps(targets_first=True)),
    ("critic-first", tools.Steps(actor_first=True)),
    ("targets-are-copies", tools.Steps(copies=False)),
    ("target-networks", tools.Steps(online_targets=True)),
    ("whose-rate", tools.Steps(swap_rates=True)),
)
RATES = {"gamma": 0.9, "tau": 0.1, "actor_lr": 2e-3, "critic_lr": 5e-3, "noise_std": 0.2}


def compare_update(student: Any, rng: np.random.Generator, updates: int) -> None:
    """After some updates all four networks are where the algorithm, step by step, brings them."""
    generator = tools.torch_rng(rng)
    actor, critic = networks(generator)
    batches = [random_batch(generator, 16) for _ in range(updates)]

    def after(steps: tools.Steps | None) -> dict[str, Tensor]:
        agent = tools.Agent(probes.build(spec_of(actor)), probes.build(spec_of(critic)), **RATES, steps=steps)
        for batch in batches:
            agent.update(batch)
        return {name: flat(probes.values_of(getattr(agent, name))) for name in probes.PARTS}

    answer = student.run(probes.updated, spec_of(actor), spec_of(critic), RATES, batches)
    missing = answer.get("missing")
    expect(not missing, f"the agent lacks networks: {missing}", expected=f"attributes {', '.join(probes.PARTS)}")
    expected = after(None)
    found = {name: flat(answer[name]) for name in probes.PARTS}
    if all(alike(found[name], expected[name]) for name in probes.PARTS):
        return
    hint = ""
    for key, steps in VARIANTS:
        wrong = after(steps)
        if all(alike(found[name], wrong[name]) for name in probes.PARTS):
            hint = key
            break
    where = next(name for name in probes.PARTS if not alike(found[name], expected[name]))
    shape = found[where].shape == expected[where].shape
    change = float((found[where] - expected[where]).abs().max()) if shape else float("nan")
    fail(
        f"after {updates} update{'s' if updates > 1 else ''}, {where} is not where it should be",
        given=f"random networks and batches; {', '.join(f'{k}={v:g}' for k, v in RATES.items())}",
        got=f"a parameter of {where} that is off by {change:.2g}",
        expected="the same as after: critic step, actor step with the new critic, soft update of both targets",
        hint=hint or "four-steps",
    )


def flat(values: Sequence[Tensor]) -> Tensor:
    """Return all parameters as one vector."""
    return torch.cat([value.ravel() for value in values])


def close(a: Tensor, b: Tensor) -> bool:
    """Whether two tensors are equal but for rounding."""
    return a.shape == b.shape and bool(torch.allclose(a, b.to(a.dtype), rtol=1e-4, atol=1e-6))


def alike(a: Tensor, b: Tensor) -> bool:
    """Whether two networks are equal but for rounding, which Adam enlarges where a gradient is nearly 0."""
    return a.shape == b.shape and float((~((a - b).abs() <= 3e-5)).float().mean()) < 0.02


def compare_agent_acts(student: Any, rng: np.random.Generator) -> None:
    """The agent adds noise if it explores, and only then."""
    actor, critic = fixed_actor(float(rng.uniform(0.5, 1.0))), networks(tools.torch_rng(rng))[1]
    obs = rng.uniform(-0.1, 0.1, (200, OBS)).astype(np.float32)
    found = student.run(probes.acted, spec_of(actor), spec_of(critic), RATES, obs, seed=int(rng.integers(2**31)))
    clean = float(actor.scale.detach()[0]) * obs[:, :ACT].astype(float)
    expect_close(found["greedy"], clean, atol=1e-6, what="act(obs)", hint="no-noise-when-it-counts")
    noisy = found["explored"]
    if not isinstance(noisy, np.ndarray) or noisy.shape != clean.shape:
        fail("act(obs, explore=True) should return actions", got=noisy, expected=f"an array {clean.shape}")
    spread = float((noisy.astype(float) - clean).std())
    expect(
        spread > 1e-6,
        "act(obs, explore=True) adds no noise",
        hint="noise-to-explore",
        expected="actions with noise around those without",
    )
    # 400 Gaussian numbers: their standard deviation is within 25 % but for a probability of about 1e-12.
    near = 0.75 < spread / RATES["noise_std"] < 1.25
    expect(near, "act(obs, explore=True) adds noise of another size than noise_std",
           got=round(spread, 3), expected=RATES["noise_std"], hint="noise-to-explore")  # fmt: skip


def compare_targets_wait(student: Any, rng: np.random.Generator) -> None:
    """The targets begin as copies, and nobody but the soft update moves them."""
    actor, critic = networks(tools.torch_rng(rng))
    found = student.run(probes.begun, spec_of(actor), spec_of(critic), RATES)
    for name, network in (("actor", actor), ("critic", critic)):
        start = flat(probes.values_of(network))
        for which in (name, f"{name}_target"):
            expect(close(flat(found[which]), start), f"{which} does not begin as a copy of the {name} that was given",
                   hint="targets-are-copies", expected=f"the same parameters as {name}")  # fmt: skip
        expect(close(flat(found[f"{name}_target later"]), start),
               f"{name}_target is {name} itself: the target moves with every step of the optimiser",
               hint="targets-are-copies", expected="a copy with parameters of its own")  # fmt: skip


def compare_learns(student: Any, rng: np.random.Generator, updates: int = 60) -> None:
    """On a linear-quadratic problem with one state, policy and Q come out as the Riccati equation has them.

    Updates are dear, so the networks begin near the answer, on a side that nobody knows.
    """
    a, b, r = (float(rng.uniform(*ends)) for ends in ((0.75, 0.95), (0.4, 0.6), (0.2, 0.5)))
    problem = tools.LinearQuadratic(np.array([[a]]), np.array([[b]]), np.array([[1.0]]), np.array([[r]]), gamma=0.5)
    settings = {"gamma": 0.5, "tau": 0.4, "actor_lr": 0.02, "critic_lr": 0.03, "noise_std": 0.1}
    start = (
        probes.LinearActor(problem.gain + rng.choice((-1, 1)) * rng.uniform(0.15, 0.35)),
        probes.QuadraticCritic(problem.hessian * rng.uniform(0.7, 1.3, (2, 2))),
    )
    data = problem.batch(rng, 48 * updates)
    batches = [[part[k : k + 48] for part in data] for k in range(0, 48 * updates, 48)]
    found = student.run(probes.updated, *map(spec_of, start), settings, batches)
    missing = found.get("missing")
    expect(not missing, f"the agent lacks networks: {missing}", expected=f"attributes {', '.join(probes.PARTS)}")
    gain = tools.as_tensor(found["actor"][0], "the actor's gain", (1, 1))
    given = f"{updates} updates on x' = {a:.2f} x + {b:.2f} u, reward -(x^2 + {r:.2f} u^2), gamma = 0.5"
    expect_close(float(gain), float(problem.gain[0, 0]), atol=0.08, given=given, hint="bellman",
                 what="the learned gain K of u = -K x")  # fmt: skip
    weights = tools.as_tensor(found["critic"][0], "the critic's H", (2, 2)).numpy()
    expect_close((weights + weights.T) / 2, problem.hessian, atol=0.08, rtol=0.06, given=given, hint="bellman",
                 what="the learned Q, -z' H z: H")  # fmt: skip

"""How `hw1_rl` tests targets, losses, soft updates, exploration, and the agent made of them.

Each ``compare_...`` function puts a question to the student's function, compares with an oracle, and, where the answer
is wrong, looks whether a typical mistake would have given just that answer; then the hint names the mistake.
"""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from robotbrain.grading import CheckFailure, expect, expect_close, fail
from robotbrain.grading.suites import hw1_rl_tools as tools
from robotbrain.grading.suites.hw1_rl_tools import Batch

OBS, ACT = 3, 2
COLUMN = "(B, 1) minus (B,) is (B, B) in torch, every value against every reward: squeeze the critic's answer first"


def networks(seed: int, obs_dim: int = OBS, act_dim: int = ACT) -> tuple[nn.Module, nn.Module]:
    """Return an actor and a critic with random weights."""
    generator = torch.Generator().manual_seed(seed)
    return tools.SmallActor(obs_dim, act_dim, generator=generator), tools.SmallCritic(
        obs_dim, act_dim, generator=generator
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


HAND_ACTOR = tools.LinearActor([[-0.1]])  # pi(x) = 0.1 x


class HandCritic(nn.Module):
    """Q(x, u) = 2 x + 10 u, (B, 1)."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.tensor([[2.0], [10.0]]))

    def forward(self, obs: Tensor, action: Tensor) -> Tensor:
        """Return the values (B, 1)."""
        return torch.cat([obs, action], dim=-1) @ self.weight


# ---------------------------------------------------------------- targets


def compare_target(student: Any, batch: Batch, actor: nn.Module, critic: nn.Module, gamma: float, given: str) -> None:
    """Compare with r + gamma (1 - terminated) Q'(s', pi'(s'))."""
    expected = tools.td_target(batch, actor, critic, gamma)
    size = len(expected)
    answer = student(batch, actor, critic, gamma)
    wrong_shapes = [((size, size), "one-column-too-many"), ((size, 1), "one-column-too-many")]
    value = tools.as_tensor(answer, "the target", (size,), wrong_shapes).detach()
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
    hint = tools.first_match(value, mistakes, expected)
    expect_close(value.numpy(), expected.numpy(), rtol=1e-4, atol=1e-5, given=given, hint=hint, what="the target")


def compare_constant(student: Any) -> None:
    """The target is a constant: no gradient leads back into the networks that it was computed from."""
    actor, critic = networks(1)
    batch = tools.random_batch(torch.Generator().manual_seed(2), 6, OBS, ACT)
    answer = tools.as_tensor(student(batch, actor, critic, 0.9), "the target", (6,), [((6, 1), "one-column-too-many")])
    expect(
        not answer.requires_grad,
        "the target still carries a gradient",
        got="requires_grad=True",
        expected="requires_grad=False",
        hint="target-is-constant",
        misconception="the loss should pull Q(s, a) towards the target, not the target towards Q(s, a)",
    )
    wanted = [p.requires_grad for network in (actor, critic) for p in network.parameters()]
    expect(all(wanted), "td_target switched requires_grad of a network off for good", hint="leave-networks-as-found")


def compare_fixed_point(student: Any, rng: np.random.Generator) -> None:
    """Where policy and Q are the best ones of a linear-quadratic problem, target and Q(s, a) are equal everywhere."""
    for _ in range(3):
        problem = random_problem(rng)
        actor, critic = tools.LinearActor(problem.gain), tools.QuadraticCritic(problem.hessian)
        batch = problem.batch(rng, 32)
        with torch.no_grad():
            q = critic(batch.obs, batch.action).squeeze(-1)
        answer = tools.as_tensor(student(batch, actor, critic, problem.gamma), "the target", (32,),
                                 [((32, 1), "one-column-too-many")])  # fmt: skip
        expect_close(answer.detach().numpy(), q.numpy(), rtol=1e-3, atol=1e-3, hint="bellman",
                     given="a linear-quadratic problem with its best policy and its exact Q",
                     what="the target")  # fmt: skip


def random_problem(rng: np.random.Generator, n: int = 2, m: int = 2) -> tools.LinearQuadratic:
    """Return a linear-quadratic problem with ``n`` states and ``m`` actions."""
    a = rng.normal(0, 0.6, (n, n))
    b = rng.normal(0, 1.0, (n, m))
    return tools.LinearQuadratic(a, b, np.diag(rng.uniform(0.5, 2, n)), np.diag(rng.uniform(0.2, 1, m)), 0.9)


# ---------------------------------------------------------------- losses


def compare_critic_loss(student: Any, critic: nn.Module, batch: Batch, target: Tensor, given: str) -> None:
    """Compare with the mean squared error."""
    with torch.no_grad():
        q = critic(batch.obs, batch.action).squeeze(-1)
    error = q - target
    crossed = q[:, None] - target[None, :]
    expected = (error**2).mean()
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
    loss = tools.as_tensor(student(critic, batch, target), "the critic's loss", ()).detach()
    hint = tools.first_match(loss, mistakes, expected)
    expect_close(loss.numpy(), expected.numpy(), rtol=1e-4, given=given, hint=hint, what="the critic's loss",
                 misconception=COLUMN if hint == "one-column-too-many" else "")  # fmt: skip


def compare_critic_gradient(student: Any, seed: int) -> None:
    """The gradient that ``backward()`` leaves in the critic is the derivative of the loss."""
    _, critic = networks(seed)
    generator = torch.Generator().manual_seed(seed + 1)
    batch = tools.random_batch(generator, 6, OBS, ACT)
    target = torch.randn(6, generator=generator)
    compare_critic_loss(student, critic, batch, target, "a small random network and six transitions")

    def value() -> float:
        with torch.no_grad():
            return float(tools.critic_loss(critic, batch, target))

    expected = tools.finite_differences(value, critic)
    found = tools.gradients_of(student(critic, batch, target), critic, "the critic's loss", "loss-has-a-gradient")
    for got, wanted in zip(found, expected, strict=True):
        expect_close(got.numpy(), wanted.numpy(), rtol=0.02, atol=5e-3, what="the critic's gradient",
                     hint="loss-has-a-gradient")  # fmt: skip


def compare_actor_loss(student: Any, actor: nn.Module, critic: nn.Module, batch: Batch, given: str) -> None:
    """Compare with -mean Q(s, pi(s))."""
    with torch.no_grad():
        q = critic(batch.obs, actor(batch.obs)).squeeze(-1)
        stored = critic(batch.obs, batch.action).squeeze(-1)
        later = critic(batch.next_obs, actor(batch.next_obs)).squeeze(-1)
    expected = -q.mean()
    mistakes = [
        ("climb-not-descend", q.mean()),
        ("mean-not-sum", -q.sum()),
        ("own-action", -stored.mean()),
        ("own-action", stored.mean()),
        ("present-obs", -later.mean()),
        ("value-not-square", (q**2).mean()),
        ("value-not-square", ((q - batch.reward) ** 2).mean()),
    ]
    loss = tools.as_tensor(student(actor, critic, batch), "the actor's loss", ()).detach()
    hint = tools.first_match(loss, mistakes, expected)
    expect_close(loss.numpy(), expected.numpy(), rtol=1e-4, atol=1e-6, given=given, hint=hint, what="the actor's loss")


def compare_actor_gradient(student: Any, seed: int) -> None:
    """The gradient in the actor is the derivative of -mean Q through the action."""
    actor, critic = networks(seed)
    batch = tools.random_batch(torch.Generator().manual_seed(seed + 1), 6, OBS, ACT)

    def value() -> float:
        with torch.no_grad():
            return float(-critic(batch.obs, actor(batch.obs)).mean())

    expected = tools.finite_differences(value, actor)
    found = tools.gradients_of(student(actor, critic, batch), actor, "the actor's loss", "through-the-action")
    if all(
        bool(torch.allclose(got, -wanted, rtol=0.02, atol=5e-3)) for got, wanted in zip(found, expected, strict=True)
    ):
        fail("the gradient points the wrong way: the actor would learn to be bad", hint="climb-not-descend")
    for got, wanted in zip(found, expected, strict=True):
        expect_close(got.numpy(), wanted.numpy(), rtol=0.02, atol=5e-3, what="the actor's gradient",
                     hint="through-the-action")  # fmt: skip


def compare_critic_alone(student: Any) -> None:
    """The critic's parameters get no gradient from the actor's loss."""
    actor, critic = networks(5)
    batch = tools.random_batch(torch.Generator().manual_seed(6), 6, OBS, ACT)
    marker = [torch.full_like(p, 0.25) for p in critic.parameters()]
    for parameter, mark in zip(critic.parameters(), marker, strict=True):
        parameter.grad = mark.clone()
    found = tools.gradients_of(student(actor, critic, batch), actor, "the actor's loss", "through-the-action")
    expect(any(bool(gradient.abs().max() > 0) for gradient in found), "no gradient reaches the actor",
           hint="through-the-action")  # fmt: skip
    for parameter, mark in zip(critic.parameters(), marker, strict=True):
        expect(
            parameter.grad is not None and torch.equal(parameter.grad, mark),
            "the actor's loss also changed the gradient of the critic's parameters",
            expected="only the actor's parameters have a new gradient",
            hint="critic-is-the-judge",
        )


def compare_critic_still_learns(student: Any) -> None:
    """After an actor's loss the critic can learn as before; what was frozen before stays frozen."""
    actor, critic = networks(7)
    batch = tools.random_batch(torch.Generator().manual_seed(8), 6, OBS, ACT)
    frozen = next(iter(critic.parameters()))
    frozen.requires_grad_(False)
    student(actor, critic, batch)
    now = [p.requires_grad for p in critic.parameters()]
    expect(all(now[1:]), "after actor_loss, parameters of the critic are frozen: it will never learn again",
           got=now, expected=[False] + [True] * (len(now) - 1), hint="leave-networks-as-found")  # fmt: skip
    expect(not now[0], "actor_loss thawed a parameter that somebody had frozen before", got=now,
           expected=[False] + [True] * (len(now) - 1), hint="leave-networks-as-found", credit=0.5)  # fmt: skip


# ---------------------------------------------------------------- soft update


def compare_soft_update(student: Any, tau: float, times: int) -> None:
    """After ``times`` updates the target has gone 1 - (1 - tau)^times of the way."""
    _, target = networks(11)
    _, online = networks(12)
    start = [p.detach().clone() for p in target.parameters()]
    goal = [p.detach().clone() for p in online.parameters()]
    leaves = list(target.parameters())
    for _ in range(times):
        student(target, online, tau)
    for now, before in zip(online.parameters(), goal, strict=True):
        expect(torch.equal(now, before), "the online network changed", hint="target-follows",
               expected="only the target moves")  # fmt: skip
    same = all(a is b for a, b in zip(target.parameters(), leaves, strict=True))
    expect(same and all(p.is_leaf for p in target.parameters()), "the target's parameters were replaced by new tensors",
           expected="the same parameters with new values", hint="in-place")  # fmt: skip
    share = 1 - (1 - tau) ** times
    answer = torch.cat([p.detach().ravel() for p in target.parameters()])
    old, new = torch.cat([s.ravel() for s in start]), torch.cat([g.ravel() for g in goal])
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


def compare_separate(student: Any) -> None:
    """Target and online network share no memory, whatever tau is."""
    for tau in (0.3, 1.0):
        _, target = networks(13)
        _, online = networks(14)
        student(target, online, tau)
        before = [p.detach().clone() for p in target.parameters()]
        with torch.no_grad():
            for parameter in online.parameters():
                parameter.add_(1.0)
        for now, kept in zip(target.parameters(), before, strict=True):
            expect(torch.equal(now, kept), "when the online network learned on, the target changed with it",
                   given=f"tau = {tau:g}", hint="in-place")  # fmt: skip


# ---------------------------------------------------------------- exploration


class Fixed(nn.Module):
    """An actor whose actions are the first columns of the observation, and which counts its parameters as any other."""

    def __init__(self, act_dim: int) -> None:
        super().__init__()
        self.act_dim = act_dim
        self.scale = nn.Parameter(torch.ones(1))

    def forward(self, obs: Tensor) -> Tensor:
        """Return the actions."""
        return obs[..., : self.act_dim] * self.scale


def actions(student: Any, obs: Any, act_dim: int = ACT, **settings: Any) -> Any:
    """Return the student's actions as float64 array, or fail and say what came instead."""
    answer = student(Fixed(act_dim), obs, **settings)
    if not isinstance(answer, np.ndarray):
        fail(
            "actions should be a NumPy array, for the environment", got=type(answer).__name__, hint="numpy-for-the-env"
        )
    expect(answer.shape == (len(obs), act_dim), "actions have the wrong shape", got=answer.shape,
           expected=(len(obs), act_dim), hint="numpy-for-the-env")  # fmt: skip
    return answer.astype(float)


def compare_greedy(student: Any) -> None:
    """Without noise the action is the actor's own, exactly, and always the same."""
    obs = np.random.default_rng(3).uniform(-0.9, 0.9, (6, OBS)).astype(np.float32)
    ways: tuple[dict[str, Any], ...] = ({}, {"std": 0.0})
    for settings in ways:
        for _ in range(3):
            answer = actions(student, obs, **settings)
            expect_close(answer, obs[:, :ACT].astype(float), atol=1e-6, hint="no-noise-when-it-counts",
                         what="the action without noise", given=str(settings or "std not given"))  # fmt: skip


def compare_noise(student: Any, std: float = 0.1, times: int = 250) -> None:
    """Far from the bounds the noise is Gaussian, of mean 0 and this standard deviation.

    False alarms: mean, spread and Kolmogorov-Smirnov distance, each at a third of ``tools.FALSE_ALARM``.
    """
    from scipy import stats

    obs = np.random.default_rng(4).uniform(-0.3, 0.3, (16, OBS)).astype(np.float32)
    found = np.stack([actions(student, obs, std=std) - obs[:, :ACT] for _ in range(times)])
    given = f"std = {std:g}, {found.size} numbers, far from the bounds"
    if np.all(found == 0):
        fail("there is no noise", given=given, hint="noise-to-explore")
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
    fit = stats.kstest(found.ravel() / std, "norm")
    expect(fit.pvalue > alarm, "the noise is not Gaussian", given=given, got=f"{fit.statistic:.3f} from the bell",
           hint="gaussian-noise")  # fmt: skip


def compare_independent(student: Any, std: float = 0.1, times: int = 250) -> None:
    """Each robot, each joint and each call draws for itself."""
    from scipy import stats

    obs = np.zeros((8, OBS), dtype=np.float32)
    found = np.stack([actions(student, obs, std=std) for _ in range(times)])
    expect(not np.all(found == found[:1]), "every call adds the same noise", hint="fresh-noise")
    expect(not np.allclose(found, found[:, :1]), "all robots get the same noise", hint="fresh-noise")
    expect(not np.allclose(found, found[..., :1]), "all joints get the same noise", hint="fresh-noise")
    table = found.reshape(times, -1)
    steps = np.corrcoef(table[:-1].ravel(), table[1:].ravel())[0, 1]
    limit = stats.norm.isf(tools.FALSE_ALARM / 2) / table[1:].size ** 0.5
    expect(abs(steps) < limit, "the noise of one call depends on that of the call before", got=round(float(steps), 3),
           hint="fresh-noise")  # fmt: skip


def compare_bounds(student: Any) -> None:
    """With and without noise the action lies within its bounds, and all of the room up to them is used."""
    edge = np.full((64, OBS), 0.95, dtype=np.float32)
    for low, high in ((-1.0, 1.0), (-0.5, 2.0)):
        found = np.stack(
            [actions(student, sign * edge, std=0.5, low=low, high=high) for sign in (1, -1) for _ in range(20)]
        )
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
PARTS = ("critic", "actor", "critic_target", "actor_target")
RATES = {"gamma": 0.9, "tau": 0.1, "actor_lr": 2e-3, "critic_lr": 5e-3, "noise_std": 0.2}


def compare_update(cls: Any, seed: int, updates: int) -> None:
    """After some updates all four networks are where the algorithm, step by step, brings them."""
    actor, critic = networks(seed)
    generator = torch.Generator().manual_seed(seed + 1)
    batches = [tools.random_batch(generator, 16, OBS, ACT) for _ in range(updates)]

    def after(steps: tools.Steps | None) -> dict[str, Tensor]:
        agent = tools.Agent(copy.deepcopy(actor), copy.deepcopy(critic), **RATES, steps=steps)
        for batch in batches:
            agent.update(batch)
        return {name: flat(getattr(agent, name)) for name in PARTS}

    agent = cls(copy.deepcopy(actor), copy.deepcopy(critic), **RATES)
    for name in PARTS:
        expect(isinstance(getattr(agent, name, None), nn.Module), f"the agent has no network called `{name}`",
               expected=f"attributes {', '.join(PARTS)}")  # fmt: skip
    for batch in batches:
        agent.update(batch)
    expected = after(None)
    found = {name: flat(getattr(agent, name)) for name in PARTS}
    if all(close(found[name], expected[name]) for name in PARTS):
        return
    hint = ""
    for key, steps in VARIANTS:
        wrong = after(steps)
        if all(close(found[name], wrong[name]) for name in PARTS):
            hint = key
            break
    where = next(name for name in PARTS if not close(found[name], expected[name]))
    change = float((found[where] - expected[where]).abs().max())
    fail(
        f"after {updates} update{'s' if updates > 1 else ''}, {where} is not where it should be",
        given=f"random networks and batches; {', '.join(f'{k}={v:g}' for k, v in RATES.items())}",
        got=f"a parameter of {where} that is off by {change:.2g}",
        expected="the same as after: critic step, actor step with the new critic, soft update of both targets",
        hint=hint or "four-steps",
    )


def flat(network: nn.Module) -> Tensor:
    """Return all parameters as one vector."""
    return torch.cat([p.detach().ravel() for p in network.parameters()]).clone()


def close(a: Tensor, b: Tensor) -> bool:
    """Whether two networks are equal but for rounding, which Adam enlarges where a gradient is nearly 0."""
    return a.shape == b.shape and float(((a - b).abs() > 3e-5).float().mean()) < 0.02


def compare_agent_acts(cls: Any) -> None:
    """The agent adds noise if it explores, and only then."""
    agent = cls(Fixed(ACT), tools.SmallCritic(OBS, ACT), **RATES)
    obs = np.zeros((200, OBS), dtype=np.float32)
    greedy = np.asarray(agent.act(obs), dtype=float)
    expect_close(greedy, np.zeros((200, ACT)), atol=1e-6, what="act(obs)", hint="no-noise-when-it-counts")
    noisy = np.asarray(agent.act(obs, explore=True), dtype=float)
    spread = float(noisy.std())
    expect(spread > 0, "act(obs, explore=True) adds no noise", hint="noise-to-explore")
    # 400 Gaussian numbers: their standard deviation is within 25 % but for a probability of about 1e-12.
    near = 0.75 < spread / RATES["noise_std"] < 1.25
    expect(near, "act(obs, explore=True) adds noise of another size than noise_std",
           got=round(spread, 3), expected=RATES["noise_std"], hint="noise-to-explore")  # fmt: skip


def compare_targets_wait(cls: Any) -> None:
    """The targets begin as copies, and nobody but the soft update moves them."""
    actor, critic = networks(31)
    agent = cls(actor, critic, **RATES)
    for name in ("actor", "critic"):
        online, target = getattr(agent, name), getattr(agent, f"{name}_target")
        expect(close(flat(online), flat(target)), f"{name}_target does not begin as a copy of {name}",
               hint="targets-are-copies")  # fmt: skip
        shared = {p.data_ptr() for p in online.parameters()} & {p.data_ptr() for p in target.parameters()}
        expect(not shared, f"{name}_target is {name} itself: the target moves with every step of the optimiser",
               hint="targets-are-copies")  # fmt: skip


def compare_learns(cls: Any, rng: np.random.Generator, updates: int = 900) -> None:
    """On a linear-quadratic problem with one state, policy and Q come out as the Riccati equation has them."""
    problem = tools.CART
    actor, critic = tools.LinearActor([[0.0]]), tools.QuadraticCritic(np.eye(2))
    agent = cls(actor, critic, gamma=0.9, tau=0.1, actor_lr=1e-2, critic_lr=3e-2, noise_std=0.1)
    data = problem.batch(rng, 32 * 60)
    for k in range(updates):
        rows = slice(32 * (k % 60), 32 * (k % 60) + 32)
        agent.update(Batch(*(part[rows] for part in data)))
    gain = float(agent.actor.gain.detach()[0, 0])
    given = f"{updates} updates on x' = 0.9 x + 0.5 u, reward -(x^2 + 0.3 u^2), gamma = 0.9"
    expect_close(
        gain, float(problem.gain[0, 0]), atol=0.06, given=given, hint="bellman", what="the learned gain K of u = -K x"
    )
    weights = agent.critic.hessian.detach().numpy()
    weights = (weights + weights.T) / 2
    expect_close(
        weights, problem.hessian, atol=0.05, rtol=0.06, given=given, hint="bellman", what="the learned Q, -z' H z: H"
    )


__all__ = [name for name in dir() if name.startswith("compare_")] + ["HAND_ACTOR", "CheckFailure", "HandCritic"]

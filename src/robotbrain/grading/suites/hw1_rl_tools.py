"""What the tests of `hw1_rl` share: a control problem with a closed form, and our own answers.

The answers (``td_target`` and its kin) stand in for a part of the student's that is not right yet, so that what builds
on it can still be graded; they are also what the student's parts are compared with.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.linalg import solve_discrete_are
from torch import Tensor

from robotbrain.grading import expect, fail
from robotbrain.grading.suites.hw1_rl_probes import Batch

torch.optim.Adam([torch.zeros(1, requires_grad=True)])  # the first optimiser loads for seconds: now, not in a check

Array = NDArray[np.float64]

FALSE_ALARM = 1e-6
"""How often a test of random numbers may fail an answer that is right, if its generator cannot be seeded from here."""


def torch_rng(rng: np.random.Generator) -> torch.Generator:
    """Return a torch generator seeded by a NumPy one."""
    return torch.Generator().manual_seed(int(rng.integers(2**62)))


def as_tensor(
    answer: Any, what: str, shape: tuple[int, ...], hints: Sequence[tuple[tuple[int, ...], str]] = ()
) -> Tensor:
    """Return the student's answer if it is a tensor of this shape, or fail and say what it is.

    Args:
        what: the answer in the student's words.
        shape: wanted.
        hints: (wrong shape, key of the hint) pairs.
    """
    if not isinstance(answer, Tensor):
        fail(f"{what} should be a torch tensor", got=answer,
             expected=f"a tensor of shape {shape}")  # fmt: skip
    if tuple(answer.shape) != shape:
        hint = next((key for wrong, key in hints if tuple(answer.shape) == wrong), "shape-of-a-batch")
        fail(f"{what} has shape {tuple(answer.shape)}, but shape {shape} is expected", got=tuple(answer.shape),
             expected=shape, hint=hint)  # fmt: skip
    expect(
        answer.dtype.is_floating_point,
        f"{what} should hold floating-point numbers",
        got=str(answer.dtype),
        expected="a floating-point dtype, for example torch.float32",
    )
    tensor: Tensor = answer.detach()
    return tensor


def first_match(answer: Tensor, mistakes: Sequence[tuple[str, Tensor]], expected: Tensor) -> str:
    """Return the hint of the first mistake that gives ``answer`` and not ``expected``, or ''."""
    for hint, wrong in mistakes:
        if wrong.shape != answer.shape or (wrong.shape == expected.shape and torch.allclose(wrong, expected)):
            continue
        if torch.allclose(answer.detach().to(wrong.dtype), wrong, rtol=1e-4, atol=1e-6):
            return hint
    return ""


# ---------------------------------------------------------------- a problem with a closed form


@dataclass(frozen=True)
class LinearQuadratic:
    """``x' = A x + B u`` with reward ``-(x' S x + u' R u)``, discounted: its best policy and values are known exactly.

    Source: the discounted Riccati equation, e.g. Bertsekas, *Dynamic Programming and Optimal Control*, vol. 1, ch. 3.
    """

    a: Array
    b: Array
    s: Array
    r: Array
    gamma: float

    @cached_property
    def cost_to_go(self) -> Array:
        """P: the optimal value of x is ``-x' P x``."""
        root = np.sqrt(self.gamma)
        return np.asarray(solve_discrete_are(root * self.a, root * self.b, self.s, self.r))

    @cached_property
    def gain(self) -> Array:
        """K: the optimal action is ``-K x``."""
        p = self.cost_to_go
        return np.asarray(
            np.linalg.solve(self.r + self.gamma * self.b.T @ p @ self.b, self.gamma * self.b.T @ p @ self.a)
        )

    @cached_property
    def hessian(self) -> Array:
        """H: the optimal Q of z = (x, u) is ``-z' H z``."""
        ab = np.hstack([self.a, self.b])
        zeros = np.zeros((len(self.s), len(self.r)))
        return np.block([[self.s, zeros], [zeros.T, self.r]]) + self.gamma * ab.T @ self.cost_to_go @ ab

    def batch(self, rng: np.random.Generator, size: int) -> Batch:
        """Return transitions from states and actions drawn uniformly from [-1, 1]."""
        x, u = rng.uniform(-1, 1, (size, len(self.s))), rng.uniform(-1, 1, (size, len(self.r)))
        reward = -np.einsum("bi,ij,bj->b", x, self.s, x) - np.einsum("bi,ij,bj->b", u, self.r, u)
        parts = (x, u, reward, x @ self.a.T + u @ self.b.T, np.zeros(size))
        return Batch(*(torch.as_tensor(part, dtype=torch.float32) for part in parts))


def random_batch(generator: torch.Generator, size: int, obs_dim: int, act_dim: int, ended: float = 0.3) -> Batch:
    """Return transitions without meaning; a share ``ended`` of them is terminated."""
    return Batch(
        torch.randn(size, obs_dim, generator=generator),
        torch.rand(size, act_dim, generator=generator) * 2 - 1,
        torch.randn(size, generator=generator),
        torch.randn(size, obs_dim, generator=generator),
        (torch.rand(size, generator=generator) < ended).float(),
    )


# ---------------------------------------------------------------- our own answers


def td_target(batch: Any, actor_target: Any, critic_target: Any, gamma: float) -> Tensor:
    """Return r + gamma (1 - terminated) Q'(s', pi'(s')), (B,)."""
    with torch.no_grad():
        next_value = critic_target(batch.next_obs, actor_target(batch.next_obs)).squeeze(-1)
        return batch.reward + gamma * (1.0 - batch.terminated) * next_value  # type: ignore[no-any-return]


def critic_loss(critic: Any, batch: Any, target: Tensor) -> Tensor:
    """Return the mean squared error of Q(s, a)."""
    return ((critic(batch.obs, batch.action).squeeze(-1) - target) ** 2).mean()  # type: ignore[no-any-return]


def actor_loss(actor: Any, critic: Any, batch: Any) -> Tensor:
    """Return -mean Q(s, pi(s)), whose gradient reaches the actor only."""
    before = [(parameter, parameter.requires_grad) for parameter in critic.parameters()]
    for parameter, _ in before:
        parameter.requires_grad_(False)
    loss = -critic(batch.obs, actor(batch.obs)).mean()
    for parameter, wanted in before:
        parameter.requires_grad_(wanted)
    return loss  # type: ignore[no-any-return]


@torch.no_grad()
def soft_update(target: Any, online: Any, tau: float) -> None:
    """Move target's parameters by the share tau towards online's."""
    for slow, fast in zip(target.parameters(), online.parameters(), strict=True):
        slow.lerp_(fast, tau)


def select_action(actor: Any, obs: Any, std: float = 0.0, low: float = -1.0, high: float = 1.0) -> Any:
    """Return the actor's actions (N, A) as NumPy array, with Gaussian noise, within the bounds."""
    with torch.no_grad():
        action = actor(torch.as_tensor(np.asarray(obs), dtype=torch.float32))
        if std > 0:
            action = action + std * torch.randn_like(action)
        return action.clamp(low, high).numpy()


@dataclass
class Steps:
    """The order of an update and what it works with; each change is a mistake that students make."""

    actor_first: bool = False
    targets_first: bool = False
    follow: tuple[str, ...] = ("actor", "critic")  # whose targets move
    copies: bool = True  # targets are networks of their own
    online_targets: bool = False  # the target is computed from the online networks
    swap_rates: bool = False
    zero_grad: bool = True


class Agent:
    """DDPG on given networks, as the homework asks for it, or with one of the mistakes in ``steps``."""

    def __init__(
        self,
        actor: Any,
        critic: Any,
        gamma: float = 0.9,
        tau: float = 0.01,
        actor_lr: float = 1e-3,
        critic_lr: float = 1e-3,
        noise_std: float = 0.1,
        steps: Steps | None = None,
    ) -> None:
        self.actor, self.critic, self.gamma, self.tau, self.noise_std = actor, critic, gamma, tau, noise_std
        self.steps = steps or Steps()
        self.actor_target = copy.deepcopy(actor) if self.steps.copies else actor
        self.critic_target = copy.deepcopy(critic) if self.steps.copies else critic
        rates = (critic_lr, actor_lr) if self.steps.swap_rates else (actor_lr, critic_lr)
        self.actor_optimizer = torch.optim.Adam(actor.parameters(), lr=rates[0])
        self.critic_optimizer = torch.optim.Adam(critic.parameters(), lr=rates[1])

    def act(self, obs: Any, explore: bool = False) -> Any:
        """Return actions (N, A), with noise only if ``explore``."""
        return select_action(self.actor, obs, self.noise_std if explore else 0.0)

    def update(self, batch: Any) -> tuple[float, float]:
        """Make one step of the critic, one of the actor, and let the targets follow; return both losses."""
        if self.steps.targets_first:
            self._follow()
        if self.steps.actor_first:
            second = self._step_actor(batch)
            first = self._step_critic(batch)
        else:
            first = self._step_critic(batch)
            second = self._step_actor(batch)
        if not self.steps.targets_first:
            self._follow()
        return first, second

    def _step_critic(self, batch: Any) -> float:
        slow = (self.actor, self.critic) if self.steps.online_targets else (self.actor_target, self.critic_target)
        loss = critic_loss(self.critic, batch, td_target(batch, *slow, self.gamma))
        return self._descend(self.critic_optimizer, loss)

    def _step_actor(self, batch: Any) -> float:
        return self._descend(self.actor_optimizer, actor_loss(self.actor, self.critic, batch))

    def _descend(self, optimizer: torch.optim.Optimizer, loss: Tensor) -> float:
        if self.steps.zero_grad:
            optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
        return loss.item()

    def _follow(self) -> None:
        for name in self.steps.follow:
            soft_update(getattr(self, f"{name}_target"), getattr(self, name), self.tau)

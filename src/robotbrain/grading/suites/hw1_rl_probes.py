"""What the tests of `hw1_rl` do where the student's objects live, which while grading is not the tests' process.

A probe makes networks and buffers of plain arrays, lets the student's code work on them, and returns what became of
them as plain arrays again. It knows inputs only: what is right is computed by the test, in a process of its own.
"""

from __future__ import annotations

import contextlib
import random
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

NetworkSpec = tuple[str, Sequence[Tensor]]
"""A network as data: the name of its class here, and its parameters."""


class Batch(NamedTuple):
    """Transitions, batch first: (B, O), (B, A), (B,), (B, O), (B,), float32."""

    obs: Tensor
    action: Tensor
    reward: Tensor
    next_obs: Tensor
    terminated: Tensor


@contextlib.contextmanager
def seeded(seed: int) -> Iterator[None]:
    """Seed every global generator that a student may draw from, and put their states back."""
    python, numbers = random.getstate(), np.random.get_state()  # noqa: NPY002 - a student may use it
    with torch.random.fork_rng(devices=[]):
        random.seed(seed)
        np.random.seed(seed)  # noqa: NPY002
        torch.manual_seed(seed)
        try:
            yield
        finally:
            random.setstate(python)
            np.random.set_state(numbers)  # noqa: NPY002


# ---------------------------------------------------------------- networks


class _Dense(nn.Module):
    """A dense layer with given numbers: ``nn.Linear`` would draw some first, and move the student's generator."""

    def __init__(self, weight: Tensor, bias: Tensor) -> None:
        super().__init__()
        self.weight, self.bias = nn.Parameter(weight.clone()), nn.Parameter(bias.clone())

    def forward(self, x: Tensor) -> Tensor:
        """Return W x + b."""
        return functional.linear(x, self.weight, self.bias)


class _Layers(nn.Module):
    """Two dense layers with a tanh between them; smooth, so that its slopes say something."""

    def __init__(self, *values: Tensor) -> None:
        super().__init__()
        self.layers = nn.Sequential(_Dense(*values[:2]), nn.Tanh(), _Dense(*values[2:]))


class SmallActor(_Layers):
    """A policy into (-1, 1)."""

    def forward(self, obs: Tensor) -> Tensor:
        """Return the actions (B, A)."""
        return torch.tanh(self.layers(obs))


class SmallCritic(_Layers):
    """A value of (obs, action), (B, 1) as the homework's own."""

    def forward(self, obs: Tensor, action: Tensor) -> Tensor:
        """Return the values (B, 1)."""
        return self.layers(torch.cat([obs, action], dim=-1))  # type: ignore[no-any-return]


class LinearActor(nn.Module):
    """The policy ``u = -K x``; ``gain`` is K (A, O)."""

    def __init__(self, gain: Any) -> None:
        super().__init__()
        self.gain = nn.Parameter(torch.as_tensor(np.asarray(gain), dtype=torch.float32).clone())

    def forward(self, obs: Tensor) -> Tensor:
        """Return the actions (B, A)."""
        return -obs @ self.gain.T


class QuadraticCritic(nn.Module):
    """The value ``-z' H z`` of ``z = (x, u)``; H (O + A, O + A), of which only the symmetric part matters."""

    def __init__(self, hessian: Any) -> None:
        super().__init__()
        self.hessian = nn.Parameter(torch.as_tensor(np.asarray(hessian), dtype=torch.float32).clone())

    def forward(self, obs: Tensor, action: Tensor) -> Tensor:
        """Return the values (B, 1)."""
        z = torch.cat([obs, action], dim=-1)
        return -((z @ self.hessian) * z).sum(dim=-1, keepdim=True)


class LinearCritic(nn.Module):
    """The value ``w' (obs, action)``, (B, 1); ``weight`` is w (O + A, 1)."""

    def __init__(self, weight: Tensor) -> None:
        super().__init__()
        self.weight = nn.Parameter(weight.clone())

    def forward(self, obs: Tensor, action: Tensor) -> Tensor:
        """Return the values (B, 1)."""
        return torch.cat([obs, action], dim=-1) @ self.weight


class Fixed(nn.Module):
    """An actor whose actions are the first columns of the observation, times its only parameter, (A,)."""

    def __init__(self, scale: Tensor) -> None:
        super().__init__()
        self.scale = nn.Parameter(scale.clone())

    def forward(self, obs: Tensor) -> Tensor:
        """Return the actions."""
        return obs[..., : len(self.scale)] * self.scale


_KINDS = {kind.__name__: kind for kind in (SmallActor, SmallCritic, LinearActor, QuadraticCritic, LinearCritic, Fixed)}


def spec_of(network: nn.Module) -> NetworkSpec:
    """Return a network as data."""
    return type(network).__name__, [parameter.detach().clone() for parameter in network.parameters()]


def build(spec: NetworkSpec) -> Any:
    """Return a network of its own, made of data."""
    name, values = spec
    return _KINDS[name](*values)


def values_of(network: Any) -> list[Tensor]:
    """Return copies of a network's parameters."""
    return [parameter.detach().clone() for parameter in network.parameters()]


def _gradients(network: nn.Module) -> list[Tensor | None]:
    return [None if p.grad is None else p.grad.clone() for p in network.parameters()]


def _learnable(network: nn.Module) -> list[bool]:
    return [parameter.requires_grad for parameter in network.parameters()]


def _batch(parts: Sequence[Tensor]) -> Batch:
    return Batch(*(part.clone() for part in parts))


# ---------------------------------------------------------------- memory

Block = Sequence[NDArray[Any]]
"""Transitions as arrays: obs, action, reward, next_obs, terminated."""


class Recorder:
    """A buffer that keeps what it is given."""

    def __init__(self) -> None:
        self.calls: list[list[Any]] = []

    def add(self, obs: Any, action: Any, reward: Any, next_obs: Any, terminated: Any) -> None:
        """Keep copies."""
        self.calls.append([np.array(value, dtype=float) for value in (obs, action, reward, next_obs, terminated)])


def _make(student: Any, blocks: Sequence[Block], capacity: int) -> tuple[Any, list[int]]:
    """Return a buffer that was given copies of ``blocks``, and its length after each of them."""
    buffer = student.ReplayBuffer(capacity, blocks[0][0].shape[1], blocks[0][1].shape[1])
    lengths = []
    for block in blocks:
        buffer.add(*(field.copy() for field in block))
        lengths.append(len(buffer))
    return buffer, lengths


def _fields(batch: Any) -> Any:
    """Return a batch's fields as they are, or the name of its type where it is no batch."""
    if not all(hasattr(batch, name) for name in Batch._fields):
        return type(batch).__name__
    return [getattr(batch, name) for name in Batch._fields]


def _kept(batches: Sequence[Any]) -> list[Any]:
    """Return the fields of each batch; of tensors, as they are now."""
    return [
        [part.detach().clone() if isinstance(part, Tensor) else part for part in fields]
        if isinstance(fields, list)
        else fields
        for fields in map(_fields, batches)
    ]


def _stacked(batches: Sequence[Any]) -> Any:
    """Return one tensor (batches, size, ...) for each field if that can be done, else the fields of the first batch."""
    try:
        return [torch.stack(field) for field in zip(*batches, strict=True)]
    except (TypeError, RuntimeError, ValueError):
        return batches[0]


def drawn(student: Any, capacity: int, blocks: Sequence[Block], size: int, times: int, seed: int) -> tuple[Any, Any]:
    """Fill a buffer and draw from it; return its lengths on the way, and the batches."""
    with seeded(seed):
        buffer, lengths = _make(student, blocks, capacity)
        if not all(isinstance(length, int) for length in lengths):
            return lengths, None
        return lengths, _stacked([_kept([buffer.sample(size)])[0] for _ in range(times)])


def overwritten(student: Any, capacity: int, first: Block, later: Block, size: int, seed: int) -> dict[str, Any]:
    """Write into what a buffer was given and into what it gave.

    Returns:
        "written": what is drawn after the caller wrote -7 into its own arrays; "stale": the same batches after more
        was stored and drawn; "returned": what is drawn after -7 was written into batches.
    """
    with seeded(seed):
        mine = [field.copy() for field in first]
        buffer, _ = _make(student, [first], capacity)
        other = student.ReplayBuffer(capacity, first[0].shape[1], first[1].shape[1])
        other.add(*mine)
        for field in mine:
            field[...] = -7  # as an environment does that reuses its arrays
        written = _kept([other.sample(size) for _ in range(4)])
        batches = [buffer.sample(size) for _ in range(4)]
        before = _kept(batches)
        buffer.add(*(field.copy() for field in later))
        buffer.sample(size)
        after = _kept(batches)
        for _ in range(4):
            for part in _fields(buffer.sample(size)):
                part.fill_(-7.0)
        returned = _kept([buffer.sample(size) for _ in range(8)])
    return {"written": written, "before": before, "after": after, "returned": returned}


STEP = ("obs", "action", "next_obs", "reward", "terminated", "truncated")
"""The arrays among the arguments of ``store_step``, in their order."""


def stored(student: Any, steps: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return, for each step of an environment, what ``store_step`` added, and what the loop's own arrays became."""
    found = []
    for step in steps:
        recorder = Recorder()
        arrays = {name: step[name].copy() for name in STEP}
        info = {name: value.copy() for name, value in step["info"].items()}
        student.store_step(recorder, *arrays.values(), info)
        found.append({"calls": recorder.calls, "after": arrays})
    return found


# ---------------------------------------------------------------- learning


def target(
    student: Any, batch: Sequence[Tensor], actor: NetworkSpec, critic: NetworkSpec, gamma: float
) -> dict[str, Any]:
    """Return the student's target, whether it carries a gradient, and which parameters can still learn."""
    networks = build(actor), build(critic)
    answer = student.td_target(_batch(batch), *networks, gamma)
    return {
        "target": answer,
        "gradient": bool(getattr(answer, "requires_grad", False)),
        "learnable": [_learnable(network) for network in networks],
    }


def critic_loss(student: Any, critic: NetworkSpec, batch: Sequence[Tensor], wanted: Tensor) -> dict[str, Any]:
    """Return the critic's loss and, where it has any, the gradients that it leaves in the critic."""
    network = build(critic)
    loss = student.critic_loss(network, _batch(batch), wanted.clone())
    return {"loss": loss, "gradients": _slopes(loss, network)}


def actor_loss(
    student: Any,
    actor: NetworkSpec,
    critic: NetworkSpec,
    batch: Sequence[Tensor],
    marker: float | None = None,
    frozen: int = 0,
) -> dict[str, Any]:
    """Return the actor's loss, the gradients that it leaves in both networks, and which parameters can still learn.

    Args:
        marker: the gradient that the critic's parameters have before.
        frozen: so many parameters of the critic are frozen before.
    """
    policy, judge = build(actor), build(critic)
    for k, parameter in enumerate(judge.parameters()):
        parameter.requires_grad_(k >= frozen)
        parameter.grad = None if marker is None else torch.full_like(parameter, marker)
    loss = student.actor_loss(policy, judge, _batch(batch))
    learnable = _learnable(judge)
    gradients = _slopes(loss, policy)
    return {"loss": loss, "gradients": gradients, "critic": _gradients(judge), "learnable": learnable}


def _slopes(loss: Any, network: nn.Module) -> list[Tensor | None] | None:
    """Return what ``loss.backward()`` leaves in ``network``, or None where nothing leads back."""
    if not isinstance(loss, Tensor) or not loss.requires_grad or loss.dim():
        return None
    loss.backward()  # type: ignore[no-untyped-call]
    return _gradients(network)


def followed(student: Any, slow: NetworkSpec, fast: NetworkSpec, tau: float, times: int) -> dict[str, Any]:
    """Let one network follow another; return both, and the follower after the other has moved on."""
    target, online = build(slow), build(fast)
    leaves = list(target.parameters())
    for _ in range(times):
        student.soft_update(target, online, tau)
    kept = all(a is b for a, b in zip(target.parameters(), leaves, strict=True)) and all(p.is_leaf for p in leaves)
    found = {"kept": kept, "target": values_of(target), "online": values_of(online)}
    with torch.no_grad():
        for parameter in online.parameters():
            parameter.add_(1.0)
    return found | {"later": values_of(target)}


def actions(
    student: Any, actor: NetworkSpec, obs: NDArray[Any], times: int, seed: int, settings: Mapping[str, Any]
) -> Any:
    """Return the student's actions of several calls: one array (times, N, A), or, where they are none, the answers."""
    policy = build(actor)
    with seeded(seed):
        answers = [student.select_action(policy, obs.copy(), **settings) for _ in range(times)]
    if all(type(answer) is np.ndarray and answer.shape == answers[0].shape for answer in answers):
        return np.stack(answers)
    return answers[:1]


# ---------------------------------------------------------------- the agent

PARTS = ("critic", "actor", "critic_target", "actor_target")
"""The agent's networks."""


def _agent(student: Any, actor: NetworkSpec, critic: NetworkSpec, settings: Mapping[str, float]) -> Any:
    return student.DDPG(build(actor), build(critic), **settings)


def updated(
    student: Any,
    actor: NetworkSpec,
    critic: NetworkSpec,
    settings: Mapping[str, float],
    batches: Sequence[Sequence[Tensor]],
) -> dict[str, Any]:
    """Return the agent's networks after an update with each batch, or the names of those that it has not."""
    agent = _agent(student, actor, critic, settings)
    missing = [name for name in PARTS if not isinstance(getattr(agent, name, None), nn.Module)]
    if missing:
        return {"missing": missing}
    for batch in batches:
        agent.update(_batch(batch))
    return {name: values_of(getattr(agent, name)) for name in PARTS}


def begun(student: Any, actor: NetworkSpec, critic: NetworkSpec, settings: Mapping[str, float]) -> dict[str, Any]:
    """Return a new agent's networks, and its target networks after the others have moved."""
    agent = _agent(student, actor, critic, settings)
    found = {name: values_of(getattr(agent, name)) for name in PARTS}
    with torch.no_grad():
        for name in PARTS[:2]:
            for parameter in getattr(agent, name).parameters():
                parameter.add_(1.0)
    return found | {f"{name} later": values_of(getattr(agent, name)) for name in PARTS[2:]}


def acted(
    student: Any,
    actor: NetworkSpec,
    critic: NetworkSpec,
    settings: Mapping[str, float],
    obs: NDArray[Any],
    seed: int,
) -> dict[str, Any]:
    """Return the agent's actions without and with exploration."""
    agent = _agent(student, actor, critic, settings)
    with seeded(seed):
        return {"greedy": agent.act(obs.copy()), "explored": agent.act(obs.copy(), explore=True)}


# ---------------------------------------------------------------- randomisation


def randomised(student: Any) -> dict[str, Any]:
    """Return what `randomise` makes of the reach task, as plain values: the configuration, and its events."""
    from robotbrain.rl.gap_variants import reach_cfg

    cfg = reach_cfg()
    changed = student.randomise(cfg)
    cfg = cfg if changed is None else changed
    return {"cfg": cfg.to_dict(), "events": events_of(cfg)}


def events_of(cfg: Any) -> dict[str, Any]:
    """Return a configuration's events as plain values, whether they are fields of their class or were added."""
    return {name: term.to_dict() for name, term in vars(cfg.events).items() if term is not None}

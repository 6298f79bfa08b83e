"""Replay memory: the last transitions of all environments, one row each, sampled uniformly."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from robotbrain.errors import InputError


class Batch(NamedTuple):
    """Transitions, batch first. Rewards and flags are ``(B,)``; nothing broadcasts by accident."""

    obs: Tensor  #: (B, obs_dim) what the policy saw
    action: Tensor  #: (B, act_dim) what was done, in [-1, 1]
    reward: Tensor  #: (B,)
    next_obs: Tensor  #: (B, obs_dim) what it led to; at the end of an episode its *final* observation
    terminated: Tensor  #: (B,) 1.0 where no future follows; 0.0 for a time limit (truncation)


class ReplayBuffer:
    """A ring of ``capacity`` transitions in one preallocated table.

    A row is ``[obs | action | reward | terminated | next_obs]``. One table means that a batch is one gather, and a
    transition can never be put together from parts of two.

    Args:
        capacity: rows kept; the oldest are overwritten.
        obs_dim: numbers in an observation.
        act_dim: numbers in an action.
    """

    def __init__(self, capacity: int, obs_dim: int, act_dim: int) -> None:
        for name, value in (("capacity", capacity), ("obs_dim", obs_dim), ("act_dim", act_dim)):
            if value < 1:
                raise InputError(name, given=value, expected="an integer >= 1", fix="Use a positive size.")
        self.capacity, self.obs_dim, self.act_dim = capacity, obs_dim, act_dim
        self._widths = (obs_dim, act_dim, 1, 1, obs_dim)
        self._rows = torch.zeros(capacity, sum(self._widths))
        self._size = 0
        self._next = 0  # the row that is written next: the oldest one once the table is full

    def __len__(self) -> int:
        return self._size

    def add(
        self, obs: ArrayLike, action: ArrayLike, reward: ArrayLike, next_obs: ArrayLike, terminated: ArrayLike
    ) -> None:
        """Store ``n`` transitions: obs and next_obs (n, obs_dim), action (n, act_dim), reward and terminated (n,).

        ``terminated`` is the environment's *terminated* alone. An episode cut by its time limit is stored as 0, since
        the robot's future goes on and its value must be bootstrapped from ``next_obs``, the final observation.
        """
        n = len(np.asarray(reward))
        columns = []
        for name, value, width in zip(
            ("obs", "action", "reward", "terminated", "next_obs"),
            (obs, action, reward, terminated, next_obs),
            self._widths,
            strict=True,
        ):
            column = np.asarray(value, dtype=np.float32)
            shape = (n,) if name in ("reward", "terminated") else (n, width)
            if column.shape != shape:
                raise InputError(
                    f"ReplayBuffer.add: {name}",
                    given=column.shape,
                    expected=f"shape {shape}",
                    fix="Pass one row per environment.",
                )
            columns.append(column.reshape(n, width))
        if n > self.capacity:
            raise InputError(
                "ReplayBuffer.add",
                given=f"{n} transitions",
                expected=f"at most the capacity, {self.capacity}",
                fix="Make the buffer larger than the number of environments.",
            )
        rows = torch.from_numpy(np.concatenate(columns, axis=1))
        head = min(n, self.capacity - self._next)  # rows before the end of the table; the rest wraps to its start
        self._rows[self._next : self._next + head] = rows[:head]
        self._rows[: n - head] = rows[head:]
        self._next = (self._next + n) % self.capacity
        self._size = min(self._size + n, self.capacity)

    def sample(self, batch_size: int, generator: torch.Generator) -> Batch:
        """Draw ``batch_size`` transitions uniformly, with replacement, from those stored."""
        if self._size == 0:
            raise InputError(
                "ReplayBuffer.sample", given="an empty buffer", expected="stored transitions", fix="Call add() first."
            )
        index = torch.randint(self._size, (batch_size,), generator=generator)
        obs, action, reward, terminated, next_obs = torch.split_with_sizes(
            self._rows.index_select(0, index), self._widths, dim=1
        )
        return Batch(obs, action, reward.squeeze(1), next_obs, terminated.squeeze(1))

    def state_dict(self) -> dict[str, Any]:
        """The stored rows and the place of the next one: all that later samples depend on."""
        return {"rows": self._rows[: self._size].clone(), "next": self._next, "capacity": self.capacity}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go back to a state that `state_dict` returned."""
        rows = state["rows"]
        if state["capacity"] != self.capacity or rows.shape[1] != sum(self._widths):
            raise InputError(
                "saved replay buffer",
                given=f"capacity {state['capacity']}, rows of {rows.shape[1]} numbers",
                expected=f"capacity {self.capacity}, rows of {sum(self._widths)} numbers",
                fix="Resume with the environment and the configuration that the checkpoint was made with.",
            )
        self._size, self._next = len(rows), int(state["next"])
        self._rows[: self._size] = rows

"""What an action term does about latency: which of the past commands reaches the joints at a physics step."""

from __future__ import annotations

from typing import Any

import torch


class CommandDelay:
    """Past commands of each environment, and its latency in physics steps.

    A command that is given every ``decimation`` physics steps and arrives ``latency`` physics steps late is in effect
    at sub-step ``s`` of a control step if it was given ``ceil((latency - s) / decimation)`` control steps ago. Before
    enough commands were given, the oldest there is counts; none from an earlier episode.
    """

    def __init__(self, num_envs: int, decimation: int, device: Any) -> None:
        self._decimation = decimation
        self.latency = torch.zeros(num_envs, dtype=torch.long, device=device)
        self._given = torch.zeros_like(self.latency)
        self._past: torch.Tensor | None = None  # (commands, num_envs, dim), the newest first
        self._rows = torch.arange(num_envs, device=device)
        self._substep = 0
        self._most = 0

    def set(self, env_ids: Any, physics_steps: torch.Tensor, most: int) -> None:
        """Give these environments a latency, (n,) whole physics steps from 0 to ``most``."""
        self.latency[env_ids] = physics_steps
        self._most = max(self._most, most)

    def push(self, command: torch.Tensor) -> None:
        """A new command, (num_envs, dim); once per control step."""
        self._substep = 0
        self._given += 1
        depth = 1 - (-self._most // self._decimation)
        if depth == 1 and self._past is not None and len(self._past) == 1:
            self._past.copy_(command)
        elif self._past is None or len(self._past) != depth:
            self._past = command.expand(depth, -1, -1).clone()
        else:
            self._past = torch.cat([command.unsqueeze(0), self._past[:-1]])

    def now(self) -> torch.Tensor:
        """The command in effect at this physics step, (num_envs, dim); once per physics step."""
        assert self._past is not None, "no command was given yet"
        if self._most == 0:
            return self._past[0]
        late = (self.latency - self._substep).clamp(min=0)
        age = torch.div(late + self._decimation - 1, self._decimation, rounding_mode="floor")
        self._substep += 1
        return self._past[torch.minimum(age, self._given - 1), self._rows]

    def reset(self, env_ids: Any) -> None:
        """Forget the commands of these environments."""
        self._given[env_ids] = 0

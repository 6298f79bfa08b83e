"""Exploration noise that is added to a deterministic policy's actions. Actions are scaled to [-1, 1]."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from robotbrain.errors import InputError


class GaussianNoise:
    """Independent normal noise; enough for most tasks.

    Args:
        act_dim: numbers in an action.
        std: standard deviation, as a fraction of half the action range.
        generator: source of all draws.
    """

    def __init__(self, act_dim: int, std: float, generator: torch.Generator) -> None:
        _check("std", std, std >= 0, "a number >= 0")
        self.act_dim, self.std, self.generator = act_dim, std, generator

    def sample(self, num_envs: int) -> NDArray[np.float32]:
        """Draw noise (num_envs, act_dim)."""
        draw: NDArray[np.float32] = torch.randn(num_envs, self.act_dim, generator=self.generator).numpy()
        return draw * np.float32(self.std)

    def reset(self, ended: NDArray[np.bool_]) -> None:
        """Start anew where an episode ended: nothing to do, this noise has no memory."""

    def state_dict(self) -> dict[str, Any]:
        """All that later draws depend on."""
        return {"generator": self.generator.get_state()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go back to a state that `state_dict` returned."""
        self.generator.set_state(state["generator"])


class OrnsteinUhlenbeckNoise(GaussianNoise):
    """Noise that wanders and is pulled back to zero, ``dx = -theta x dt + sigma dW`` (Uhlenbeck and Ornstein, 1930).

    Neighbouring steps are alike, which pushes a sluggish robot further than independent noise of the same size does.
    The step is the exact solution over ``dt``, so the long-run standard deviation is ``sigma / sqrt(2 theta)`` for any
    ``dt``. Each environment has a state of its own, zero at the start of an episode.

    Args:
        act_dim: numbers in an action.
        sigma: strength of the random push, in action units per square root of a second.
        theta: pull towards zero, 1/s.
        dt: duration of a control step, s.
        generator: source of all draws.
    """

    def __init__(self, act_dim: int, sigma: float, theta: float, dt: float, generator: torch.Generator) -> None:
        _check("sigma", sigma, sigma >= 0, "a number >= 0")
        _check("theta", theta, theta > 0, "a number > 0 (1/s)")
        _check("dt", dt, dt > 0, "a number > 0 (s)")
        self._keep = math.exp(-theta * dt)
        super().__init__(act_dim, sigma * math.sqrt((1.0 - self._keep**2) / (2.0 * theta)), generator)
        self._state: NDArray[np.float32] = np.zeros((0, act_dim), np.float32)

    def sample(self, num_envs: int) -> NDArray[np.float32]:
        """Advance by one step and return the noise (num_envs, act_dim)."""
        if len(self._state) != num_envs:
            self._state = np.zeros((num_envs, self.act_dim), np.float32)
        self._state = np.float32(self._keep) * self._state + super().sample(num_envs)
        return self._state.copy()

    def reset(self, ended: NDArray[np.bool_]) -> None:
        """Go back to zero in the environments whose episode ended (num_envs,)."""
        if len(self._state) == len(ended):
            self._state[ended] = 0.0

    def state_dict(self) -> dict[str, Any]:
        """All that later draws depend on."""
        return super().state_dict() | {"state": torch.from_numpy(self._state.copy())}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go back to a state that `state_dict` returned."""
        super().load_state_dict(state)
        self._state = state["state"].numpy().copy()


def _check(name: str, value: float, right: bool, expected: str) -> None:
    if not right or not math.isfinite(value):
        raise InputError(f"noise: {name}", given=value, expected=expected, fix="Change the configuration.")

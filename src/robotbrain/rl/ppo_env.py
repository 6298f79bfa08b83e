"""One way of stepping for PPO, whatever the environments are: the kit's own, or Gymnasium's vector environments."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from robotbrain.errors import InputError

Observations = dict[str, Tensor]
"""Observation groups by name, each (num_envs, n) float32."""


@dataclass(frozen=True)
class Step:
    """What a control step of all N environments gave; those that ended have been reset already.

    Attributes:
        obs: after the resets.
        reward: (N,) float32.
        terminated: (N,) bool, the task itself ended: nothing more is to be earned.
        truncated: (N,) bool, only the time was up: what could still have been earned counts. Never with ``terminated``.
        final_obs: before the resets, of all environments; None when none ended.
        log: figures of the environment by name, about the episodes that ended.
    """

    obs: Observations
    reward: Tensor
    terminated: Tensor
    truncated: Tensor
    final_obs: Observations | None
    log: Mapping[str, float]

    @property
    def done(self) -> Tensor:
        """(N,) bool: which environments were reset."""
        return self.terminated | self.truncated

    @property
    def last_obs(self) -> Observations:
        """What the step led to in each environment, before any reset."""
        return self.obs if self.final_obs is None else self.final_obs


class PpoEnv(Protocol):
    """What PPO needs of environments; :func:`ppo_env` makes one.

    Attributes:
        unwrapped: the environments as they were given.
        num_envs: N.
        num_actions: A.
    """

    unwrapped: Any
    num_envs: int
    num_actions: int

    def reset(self, seed: int) -> Observations:
        """Reset all environments; return what they show."""

    def step(self, actions: Tensor) -> Step:
        """Take actions (N, A) for one control step."""

    def stagger(self, generator: torch.Generator) -> None:
        """Move each environment's clock to a random time of its episode, where that is possible."""

    def state_dict(self) -> dict[str, Any] | None:
        """Return everything that decides how it goes on; None where the environments cannot tell."""

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from such a state."""


def ppo_env(env: Any, clip_actions: float | None = None) -> PpoEnv:
    """Return ``env`` as PPO steps it.

    Args:
        env: a ``ManagerBasedRLEnv``, a ``gymnasium.vector.VectorEnv``, or a :class:`PpoEnv`, which is returned.
        clip_actions: actions are clamped to this magnitude.

    Raises:
        InputError: for anything else, for a vector environment that does not reset within the step in which an
            episode ended, and for spaces that are not boxes of one dimension.
    """
    if isinstance(env, (ManagerPpoEnv, GymPpoEnv)):
        return env
    if hasattr(env, "observation_manager") and hasattr(env, "action_manager"):
        return ManagerPpoEnv(env, clip_actions)
    if hasattr(env, "single_action_space"):
        return GymPpoEnv(env, clip_actions)
    raise InputError(
        "env",
        given=type(env).__name__,
        expected="a ManagerBasedRLEnv or a gymnasium.vector.VectorEnv",
        fix="robotbrain.rl.registry.make(task) and gymnasium.make_vec(name, ...) make such environments.",
    )


def check_finite(step: Step) -> None:
    """Check that observations and rewards are numbers.

    Raises:
        InputError: naming the environment and the component of the first that is not.
    """
    for name, values in [("the reward", step.reward), *((f"observation {k!r}", v) for k, v in step.obs.items())]:
        if not torch.isfinite(values).all():
            bad = (~torch.isfinite(values)).nonzero()[0].tolist()
            raise InputError(
                name,
                given=f"{values[tuple(bad)].item()} in environment {bad[0]}"
                + (f", component {bad[1]}" if len(bad) > 1 else ""),
                expected="finite numbers",
                fix="Look for a term that divides by zero or overflows, or a simulation that has become unstable.",
            )


class ManagerPpoEnv:
    """The kit's (or Isaac Lab's) manager-based environment."""

    def __init__(self, env: Any, clip_actions: float | None = None) -> None:
        self.unwrapped = env
        self.num_envs = int(env.num_envs)
        self.num_actions = int(env.action_manager.total_action_dim)
        self._clip = clip_actions
        self._finite = bool(env.cfg.is_finite_horizon)
        # Without the last observation of an episode, what a time limit cut off could not be valued.
        env.cfg.compute_final_obs = True

    def reset(self, seed: int) -> Observations:
        """Reset all environments."""
        obs: Observations = self.unwrapped.reset(seed=seed)[0]
        return dict(obs)

    def step(self, actions: Tensor) -> Step:
        """Take one control step."""
        if self._clip is not None:
            actions = actions.clamp(-self._clip, self._clip)
        obs, reward, terminated, time_outs, extras = self.unwrapped.step(actions)
        terminated = terminated.bool()
        if self._finite:  # the remaining time is part of the task: nothing can be earned after it
            terminated = terminated | time_outs.bool()
        truncated = time_outs.bool() & ~terminated
        if not bool((terminated | truncated).any()):
            return Step(dict(obs), reward, terminated, truncated, None, {})
        log = {name: float(value) for name, value in extras.get("log", {}).items()}
        return Step(dict(obs), reward, terminated, truncated, extras["final_obs"], log)

    def stagger(self, generator: torch.Generator) -> None:
        """Move each environment's clock to a random time of its episode."""
        clock = self.unwrapped.episode_length_buf
        clock[:] = torch.randint(0, int(self.unwrapped.max_episode_length), clock.shape, generator=generator).to(clock)

    def state_dict(self) -> dict[str, Any] | None:
        """Return the simulation's state, all counters and random states."""
        state: dict[str, Any] = self.unwrapped.state_dict()
        return state

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from such a state."""
        self.unwrapped.load_state_dict(state)


class GymPpoEnv:
    """A vector environment of Gymnasium; its observation is the group ``"policy"``."""

    def __init__(self, env: Any, clip_actions: float | None = None) -> None:
        mode = env.metadata.get("autoreset_mode")
        if getattr(mode, "value", mode) != "SameStep":
            raise InputError(
                "autoreset_mode of the vector environment",
                given=mode,
                expected="AutoresetMode.SAME_STEP",
                fix='Pass vector_kwargs={"autoreset_mode": AutoresetMode.SAME_STEP} to gymnasium.make_vec.',
            )
        for name, space in (("observation", env.single_observation_space), ("action", env.single_action_space)):
            if len(getattr(space, "shape", None) or ()) != 1 or not hasattr(space, "low"):
                raise InputError(
                    f"{name} space", given=space, expected="a Box of one dimension", fix="Wrap the environment."
                )
        self.unwrapped = env
        self.num_envs = int(env.num_envs)
        self.num_actions = int(env.single_action_space.shape[0])
        limit = np.inf if clip_actions is None else clip_actions
        self._low = np.maximum(env.single_action_space.low, -limit)
        self._high = np.minimum(env.single_action_space.high, limit)

    def reset(self, seed: int) -> Observations:
        """Reset all environments."""
        return {"policy": _tensor(self.unwrapped.reset(seed=seed)[0])}

    def step(self, actions: Tensor) -> Step:
        """Take one control step; actions are clipped to the action space."""
        clipped = np.clip(actions.numpy(), self._low, self._high)
        obs, reward, terminated, truncated, info = self.unwrapped.step(clipped)
        now = _tensor(obs)
        final = None
        if (ended := np.asarray(terminated | truncated)).any():
            rows = torch.from_numpy(np.flatnonzero(ended))
            last = now.clone()
            # An array of arrays from Gymnasium's own vector environments, of which others have no entry.
            last[rows] = _tensor(np.stack([np.asarray(info["final_obs"][i]) for i in rows.tolist()]))
            final = {"policy": last}
        done = torch.from_numpy(np.asarray(terminated, bool))
        cut = torch.from_numpy(np.asarray(truncated, bool)) & ~done
        return Step({"policy": now}, _tensor(reward), done, cut, final, {})

    def stagger(self, generator: torch.Generator) -> None:
        """Do nothing: Gymnasium has no way to set the clock of an episode."""

    def state_dict(self) -> dict[str, Any] | None:
        """Return the environments' state where they offer ``state_dict``."""
        return self.unwrapped.state_dict() if hasattr(self.unwrapped, "state_dict") else None

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from such a state."""
        self.unwrapped.load_state_dict(state)


def _tensor(array: Any) -> Tensor:
    # A copy: vector environments write their next observation into the same memory.
    return torch.from_numpy(np.array(array, dtype=np.float32))

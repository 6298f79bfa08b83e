"""How good a policy is: whole episodes, without favour to short ones. What follows from them: ``conclusions``."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor, nn

from robotbrain.errors import InputError
from robotbrain.monitoring.accuracy import Estimate, wilson_interval
from robotbrain.rl.conclusions import Comparison, bootstrap, clopper_pearson, compare
from robotbrain.rl.ppo_env import Step, ppo_env

if TYPE_CHECKING:
    from robotbrain.rl.logs import Progress

__all__ = [
    "Comparison",
    "EpisodeTable",
    "Estimate",
    "bootstrap",
    "clopper_pearson",
    "compare",
    "run_episodes",
    "velocity_errors",
    "wilson_interval",
]

LONGEST = 10
"""An episode of so many times the environment's time limit will not end."""

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Act = Callable[[NDArray[np.float32]], ArrayLike]
"""A policy: observations (N, O) of the group ``"policy"`` to actions (N, A)."""
Measure = Callable[[Any, Step], Mapping[str, Tensor]]
"""Figures (N,) of a control step, from the environments and what the step gave. Environments whose episode has just
ended already show the next one: take what ended from ``step.last_obs``, or answer NaN for ``step.done``."""


@dataclass(frozen=True)
class EpisodeTable:
    """Episodes that were run to their end; arrays have one row for each, by environment, then in order of time.

    Attributes:
        env: index of the environment.
        returns: sum of the rewards, not discounted.
        lengths: control steps.
        terminated: ended by the task itself, not by its time limit.
        mean: mean over the steps of each measured figure.
        tail: its last values, (n, tail), the last one last; NaN where the episode was shorter.
        success: None where nothing says what success is.
    """

    env: NDArray[np.int64]
    returns: Floats
    lengths: NDArray[np.int64]
    terminated: Bools
    mean: dict[str, Floats]
    tail: dict[str, Floats]
    success: Bools | None = None

    def __len__(self) -> int:
        return len(self.returns)

    def success_rate(self, level: float = 0.95) -> Estimate:
        """Return the share of successes with its Wilson interval.

        Raises:
            InputError: when the episodes were run without ``success``.
        """
        if self.success is None:
            raise InputError(
                "success", given=None, expected="run_episodes(..., success=...)", fix="Say what counts as success."
            )
        return wilson_interval(int(self.success.sum()), len(self), level)

    def __str__(self) -> str:
        words = [
            f"{len(self)} episodes",
            f"return {bootstrap(self.returns)}",
            f"length {self.lengths.mean():.0f} steps",
        ]
        if self.success is not None:
            words.append(f"success {self.success_rate()}")
        words += [f"{name} {values.mean():.3f}" for name, values in self.mean.items()]
        return ", ".join(words)


def run_episodes(
    env: Any,
    act: Act | nn.Module,
    episodes: int,
    *,
    seed: int = 0,
    measure: Measure | None = None,
    tail: int = 5,
    success: Callable[[EpisodeTable], ArrayLike] | None = None,
    progress: Progress | None = None,
) -> EpisodeTable:
    """Run exactly so many episodes to their end.

    Which ones count is decided before: the first ``episodes / N`` of each of the N environments. To take the first
    ``episodes`` that come to an end would favour short ones, so failures where failing is quick.

    Args:
        env: a ``ManagerBasedRLEnv`` or a Gymnasium ``VectorEnv`` that resets in the same step.
        act: the policy, of arrays; a torch module likewise of tensors.
        episodes: at least 1.
        seed: of the environments' reset.
        measure: figures to keep of every step.
        tail: how many last values of them to keep.
        success: which episodes (n,) bool succeeded, by the table of the others, e.g.
            ``lambda table: (table.tail["distance"] < 0.02).all(axis=1)``.
        progress: a bar that counts episodes.

    Raises:
        InputError: for a number of episodes below 1, actions of the wrong shape or that are not numbers, or an episode
            that does not end within ``LONGEST`` times the environment's ``max_episode_length``, where it has one.
    """
    if episodes < 1 or tail < 1:
        raise InputError("episodes, tail", given=(episodes, tail), expected="1 or more", fix="Some hundreds are usual.")
    stepper = ppo_env(env)
    number = stepper.num_envs
    wanted = np.array([episodes // number + (index < episodes % number) for index in range(number)])
    found: list[list[_Episode]] = [[] for _ in range(number)]
    returns, lengths = np.zeros(number), np.zeros(number, np.int64)
    kept: list[dict[str, Floats]] = []
    sums: dict[str, Floats] = {}
    counts: dict[str, Floats] = {}
    obs = stepper.reset(seed)
    left = episodes
    longest = LONGEST * getattr(stepper.unwrapped, "max_episode_length", math.inf)
    while left:
        step = stepper.step(_actions(act, obs["policy"], number, stepper.num_actions))
        returns += step.reward.double().numpy()
        lengths += 1
        if lengths.max() > longest:
            raise InputError(
                "episode",
                given=f"{lengths.max()} control steps without an end",
                expected=f"an end within {longest / LONGEST:.0f} steps, its time limit",
                fix="Give the task a termination with time_out=True.",
            )
        if measure is not None:
            now = {name: x.double().numpy().copy() for name, x in measure(stepper.unwrapped, step).items()}
            kept = [*kept[-(tail - 1) :], now] if tail > 1 else [now]
            for name, x in now.items():
                valid = np.isfinite(x)
                sums[name] = sums.get(name, 0.0) + np.where(valid, x, 0.0)
                counts[name] = counts.get(name, 0.0) + valid
        for index in step.done.nonzero().squeeze(1).tolist():
            if len(found[index]) < wanted[index]:
                mean = {n: sums[n][index] / counts[n][index] if counts[n][index] else math.nan for n in sums}
                last = {n: _tail([row[n][index] for row in kept], int(lengths[index]), tail) for n in sums}
                ended = bool(step.terminated[index])
                found[index].append(_Episode(returns[index], int(lengths[index]), ended, mean, last))
                left -= 1
                if progress is not None:
                    progress.update()
            returns[index] = lengths[index] = 0
            for name in sums:
                sums[name][index] = counts[name][index] = 0
        obs = step.obs
    rows = [episode for group in found for episode in group]
    table = EpisodeTable(
        env=np.repeat(np.arange(number), wanted),
        returns=np.array([row.total for row in rows]),
        lengths=np.array([row.length for row in rows]),
        terminated=np.array([row.terminated for row in rows]),
        mean={name: np.array([row.mean[name] for row in rows]) for name in sums},
        tail={name: np.array([row.tail[name] for row in rows]) for name in sums},
    )
    return table if success is None else replace(table, success=np.asarray(success(table), dtype=bool))


def velocity_errors(env: Any, step: Step, command: str = "base_velocity", asset: str = "robot") -> dict[str, Tensor]:
    """A measure for :func:`run_episodes`: by how much a robot misses its commanded velocity.

    Returns:
        ``error_xy`` m/s, the length of the error of the horizontal velocity in the robot's frame, and ``error_yaw``
        rad/s, absolute; NaN in the step in which an episode ended.
    """
    data = env.scene[asset].data
    wanted = env.command_manager.get_command(command)
    xy = (wanted[:, :2] - data.root_lin_vel_b.torch[:, :2]).norm(dim=1)
    yaw = (wanted[:, 2] - data.root_ang_vel_b.torch[:, 2]).abs()
    return {"error_xy": xy.masked_fill(step.done, math.nan), "error_yaw": yaw.masked_fill(step.done, math.nan)}


@dataclass(frozen=True)
class _Episode:
    total: float
    length: int
    terminated: bool
    mean: dict[str, float]
    tail: dict[str, Floats]


def _actions(act: Act | nn.Module, obs: Tensor, rows: int, columns: int) -> Tensor:
    if isinstance(act, nn.Module):
        with torch.no_grad():
            actions: Tensor = act(obs)
    else:
        actions = torch.from_numpy(np.array(act(obs.numpy()), dtype=np.float32))
    if tuple(actions.shape) != (rows, columns) or not bool(torch.isfinite(actions).all()):
        raise InputError(
            "actions of the policy",
            given=f"shape {tuple(actions.shape)}, {int((~torch.isfinite(actions)).sum())} not numbers",
            expected=f"shape {(rows, columns)}, finite",
            fix="Does the policy belong to this task?",
        )
    return actions


def _tail(values: Sequence[float], length: int, size: int) -> Floats:
    recent = list(values)[-min(length, size) :]
    return np.array([math.nan] * (size - len(recent)) + recent)

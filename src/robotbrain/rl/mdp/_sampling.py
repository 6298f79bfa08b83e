"""Random draws of the terms. Every one of them comes from ``env.generator``: same seed, same episodes."""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal

import torch

from robotbrain.errors import InputError
from robotbrain.rl.mdp._names import axis_ranges

if TYPE_CHECKING:
    from robotbrain.rl.envs import ManagerBasedRLEnv

Tensor = torch.Tensor
Operation = Literal["add", "scale", "abs"]
Distribution = Literal["uniform", "log_uniform", "gaussian"]
Bounds = tuple[float, float]

OPERATIONS = ("add", "scale", "abs")
DISTRIBUTIONS = ("uniform", "log_uniform", "gaussian")


def uniform(env: ManagerBasedRLEnv, bounds: Bounds, size: Sequence[int]) -> Tensor:
    """Draws uniform over ``bounds``."""
    low, span = _low_and_span(((bounds[0], bounds[1]),), exact_span=True)
    drawn: Tensor = low + span * torch.rand(*size, generator=env.generator, device=env.device)
    return drawn


def uniform_axes(
    env: ManagerBasedRLEnv, what: str, ranges: Mapping[str, Bounds], count: int, axes: Sequence[str]
) -> Tensor:
    """(count, len(axes)) draws, each column uniform over its axis' range; 0 for an axis that has none."""
    bounds = tuple((pair[0], pair[1]) for pair in axis_ranges(what, ranges, axes))
    low, span = _low_and_span(bounds)
    drawn: Tensor = low + span * torch.rand(count, len(axes), generator=env.generator, device=env.device)
    return drawn


def uniform_columns(env: ManagerBasedRLEnv, bounds: Sequence[Bounds], count: int) -> Tensor:
    """(count, len(bounds)) draws, each column uniform over its bounds; the same as one column drawn after the other."""
    low, span = _low_and_span(tuple((pair[0], pair[1]) for pair in bounds), exact_span=True)
    drawn: Tensor = low + span * torch.rand(len(bounds), count, generator=env.generator, device=env.device).T
    return drawn


@functools.lru_cache(maxsize=256)
def _low_and_span(bounds: tuple[Bounds, ...], exact_span: bool = False) -> tuple[Tensor, Tensor]:
    """Lower bounds and widths as rows; with ``exact_span`` widths are rounded once, like those of single draws."""
    low, high = torch.tensor(bounds, dtype=torch.float32).T
    span = torch.tensor([pair[1] - pair[0] for pair in bounds], dtype=torch.float32) if exact_span else high - low
    return low.contiguous(), span


def draw(
    env: ManagerBasedRLEnv,
    params: tuple[float | Tensor, float | Tensor],
    size: Sequence[int],
    distribution: Distribution,
) -> Tensor:
    """Draws of a named law.

    Args:
        params: (low, high) of ``"uniform"`` and ``"log_uniform"``, (mean, standard deviation) of ``"gaussian"``;
            tensors broadcast against ``size``.
    """
    first, second = params
    if distribution == "gaussian":
        return first + second * torch.randn(*size, generator=env.generator, device=env.device)
    share = torch.rand(*size, generator=env.generator, device=env.device)
    if distribution == "log_uniform":
        low, high = torch.as_tensor(first).log(), torch.as_tensor(second).log()
        return torch.exp(low + (high - low) * share)
    drawn: Tensor = first + (second - first) * share
    return drawn


def combine(default: Tensor, sample: Tensor, operation: Operation) -> Tensor:
    """``default`` with ``sample`` added, multiplied, or put in its place."""
    if operation == "add":
        return default + sample
    if operation == "scale":
        return default * sample
    return sample.expand_as(default).clone()


def check_law(
    params: Mapping[str, Any], name: str, *, operation: str, distribution: str, positive_scale: bool = False
) -> None:
    """Check a term's law when the environment is made, not when it first draws.

    Args:
        params: the term's parameters; a law that is absent or None changes nothing and is right.
        positive_scale: a scale of 0 is wrong too (a body without mass).

    Raises:
        InputError: unknown operation or distribution, swapped or infinite bounds, a negative scale or deviation.
    """
    if operation not in OPERATIONS or distribution not in DISTRIBUTIONS:
        raise InputError(
            name,
            given={"operation": operation, "distribution": distribution},
            expected=f"an operation out of {OPERATIONS} and a distribution out of {DISTRIBUTIONS}",
            fix="Correct the spelling.",
        )
    law = params.get(name)
    if law is None:
        return
    gaussian = distribution == "gaussian"
    numbers = isinstance(law, tuple | list) and len(law) == 2 and all(isinstance(v, int | float) for v in law)
    if not numbers or not all(map(math.isfinite, law)) or (law[1] < 0 if gaussian else law[1] < law[0]):
        raise InputError(
            name,
            given=law,
            expected="(mean, standard deviation >= 0)" if gaussian else "(low, high) with low <= high",
            fix="Give two finite numbers in this order.",
        )
    if distribution == "log_uniform" and law[0] <= 0:
        raise InputError(name, given=law, expected="bounds above 0", fix="A logarithmic law needs positive bounds.")
    if operation == "scale" and (law[0] < 0 or (positive_scale and law[0] == 0)):
        raise InputError(
            name,
            given=law,
            expected="a positive scale" if positive_scale else "a scale of 0 or more",
            fix="A scale multiplies the default; use operation='add' for an offset.",
        )

"""Sensor noise of observation terms (names and fields as in ``isaaclab.utils.noise``)."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Literal

from robotbrain.errors import InputError
from robotbrain.rl.configclass import MISSING, Config, configclass

if TYPE_CHECKING:
    import torch


def constant_noise(data: torch.Tensor, cfg: ConstantNoiseCfg, generator: torch.Generator) -> torch.Tensor:
    """Combine ``data`` with a constant."""
    return _combine(data, cfg.bias, cfg.operation)


def uniform_noise(data: torch.Tensor, cfg: UniformNoiseCfg, generator: torch.Generator) -> torch.Tensor:
    """Combine ``data`` with draws from [n_min, n_max), independent per component."""
    import torch

    draws = torch.empty_like(data).uniform_(generator=generator)
    return _combine(data, draws * (cfg.n_max - cfg.n_min) + cfg.n_min, cfg.operation)


def gaussian_noise(data: torch.Tensor, cfg: GaussianNoiseCfg, generator: torch.Generator) -> torch.Tensor:
    """Combine ``data`` with draws of a normal distribution, independent per component."""
    import torch

    draws = torch.empty_like(data).normal_(generator=generator)
    return _combine(data, draws * cfg.std + cfg.mean, cfg.operation)


@configclass
class NoiseCfg(Config):
    """Noise in general.

    Attributes:
        func: ``func(data, cfg, generator)`` returns the noisy data and leaves its input as it is.
        operation: ``"add"`` to the data, ``"scale"`` them, or ``"abs"``: take their place.
    """

    func: Callable[..., Any] = MISSING
    operation: Literal["add", "scale", "abs"] = "add"


@configclass
class ConstantNoiseCfg(NoiseCfg):
    """A constant ``bias`` (in the unit of the data)."""

    func: Callable[..., Any] = constant_noise
    bias: Any = 0.0


@configclass
class UniformNoiseCfg(NoiseCfg):
    """Uniform noise between ``n_min`` and ``n_max`` (in the unit of the data)."""

    func: Callable[..., Any] = uniform_noise
    n_min: Any = -1.0
    n_max: Any = 1.0


@configclass
class GaussianNoiseCfg(NoiseCfg):
    """Normal noise with ``mean`` and standard deviation ``std`` (in the unit of the data)."""

    func: Callable[..., Any] = gaussian_noise
    mean: Any = 0.0
    std: Any = 1.0


def _combine(data: torch.Tensor, noise: Any, operation: str) -> torch.Tensor:
    import torch

    values = torch.as_tensor(noise)
    if operation == "add":
        return torch.add(data, values)
    if operation == "scale":
        return torch.mul(data, values)
    if operation == "abs":
        return values.expand_as(data).clone()
    raise InputError(
        "NoiseCfg.operation", given=operation, expected="'add', 'scale' or 'abs'", fix="Choose one of these."
    )

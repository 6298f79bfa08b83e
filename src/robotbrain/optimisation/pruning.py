"""Unstructured pruning: the weights of smallest magnitude become zero, and stay so while the rest trains on.

Only the ``weight`` of convolutions and linear layers is pruned. Biases and normalisation are left alone: they are a
handful of numbers, and each of them moves a whole channel.

A zero saves nothing by itself: dense kernels, of ONNX Runtime on a CPU as of TensorRT on a Jetson, multiply by zero as
slowly as by anything else (``benchmarks/opt_sparsity.py`` shows it). What unstructured pruning shrinks is the
compressed file. To save time, remove whole channels (``structured``), or use a pattern that the hardware knows
(``semi_structured``).

Source: Han, Pool, Tran and Dally, "Learning both weights and connections", NeurIPS 2015 (magnitude, fine-tuning with
the mask); Zhu and Gupta, "To prune, or not to prune", 2017, arXiv:1710.01878 (the gradual schedule).
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping

import torch
from torch import nn

from robotbrain.errors import InputError

Masks = dict[str, torch.Tensor]
"""Name of a parameter, as ``module.named_parameters()`` has it -> bool of its shape, True where the weight is kept."""

SCOPES = ("global", "layer")
"""Whether weights compete across the network, or each layer gives the same share."""

PRUNABLE = (nn.Linear, nn.Conv1d, nn.Conv2d, nn.Conv3d, nn.ConvTranspose1d, nn.ConvTranspose2d, nn.ConvTranspose3d)


def prunable_weights(module: nn.Module, ignore: Collection[str] = ()) -> Iterator[tuple[str, torch.Tensor]]:
    """Yield name and weight of each convolution and linear layer, a shared weight once.

    Args:
        module: the network.
        ignore: names of layers to leave dense, as ``named_modules()`` has them; what lies inside them is left, too.

    Raises:
        InputError: for a name that no layer has.
    """
    known = {name for name, _ in module.named_modules()}
    unknown = sorted(set(ignore) - known)
    if unknown:
        raise InputError(
            "ignore", given=unknown, expected="names of the network's layers", fix="Look at named_modules()."
        )
    seen: set[int] = set()
    for name, layer in module.named_modules():
        skipped = any(name == i or name.startswith(f"{i}.") for i in ignore)
        if isinstance(layer, PRUNABLE) and not skipped and id(layer.weight) not in seen:
            seen.add(id(layer.weight))
            yield (f"{name}.weight" if name else "weight"), layer.weight


def l1_mask(weight: torch.Tensor, sparsity: float) -> torch.Tensor:
    """Return where a weight is kept when the smallest magnitudes are removed.

    Exactly ``round(sparsity * weight.numel())`` entries are False, also among equal magnitudes: of those the first in
    memory order go first, so that the same weight gives the same mask on every machine.

    Args:
        weight: of any shape.
        sparsity: share to remove, 0 to 1.

    Returns:
        bool of the weight's shape, True where the weight is kept.

    Raises:
        InputError: for a share out of range, or weights that are not finite.
    """
    check_sparsity(sparsity)
    if not torch.isfinite(weight).all():
        raise InputError("weight", given="NaN or infinity", expected="finite values", fix="Check the training.")
    removed = round(sparsity * weight.numel())
    mask = torch.ones(weight.numel(), dtype=torch.bool)
    mask[torch.argsort(weight.detach().abs().flatten(), stable=True)[:removed]] = False
    return mask.reshape(weight.shape)


def l1_masks(module: nn.Module, sparsity: float, *, scope: str = "global", ignore: Collection[str] = ()) -> Masks:
    """Return the masks that prune a network to a sparsity of its prunable weights.

    Args:
        module: the network; it is not changed.
        sparsity: share to remove, 0 to 1.
        scope: ``"global"``: the smallest of all layers together go, so that wide layers give more than narrow ones;
            ``"layer"``: each layer gives this share.
        ignore: layers to leave dense (see :func:`prunable_weights`).

    Raises:
        InputError: for a share out of range, an unknown scope, or a network with nothing to prune.
    """
    if scope not in SCOPES:
        raise InputError("scope", given=scope, expected="one of " + ", ".join(SCOPES), fix="Choose one of these.")
    weights = dict(prunable_weights(module, ignore))
    if not weights:
        raise InputError(
            "network",
            given=type(module).__name__,
            expected="at least one convolution or linear layer",
            fix="Ignore fewer layers, or pass the whole network.",
        )
    if scope == "layer":
        return {name: l1_mask(weight, sparsity) for name, weight in weights.items()}
    together = l1_mask(torch.cat([weight.detach().flatten() for weight in weights.values()]), sparsity)
    parts = torch.split(together, [weight.numel() for weight in weights.values()])
    return {name: part.reshape(weight.shape) for (name, weight), part in zip(weights.items(), parts, strict=True)}


def cubic_sparsity(step: int, *, final: float, end: int, begin: int = 0, initial: float = 0.0) -> float:
    """Return the sparsity at a training step: fast at first, while much is redundant, then ever slower.

    ``final + (initial - final) * (1 - (step - begin) / (end - begin)) ** 3`` between ``begin`` and ``end``.

    Args:
        step: since the training began, 0 or more.
        final: share that is reached at ``end`` and held from there on.
        end: step at which it is reached; leave some training after it.
        begin: step before which the sparsity is ``initial``.
        initial: share to begin with.

    Raises:
        InputError: for shares out of range, or an end that is not after the beginning.
    """
    check_sparsity(final)
    check_sparsity(initial)
    if not 0 <= begin < end:
        raise InputError("begin, end", given=(begin, end), expected="0 <= begin < end", fix="Give it some steps.")
    left = 1.0 - min(max((step - begin) / (end - begin), 0.0), 1.0)
    return final + (initial - final) * left**3


class MaskedPruning:
    """Zeros in a network that stay zero through training.

    The masks are applied at once; call :meth:`after_step` after each step of the optimiser (momentum and weight decay
    move pruned weights away from zero), and :meth:`make_permanent` at the end. The module keeps its own parameters, so
    that it can be saved and exported at any time as it is.

    Args:
        module: the network; it is changed in place.
        masks: see :func:`l1_masks`; of other sources, too.

    Raises:
        InputError: for a mask whose name or shape is not that of a parameter.
    """

    def __init__(self, module: nn.Module, masks: Mapping[str, torch.Tensor]) -> None:
        self.module = module
        self._masks: Masks = {}
        self.set_masks(masks)

    @property
    def masks(self) -> Masks:
        """The masks in force; none after :meth:`make_permanent`."""
        return dict(self._masks)

    def set_masks(self, masks: Mapping[str, torch.Tensor]) -> None:
        """Put other masks in force, and apply them."""
        parameters = dict(self.module.named_parameters())
        for name, mask in masks.items():
            if name not in parameters or parameters[name].shape != mask.shape or mask.dtype != torch.bool:
                shape = tuple(parameters[name].shape) if name in parameters else "no such parameter"
                raise InputError(
                    f"mask of {name!r}",
                    given=f"{mask.dtype} {tuple(mask.shape)}",
                    expected=f"bool of the parameter's shape ({shape})",
                    fix="Make the masks from this very network.",
                )
        self._masks = {name: mask.clone() for name, mask in masks.items()}
        self._apply()

    def after_step(self, *_ignored: object) -> None:
        """Set the pruned weights to zero again; whatever a training loop passes along is not needed."""
        self._apply()

    def make_permanent(self) -> nn.Module:
        """Apply the masks for good, forget them, and return the module."""
        self._apply()
        self._masks = {}
        return self.module

    def _apply(self) -> None:
        parameters = dict(self.module.named_parameters())
        with torch.no_grad():
            for name, mask in self._masks.items():
                # Not a product: 0 * inf is NaN, and -1 * 0 is a minus zero that compresses badly.
                parameters[name].masked_fill_(~mask.to(parameters[name].device), 0.0)


class GradualPruning(MaskedPruning):
    """Prunes more and more while training goes on, after the cubic schedule; what is pruned stays pruned.

    Args:
        module: the network; it is changed in place.
        final: share to reach, 0 to 1.
        end, begin: steps of the schedule (see :func:`cubic_sparsity`).
        every: steps between two prunings, in which the network recovers.
        scope, ignore: see :func:`l1_masks`.
    """

    def __init__(
        self,
        module: nn.Module,
        final: float,
        *,
        end: int,
        begin: int = 0,
        every: int = 10,
        scope: str = "global",
        ignore: Collection[str] = (),
    ) -> None:
        if every < 1:
            raise InputError("every", given=every, expected="1 or more steps", fix="Try 10.")
        self.step = 0
        self._schedule = (final, begin, end, every)
        self._scope, self._ignore = scope, tuple(ignore)
        super().__init__(module, l1_masks(module, self._target(), scope=scope, ignore=self._ignore))

    def after_step(self, *_ignored: object) -> None:
        """Count the step, prune more where the schedule says so, and hold the zeros."""
        self.step += 1
        self._apply()  # first: a pruned weight must not look alive to the next choice
        _, begin, end, every = self._schedule
        if begin <= self.step <= end and ((self.step - begin) % every == 0 or self.step == end):
            self.set_masks(l1_masks(self.module, self._target(), scope=self._scope, ignore=self._ignore))

    def _target(self) -> float:
        final, begin, end, _ = self._schedule
        return cubic_sparsity(self.step, final=final, begin=begin, end=end)


def sparsity_of(module: nn.Module, ignore: Collection[str] = ()) -> float:
    """Return the share of a network's prunable weights that are exactly zero; 0 for a network without any."""
    weights = [weight for _, weight in prunable_weights(module, ignore)]
    total = sum(weight.numel() for weight in weights)
    return sum(int((weight == 0).sum()) for weight in weights) / total if total else 0.0


def check_sparsity(sparsity: float) -> float:
    """Return a share from 0 to 1.

    Raises:
        InputError: for anything else.
    """
    number = isinstance(sparsity, int | float) and not isinstance(sparsity, bool)
    if not number or not math.isfinite(sparsity) or not 0.0 <= sparsity <= 1.0:
        raise InputError("sparsity", given=sparsity, expected="a share from 0 to 1", fix="50 % is 0.5.")
    return float(sparsity)

"""2:4 sparsity: of every four consecutive input channels two are zero, the pattern that Ampere's tensor cores know.

What it takes to gain from it: a GPU of the Ampere family or newer (an Orin has one; Nano, TX2 and Xavier have not), the
pattern in the weights along the input channels, and an engine built with ``trtexec --sparsity=enable`` (in the API, the
builder flag ``SPARSE_WEIGHTS``). Even then the builder only takes a sparse kernel where it times faster than the dense
one. NVIDIA's engineers report that this needs about 256 channels on both sides, and about 15 % of a convolutional
network's latency, usually less (see SOURCES). The networks of this kit are far narrower. So the twin counts 2:4 weights
as dense: nobody has measured a gain that it could promise.

Source of the choice of two of four by magnitude, and of training on with the mask: Mishra et al., "Accelerating sparse
deep neural networks", 2021, arXiv:2104.08378.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import NamedTuple

import torch
from torch import nn

from robotbrain.errors import InputError
from robotbrain.jetson.catalogue import load_module
from robotbrain.optimisation.pruning import Masks, prunable_weights

GROUP, KEPT = 4, 2

SOURCES = (
    "https://github.com/NVIDIA/TensorRT/issues/2310 (about 15 % end to end, usually less)",
    "https://github.com/NVIDIA/TensorRT/issues/3849 (sparse kernels win from about 256 channels)",
    "https://github.com/NVIDIA/TensorRT/issues/4065 (no gain on an A40; the same 256 channels)",
    "https://github.com/NVIDIA/Deep-Learning-Accelerator-SW/issues/19 (no gain seen on an Orin, GPU or DLA)",
)
"""What is published about the gain; NVIDIA's engineers answer in the first three."""

WORTHWHILE_CHANNELS = 256
"""Input and output channels from which NVIDIA's engineers see sparse kernels win."""

SPARSE_FAMILIES = ("ampere", "blackwell")
"""GPU families of Jetson modules whose tensor cores know the pattern."""


class SparsityAdvice(NamedTuple):
    """What 2:4 weights can bring on a module.

    Attributes:
        supported: whether its GPU has sparse tensor cores.
        wide_layers: names of the layers wide enough that a gain was ever reported.
        text: the verdict in a sentence or two.
    """

    supported: bool
    wide_layers: tuple[str, ...]
    text: str


def two_four_mask(weight: torch.Tensor) -> torch.Tensor:
    """Return the mask that keeps the two largest magnitudes of every four consecutive input channels.

    Of equal magnitudes the first channels are kept.

    Args:
        weight: (outputs, inputs, ...) of a linear layer or convolution, inputs divisible by 4; per output and pixel
            of the kernel, as TensorRT wants it.

    Returns:
        bool of the same shape; exactly half of it True.

    Raises:
        InputError: for fewer than two axes, inputs not divisible by four, or values that are not finite.
    """
    if weight.ndim < 2 or weight.shape[1] % GROUP or not weight.shape[1]:
        raise InputError(
            "weight",
            given=tuple(weight.shape),
            expected="(outputs, inputs, ...) with inputs divisible by 4",
            fix="Leave this layer dense (an image's three channels, depthwise convolutions).",
        )
    if not torch.isfinite(weight).all():
        raise InputError("weight", given="NaN or infinity", expected="finite values", fix="Check the training.")
    groups = _groups(weight.detach())
    order = torch.argsort(groups.abs(), dim=-1, descending=True, stable=True)
    kept = torch.zeros(groups.shape, dtype=torch.bool).scatter_(-1, order[..., :KEPT], True)
    return kept.reshape(weight.movedim(1, -1).shape).movedim(-1, 1).contiguous()


def is_two_four(weight: torch.Tensor) -> bool:
    """Return whether no four consecutive input channels of a weight hold more than two that are not zero."""
    if weight.ndim < 2 or weight.shape[1] % GROUP or not weight.shape[1]:
        return False
    return bool((torch.count_nonzero(_groups(weight.detach()), dim=-1) <= KEPT).all())


def two_four_masks(module: nn.Module, ignore: Collection[str] = ()) -> Masks:
    """Return the masks of every layer that can take the pattern, for ``MaskedPruning``.

    Layers whose inputs do not divide by four stay dense, and so do grouped and transposed convolutions.

    Raises:
        InputError: if no layer can take it.
    """
    masks = {name: two_four_mask(weight) for name, weight in _eligible(module, ignore)}
    if not masks:
        raise InputError(
            "network",
            given=type(module).__name__,
            expected="a dense layer with a number of input channels divisible by 4",
            fix="2:4 sparsity does not apply to this network.",
        )
    return masks


def two_four_share(module: nn.Module) -> float:
    """Return the share of a network's prunable weights that lie in layers with the pattern."""
    holders = {name for name, weight in _eligible(module) if is_two_four(weight)}
    sizes = {name: weight.numel() for name, weight in prunable_weights(module)}
    return sum(sizes[name] for name in holders) / sum(sizes.values()) if sizes else 0.0


def advice(module: nn.Module, device: str) -> SparsityAdvice:
    """Say what 2:4 weights can bring a network on a Jetson module, without promising what nobody measured.

    Args:
        module: the network.
        device: slug of the Jetson module.

    Raises:
        InputError: for an unknown device.
    """
    jetson = load_module(device)
    wide = tuple(
        name.removesuffix(".weight")
        for name, weight in _eligible(module)
        if min(weight.shape[0], weight.shape[1]) >= WORTHWHILE_CHANNELS
    )
    if jetson.family not in SPARSE_FAMILIES:
        text = f"{jetson.name} has no sparse tensor cores ({jetson.family}): 2:4 weights run as dense ones."
    elif not wide:
        text = (
            f"{jetson.name} knows the pattern, but no layer has {WORTHWHILE_CHANNELS} channels on both sides, from "
            "which sparse kernels were reported to win: expect no gain. Build with --sparsity=enable and measure."
        )
    else:
        text = (
            f"{jetson.name} knows the pattern, and {len(wide)} layers are wide enough for sparse kernels to win. "
            "Published gains are about 15 % end to end or less; build with --sparsity=enable and measure."
        )
    return SparsityAdvice(jetson.family in SPARSE_FAMILIES, wide, text)


def _groups(weight: torch.Tensor) -> torch.Tensor:
    last = weight.movedim(1, -1)
    return last.reshape(*last.shape[:-1], -1, GROUP)


def _eligible(module: nn.Module, ignore: Collection[str] = ()) -> list[tuple[str, torch.Tensor]]:
    layers = dict(module.named_modules())
    found = []
    for name, weight in prunable_weights(module, ignore):
        layer = layers[name.removesuffix(".weight").removesuffix("weight")]
        plain = isinstance(layer, nn.Linear) or (not getattr(layer, "transposed", False) and layer.groups == 1)
        if plain and weight.shape[1] % GROUP == 0:
            found.append((name, weight))
    return found

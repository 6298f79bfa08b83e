"""Structured pruning: whole channels go, and what is left is a smaller dense network that is really faster.

A channel cannot go alone: what adds to it, is concatenated with it or normalises it must shrink alike, and every reader
must drop the matching input. ``torch-pruning`` finds these groups from a traced graph, so that skip connections and
concatenations of a U-Net need no special care.

Source: Li et al., "Pruning filters for efficient ConvNets", ICLR 2017 (L1 norms); Liu et al., "Network slimming", ICCV
2017 (scales of the batch normalisation); Fang et al., "DepGraph", CVPR 2023 (groups).
"""

from __future__ import annotations

import copy
from collections.abc import Collection, Mapping
from typing import Any

import torch
from torch import nn

from robotbrain.errors import InputError, MissingDependencyError

IMPORTANCES = ("l1", "l2", "bn")
"""What makes a channel worth keeping: the L1 or L2 norm of its weights, or the scale of its batch normalisation."""

_CONVOLUTIONS = (nn.Conv1d, nn.Conv2d, nn.Conv3d)
_NORMALISATIONS = (nn.BatchNorm1d, nn.BatchNorm2d, nn.BatchNorm3d)


def prune_channels(
    module: nn.Module,
    example: torch.Tensor,
    ratio: float,
    *,
    importance: str = "l1",
    scope: str = "layer",
    ignore: Collection[str] = (),
    round_to: int = 1,
) -> nn.Module:
    """Return a smaller copy of a network, without its least important channels.

    Train it on afterwards: a network loses most of its accuracy when channels go, and wins nearly all of it back.

    Args:
        module: the network; it is not changed.
        example: an input, as for tracing.
        ratio: share of the channels of each layer to remove, 0 to below 1; as the parameters of a layer are its inputs
            times its outputs, 0.5 leaves about a quarter of them.
        importance: ``"l1"``, ``"l2"`` or ``"bn"`` (see IMPORTANCES).
        scope: ``"layer"``: each layer gives this share; ``"global"``: layers compete, and at least a tenth of each is
            left.
        ignore: names of layers whose outputs are left alone. The layers that make the network's output never lose one:
            its shape stays.
        round_to: channels that remain are a multiple of this; 8 suits the tensor cores.

    Returns:
        A module of the same class in the mode that the given one is in (train or eval), float32, which exports.

    Raises:
        InputError: for a ratio, importance or layer name that is not known, or an example that the network refuses.
        MissingDependencyError: without torch-pruning.
    """
    tp = _torch_pruning()
    if isinstance(ratio, bool) or not isinstance(ratio, int | float) or not 0.0 <= ratio < 1.0:
        raise InputError("ratio", given=ratio, expected="a share from 0 to below 1", fix="Half of the channels is 0.5.")
    if importance not in IMPORTANCES:
        raise InputError("importance", given=importance, expected=", ".join(IMPORTANCES), fix="Choose one of these.")
    if scope not in ("layer", "global"):
        raise InputError("scope", given=scope, expected="layer or global", fix="Choose one of these.")
    small = copy.deepcopy(module).eval()
    layers = dict(small.named_modules())
    unknown = sorted(set(ignore) - layers.keys())
    if unknown:
        raise InputError("ignore", given=unknown, expected="names of layers", fix="Look at named_modules().")
    if importance == "bn" and not any(isinstance(layer, _NORMALISATIONS) for layer in layers.values()):
        raise InputError("importance", given="bn", expected="a network with batch normalisation", fix="Take l1.")
    before = _output_shape(small, example)
    if ratio == 0.0:
        return small.train(module.training)
    measure = {
        "l1": lambda: tp.importance.MagnitudeImportance(p=1),
        "l2": lambda: tp.importance.MagnitudeImportance(p=2),
        "bn": lambda: tp.importance.BNScaleImportance(),
    }[importance]()
    kept = [layers[name] for name in ignore] + [layers[name] for name in output_layers(small, example)]
    pruner = tp.pruner.BasePruner(
        small,
        example,
        importance=measure,
        global_pruning=scope == "global",
        pruning_ratio=float(ratio),
        max_pruning_ratio=max(0.9, float(ratio)),
        ignored_layers=kept,
        round_to=round_to if round_to > 1 else None,
    )
    pruner.step()
    if widths_of(small) == widths_of(module):
        raise InputError(
            "ratio",
            given=ratio,
            expected="a share that removes a channel",
            fix="Ask for more, round less, or take another importance (an untrained network's scales are all equal).",
        )
    after = _output_shape(small, example)
    if after != before:
        raise InputError(
            "network", given=f"output {after} after pruning", expected=f"output {before}", fix="Ignore its last layers."
        )
    for parameter in small.parameters():
        parameter.grad = None
    return small.train(module.training)


def output_layers(module: nn.Module, example: torch.Tensor) -> list[str]:
    """Return the names of the layers whose output channels are the network's: those that pruning must leave alone.

    Found from the graph of gradients: a layer makes the output if nothing with weights comes after it.
    """
    order: list[str] = []
    hooks = []
    made_by: dict[Any, str] = {}  # holds the nodes: autograd's Python objects are made anew once nobody has them

    def note(name: str) -> Any:
        def hook(_layer: nn.Module, _given: Any, result: torch.Tensor) -> None:
            order.append(name)
            made_by[result.grad_fn] = name

        return hook

    for name, layer in module.named_modules():
        if isinstance(layer, (*_CONVOLUTIONS, nn.Linear, nn.ConvTranspose2d)):
            hooks.append(layer.register_forward_hook(note(name)))
    try:
        with torch.enable_grad():
            result = module(example.detach().clone().requires_grad_())
            found: list[str] = []
            seen: set[Any] = set()
            pending = [result.grad_fn]
            while pending:  # back from the output, not past the first layer with weights
                node = pending.pop()
                if node is None or node in seen:
                    continue
                seen.add(node)
                if node in made_by:
                    found.append(made_by[node])
                else:
                    pending += [parent for parent, _ in node.next_functions]
    finally:
        for hook in hooks:
            hook.remove()
    return sorted(found, key=order.index)


def fit_to_state(module: nn.Module, state: Mapping[str, torch.Tensor]) -> nn.Module:
    """Return a copy of a network with the widths and values of a stored state: the way back to a pruned network.

    A state dict is all that needs storing: its shapes say how many channels are left. Load it with
    ``torch.load(..., weights_only=True)``.

    Args:
        module: the network before pruning; it is not changed.
        state: ``state_dict()`` of a pruned copy of it.

    Raises:
        InputError: for a state of another network.
    """
    rebuilt = copy.deepcopy(module)
    own = rebuilt.state_dict()
    if own.keys() != state.keys():
        odd = sorted(own.keys() ^ state.keys())[:3]
        raise InputError("state", given=f"differs in {odd}", expected="the same layers", fix="Pass the same network.")
    for name, layer in rebuilt.named_modules():
        start = f"{name}." if name else ""
        for entry in ("weight", "bias", "running_mean", "running_var"):
            tensor = getattr(layer, entry, None)
            if tensor is not None and isinstance(tensor, torch.Tensor) and f"{start}{entry}" in state:
                fresh = torch.empty_like(state[f"{start}{entry}"], dtype=tensor.dtype)
                setattr(layer, entry, nn.Parameter(fresh) if isinstance(tensor, nn.Parameter) else fresh)
        if isinstance(layer, _NORMALISATIONS):
            layer.num_features = state[f"{start}running_mean"].shape[0]
        elif isinstance(layer, nn.Linear):
            layer.out_features, layer.in_features = state[f"{start}weight"].shape
        elif isinstance(layer, _CONVOLUTIONS):
            outputs, inputs = state[f"{start}weight"].shape[:2]
            if layer.groups > 1:  # depthwise: each channel is a group
                layer.groups = outputs if layer.groups == layer.in_channels else layer.groups
            layer.out_channels, layer.in_channels = outputs, inputs * layer.groups
        elif isinstance(layer, nn.ConvTranspose2d):
            layer.in_channels, layer.out_channels = state[f"{start}weight"].shape[:2]
    rebuilt.load_state_dict(dict(state))
    return rebuilt


def widths_of(module: nn.Module) -> dict[str, int]:
    """Return the output channels of each convolution and linear layer, by name."""
    widths = {}
    for name, layer in module.named_modules():
        if isinstance(layer, nn.Linear):
            widths[name] = layer.out_features
        elif isinstance(layer, (*_CONVOLUTIONS, nn.ConvTranspose2d)):
            widths[name] = layer.out_channels
    return widths


def _torch_pruning() -> Any:
    try:
        import torch_pruning
    except ImportError as error:
        raise MissingDependencyError(
            "torch-pruning", needed_for="removing channels", install="pip install torch-pruning"
        ) from error
    return torch_pruning


def _output_shape(module: nn.Module, example: torch.Tensor) -> tuple[int, ...]:
    try:
        with torch.no_grad():
            return tuple(module(example).shape)
    except (RuntimeError, TypeError, ValueError) as error:
        raise InputError(
            "example",
            given=tuple(getattr(example, "shape", ())),
            expected="an input that the network takes",
            fix=f"It says: {str(error).splitlines()[0][:160]}",
        ) from error

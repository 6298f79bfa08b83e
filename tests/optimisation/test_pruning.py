"""Magnitude pruning against its definition, its schedule's closed form, and torch's own implementation."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn
from torch.nn.utils import prune

from robotbrain.errors import InputError
from robotbrain.optimisation.networks import build_student
from robotbrain.optimisation.pruning import (
    GradualPruning,
    MaskedPruning,
    cubic_sparsity,
    l1_mask,
    l1_masks,
    prunable_weights,
    sparsity_of,
)

SHARES = (0.0, 0.2, 0.5, 0.8, 0.95, 1.0)


@pytest.fixture
def network() -> nn.Module:
    torch.manual_seed(0)
    return build_student(4)


@settings(max_examples=60, deadline=None)
@given(
    values=st.lists(st.integers(-4, 4), min_size=1, max_size=60),  # few values: many ties
    sparsity=st.floats(0.0, 1.0),
)
def test_exactly_the_smallest_go_and_as_many_as_asked(values: list[int], sparsity: float) -> None:
    weight = torch.tensor(values, dtype=torch.float32)
    mask = l1_mask(weight, sparsity)
    assert int((~mask).sum()) == round(sparsity * len(values))
    if mask.any() and (~mask).any():
        assert weight[~mask].abs().max() <= weight[mask].abs().min()
    assert torch.equal(mask, l1_mask(-3.0 * weight, sparsity))  # neither sign nor scale matters


def test_among_equals_the_first_go() -> None:
    mask = l1_mask(torch.tensor([[1.0, -1.0], [1.0, 2.0]]), 0.5)
    assert mask.tolist() == [[False, False], [True, True]]


@pytest.mark.parametrize("sparsity", SHARES)
def test_agrees_with_torch(network: nn.Module, sparsity: float) -> None:
    layer = nn.Conv2d(7, 5, 3)
    expected = prune.l1_unstructured(layer, "weight", amount=float(sparsity)).weight_mask.bool()
    assert torch.equal(l1_mask(layer.weight_orig, sparsity), expected)

    masks = l1_masks(network, sparsity)
    layers = dict(network.named_modules())
    chosen = [(layers[name.removesuffix(".weight")], "weight") for name in masks]
    prune.global_unstructured(chosen, pruning_method=prune.L1Unstructured, amount=float(sparsity))
    for name, mask in masks.items():
        assert torch.equal(layers[name.removesuffix(".weight")].weight_mask.bool(), mask)


def test_global_and_layer_scope(network: nn.Module) -> None:
    per_layer = l1_masks(network, 0.5, scope="layer")
    assert all(int((~m).sum()) == round(0.5 * m.numel()) for m in per_layer.values())
    together = l1_masks(network, 0.5)
    total = sum(m.numel() for m in together.values())
    assert sum(int((~m).sum()) for m in together.values()) == round(0.5 * total)
    kept = min(p.abs()[together[n]].min() for n, p in prunable_weights(network) if together[n].any())
    gone = max(p.abs()[~together[n]].max() for n, p in prunable_weights(network) if (~together[n]).any())
    assert gone <= kept  # one threshold for the whole network, which a share for each layer has not


def test_biases_and_normalisation_are_left_alone(network: nn.Module) -> None:
    before = {name: value.clone() for name, value in network.state_dict().items()}
    masks = l1_masks(network, 1.0)
    MaskedPruning(network, masks).make_permanent()
    changed = {name for name, value in network.state_dict().items() if not torch.equal(value, before[name])}
    convolutions = {f"{n}.weight" for n, m in network.named_modules() if isinstance(m, nn.Conv2d)}
    assert changed == convolutions == set(masks)


def test_a_shared_weight_is_counted_once() -> None:
    one = nn.Linear(4, 4)
    assert [name for name, _ in prunable_weights(nn.Sequential(one, nn.ReLU(), one))] == ["0.weight"]


def test_ignored_layers_stay_dense(network: nn.Module) -> None:
    stage = nn.Sequential(nn.Conv2d(3, 4, 1), nn.Conv2d(4, 4, 1))
    network = nn.ModuleDict({"up": stage, "upper": nn.Linear(4, 4), "head": nn.Linear(4, 2)})
    assert list(l1_masks(network, 0.9, ignore=["head", "up"])) == ["upper.weight"]
    assert list(l1_masks(network, 0.9, ignore=["up.1", "head"])) == ["up.0.weight", "upper.weight"]
    with pytest.raises(InputError, match="heads"):
        l1_masks(network, 0.5, ignore=["heads"])


def _train(network: nn.Module, after_step: object, steps: int) -> None:
    rng = torch.Generator().manual_seed(1)
    optimiser = torch.optim.AdamW(network.parameters(), lr=1e-2, weight_decay=0.1)
    for _ in range(steps):
        optimiser.zero_grad()
        network(torch.randn(2, 3, 16, 16, generator=rng)).square().mean().backward()
        optimiser.step()
        after_step()  # type: ignore[operator]


def test_masks_hold_through_training_and_are_permanent(network: nn.Module) -> None:
    pruning = MaskedPruning(network, l1_masks(network, 0.7))
    masks, before = pruning.masks, {n: p.detach().clone() for n, p in prunable_weights(network)}
    _train(network, pruning.after_step, 3)
    for name, weight in prunable_weights(network):
        assert not weight[~masks[name]].any()
        assert not torch.signbit(weight[~masks[name]]).any()  # no minus zero
        assert not torch.equal(weight, before[name])  # while the others do learn
    assert sparsity_of(network) == pytest.approx(0.7, abs=1e-3)
    assert pruning.make_permanent() is network and not pruning.masks
    # Nothing but the parameters remains: what torch.nn.utils.prune leaves behind before prune.remove() does not.
    assert network.state_dict().keys() == build_student(4).state_dict().keys()
    _train(network, lambda: None, 2)
    assert sparsity_of(network) < 0.5  # without the masks training brings the weights back


def test_masks_survive_weights_that_are_not_finite() -> None:
    layer = nn.Linear(2, 1, bias=False)
    pruning = MaskedPruning(layer, {"weight": torch.tensor([[False, True]])})
    with torch.no_grad():
        layer.weight.fill_(float("inf"))
    pruning.after_step()
    assert layer.weight.tolist() == [[0.0, float("inf")]]


def test_the_schedule_is_the_cubic() -> None:
    curve = [cubic_sparsity(s, final=0.9, begin=20, end=120) for s in range(150)]
    assert curve[:21] == [0.0] * 21 and curve[120:] == [0.9] * 30
    assert np.all(np.diff(curve) >= 0)
    assert curve[70] == pytest.approx(0.9 * (1 - 0.5**3))
    third = np.diff(curve[20:121], 3)  # of a cubic: constant, 3! / 100**3 of its coefficient
    assert np.allclose(third, 0.9 * 6 / 100**3)
    assert cubic_sparsity(0, final=0.8, end=10, initial=0.3) == pytest.approx(0.3)


def test_gradual_pruning_only_ever_adds_zeros_and_ends_exactly(network: nn.Module) -> None:
    pruning = GradualPruning(network, 0.8, end=12, every=4)
    seen = []

    def after() -> None:
        old = pruning.masks
        pruning.after_step()
        assert all(not (new & ~old[name]).any() for name, new in pruning.masks.items())
        seen.append(sparsity_of(network))

    _train(network, after, 15)
    total = sum(w.numel() for _, w in prunable_weights(network))
    targets = {step: cubic_sparsity(step, final=0.8, end=12) for step in (4, 8, 12)}
    for step, target in targets.items():
        assert seen[step - 1] == round(target * total) / total
    assert seen[-1] == seen[11] and seen[2] == 0.0


@pytest.mark.parametrize(
    "call",
    [
        lambda n: l1_mask(torch.ones(3), 1.5),
        lambda n: l1_mask(torch.ones(3), True),
        lambda n: l1_mask(torch.ones(3), float("nan")),
        lambda n: l1_mask(torch.tensor([1.0, float("nan")]), 0.5),
        lambda n: l1_masks(n, 0.5, scope="both"),
        lambda n: l1_masks(nn.ReLU(), 0.5),
        lambda n: MaskedPruning(n, {"head.1.weight": torch.ones(2, dtype=torch.bool)}),
        lambda n: MaskedPruning(n, {"nothing": torch.ones(2, dtype=torch.bool)}),
        lambda n: cubic_sparsity(1, final=0.5, begin=5, end=5),
        lambda n: GradualPruning(n, 0.5, end=10, every=0),
    ],
)
def test_refusals_say_what_to_do(network: nn.Module, call: object) -> None:
    with pytest.raises(InputError, match="expected"):
        call(network)  # type: ignore[operator]

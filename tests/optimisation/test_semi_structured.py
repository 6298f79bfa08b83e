"""The 2:4 pattern against every way of choosing two of four, and what is (not) promised about its speed."""

from __future__ import annotations

import itertools
from pathlib import Path

import pytest
import torch
from torch import nn

from robotbrain.errors import InputError
from robotbrain.jetson import predict
from robotbrain.optimisation.export import export_onnx
from robotbrain.optimisation.networks import build_student
from robotbrain.optimisation.pruning import MaskedPruning
from robotbrain.optimisation.semi_structured import (
    advice,
    is_two_four,
    two_four_mask,
    two_four_masks,
    two_four_share,
)


@pytest.mark.parametrize("shape", [(3, 8), (5, 12, 3, 3), (2, 4, 1, 1)])
def test_keeps_the_best_two_of_every_four_inputs(shape: tuple[int, ...]) -> None:
    weight = torch.randn(shape, generator=torch.Generator().manual_seed(0))
    mask = two_four_mask(weight)
    assert mask.shape == weight.shape and mask.float().mean() == 0.5
    assert is_two_four(weight * mask) and not is_two_four(weight)
    kept = (weight * mask).abs()
    for out in range(shape[0]):
        for first in range(0, shape[1], 4):
            four, got = weight[out, first : first + 4].abs(), kept[out, first : first + 4]
            best = torch.stack([four[list(pair)].sum(0) for pair in itertools.combinations(range(4), 2)]).amax(0)
            assert torch.allclose(got.sum(0), best)


def test_the_groups_run_along_the_inputs_not_along_the_kernel() -> None:
    weight = torch.zeros(1, 4, 2, 2)
    weight[0, :2] = 1.0  # four in a row in memory, but two of the four inputs at each pixel
    assert is_two_four(weight)
    weight = torch.zeros(1, 4, 2, 2)
    weight[0, :, 0, 0] = 1.0  # one of every four in memory, but all four inputs at one pixel
    assert not is_two_four(weight)


def test_ties_keep_the_first() -> None:
    assert two_four_mask(torch.ones(1, 8)).tolist() == [[True, True, False, False] * 2]


def test_a_network_keeps_the_pattern_through_training() -> None:
    torch.manual_seed(0)
    network = build_student(8)
    masks = two_four_masks(network)
    assert "down.0.0.0.weight" not in masks  # three input channels: an image
    pruning = MaskedPruning(network, masks)
    optimiser = torch.optim.AdamW(network.parameters(), lr=1e-2)
    network(torch.randn(2, 3, 16, 16)).square().mean().backward()
    optimiser.step()
    assert two_four_share(network) < 0.1
    pruning.after_step()
    layers = dict(network.named_parameters())
    assert all(is_two_four(layers[name]) for name in masks)
    total = sum(m.weight.numel() for m in network.modules() if isinstance(m, nn.Conv2d))
    assert two_four_share(network) == sum(m.numel() for m in masks.values()) / total


def test_grouped_and_transposed_convolutions_stay_dense() -> None:
    network = nn.Sequential(nn.Conv2d(8, 8, 3, groups=2), nn.ConvTranspose2d(8, 8, 2), nn.Conv2d(8, 4, 1))
    assert list(two_four_masks(network)) == ["2.weight"]
    with pytest.raises(InputError, match="divisible by 4"):
        two_four_masks(network[:2])


@pytest.mark.parametrize("weight", [torch.ones(4), torch.ones(4, 3, 3, 3), torch.full((1, 4), float("nan"))])
def test_refusals(weight: torch.Tensor) -> None:
    with pytest.raises(InputError, match="expected"):
        two_four_mask(weight)


def test_no_speedup_is_promised_that_nobody_measured() -> None:
    student, wide = build_student(), nn.Sequential(nn.Conv2d(256, 256, 3), nn.Conv2d(256, 4, 1))
    for slug in ("nano-4gb", "tx2", "xavier-nx"):
        said = advice(wide, slug)
        assert not said.supported and "no sparse tensor cores" in said.text
    orin = advice(student, "orin-nano-8gb")
    assert orin.supported and not orin.wide_layers and "expect no gain" in orin.text
    assert advice(wide, "agx-orin-64gb").wide_layers == ("0",)
    with pytest.raises(InputError):
        advice(student, "toaster")


def test_the_twin_counts_the_pattern_as_dense(tmp_path: Path) -> None:
    times = []
    for sparse in (False, True):
        torch.manual_seed(0)
        network = nn.Sequential(nn.Conv2d(256, 256, 3), nn.ReLU(), nn.Conv2d(256, 256, 3)).eval()
        if sparse:
            MaskedPruning(network, two_four_masks(network)).make_permanent()
        path = export_onnx(network, tmp_path / f"{sparse}.onnx", example=(1, 256, 16, 16), check=False)
        times.append(predict(path, "orin-nano-8gb", precision="int8").latency_ms)
    assert times[0] == times[1]

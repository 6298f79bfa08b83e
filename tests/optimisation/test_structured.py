"""Channel pruning: the right channels go, everything that touches them follows, and the result is a plain module."""

from __future__ import annotations

from pathlib import Path

import onnx
import pytest
import torch
from torch import nn

from robotbrain.errors import InputError
from robotbrain.optimisation.export import export_onnx
from robotbrain.optimisation.networks import build_depthwise, build_student, build_teacher
from robotbrain.optimisation.structured import fit_to_state, output_layers, prune_channels, widths_of

IMAGE = torch.randn(2, 3, 32, 32, generator=torch.Generator().manual_seed(0))
BUILDERS = {"student": build_student, "teacher": build_teacher, "depthwise": build_depthwise}


def made(name: str) -> nn.Module:
    """A network whose statistics are not those of the first moment."""
    torch.manual_seed(0)
    network: nn.Module = BUILDERS[name]()
    for layer in network.modules():
        if isinstance(layer, nn.BatchNorm2d):
            layer.weight.data.uniform_(0.5, 1.5)
            layer.bias.data.normal_()
    return network.eval()


@pytest.mark.parametrize("name", BUILDERS)
def test_a_smaller_network_of_the_same_shape(name: str) -> None:
    network = made(name)
    before = {key: value.clone() for key, value in network.state_dict().items()}
    small = prune_channels(network, IMAGE, 0.5)
    assert small(IMAGE).shape == network(IMAGE).shape
    assert type(small) is type(network) and not small.training
    old, new = widths_of(network), widths_of(small)
    (head,) = output_layers(network, IMAGE)
    halved = {layer for layer in old if new[layer] == old[layer] // 2}
    # A depthwise convolution of a concatenation ties both sources together; torch-pruning leaves some of these be.
    assert halved == old.keys() - {head} or (name == "depthwise" and len(halved) >= 8)
    assert new[head] == old[head]
    assert all(torch.equal(value, before[key]) for key, value in network.state_dict().items())
    share = sum(p.numel() for p in small.parameters()) / sum(p.numel() for p in network.parameters())
    assert 0.2 < share < (0.6 if name == "depthwise" else 0.3)


@pytest.mark.parametrize(("importance", "norm"), [("l1", 1), ("l2", 2)])
def test_dead_channels_go_first_and_nothing_changes(importance: str, norm: int) -> None:
    """Channels that contribute nothing: without them the network computes exactly what it did with them."""
    network = nn.Sequential(
        nn.Conv2d(3, 8, 3, padding=1, bias=False), nn.BatchNorm2d(8), nn.ReLU(), nn.Conv2d(8, 4, 1)
    ).eval()
    dead = [1, 4, 6]
    with torch.no_grad():
        for tensor in (network[0].weight, network[1].weight, network[1].bias):
            tensor[dead] = 0.0
        network[3].weight[:, dead] = 0.0
    small = prune_channels(network, IMAGE, 3 / 8, importance=importance)
    assert small[0].out_channels == 5
    assert torch.allclose(small(IMAGE), network(IMAGE), atol=1e-6)
    alive = [i for i in range(8) if i not in dead]
    assert torch.equal(small[0].weight, network[0].weight[alive])


def test_a_skip_connection_shrinks_both_sides_alike() -> None:
    class Residual(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.first, self.second = nn.Conv2d(3, 8, 1), nn.Conv2d(8, 8, 3, padding=1)
            self.head = nn.Conv2d(16, 4, 1)

        def forward(self, x: torch.Tensor) -> torch.Tensor:
            one = self.first(x)
            two = one + self.second(one).relu()
            return self.head(torch.cat([two, one], dim=1))

    torch.manual_seed(0)
    network = Residual()
    small = prune_channels(network, IMAGE, 0.5)
    assert widths_of(small) == {"first": 4, "second": 4, "head": 4} and small.head.in_channels == 8
    kept = [i for i in range(8) if any(torch.equal(network.first.weight[i], row) for row in small.first.weight)]
    assert len(kept) == 4
    # The concatenation reads the same channels twice, and the second summand keeps those of the first.
    both = kept + [8 + i for i in kept]
    assert torch.equal(small.head.weight, network.head.weight[:, both])
    assert torch.equal(small.second.weight, network.second.weight[kept][:, kept])


def test_normalisation_scales_decide_if_asked() -> None:
    network = nn.Sequential(nn.Conv2d(3, 4, 1), nn.BatchNorm2d(4), nn.ReLU(), nn.Conv2d(4, 4, 1)).eval()
    with torch.no_grad():
        network[0].weight[:] = torch.tensor([9.0, 9.0, 1.0, 1.0])[:, None, None, None]
        network[1].weight[:] = torch.tensor([0.1, 0.2, 3.0, 4.0])
        network[3].weight[:] = 1.0
    assert prune_channels(network, IMAGE, 0.5, importance="bn")[1].weight.tolist() == [3.0, 4.0]
    assert prune_channels(network, IMAGE, 0.5, importance="l1")[0].weight[:, 0, 0, 0].tolist() == [9.0, 9.0]


def test_it_trains_on_and_exports(tmp_path: Path) -> None:
    small = prune_channels(made("student"), IMAGE, 0.4, round_to=4).train()
    assert all(width % 4 == 0 for width in widths_of(small).values())
    small(IMAGE).square().mean().backward()
    assert all(p.grad is not None for p in small.parameters())
    path = export_onnx(small, tmp_path / "small.onnx", example=(1, 3, 32, 32))  # compares the two
    sizes = [d.dim_value for d in onnx.load(str(path)).graph.output[0].type.tensor_type.shape.dim]
    assert sizes[1:] == [4, 32, 32]


@pytest.mark.parametrize("name", BUILDERS)
def test_a_state_is_enough_to_come_back(name: str, tmp_path: Path) -> None:
    small = prune_channels(made(name), IMAGE, 0.3, scope="global")
    torch.save(small.state_dict(), tmp_path / "small.pt")
    again = fit_to_state(BUILDERS[name](), torch.load(tmp_path / "small.pt", weights_only=True)).eval()
    assert torch.equal(again(IMAGE), small(IMAGE)) and widths_of(again) == widths_of(small)
    again.train()(IMAGE).mean().backward()
    with pytest.raises(InputError, match="state"):
        fit_to_state(nn.Linear(2, 2), small.state_dict())


def test_the_output_is_found_by_what_comes_after_it() -> None:
    for name in BUILDERS:
        (last,) = output_layers(made(name), IMAGE)
        assert last.startswith("head.")
    plain = nn.Sequential(nn.Conv2d(3, 4, 1), nn.Conv2d(4, 5, 1), nn.BatchNorm2d(5), nn.ReLU())
    assert output_layers(plain, IMAGE) == ["1"]


def test_ignored_layers_keep_their_width() -> None:
    network = made("student")
    first, second, *_ = old = widths_of(network)
    new = widths_of(prune_channels(network, IMAGE, 0.5, ignore=[first]))
    assert new[first] == old[first] and new[second] == old[second] // 2


@pytest.mark.parametrize(
    "options",
    [
        {"ratio": 1.0},
        {"ratio": -0.1},
        {"ratio": float("nan")},
        {"importance": "l3"},
        {"scope": "both"},
        {"ignore": ["nothing"]},
        {"example": torch.zeros(1, 5, 32, 32)},
    ],
)
def test_refusals(options: dict[str, object]) -> None:
    arguments: dict[str, object] = {"example": IMAGE, "ratio": 0.5} | options
    with pytest.raises(InputError, match="expected"):
        prune_channels(made("student"), **arguments)  # type: ignore[arg-type]


def test_pruning_that_removes_nothing_is_no_silent_success() -> None:
    torch.manual_seed(0)
    with pytest.raises(InputError, match="untrained"):  # all scales are 1: none is the least important
        prune_channels(build_student(8), IMAGE, 0.5, importance="bn", scope="global")

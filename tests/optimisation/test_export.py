"""The file computes what the module computes, or there is no file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from torch import nn

import robotbrain.optimisation.export as export_module
from robotbrain.errors import InputError, RobotBrainError
from robotbrain.optimisation.evaluate import onnx_session
from robotbrain.optimisation.export import export_onnx
from robotbrain.optimisation.networks import build_student


def seasoned() -> nn.Module:
    """A student whose batch norms have seen data, so that folding them matters."""
    torch.manual_seed(1)
    network = build_student(4)
    with torch.no_grad():
        network(torch.randn(8, 3, 64, 64) * 3 + 1)
    return network


@pytest.mark.parametrize("opset", [13, 17])
def test_it_agrees_with_torch_at_any_batch_and_leaves_the_module_alone(tmp_path: Path, opset: int) -> None:
    network = seasoned().train()
    before = {k: v.clone() for k, v in network.state_dict().items()}
    path = export_onnx(network, tmp_path / "sub" / "net.onnx", opset=opset)
    assert network.training and all(torch.equal(v, before[k]) for k, v in network.state_dict().items())
    model = onnx.load(path)
    assert model.opset_import[0].version == opset
    assert not any(node.op_type == "BatchNormalization" for node in model.graph.node)
    session = onnx_session(path)
    for batch in (1, 2, 5):
        x = torch.randn(batch, 3, 64, 64)
        with torch.no_grad():
            wanted = network.eval()(x).numpy()
        np.testing.assert_allclose(session.run(["logits"], {"image": x.numpy()})[0], wanted, atol=1e-4)


def test_names_and_a_fixed_batch_are_as_asked_for(tmp_path: Path) -> None:
    path = export_onnx(
        nn.Conv2d(2, 5, 1),
        tmp_path / "c.onnx",
        input_name="a",
        output_name="b",
        example=(4, 2, 3, 3),
        dynamic_batch=False,
    )
    session = onnx_session(path)
    assert (session.get_inputs()[0].name, session.get_inputs()[0].shape) == ("a", [4, 2, 3, 3])
    assert (session.get_outputs()[0].name, session.get_outputs()[0].shape) == ("b", [4, 5, 3, 3])


def test_the_same_module_gives_the_same_bytes_and_no_names_of_this_machine(tmp_path: Path) -> None:
    network = seasoned()
    one, two = (export_onnx(network, tmp_path / name).read_bytes() for name in ("one.onnx", "two.onnx"))
    assert one == two
    assert b".py" not in one and str(Path.home()).encode() not in one


class Noisy(nn.Module):
    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return x + torch.randn_like(x)


class MixesImages(nn.Module):
    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return x / len(x)  # a Python number: the trace keeps 1 for ever


@pytest.mark.parametrize("module", [Noisy(), MixesImages()])
def test_a_file_that_computes_something_else_is_not_written(tmp_path: Path, module: nn.Module) -> None:
    target = tmp_path / "net.onnx"
    target.write_bytes(b"the one before")
    with pytest.raises(RobotBrainError, match="differs from the module"):
        export_onnx(module, target)
    assert target.read_bytes() == b"the one before"
    assert [p.name for p in tmp_path.iterdir()] == ["net.onnx"]


def test_another_opset_than_asked_for_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What torch's newer exporter does when asked for 13, imitated."""
    genuine = torch.onnx.export

    def newer(*arguments: object, **options: object) -> object:
        return genuine(*arguments, **{**options, "opset_version": 18})  # type: ignore[arg-type]

    monkeypatch.setattr(torch.onnx, "export", newer)
    with pytest.raises(RobotBrainError, match="opset 18 instead of 13"):
        export_onnx(nn.Conv2d(3, 4, 1), tmp_path / "net.onnx", opset=13)
    assert not list(tmp_path.iterdir())


def test_the_check_is_as_strict_as_it_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(export_module, "TOLERANCE", 0.0)
    with pytest.raises(RobotBrainError, match="allowed: 0"):
        export_onnx(seasoned(), tmp_path / "net.onnx")
    assert export_onnx(seasoned(), tmp_path / "net.onnx", check=False).is_file()


def test_mistakes_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"\.onnx"):
        export_onnx(nn.Identity(), tmp_path / "net.pt")
    for opset in (7, 21):
        with pytest.raises(InputError, match="opset"):
            export_onnx(nn.Identity(), tmp_path / "net.onnx", opset=opset)
    with pytest.raises(InputError, match="consists of exportable operators"):
        export_onnx(nn.Conv2d(7, 1, 1), tmp_path / "net.onnx")

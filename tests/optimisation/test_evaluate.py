"""The figure is computed as it should be, for modules, files and sessions alike."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from robotbrain.errors import InputError
from robotbrain.optimisation.data import IGNORE, Scenes
from robotbrain.optimisation.evaluate import confusion, intersection_over_union, mean_iou, onnx_session, predict
from robotbrain.optimisation.export import export_onnx
from robotbrain.optimisation.networks import build_student
from robotbrain.pipeline.segmentation import CLASSES


class Oracle(nn.Module):
    """Reads the class off the red channel: 10, 70, 130, 190 of 255."""

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        red = image[:, :1] * 0.25 + 0.45
        centre = torch.tensor([10.0, 70.0, 130.0, 190.0]).view(1, 4, 1, 1) / 255
        return -((red - centre) ** 2) * 1000


def painted(classes: np.ndarray) -> np.ndarray:
    images = np.zeros((*classes.shape, 3), np.uint8)
    images[..., 0] = 10 + 60 * classes
    return images


def test_a_case_worked_out_by_hand() -> None:
    truth = np.array([[0, 0, 1, 1, 2, 2, IGNORE]])
    answer = np.array([[0, 1, 1, 1, 2, 0, 2]])
    counts = confusion(truth, answer, 3)
    np.testing.assert_array_equal(counts, [[1, 1, 0], [0, 2, 0], [1, 0, 1]])
    np.testing.assert_allclose(intersection_over_union(counts), [1 / 3, 2 / 3, 1 / 2])


def test_a_known_answer_gives_the_known_figure() -> None:
    """Over all pixels together, not image by image; a class that is nowhere has no say."""
    truth = np.random.default_rng(0).integers(0, 3, (60, 8, 8)).astype(np.uint8)  # more than one batch, no class 3
    assert mean_iou(Oracle(), Scenes(painted(truth), truth)).mean == 1.0
    seen = truth.copy()
    seen[:30][truth[:30] == 0] = 1  # class 0 is taken for 1 in half of the images
    result = mean_iou(Oracle(), Scenes(painted(seen), truth))
    zero, one = (truth == 0).sum(), (truth == 1).sum()
    wrong = (truth[:30] == 0).sum()
    assert result.per_class["background"] == pytest.approx((zero - wrong) / zero)
    assert result.per_class["floor"] == pytest.approx(one / (one + wrong))
    assert math.isnan(result.per_class["marker"])
    assert result.mean == pytest.approx(np.mean([result.per_class[c] for c in CLASSES[:3]]))


def test_module_file_and_session_agree_with_and_without_optimisation(tmp_path: Path) -> None:
    torch.manual_seed(0)
    network = build_student(4)
    path = export_onnx(network, tmp_path / "net.onnx")
    rng = np.random.default_rng(1)
    images = rng.integers(0, 256, (7, 64, 64, 3)).astype(np.uint8)
    some = Scenes(images, rng.integers(0, 4, (7, 64, 64)).astype(np.uint8))
    figures = [
        mean_iou(m, some, optimise=o).mean
        for m in (network, path, str(path), onnx_session(path))
        for o in (True, False)
    ]
    np.testing.assert_allclose(figures, figures[0], atol=2e-4)
    np.testing.assert_allclose(predict(path, images), predict(network, images), atol=1e-4)


def test_batch_norm_is_in_eval_mode_and_the_module_is_left_as_it_was() -> None:
    network = build_student(4).train()
    network.down[0].eval()
    before = {k: v.clone() for k, v in network.state_dict().items()}
    some = Scenes(np.zeros((2, 64, 64, 3), np.uint8), np.zeros((2, 64, 64), np.uint8))
    mean_iou(network, some)
    assert network.training and not network.down[0].training and network.head.training
    assert all(torch.equal(v, before[k]) for k, v in network.state_dict().items())


def test_optimise_false_computes_the_graph_as_written(tmp_path: Path) -> None:
    """ONNX Runtime fuses convolution and ReLU unless told not to: seen in the graph that it says it runs."""
    import onnx
    import onnxruntime

    path = export_onnx(build_student(4), tmp_path / "net.onnx")
    for optimise, relu_left in ((True, False), (False, True)):
        session = onnx_session(path, optimise=optimise)
        options = session.get_session_options()
        options.optimized_model_filepath = str(tmp_path / f"{optimise}.onnx")
        onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
        kinds = {node.op_type for node in onnx.load(options.optimized_model_filepath).graph.node}
        assert ("Relu" in kinds) is relu_left


def test_a_file_with_a_fixed_batch_is_measured_image_by_image(tmp_path: Path) -> None:
    truth = np.random.default_rng(2).integers(0, 4, (5, 8, 8)).astype(np.uint8)
    path = export_onnx(Oracle(), tmp_path / "one.onnx", example=(1, 3, 8, 8), dynamic_batch=False)
    assert mean_iou(path, Scenes(painted(truth), truth)).mean == 1.0


def test_mistakes_are_named(tmp_path: Path) -> None:
    truth = np.zeros((2, 8, 8), np.uint8)
    some = Scenes(painted(truth), truth)
    with pytest.raises(InputError, match="path of an ONNX file"):
        mean_iou(tmp_path / "none.onnx", some)
    (tmp_path / "bad.onnx").write_bytes(b"not a network")
    with pytest.raises(InputError, match="ONNX Runtime says"):
        onnx_session(tmp_path / "bad.onnx")
    with pytest.raises(InputError, match="labels"):
        mean_iou(Oracle(), some.without_labels())
    with pytest.raises(InputError, match="logits"):
        mean_iou(nn.AvgPool2d(2), some)
    with pytest.raises(InputError, match="NaN"):
        mean_iou(nn.Conv2d(3, 4, 1).requires_grad_(False).apply(lambda m: m.weight.fill_(math.nan)), some)  # type: ignore[operator]

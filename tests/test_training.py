"""The shipped network is as good as its provenance says; the figure is computed as it should be."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import onnxruntime
import pytest

from robotbrain.errors import InputError
from robotbrain.pipeline.brain import default_model
from robotbrain.sim.dataset import render_dataset
from robotbrain.training.segmentation import (
    HELD_OUT_SEED,
    TrainConfig,
    build_network,
    confusion,
    evaluate,
    export,
    intersection_over_union,
    train,
)


def test_the_shipped_network_recognises_worlds_it_never_saw() -> None:
    images, labels, _ = render_dataset(range(HELD_OUT_SEED, HELD_OUT_SEED + 25), 4)
    session = onnxruntime.InferenceSession(str(default_model()), providers=["CPUExecutionProvider"])
    iou = evaluate(session, images, labels)
    assert iou.mean() >= 0.90
    assert iou.min() >= 0.85
    provenance = json.loads(default_model().with_suffix(".json").read_text(encoding="utf-8"))
    assert iou.mean() == pytest.approx(provenance["held_out_mean_iou"], abs=0.02)


def test_iou_of_a_case_worked_out_by_hand() -> None:
    truth = np.array([[0, 0, 1, 1, 2, 2]])
    answer = np.array([[0, 1, 1, 1, 2, 0]])
    counts = confusion(truth, answer, 3)
    np.testing.assert_array_equal(counts, [[1, 1, 0], [0, 2, 0], [1, 0, 1]])
    np.testing.assert_allclose(intersection_over_union(counts), [1 / 3, 2 / 3, 1 / 2])
    np.testing.assert_allclose(intersection_over_union(confusion(truth, truth, 3)), 1.0)


def test_the_exported_network_is_the_trained_one_and_takes_any_batch(tmp_path: Path) -> None:
    import torch

    torch.manual_seed(1)
    network = build_network(4)
    with torch.no_grad():  # statistics as after training, so that folding them matters
        network(torch.randn(8, 3, 64, 64))
    path = tmp_path / "net.onnx"
    export(network, path)
    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    for batch in (1, 3):
        x = torch.randn(batch, 3, 64, 64)
        with torch.no_grad():
            expected = network.eval()(x).numpy()
        np.testing.assert_allclose(session.run(None, {"image": x.numpy()})[0], expected, atol=1e-4)


def test_training_learns_and_writes_its_provenance(tmp_path: Path) -> None:
    out = tmp_path / "small.onnx"
    config = TrainConfig(worlds=8, images_per_world=8, epochs=20, batch_size=16, held_out_worlds=3, width=4)
    provenance = train(config, out, progress=False)
    assert provenance["held_out_iou"]["floor"] > 0.4  # guessing would give less than a quarter
    assert json.loads(out.with_suffix(".json").read_text())["recipe"]["worlds"] == 8
    assert [p.suffix for p in sorted(tmp_path.iterdir())] == [".json", ".onnx"]


@pytest.mark.parametrize(
    ("config", "name", "words"),
    [(TrainConfig(), "net.pt", "onnx"), (TrainConfig(worlds=600_000), "net.onnx", "apart")],
)
def test_a_recipe_that_cannot_be_right_is_refused(tmp_path: Path, config: TrainConfig, name: str, words: str) -> None:
    with pytest.raises(InputError, match=words):
        train(config, tmp_path / name)

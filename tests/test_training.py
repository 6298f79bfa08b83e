"""The shipped network is as good as its provenance says; the figure is computed as it should be."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import onnxruntime
import pytest

from robotbrain.cli import main
from robotbrain.errors import InputError
from robotbrain.optimisation.data import IGNORE, Scenes
from robotbrain.optimisation.distillation import DistilConfig
from robotbrain.optimisation.evaluate import mean_iou
from robotbrain.optimisation.networks import build_student, load_weights, parameter_count
from robotbrain.optimisation.training import FitConfig, TeacherTargets
from robotbrain.pipeline.brain import default_model
from robotbrain.sim.dataset import render_dataset
from robotbrain.training import perception
from robotbrain.training.perception import Recipe, images_of, student_recipe, train_network
from robotbrain.training.segmentation import (
    HELD_OUT_SEED,
    TrainConfig,
    build_network,
    export,
    train,
)


def test_the_shipped_network_recognises_worlds_it_never_saw() -> None:
    images, labels, _ = render_dataset(range(HELD_OUT_SEED, HELD_OUT_SEED + 25), 4)
    iou = mean_iou(default_model(), Scenes(images, labels))
    assert iou.mean >= 0.90
    assert min(iou.per_class.values()) >= 0.85
    provenance = json.loads(default_model().with_suffix(".json").read_text(encoding="utf-8"))
    assert iou.mean == pytest.approx(provenance["held_out_mean_iou"], abs=0.02)


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


@pytest.fixture
def few_images(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Small sizes in a cache of their own, so that a training of a shipped network takes a second."""
    monkeypatch.setenv("ROBOTBRAIN_CACHE", str(tmp_path / "cache"))
    for name, size in {"LABELLED": 40, "UNLABELLED": 40, "STEPS": 10, "VALIDATION_IMAGES": 8, "TEST_IMAGES": 8}.items():
        monkeypatch.setattr(perception, name, size)


def test_variants_of_the_student_differ_in_what_they_should(few_images: None) -> None:
    """Same labels and about the same number of steps; the plain one knows neither teacher nor unlabelled images."""
    plain, same, more = student_recipe(plain=True), student_recipe(unlabelled=0), student_recipe(unlabelled=40)
    assert plain.distil is None and plain.unlabelled == 0
    assert same.distil is not None and same.distil == more.distil
    assert {r.fit.epochs * ((r.labelled + r.unlabelled) // r.fit.batch_size) for r in (plain, same, more)} == {10}
    scenes = images_of(more)
    np.testing.assert_array_equal(scenes.images[:40], images_of(plain).images)
    assert (scenes.labels[:40] != IGNORE).all() and (scenes.labels[40:] == IGNORE).all()
    with pytest.raises(InputError, match="unlabelled"):
        student_recipe(unlabelled=-1)


def test_a_student_is_written_with_weights_and_provenance(
    few_images: None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out" / "student.onnx"
    command = ["train", "student", "--seed", "3", "--plain", "--quiet", "--out", str(out)]
    assert main([*command, "--run-dir", str(tmp_path / "run")]) == 0
    provenance = json.loads(out.with_suffix(".json").read_text(encoding="utf-8"))
    assert provenance["made_by"] == "robotbrain train student --seed 3 --plain"
    assert provenance["recipe"]["fit"]["seed"] == 3
    assert "held" not in capsys.readouterr().err
    assert (tmp_path / "run" / "fit.pt").is_file()
    network = load_weights(build_student(), out.with_suffix(".pt"))
    test = perception.scenes("test", 8)
    assert mean_iou(network, test).mean == pytest.approx(provenance["test_8_images"]["mean_iou"], abs=2e-3)
    assert provenance["parameters"] == parameter_count(network)


def test_the_teachers_answers_may_be_given_in_advance(few_images: None, tmp_path: Path) -> None:
    import torch

    recipe = Recipe(FitConfig(epochs=1, batch_size=20), 40, 0, DistilConfig(alpha=1.0))
    answers = TeacherTargets(torch.randn(60, 4, 64, 64).half(), None).first(40)
    provenance = train_network(
        build_student(4), recipe, tmp_path / "s.onnx", command="a test", teacher=answers, progress=False
    )
    assert provenance["steps"] == 2 and provenance["recipe"]["distil"]["alpha"] == 1.0


@pytest.mark.parametrize(
    "words",
    [["teacher", "--plain"], ["segmentation", "--unlabelled", "5"], ["student", "--plain", "--unlabelled", "5"]],
)
def test_options_that_do_not_go_together_are_refused(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["train", *words]) == 2
    assert "--unlabelled" in capsys.readouterr().err

"""The loop: it learns, repeats itself, survives interrupts bit for bit, and asks its teacher properly."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

import robotbrain.optimisation.training as training
from robotbrain.errors import InputError, RobotBrainError
from robotbrain.optimisation.data import Scenes
from robotbrain.optimisation.distillation import DistilConfig, distillation_loss
from robotbrain.optimisation.export import export_onnx
from robotbrain.optimisation.networks import UNet
from robotbrain.optimisation.training import FitConfig, fit, teacher_targets

CONFIG = FitConfig(epochs=3, batch_size=8, learning_rate=1e-2, seed=3)


def tiny(seed: int = 0, width: int = 4) -> UNet:
    torch.manual_seed(seed)
    return UNet((width, 8), (1, 1))


@pytest.fixture(scope="module")
def striped() -> Scenes:
    """42 images of 16x16 whose class is the brightness, with noise: five batches and two left over."""
    rng = np.random.default_rng(0)
    labels = rng.integers(0, 4, (42, 4, 4)).repeat(4, axis=1).repeat(4, axis=2).astype(np.uint8)
    images = (labels[..., None] * 60.0 + rng.normal(20, 8, (42, 16, 16, 3))).clip(0, 255).astype(np.uint8)
    return Scenes(images, labels)


def weights(network: nn.Module) -> dict[str, torch.Tensor]:
    return {name: value.clone() for name, value in network.state_dict().items()}


def same(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> bool:
    return all(torch.equal(a[name], b[name]) for name in a)


class Stop(Exception):  # noqa: N818
    """The power cut."""


def stop_after(steps: int) -> Callable[[nn.Module], None]:
    left = [steps]

    def callback(_: nn.Module) -> None:
        left[0] -= 1
        if left[0] < 0:
            raise Stop

    return callback


def test_it_learns_repeats_itself_and_leaves_the_global_generator_alone(striped: Scenes) -> None:
    torch.manual_seed(123)
    before = torch.get_rng_state()
    one, two = tiny(), tiny()
    torch.set_rng_state(before)
    first = fit(one, striped, CONFIG, progress=False)
    assert torch.equal(torch.get_rng_state(), before)
    second = fit(two, striped, CONFIG, progress=False)
    assert same(weights(one), weights(two)) and first.history == second.history
    assert first.steps == 15 and len(first.history) == 3
    assert first.history[-1] < 0.7 * first.history[0]
    assert not one.training
    other = tiny()
    fit(other, striped, FitConfig(**{**CONFIG.__dict__, "seed": 4}), progress=False)
    assert not same(weights(one), weights(other))


@pytest.mark.parametrize("when", [1, 5, 7, 14])
@pytest.mark.parametrize("distil", [None, DistilConfig(feature_weight=0.5)])
def test_an_interrupted_training_ends_where_an_undisturbed_one_does(
    striped: Scenes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, when: int, distil: DistilConfig | None
) -> None:
    """In the first step, at the border of an epoch, within one and before the last: BN statistics, flips."""
    monkeypatch.setattr(training, "SAVE_EVERY_S", 0.0)
    teacher = tiny(9, width=6).eval() if distil else None
    whole, parts = tiny(), tiny()
    history = fit(whole, striped, CONFIG, teacher=teacher, distil=distil, progress=False).history
    with pytest.raises(Stop):
        fit(
            parts, striped, CONFIG, teacher=teacher, distil=distil, run_dir=tmp_path, after_step=stop_after(when),
            progress=False,
        )  # fmt: skip
    resumed = tiny()
    counted = [0]

    def count(_: nn.Module) -> None:
        counted[0] += 1

    result = fit(
        resumed, striped, CONFIG, teacher=teacher, distil=distil, run_dir=tmp_path, after_step=count, progress=False
    )
    assert counted[0] == 15 - when  # it did go on, rather than begin again
    assert same(weights(whole), weights(resumed))
    assert result.history == history
    finished = tiny()
    fit(
        finished,
        striped,
        CONFIG,
        teacher=teacher,
        distil=distil,
        run_dir=tmp_path,
        after_step=stop_after(0),
        progress=False,
    )
    assert same(weights(whole), weights(finished))


def test_what_a_network_draws_itself_survives_an_interrupt(
    striped: Scenes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(training, "SAVE_EVERY_S", 0.0)

    def dropping() -> nn.Module:
        return nn.Sequential(tiny(), nn.Dropout(0.5))

    whole, resumed = dropping(), dropping()
    fit(whole, striped, CONFIG, progress=False)
    with pytest.raises(Stop):
        fit(dropping(), striped, CONFIG, run_dir=tmp_path, after_step=stop_after(4), progress=False)
    fit(resumed, striped, CONFIG, run_dir=tmp_path, progress=False)
    assert same(weights(whole), weights(resumed))


def test_another_training_does_not_go_on_from_this_folder(striped: Scenes, tmp_path: Path) -> None:
    fit(tiny(), striped, CONFIG, run_dir=tmp_path, progress=False)
    for network, scenes, config in (
        (tiny(1), striped, CONFIG),
        (tiny(), striped[:41], CONFIG),
        (tiny(), striped, FitConfig(**{**CONFIG.__dict__, "epochs": 4})),
    ):
        with pytest.raises(InputError, match="run_dir"):
            fit(network, scenes, config, run_dir=tmp_path, progress=False)
    with pytest.raises(InputError, match="run_dir"):
        fit(tiny(), striped, CONFIG, teacher=tiny(5), run_dir=tmp_path, progress=False)


def test_the_teacher_answers_in_eval_mode_and_is_left_as_it_was(striped: Scenes) -> None:
    teacher = tiny(7).train()
    with torch.no_grad():
        teacher(torch.randn(8, 3, 16, 16) * 2)
    before = weights(teacher)
    targets = teacher_targets(teacher, striped, features=True)
    assert teacher.training and same(before, weights(teacher))
    assert all(p.grad is None for p in teacher.parameters())
    teacher.eval()
    with torch.no_grad():
        wanted = teacher(torch.from_numpy(striped.inputs()))
        coarse = teacher.features(torch.from_numpy(striped.inputs()))
    torch.testing.assert_close(targets.logits.float(), wanted, atol=5e-3, rtol=2e-3)
    assert targets.features is not None and targets.features.shape == coarse.shape
    fit(tiny(), striped, CONFIG, teacher=teacher, progress=False)
    assert same(before, weights(teacher)) and all(p.grad is None for p in teacher.parameters())


@pytest.mark.parametrize("weighted", [True, False])
def test_the_first_loss_is_that_of_the_formula(striped: Scenes, weighted: bool) -> None:
    """One batch of all images, mirrored or not: computed here from the networks themselves."""
    teacher, network = tiny(7).eval(), tiny()
    config = FitConfig(epochs=1, batch_size=42, flip=False)
    image, labels = torch.from_numpy(striped.inputs()), torch.from_numpy(striped.labels.astype(np.int64))
    with torch.no_grad():
        expected = distillation_loss(
            tiny().train()(image), teacher(image), labels,
            temperature=2.0, alpha=0.4, class_weights=torch.tensor([1.0, 1.0, 1.0, 3.0]),
            soft_weights=torch.tensor([1.0, 1.0, 1.0, 3.0]) if weighted else None,
        )  # fmt: skip
    result = fit(
        network, striped, config, teacher=teacher, distil=DistilConfig(2.0, 0.4, weighted=weighted), progress=False
    )
    assert result.history[0] == pytest.approx(expected.item(), rel=2e-3)


def test_targets_are_mirrored_with_the_image(striped: Scenes, monkeypatch: pytest.MonkeyPatch) -> None:
    """A 1x1 student that equals its 1x1 teacher has no soft loss, mirrored or not; with wrong mirroring it would."""
    pairs = []
    genuine = training.distillation_loss

    def spy(student: torch.Tensor, teacher: torch.Tensor, labels: torch.Tensor, **options: object) -> torch.Tensor:
        pairs.append((student.detach(), teacher, labels))
        return genuine(student, teacher, labels, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(training, "distillation_loss", spy)
    torch.manual_seed(0)
    student = nn.Conv2d(3, 4, 1)
    teacher = nn.Conv2d(3, 4, 1)
    teacher.load_state_dict(student.state_dict())
    still = FitConfig(epochs=4, batch_size=8, learning_rate=1e-12, weight_decay=0.0)
    fit(student, striped, still, teacher=teacher, progress=False)
    for mine, theirs, _ in pairs:
        torch.testing.assert_close(mine, theirs, atol=5e-3, rtol=2e-3)
    assert len(pairs) == 20


def test_images_without_labels_teach_through_the_teacher_alone(striped: Scenes) -> None:
    mixed = striped.without_labels()
    silent, taught = tiny(), tiny()
    before = weights(silent)
    still = FitConfig(epochs=2, batch_size=8, weight_decay=0.0)
    fit(silent, mixed, still, progress=False)
    assert all(torch.equal(before[n], p) for n, p in silent.named_parameters())  # nothing to learn from
    losses = fit(taught, mixed, FitConfig(epochs=10, batch_size=8), teacher=tiny(5).eval(), progress=False).history
    assert losses[-1] < 0.5 * losses[0]


def test_after_step_sees_every_step_and_has_the_last_word(striped: Scenes) -> None:
    network = tiny()

    def silence(module: nn.Module) -> None:
        module.head[-1].weight.data[0] = 0.0  # type: ignore[index, operator, union-attr]

    fit(network, striped, CONFIG, after_step=silence, progress=False)
    assert not network.head[-1].weight[0].any() and network.head[-1].weight[1].any()  # type: ignore[index, union-attr]


def test_divergence_is_said_and_not_saved(striped: Scenes, tmp_path: Path) -> None:
    network = tiny()
    network.head[-1].weight.data[:] = float("nan")  # type: ignore[index, operator, union-attr]
    with pytest.raises(RobotBrainError, match="diverged"):
        fit(network, striped, CONFIG, run_dir=tmp_path, progress=False)
    assert not list(tmp_path.iterdir())


def test_mistakes_are_named(striped: Scenes) -> None:
    for bad in ({"epochs": 0}, {"batch_size": 0}, {"learning_rate": 0.0}, {"epochs": 1.5}, {"class_weights": (-1.0,)}):
        with pytest.raises(InputError, match="FitConfig"):
            FitConfig(**bad)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="batch"):
        fit(tiny(), striped[:5], CONFIG, progress=False)
    with pytest.raises(InputError, match="teacher"):
        fit(tiny(), striped, CONFIG, distil=DistilConfig(), progress=False)
    with pytest.raises(InputError, match="same scenes"):
        fit(tiny(), striped, CONFIG, teacher=teacher_targets(tiny(), striped[:9]), progress=False)
    with pytest.raises(InputError, match="features"):
        targets = teacher_targets(tiny(), striped)
        fit(tiny(), striped, CONFIG, teacher=targets, distil=DistilConfig(feature_weight=1.0), progress=False)


def test_the_teachers_file_answers_as_the_teacher(striped: Scenes, tmp_path: Path) -> None:
    teacher = tiny(7)
    path = export_onnx(teacher, tmp_path / "teacher.onnx", example=(1, 3, 16, 16))
    torch.testing.assert_close(
        teacher_targets(path, striped).logits, teacher_targets(teacher, striped).logits, atol=5e-3, rtol=2e-3
    )
    with pytest.raises(InputError, match="features"):
        teacher_targets(path, striped, features=True)

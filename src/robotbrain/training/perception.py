"""Recipes of the shipped teacher and students (``robotbrain train teacher|student``).

The teacher learns from many labelled images. The student gets few labels; with the teacher's help it also learns from
images that nobody labelled. The plain student has the same network, labels and number of steps, but no teacher.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from torch import nn

from robotbrain.errors import InputError
from robotbrain.files import atomic_path, write_text
from robotbrain.optimisation import networks
from robotbrain.optimisation.data import Scenes, join, scenes
from robotbrain.optimisation.distillation import DistilConfig
from robotbrain.optimisation.evaluate import IoUResult, mean_iou
from robotbrain.optimisation.export import export_onnx
from robotbrain.optimisation.training import FitConfig, TeacherTargets, fit, teacher_targets

VALIDATION_IMAGES, TEST_IMAGES = 600, 1200

LABELLED, UNLABELLED, STEPS = 144, 2_856, 3_000
"""Images of the shipped student (twelve worlds have labels: what one person draws in a few days), and its steps."""


BATCH_SIZE = 16

DISTIL = DistilConfig(temperature=1.0, alpha=0.9)


@dataclass(frozen=True)
class Recipe:
    """What a shipped network is made of.

    Attributes:
        fit: of the loop.
        labelled: images of the split ``train``, with labels.
        unlabelled: images of the split ``unlabelled``, without.
        distil: how to listen to the teacher; None: not at all.
    """

    fit: FitConfig
    labelled: int
    unlabelled: int = 0
    distil: DistilConfig | None = None


def teacher_recipe(seed: int = 0) -> Recipe:
    """Return the teacher's: 9,600 labelled images."""
    return Recipe(FitConfig(epochs=5, learning_rate=4e-3, seed=seed), labelled=9_600)


def student_recipe(seed: int = 0, *, plain: bool = False, unlabelled: int | None = None) -> Recipe:
    """Return the student's.

    Args:
        seed: of weights, order and flips.
        plain: without a teacher: the baseline.
        unlabelled: further images that only the teacher has looked at. The number of steps stays about the same: the
            more images, the fewer passes over them. None: UNLABELLED.
    """
    more = UNLABELLED if unlabelled is None else unlabelled
    if not 0 <= more <= 20 * UNLABELLED:
        raise InputError("unlabelled", given=more, expected=f"0 to {20 * UNLABELLED}", fix=f"Use {UNLABELLED}.")
    images = LABELLED + (0 if plain else more)
    epochs = round(STEPS / (images // BATCH_SIZE))
    config = FitConfig(epochs=epochs, batch_size=BATCH_SIZE, seed=seed)
    return Recipe(config, LABELLED) if plain else Recipe(config, LABELLED, more, DISTIL)


def images_of(recipe: Recipe, *, progress: bool = False) -> Scenes:
    """Return what a recipe learns from; images without labels have IGNORE everywhere."""
    labelled = scenes("train", recipe.labelled, progress=progress)
    if not recipe.unlabelled:
        return labelled
    return join(labelled, scenes("unlabelled", recipe.unlabelled, progress=progress).without_labels())


def train_network(
    network: networks.UNet,
    recipe: Recipe,
    out: Path,
    *,
    command: str,
    teacher: nn.Module | TeacherTargets | None = None,
    run_dir: Path | None = None,
    progress: bool = True,
) -> dict[str, Any]:
    """Train, export, measure; write ``out`` (.onnx) with weights (.pt) and provenance (.json) beside it.

    Returns:
        The provenance; its figures are measured through ONNX Runtime.
    """
    if out.suffix != ".onnx":
        raise InputError("output", given=str(out), expected="a path ending in .onnx", fix="Add the suffix.")
    data = images_of(recipe, progress=progress)
    result = fit(network, data, recipe.fit, teacher=teacher, distil=recipe.distil, run_dir=run_dir, progress=progress)
    save_weights(network, out.with_suffix(".pt"))
    export_onnx(network, out)
    validation = mean_iou(out, scenes("validation", VALIDATION_IMAGES, progress=progress))
    test = mean_iou(out, scenes("test", TEST_IMAGES, progress=progress))
    provenance: dict[str, Any] = {
        "made_by": command,
        "recipe": asdict(recipe),
        "data": "robotbrain.optimisation.data: labelled from split train, the rest from split unlabelled",
        "parameters": networks.parameter_count(network),
        "steps": result.steps,
        "final_loss": round(result.history[-1], 5),
        f"validation_{VALIDATION_IMAGES}_images": _figures(validation),
        f"test_{TEST_IMAGES}_images": _figures(test),
        "bytes": out.stat().st_size,
        "minutes": round(result.seconds / 60, 1),
        "torch": torch.__version__,
    }
    write_text(out.with_suffix(".json"), json.dumps(provenance, indent=2) + "\n")
    return provenance


def save_weights(network: nn.Module, path: Path) -> None:
    """Write the state dict, tensors only, contiguous and on the CPU; the same weights give the same bytes."""
    state = {name: value.detach().cpu().contiguous() for name, value in network.state_dict().items()}
    with atomic_path(path) as temporary, temporary.open("wb") as file:  # a path's name would get into the archive
        torch.save(state, file)


def train_teacher(seed: int, out: Path, *, run_dir: Path | None = None, progress: bool = True) -> dict[str, Any]:
    """Train the teacher as it is shipped; see :func:`train_network`."""
    torch.manual_seed(seed)
    command = f"robotbrain train teacher --seed {seed}"
    return train_network(
        networks.build_teacher(), teacher_recipe(seed), out, command=command, run_dir=run_dir, progress=progress
    )


def train_student(
    seed: int,
    out: Path,
    *,
    plain: bool = False,
    unlabelled: int | None = None,
    targets: TeacherTargets | None = None,
    run_dir: Path | None = None,
    progress: bool = True,
) -> dict[str, Any]:
    """Train a student as it is shipped, from the shipped teacher or without; see :func:`train_network`.

    Args:
        seed: of the weights and the order.
        out: of the ONNX file.
        plain: without a teacher.
        unlabelled: of :func:`student_recipe`.
        targets: what the teacher said about these images, or about more that begin with these; None asks it.
        run_dir: folder of a checkpoint.
        progress: show bars.
    """
    recipe = student_recipe(seed, plain=plain, unlabelled=unlabelled)
    teacher: TeacherTargets | None = None
    if not plain:
        count = recipe.labelled + recipe.unlabelled
        if targets is None:
            targets = teacher_targets(networks.network_path("teacher"), images_of(recipe), progress=progress)
        teacher = targets.first(count)
    torch.manual_seed(seed)
    options = " --plain" if plain else "" if unlabelled is None else f" --unlabelled {unlabelled}"
    command = f"robotbrain train student --seed {seed}{options}"
    network = networks.build_student()
    return train_network(network, recipe, out, command=command, teacher=teacher, run_dir=run_dir, progress=progress)


def _figures(result: IoUResult) -> dict[str, float]:
    return {"mean_iou": round(result.mean, 4), **{name: round(value, 4) for name, value in result.per_class.items()}}

"""How well a network segments: mean intersection over union, for torch modules and for ONNX files alike."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from robotbrain.errors import InputError
from robotbrain.optimisation.data import IGNORE, Scenes
from robotbrain.pipeline.segmentation import CLASSES, normalise

if TYPE_CHECKING:
    from torch import nn

BATCH = 50


@dataclass(frozen=True)
class IoUResult:
    """Intersection over union, 0 to 1.

    Attributes:
        per_class: of each class, over the pixels of all images together; NaN for one that is neither there nor claimed.
        mean: of the classes that are not NaN.
    """

    mean: float
    per_class: dict[str, float]


def confusion(labels: NDArray[Any], predicted: NDArray[Any], classes: int = len(CLASSES)) -> NDArray[np.int64]:
    """Return the (classes, classes) pixel counts, rows the truth, columns the prediction; IGNORE is left out."""
    known = labels != IGNORE
    index = labels[known].astype(np.int64) * classes + predicted[known].astype(np.int64)
    return np.bincount(index, minlength=classes * classes).reshape(classes, classes)


def intersection_over_union(counts: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the IoU of each class from a confusion matrix, over all pixels together; NaN without any pixel."""
    hit = np.diag(counts).astype(float)
    union = counts.sum(axis=0) + counts.sum(axis=1) - np.diag(counts)
    return np.asarray(np.divide(hit, union, out=np.full_like(hit, np.nan), where=union > 0))


def onnx_session(path: str | Path, *, optimise: bool = True, threads: int = 1) -> Any:
    """Open an ONNX file in ONNX Runtime on the CPU.

    Args:
        path: of the file.
        optimise: False computes the graph as it is written (``ORT_DISABLE_ALL``): Q/DQ pairs around float operators.
            INT8 accuracy is measured so, because the fused integer kernels saturate on CPUs without VNNI.
        threads: that one inference may use.

    Raises:
        InputError: for a file that is missing or that ONNX Runtime cannot load.
    """
    from robotbrain.jetson.engine.ort import load_session

    file = Path(path)
    if not file.is_file():
        raise InputError("model", given=str(path), expected="the path of an ONNX file", fix="Check the path.")
    return load_session(file, threads=threads, optimise=optimise)


def predict(model: nn.Module | str | Path | Any, images: NDArray[np.uint8], *, optimise: bool = True) -> NDArray[Any]:
    """Return logits (N, classes, H, W) float32.

    Args:
        model: a torch module (run in eval mode without gradient; its mode is restored), the path of an ONNX file, or an
            ONNX Runtime session.
        images: (N, H, W, 3) uint8.
        optimise: of :func:`onnx_session`, for a path.
    """
    run = _runner(model, optimise)
    return np.concatenate([run(normalise(images[i : i + BATCH])) for i in range(0, len(images), BATCH)])


def mean_iou(model: nn.Module | str | Path | Any, scenes: Scenes, *, optimise: bool = True) -> IoUResult:
    """Return the mean IoU of a model on scenes.

    Args:
        model: a torch module, the path of an ONNX file, or an ONNX Runtime session.
        scenes: with labels; pixels labelled IGNORE do not count.
        optimise: of :func:`onnx_session`, for a path. False for quantised files.
    """
    if len(scenes) == 0 or bool((scenes.labels == IGNORE).all()):
        raise InputError("scenes", given=f"{len(scenes)} images", expected="some with labels", fix="Pass a test split.")
    run = _runner(model, optimise)
    counts = np.zeros((len(CLASSES), len(CLASSES)), dtype=np.int64)
    for first in range(0, len(scenes), BATCH):
        part = scenes[first : first + BATCH]
        logits = run(part.inputs())
        expected = (len(part), len(CLASSES), *part.labels.shape[1:])
        if logits.shape != expected or not np.isfinite(logits).all():
            given = logits.shape if logits.shape != expected else "NaN or infinity"
            raise InputError("logits", given=given, expected=f"finite {expected}", fix="Check the network's output.")
        counts += confusion(part.labels, logits.argmax(axis=1))
    iou = intersection_over_union(counts)
    return IoUResult(float(np.nanmean(iou)), {name: float(v) for name, v in zip(CLASSES, iou, strict=True)})


@contextlib.contextmanager
def in_eval_mode(module: nn.Module) -> Iterator[None]:
    """Put a module and its parts in eval mode for a while, graphs of ``torch.export`` (that refuse eval()) included."""
    modes = [(m, m.training) for m in module.modules()]
    try:
        for m, _ in modes:
            m.training = False
        yield
    finally:
        for m, training in modes:
            m.training = training


def _runner(model: Any, optimise: bool) -> Any:
    """Return a function from normalised inputs to logits."""
    if isinstance(model, str | Path):
        model = onnx_session(model, optimise=optimise)
    if hasattr(model, "get_inputs"):
        name = model.get_inputs()[0].name
        fixed = model.get_inputs()[0].shape[0]

        def session_run(inputs: NDArray[np.float32]) -> NDArray[Any]:
            if fixed == 1:  # exported without a dynamic batch
                return np.concatenate([model.run(None, {name: one[None]})[0] for one in inputs])
            return np.asarray(model.run(None, {name: inputs})[0])

        return session_run
    import torch

    def module_run(inputs: NDArray[np.float32]) -> NDArray[Any]:
        with in_eval_mode(model), torch.no_grad():
            return np.asarray(model(torch.from_numpy(inputs)).numpy())

    return module_run

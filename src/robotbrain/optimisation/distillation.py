"""Knowledge distillation: a small network learns from a large one's probabilities, not from labels alone.

Sources: Hinton, Vinyals and Dean, "Distilling the Knowledge in a Neural Network", 2015; Romero et al., "FitNets",
ICLR 2015, for the intermediate features.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import nn
from torch.nn import functional

from robotbrain.errors import InputError
from robotbrain.optimisation.data import IGNORE


@dataclass(frozen=True)
class DistilConfig:
    """How much a student listens to its teacher.

    Attributes:
        temperature: of the softmax on both sides, > 0; above 1 it brings out how the teacher ranks wrong classes.
        alpha: weight of the soft targets, 0 (labels alone) to 1 (teacher alone).
        feature_weight: of the loss on the coarsest features; 0 leaves it out.
        weighted: let the soft loss use the class weights of the training, too.
    """

    temperature: float = 4.0
    alpha: float = 0.7
    feature_weight: float = 0.0
    weighted: bool = True

    def __post_init__(self) -> None:
        _check(self.temperature, self.alpha)
        if not (math.isfinite(self.feature_weight) and self.feature_weight >= 0):
            raise InputError("feature_weight", given=self.feature_weight, expected="0 or more", fix="0 leaves it out.")


def soft_targets_loss(
    student_logits: torch.Tensor,
    teacher_logits: torch.Tensor,
    temperature: float,
    class_weights: torch.Tensor | None = None,
) -> torch.Tensor:
    """Return T^2 KL(teacher || student) at temperature T, the mean over all positions.

    The gradient of the KL divergence shrinks with 1/T^2; the factor keeps it at the size of the hard loss's, so that
    the temperature can be changed without changing ``alpha``. No gradient reaches the teacher.

    Args:
        student_logits: (N, classes, ...), classes on axis 1.
        teacher_logits: of the same shape.
        temperature: > 0.
        class_weights: (classes,) of the class that the teacher finds likeliest at a position: a weighted mean, as in
            the hard loss. None: the plain mean.

    Returns:
        A scalar, at least 0; exactly 0 for equal logits.
    """
    _check(temperature, 0.0)
    if student_logits.shape != teacher_logits.shape or student_logits.ndim < 2:
        raise InputError(
            "teacher's logits",
            given=tuple(teacher_logits.shape),
            expected=f"the student's shape, {tuple(student_logits.shape)}",
            fix="Teacher and student must answer for the same pixels and classes.",
        )
    log_student = functional.log_softmax(student_logits / temperature, dim=1)
    log_teacher = functional.log_softmax(teacher_logits.detach() / temperature, dim=1)
    each = functional.kl_div(log_student, log_teacher, reduction="none", log_target=True).sum(dim=1)
    if class_weights is None:
        return temperature**2 * each.mean()
    weights = class_weights[teacher_logits.detach().argmax(dim=1)]
    return temperature**2 * (weights * each).sum() / weights.sum()


def hard_loss(
    student_logits: torch.Tensor, labels: torch.Tensor, class_weights: torch.Tensor | None = None
) -> torch.Tensor:
    """Return the cross entropy with the labels, the (weighted) mean over labelled positions; 0 if there are none.

    Args:
        student_logits: (N, classes, ...).
        labels: (N, ...) int64, class ids, or IGNORE.
        class_weights: (classes,) float32.
    """
    if not bool((labels != IGNORE).any()):
        return student_logits.sum() * 0.0
    return functional.cross_entropy(student_logits, labels, weight=class_weights, ignore_index=IGNORE)


def distillation_loss(
    student_logits: torch.Tensor,
    teacher_logits: torch.Tensor,
    labels: torch.Tensor,
    *,
    temperature: float = 4.0,
    alpha: float = 0.7,
    class_weights: torch.Tensor | None = None,
    soft_weights: torch.Tensor | None = None,
) -> torch.Tensor:
    """Return ``alpha * soft_targets_loss + (1 - alpha) * hard_loss``.

    Args:
        student_logits: (N, classes, ...).
        teacher_logits: of the same shape; detached here.
        labels: (N, ...) int64; positions labelled IGNORE learn from the teacher alone.
        temperature: > 0.
        alpha: 0 to 1.
        class_weights: (classes,) float32, of the hard loss.
        soft_weights: (classes,) float32, of the soft loss.
    """
    _check(temperature, alpha)
    soft = soft_targets_loss(student_logits, teacher_logits, temperature, soft_weights)
    return alpha * soft + (1.0 - alpha) * hard_loss(student_logits, labels, class_weights)


class FeatureLoss(nn.Module):
    """Mean squared error between the teacher's features and the student's, seen through a trained 1x1 convolution.

    The convolution translates between different numbers of channels; it is trained along and thrown away afterwards.

    Args:
        student_channels: of the student's features.
        teacher_channels: of the teacher's.
    """

    def __init__(self, student_channels: int, teacher_channels: int) -> None:
        super().__init__()
        self.adapter = nn.Conv2d(student_channels, teacher_channels, 1)

    def forward(self, student: torch.Tensor, teacher: torch.Tensor) -> torch.Tensor:
        """Return the loss of (N, student_channels, H, W) against (N, teacher_channels, H, W); teacher is detached."""
        adapted = self.adapter(student)
        if adapted.shape != teacher.shape:
            raise InputError(
                "teacher's features",
                given=tuple(teacher.shape),
                expected=f"{tuple(adapted.shape)}",
                fix="Take both at the same resolution.",
            )
        return functional.mse_loss(adapted, teacher.detach())


def _check(temperature: float, alpha: float) -> None:
    if not (math.isfinite(temperature) and temperature > 0):
        raise InputError("temperature", given=temperature, expected="a number above 0", fix="4 is a usual choice.")
    if not 0.0 <= alpha <= 1.0:
        raise InputError("alpha", given=alpha, expected="0 to 1", fix="0.7 listens mostly to the teacher.")

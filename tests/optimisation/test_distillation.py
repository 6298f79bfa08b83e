"""The losses against closed forms, numpy and finite differences."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import nn

from robotbrain.errors import InputError
from robotbrain.optimisation.data import IGNORE
from robotbrain.optimisation.distillation import (
    DistilConfig,
    FeatureLoss,
    distillation_loss,
    hard_loss,
    soft_targets_loss,
)


def logits(seed: int, *shape: int) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_two_classes_worked_out_by_hand() -> None:
    """Teacher 3/4 : 1/4 at temperature 2, student even: KL = ln 2 - H(3/4); the factor T^2 is 4."""
    teacher = torch.tensor([[2.0 * math.log(3.0), 0.0]])
    student = torch.zeros(1, 2)
    entropy = -(0.75 * math.log(0.75) + 0.25 * math.log(0.25))
    assert soft_targets_loss(student, teacher, 2.0).item() == pytest.approx(4.0 * (math.log(2.0) - entropy), rel=1e-6)
    # The other direction is another number: the teacher comes first in KL(teacher || student).
    turned = 0.5 * math.log(0.5 / 0.75) + 0.5 * math.log(0.5 / 0.25)
    assert soft_targets_loss(teacher, student, 2.0).item() == pytest.approx(4.0 * turned, rel=1e-6)


@pytest.mark.parametrize("shape", [(5, 3), (2, 4, 3, 5)])
def test_the_mean_is_over_positions(shape: tuple[int, ...]) -> None:
    """As numpy has it: sum over classes, mean over images and pixels; no dependence on the batch's size."""
    student, teacher, t = logits(0, *shape), logits(1, *shape), 3.0

    def softmax(x: np.ndarray) -> np.ndarray:
        e = np.exp(x / t - (x / t).max(axis=1, keepdims=True))
        return e / e.sum(axis=1, keepdims=True)

    p, q = softmax(teacher.numpy()), softmax(student.numpy())
    expected = t**2 * (p * np.log(p / q)).sum(axis=1).mean()
    assert soft_targets_loss(student, teacher, t).item() == pytest.approx(expected, rel=1e-9)
    twice = soft_targets_loss(torch.cat([student, student]), torch.cat([teacher, teacher]), t)
    assert twice.item() == pytest.approx(expected, rel=1e-9)


def test_it_is_zero_for_equal_logits_and_blind_to_an_offset() -> None:
    a = logits(2, 3, 4, 2, 2)
    assert soft_targets_loss(a, a.clone(), 4.0).item() == 0.0
    assert soft_targets_loss(a + 5.0, a, 4.0).item() == pytest.approx(0.0, abs=1e-12)
    assert soft_targets_loss(logits(3, 3, 4, 2, 2), a, 4.0).item() > 0.0


def test_gradient_against_finite_differences() -> None:
    student, teacher = logits(4, 2, 3, 2, 1).requires_grad_(), logits(5, 2, 3, 2, 1)
    labels = torch.tensor([[[0], [2]], [[1], [IGNORE]]])
    weights = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)

    def loss(x: torch.Tensor) -> torch.Tensor:
        return distillation_loss(x, teacher, labels, temperature=2.5, alpha=0.6, class_weights=weights)

    assert torch.autograd.gradcheck(loss, (student,), eps=1e-6, atol=1e-7)


def test_the_gradient_keeps_its_size_as_the_temperature_rises() -> None:
    """At high T the gradient tends to (z_s - z_t) / classes for centred logits (Hinton et al., eq. 4): T^2 at work."""
    student, teacher = logits(6, 4, 5), logits(7, 4, 5)
    student, teacher = student - student.mean(1, keepdim=True), teacher - teacher.mean(1, keepdim=True)
    student.requires_grad_()
    (gradient,) = torch.autograd.grad(soft_targets_loss(student, teacher, 500.0), student)
    torch.testing.assert_close(gradient, (student - teacher).detach() / 5 / 4, rtol=0.02, atol=1e-4)


def test_no_gradient_reaches_the_teacher() -> None:
    student, teacher = logits(8, 2, 3).requires_grad_(), logits(9, 2, 3).requires_grad_()
    soft_targets_loss(student, teacher, 2.0).backward()
    assert student.grad is not None and teacher.grad is None
    feature = FeatureLoss(2, 3)
    big = torch.randn(1, 3, 2, 2, requires_grad=True)
    feature(torch.randn(1, 2, 2, 2), big).backward()
    assert big.grad is None and feature.adapter.weight.grad is not None


def test_alpha_mixes_soft_and_hard() -> None:
    student, teacher, labels = logits(10, 3, 4), logits(11, 3, 4), torch.tensor([0, 3, 1])
    soft, hard = soft_targets_loss(student, teacher, 4.0), nn.functional.cross_entropy(student, labels)
    for alpha in (0.0, 0.3, 1.0):
        got = distillation_loss(student, teacher, labels, temperature=4.0, alpha=alpha)
        torch.testing.assert_close(got, alpha * soft + (1 - alpha) * hard)


def test_pixels_without_label_teach_nothing_hard() -> None:
    student = logits(12, 2, 4, 3, 3)
    labels = torch.randint(0, 4, (2, 3, 3), generator=torch.Generator().manual_seed(0))
    labels[1] = IGNORE
    torch.testing.assert_close(hard_loss(student, labels), hard_loss(student[:1], labels[:1]))
    student.requires_grad_()
    nothing = hard_loss(student, torch.full((2, 3, 3), IGNORE))
    nothing.backward()
    assert nothing.item() == 0.0 and student.grad is not None and not student.grad.any()


def test_features_match_once_the_adapter_translates_them() -> None:
    loss = FeatureLoss(2, 4)
    student = torch.randn(3, 2, 5, 5)
    with torch.no_grad():
        teacher = loss.adapter(student)
    assert loss(student, teacher).item() == 0.0
    assert loss(student, teacher + 2.0).item() == pytest.approx(4.0)
    with pytest.raises(InputError, match="resolution"):
        loss(student, torch.zeros(3, 4, 2, 2))


def test_positions_count_as_much_as_their_class_does_for_the_teacher() -> None:
    """Three positions whose likeliest class for the teacher is 0, 2 and 2: weights 1, 4 and 4."""
    teacher = torch.tensor([[3.0, 0.0, 1.0], [0.0, 1.0, 2.0], [-1.0, 0.0, 5.0]], dtype=torch.float64)
    student = logits(13, 3, 3)
    each = [soft_targets_loss(student[k : k + 1], teacher[k : k + 1], 2.0).item() for k in range(3)]
    weights = torch.tensor([1.0, 2.0, 4.0], dtype=torch.float64)
    got = soft_targets_loss(student, teacher, 2.0, weights).item()
    assert got == pytest.approx((each[0] + 4 * each[1] + 4 * each[2]) / 9, rel=1e-9)
    mixed = distillation_loss(
        student, teacher, torch.tensor([0, 1, 2]), temperature=2.0, alpha=1.0, soft_weights=weights
    )
    assert mixed.item() == pytest.approx(got, rel=1e-9)


@pytest.mark.parametrize("bad", [0.0, -1.0, math.nan, math.inf])
def test_a_temperature_that_cannot_be_is_refused(bad: float) -> None:
    with pytest.raises(InputError, match="temperature"):
        soft_targets_loss(torch.zeros(1, 2), torch.zeros(1, 2), bad)
    with pytest.raises(InputError, match="temperature"):
        DistilConfig(temperature=bad)


def test_other_mistakes_are_named() -> None:
    with pytest.raises(InputError, match="alpha"):
        DistilConfig(alpha=1.5)
    with pytest.raises(InputError, match="alpha"):
        distillation_loss(torch.zeros(1, 2), torch.zeros(1, 2), torch.zeros(1, dtype=torch.long), alpha=-0.1)
    with pytest.raises(InputError, match="feature_weight"):
        DistilConfig(feature_weight=-1.0)
    with pytest.raises(InputError, match="same pixels"):
        soft_targets_loss(torch.zeros(1, 4, 8, 8), torch.zeros(1, 4, 4, 4), 1.0)

"""How `hw2_optimisation` tests masks, pruning, the distillation loss and the step that uses it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from robotbrain.grading import expect, expect_close, fail
from robotbrain.grading.suites import hw2_optimisation_probes as probes
from robotbrain.grading.suites import hw2_optimisation_tools as tools

HINTS = {
    "true-keeps": "True keeps a weight, False prunes it.",
    "mask-of-bools": "A mask has the shape of the weight and holds truth values (torch.bool).",
    "small-ones-go": "The weights of smallest MAGNITUDE go: -0.9 is larger than 0.1.",
    "exactly-so-many": "Exactly round(sparsity * n) weights go, also where several have the same magnitude: sort and "
    "count instead of comparing with a threshold.",
    "share-that-goes": "sparsity is the share of zeros: 0.25 keeps three quarters.",
    "each-tensor-at-once": "The ranking is over the whole tensor, not row by row.",
    "two-of-four": "In EVERY group of four exactly two weights stay: also where some of them are equal.",
    "groups-along-inputs": "The four neighbours follow each other along axis 1, the input channels; the last axis of a "
    "convolution holds its columns.",
    "larger-two-stay": "Of each four the two of largest magnitude stay.",
    "weights-only": "Masks are for the weights of convolutions and linear layers. Biases and batch norms are a "
    "fraction of a per cent of all numbers, and each is worth a whole channel.",
    "each-layer-its-own": "Each layer loses its own share. One threshold for all of them would empty the layers whose "
    "weights are small.",
    "apply-the-mask": "A mask that nobody applies changes nothing: set the weights to zero, in place, under "
    "`torch.no_grad()`.",
    "parameters-stay": "Change the values in place (`weight.mul_(mask)`): the optimiser holds THESE parameters.",
    "mask-after-the-step": "The step moves every weight, zeros included: apply the masks again after it.",
    "momentum-remembers": "A gradient of zero does not stop Adam: it remembers gradients from before, and so does "
    "momentum. Mask the WEIGHTS, after the step.",
    "zero-grad": "Gradients add up until they are cleared: `zero_grad()` before every `backward()`.",
    "kept-weights-learn": "The weights that stay must go on learning: apply masks to values, not instead of a step.",
    "t-squared": "The gradient of the KL divergence shrinks with 1 / T^2: multiply the soft term by T^2.",
    "kl-direction": "KL(teacher || student) = sum p_teacher (log p_teacher - log p_student): the teacher says how much "
    "each class counts.",
    "mean-over-pixels": "The soft term is the mean over all positions (N, H, W) of a sum over the classes. "
    "`reduction='batchmean'` divides by N only, `'mean'` by the classes, too.",
    "classes-are-axis-1": "The classes lie on axis 1 of (N, 4, H, W): softmax over them, not over columns or rows.",
    "alpha-is-the-teachers": "alpha is the teacher's share, 1 - alpha that of the labels.",
    "soften-both": "Both softmaxes are taken at temperature T: the student's and the teacher's.",
    "hard-at-one": "The cross entropy with the labels is taken of the logits as they are, at temperature 1.",
    "zero-when-equal": "The KL divergence is 0 where student and teacher agree. A cross entropy is not: it adds the "
    "teacher's entropy.",
    "the-hard-term": "There are two terms: the teacher's word, and the labels.",
    "255-is-no-class": "Pixels labelled 255 have no label: leave them out of the hard term (`ignore_index=255`).",
    "mean-of-nothing": "Without a single labelled pixel, cross_entropy is 0 / 0, a NaN. There the hard term is 0: "
    "leave it out. (`torch.where` hides the NaN in the value, and not in the gradient.)",
    "unlabelled-still-teach": "The soft term needs no labels: pixels without one count in it as all others do.",
    "kl-div-wants-logs": "`F.kl_div(input, target)` wants LOG-probabilities of the student first, and then the "
    "teacher's probabilities.",
    "loss-has-a-gradient": "The loss must still be connected to the student: no detach, item or numpy on its logits.",
    "teacher-is-a-constant": "The student is to follow the teacher, not the other way round: detach the teacher's "
    "logits, or compute them under `torch.no_grad()`.",
    "step-by-step": "zero_grad, backward, step: each of them once. And the loss wants the student's logits first, then "
    "the teacher's.",
    "student-in-train": "The student learns, so it is in train mode: batch norm then uses, and follows, the batch.",
    "every-image-once": "The answer has a row for each image, in the order of the images: mind the last, smaller "
    "batch.",
    "fifty-at-a-time": "All images at once would need gigabytes where there are thousands: "
    "`for part in images.split(50)`.",
    "logits-not-probabilities": "Return the logits, as they come: the loss divides them by T before its softmax.",
    "use-what-is-given": "Pass temperature and alpha on to the loss.",
    "teacher-in-eval": "The teacher is in eval mode: `teacher.eval()`. In train mode its batch norms follow the "
    "student's batches, and dropout makes it guess.",
    "loss-as-a-float": "Return the loss as a float (`loss.item()`): a tensor would keep its whole graph in memory.",
}

# ---------------------------------------------------------------- masks


def compare_mask(student: Any, weight: Tensor, sparsity: float, given: str) -> None:
    """The mask keeps exactly the right number of weights, and none that is smaller than one that goes."""
    held = student.hold(weight.clone())
    mask = _mask(student.magnitude_mask(held, sparsity), weight, given)
    expect(torch.equal(student.fetch(held), weight), "the weights were changed: only a mask was asked for", given=given)
    size = weight.numel()
    drop = round(sparsity * size)
    zeros = int((~mask).sum())
    big, small = weight.abs()[mask], weight.abs()[~mask]
    ordered = not len(big) or not len(small) or bool(small.max() <= big.min())
    if zeros == drop and ordered:
        return
    hint = tools.first_match(mask, _mask_mistakes(weight, sparsity, drop), tools.magnitude_mask(weight, sparsity))
    fail(
        "the mask prunes other weights than the smallest" if zeros == drop else f"{zeros} of {size} weights go",
        given=given,
        got=f"{zeros} go; the largest of them has magnitude {float(small.max()) if len(small) else 0:.4g}, the "
        f"smallest that stays {float(big.min()) if len(big) else 0:.4g}",
        expected=f"the {drop} smallest go",
        hint=hint or ("small-ones-go" if zeros == drop else "exactly-so-many"),
    )


def _mask_mistakes(weight: Tensor, sparsity: float, drop: int) -> list[tuple[str, Tensor]]:
    rows = torch.stack([tools.magnitude_mask(row, sparsity) for row in weight])
    signed = tools.magnitude_mask(weight - weight.min(), sparsity)
    threshold = torch.sort(weight.abs().ravel()).values[min(drop, weight.numel() - 1)]
    return [
        ("true-keeps", ~tools.magnitude_mask(weight, sparsity)),
        ("share-that-goes", tools.magnitude_mask(weight, 1 - sparsity)),
        ("small-ones-go", signed),
        ("small-ones-go", ~tools.magnitude_mask(weight, 1 - sparsity)),
        ("each-tensor-at-once", rows),
        ("exactly-so-many", weight.abs() > threshold),
    ]


def _mask(answer: Any, weight: Tensor, given: str) -> Tensor:
    mask = tools.as_tensor(answer, "the mask", tuple(weight.shape), "mask-of-bools")
    expect(mask.dtype == torch.bool, "the mask should hold truth values", got=str(mask.dtype), expected="torch.bool",
           given=given, hint="mask-of-bools")  # fmt: skip
    return mask


def compare_two_four(student: Any, weight: Tensor, given: str) -> None:
    """Of four neighbours along the input channels exactly two stay, the larger ones."""
    mask = _mask(student.two_four_mask(weight.clone()), weight, given)

    def groups(tensor: Tensor) -> Tensor:
        moved = tensor.movedim(1, -1)
        return moved.reshape(*moved.shape[:-1], -1, 4)

    stay = groups(mask).sum(dim=-1)
    kept = groups(torch.where(mask, weight.abs(), torch.inf)).amin(dim=-1)
    gone = groups(torch.where(mask, -torch.inf, weight.abs())).amax(dim=-1)
    if bool((stay == 2).all()) and bool((gone <= kept).all()):
        return
    key = "two-of-four" if not bool((stay == 2).all()) else "larger-two-stay"
    if key == "larger-two-stay" and bool((kept <= gone).all()):
        key = "true-keeps"
    for axis in {0, weight.ndim - 1, weight.ndim - 2} - {1}:
        if weight.shape[axis] % 4 == 0:
            elsewhere = mask.movedim(axis, -1)
            if bool((elsewhere.reshape(*elsewhere.shape[:-1], -1, 4).sum(dim=-1) == 2).all()):
                key = "groups-along-inputs" if key == "two-of-four" else key
    if key == "two-of-four" and bool((mask.reshape(-1, 4).sum(dim=-1) == 2).all()):
        key = "groups-along-inputs"
    fail("a group of four is not as it should be", given=given,
         got=f"groups keep {int(stay.min())} to {int(stay.max())} weights", hint=key,
         expected="each group keeps its two largest")  # fmt: skip


# ---------------------------------------------------------------- pruning


def compare_pruned(student: Any, sparsity: float, rng: np.random.Generator) -> None:
    """After ``prune`` each weight tensor has its own share of zeros, and nothing else has changed."""
    network = tools.mixed_network(rng)
    before, names = probes.state_of(network), [name for name, _ in network.named_parameters()]
    wanted = list(probes.prunable(network))
    given = f"a network with convolutions, a batch norm and a linear layer; sparsity = {sparsity:g}"
    found = student.run(probes.pruned, before, sparsity)
    masks, now = found["answer"], found["state"]
    expect(found["names"] == names and found["kept"] is True, "parameters were replaced",
           got=found["names"], expected=names, given=given, hint="parameters-stay")  # fmt: skip
    if not isinstance(masks, Mapping):
        fail("the answer should be a dict of masks", got=masks, expected='{"body.0.weight": mask, ...}', given=given)
    others = [n for n in (*masks, *tools.changed(before, now)) if n not in wanted]
    expect(not others, "other numbers than the weights of convolutions and linear layers are pruned", got=others,
           expected=wanted, given=given, hint="weights-only")  # fmt: skip
    missing = [n for n in wanted if n not in masks]
    expect(not missing, "masks are missing", got=list(masks), expected=wanted, given=given, hint="weights-only")
    zeros = {n: int((now[n] == 0).sum()) for n in wanted}
    drop = {n: round(sparsity * before[n].numel()) for n in wanted}
    total = sum(drop.values())
    if zeros != drop:
        kept = {n: before[n].numel() - k for n, k in drop.items()}
        untouched = not any(zeros.values())
        key = "apply-the-mask" if untouched else "true-keeps" if zeros == kept else "each-layer-its-own"
        alike = untouched or zeros == kept or abs(sum(zeros.values()) - total) <= len(drop)
        fail("the layers do not have the right number of zeros", got=zeros, expected=drop, given=given,
             hint=key if alike else "exactly-so-many")  # fmt: skip
    for name in wanted:
        mask = _mask(masks[name], before[name], given)
        expect(torch.equal(now[name], before[name] * mask), f"{name} is not the old weight times its mask", given=given,
               hint="true-keeps" if torch.equal(now[name], before[name] * ~mask) else "apply-the-mask")  # fmt: skip
        small, big = before[name].abs()[~mask], before[name].abs()[mask]
        expect(not len(small) or not len(big) or bool(small.max() <= big.min()), f"{name} lost large weights",
               given=given, hint="small-ones-go")  # fmt: skip


def compare_pruned_steps(student: Any, rng: np.random.Generator, kind: str, steps: int = 4) -> None:
    """Zeros stay zeros while the rest learns, also with an optimiser that remembers dense gradients."""
    network = tools.mixed_network(rng)
    state = probes.state_of(network)
    images, wanted = (
        torch.from_numpy(rng.normal(0, 1, shape).astype(np.float32)) for shape in ((12, 3, 5, 5), (12, 5))
    )
    masks = {name: tools.magnitude_mask(weight, 0.5) for name, weight in probes.prunable(network).items()}
    given = f"{kind} after three dense steps, then {steps} steps with half of the weights pruned"

    def after(mistake: str, step: int) -> Tensor:
        return _run_steps(state, kind, masks, images, wanted, mistake, step)

    found = student.run(probes.pruned_steps, state, kind, masks, images, wanted, steps)
    for k in range(steps):
        back = {name: int((found[k][name][~mask] != 0).sum()) for name, mask in masks.items()}
        if any(back.values()):
            wrong = [(key, after(key, k + 1)) for key in _STEP_MISTAKES]
            key = tools.first_match(tools.flat(found[k]), wrong, after("", k + 1))
            fail("pruned weights came back", got=f"{sum(back.values())} pruned weights are not zero",
                 expected="every pruned weight is 0 after every step", given=given,
                 hint=key or "mask-after-the-step")  # fmt: skip
    got, right = tools.flat(found[steps - 1]), after("", steps)
    hint = tools.first_match(got, lambda: [(key, after(key, steps)) for key in _STEP_MISTAKES], right)
    expect_close(got.numpy(), right.numpy(), rtol=1e-3, atol=1e-5, given=given, hint=hint or "kept-weights-learn",
                 what="the network after the steps")  # fmt: skip


_STEP_MISTAKES = ("mask-after-the-step", "momentum-remembers", "zero-grad")


def _run_steps(
    state: Mapping[str, Tensor],
    kind: str,
    masks: Mapping[str, Tensor],
    images: Tensor,
    wanted: Tensor,
    mistake: str,
    steps: int,
) -> Tensor:
    """Return a pruned network's numbers after some steps, made right or with a mistake."""
    network, optimiser = probes.trained(state, kind, images, wanted)
    probes.apply_masks(network, masks)
    for _ in range(steps):
        loss = probes.loss_of(network, images, wanted)
        if mistake != "zero-grad":
            optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        if mistake == "momentum-remembers":
            for name, weight in probes.prunable(network).items():
                assert weight.grad is not None
                weight.grad.mul_(masks[name])
        optimiser.step()
        if mistake not in ("mask-after-the-step", "momentum-remembers"):
            probes.apply_masks(network, masks)
    return tools.flat(probes.state_of(network))


# ---------------------------------------------------------------- the distillation loss


def logits_and_labels(
    rng: np.random.Generator, shape: tuple[int, ...] = (3, 4, 2, 5), unknown: float = 0.0
) -> tuple[Tensor, ...]:
    """Return logits of student and teacher, float64, and labels, a share ``unknown`` of them 255."""
    generator = torch.Generator().manual_seed(int(rng.integers(2**62)))
    student = 2 * torch.randn(shape, generator=generator, dtype=torch.float64)
    teacher = 3 * torch.randn(shape, generator=generator, dtype=torch.float64)
    labels = torch.randint(0, shape[1], (shape[0], *shape[2:]), generator=generator)
    labels[torch.rand(labels.shape, generator=generator) < unknown] = tools.IGNORE
    return student, teacher, labels


def compare_loss(
    student: Any, logits: tuple[Tensor, ...], temperature: float, alpha: float, given: str, rtol: float = 1e-5
) -> None:
    """Compare the value with alpha T^2 KL(teacher || student) + (1 - alpha) CE."""
    z, t, labels = logits
    expected = tools.distillation_loss(z, t, labels, temperature, alpha)
    found = student.run(probes.distilled, z, t, labels, temperature, alpha)
    loss = tools.as_tensor(found["loss"], "the loss", (), "mean-over-pixels", "loss-has-a-gradient")
    hint = tools.first_match(loss, lambda: _loss_mistakes(z, t, labels, temperature, alpha), expected)
    if bool(torch.isnan(loss)) and bool((labels == tools.IGNORE).all()):
        hint = "mean-of-nothing"
    expect_close(loss.numpy(), expected.numpy(), rtol=rtol, atol=1e-9, given=given, hint=hint, what="the loss")
    if found["gradient"] is not None:  # a NaN that was replaced in the value comes back in the gradient
        finite = bool(torch.isfinite(found["gradient"]).all())
        expect(finite, "the loss is finite, but its gradient is not", given=given, hint="mean-of-nothing")


def _loss_mistakes(z: Tensor, t: Tensor, labels: Tensor, temp: float, alpha: float) -> list[tuple[str, Any]]:
    def soft(
        axis: int = 1, reverse: bool = False, student_t: float = temp, teacher_t: float = temp, entropy: bool = True
    ) -> Tensor:
        log_q, log_p = (functional.log_softmax(v / k, dim=axis) for v, k in ((z, student_t), (t, teacher_t)))
        if reverse:
            log_q, log_p = log_p, log_q
        value: Tensor = (log_p.exp() * ((log_p if entropy else 0.0) - log_q)).sum(dim=axis).mean()
        return value

    known = labels != tools.IGNORE
    some = bool(known.any())

    def cross(scale: float = 1.0) -> Tensor:
        return functional.cross_entropy(z / scale, labels, ignore_index=tools.IGNORE) if some else torch.zeros(())

    kl, hard, square = soft(), cross(), temp**2
    positions, batch = z.numel() / z.shape[1], z.shape[0]

    def both(soft_term: Any, hard_term: Any = hard, share: float = alpha) -> Tensor:
        return torch.as_tensor(share * soft_term + (1 - share) * hard_term)

    clamped = torch.where(known, labels, 0)
    found = [
        ("t-squared", both(kl)),
        ("t-squared", both(temp * kl)),
        ("t-squared", both(kl / square)),
        ("t-squared", both(kl, hard) * square),
        ("kl-direction", both(square * soft(reverse=True))),
        ("mean-over-pixels", both(square * kl * positions / batch)),
        ("mean-over-pixels", both(square * kl / z.shape[1])),
        ("mean-over-pixels", both(square * kl * positions)),
        ("alpha-is-the-teachers", both(square * kl, hard, 1 - alpha)),
        ("soften-both", both(square * soft(student_t=1.0))),
        ("soften-both", both(square * soft(teacher_t=1.0))),
        ("soften-both", both(square * soft(student_t=1.0, teacher_t=1.0))),
        ("soften-both", both(soft(student_t=1.0, teacher_t=1.0))),
        ("hard-at-one", both(square * kl, cross(temp))),
        ("hard-at-one", both(square * kl, square * cross(temp))),
        ("zero-when-equal", both(square * soft(entropy=False))),
        ("zero-when-equal", both(soft(entropy=False))),
        ("zero-when-equal", square * soft(entropy=False)),
        ("zero-when-equal", soft(entropy=False)),
        ("the-hard-term", square * kl),
        ("the-hard-term", alpha * square * kl),
        ("the-hard-term", square * kl + hard),
        ("255-is-no-class", both(square * kl, functional.cross_entropy(z, clamped))),
        ("255-is-no-class", both(square * kl, hard * known.double().mean())),
    ]
    q, p = ((v / temp).softmax(dim=1) for v in (z, t))
    for first, second in ((q, p), (q.log(), p.log()), (p, q)):  # not what kl_div takes
        wrong = functional.kl_div(first, second, reduction="none").sum(dim=1).mean()
        found += [("kl-div-wants-logs", both(square * wrong)), ("kl-div-wants-logs", both(wrong))]
    if some:
        each = (p * (p.log() - q.log())).sum(dim=1)[known].mean()
        found.append(("unlabelled-still-teach", both(square * each)))
    else:
        found.append(("unlabelled-still-teach", torch.zeros(())))
    for axis in {0, z.ndim - 1, z.ndim - 2, 2} - {1}:
        if axis < z.ndim:
            wrong = soft(axis)
            found.append(("classes-are-axis-1", both(square * wrong)))
            mixed = functional.softmax(t / temp, dim=axis)
            logs = functional.log_softmax(z / temp, dim=axis)
            each = functional.kl_div(logs, mixed, reduction="none").sum(dim=1).mean()
            found.append(("classes-are-axis-1", both(square * each)))
    return found


def _gradient(found: Mapping[str, Any], logits: Tensor) -> Tensor:
    """Return the gradient by the student's logits, or fail where there is none."""
    tools.as_tensor(found["loss"], "the loss", (), "mean-over-pixels", "loss-has-a-gradient")
    expect(found["connected"] is True, "the loss is cut off from the student: nothing can be learned from it",
           hint="loss-has-a-gradient")  # fmt: skip
    expect(found["gradient"] is not None, "no gradient reaches the student's logits", hint="loss-has-a-gradient")
    return tools.as_tensor(found["gradient"], "the gradient", tuple(logits.shape), "loss-has-a-gradient")


def compare_loss_gradient(student: Any, rng: np.random.Generator) -> None:
    """The gradient is the derivative; none reaches the teacher."""
    z, t, labels = logits_and_labels(rng, (2, 4, 1, 3))
    temperature, alpha = float(rng.uniform(2.5, 3.5)), float(rng.uniform(0.55, 0.65))
    found = student.run(probes.distilled, z, t, labels, temperature, alpha, teacher_learns=True)
    got, teacher = _gradient(found, z), found["teacher"]
    expect(teacher is None or not bool(teacher.any()), "a gradient reaches the teacher's logits", got=teacher,
           expected="none", hint="teacher-is-a-constant")  # fmt: skip
    leaf = z.clone().requires_grad_(True)
    (slope,) = torch.autograd.grad(tools.distillation_loss(leaf, t, labels, temperature, alpha), leaf)

    def mistakes() -> tools.Mistakes:
        wrong = _loss_mistakes(leaf, t, labels, temperature, alpha)
        return [
            (key, torch.autograd.grad(value, leaf, retain_graph=True)[0]) for key, value in wrong if value.requires_grad
        ]

    hint = tools.first_match(got, mistakes, slope) or ("" if bool(got.any()) else "loss-has-a-gradient")
    expect_close(got.numpy(), slope.numpy(), rtol=1e-3, atol=1e-6, what="the gradient by the student's logits",
                 hint=hint)  # fmt: skip


def check_temperature(student: Any, rng: np.random.Generator) -> None:
    """At high temperature the soft gradient is (z - v) / (C n), z and v centred: it no longer depends on T."""
    z, t, labels = logits_and_labels(rng, (4, 4, 3, 2))
    limit = ((z - z.mean(dim=1, keepdim=True)) - (t - t.mean(dim=1, keepdim=True))) / 4 / (4 * 3 * 2)
    for temperature in (float(rng.uniform(900, 1100)), 1e4):
        got = _gradient(student.run(probes.distilled, z, t, labels, temperature, 1.0), z)
        norm = float(limit.norm())
        ratio = float((got * limit).sum()) / norm**2
        alike = float((got - ratio * limit).norm()) <= 0.02 * abs(ratio) * norm
        powers = [temperature**p for p in (-3, -2, -1, 1)]
        hint = "t-squared" if alike and any(abs(ratio / p - 1) < 0.05 for p in powers) else ""
        hint = hint or ("mean-over-pixels" if alike and abs(ratio - 1) > 0.05 else "")
        expect(alike and abs(ratio - 1) < 0.02, "the soft gradient depends on the temperature", hint=hint,
               given=f"alpha = 1, T = {temperature:g}", got=f"{ratio:.3g} times that of the limit",
               expected="for large T, (z - v) / 4 per pixel, whatever T is (Hinton et al., 2015, section 2.1)",
               misconception="")  # fmt: skip


# ---------------------------------------------------------------- the teacher is asked


AT_ONCE = 50
"""Images that the teacher is asked about at a time."""


def compare_asked(student: Any, rng: np.random.Generator, count: int) -> None:
    """The answers are those of the teacher in eval mode, without a graph; the teacher is the same afterwards."""
    dropout = 0.2
    teacher = tools.small_network(rng, 6, dropout)
    before = probes.state_of(teacher)
    inputs = torch.from_numpy(tools.small_scenes(rng, count).inputs())
    expected = np.concatenate(tools.outputs_of(teacher, inputs.numpy(), ["4"])["4"])
    given = f"a teacher in train mode, with batch norm and dropout, and {count} images"
    found = student.run(probes.asked, before, inputs, dropout, seed=int(rng.integers(2**31)))
    answer = tools.as_tensor(found["answer"], "the answer", expected.shape, "every-image-once")
    moved = tools.changed(before, found["state"])
    expect(not moved, "the teacher changed", got=", ".join(moved), expected="the teacher it was", given=given,
           hint="teacher-in-eval" if all("1." in n for n in moved) else "teacher-is-a-constant")  # fmt: skip
    expect(found["connected"] is False, "the answers carry the teacher's graph", got="requires_grad=True", given=given,
           expected="requires_grad=False", hint="teacher-is-a-constant")  # fmt: skip

    def mistakes() -> tools.Mistakes:
        soft = torch.from_numpy(expected).softmax(dim=1)
        return [("logits-not-probabilities", soft), ("logits-not-probabilities", soft.log())]

    hint = tools.first_match(answer, mistakes, expected) or "teacher-in-eval"
    expect_close(answer.numpy(), expected, rtol=1e-3, atol=1e-4, given=given, hint=hint, what="the teacher's logits")
    most = max(found["sizes"])
    expect(most <= AT_ONCE, "the teacher was asked about too many images at once", got=most,
           expected=f"at most {AT_ONCE}", given=given, hint="fifty-at-a-time", credit=0.5)  # fmt: skip


# ---------------------------------------------------------------- the step


@dataclass(frozen=True)
class Step:
    """How a step is made; each change is a mistake that students make."""

    zero_grad: bool = True
    train: bool = True
    temperature: float | None = None
    alpha: float | None = None
    moves: bool = True
    softened: bool = False

    def __call__(
        self,
        student: nn.Module,
        optimiser: torch.optim.Optimizer,
        images: Tensor,
        labels: Tensor,
        wanted: Tensor,
        temperature: float = 4.0,
        alpha: float = 0.7,
    ) -> float:
        """Make one step and return the loss."""
        student.train(self.train)
        share = alpha if self.alpha is None else self.alpha
        wanted = wanted.softmax(dim=1) if self.softened else wanted
        loss = tools.distillation_loss(student(images), wanted, labels, self.temperature or temperature, share)
        if self.zero_grad:
            optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        if self.moves:
            optimiser.step()
        return loss.item()


STEP_VARIANTS = (
    ("zero-grad", Step(zero_grad=False)),
    ("student-in-train", Step(train=False)),
    ("use-what-is-given", Step(temperature=4.0)),
    ("use-what-is-given", Step(alpha=0.7)),
    ("use-what-is-given", Step(temperature=4.0, alpha=0.7)),
    ("the-hard-term", Step(alpha=1.0)),
    ("use-what-is-given", Step(alpha=0.0)),
    ("step-by-step", Step(moves=False)),
    ("logits-not-probabilities", Step(softened=True)),
)


def compare_steps(student: Any, rng: np.random.Generator, steps: int = 3) -> None:
    """After some steps the student is where it should be."""
    state = probes.state_of(tools.small_network(rng))
    scenes = [tools.small_scenes(rng, 5) for _ in range(steps)]
    batches = [
        (
            torch.from_numpy(part.inputs()),
            torch.from_numpy(part.labels.astype(np.int64)),
            torch.from_numpy(rng.normal(0, 2, (5, 4, 8, 8)).astype(np.float32)),
        )
        for part in scenes
    ]
    temperature, alpha, rate = float(rng.uniform(2.2, 2.8)), float(rng.uniform(0.35, 0.45)), 0.05

    def run(step: Step) -> tuple[Tensor, list[float]]:
        learner = probes.small_network(state).eval()
        optimiser = torch.optim.SGD(learner.parameters(), lr=rate)
        losses = [step(learner, optimiser, *batch, temperature=temperature, alpha=alpha) for batch in batches]
        return tools.flat(probes.state_of(learner)), losses

    given = f"a student with batch norms; {steps} steps of SGD, temperature={temperature:.2f}, alpha={alpha:.2f}"
    right, expected = run(Step())
    found = student.run(probes.stepped, state, batches, temperature, alpha, rate)
    got, losses = tools.flat(found["state"]), found["answer"]
    hint = tools.first_match(got, lambda: [(key, run(step)[0]) for key, step in STEP_VARIANTS], right, rtol=1e-3)
    expect_close(got.numpy(), right.numpy(), rtol=1e-3, atol=1e-5, given=given, hint=hint or "step-by-step",
                 what="the student after the steps")  # fmt: skip
    if any(isinstance(v, Tensor) for v in losses):
        fail("the loss should be a float", got=losses[0], expected="a float", hint="loss-as-a-float",
             credit=0.5)  # fmt: skip
    expect_close(losses, expected, rtol=1e-3, given=given, what="the losses", hint="loss-as-a-float")

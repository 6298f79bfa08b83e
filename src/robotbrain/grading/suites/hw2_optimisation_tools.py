"""What the tests of `hw2_optimisation` share: small networks and scenes, and our own answers.

The answers stand in for a part of the student's that is not right yet, so that what builds on it can still be graded.
They are independent of `robotbrain.optimisation`, whose functions tests/test_hw2_optimisation.py compares them with.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from robotbrain.grading import expect, fail
from robotbrain.grading.suites import hw2_optimisation_probes as probes
from robotbrain.grading.suites.hw2_optimisation_probes import CLASSES, Array, SmallScenes

torch.optim.Adam([torch.zeros(1, requires_grad=True)])  # the first optimiser loads for seconds: now, not in a check

IGNORE = 255
"""Label of a pixel that nobody has labelled."""
Mistakes = Sequence[tuple[str, Any]]
"""Keys of hints, and the answers that show the mistakes."""


def first_match(answer: Any, mistakes: Mistakes | Callable[[], Mistakes], expected: Any, rtol: float = 1e-4) -> str:
    """Return the hint of the first mistake that gives ``answer`` and not ``expected``, or ''.

    ``mistakes`` that are costly are a function, which a right answer does not call.
    """
    given = _numbers(answer)
    if given is None:
        return ""
    right = np.asarray(expected, dtype=float)
    if given.shape == right.shape and np.allclose(given, right, rtol=min(rtol, 1e-6), atol=1e-9, equal_nan=True):
        return ""
    for hint, wrong in mistakes() if callable(mistakes) else mistakes:
        value = _numbers(wrong)
        if value is None or value.shape != given.shape:
            continue
        if value.shape == right.shape and np.allclose(value, right, rtol=rtol, atol=1e-9, equal_nan=True):
            continue
        if np.allclose(given, value, rtol=rtol, atol=1e-7, equal_nan=True):
            return hint
    return ""


def _numbers(value: Any) -> Array | None:
    try:
        return np.asarray(value.detach() if isinstance(value, Tensor) else value, dtype=float)
    except (TypeError, ValueError):
        return None


def as_tensor(answer: Any, what: str, shape: tuple[int, ...], hint: str = "", no_tensor: str = "") -> Tensor:
    """Return the student's answer if it is a tensor of this shape, or fail and say what it is.

    ``hint`` is for another shape, and for another type, too, unless ``no_tensor`` is.
    """
    if not isinstance(answer, Tensor):
        fail(f"{what} should be a torch tensor", got=answer,
             expected=f"a tensor of shape {shape}", hint=no_tensor or hint)  # fmt: skip
    if tuple(answer.shape) != shape:
        fail(f"{what} has shape {tuple(answer.shape)}, but shape {shape} is expected", got=tuple(answer.shape),
             expected=shape, hint=hint)  # fmt: skip
    tensor: Tensor = answer.detach()
    return tensor


# ---------------------------------------------------------------- small networks and scenes


def small_network(rng: np.random.Generator, width: int = 4, dropout: float = 0.0) -> nn.Sequential:
    """Return the probes' network with random numbers."""
    generator = torch.Generator().manual_seed(int(rng.integers(2**62)))

    def noise(*shape: int, fan_in: int = 1) -> Tensor:
        return torch.empty(shape).uniform_(-(fan_in**-0.5), fan_in**-0.5, generator=generator)

    # Statistics and factors of a network that has learned something: train and eval mode must differ.
    state = {
        "0.weight": noise(width, 3, 3, 3, fan_in=27),
        "0.bias": noise(width, fan_in=27),
        "1.weight": torch.rand(width, generator=generator) + 0.5,
        "1.bias": 0.3 * torch.randn(width, generator=generator),
        "1.running_mean": 0.3 * torch.randn(width, generator=generator),
        "1.running_var": torch.rand(width, generator=generator) + 0.5,
        "1.num_batches_tracked": torch.tensor(7),
        "4.weight": noise(CLASSES, width, 1, 1, fan_in=width),
        "4.bias": noise(CLASSES, fan_in=width),
    }
    return probes.small_network(state, dropout)


def mixed_network(rng: np.random.Generator) -> probes.Mixed:
    """Return the probes' network of many kinds of layers with random numbers; its layers' weights differ in size."""
    generator = torch.Generator().manual_seed(int(rng.integers(2**62)))
    network = probes.Mixed()
    with torch.no_grad():
        for name, parameter in network.named_parameters():
            parameter.copy_((2 * torch.rand(parameter.shape, generator=generator) - 1) / 4)
            if name == "body.3.weight":
                parameter.mul_(0.1)
            if name == "body.1.weight":
                parameter.add_(1.0)
    return network


def small_scenes(
    rng: np.random.Generator, count: int, brightness: float = 128.0, spread: float = 40.0, size: int = 8
) -> SmallScenes:
    """Return images of noise; their labels follow the colours, so that some network can be right about them."""
    images = np.clip(rng.normal(brightness, spread, (count, size, size, 3)), 0, 255).astype(np.uint8)
    labels = images.argmax(axis=3).astype(np.uint8)
    labels[images.sum(axis=3) < 3 * brightness - spread] = 3
    return SmallScenes(images, labels)


def small_splits(rng: np.random.Generator, counts: Sequence[int] = (12, 110, 6, 105)) -> dict[str, SmallScenes]:
    """Return train, calibration, validation and test scenes whose brightness differs: it shows which were used.

    Those that count are more than a batch: who keeps the last one only is found out.
    """
    names = ("train", "calibration", "validation", "test")
    light = (100.0, 125.0, 145.0, 165.0)
    return {
        name: small_scenes(rng, count, bright, 30.0 + 4 * k)
        for k, (name, count, bright) in enumerate(zip(names, counts, light, strict=True))
    }


def changed(before: Mapping[str, Tensor], now: Any) -> list[str]:
    """Return the names whose values are not those of ``before``."""
    return [n for n, value in before.items() if not (isinstance(now[n], Tensor) and torch.equal(value, now[n]))]


def expect_untouched(before: Mapping[str, Tensor], now: Any, what: str, hint: str) -> None:
    """Fail where a parameter or a statistic of a network is not as ``before``."""
    names = changed(before, now)
    expect(not names, f"{what} was changed", got=", ".join(names[:6]), expected="the numbers it came with", hint=hint)


def expect_mode(found: Any, network: nn.Module, training: bool, given: str, hint: str) -> None:
    """Fail, for half of the points, where a network's modules are not all in the mode that they came in."""
    expect(found == [training] * len(list(network.modules())), "the network is in another mode than before",
           given=given, credit=0.5, got="train" if True in found else "eval",
           expected="train" if training else "eval", hint=hint)  # fmt: skip


def flat(state: Mapping[str, Tensor]) -> Tensor:
    """Return all floating-point numbers of a network, statistics included, in one row."""
    return torch.cat([v.detach().ravel() for v in state.values() if v.is_floating_point()])


# ---------------------------------------------------------------- our own answers: numbers


def choose_scale(low: float, high: float, symmetric: bool = False, bits: int = 8) -> tuple[float, int]:
    """Return scale and zero point for real values between ``low`` and ``high``."""
    low, high = min(float(low), 0.0), max(float(high), 0.0)
    if symmetric:
        return max(-low, high) / (2 ** (bits - 1) - 1) or 1.0, 0
    scale = (high - low) / (2**bits - 1) or 1.0
    return scale, round(-low / scale)


def quantise(x: Any, scale: Any, zero_point: int, qmin: int = 0, qmax: int = 255) -> Array:
    """Return the integers that stand for ``x``, int32."""
    steps = np.rint(np.asarray(x, dtype=np.float64) / scale) + zero_point
    return np.asarray(np.clip(steps, qmin, qmax), dtype=np.int32)


def dequantise(q: Any, scale: Any, zero_point: int) -> Array:
    """Return the real values that integers stand for, float32."""
    return np.asarray((np.asarray(q).astype(np.float64) - zero_point) * scale, dtype=np.float32)


def quantise_weights(weight: Any, per_channel: bool = True) -> tuple[Array, Array]:
    """Return int8 weights and their scales, (O, 1, ...) or a single one."""
    weight = np.asarray(weight)
    axes = tuple(range(1, weight.ndim)) if per_channel else None
    scale = np.abs(weight).max(axis=axes, keepdims=per_channel) / 127
    scale = np.where(scale == 0, 1.0, scale)
    return quantise(weight, scale, 0, -127, 127).astype(np.int8), scale


def activation_range(
    batches: Iterable[Any], percentile: float | None = None, method: Any = "linear"
) -> tuple[float, float]:
    """Return the range of all values in all batches; ``method`` as of ``np.percentile``."""
    values = np.concatenate([np.ravel(batch) for batch in batches])
    if percentile is None:
        return float(values.min()), float(values.max())
    top = float(np.percentile(np.abs(values), percentile, method=method))
    return -top, top


def outputs_of(network: nn.Module, inputs: Array, layers: Sequence[str], train: bool = False) -> dict[str, list[Array]]:
    """Return the outputs of the named layers, batch by batch; ``network`` is put back as it was."""
    modes, before = [(m, m.training) for m in network.modules()], probes.state_of(network)
    found: dict[str, list[Array]] = {name: [] for name in layers}
    modules = dict(network.named_modules())

    def keep(name: str) -> Callable[..., None]:
        return lambda _module, _inputs, output: found[name].append(output.detach().numpy().copy())

    hooks = [modules[name].register_forward_hook(keep(name)) for name in layers]
    try:
        network.train(train)
        with torch.no_grad():
            for start in range(0, len(inputs), 32):
                network(torch.from_numpy(inputs[start : start + 32]))
    finally:
        for hook in hooks:
            hook.remove()
        for module, training in modes:
            module.training = training
        network.load_state_dict(before)
    return found


# ---------------------------------------------------------------- our own answers: pruning


def magnitude_mask(weight: Tensor, sparsity: float) -> Tensor:
    """Return True where a weight stays; exactly round(sparsity n) go."""
    drop = torch.argsort(weight.detach().abs().ravel(), stable=True)[: round(sparsity * weight.numel())]
    mask = torch.ones(weight.numel(), dtype=torch.bool)
    mask[drop] = False
    return mask.view(weight.shape)


# ---------------------------------------------------------------- our own answers: distillation


def distillation_loss(
    student_logits: Tensor, teacher_logits: Tensor, labels: Tensor, temperature: float = 4.0, alpha: float = 0.7
) -> Tensor:
    """Return alpha T^2 KL(teacher || student) + (1 - alpha) cross entropy with the labelled pixels."""
    log_q = functional.log_softmax(student_logits / temperature, dim=1)
    log_p = functional.log_softmax(teacher_logits.detach() / temperature, dim=1)
    soft = (log_p.exp() * (log_p - log_q)).sum(dim=1).mean() * temperature**2
    known = labels != IGNORE
    if not bool(known.any()):
        return alpha * soft
    hard = functional.cross_entropy(student_logits, labels, ignore_index=IGNORE)
    return alpha * soft + (1 - alpha) * hard


def confusion(labels: Array, predicted: Array) -> NDArray[np.int64]:
    """Return pixel counts (4, 4), rows the truth, columns the prediction."""
    counts = np.zeros((CLASSES, CLASSES), dtype=np.int64)
    np.add.at(counts, (labels.ravel(), predicted.ravel()), 1)
    return counts


def iou(counts: Array) -> float:
    """Return the mean IoU over the classes that occur in truth or prediction."""
    hit = np.diagonal(counts, axis1=-2, axis2=-1).astype(float)
    union = counts.sum(axis=-1) + counts.sum(axis=-2) - hit
    with np.errstate(invalid="ignore"):
        return float(np.nanmean(hit / union))

"""The one training loop of the segmentation networks: with labels, with a teacher, or both; interrupted and resumed.

Everything random comes from the seed: the same call gives the same weights, whether it was interrupted or not (bit for
bit on one machine and number of threads).
"""

from __future__ import annotations

import hashlib
import json
import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from robotbrain.errors import InputError, RobotBrainError
from robotbrain.optimisation.data import Scenes
from robotbrain.optimisation.distillation import DistilConfig, FeatureLoss, distillation_loss, hard_loss
from robotbrain.optimisation.evaluate import BATCH, in_eval_mode, onnx_session, predict
from robotbrain.pipeline.segmentation import normalise

SAVE_EVERY_S = 15.0
"""At most this much work is lost to an interrupt, s."""

_KIND = "segmentation-fit"


@dataclass(frozen=True)
class FitConfig:
    """How to train; AdamW under a one-cycle schedule.

    Attributes:
        epochs: passes over the images.
        batch_size: images of a step; what is left over at the end of an epoch is left out.
        learning_rate: peak of the schedule.
        seed: of the order and the flips, and of whatever the network draws.
        class_weights: of the hard loss. The marker covers few pixels; without weight it would be learned last.
        weight_decay: of AdamW.
        flip: mirror half of the batches.
    """

    epochs: int = 6
    batch_size: int = 32
    learning_rate: float = 6e-3
    seed: int = 0
    class_weights: tuple[float, ...] | None = (1.0, 1.0, 1.0, 3.0)
    weight_decay: float = 1e-4
    flip: bool = True

    def __post_init__(self) -> None:
        whole = isinstance(self.epochs, int) and isinstance(self.batch_size, int)
        rates = (self.learning_rate, self.weight_decay, *(self.class_weights or ()))
        if not (whole and self.epochs >= 1 and self.batch_size >= 1 and self.learning_rate > 0):
            raise InputError(
                "FitConfig",
                given=f"epochs={self.epochs}, batch_size={self.batch_size}, learning_rate={self.learning_rate}",
                expected="whole numbers of at least 1, and a rate above 0",
                fix="FitConfig() has usual values.",
            )
        if not all(math.isfinite(r) and r >= 0 for r in rates):
            raise InputError("FitConfig", given=rates, expected="finite rates and weights", fix="None is below 0.")


@dataclass(frozen=True)
class FitResult:
    """What a training did.

    Attributes:
        history: mean loss of each epoch, in order.
        steps: optimiser steps in all.
        seconds: spent on steps, those before an interrupt included.
    """

    history: tuple[float, ...]
    steps: int
    seconds: float


@dataclass(frozen=True)
class TeacherTargets:
    """What a teacher says about each image: logits (N, classes, H, W), coarsest features (N, C, h, w) or None."""

    logits: torch.Tensor
    features: torch.Tensor | None

    def first(self, count: int) -> TeacherTargets:
        """Return those of the first ``count`` images."""
        return TeacherTargets(self.logits[:count], None if self.features is None else self.features[:count])


def teacher_targets(
    teacher: nn.Module | Path, scenes: Scenes, *, features: bool = False, progress: bool = False
) -> TeacherTargets:
    """Ask the teacher once about every image: in eval mode, without gradient; stored as float16.

    Each image is seen many times in a training, and mirrored targets serve the mirrored image.

    Args:
        teacher: a module, or its ONNX file, which answers in about half the time.
        scenes: the images.
        features: store the coarsest features, too; for a module only.
        progress: show a bar.
    """
    from tqdm.auto import tqdm

    module = teacher if isinstance(teacher, nn.Module) else None
    if features and module is None:
        raise InputError("teacher", given=str(teacher), expected="a module with features()", fix="Use load_network().")
    answer = module or onnx_session(teacher)  # type: ignore[arg-type]
    logits, coarse = [], []
    for first in tqdm(range(0, len(scenes), BATCH), desc="teacher", unit="batch", disable=not progress):
        part = scenes[first : first + BATCH]
        logits.append(torch.from_numpy(predict(answer, part.images)).half())
        if features and module is not None:
            with in_eval_mode(module), torch.no_grad():
                coarse.append(module.features(torch.from_numpy(part.inputs())).half())  # type: ignore[operator]
    return TeacherTargets(torch.cat(logits), torch.cat(coarse) if features else None)


def fit(
    network: nn.Module,
    scenes: Scenes,
    config: FitConfig,
    *,
    teacher: nn.Module | TeacherTargets | None = None,
    distil: DistilConfig | None = None,
    after_step: Callable[[nn.Module], None] | None = None,
    run_dir: Path | None = None,
    progress: bool = True,
) -> FitResult:
    """Train ``network`` in place and leave it in eval mode.

    Args:
        network: float32, images (N, 3, H, W) to logits (N, 4, H, W).
        scenes: to learn from. Pixels labelled IGNORE are learned from the teacher alone.
        config: how.
        teacher: whose answers are learned along with the labels, or its :func:`teacher_targets` for these scenes.
        distil: how much of the teacher; DistilConfig() if there is a teacher.
        after_step: called with the network after each step of the optimiser: to put pruned weights back to zero, say.
        run_dir: folder of a checkpoint. A training that was interrupted goes on from there, a finished one is loaded.
        progress: show a bar.

    Raises:
        InputError: for fewer images than a batch, a teacher that does not fit, or a ``run_dir`` of another training.
        RobotBrainError: when the loss is no longer finite.
    """
    if len(scenes) < config.batch_size:
        fix = "Render more, or use smaller batches."
        raise InputError("scenes", given=len(scenes), expected=f"a batch of {config.batch_size} or more", fix=fix)
    if distil is not None and teacher is None:
        raise InputError("teacher", given=None, expected="a network to learn from", fix='Use load_network("teacher").')
    if teacher is not None:
        distil = distil or DistilConfig()
        if isinstance(teacher, nn.Module):
            teacher = teacher_targets(teacher, scenes, features=distil.feature_weight > 0, progress=progress)
        if len(teacher.logits) != len(scenes) or (distil.feature_weight > 0 and teacher.features is None):
            given = f"targets for {len(teacher.logits)} images"
            expected = f"{len(scenes)}, with features if they have a weight"
            raise InputError("teacher", given=given, expected=expected, fix="Make them from the same scenes.")
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        return _Loop(network, scenes, config, teacher, distil, run_dir).run(after_step, progress)


class _Loop:
    """A training between two steps: all that a checkpoint must hold."""

    def __init__(
        self,
        network: nn.Module,
        scenes: Scenes,
        config: FitConfig,
        targets: TeacherTargets | None,
        distil: DistilConfig | None,
        run_dir: Path | None,
    ) -> None:
        self.network = network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.scenes, self.config, self.targets, self.distil = scenes, config, targets, distil
        self.checkpoint = None if run_dir is None else Path(run_dir) / "fit.pt"
        self.identity = _identity(network, scenes, config, targets, distil) if run_dir is not None else ""
        self.rng = np.random.default_rng(config.seed)
        weights = config.class_weights
        self.class_weights = None if weights is None else torch.tensor(weights, dtype=torch.float32)
        self.translator: FeatureLoss | None = None
        if distil is not None and distil.feature_weight > 0:
            assert targets is not None and targets.features is not None
            with torch.no_grad():
                mine = network.features(torch.from_numpy(scenes[:1].inputs()))  # type: ignore[operator]
            self.translator = FeatureLoss(mine.shape[1], targets.features.shape[1])
        parameters = [*network.parameters(), *(self.translator.parameters() if self.translator else ())]
        self.optimiser = torch.optim.AdamW(parameters, lr=config.learning_rate, weight_decay=config.weight_decay)
        self.per_epoch = len(scenes) // config.batch_size
        self.total = config.epochs * self.per_epoch
        self.schedule = torch.optim.lr_scheduler.OneCycleLR(
            self.optimiser, config.learning_rate, total_steps=max(self.total, 2)
        )
        self.step = 0
        self.order = np.zeros(0, dtype=np.int64)
        self.history: list[float] = []
        self.running = 0.0
        self.seconds = 0.0

    def run(self, after_step: Callable[[nn.Module], None] | None, progress: bool) -> FitResult:
        from tqdm.auto import tqdm

        self.load()
        before, begin = self.seconds, time.monotonic()
        saved = begin
        _set_mode(self.network, training=True)
        with tqdm(total=self.total, initial=self.step, desc="training", unit="step", disable=not progress) as bar:
            while self.step < self.total:
                loss = self.one_step()
                if after_step is not None:
                    after_step(self.network)
                bar.update()
                if self.step % 20 == 0:
                    bar.set_postfix(loss=f"{loss:.3f}")
                now = time.monotonic()
                self.seconds = before + now - begin
                if self.checkpoint and (now - saved >= SAVE_EVERY_S or self.step == self.total):
                    self.save()
                    saved = now
        _set_mode(self.network, training=False)
        return FitResult(tuple(self.history), self.total, self.seconds)

    def one_step(self) -> float:
        within = self.step % self.per_epoch
        if within == 0:
            self.order, self.running = self.rng.permutation(len(self.scenes)), 0.0
        size = self.config.batch_size
        chosen = self.order[within * size : (within + 1) * size]
        loss = self.loss(chosen, mirrored=self.config.flip and self.rng.random() < 0.5)
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        self.optimiser.step()
        if self.step + 1 < max(self.total, 2):
            self.schedule.step()
        value = float(loss.detach())
        if not math.isfinite(value):
            raise RobotBrainError(
                f"the loss is {value} at step {self.step + 1}: the training has diverged. Use a lower learning rate "
                f"than {self.config.learning_rate:g}"
            )
        self.running += value
        self.step += 1
        if self.step % self.per_epoch == 0:
            self.history.append(self.running / self.per_epoch)
        return value

    def loss(self, chosen: np.ndarray[Any, np.dtype[np.int64]], mirrored: bool) -> torch.Tensor:
        image = torch.from_numpy(normalise(self.scenes.images[chosen]))
        labels = torch.from_numpy(self.scenes.labels[chosen].astype(np.int64))
        if mirrored:
            image, labels = image.flip(-1), labels.flip(-1)
        image = image.contiguous(memory_format=torch.channels_last)
        if self.targets is None or self.distil is None:
            return hard_loss(self.network(image), labels, self.class_weights)

        def target(stored: torch.Tensor) -> torch.Tensor:
            part = stored[torch.from_numpy(chosen)].float()
            return part.flip(-1) if mirrored else part

        features = None
        if self.translator is None:
            logits = self.network(image)
        else:
            stages = self.network.encode(image)
            features, logits = stages[-1], self.network.decode(stages)
        loss = distillation_loss(
            logits,
            target(self.targets.logits),
            labels,
            temperature=self.distil.temperature,
            alpha=self.distil.alpha,
            class_weights=self.class_weights,
            soft_weights=self.class_weights if self.distil.weighted else None,
        )
        if self.translator is not None and features is not None and self.targets.features is not None:
            loss = loss + self.distil.feature_weight * self.translator(features, target(self.targets.features))
        return loss

    def save(self) -> None:
        from robotbrain.rl.checkpoint import save_checkpoint

        assert self.checkpoint is not None
        state = {
            "identity": self.identity,
            "network": self.network.state_dict(),
            "translator": self.translator.state_dict() if self.translator else {},
            "optimiser": self.optimiser.state_dict(),
            "schedule": {"last_epoch": self.schedule.last_epoch, "step_count": self.schedule._step_count},
            "torch_rng": torch.get_rng_state(),
            "rng": self.rng.bit_generator.state,
            "order": torch.from_numpy(self.order),
            "step": self.step,
            "history": self.history,
            "running": self.running,
            "seconds": self.seconds,
        }
        save_checkpoint(self.checkpoint, state, kind=_KIND)

    def load(self) -> None:
        from robotbrain.rl.checkpoint import load_checkpoint

        if self.checkpoint is None or not self.checkpoint.is_file():
            return
        state = load_checkpoint(self.checkpoint, kind=_KIND)
        if state["identity"] != self.identity:
            raise InputError(
                "run_dir",
                given=str(self.checkpoint.parent),
                expected="the folder of a training with the same network, images and recipe",
                fix="Choose another folder, or remove this one to begin again.",
            )
        self.network.load_state_dict(state["network"])
        if self.translator:
            self.translator.load_state_dict(state["translator"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.schedule.last_epoch = state["schedule"]["last_epoch"]
        self.schedule._step_count = state["schedule"]["step_count"]
        torch.set_rng_state(state["torch_rng"])
        self.rng.bit_generator.state = state["rng"]
        self.order, self.step = state["order"].numpy(), state["step"]
        self.history, self.running, self.seconds = list(state["history"]), state["running"], state["seconds"]


def _identity(
    network: nn.Module,
    scenes: Scenes,
    config: FitConfig,
    targets: TeacherTargets | None,
    distil: DistilConfig | None,
) -> str:
    """Return a digest of all that a training depends on, initial weights included."""
    digest = hashlib.sha256(json.dumps([asdict(config), asdict(distil) if distil else None]).encode())
    tensors = [value for _, value in sorted(network.state_dict().items())]
    tensors += [t for t in (targets.logits, targets.features) if t is not None] if targets else []
    for tensor in tensors:
        digest.update(np.ascontiguousarray(tensor.detach().contiguous().numpy()).tobytes())
    digest.update(scenes.images.tobytes())
    digest.update(scenes.labels.tobytes())
    return digest.hexdigest()


def _set_mode(network: nn.Module, *, training: bool) -> None:
    try:
        network.train(training)
    except NotImplementedError:
        # Graphs of torch.export refuse; what runs them (quantisation-aware training) switches them over itself.
        for module in network.modules():
            module.training = training

"""Compositions: a network, and what is done to it one after the other, as data that can be compared, hashed and stored.

A recipe is a value. :func:`plan` spells it out as steps, :class:`robotbrain.optimisation.workshop.Workshop` carries
them out and keeps every intermediate result under a key made of all that went into it, so that recipes which begin
alike share their trainings, and a second run computes nothing.

The order is always the same: network, channels, sparsity, quantisation. Removing channels changes what the weights are
worth, so zeros are chosen afterwards; quantisation comes last, because nothing may train in float once it is done.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, NamedTuple

from robotbrain.errors import InputError

SHIPPED = ("teacher", "student", "student_plain")
"""Networks to begin with that come with weights; a number instead is the width of a student that is trained here."""

QUANTISERS = ("ptq", "qat")
CALIBRATIONS = ("minmax", "percentile", "entropy")
TWO_FOUR = "2:4"

REVISION = 1
"""Part of every key: to be raised when a step computes something else than before."""


@dataclass(frozen=True)
class Recipe:
    """One composition.

    Attributes:
        student: ``"teacher"``, ``"student"`` or ``"student_plain"`` (the student that never met the teacher) with their
            shipped weights, or the width (4 to 64) of a student to train.
        distil: whether trainings of this recipe listen to the teacher, or to the labels alone.
        prune_channels: share of each layer's channels to remove, 0 to below 1; a training follows.
        sparsity: share of the weights to set to zero, or ``"2:4"``; a training with the mask follows.
        quantise: ``"ptq"`` (after training), ``"qat"`` (quantisation-aware training), or None for float32.
        calibration: how ``"ptq"`` finds the ranges of activations: minmax, percentile or entropy.
        per_channel: one scale for each output channel of a weight, or one for the whole.
        seed: of everything random.

    Raises:
        InputError: for a value that is out of range or that does not fit the others.
    """

    student: str | int = "student"
    distil: bool = True
    prune_channels: float = 0.0
    sparsity: float | str | None = None
    quantise: str | None = None
    calibration: str = "minmax"
    per_channel: bool = True
    seed: int = 0

    def __post_init__(self) -> None:
        def check(good: bool, what: str, expected: str, fix: str = "Look at Recipe's attributes.") -> None:
            if not good:
                raise InputError(f"recipe: {what}", given=getattr(self, what), expected=expected, fix=fix)

        def whole(value: object) -> bool:
            return isinstance(value, int) and not isinstance(value, bool)

        named = self.student in SHIPPED if isinstance(self.student, str) else whole(self.student)
        in_range = isinstance(self.student, str) or 4 <= self.student <= 64
        check(named and in_range, "student", "one of " + ", ".join(SHIPPED) + ", or a width from 4 to 64")
        share = isinstance(self.prune_channels, int | float) and not isinstance(self.prune_channels, bool)
        check(share and 0.0 <= self.prune_channels < 1.0, "prune_channels", "a share from 0 to below 1", "Half is 0.5.")
        number = isinstance(self.sparsity, int | float) and not isinstance(self.sparsity, bool)
        good = 0.0 < self.sparsity < 1.0 if number else self.sparsity in (None, TWO_FOUR)  # type: ignore[operator]
        check(good, "sparsity", 'None, a share above 0 and below 1, or "2:4"', "Half is 0.5.")
        check(self.quantise in (None, *QUANTISERS), "quantise", "None, ptq or qat")
        check(self.calibration in CALIBRATIONS, "calibration", ", ".join(CALIBRATIONS))
        check(whole(self.seed) and self.seed >= 0, "seed", "a whole number, 0 or more")
        check(isinstance(self.distil, bool), "distil", "True or False")
        check(isinstance(self.per_channel, bool), "per_channel", "True or False")

    @property
    def label(self) -> str:
        """What it is, in a few words for a figure or a table."""
        begin = f"width {self.student}" if isinstance(self.student, int) else self.student.replace("_plain", "")
        words = [begin]
        trained_here = isinstance(self.student, int) or self.prune_channels or self.sparsity or self.quantise == "qat"
        if self.student == "student_plain" or (trained_here and not self.distil):
            words[0] += " (no teacher)"
        if self.prune_channels:
            words.append(f"\N{MINUS SIGN}{self.prune_channels:.0%} channels")
        if self.sparsity is not None:
            words.append("2:4" if self.sparsity == TWO_FOUR else f"{float(self.sparsity):.0%} zeros")
        if self.quantise:
            details = [] if self.quantise == "qat" or self.calibration == "minmax" else [self.calibration]
            details += [] if self.per_channel else ["per tensor"]
            words.append("INT8 " + self.quantise.upper() + (f" ({', '.join(details)})" if details else ""))
        if self.seed:
            words.append(f"seed {self.seed}")
        return ", ".join(words)

    @property
    def slug(self) -> str:
        """The label as part of a file name."""
        plain = self.label.replace("\N{MINUS SIGN}", "minus ").replace("%", "").replace(":", "of")
        return re.sub(r"[^a-z0-9]+", "-", plain.lower()).strip("-")

    @property
    def precision(self) -> str:
        """``"int8"`` or ``"fp32"``: what its file is written in."""
        return "int8" if self.quantise else "fp32"

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return asdict(self)

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Recipe:
        """Return the recipe of plain values; what is left out has its default.

        Raises:
            InputError: for an unknown entry, or a value that cannot be right.
        """
        names = [field.name for field in fields(cls)]
        if not isinstance(values, Mapping) or not set(values) <= set(names):
            odd = values if not isinstance(values, Mapping) else sorted(set(map(str, values)) - set(names))
            raise InputError(
                "recipe", given=odd, expected="a mapping with entries of " + ", ".join(names), fix="Check the spelling."
            )
        return cls(**values)


@dataclass(frozen=True)
class Budget:
    """How much is spent on each recipe.

    Attributes:
        images: of the training split, for every training.
        epochs: of a training with zeros in the weights.
        channel_epochs: of a training after channels were removed.
        qat_epochs: of a quantisation-aware training; its steps take about three times as long as others.
        scratch_epochs: of a student trained from nothing.
        calibration_images: of the calibration split, for post-training quantisation.
        batch_size: images of a step.
        learning_rate: peak, of the trainings with zeros in the weights.
        scratch_learning_rate: peak, of those from nothing or after channels were removed; a tenth of it for
            quantisation-aware training.
    """

    images: int = 1500
    epochs: int = 3
    channel_epochs: int = 6
    qat_epochs: int = 1
    scratch_epochs: int = 10
    calibration_images: int = 128
    batch_size: int = 32
    learning_rate: float = 2e-3
    scratch_learning_rate: float = 6e-3

    def __post_init__(self) -> None:
        counts = (
            self.images,
            self.epochs,
            self.channel_epochs,
            self.qat_epochs,
            self.scratch_epochs,
            self.calibration_images,
            self.batch_size,
        )
        rates = (self.learning_rate, self.scratch_learning_rate)
        if any(not isinstance(n, int) or n < 1 for n in counts) or not all(0 < r < 1 for r in rates):
            raise InputError(
                "budget",
                given=asdict(self),
                expected="whole numbers of at least 1, and learning rates between 0 and 1",
                fix="Budget() has usual values.",
            )
        if self.images < self.batch_size:
            raise InputError(
                "budget", given=f"{self.images} images", expected=f"a batch ({self.batch_size})", fix="Allow more."
            )


class Step(NamedTuple):
    """One thing to do.

    Attributes:
        kind: ``network``, ``channels``, ``sparsity``, ``export``, ``qat`` or ``ptq``.
        settings: plain values; all that the result depends on besides the step before and the data.
    """

    kind: str
    settings: dict[str, Any]

    @property
    def trains(self) -> bool:
        """Whether images are learned from."""
        return "epochs" in self.settings


class Artefact(NamedTuple):
    """What a recipe leads to.

    Attributes:
        onnx: path of the network, opset 17, dynamic batch.
        metadata: path of the JSON beside it: recipe, steps with their keys and seconds, size, SHA-256.
        facts: content of that JSON.
    """

    onnx: Path
    metadata: Path
    facts: dict[str, Any]


def plan(recipe: Recipe, budget: Budget | None = None) -> tuple[Step, ...]:
    """Return the steps of a recipe, the first from nothing, the last with an ONNX file as its result.

    Settings that do not matter for a step are not in it: that is what makes recipes share steps.
    """
    budget = budget or Budget()

    def training(epochs: int, rate: float) -> dict[str, Any]:
        return {
            "images": budget.images,
            "epochs": epochs,
            "batch_size": budget.batch_size,
            "learning_rate": rate,
            "seed": recipe.seed,
            "distil": recipe.distil,
        }

    after = training(budget.epochs, budget.learning_rate)
    if isinstance(recipe.student, int):
        scratch = training(budget.scratch_epochs, budget.scratch_learning_rate)
        steps = [Step("network", {"width": recipe.student} | scratch)]
    else:
        steps = [Step("network", {"name": recipe.student})]
    if recipe.prune_channels:
        # Half a network has to learn much again: longer, and at the rate of a network that is new.
        again = training(budget.channel_epochs, budget.scratch_learning_rate)
        steps.append(Step("channels", {"ratio": float(recipe.prune_channels), "importance": "l1"} | again))
    if recipe.sparsity is not None:
        pattern = recipe.sparsity if recipe.sparsity == TWO_FOUR else float(recipe.sparsity)
        steps.append(Step("sparsity", {"pattern": pattern} | after))
    if recipe.quantise == "qat":
        # A tenth of the rate that made the network, or little more: it is nearly there.
        aware = training(budget.qat_epochs, 0.1 * budget.scratch_learning_rate)
        steps.append(Step("qat", {"per_channel": recipe.per_channel, "bits": 8} | aware))
    else:
        steps.append(Step("export", {"opset": 17}))
    if recipe.quantise == "ptq":
        how = {"method": recipe.calibration, "per_channel": recipe.per_channel, "images": budget.calibration_images}
        steps.append(Step("ptq", how))
    return tuple(steps)


def step_key(step: Step, previous: str, inputs: Mapping[str, str]) -> str:
    """Return the key of a step's result: a digest of all that it depends on.

    Args:
        step: what is done.
        previous: key of the step before; empty for the first.
        inputs: digests of data and weights by name, and versions of what computes.
    """
    content = [REVISION, previous, step.kind, step.settings, dict(inputs)]
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:24]


def apply(recipe: Recipe, out_dir: str | Path, *, budget: Budget | None = None, progress: bool = True) -> Artefact:
    """Carry a recipe out, as far as that has not been done before, and return its artefact.

    Args:
        recipe: what to do.
        out_dir: folder for the artefact and the results of its steps; share it between recipes.
        budget: Budget() if None.
        progress: show bars.

    Raises:
        InputError: for a folder that cannot be used.
        MissingDependencyError: without a package that a step needs.
    """
    from robotbrain.optimisation.workshop import Workshop

    return Workshop(out_dir, budget, progress=progress).make(recipe)

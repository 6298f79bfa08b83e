"""Hidden tests of `hw2_optimisation`. They never ship to students, who see a test's name and its hint only."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import torch

from robotbrain.grading import Suite
from robotbrain.grading.suites import hw2_optimisation_judge as judge
from robotbrain.grading.suites import hw2_optimisation_learning as learning
from robotbrain.grading.suites import hw2_optimisation_numbers as numbers
from robotbrain.grading.suites import judging

suite = Suite.extending("hw2_optimisation")

VERDICTS = {"f": "fine", "g": "breaks", "h": "breaks", "i": "wastes", "j": "breaks"}
WORLDS = range(731_406_000, 731_406_075)
"""Worlds of the final judgement, four scenes each, far from those of any split and the same for everybody."""
LOOKS = ((8, 0.005), (16, 0.02), (40, 0.02), (75, 0.05))
REFERENCE = Path(__file__).parents[1] / "reference" / "hw2_optimisation"

READINGS = (
    tuple(
        judge.Reading(channels, False, "orin-nano-8gb", "7W", cameras)
        for channels, cameras in (((8, 24), 4), ((20, 12), 3), ((16, 28), 5))
    ),
    tuple(
        judge.Reading(channels, True, "xavier-nx", "MODE_10W_2CORE", cameras)
        for channels, cameras in (((32,), 2), ((24,), 3), ((40,), 4))
    ),
)


@suite.warm
def fill_caches():
    for questions in READINGS:
        for question in questions:
            judge.latency_of(question)
    for seed in WORLDS[: LOOKS[1][0]]:
        judge.world(seed)
    for file in REFERENCE.glob("*.onnx"):  # whatever judging does for the first time
        ours = SimpleNamespace(STUDENT=file.name, files=REFERENCE)
        judge.check_int8(ours)
        judge.check_latency(ours)
        judge.judge_accuracy(ours, WORLDS, LOOKS)


@suite.test("bugs", points=2, name="f to j", reread="Exercise 1.1, the listing")
def bugs_second(student):
    judging.compare_verdicts(student.VERDICTS, VERDICTS, numbers.VERDICT_HINTS)


# ---------------------------------------------------------------- Part 2: numbers


@suite.test("scale", points=2, name="other ranges, other widths", reread="Exercise 2.1")
def scale_random(student):
    rng = student.rng("scale")
    for bits in (8, 8, 8, 4):
        for symmetric in (False, True):
            numbers.compare_random_scale(student, rng, symmetric, bits)


@suite.test("scale", points=1, name="zero in every range", hint="range-holds-zero", reread="Exercise 2.1")
def scale_one_sided(student):
    a, b = sorted(float(v) for v in student.rng("one side").uniform(0.5, 4, 2))
    for low, high in ((a, b), (-b, -a), (0.0, b), (0.0, 0.0)):
        for symmetric in (False, True):
            numbers.compare_scale(student, low, high, symmetric)


@suite.test("quantise", points=2, name="half a step", hint="half-a-step", reread="Exercise 2.2")
def quantise_bound(student):
    numbers.check_half_a_step(student, student.rng("half"))
    rng = student.rng("signed")
    x = rng.normal(0, 2, 500).astype(np.float32)
    numbers.compare_quantise(student, x, 0.013, 0, -127, 127, "500 values, scale = 0.013, -127 to 127")


@suite.test("quantise", points=1, name="every level comes back", hint="zero-point-ignored", reread="Exercise 2.2")
def quantise_round_trip(student):
    for scale, zero in ((0.02, 100), (0.3, 0), (1.7, 255)):
        levels = np.arange(256, dtype=np.uint8)
        numbers.compare_dequantise(
            student, levels, scale, zero, f"levels 0 to 255 as uint8, scale = {scale}, zero_point = {zero}"
        )
        numbers.check_round_trip(student, scale, zero)


@suite.test("quantise", points=1, name="many scales at once", reread="Exercise 2.2, last paragraph")
def quantise_channels(student):
    rng = student.rng("channels")
    x, scale = rng.normal(0, 1, (5, 4, 3)).astype(np.float32), rng.uniform(0.01, 0.1, (5, 1, 1))
    numbers.compare_quantise(student, x, scale, 128, 0, 255, "(5, 4, 3) values, a scale for each of five rows")
    q = rng.integers(0, 256, (5, 4, 3)).astype(np.int32)
    numbers.compare_dequantise(student, q, scale, 128, "(5, 4, 3) integers, a scale for each of five rows")


@suite.test("weights", points=2, name="dead channels, other shapes", reread="Exercise 2.3")
def weights_shapes(student):
    rng = student.rng("weights")
    for shape in ((7, 2, 3, 3), (4, 9), (5, 1, 3, 3)):
        weight = numbers.channels_of_all_sizes(rng, shape, dead=True)
        numbers.compare_weights(student, weight, True, f"weights {shape}, one channel zero, per_channel=True")


@suite.test("weights", points=2, name="one scale for all", reread="Exercise 2.3")
def weights_per_tensor(student):
    rng = student.rng("tensor")
    for shape in ((6, 3, 3, 3), (8, 5)):
        weight = numbers.channels_of_all_sizes(rng, shape)
        numbers.compare_weights(student, weight, False, f"weights {shape}, per_channel=False")


# ---------------------------------------------------------------- Part 3: calibration


@suite.test("range", points=2, name="other batches", reread="Exercise 3.1")
def range_random(student):
    rng = student.rng("range")
    for percentile in (None, 99.0, 99.9, None):
        sizes = rng.integers(2, 60, 4)
        batches = [rng.normal(rng.uniform(-1, 1), rng.uniform(0.2, 3), (n, 3, 4)).astype(np.float32) for n in sizes]
        numbers.compare_range(student, batches, percentile, f"four batches, percentile = {percentile}")
    for sign in (1.0, -1.0):  # zero is not among them
        batches = [sign * rng.uniform(0.5, 2, shape).astype(np.float32) for shape in ((4, 6), (2, 3, 5), (7,))]
        numbers.compare_range(student, batches, None, "batches of several shapes, all of one sign")


@suite.test("calibrate", points=3, name="a network in training", reread="Exercise 3.2", time_limit_s=20)
def calibrate_training(student):
    numbers.compare_calibration(student, student.rng("calibrate"), percentile=99.0, training=True)


# ---------------------------------------------------------------- Part 4: pruning


@suite.test("mask", points=2, name="other weights", reread="Exercise 4.1")
def mask_random(student):
    rng = student.rng("mask")
    for shape, sparsity in (((8, 3, 3, 3), 0.25), ((5, 7), 0.9), ((6, 4), 0.0), ((6, 4), 1.0)):
        weight = torch.from_numpy(rng.normal(0.3, 1, shape).astype(np.float32))
        learning.compare_mask(student, weight, sparsity, f"weights {shape}, sparsity = {sparsity}")


@suite.test("mask", points=1, name="equal weights", hint="exactly-so-many", reread="Exercise 4.1, last sentence")
def mask_ties(student):
    for weight in (torch.full((4, 5), 0.5), torch.tensor([[0.0, 0.0, 0.0, 0.0], [0.0, 1.0, -1.0, 1.0]])):
        learning.compare_mask(student, weight, 0.5, f"{tuple(weight.shape)} weights, many of them equal")


@suite.test("pattern", points=1, name="convolutions", reread="Exercise 4.2")
def pattern_convolution(student):
    generator = torch.Generator().manual_seed(int(student.rng("pattern").integers(1000)))
    for shape in ((4, 8, 3, 3), (8, 4, 1, 1), (3, 12)):
        learning.compare_two_four(student, torch.randn(shape, generator=generator) + 0.3, f"weights {shape}")


@suite.test("pattern", points=1, name="equal weights", hint="two-of-four", reread="Exercise 4.2")
def pattern_ties(student):
    for weight in (torch.ones(4, 8), torch.zeros(2, 4, 3, 3)):
        learning.compare_two_four(student, weight, f"{tuple(weight.shape)} weights, all equal")


@suite.test("prune", points=1, name="other shares", reread="Exercise 4.3")
def prune_other(student):
    rng = student.rng("prune")
    for low, high in ((0.2, 0.4), (0.8, 0.9)):
        learning.compare_pruned(student, round(float(rng.uniform(low, high)), 2), rng)


@suite.test("prune", points=2, name="another network learns on", reread="Exercise 4.3, the step", time_limit_s=20)
def prune_steps_other(student):
    learning.compare_pruned_steps(student, student.rng("steps"), "SGD")


# ---------------------------------------------------------------- Part 5: distillation


@suite.test("loss", points=3, name="the right slope", reread="Exercise 5.1", time_limit_s=10)
def loss_gradient(student):
    learning.compare_loss_gradient(student, student.rng("slope"))


@suite.test("loss", points=2, name="any temperature", hint="t-squared", reread="Exercise 5.1, T squared")
def loss_temperature(student):
    learning.check_temperature(student, student.rng("temperature"))


@suite.test("loss", points=2, name="pixels without a label", reread="Exercise 5.1, last paragraph")
def loss_unlabelled(student):
    rng = student.rng("unlabelled")
    for share in (0.4, 1.0):
        given = f"logits (2, 4, 3, 3), {share:.0%} of the pixels labelled 255, temperature = 2, alpha = 0.8"
        logits = learning.logits_and_labels(rng, (2, 4, 3, 3), share)
        learning.compare_loss(student, logits, 2.0, 0.8, given)


@suite.test("step", points=2, name="sixty questions", reread="Exercise 5.2, the teacher", time_limit_s=20)
def step_asked_often(student):
    learning.compare_asked(student, student.rng("asked"), 63)


@suite.test("step", points=1, name="other networks", reread="Exercise 5.2, the student", time_limit_s=30)
def step_other(student):
    learning.compare_steps(student, student.rng("step"), steps=4)


# ---------------------------------------------------------------- Part 6: evaluation


@suite.test("iou", points=2, name="a network in training", reread="Exercise 6.1", time_limit_s=20)
def iou_training(student):
    judge.compare_iou(student, student.rng("iou"), training=True)


@suite.test("iou", points=1, name="a class that is not there", hint="absent-classes", reread="Exercise 6.1",
            time_limit_s=20)  # fmt: skip
def iou_absent(student):
    judge.compare_iou(student, student.rng("absent"), absent=True)


@suite.test("readings", points=2, name="other networks, modules, modes", reread="Exercise 6.2", time_limit_s=60)
def readings_other(student):
    rng = student.rng("readings")
    for questions in READINGS:
        judge.compare_readings(student, questions[int(rng.integers(len(questions)))], rng)


# ---------------------------------------------------------------- Part 7: the network


@suite.test("student", points=8, name="300 scenes nobody has seen", reread="Exercise 7.1, the budget", time_limit_s=120)
def student_hidden(student):
    judge.judge_accuracy(student, WORLDS, LOOKS)

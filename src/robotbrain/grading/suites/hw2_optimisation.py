"""Visible tests of homework 2, `hw2_optimisation`: what `lab.check` runs, and half of what is graded."""

# ruff: noqa: D103 - a test's name says what it tests

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from robotbrain.grading import Suite
from robotbrain.grading.suites import hw2_optimisation_judge as judge
from robotbrain.grading.suites import hw2_optimisation_learning as learning
from robotbrain.grading.suites import hw2_optimisation_network as network_file
from robotbrain.grading.suites import hw2_optimisation_numbers as numbers
from robotbrain.grading.suites import judging
from robotbrain.grading.suites.training import first_steps

suite = Suite("hw2_optimisation")

suite.exercise("bugs", title="1.1 Read before you run", points=4, provides=("VERDICTS",))
suite.exercise("scale", title="2.1 Scale and zero point", points=5, provides=("choose_scale",))
suite.exercise("quantise", title="2.2 There and back", points=6, provides=("quantise", "dequantise"))
suite.exercise(
    "weights", title="2.3 A scale for each channel", points=6, upstream=("quantise",), provides=("quantise_weights",)
)
suite.exercise("range", title="3.1 The range of a signal", points=5, provides=("activation_range",))
suite.exercise("calibrate", title="3.2 Calibrate a network", points=6, upstream=("range",), provides=("calibrate",))
suite.exercise("mask", title="4.1 Which weights go", points=5, provides=("magnitude_mask",))
suite.exercise("pattern", title="4.2 Two of four", points=4, provides=("two_four_mask",))
suite.exercise("prune", title="4.3 Zeros that stay", points=7, upstream=("mask",), provides=("prune", "pruned_step"))
suite.exercise("loss", title="5.1 What the teacher knows", points=9, provides=("distillation_loss",))
suite.exercise(
    "step", title="5.2 Teacher and student", points=6, upstream=("loss",), provides=("teacher_logits", "distil_step")
)
suite.exercise("iou", title="6.1 An honest score", points=6, provides=("mean_iou",))
suite.exercise("readings", title="6.2 Reading the twin", points=4, provides=("readings",))
suite.exercise("student", title="7.1 The network that ships", points=19, provides=("STUDENT",))

# Parts that are not right yet must not spoil what builds on them: our own stand in.
for _name in (
    "quantise",
    "dequantise",
    "activation_range",
    "magnitude_mask",
    "distillation_loss",
):
    suite.reference(_name, f"robotbrain.grading.suites.hw2_optimisation_tools:{_name}")

for _exercise in suite.exercises:
    suite.forbid(
        _exercise,
        imports=(
            "robotbrain.optimisation",
            "robotbrain.training",
            "robotbrain.grading",
            "onnxruntime",
            "torch.ao",
            "torch.nn.utils.prune",
            "torch_pruning",
            "torchao",
        ),
    )

for _key, _text in (numbers.HINTS | learning.HINTS | network_file.HINTS | judge.HINTS).items():
    suite.hint(_key, _text)


suite.warm(judge.warm)
suite.warm_students(judge.warm_students)
suite.warm_students(first_steps)


# ---------------------------------------------------------------- Part 1: reading


@suite.test("bugs", points=2, name="a to e", reread="Exercise 1.1, the listing")
def bugs_first(student: Any) -> None:
    judging.compare_verdicts(student.VERDICTS, numbers.VERDICTS, numbers.VERDICT_HINTS)


# ---------------------------------------------------------------- Part 2: numbers


@suite.test("scale", points=1, name="asymmetric, by hand", reread="Exercise 2.1")
def scale_asymmetric(student: Any) -> None:
    numbers.compare_scale(student, -1.0, 3.0, False)
    numbers.compare_random_scale(student, student.rng("asymmetric"), False)


@suite.test("scale", points=1, name="symmetric, by hand", reread="Exercise 2.1")
def scale_symmetric(student: Any) -> None:
    numbers.compare_scale(student, -1.0, 3.0, True)
    numbers.compare_random_scale(student, student.rng("symmetric"), True)


@suite.test("quantise", points=1, name="six values by hand", reread="Exercise 2.2")
def quantise_small(student: Any) -> None:
    x = np.array([-3.0, -1.04, -0.26, 0.0, 0.44, 9.0], dtype=np.float32)
    numbers.compare_quantise(student, x, 0.1, 20, 0, 63, "[-3, -1.04, -0.26, 0, 0.44, 9], scale = 0.1, "
                             "zero_point = 20, qmin = 0, qmax = 63")  # fmt: skip
    x = (x + student.rng("six values").uniform(-0.03, 0.03, 6)).astype(np.float32)
    numbers.compare_quantise(student, x, 0.1, 20, 0, 63, "six values, scale = 0.1, zero_point = 20, qmin = 0, "
                             "qmax = 63")  # fmt: skip


@suite.test("quantise", points=1, name="and back", reread="Exercise 2.2")
def dequantise_small(student: Any) -> None:
    q = np.array([0, 10, 20, 63], dtype=np.int32)
    numbers.compare_dequantise(student, q, 0.1, 20, "[0, 10, 20, 63], scale = 0.1, zero_point = 20")
    q = student.rng("and back").integers(0, 64, 6).astype(np.int32)
    numbers.compare_dequantise(student, q, 0.1, 20, "six integers, scale = 0.1, zero_point = 20")


@suite.test("weights", points=2, name="channels of all sizes", reread="Exercise 2.3")
def weights_small(student: Any) -> None:
    weight = numbers.channels_of_all_sizes(student.rng("sizes"), (6, 3, 3, 3))
    numbers.compare_weights(student, weight, True, "weights (6, 3, 3, 3), per_channel=True")


# ---------------------------------------------------------------- Part 3: calibration


@suite.test("range", points=1, name="smallest and largest", reread="Exercise 3.1")
def range_minmax(student: Any) -> None:
    batches = [np.array([[0.5, -2.0]]), np.array([[4.0, 1.0], [0.0, 1.5]])]
    numbers.compare_range(student, batches, None, "batches [[0.5, -2]] and [[4, 1], [0, 1.5]]")
    rng = student.rng("smallest and largest")
    batches = [rng.normal(0.5, 2, (k, 2)) for k in (1, 4, 2)]
    numbers.compare_range(student, batches, None, "three batches of 2, 8 and 4 values")


@suite.test("range", points=2, name="without the outliers", reread="Exercise 3.1, the percentile")
def range_percentile(student: Any) -> None:
    rng = student.rng("outliers")
    batches = [rng.normal(1.0, 0.5 + k, (40 + 30 * k, 5)).astype(np.float32) for k in range(3)]
    numbers.compare_range(student, batches, 95.0, "three batches of 200, 350 and 500 values, "
                          "percentile = 95")  # fmt: skip


@suite.test("calibrate", points=3, name="three layers", reread="Exercise 3.2", time_limit_s=20)
def calibrate_small(student: Any) -> None:
    numbers.compare_calibration(student, student.rng("three layers"))


# ---------------------------------------------------------------- Part 4: pruning


@suite.test("mask", points=2, name="eight weights by hand", reread="Exercise 4.1")
def mask_small(student: Any) -> None:
    weight = torch.tensor([[0.1, -0.9, 0.4, -0.2], [0.8, 0.05, -0.6, 0.3]])
    given = "[[0.1, -0.9, 0.4, -0.2], [0.8, 0.05, -0.6, 0.3]], sparsity = 0.375"
    learning.compare_mask(student, weight, 0.375, given)
    weight = torch.from_numpy(student.rng("eight weights").normal(0, 1, (4, 4)))
    learning.compare_mask(student, weight, 0.375, "sixteen weights, sparsity = 0.375")


@suite.test("pattern", points=2, name="a linear layer", reread="Exercise 4.2")
def pattern_small(student: Any) -> None:
    weight = torch.tensor([[0.1, -0.9, 0.4, -0.2, 0.8, 0.05, -0.6, 0.3], [5.0, 4.0, 3.0, 2.0, 0.1, 0.2, 0.3, 0.4]])
    learning.compare_two_four(student, weight, "weights (2, 8)")
    weight = torch.from_numpy(student.rng("a linear layer").normal(0, 1, (3, 8)))
    learning.compare_two_four(student, weight, "weights (3, 8)")


@suite.test("prune", points=2, name="half of every layer", reread="Exercise 4.3")
def prune_half(student: Any) -> None:
    learning.compare_pruned(student, 0.5, student.rng("half"))


@suite.test("prune", points=2, name="zeros after four steps", reread="Exercise 4.3, the step", time_limit_s=20)
def prune_steps(student: Any) -> None:
    learning.compare_pruned_steps(student, student.rng("four steps"), "Adam")


# ---------------------------------------------------------------- Part 5: distillation


@suite.test("loss", points=2, name="fifteen pixels", reread="Exercise 5.1")
def loss_small(student: Any) -> None:
    logits = learning.logits_and_labels(student.rng("pixels"))
    given = "logits (3, 4, 2, 5), every pixel labelled, temperature = 3, alpha = 0.6"
    learning.compare_loss(student, logits, 3.0, 0.6, given)


@suite.test("step", points=1, name="five questions", reread="Exercise 5.2, the teacher", time_limit_s=20)
def step_asked(student: Any) -> None:
    learning.compare_asked(student, student.rng("five"), 5)


@suite.test("step", points=2, name="three steps", reread="Exercise 5.2, the student", time_limit_s=30)
def step_small(student: Any) -> None:
    learning.compare_steps(student, student.rng("three steps"))


# ---------------------------------------------------------------- Part 6: evaluation


@suite.test("iou", points=3, name="ten images", reread="Exercise 6.1", time_limit_s=20)
def iou_small(student: Any) -> None:
    judge.compare_iou(student, student.rng("ten images"))


@suite.test("readings", points=2, name="a quantised network, several cameras", reread="Exercise 6.2", time_limit_s=30)
def readings_small(student: Any) -> None:
    rng = student.rng("several cameras")
    judge.compare_readings(student, judge.random_reading(rng), rng)


# ---------------------------------------------------------------- Part 7: the network


@suite.test("student", points=1, name="the file", reread="Exercise 7.1", time_limit_s=30)
def student_file(student: Any) -> None:
    network_file.load(student)


@suite.test("student", points=3, name="INT8, as TensorRT takes it", reread="Exercise 7.1", time_limit_s=30)
def student_int8(student: Any) -> None:
    judge.check_int8(student)


@suite.test("student", points=2, name="fast enough", reread="Exercise 7.1, the budget", time_limit_s=30)
def student_latency(student: Any) -> None:
    judge.check_latency(student)


@suite.test("student", points=2, name="small enough", reread="Exercise 7.1, the budget", time_limit_s=30)
def student_size(student: Any) -> None:
    judge.check_size(student)


@suite.test("student", points=3, name="100 scenes to practise", reread="Exercise 7.1, the budget", time_limit_s=90)
def student_practice(student: Any) -> None:
    judge.judge_accuracy(student, judge.PRACTICE_WORLDS, judge.PRACTICE_LOOKS)

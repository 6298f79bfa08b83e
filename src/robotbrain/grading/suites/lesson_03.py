"""Checks of the lesson `03_tensorrt_deployment`. Nothing here is graded: an answer that is still open is no mistake."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from robotbrain.grading import Suite, expect, fail
from robotbrain.grading.suites.lesson_tools import answered, equals
from robotbrain.jetson.catalogue import list_modules
from robotbrain.jetson.kernels import Kernel
from robotbrain.jetson.software import newest_jetpack

suite = Suite("lesson_03")

suite.exercise("opset", title="1 One file for a fleet", points=3, provides=("fleet_opset",))
suite.exercise("bandwidth", title="2 What bandwidth was reached?", points=2, provides=("effective_gbs",))
suite.exercise("scale", title="3 A scale from a range", points=2, provides=("int8_scale",))
suite.exercise("stream", title="4 In which order?", points=2, provides=("order",))
suite.exercise("profile", title="5 Batches that the plan takes", points=3, provides=("fit_batch",))
suite.exercise("rebuild", title="6 Build again?", points=1, provides=("builds_again",))

_HINTS = {
    "weakest-parser": "One file for all: the board with the oldest parser decides, so take the least of the opsets.",
    "operators-too-new": "If the operators need a newer opset than some board parses, no file serves all: None.",
    "plain-number": "Return a plain whole number: int(release.onnx_opset.value).",
    "elements-are-bytes": "Count bytes: elements times the bytes of one.",
    "all-three-move": "A kernel reads its input and its weights, and writes its output: add the three.",
    "seconds-and-giga": "GB/s: bytes over seconds over 10^9. A millisecond is 10^-3 s.",
    "symmetric-range": "Symmetric: zero stays zero, so what counts is the larger of |low| and |high|.",
    "top-is-127": "The largest INT8 that is used is 127: -128 has no counterpart, and 255 is for unsigned numbers.",
    "not-the-width": "The range from -127 to 127 is spread over twice the largest magnitude; the two factors 2 cancel.",
    "no-scale-of-zero": "A tensor that is always 0 would give a scale of 0, and dividing by it NaN: return 1.0.",
    "too-many-rows": "No piece may have more rows than the profile's largest batch.",
    "too-few-rows": "No piece may have fewer rows than the profile's smallest batch: pad it.",
    "all-in-order": "The valid rows of all pieces, one after another, are the images in their order, none twice.",
    "pad-at-the-end": "The images come first in a piece and the padding last, and the count is of images alone.",
    "fewest-calls": "Fill a piece before you start another: ceil(n / most) pieces are enough.",
    "same-type": "The padding must be of the images' dtype: an engine for float32 refuses float64.",
    "nothing-to-run": "No images, no pieces: return an empty list.",
    "each-step-once": "Each of the steps belongs into the list exactly once, spelt as in the cell.",
    "copy-what-is-there": "The copy to the GPU takes what stands in host memory: write the image there before.",
    "addresses-first": "The engine asks for the addresses when it starts: set them before.",
    "input-before-run": "A stream works in the order in which it was filled: enqueue the copy before the inference.",
    "run-before-output": "Enqueued before the inference, this copy would fetch the logits of the image before.",
    "sync-last": "Synchronising waits for what is in the stream by then: enqueue the copy back before you wait.",
    "read-after-sync": "Before the stream has been synchronised, host memory holds whatever was there before.",
    "engine-is-of-its-file": "The engine was made of this file's weights and of its scales.",
    "engine-is-of-its-software": "An engine belongs to one TensorRT, on one Jetson Linux.",
    "engine-is-of-its-gpu": "Kernels are chosen for one GPU, by timing them there.",
    "engine-is-of-its-clocks": "Kernels are chosen by timing them, and the winner may change with the clocks.",
    "engine-is-a-file": "The engine is a file on disk. What does not go into its making does not change it.",
}
for _key, _text in _HINTS.items():
    suite.hint(_key, _text)


# ---------------------------------------------------------------- 1


def _right_opset(slugs: Sequence[str], needed: int) -> int | None:
    least = min(int(newest_jetpack(slug).onnx_opset.value) for slug in slugs)
    return least if least >= needed else None


def _opset(student: Any, slugs: list[str], needed: int) -> Any:
    got = answered(student.fleet_opset(list(slugs), needed), "fleet_opset")
    if got is not None and (isinstance(got, bool) or not equals(got, got)):
        fail("`fleet_opset` should return a whole number, or None", got=got, hint="plain-number")
    return got


@suite.test("opset", points=2, name="fleets of the catalogue", reread="Out of torch")
def _opset_fleets(student: Any) -> None:
    rng = student.rng("fleet")
    fleets = [["orin-nano-8gb"], ["orin-nano-8gb", "xavier-nx"], ["nano-4gb", "t5000"], ["t5000", "agx-xavier-32gb"]]
    fleets += [rng.choice(list_modules(), 3, replace=False).tolist() for _ in range(3)]
    for slugs in fleets:
        got, right = _opset(student, slugs, 9), _right_opset(slugs, 9)
        if got != right:
            fail(
                f"on {', '.join(slugs)} the newest opset that all can parse is {right}", got=got, hint="weakest-parser"
            )


@suite.test("opset", points=1, name="operators that are too new", reread="Exercise 1, last sentence")
def _opset_needed(student: Any) -> None:
    for slugs, needed in ((["nano-4gb", "orin-nano-8gb"], 17), (["nano-4gb"], 13), (["xavier-nx"], 18)):
        got, right = _opset(student, slugs, needed), _right_opset(slugs, needed)
        if got != right:
            words = f"for operators of opset {needed} on {', '.join(slugs)} the answer is {right}"
            fail(words, got=got, hint="operators-too-new")


# ---------------------------------------------------------------- 2


@suite.test("bandwidth", points=2, name="kernels worked out by hand", reread="What TensorRT fuses")
def _bandwidth(student: Any) -> None:
    for read, written, weights, size, ms in (
        (6000, 24000, 0, 2, 0.01),
        (4096, 4096, 9216, 4, 0.5),
        (1000, 500, 64, 1, 2.0),
    ):
        kernel = Kernel("conv" if weights else "mem:resize", 10 * weights, read, written, weights)
        got = answered(student.effective_gbs(kernel, size, ms), "effective_gbs")
        right = (read + written + weights) * size / (ms * 1e6)
        if equals(got, right):
            continue
        hint = "seconds-and-giga"
        if equals(got, right / size):
            hint = "elements-are-bytes"
        elif any(equals(got, part * size / (ms * 1e6)) for part in (read, written, read + written, read + weights)):
            hint = "all-three-move"
        words = f"{read} elements read, {written} written and {weights} weights of {size} bytes in {ms:g} ms"
        fail(f"{words} are {right:.4g} GB/s", got=got, hint=hint)


# ---------------------------------------------------------------- 3


@suite.test("scale", points=1, name="ranges worked out by hand", reread="INT8")
def _scale(student: Any) -> None:
    for low, high in ((-1.0, 2.54), (-6.35, 1.0), (0.0, 12.7), (-5.0, 5.0)):
        got = answered(student.int8_scale(low, high), "int8_scale")
        top = max(-low, high)
        if equals(got, top / 127):
            continue
        hint = "symmetric-range"
        if any(equals(got, value) for value in (top / 128, top / 255, top / 256)):
            hint = "top-is-127"
        elif any(equals(got, (high - low) / steps) for steps in (254, 255, 256, 127)) or equals(got, 2 * top / 127):
            hint = "not-the-width"
        fail(f"the range from {low:g} to {high:g} has the scale {top / 127:.5g}", got=got, hint=hint)


@suite.test("scale", points=1, name="a tensor that is always zero", reread="Exercise 3, last sentence")
def _scale_zero(student: Any) -> None:
    got = answered(student.int8_scale(0.0, 0.0), "int8_scale")
    expect(equals(got, 1.0), "the range from 0 to 0 has the scale 1", got=got, hint="no-scale-of-zero")


# ---------------------------------------------------------------- 4

WRITE, COPY_IN, ADDRESSES = (
    "write the image into host memory",
    "enqueue the copy to the GPU",
    "set the tensor addresses",
)
RUN, COPY_OUT = "enqueue the inference", "enqueue the copy to the host"
WAIT, READ = "synchronise the stream", "read the logits from host memory"
_STEPS = (WRITE, COPY_IN, ADDRESSES, RUN, COPY_OUT, WAIT, READ)
_BEFORE = (
    (WRITE, COPY_IN, "copy-what-is-there"),
    (ADDRESSES, RUN, "addresses-first"),
    (COPY_IN, RUN, "input-before-run"),
    (RUN, COPY_OUT, "run-before-output"),
    (COPY_OUT, WAIT, "sync-last"),
    (WAIT, READ, "read-after-sync"),
)


@suite.test("stream", points=2, name="the seven steps", reread="Streams")
def _stream(student: Any) -> None:
    order = student["order"]
    if order is ... or (isinstance(order, list | tuple) and any(step is ... for step in order)):
        raise NotImplementedError("order")
    expect(isinstance(order, list | tuple), "`order` should be a list of steps", got=order)
    expect(
        sorted(map(str, order)) == sorted(_STEPS),
        "the list should hold the seven steps of the cell",
        got=f"{len(order)} entries",
        hint="each-step-once",
    )
    for first, second, hint in _BEFORE:
        if order.index(first) > order.index(second):
            fail(f'"{second}" stands before "{first}"', hint=hint)


# ---------------------------------------------------------------- 5


def _pieces(
    student: Any, images: np.ndarray[Any, Any], least: int, most: int
) -> list[tuple[np.ndarray[Any, Any], int]]:
    got = answered(student.fit_batch(images.copy(), least, most), "fit_batch")
    try:
        pieces = [(np.asarray(rows), int(count)) for rows, count in got]
    except (TypeError, ValueError):
        fail("`fit_batch` should return a list of (array, number of images in it)", got=got)
    for rows, _ in pieces:
        expect(rows.shape[1:] == images.shape[1:], f"a piece has the shape {rows.shape}", got=rows.shape)
    return pieces


@suite.test("profile", points=2, name="pieces that a plan takes", reread="Exercise 5")
def _profile(student: Any) -> None:
    rng = student.rng("images")
    for count, least, most in (
        (3, 1, 8),
        (8, 1, 8),
        (11, 1, 4),
        (9, 4, 8),
        (2, 4, 8),
        (17, 2, 8),
        (5, 5, 5),
        (1, 3, 3),
    ):
        images = rng.normal(size=(count, 3, 4, 4)).astype(np.float32)
        pieces = _pieces(student, images, least, most)
        words = f"{count} images, batches of {least} to {most}: "
        sizes = [len(rows) for rows, _ in pieces]
        expect(
            max(sizes, default=0) <= most, f"{words}a piece of {max(sizes, default=0)}", got=sizes, hint="too-many-rows"
        )
        expect(
            min(sizes, default=most) >= least,
            f"{words}a piece of {min(sizes, default=0)}",
            got=sizes,
            hint="too-few-rows",
        )
        counts = [number for _, number in pieces]
        empty = images[:0]
        whole = np.concatenate([empty, *(rows[:number] for rows, number in pieces)])
        if whole.shape != images.shape or not np.array_equal(whole, images):
            at_the_end = np.concatenate([empty, *(rows[len(rows) - number :] for rows, number in pieces)])
            front = at_the_end.shape == images.shape and np.array_equal(at_the_end, images)
            hint = "pad-at-the-end" if front or sum(counts) > count else "all-in-order"
            fail(f"{words}the valid rows are not the images in their order", got=f"counts {counts}", hint=hint)
        expect(
            len(pieces) == math.ceil(count / most),
            f"{words}{len(pieces)} pieces where {math.ceil(count / most)} are enough",
            got=sizes,
            hint="fewest-calls",
        )


@suite.test("profile", points=1, name="types, and nothing at all", reread="Exercise 5")
def _profile_types(student: Any) -> None:
    images = student.rng("types").normal(size=(3, 3, 2, 2)).astype(np.float32)
    types = sorted({str(rows.dtype) for rows, _ in _pieces(student, images, 4, 4)})
    expect(types == ["float32"], "the pieces of float32 images are float32", got=types, hint="same-type")
    pieces = _pieces(student, images[:0], 2, 4)
    expect(len(pieces) == 0, "without images there are no pieces", got=len(pieces), hint="nothing-to-run")


# ---------------------------------------------------------------- 6

_REBUILD = {
    "the ONNX file was trained for ten minutes more": (True, "engine-is-of-its-file"),
    "`sudo apt upgrade` brought another TensorRT": (True, "engine-is-of-its-software"),
    "the folder was copied to another module": (True, "engine-is-of-its-gpu"),
    "a bundle for 7W instead of 15W": (True, "engine-is-of-its-clocks"),
    "the board was switched off overnight": (False, "engine-is-a-file"),
    "the camera was exchanged for one with better colours": (False, "engine-is-a-file"),
    "it is to be timed for 60 s instead of 10 s": (False, "engine-is-a-file"),
}


@suite.test("rebuild", points=1, name="the seven changes", reread="On the board")
def _rebuild(student: Any) -> None:
    answers = student["builds_again"]
    expect(isinstance(answers, dict), "`builds_again` should still be the dictionary of the cell", got=answers)
    if all(answers.get(change) is ... for change in _REBUILD):
        raise NotImplementedError("builds_again")
    for change, (right, hint) in _REBUILD.items():
        got = answers.get(change)
        expect(isinstance(got, bool | np.bool_), f'for "{change}" the answer is True or False', got=got)
        expect(bool(got) is right, f'"{change}": not {got}', hint=hint)

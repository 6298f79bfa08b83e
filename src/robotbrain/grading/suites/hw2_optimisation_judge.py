"""How `hw2_optimisation` tests evaluation and readings, and judges the submitted network against its budget.

Nothing is trained here. Accuracy is compared with the teacher's on the same scenes, which the author of the network has
not seen, and with what chance could have done to so few of them; latency is the twin's, which is deterministic.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from robotbrain.grading import expect, expect_close, fail
from robotbrain.grading.suites import hw2_optimisation_network as network_file
from robotbrain.grading.suites import hw2_optimisation_probes as probes
from robotbrain.grading.suites import hw2_optimisation_tools as tools
from robotbrain.grading.suites.hw2_optimisation_network import Network
from robotbrain.grading.suites.hw2_optimisation_probes import Array

BUDGET: Mapping[str, Any] = {
    "module": "orin-nano-8gb",
    "mode": "7W",
    "cameras": 8,
    "latency_ms": 1.3,
    "bytes": 300_000,
    "drop": 0.035,
}
"""What the notebook publishes: at most so many ms for the images of all cameras at once, so many bytes of ONNX file,
and a mean IoU so far below the teacher's."""
HALF_DROP = 0.05
"""A drop up to here is worth half of the points."""
INT8_SHARE = 0.9
"""Of the multiply-adds in convolutions and products, at least so many run in INT8."""
TRAINED = 0.6
"""Below this mean IoU a network has not learned its task."""
PER_WORLD = 4
PRACTICE_WORLDS = range(2_600_000, 2_600_025)
"""The practice scenes are those of the validation split."""
PRACTICE_LOOKS = ((6, 0.005), (10, 0.05), (25, 0.05))

HINTS = {
    "iou-over-all-pixels": "Count pixels over ALL images first, and divide once. A mean over images gives a scene with "
    "three pixels of marker as much weight as one that is full of it.",
    "iou-not-accuracy": "Three quarters of all pixels are floor and walls. IoU = TP / (TP + FP + FN) for each class, "
    "and then the mean over the classes.",
    "union-counts-once": "The union is truth plus prediction MINUS what both have: TP + FP + FN.",
    "absent-classes": "A class that is neither in the labels nor in the predictions has no IoU: leave it out of the "
    "mean, instead of counting it as 0 or 1.",
    "all-four-classes": "All four classes count, the first one, too.",
    "test-split": "The figure that is reported comes from `splits['test']`, and only it.",
    "not-what-was-trained-on": "This is the score on the training images: what was learned by heart counts, too.",
    "evaluate-in-eval": "Call `network.eval()` first. In train mode batch norm uses the batch, and its statistics "
    "follow the test images.",
    "leave-the-mode": "Put the network back into the mode in which you found it: it may be in the middle of a "
    "training.",
    "argmax-over-classes": "The class of a pixel is the argmax over axis 1 of (N, 4, H, W).",
    "teacher-minus-student": "The drop is what is lost: teacher's mean IoU minus student's. It is negative where the "
    "student is better.",
    "mode-and-module": "Read the twin for the module AND the power mode of the budget: `predict(path, module, "
    "mode=...)`. The default mode is a faster one.",
    "all-cameras-at-once": "The images of all cameras go through in one batch: `batch=`.",
    "latency-of-the-whole": "`latency_ms` is the time of one inference of the whole batch, all kernels and the start "
    "included; not of one image, of one kernel, or of the peak of the data sheet.",
    "precision-of-the-file": "A file with Q/DQ nodes runs in INT8; without them TensorRT runs it in FP16.",
    "size-of-the-file": "The size is that of the file in bytes (`Path.stat().st_size`).",
    "int8-by-qdq": "No Q/DQ nodes were found in it: this is a floating-point network, whatever its name says. "
    "`quantise_onnx` makes an INT8 one.",
    "most-of-it-in-int8": "Some Q/DQ nodes are there, but much of the work still runs in FP16: convolutions need a "
    "pair before their input AND before their weights.",
    "tensorrt-safe": "TensorRT takes symmetric INT8 only: `quantise_onnx(..., target='tensorrt')` writes it, and the "
    "lint of lesson 8 says which node is at fault.",
    "smaller-please": "The file is too large: a narrower student, or the student instead of the teacher.",
    "faster-please": "Too slow on that module: fewer and cheaper layers. Zeros do not help, and Q/DQ nodes in the "
    "wrong places tear kernels apart.",
    "no-better-than-chance": "Most pixels are wrong. Was the network trained before it was exported? Does it expect "
    "images normalised as `scenes.inputs()` does, and classes in the kit's order?",
    "quantisation-broke-it": "The weights know better than the answers: without its Q/DQ nodes this network is good. "
    "Look at the calibration: images, range, percentile.",
    "labels-are-not-enough": "It is trained, but too far below the teacher. Let it learn from the teacher, on the "
    "unlabelled images, too, and for longer.",
}

# ---------------------------------------------------------------- mean IoU


def compare_iou(student: Any, rng: np.random.Generator, training: bool = False, absent: bool = False) -> None:
    """Compare with the IoU of the pooled counts on the test split; the network stays as it was."""
    network = tools.small_network(rng)
    splits = tools.small_splits(rng)

    def answers(scenes: Any) -> Array:
        return np.concatenate(tools.outputs_of(network, scenes.inputs(), ["4"])["4"])

    test = splits["test"]
    logits = answers(test)
    level = logits.mean(axis=(0, 2, 3))  # every class is claimed somewhere
    level[3] += 1e3 if absent else 0.0  # or class 3 is neither there nor claimed
    for scenes in splits.values() if absent else ():
        scenes.labels[scenes.labels == 3] = 0
    with torch.no_grad():
        network.get_parameter("4.bias").sub_(torch.from_numpy(level))
    logits = logits - level[:, None, None]
    before = probes.state_of(network)
    counts = tools.confusion(test.labels, logits.argmax(axis=1))
    expected = tools.iou(counts)
    found = student.run(probes.scored, before, training, splits)
    answer = found["answer"]
    given = f"a small network, {len(test)} images of 8x8 pixels in the test split"
    hint = tools.first_match(answer, lambda: _iou_mistakes(splits, answers, logits, counts), expected)
    tools.expect_untouched(before, found["state"], "the network", "evaluate-in-eval")
    # Two classes may tie in a pixel, and another batch size rounds another way: a few pixels of 40 960 decide nothing.
    expect_close(answer, expected, atol=5e-5, rtol=1e-5, given=given, hint=hint or ("absent-classes" if absent else ""),
                 what="the mean IoU")  # fmt: skip
    tools.expect_mode(found["training"], network, training, given, "leave-the-mode")


def _iou_mistakes(splits: Mapping[str, Any], answers: Any, logits: Array, counts: Array) -> list[tuple[str, Any]]:
    test = splits["test"]
    predicted = logits.argmax(axis=1)
    each = [tools.confusion(a, b) for a, b in zip(test.labels, predicted, strict=True)]
    hit = np.diag(counts).astype(float)
    truth, claimed = counts.sum(axis=1), counts.sum(axis=0)
    union = truth + claimed - hit
    with np.errstate(invalid="ignore", divide="ignore"):
        values = hit / union
        per_image = np.array([np.diag(c) / (c.sum(axis=0) + c.sum(axis=1) - np.diag(c)) for c in each])
        found: list[tuple[str, Any]] = [
            ("absent-classes", np.nan_to_num(values).mean()),
            ("absent-classes", np.nan_to_num(values, nan=1.0).mean()),
            ("absent-classes", np.float64("nan")),
            ("all-four-classes", np.nanmean(values[1:])),
            ("iou-over-all-pixels", np.mean([tools.iou(c) for c in each])),
            ("iou-over-all-pixels", np.mean(np.nan_to_num(per_image))),
            ("iou-over-all-pixels", np.mean(np.nan_to_num(per_image, nan=1.0))),
            ("iou-over-all-pixels", np.nanmean(np.nanmean(per_image, axis=0))),
            ("iou-not-accuracy", hit.sum() / counts.sum()),
            ("iou-not-accuracy", hit.sum() / union.sum()),
            ("iou-not-accuracy", np.nanmean(hit / truth)),
            ("iou-not-accuracy", np.nanmean(hit / claimed)),
            ("union-counts-once", np.nanmean(hit / (truth + claimed))),
            ("union-counts-once", np.nanmean(2 * hit / (truth + claimed))),
        ]
    for name, key in (
        ("train", "not-what-was-trained-on"),
        ("calibration", "test-split"),
        ("validation", "test-split"),
    ):
        scenes = splits[name]
        found.append((key, tools.iou(tools.confusion(scenes.labels, answers(scenes).argmax(axis=1)))))
    for axis in (2, 3):
        wrong = np.minimum(np.moveaxis(logits, axis, 1)[:, :4].argmax(axis=1), 3)
        if wrong.shape == test.labels.shape:
            found.append(("argmax-over-classes", tools.iou(tools.confusion(test.labels, wrong))))
    return found


# ---------------------------------------------------------------- readings


def chain(channels: Sequence[int], quantised: bool) -> bytes:
    """Return an ONNX file of 3x3 convolutions, with Q/DQ pairs before inputs and weights if ``quantised``."""
    from onnx import TensorProto, helper, numpy_helper

    rng = np.random.default_rng(len(channels))
    nodes, stored = [], [numpy_helper.from_array(np.array(0.05, np.float32), "scale"),
                         numpy_helper.from_array(np.array(0, np.int8), "zero")]  # fmt: skip
    value = "image"

    def pair(name: str) -> str:
        if not quantised:
            return name
        nodes.append(helper.make_node("QuantizeLinear", [name, "scale", "zero"], [f"{name}_q"]))
        nodes.append(helper.make_node("DequantizeLinear", [f"{name}_q", "scale", "zero"], [f"{name}_dq"]))
        return f"{name}_dq"

    for k, (before, after) in enumerate(zip((3, *channels), (*channels, 4), strict=True)):
        weight = rng.normal(0, 0.1, (after, before, 3, 3)).astype(np.float32)
        stored.append(numpy_helper.from_array(weight, f"weight{k}"))
        last = k == len(channels)
        out = "logits" if last else f"conv{k}"
        nodes.append(helper.make_node("Conv", [pair(value), pair(f"weight{k}")], [out], pads=[1, 1, 1, 1]))
        if not last:
            nodes.append(helper.make_node("Relu", [out], [f"relu{k}"]))
        value = f"relu{k}"
    ends = [
        helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", c, 64, 64])
        for name, c in (("image", 3), ("logits", 4))
    ]
    graph = helper.make_graph(nodes, "chain", ends[:1], ends[1:], stored)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    content: bytes = model.SerializeToString(deterministic=True)
    return content


@dataclass(frozen=True)
class Reading:
    """A question to ``readings``: a network, and the conditions under which the twin is asked."""

    channels: tuple[int, ...]
    quantised: bool
    module: str
    mode: str
    cameras: int

    @property
    def precision(self) -> str:
        """What TensorRT makes of the file."""
        return "int8" if self.quantised else "fp16"


def random_reading(rng: np.random.Generator) -> Reading:
    """Return a question about a quantised network under the budget's conditions, but for the number of cameras."""
    first, second, cameras = (int(rng.integers(low, high)) for low, high in ((8, 33), (8, 33), (3, 9)))
    return Reading((first, second), True, BUDGET["module"], BUDGET["mode"], cameras)


@functools.lru_cache(maxsize=16)
def _network_of(channels: tuple[int, ...], quantised: bool) -> bytes:
    return chain(channels, quantised)


@functools.lru_cache(maxsize=16)
def _graph_of(channels: tuple[int, ...], quantised: bool) -> Any:
    from robotbrain.jetson.twin.predictor import as_graph

    return as_graph(_network_of(channels, quantised))


@functools.lru_cache(maxsize=16)
def latency_of(question: Reading) -> float:
    """Return the twin's latency (ms) for a question, which depends on nothing else."""
    q = question
    return float(_asked(q, mode=q.mode, batch=q.cameras, precision=q.precision).latency_ms)


def _asked(question: Reading, **settings: Any) -> Any:
    from robotbrain.jetson import predict

    return predict(_graph_of(question.channels, question.quantised), question.module, **settings)


def compare_readings(student: Any, question: Reading, rng: np.random.Generator) -> None:
    """Compare drop, latency and size with our own reading of the twin."""
    q = question
    teacher_iou, iou = (round(float(v), 4) for v in (rng.uniform(0.965, 0.975), rng.uniform(0.90, 0.99)))
    content = _network_of(q.channels, q.quantised)
    expected = {"drop": teacher_iou - iou, "latency_ms": latency_of(q), "bytes": len(content)}
    budget = {**BUDGET, "module": q.module, "mode": q.mode, "cameras": q.cameras}
    answer = student.run(probes.read, content, iou, teacher_iou, budget)
    kind = "quantised" if q.quantised else "floating-point"
    given = (
        f"a {kind} network of {len(q.channels) + 1} convolutions, {q.module} in mode {q.mode}, {q.cameras} cameras; "
        f"IoU {iou:.3f}, teacher's {teacher_iou:.3f}"
    )
    if not isinstance(answer, Mapping) or set(answer) != set(expected):
        fail("the answer should be a dict of three numbers", got=answer, expected=expected, given=given)
    mistakes: dict[str, Any] = {
        "drop": [("teacher-minus-student", iou - teacher_iou), ("teacher-minus-student", 1 - iou / teacher_iou),
                 ("teacher-minus-student", 100 * (teacher_iou - iou)),
                 ("teacher-minus-student", abs(teacher_iou - iou)), ("teacher-minus-student", 1 - iou)],
        "latency_ms": lambda: _latency_mistakes(q),
        "bytes": [("size-of-the-file", expected["bytes"] / k) for k in (1000, 1024, 1e6, 2**20, 0.125, 4)],
    }  # fmt: skip
    fallback = {"drop": "teacher-minus-student", "latency_ms": "latency-of-the-whole", "bytes": "size-of-the-file"}
    for key, wanted in expected.items():
        hint = tools.first_match(answer[key], mistakes[key], wanted, rtol=1e-6)
        expect_close(answer[key], wanted, rtol=1e-6, given=given, hint=hint or fallback[key], what=f'"{key}"')


def _latency_mistakes(q: Reading) -> tools.Mistakes:
    from robotbrain.jetson import load_module

    right = _asked(q, mode=q.mode, batch=q.cameras, precision=q.precision)
    single = _asked(q, mode=q.mode, precision=q.precision)
    default = load_module(q.module).default_mode
    elsewhere = [_asked(q, mode=default, batch=batch, precision=q.precision) for batch in (1, q.cameras)]
    others = [_asked(q, mode=q.mode, batch=q.cameras, precision=p) for p in ("fp32", "fp16", "int8")]
    return [
        ("all-cameras-at-once", single.latency_ms),
        ("all-cameras-at-once", q.cameras * single.latency_ms),
        ("latency-of-the-whole", right.latency_ms / q.cameras),
        ("latency-of-the-whole", right.baseline_ms),
        ("latency-of-the-whole", right.latency_ms / 1e3),
        ("latency-of-the-whole", right.throughput),
        ("latency-of-the-whole", sum(k.total_ms for k in right.kernels)),
        ("latency-of-the-whole", float(right.macs)),
        ("latency-of-the-whole", right.latency_high_ms),
        ("latency-of-the-whole", right.latency_low_ms),
        *(("mode-and-module", p.latency_ms) for p in elsewhere),
        ("mode-and-module", _asked(q, batch=q.cameras).latency_ms),
        *(("precision-of-the-file", p.latency_ms) for p in others),
    ]


# ---------------------------------------------------------------- the submission


def check_int8(student: Any) -> None:
    """Fail unless the file runs in INT8, nearly all of it, and TensorRT takes it."""
    from robotbrain.optimisation.qdq_lint import lint

    network = network_file.load(student)
    name = network.path.name
    expect(network.quantised, f"{name} is not quantised", got="no QuantizeLinear or DequantizeLinear node",
           hint="int8-by-qdq")  # fmt: skip
    errors = [finding for finding in lint(network.path) if finding.severity == "error"]
    if errors:
        first = errors[0]
        fail(f"TensorRT would refuse {name}: {first.message}", got=f"{len(errors)} violations, the first at "
             f"{first.node} ({first.code})", expected=first.fix, hint="tensorrt-safe")  # fmt: skip
    low, every = network_file.quantised_work(network.model)
    expect(low >= INT8_SHARE * every > 0, "much of the network does not run in INT8",
           got=f"{low / max(1, every):.0%} of the multiply-adds read integers on both sides",
           expected=f"at least {INT8_SHARE:.0%} of them", hint="most-of-it-in-int8")  # fmt: skip


def check_latency(student: Any) -> None:
    """Fail unless the twin's latency is within the budget."""
    network = network_file.load(student)
    prediction = predict_of(network)
    most = BUDGET["latency_ms"]
    expect(prediction.latency_ms <= most, f"{network.path.name} is too slow", got=f"{prediction.latency_ms:.2f} ms in "
           f"{len(prediction.kernels)} kernels ({prediction.precision})", expected=f"at most {most:g} ms",
           given=f"{BUDGET['module']} in mode {BUDGET['mode']}, {BUDGET['cameras']} images at once",
           hint="faster-please" if network.quantised else "int8-by-qdq")  # fmt: skip


def check_size(student: Any) -> None:
    """Fail unless the file is within the budget."""
    network = network_file.load(student)
    name, most = network.path.name, BUDGET["bytes"]
    expect(network.size_bytes <= most, f"{name} is too large", got=f"{network.size_bytes} bytes",
           expected=f"at most {most} bytes", hint="smaller-please")  # fmt: skip


def predict_of(network: Network) -> Any:
    """Return the twin's prediction under the budget's conditions: INT8 if there are Q/DQ nodes, else FP16."""
    from robotbrain.jetson import predict

    precision = "int8" if network.quantised else "fp16"
    return predict(network.path, BUDGET["module"], mode=BUDGET["mode"], batch=BUDGET["cameras"], precision=precision)


@functools.cache
def world(seed: int) -> World:
    """Return a world's scenes with what the teacher makes of them; half a second of work, hence kept."""
    from robotbrain.optimisation.data import scenes_of

    scenes = scenes_of([seed], PER_WORLD)
    session = _teacher()
    logits = session.run(None, {session.get_inputs()[0].name: scenes.inputs()})[0]
    return World(scenes.inputs(), scenes.labels, counts_by_world(scenes.labels, logits)[0])


@dataclass(frozen=True, eq=False)
class World:
    """Scenes of one world: normalised images (4, 3, 64, 64), labels (4, 64, 64), the teacher's pixel counts (4, 4)."""

    inputs: Array
    labels: Array
    teacher: NDArray[np.int64]


@functools.cache
def _teacher() -> Any:
    from robotbrain.optimisation.evaluate import onnx_session
    from robotbrain.optimisation.networks import network_path

    return onnx_session(network_path("teacher"))


def counts_by_world(labels: Array, logits: Array) -> NDArray[np.int64]:
    """Return the confusion matrix of each world, (worlds, 4, 4); ``PER_WORLD`` scenes of each follow each other."""
    index = labels.astype(np.int64) * 4 + logits.argmax(axis=1)
    blocks = index.reshape(-1, PER_WORLD * index[0].size)
    return np.stack([np.bincount(block, minlength=16).reshape(4, 4) for block in blocks])


def drop_with_bound(
    teacher: Array, student: Array, draws: int = 2000, seed: int = 0, doubt: float = 0.05
) -> tuple[float, float]:
    """Return the drop of the mean IoU and the upper end of its one-sided interval, 95 % unless ``doubt`` says else.

    Paired bootstrap over worlds (Efron, 1979): scenes of one world resemble each other, so worlds are drawn, and both
    networks are judged on the same ones.
    """
    picks = np.random.default_rng(seed).multinomial(len(teacher), np.full(len(teacher), 1 / len(teacher)), draws)

    def mean_iou(counts: Array) -> Array:
        hit = np.diagonal(counts, axis1=-2, axis2=-1).astype(float)
        return np.asarray((hit / np.maximum(1, counts.sum(axis=-1) + counts.sum(axis=-2) - hit)).mean(axis=-1))

    drops = [mean_iou(np.tensordot(picks, c, axes=1)) for c in (teacher, student)]
    upper = float(np.quantile(drops[0] - drops[1], 1 - doubt))
    return float(mean_iou(teacher.sum(axis=0)) - mean_iou(student.sum(axis=0))), upper


def judge_accuracy(student: Any, seeds: Sequence[int], looks: Sequence[tuple[int, float]]) -> None:
    """Fail unless the drop is within the budget, chance included; half of the points up to ``HALF_DROP``.

    Args:
        student: whose file it is.
        seeds: of the worlds, ``PER_WORLD`` scenes of each.
        looks: at how many of the worlds to look, and with how much doubt the drop may then be thought to be within
            the budget: most networks need few. One that is hopeless is not looked at any further.
    """
    network = network_file.load(student)
    network_file.check_own(network)
    most = BUDGET["drop"]
    counts, seen, upper = np.zeros((0, 4, 4), np.int64), 0, 0.0
    for number, doubt in looks:
        counts, seen = np.concatenate([counts, _counts(network, seeds[seen:number])]), number
        teacher = _teachers(seeds[:seen])
        drop, upper = drop_with_bound(teacher, counts, doubt=doubt)
        if upper <= most:
            return
        if drop_with_bound(teacher, counts, doubt=0.999)[1] > HALF_DROP:  # so much is lost at least
            break
    mean = tools.iou(counts.sum(axis=0))
    drop, upper = drop_with_bound(teacher, counts)
    fail(
        "the network loses too much accuracy against the teacher",
        given=f"{PER_WORLD * seen} scenes in {seen} worlds that neither network was trained on",
        got=f"mean IoU {mean:.3f}, teacher's {tools.iou(teacher.sum(axis=0)):.3f}: a drop of {100 * drop:.1f} points, "
        f"at most {100 * upper:.1f} with 95 % confidence",
        expected=f"at most {100 * most:.1f} points with 95 % confidence",
        hint=_why(network, seeds[:10], mean),
        credit=0.5 if upper <= HALF_DROP else 0.0,
    )


def _counts(network: Network, seeds: Sequence[int]) -> NDArray[np.int64]:
    """Return a network's pixel counts in each of some worlds, (worlds, 4, 4)."""
    worlds = [world(seed) for seed in seeds]
    if not worlds:
        return np.zeros((0, 4, 4), np.int64)
    logits = network.logits(np.concatenate([w.inputs for w in worlds]))
    return counts_by_world(np.concatenate([w.labels for w in worlds]), logits)


def _teachers(seeds: Sequence[int]) -> NDArray[np.int64]:
    return np.stack([world(seed).teacher for seed in seeds])


def _why(network: Network, seeds: Sequence[int], mean: float) -> str:
    """Return the hint for a network that is not accurate enough."""
    floating = without_quantisers(network.model)
    if floating is not None:
        plain = Network(network.path, network.size_bytes, floating, network_file.session_of(floating))
        unhurt, mine = (tools.iou(_counts(net, seeds).sum(axis=0)) for net in (plain, network))
        if unhurt > TRAINED and unhurt - mine > 0.02:
            return "quantisation-broke-it"
    return "no-better-than-chance" if mean < TRAINED else "labels-are-not-enough"


def warm_students() -> None:
    """Ask the twin for the first time, as students' code will."""
    _asked(Reading((8,), True, BUDGET["module"], BUDGET["mode"], 2), mode=BUDGET["mode"], batch=2)
    _asked(Reading((8,), False, BUDGET["module"], BUDGET["mode"], 2))


def warm() -> None:
    """Import and cache what judging needs."""
    from robotbrain.optimisation.qdq_lint import lint  # noqa: F401

    network_file.shipped_logits()
    latency_of(random_reading(np.random.default_rng(0)))
    for seed in PRACTICE_WORLDS[: PRACTICE_LOOKS[1][0]]:
        world(seed)


def without_quantisers(model: Any) -> Any:
    """Return a copy of a model whose Q/DQ pairs are gone, or None where weights are stored as integers."""
    import onnx

    plain = onnx.ModelProto()
    plain.CopyFrom(model)
    floats = {t.name for t in plain.graph.initializer if t.data_type == onnx.TensorProto.FLOAT}
    inputs = {i.name for i in plain.graph.input}
    comes_from: dict[str, str] = {}
    kept = []
    for node in plain.graph.node:
        if node.op_type in network_file.QUANTISERS:
            comes_from[node.output[0]] = comes_from.get(node.input[0], node.input[0])
        else:
            kept.append(node)
    made = {name for node in kept for name in node.output}
    if not comes_from or any(name not in floats | inputs | made for name in comes_from.values()):
        return None
    for node in kept:
        node.input[:] = [comes_from.get(name, name) for name in node.input]
    ends = {o.name for o in plain.graph.output}
    if ends & set(comes_from):
        kept += [
            onnx.helper.make_node("Identity", [comes_from[name]], [name]) for name in sorted(ends & set(comes_from))
        ]
    del plain.graph.node[:]
    plain.graph.node.extend(kept)
    return plain

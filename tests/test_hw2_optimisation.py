"""Homework 2 itself: generated from its solution, its tests tested by named wrong solutions, its story true."""

from __future__ import annotations

import ast
import copy
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import nbformat
import numpy as np
import pytest
import torch
from torch import nn

from robotbrain.errors import InputError
from robotbrain.grading import CheckFailure, Suite, load_hidden_suite
from robotbrain.grading.course import find_course, release_differences
from robotbrain.grading.sample import Reference, load_mutants
from robotbrain.grading.student import Student
from robotbrain.grading.suites import hw2_optimisation_judge as judge
from robotbrain.grading.suites import hw2_optimisation_learning as learning
from robotbrain.grading.suites import hw2_optimisation_network as network_file
from robotbrain.grading.suites import hw2_optimisation_numbers as numbers
from robotbrain.grading.suites import hw2_optimisation_probes as probes
from robotbrain.grading.suites import hw2_optimisation_tools as tools
from tests import classes, far

LAB = "hw2_optimisation"
FILE = "student_int8.onnx"


@pytest.fixture(scope="module")
def suite(repo: Path) -> Suite:
    return load_hidden_suite(LAB, repo / "autograder")


@pytest.fixture(scope="module")
def solution(repo: Path) -> Any:
    return nbformat.read(repo / "solutions" / LAB / f"{LAB}.ipynb", as_version=4)


@pytest.fixture(scope="module")
def beside(repo: Path) -> Path:
    """The files that are handed in with the reference."""
    return repo / "autograder" / "reference" / LAB


HANDED_IN = Student({"STUDENT": FILE}, LAB, frozenset())
"""A student who hands in what lies in the working directory."""


@pytest.fixture
def handed_in(repo: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with the reference network, which is the working directory."""
    target = tmp_path / FILE
    target.write_bytes((repo / "autograder" / "reference" / LAB / FILE).read_bytes())
    monkeypatch.chdir(tmp_path)
    return target


def test_labs_is_what_solutions_generates(repo: Path, tmp_path: Path) -> None:
    assert release_differences(find_course(repo), LAB, tmp_path) == []


def test_the_released_lab_holds_no_answer_no_hidden_test_and_no_network(repo: Path) -> None:
    text = (repo / "labs" / LAB / f"{LAB}.ipynb").read_text(encoding="utf-8")
    for secret in (
        "BEGIN SOLUTION",
        "HIDDEN TESTS",
        "hidden=True",
        '"a": "breaks"',
        "np.rint(",
        "log_p.exp()",
        "topk(",
    ):
        assert secret not in text, secret
    assert text.count("raise NotImplementedError()") >= 16
    assert not list((repo / "labs" / LAB).glob("*.onnx"))


def test_points_agree_between_notebook_and_tests(repo: Path, suite: Suite) -> None:
    classes.check_points(repo, LAB, suite, automatic=92, by_hand=8)


def test_the_budget_of_the_notebook_is_the_judges(solution: Any) -> None:
    cell = next(c for c in solution.cells if c.id == "budget")
    assigned = next(n for n in ast.parse(cell.source).body if isinstance(n, ast.Assign))
    assert ast.literal_eval(assigned.value) == dict(judge.BUDGET)
    text = next(c.source for c in solution.cells if c.id == "ex-student")
    for promise in (
        f"**{judge.BUDGET['latency_ms']:g} ms**",
        f"**{judge.BUDGET['bytes'] / 1000:g} kB**",
        f"**{100 * judge.BUDGET['drop']:g} percentage points**",
        f"A drop of up to {100 * judge.HALF_DROP:g} percentage points",
    ):
        assert promise in text, promise


def test_nothing_is_trained_or_rendered_while_grading(solution: Any) -> None:
    for cell in solution.cells:
        costly = ("= train(", "scenes(", "export_onnx(", "quantise_onnx(", "pruned_step(network, masks")
        if cell.cell_type == "code" and any(word in cell.source for word in costly) and "def pruned" not in cell.source:
            assert "skip-grading" in cell.metadata.get("tags", []), cell.id


def test_every_hint_and_every_mutant_is_of_use(repo: Path, suite: Suite) -> None:
    mutants, styles = load_mutants(find_course(repo), LAB)
    assert len(mutants) >= 45 and len(styles) == 3
    assert {m.hint for m in mutants} <= set(suite.hints)
    assert {m.exercise for m in mutants} == set(suite.exercises)
    parts = ("", "_judge", "_learning", "_network", "_numbers", "_probes", "_tools")
    files = [f"src/robotbrain/grading/suites/{LAB}{part}.py" for part in parts]
    tests = "".join((repo / name).read_text(encoding="utf-8") for name in [*files, f"autograder/hidden/{LAB}.py"])
    assert [key for key in suite.hints if tests.count(f'"{key}"') < 2] == []


# ---------------------------------------------------------------- our answers against peers and mathematics


def test_our_scales_are_those_of_the_library() -> None:
    from robotbrain.optimisation.affine import choose_qparams

    rng = np.random.default_rng(0)
    for _ in range(50):
        low, high = sorted(float(v) for v in rng.uniform(-3, 3, 2))
        scale, zero = tools.choose_scale(low, high)
        theirs = choose_qparams(np.float64(low), np.float64(high), signed=False)
        assert (float(theirs.scale), int(theirs.zero_point)) == (pytest.approx(scale, rel=1e-5), zero)
        scale, zero = tools.choose_scale(low, high, symmetric=True)
        theirs = choose_qparams(np.float64(low), np.float64(high), signed=True, symmetric=True)
        assert (float(theirs.scale), int(theirs.zero_point)) == (pytest.approx(scale, rel=0.01), zero)


def test_our_loss_is_that_of_the_library_and_its_slope_is_a_slope() -> None:
    from robotbrain.optimisation.distillation import distillation_loss

    for seed, unknown in ((0, 0.0), (1, 0.4), (2, 1.0)):
        logits = learning.logits_and_labels(np.random.default_rng(seed), unknown=unknown)
        for temperature, alpha in ((1.0, 0.5), (4.0, 0.7), (20.0, 1.0)):
            ours = tools.distillation_loss(*logits, temperature, alpha)
            assert float(ours) == pytest.approx(
                float(distillation_loss(*logits, temperature=temperature, alpha=alpha)), rel=1e-9
            )
    student, teacher, labels = learning.logits_and_labels(np.random.default_rng(3), (2, 4, 1, 3))

    def loss(z: torch.Tensor) -> torch.Tensor:
        return tools.distillation_loss(z, teacher, labels, 3.0, 0.6)

    assert torch.autograd.gradcheck(loss, (student.requires_grad_(True),))


def test_our_masks_are_those_of_the_library() -> None:
    from robotbrain.optimisation.pruning import l1_mask

    weight = torch.randn(6, 5, 3, 3, generator=torch.Generator().manual_seed(0))
    for sparsity in (0.0, 0.3, 0.5, 1.0):
        assert torch.equal(tools.magnitude_mask(weight, sparsity), torch.as_tensor(l1_mask(weight, sparsity)))


def test_our_score_is_that_of_the_library() -> None:
    from robotbrain.optimisation.data import Scenes
    from robotbrain.optimisation.evaluate import mean_iou

    for seed in range(4):
        rng = np.random.default_rng(seed)
        scenes = tools.small_scenes(rng, 6)
        network = tools.small_network(rng).eval()
        logits = np.concatenate(tools.outputs_of(network, scenes.inputs(), ["4"])["4"])
        ours = tools.iou(tools.confusion(scenes.labels, logits.argmax(axis=1)))
        assert ours == pytest.approx(mean_iou(network, Scenes(scenes.images, scenes.labels)).mean, abs=1e-9)


def test_the_bound_covers_the_drop_as_often_as_it_says() -> None:
    rng = np.random.default_rng(1)

    def worlds(count: int) -> tuple[Any, Any]:
        """Two networks that are right about each pixel with probabilities that differ from world to world."""
        ease = rng.uniform(0.90, 0.98, count)
        tables = []
        for skill in (0.01, -0.02):
            counts = np.zeros((count, 4, 4), dtype=np.int64)
            for k, p in enumerate(np.clip(ease + skill + rng.normal(0, 0.01, count), 0, 1)):
                for c in range(4):
                    right = rng.binomial(4000, p)
                    counts[k, c, c], counts[k, c, (c + 1) % 4] = right, 4000 - right
            tables.append(counts)
        return tables[0], tables[1]

    truth, _ = judge.drop_with_bound(*worlds(4000), draws=2)
    covered = sum(truth <= judge.drop_with_bound(*worlds(60), draws=300)[1] for _ in range(200))
    assert 0.89 <= covered / 200 <= 0.99


def student(**answers: Any) -> Student:
    """Return a student with these answers."""
    return Student(answers, LAB, frozenset())


OURS = student(
    **{name: getattr(tools, name) for name in ("choose_scale", "quantise", "dequantise", "quantise_weights")},
    **{name: getattr(tools, name) for name in ("activation_range", "magnitude_mask", "distillation_loss")},
    distil_step=learning.Step(),
)


def right_answers() -> Iterator[tuple[Callable[..., None], tuple[Any, ...]]]:
    for low, high in ((-1, 3), (0.5, 3), (-3, -1), (0, 0)):
        for symmetric in (False, True):
            yield numbers.compare_scale, (low, high, symmetric)
    yield numbers.check_round_trip, (0.02, 100)
    for seed in range(5):
        rng = np.random.default_rng(seed)
        yield numbers.check_half_a_step, (rng,)
        weight = numbers.channels_of_all_sizes(rng, (5, 4, 3, 3), dead=bool(seed % 2))
        yield numbers.compare_weights, (weight, bool(seed % 3), "")
        batches = [rng.normal(0, 1 + k, (7, 5)) for k in range(3)]
        yield numbers.compare_range, (batches, [None, 90.0][seed % 2], "")
        yield learning.compare_mask, (torch.from_numpy(rng.normal(0, 1, (6, 5))), 0.3, "")
        yield learning.compare_loss, (learning.logits_and_labels(rng), 3.0, 0.4, "")
        yield learning.compare_loss_gradient, (rng,)
        yield learning.check_temperature, (rng,)
        yield learning.compare_steps, (rng,)


def test_random_tests_pass_our_own_answers_whatever_the_seed() -> None:
    for test, arguments in right_answers():
        test(OURS, *arguments)


def test_typical_mistakes_of_a_step_can_be_told_apart() -> None:
    for seed, steps in ((6, 3), (100, 4), (101, 4)):
        for key, step in learning.STEP_VARIANTS:
            with pytest.raises(CheckFailure) as caught:
                learning.compare_steps(student(distil_step=step), np.random.default_rng(seed), steps)
            assert caught.value.hint == key


PREAMBLE = """
from pathlib import Path
import numpy as np
import torch
from torch import nn
from torch.nn import functional as F
from robotbrain.jetson import predict
STUDENT = "student_int8.onnx"
"""


def test_answers_are_graded_alike_near_and_far(repo: Path, suite: Suite, beside: Path) -> None:
    reference = Reference(find_course(repo), LAB)
    mutants, styles = load_mutants(find_course(repo), LAB)
    trials = far.Trials(suite, PREAMBLE, beside)
    trials.expect_full(reference.edit({}, "reference"), "reference", suite.exercises)
    trials.expect_nothing(reference.stubs, "stub", [e for e in suite.exercises if e != "student"])
    for style in styles:
        trials.expect_full(reference.edit(style.replace, style.name), style.name,
                           [e for e in suite.exercises if e in style.replace])  # fmt: skip
    for mutant in mutants:
        if not mutant.files:
            trials.expect_loss(reference.edit(mutant.replace, mutant.name), mutant)
    assert trials.problems == []


# Of the wrong files, those that are made and judged quickly; `make mutation-test` grades all.
QUICK_FILES = ("file-not-handed-in", "file-cut-off", "weights-elsewhere", "loops-for-ever", "channels-last",
               "not-a-number", "floating-point-network", "int8-by-name", "forgotten-numbers", "plain-student",
               "exported-before-training", "classes-in-another-order", "calibrated-in-the-dark")  # fmt: skip


@pytest.mark.parametrize("name", QUICK_FILES)
def test_wrong_files_lose_their_points(repo: Path, suite: Suite, beside: Path, tmp_path: Path, name: str) -> None:
    reference = Reference(find_course(repo), LAB)
    mutant = next(m for m in load_mutants(find_course(repo), LAB)[0] if m.name == name)
    trials = far.Trials(suite, PREAMBLE, far.with_files(beside, mutant, tmp_path), near=False)
    trials.expect_loss(reference.edit(mutant.replace, mutant.name), mutant)
    assert trials.problems == []


def test_a_value_between_two_levels_may_be_rounded_in_either_precision() -> None:
    rng = np.random.default_rng(0)
    x = ((rng.integers(-90, 90, 4000) + 0.5) * 0.013).astype(np.float32)  # ties, up to their own rounding
    single, double = (np.rint(x / kind(0.013)).astype(np.int32) for kind in (np.float32, np.float64))
    assert (single != double).any()
    for answer in (single, double):
        mine = student(quantise=lambda *_, answer=answer, **__: answer)
        numbers.compare_quantise(mine, x, 0.013, 0, -127, 127, "")
    wrong = student(quantise=lambda *_, **__: double + (x > 0))
    with pytest.raises(CheckFailure):
        numbers.compare_quantise(wrong, x + np.float32(0.001), 0.013, 0, -127, 127, "")


def test_a_wrong_type_is_no_second_walk() -> None:
    batches = [np.ones((2, 3)), np.ones(4)]

    def inhomogeneous(source: Any, percentile: Any = None) -> Any:
        values = np.array(list(source))
        return values.min(), values.max()

    with pytest.raises(ValueError, match="inhomogeneous"):  # the student's own error is reported as such
        numbers.compare_range(student(activation_range=inhomogeneous), batches, None, "")
    with pytest.raises(CheckFailure) as caught:
        numbers.compare_range(student(activation_range=lambda source, percentile=None: 3.0), batches, None, "")
    assert caught.value.hint == ""


# ---------------------------------------------------------------- what the homework tells


def tiny() -> nn.Sequential:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        return nn.Sequential(nn.Conv2d(3, 6, 3), nn.BatchNorm2d(6), nn.ReLU(), nn.Conv2d(6, 4, 1))


def test_what_part_1_says_of_zeros_teacher_and_loss_is_true() -> None:
    from torch.nn.utils import prune

    images = torch.randn(8, 3, 8, 8, generator=torch.Generator().manual_seed(1))

    def outline(detach: bool = True, divergence: bool = False, teacher_eval: bool = True) -> tuple[Any, Any, Any]:
        network, teacher = tiny(), tiny()
        with torch.no_grad():
            teacher[3].weight.mul_(3.0)
        for layer in network:
            if isinstance(layer, nn.Conv2d):
                prune.l1_unstructured(layer, name="weight", amount=0.2)
                prune.remove(layer, "weight")
        zeros = int((network[0].weight == 0).sum())
        assert zeros == round(0.2 * network[0].weight.numel())
        optimiser = torch.optim.Adam(network.parameters(), lr=1e-3)
        before = probes.state_of(teacher)
        network.train()
        teacher.train(not teacher_eval)
        for _ in range(3):
            wanted = torch.softmax(teacher(images) / 4.0, dim=1)
            wanted = wanted.detach() if detach else wanted
            given = torch.log_softmax(network(images) / 4.0, dim=1)
            loss = -(wanted * given).sum(dim=1).mean()
            if divergence:
                loss = loss + (wanted * wanted.log()).sum(dim=1).mean()
            optimiser.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            optimiser.step()
        assert int((network[0].weight == 0).sum()) == 0  # a: no zero is left
        moved = tools.changed(before, probes.state_of(teacher))
        return tools.flat(probes.state_of(network)), moved, teacher[0].weight.grad

    right, moved, gradient = outline()
    assert not moved and gradient is None
    same, _, wasted = outline(detach=False)
    assert torch.equal(same, right) and wasted is not None  # c: the same numbers, for more work
    assert torch.allclose(outline(divergence=True)[0], right, atol=1e-6)  # e: the same slope
    other, moved, _ = outline(teacher_eval=False)
    assert moved and not torch.allclose(other, right, atol=1e-4)  # d


def test_what_part_1_says_of_quantisation_is_true() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import torch.ao.quantization as deprecated

        network = nn.Sequential(nn.Conv2d(3, 4, 3), nn.ReLU())
        network.eval()
        network.qconfig = deprecated.get_default_qat_qconfig("fbgemm")  # type: ignore[assignment]
        with pytest.raises(AssertionError, match="training mode"):  # g
            deprecated.prepare_qat(network)
        network.train()
        converted = deprecated.convert(deprecated.prepare_qat(network).eval())
    assert float(converted[0].scale) == 1.0  # h: what it was made with
    assert type(converted[0]).__module__.startswith("torch.ao.nn.quantized")  # j: a CPU's kernels


def test_zeros_change_neither_the_latency_nor_the_size(handed_in: Path) -> None:
    import onnx
    from onnx import numpy_helper

    network = network_file.load(HANDED_IN)
    before = judge.predict_of(network).latency_ms
    model = copy.deepcopy(network.model)
    for tensor in model.graph.initializer:
        array = numpy_helper.to_array(tensor)
        if array.ndim == 4:
            tensor.CopyFrom(numpy_helper.from_array(np.zeros_like(array), tensor.name))
    onnx.save(model, FILE)
    pruned = network_file.load(HANDED_IN)
    assert judge.predict_of(pruned).latency_ms == before and pruned.size_bytes == network.size_bytes


# ---------------------------------------------------------------- the budget


WORLDS = 40


def test_the_reference_keeps_within_the_budget_with_a_margin(handed_in: Path) -> None:
    network = network_file.load(HANDED_IN)
    judge.check_int8(HANDED_IN)
    assert judge.predict_of(network).latency_ms < 0.97 * judge.BUDGET["latency_ms"]
    assert network.size_bytes < 0.97 * judge.BUDGET["bytes"]
    drop, upper = drop_of(network)
    assert judge.BUDGET["drop"] - upper > 1.5 * (upper - drop)  # 1.5 times the noise is left


def test_teacher_plain_student_and_floating_point_do_not(repo: Path, handed_in: Path) -> None:
    from robotbrain.optimisation.networks import network_path

    handed_in.write_bytes(network_path("teacher").read_bytes())
    for check, hint in ((judge.check_latency, "int8-by-qdq"), (judge.check_size, "smaller-please"),
                        (judge.check_int8, "int8-by-qdq")):  # fmt: skip
        with pytest.raises(CheckFailure) as caught:
            check(HANDED_IN)
        assert caught.value.hint == hint
    plain = repo / "autograder" / "mutants" / LAB / "plain_int8.onnx"
    handed_in.write_bytes(plain.read_bytes())
    drop, upper = drop_of(network_file.load(HANDED_IN))
    assert drop - judge.BUDGET["drop"] > 1.5 * (upper - drop)  # no luck of the draw saves it


def drop_of(network: Any) -> tuple[float, float]:
    seeds = range(31_000_000, 31_000_000 + WORLDS)
    return judge.drop_with_bound(judge._teachers(seeds), judge._counts(network, seeds))


def test_work_that_nobody_needs_and_cheap_layers_make_no_network_more_quantised(handed_in: Path) -> None:
    import onnx
    from onnx import helper, numpy_helper

    network = network_file.load(HANDED_IN)
    low, every = network_file.quantised_work(network.model)
    assert 0.9 * every <= low <= every

    floating = copy.deepcopy(judge.without_quantisers(network.model))
    assert network_file.quantised_work(floating) == (0, every)
    # A hundred quantised convolutions of four channels behind it, each of which changes nothing.
    for node in floating.graph.node:
        node.output[:] = ["c0" if name == "logits" else name for name in node.output]
    eye = np.eye(4, dtype=np.float32)[:, :, None, None]
    stored = ((eye, "eye"), (np.array(0.01, np.float32), "s"), (np.array(0, np.int8), "z"))
    floating.graph.initializer.extend(numpy_helper.from_array(array, name) for array, name in stored)
    for k in range(100):
        out = "logits" if k == 99 else f"c{k + 1}"
        floating.graph.node.extend([
            helper.make_node("QuantizeLinear", [f"c{k}", "s", "z"], [f"q{k}"]),
            helper.make_node("DequantizeLinear", [f"q{k}", "s", "z"], [f"d{k}"]),
            helper.make_node("QuantizeLinear", ["eye", "s", "z"], [f"w{k}"]),
            helper.make_node("DequantizeLinear", [f"w{k}", "s", "z"], [f"v{k}"]),
            helper.make_node("Conv", [f"d{k}", f"v{k}"], [out]),
        ])  # fmt: skip
    onnx.checker.check_model(floating)
    low, more = network_file.quantised_work(floating)
    assert low == 100 * 16 * 64 * 64 == more - every
    # What does not reach the output does not count at all.
    floating.graph.output[0].name = "c0"
    assert network_file.quantised_work(floating) == (0, every)


def test_the_kits_student_is_known_in_any_disguise_and_ours_is_our_own(repo: Path, handed_in: Path) -> None:
    network_file.check_own(network_file.load(HANDED_IN))
    mutants, _ = load_mutants(find_course(repo), LAB)
    disguised = next(m for m in mutants if m.name == "kits-student-in-disguise")
    content = disguised.files[FILE](handed_in.parent)
    assert content is not None
    handed_in.write_bytes(content)
    with pytest.raises(CheckFailure) as caught:
        network_file.check_own(network_file.load(HANDED_IN))
    assert caught.value.hint == "train-your-own"


def test_what_a_transposed_convolution_cuts_off_is_counted() -> None:
    from onnx import helper, numpy_helper

    kernel = np.zeros((1, 1, 1536, 1536), np.float32)
    ends = [helper.make_tensor_value_info(n, 1, ["batch", c, 64, 64]) for n, c in (("image", 3), ("logits", 4))]
    nodes = [
        helper.make_node("ReduceMean", ["image"], ["one"], axes=[1]),
        helper.make_node("ConvTranspose", ["one", "kernel"], ["point"], pads=[799, 799, 799, 799]),
        helper.make_node("ReduceMean", ["point"], ["number"], axes=[2, 3]),
        helper.make_node("Slice", ["image", "start", "end", "axis"], ["three"]),
        helper.make_node("Concat", ["three", "one"], ["four"], axis=1),
        helper.make_node("Add", ["four", "number"], ["logits"]),
    ]
    stored = [numpy_helper.from_array(kernel, "kernel")]
    stored += [numpy_helper.from_array(np.array([v]), n) for n, v in (("start", 0), ("end", 3), ("axis", 1))]
    graph = helper.make_graph(nodes, "cut", ends[:1], ends[1:], stored)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    with pytest.raises(InputError, match="cost"):
        network_file.checked_model(model.SerializeToString())


@pytest.mark.parametrize("damage", ["empty", "text", "huge", "many nodes", "future opset"])
def test_a_hostile_file_gets_a_sentence(handed_in: Path, damage: str) -> None:
    import onnx

    model = onnx.load(FILE)
    if damage == "empty":
        data = b""
    elif damage == "text":
        data = b"import os; os.system('true')"
    elif damage == "huge":
        data = bytes(network_file.MAX_BYTES + 1)
    elif damage == "many nodes":
        name = model.graph.node[-1].output[0]
        for k in range(network_file.MAX_NODES):
            model.graph.node.append(onnx.helper.make_node("Identity", [name], [f"more{k}"]))
        data = model.SerializeToString()
    else:
        model.opset_import[0].version = 99
        data = model.SerializeToString()
    handed_in.write_bytes(data)
    with pytest.raises(CheckFailure) as caught:
        network_file.load(HANDED_IN)
    assert caught.value.hint == "not-a-network" and FILE in caught.value.message


def test_a_resize_cannot_ask_for_terabytes(handed_in: Path) -> None:
    import onnx
    from onnx import numpy_helper

    model = onnx.load(FILE)
    model.graph.initializer.append(numpy_helper.from_array(np.array([1, 1, 4e4, 4e4], np.float32), "much"))
    for node in model.graph.node:
        node.output[:] = ["small" if name == "logits" else name for name in node.output]
    model.graph.node.append(onnx.helper.make_node("Resize", ["small", "", "much"], ["logits"]))
    onnx.save(model, FILE)
    with pytest.raises(CheckFailure) as caught:
        network_file.load(HANDED_IN)
    assert caught.value.hint == "not-a-network"


# ---------------------------------------------------------------- the class


@pytest.fixture(scope="module")
def graded(repo: Path, tmp_path_factory: pytest.TempPathFactory) -> classes.Graded:
    # What wrong answers lose is tested above, in this process; here, how right ones and a wrong file fare in the
    # sandbox and in nbgrader. `make mutation-test` grades all.
    names = {"weights-elsewhere", "torch-only"}
    return classes.grade_sample(repo, LAB, tmp_path_factory.mktemp("class"), lambda entry: entry["name"] in names)


@pytest.mark.timeout(1200)
def test_a_class_gets_what_it_deserves(graded: classes.Graded) -> None:
    classes.check_losses(graded, at_least=2)


def test_every_submission_ends_in_a_grade_and_a_feedback_page(graded: classes.Graded) -> None:
    classes.check_pages(graded, LAB)


def test_hidden_tests_do_not_show_in_feedback(graded: classes.Graded) -> None:
    classes.check_secrets(graded, LAB, "check_half_a_step", "judge_accuracy")

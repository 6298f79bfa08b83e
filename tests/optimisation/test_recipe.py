"""Recipes as values, the sharing of steps, and what a workshop leaves behind."""

from __future__ import annotations

import dataclasses
import gzip
import hashlib
import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch

from robotbrain.errors import InputError, RobotBrainError
from robotbrain.optimisation import networks
from robotbrain.optimisation.evaluate import predict
from robotbrain.optimisation.pruning import MaskedPruning
from robotbrain.optimisation.recipe import Budget, Recipe, plan, step_key
from robotbrain.optimisation.sweep import default_recipes
from robotbrain.optimisation.workshop import Workshop, weight_facts
from tests.optimisation import tiny

TINY = Recipe(student=4, distil=False)


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    folder, before = tiny.make_weights(tmp_path_factory.mktemp("weights")), networks.WEIGHTS
    networks.WEIGHTS = folder
    yield folder
    networks.WEIGHTS = before


@pytest.fixture(scope="module")
def shop(weights: Path, tmp_path_factory: pytest.TempPathFactory) -> Workshop:
    return tiny.workshop(tmp_path_factory.mktemp("shop"))


# ---------------------------------------------------------------- values


def test_recipes_survive_json_and_have_names_of_their_own() -> None:
    recipes = default_recipes()
    assert 20 <= len(recipes) <= 30
    assert [Recipe.from_dict(json.loads(json.dumps(r.to_dict()))) for r in recipes] == recipes
    for names in ([r.label for r in recipes], [r.slug for r in recipes]):
        assert len(set(names)) == len(recipes)
    assert all(set(r.slug) <= set("abcdefghijklmnopqrstuvwxyz0123456789-") for r in recipes)


@pytest.mark.parametrize(
    ("change", "what"),
    [
        ({"student": "pupil"}, "student"),
        ({"student": 3}, "student"),
        ({"student": True}, "student"),
        ({"prune_channels": 1.0}, "prune_channels"),
        ({"prune_channels": float("nan")}, "prune_channels"),
        ({"sparsity": 0.0}, "sparsity"),
        ({"sparsity": "1:2"}, "sparsity"),
        ({"sparsity": True}, "sparsity"),
        ({"quantise": "int4"}, "quantise"),
        ({"calibration": "max"}, "calibration"),
        ({"seed": -1}, "seed"),
        ({"distil": 1}, "distil"),
    ],
)
def test_wrong_values_are_refused_by_name(change: dict[str, object], what: str) -> None:
    with pytest.raises(InputError, match=f"recipe: {what}"):
        Recipe.from_dict(change)


def test_unknown_entries_and_budgets_are_refused() -> None:
    with pytest.raises(InputError, match="prunning"):
        Recipe.from_dict({"prunning": 0.5})
    for change in ({"images": 0}, {"epochs": 1.5}, {"learning_rate": 0.0}, {"images": 8}):
        with pytest.raises(InputError, match="budget"):
            dataclasses.replace(Budget(), **change)


# ---------------------------------------------------------------- plans and keys


def kinds(recipe: Recipe) -> list[str]:
    return [step.kind for step in plan(recipe)]


def test_the_order_of_the_steps_is_fixed() -> None:
    everything = Recipe(prune_channels=0.5, sparsity="2:4", quantise="ptq")
    assert kinds(everything) == ["network", "channels", "sparsity", "export", "ptq"]
    assert kinds(dataclasses.replace(everything, quantise="qat")) == ["network", "channels", "sparsity", "qat"]
    assert kinds(Recipe()) == ["network", "export"]


def test_recipes_that_begin_alike_share_their_steps() -> None:
    def shared(one: Recipe, other: Recipe) -> int:
        count = 0
        for a, b in zip(plan(one), plan(other), strict=False):
            if a != b:
                break
            count += 1
        return count

    pruned = Recipe(prune_channels=0.5)
    assert shared(pruned, dataclasses.replace(pruned, quantise="ptq")) == 3  # up to the export
    assert shared(pruned, dataclasses.replace(pruned, sparsity=0.5)) == 2
    assert shared(pruned, dataclasses.replace(pruned, distil=False)) == 1
    # What does not matter for a step is not in it: nothing is trained here, nothing calibrated there.
    assert plan(Recipe(distil=False, seed=3)) == plan(Recipe())
    assert plan(Recipe(quantise="qat", calibration="entropy")) == plan(Recipe(quantise="qat"))


def test_a_key_depends_on_all_that_matters() -> None:
    first, *_ = plan(Recipe(student=8))
    key = step_key(first, "", {"train": "a"})
    assert key == step_key(first, "", {"train": "a"})
    others = [
        step_key(first, "x", {"train": "a"}),
        step_key(first, "", {"train": "b"}),
        *(
            step_key(first._replace(settings=first.settings | {name: 99}), "", {"train": "a"})
            for name in first.settings
        ),
    ]
    assert len({key, *others}) == 1 + len(others)


def test_data_teacher_and_weights_are_part_of_the_key(shop: Workshop, weights: Path, tmp_path: Path) -> None:
    other = Workshop(tmp_path, tiny.BUDGET, train=tiny.noise(16, 9), calibration=tiny.noise(4, 2), progress=False)
    assert shop.key(TINY) != other.key(TINY)  # other images
    assert shop.key(Recipe(quantise="ptq")) == other.key(Recipe(quantise="ptq"))  # which these do not look at
    stored = (weights / "teacher.pt").read_bytes()
    before = [shop.key(r) for r in (TINY, dataclasses.replace(TINY, distil=True), Recipe())]
    try:
        (weights / "teacher.pt").write_bytes(stored + b"!")
        after = [shop.key(r) for r in (TINY, dataclasses.replace(TINY, distil=True), Recipe())]
    finally:
        (weights / "teacher.pt").write_bytes(stored)
    assert [a == b for a, b in zip(before, after, strict=True)] == [True, False, True]


# ---------------------------------------------------------------- artefacts


def test_the_artefact_is_what_its_metadata_says(shop: Workshop) -> None:
    recipe = dataclasses.replace(TINY, prune_channels=0.5, sparsity=0.6, quantise="ptq")
    onnx_file, metadata, facts = shop.make(recipe)
    content = onnx_file.read_bytes()
    assert json.loads(metadata.read_text(encoding="utf-8")) == json.loads(json.dumps(facts))
    assert facts["sha256"] == hashlib.sha256(content).hexdigest() and facts["size_bytes"] == len(content)
    assert facts["gzip_bytes"] == len(gzip.compress(content, 9, mtime=0))
    assert Recipe.from_dict(facts["recipe"]) == recipe
    assert [s["kind"] for s in facts["steps"]] == ["network", "channels", "sparsity", "export", "ptq"]
    model = onnx.load(str(onnx_file))
    assert model.opset_import[0].version == 17 and model.graph.input[0].type.tensor_type.shape.dim[0].dim_param
    assert predict(onnx_file, tiny.noise(3, 5).images, optimise=False).shape == (3, 4, 64, 64)
    # Zeros stay zeros on the way: pruned in torch, folded, quantised with zero point 0, counted in the file.
    assert facts["zero_weights"] / facts["weights"] == pytest.approx(0.6, abs=0.01)
    assert facts["weights_bytes"] < 1.2 * facts["weights"]


def test_what_is_there_is_not_made_again_and_what_is_damaged_is(shop: Workshop) -> None:
    said: list[str] = []
    shop.say = said.append
    quantised = dataclasses.replace(TINY, quantise="ptq")
    shop.make(TINY)
    artefact = shop.make(quantised)
    assert any("quantising" in words for words in said)
    before, content = {p: p.stat().st_mtime_ns for p in shop.folder.rglob("*.*")}, artefact.onnx.read_bytes()
    said.clear()
    assert shop.make(quantised) == artefact and said == []
    assert {p: p.stat().st_mtime_ns for p in shop.folder.rglob("*.*")} == before

    keys = {step["kind"]: step["key"] for step in artefact.facts["steps"]}
    damaged = shop.folder / "steps" / f"{keys['ptq']}.onnx"
    damaged.write_bytes(damaged.read_bytes()[:-100])
    assert shop.make(quantised).onnx.read_bytes() == content and [w.split(":")[0] for w in said] == ["quantising"]

    said.clear()
    (shop.folder / "steps" / f"{keys['export']}.json").unlink()  # as if the process had died before writing it
    artefact.onnx.write_bytes(b"spoilt")
    assert shop.make(quantised).onnx.read_bytes() == content and [w.split(":")[0] for w in said] == ["exporting"]
    shop.say = lambda _words: None


def test_another_folder_gives_the_same_bytes(shop: Workshop, tmp_path: Path) -> None:
    recipe = dataclasses.replace(TINY, quantise="ptq")
    assert tiny.workshop(tmp_path).make(recipe).onnx.read_bytes() == shop.make(recipe).onnx.read_bytes()


def test_two_four_weights_are_two_four_in_the_file(shop: Workshop, monkeypatch: pytest.MonkeyPatch) -> None:
    held, after_step = [], MaskedPruning.after_step
    monkeypatch.setattr(MaskedPruning, "after_step", lambda self, *rest: held.append(after_step(self, *rest)))
    artefact = shop.make(dataclasses.replace(TINY, sparsity="2:4"))
    assert len(held) == 2  # in each step of the training, and not only at its end
    tensors = {t.name: onnx.numpy_helper.to_array(t) for t in onnx.load(str(artefact.onnx)).graph.initializer}
    weights = [w for w in tensors.values() if w.ndim == 4 and w.shape[1] % 4 == 0]
    assert len(weights) >= 7
    for w in weights:
        groups = np.moveaxis(w, 1, -1).reshape(-1, 4)
        assert (np.count_nonzero(groups, axis=1) == 2).all()


def test_a_distilled_training_is_another_one(shop: Workshop) -> None:
    plain, taught = shop.make(TINY), shop.make(dataclasses.replace(TINY, distil=True))
    assert plain.facts["sha256"] != taught.facts["sha256"]
    assert "teacher" in taught.facts["made_with"] and "teacher" not in plain.facts["made_with"]


def test_the_number_of_threads_is_put_back(shop: Workshop) -> None:
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        shop.make(dataclasses.replace(TINY, seed=5))
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


def test_weight_facts_count_a_weight_once_by_its_precision() -> None:
    make = onnx.helper.make_node
    weight = onnx.numpy_helper.from_array(np.array([[0.0, 1.0], [2.0, 3.0]], np.float32), "w")
    scale = onnx.numpy_helper.from_array(np.array(0.1, np.float32), "s")
    zero = onnx.numpy_helper.from_array(np.array(0, np.int8), "z")
    nodes = [
        make("QuantizeLinear", ["w", "s", "z"], ["q"]),
        make("DequantizeLinear", ["q", "s", "z"], ["d"]),
        make("MatMul", ["x", "d"], ["y"]),
    ]
    value = onnx.helper.make_tensor_value_info
    ends = [value(n, onnx.TensorProto.FLOAT, [1, 2]) for n in "xy"]
    graph = onnx.helper.make_graph(nodes, "g", ends[:1], ends[1:], [weight, scale, zero])
    model = onnx.helper.make_model(graph)
    assert weight_facts(model.SerializeToString()) == {"weights": 4, "zero_weights": 1, "weights_bytes": 4}
    del graph.node[:2]
    graph.node[0].input[1] = "w"
    plain = onnx.helper.make_model(onnx.helper.make_graph(graph.node, "g", ends[:1], ends[1:], [weight]))
    assert weight_facts(plain.SerializeToString())["weights_bytes"] == 16


def test_refusals(weights: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="train scenes"):
        Workshop(tmp_path, tiny.BUDGET, train=tiny.noise(8, 1))
    (tmp_path / "file").write_text("not a folder", encoding="utf-8")
    with pytest.raises(InputError, match="folder"):
        tiny.workshop(tmp_path / "file")
    stored = (weights / "student_plain.pt").read_bytes()
    (weights / "student_plain.pt").unlink()
    try:
        with pytest.raises(RobotBrainError, match="weights of student_plain"):
            tiny.workshop(tmp_path / "shop").make(Recipe(student="student_plain"))
    finally:
        (weights / "student_plain.pt").write_bytes(stored)

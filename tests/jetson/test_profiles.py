"""Profiles are read whole or refused with a reason; the engine runs what it is given or says why not."""

from __future__ import annotations

import dataclasses
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from robotbrain.errors import InputError
from robotbrain.jetson import OnnxEngine, list_profiles, load_profile, profiles
from robotbrain.jetson.catalogue import list_modules, load_cpu_hosts, load_module
from robotbrain.jetson.paths import profile_directory
from robotbrain.jetson.profiles import PROVENANCES
from robotbrain.jetson.resize import at_image_size
from robotbrain.jetson.twin import as_graph, predict
from robotbrain.jetson.work import load_work
from robotbrain.pipeline.brain import default_model


@pytest.fixture
def network_takes_12_ms(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(profiles, "_network_ms", lambda *_: (12.0, "predicted", "kit:a test"))


@pytest.mark.usefixtures("network_takes_12_ms")
def test_every_module_is_a_profile_in_every_mode() -> None:
    slugs = list_profiles()
    assert slugs == list_modules() and {"nano-4gb", "xavier-nx", "orin-nano-8gb", "agx-orin-64gb"} <= set(slugs)
    for slug in slugs:
        module = load_module(slug)
        for mode in (None, *module.modes):
            profile = load_profile(slug, mode)
            chosen = module.mode(mode)
            assert (profile.slug, profile.name, profile.power_mode) == (slug, module.name, chosen.name)
            assert profile.cpu_cores == chosen.cpu_online and profile.dla <= module.dla_count
            assert set(profile.provenance.values()) <= set(PROVENANCES)
            assert set(profile.provenance) == set(profile.source) and all(profile.source.values())
            assert profile.planning_ns(1000) > profile.planning_ns(0) > 0
            assert profile.segmentation_ms == 12.0 and profile.provenance["segmentation"] == "predicted"


def test_cpu_time_goes_with_the_published_benchmark_and_nothing_else() -> None:
    host = load_cpu_hosts()[load_work().host].single_thread.value
    for slug, mode in (("nano-4gb", "5W"), ("xavier-nx", None), ("agx-orin-64gb", "MAXN")):
        profile, score = load_profile(slug, mode), load_module(slug).cpu_score(mode)
        for kind in load_work().kinds.values():
            expected = (kind.fixed_ns + 1000 * kind.unit_ns) * host / score
            assert profile.work_ns(kind.name, 1000) == pytest.approx(expected, abs=1)
    slow, fast = load_profile("nano-4gb:5W"), load_profile("nano-4gb")
    assert all(slow.callback_ms[name] > fast.callback_ms[name] for name in fast.callback_ms)
    ratio = slow.callback_ms["mission"] / fast.callback_ms["mission"]
    assert ratio == pytest.approx(
        load_module("nano-4gb").mode(None).cpu_mhz / load_module("nano-4gb").mode("5W").cpu_mhz, rel=1e-3
    )


def test_a_typical_callback_costs_the_sum_of_its_work() -> None:
    profile = load_profile("nano-4gb")
    for name, callback in load_work().callbacks.items():
        total = sum(
            calls * profile.work_cost(kind)[0] + units * profile.work_cost(kind)[1]
            for kind, (calls, units) in callback.work.items()
        )
        assert profile.callback_ms[name] == pytest.approx(total * 1e-6, abs=1e-6)
    assert {"perception", "estimator_scan", "estimator_wheels", "mapper", "mission", "controller"} <= set(
        profile.callback_ms
    )


def test_a_mode_can_be_named_with_the_module() -> None:
    assert load_profile("nano-4gb:5W") == load_profile("nano-4gb", mode="5w") == load_profile("nano-4gb:5W", "5W")
    assert load_profile("nano-4gb:5W") != load_profile("nano-4gb")
    with pytest.raises(InputError, match="one power mode"):
        load_profile("nano-4gb:5W", mode="MAXN")
    with pytest.raises(InputError, match="5W"):
        load_profile("nano-4gb:6W")


def test_an_unknown_profile_suggests_the_nearest() -> None:
    with pytest.raises(InputError, match="orin-nano-8gb"):
        load_profile("orin-nano")
    with pytest.raises(InputError, match="estimator_scan"):
        load_profile("nano-4gb").callback_ns("scan")
    with pytest.raises(InputError, match="astar"):
        load_profile("nano-4gb").work_ns("a-star", 1)


def test_a_network_is_asked_for_once_and_by_its_own_file(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[object, ...]] = []

    def answer(*question: object) -> tuple[float, str, str]:
        asked.append(question)
        return float(len(asked)), "predicted", "kit:a test"

    monkeypatch.setattr(profiles, "_network_ms", answer)
    profile = load_profile("nano-4gb:5W")
    assert asked == []  # nothing is predicted before it is needed
    assert [profile.segmentation_ms, profile.segmentation_ms] == [1.0, 1.0]
    assert profile.network_ms("other.onnx") == 2.0 and profile.network_ms("other.onnx", "int8") == 3.0
    assert asked[0] == (default_model(), "nano-4gb", "5W", "fp16", None) and len(asked) == 3
    assert profile.network_ms("other.onnx", image_size=(640, 480)) == 4.0
    assert asked[-1][-1] == (640, 480)
    assert dataclasses.replace(profile, network_factor=10.0).network_ms("third.onnx") == 50.0


def test_network_times_are_the_twins() -> None:
    for slug, mode in (("agx-orin-64gb", "MAXN"), ("nano-4gb", "5W")):
        profile = load_profile(slug, mode)
        for precision in ("fp16", "fp32"):
            predicted = predict(default_model(), slug, mode=mode, precision=precision)
            assert profile.network_ms(default_model(), precision) == predicted.latency_ms
        assert profile.segmentation_ms == profile.network_ms(default_model(), "fp16")
        assert OnnxEngine(default_model(), profile).latency_ns == round(profile.segmentation_ms * 1e6)
    assert load_profile("nano-4gb:5W").segmentation_ms > load_profile("nano-4gb").segmentation_ms


def test_a_larger_image_is_as_much_work_as_so_many_small_ones() -> None:
    graph = as_graph(at_image_size(default_model(), (640, 480)))
    small = as_graph(default_model())
    assert graph.macs == 75 * small.macs and graph.weight_elems == small.weight_elems
    assert list(graph.inputs.values()) == [(1, 3, 480, 640)]
    profile = load_profile("nano-4gb")
    expected = predict(default_model(), "nano-4gb", batch=75).latency_ms
    assert profile.network_ms(default_model(), image_size=(640, 480)) == pytest.approx(expected, rel=1e-6)
    engine = OnnxEngine(default_model(), profile, (640, 480))
    assert engine.latency_ns == round(expected * 1e6) and engine.input_shape[2:] == (64, 64)


@pytest.mark.parametrize("size", [(640,), (0, 480), (640.0, 480), "VGA", (True, 480)])
def test_impossible_image_sizes_are_refused(size: Any) -> None:
    with pytest.raises(InputError, match="image size"):
        at_image_size(default_model(), size)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("unit_ns = 5", "unit_ns = -5", "unit_ns"),
        ("unit_ns = 5", 'unit_ns = "fast"', "unit_ns"),
        ("fixed_ns = 100\n", "", "fixed_ns"),
        ('"measured"', '"heard"', "provenance"),
        ('"kit:a desk"', '""', "source"),
        ("astar = [1, 2000]", "astar = 3", "calls, units"),
        ("astar = [1, 2000]", "a_star = [1, 2000]", "astar"),
        ('kind = "service"', 'kind = "visit"', "subscription"),
        ("[host]", "[host", "TOML"),
        ('key = "intel-n100"', 'key = "my-laptop"', "cpu_hosts"),
    ],
)
def test_a_damaged_work_table_is_refused_with_its_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, old: str, new: str, words: str
) -> None:
    shutil.copytree(profile_directory() / "modules", tmp_path / "modules")
    monkeypatch.setenv("ROBOTBRAIN_PROFILES", str(tmp_path))
    path = tmp_path / "work.toml"
    path.write_text(WORK)
    profile = load_profile("nano-4gb")
    assert profile.work_ns("astar", 20) == round(200 * profile.cpu_factor)
    assert profile.planning_ns(0) == pytest.approx(100 * profile.cpu_factor, abs=1)
    assert old in WORK
    path.write_text(WORK.replace(old, new) + "# changed\n")
    with pytest.raises(InputError, match=words):
        load_profile("nano-4gb")


WORK = """[host]
key = "intel-n100"
cpu = "Intel N100"
date = "2026-01-01"
command = "by hand"
software = "Python"
provenance = "measured"
source = "kit:a desk"
[kinds.astar]
unit = "cell"
what = "A*"
fixed_ns = 100
unit_ns = 5
error = 0.1
calls = 10
[callbacks.planner]
role = "planner"
kind = "service"
topic = "/plan"
[callbacks.planner.work]
astar = [1, 2000]
"""


def test_no_profiles_at_all_is_explained(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROBOTBRAIN_PROFILES", str(tmp_path / "nowhere"))
    with pytest.raises(InputError, match="ROBOTBRAIN_PROFILES"):
        list_profiles()


def test_weights_beside_the_model_are_found(tmp_path: Path) -> None:
    import onnx

    model = onnx.load(default_model())
    path = tmp_path / "outside.onnx"
    onnx.save_model(model, path, save_as_external_data=True, location="outside.onnx.data", size_threshold=0)
    x = np.ones((1, 3, 64, 64), np.float32)
    np.testing.assert_array_equal(OnnxEngine(path).infer(x), OnnxEngine(default_model()).infer(x))
    (tmp_path / "outside.onnx.data").unlink()
    with pytest.raises(InputError, match="ONNX"):
        OnnxEngine(path)


@pytest.mark.usefixtures("network_takes_12_ms")
def test_the_engine_agrees_with_the_onnx_reference_evaluator() -> None:
    import onnx
    from onnx.reference import ReferenceEvaluator

    rng = np.random.default_rng(0)
    x = rng.normal(size=(1, 3, 64, 64)).astype(np.float32)
    engine = OnnxEngine(default_model(), load_profile("nano-4gb"))
    reference = ReferenceEvaluator(onnx.load(default_model())).run(None, {"image": x})[0]
    np.testing.assert_allclose(engine.infer(x), reference, atol=1e-3)
    assert engine.latency_ns == 12_000_000 and engine.resource == "gpu"
    assert OnnxEngine(default_model()).latency_ns == 0


@pytest.mark.parametrize(
    "bad",
    [
        np.zeros((1, 3, 64, 64)),
        np.zeros((3, 64, 64), np.float32),
        np.zeros((1, 64, 64, 3), np.float32),
        np.full((1, 3, 64, 64), np.nan, np.float32),
    ],
)
def test_the_engine_refuses_other_inputs(bad: np.ndarray) -> None:
    with pytest.raises(InputError, match="network input"):
        OnnxEngine(default_model()).infer(bad)


def test_a_missing_or_broken_model_is_explained(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="robotbrain train"):
        OnnxEngine(tmp_path / "no.onnx")
    (tmp_path / "bad.onnx").write_bytes(default_model().read_bytes()[:500])
    with pytest.raises(InputError, match="ONNX"):
        OnnxEngine(tmp_path / "bad.onnx")

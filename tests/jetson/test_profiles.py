"""Profiles are read whole or refused with a reason; the engine runs what it is given or says why not."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest

from robotbrain.errors import InputError
from robotbrain.jetson import OnnxEngine, list_profiles, load_profile
from robotbrain.jetson.profiles import PROVENANCES
from robotbrain.pipeline.brain import default_model


def test_every_profile_loads_and_labels_its_numbers() -> None:
    slugs = list_profiles()
    assert {"nano-4gb", "xavier-nx", "orin-nano-8gb", "agx-orin-64gb"} <= set(slugs)
    for slug in slugs:
        profile = load_profile(slug)
        assert set(profile.provenance.values()) <= set(PROVENANCES)
        assert all(profile.source.values())
        assert profile.planning_ns(1000) > profile.planning_ns(0) > 0


def test_slower_modules_are_slower_in_everything() -> None:
    order = [load_profile(s) for s in ("agx-orin-64gb", "orin-nano-8gb", "xavier-nx", "nano-4gb")]
    for fast, slow in itertools.pairwise(order):
        assert fast.segmentation_ms < slow.segmentation_ms
        assert all(fast.callback_ms[k] < slow.callback_ms[k] for k in fast.callback_ms)
        assert fast.planning_ns(0) < slow.planning_ns(0) and fast.planning_ns(5000) < slow.planning_ns(5000)


def test_an_unknown_profile_suggests_the_nearest() -> None:
    with pytest.raises(InputError, match="orin-nano-8gb"):
        load_profile("orin-nano")


GOOD = """slug = "mine"
name = "Mine"
power_mode = "10W"
[segmentation]
value_ms = 1.0
provenance = "measured"
source = "my desk"
[callbacks]
provenance = "assumed"
source = "a guess"
perception_ms = 1
estimator_scan_ms = 1
estimator_wheels_ms = 1
mapper_ms = 1
mission_ms = 1
controller_ms = 1
[planner]
provenance = "assumed"
source = "a guess"
fixed_ms = 2
per_1000_cells_ms = 3
"""


SEGMENTATION = GOOD[GOOD.index("[segmentation]") : GOOD.index("[callbacks]")].strip()


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("value_ms = 1.0", "value_ms = -1.0", "segmentation"),
        ("value_ms = 1.0", "value_ms = nan", "segmentation"),
        ("value_ms = 1.0", 'value_ms = "fast"', "segmentation"),
        ("mapper_ms = 1\n", "", "mapper_ms"),
        ('"measured"', '"heard"', "provenance"),
        ('"my desk"', '""', "source"),
        ('slug = "mine"', 'slug = "yours"', "slug"),
        (
            '[segmentation]\nvalue_ms = 1.0\nprovenance = "measured"\nsource = "my desk"',
            "segmentation = 3",
            "segmentation",
        ),
        ("[planner]", "[planner", "TOML"),
    ],
)
def test_a_damaged_profile_is_refused_with_its_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, old: str, new: str, words: str
) -> None:
    monkeypatch.setenv("ROBOTBRAIN_PROFILES", str(tmp_path))
    path = tmp_path / "mine.toml"
    path.write_text(GOOD)
    assert load_profile("mine").planning_ns(2000) == 8_000_000
    assert old in GOOD
    path.write_text(GOOD.replace(old, new))
    with pytest.raises(InputError, match=words):
        load_profile("mine")


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


def test_the_engine_agrees_with_the_onnx_reference_evaluator() -> None:
    import onnx
    from onnx.reference import ReferenceEvaluator

    rng = np.random.default_rng(0)
    x = rng.normal(size=(1, 3, 64, 64)).astype(np.float32)
    engine = OnnxEngine(default_model(), load_profile("nano-4gb"))
    reference = ReferenceEvaluator(onnx.load(default_model())).run(None, {"image": x})[0]
    np.testing.assert_allclose(engine.infer(x), reference, atol=1e-3)
    assert engine.latency_ns == 12_000_000
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

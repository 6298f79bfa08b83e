"""The twin's front door: every module, mode, precision and harness; warnings; measured profiles; forms of a network."""

from __future__ import annotations

import json
import math
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest

from robotbrain.errors import InputError
from robotbrain.jetson.catalogue import list_modules, load_module
from robotbrain.jetson.kernels import Kernel, KernelGraph
from robotbrain.jetson.measured import MeasuredProfile, Power, Timing
from robotbrain.jetson.twin import HARNESSES, PRECISIONS, Prediction, as_graph, compare, predict
from robotbrain.jetson.twin.data import fastest_mode, load_kernel_lists
from robotbrain.jetson.twin.power import SUPPLY_EFFICIENCY

REPO = Path(__file__).resolve().parents[2]
GRAPHS = REPO / "tests" / "data" / "graphs"
LISTS = load_kernel_lists()
RESNET, MOBILENET = LISTS["resnet50"], LISTS["mobilenet_v1_1p0_224"]


# -- everywhere


@pytest.mark.parametrize("slug", list_modules())
def test_every_mode_precision_and_harness_gives_a_sound_prediction(slug: str) -> None:
    module = load_module(slug)
    for mode in module.modes:
        for precision in PRECISIONS:
            for harness in HARNESSES:
                p = predict(MOBILENET, slug, mode=mode, precision=precision, harness=harness)
                assert 0 < p.latency_low_ms < p.latency_ms < p.latency_high_ms < 10_000
                # An interval on a logarithmic scale: as far down as up, in ratio.
                assert p.latency_ms**2 == pytest.approx(p.latency_low_ms * p.latency_high_ms)
                assert p.latency_ms == pytest.approx(p.fixed_ms + sum(k.total_ms for k in p.kernels))
                assert 0 < p.power_w < p.wall_power_w < 250
                assert p.energy_mj == pytest.approx(p.power_w * p.latency_ms)
                assert p.memory_mb > 0 and p.fits
                assert 20 < p.temperature_c < 120
                assert p.provenance == "predicted"
                assert p.baseline_ms < p.latency_ms
                assert (p.device, p.mode, p.precision, p.harness) == (slug, mode, precision, harness)


@pytest.mark.parametrize("slug", list_modules())
def test_fewer_bits_are_not_slower_for_networks_that_compute(slug: str) -> None:
    for harness in HARNESSES:
        fp32, fp16, int8 = (predict(RESNET, slug, precision=p, harness=harness).latency_ms for p in PRECISIONS)
        assert int8 <= fp16 < fp32, harness


@pytest.mark.parametrize("name", sorted(LISTS))
def test_where_bits_do_not_help_they_hardly_hurt(name: str) -> None:
    """Launch-bound networks may come out a little slower in fewer bits, as published rows do."""
    for slug, harness in (("tx2", "tf_to_trt"), ("agx-orin-64gb", "ultralytics")):
        fp32, fp16, int8 = (predict(LISTS[name], slug, precision=p, harness=harness).latency_ms for p in PRECISIONS)
        assert int8 < 1.1 * fp16 < 1.21 * fp32


@pytest.mark.parametrize("slug", list_modules())
def test_the_fastest_mode_is_the_fastest(slug: str) -> None:
    module = load_module(slug)
    for network in (RESNET, MOBILENET):
        best = predict(network, slug, mode=fastest_mode(module)).latency_ms
        for mode in module.modes:
            assert best <= predict(network, slug, mode=mode).latency_ms * (1 + 1e-9)


def test_generations_are_ordered_at_their_best() -> None:
    order = ["nano-4gb", "tx2", "xavier-nx", "agx-xavier-32gb", "orin-nx-16gb", "agx-orin-64gb"]
    for network in (RESNET, MOBILENET, LISTS["yolov8m"]):
        times = [predict(network, slug, mode="MAXN").latency_ms for slug in order]
        assert times == sorted(times, reverse=True)


def test_the_same_question_has_the_same_answer() -> None:
    first, second = (predict(RESNET, "orin-nano-8gb", precision="int8") for _ in range(2))
    assert first == second
    assert json.dumps(first.to_dict()) == json.dumps(second.to_dict())


def test_names_are_read_as_people_write_them() -> None:
    exact = predict(RESNET, "orin-nano-8gb", mode="15W", precision="fp16", harness="trtexec")
    loose = predict(RESNET, "Orin-Nano-8GB".lower(), mode="mode_15w", precision="FP16", harness="TRTexec")
    assert loose.to_dict() == exact.to_dict()
    assert predict(RESNET, load_module("orin-nano-8gb")).mode == load_module("orin-nano-8gb").default_mode.name


@pytest.mark.parametrize("batch", [1, 2, 16])
def test_a_batch_is_one_inference_of_several_inputs(batch: int) -> None:
    one, many = predict(RESNET, "agx-orin-64gb"), predict(RESNET, "agx-orin-64gb", batch=batch)
    assert many.macs == batch * one.macs
    assert one.latency_ms <= many.latency_ms <= batch * one.latency_ms
    assert many.throughput == pytest.approx(1e3 * batch / many.latency_ms)
    assert many.throughput >= one.throughput
    assert many.memory_mb >= one.memory_mb


# -- what is refused


@pytest.mark.parametrize(
    "bad",
    [
        {"device": "nano"},
        {"device": ""},
        {"mode": "99W"},
        {"precision": "fp8"},
        {"harness": "stopwatch"},
        {"batch": 0},
        {"batch": 1.5},
        {"batch": True},
        {"model": []},
        {"model": None},
        {"model": "no-such-file.onnx"},
        {"model": b"not onnx"},
        {"model": KernelGraph("empty", ())},
        {"model": [{"op": "conv"}]},
        {"mode": load_module("tx2").default_mode},
    ],
)
def test_what_cannot_be_used_is_refused(bad: dict[str, Any]) -> None:
    given = {"model": RESNET, "device": "nano-4gb", **bad}
    with pytest.raises(InputError):
        predict(given.pop("model"), given.pop("device"), **given)


@pytest.mark.parametrize("bindings", [{"x": [1]}, {1: 2, "a": 3}, [("a", 1)], "x", {"nope": 3}, {"input:0": 0}])
def test_bindings_that_are_none_are_refused(bindings: Any) -> None:
    with pytest.raises(InputError):
        as_graph(GRAPHS / "resnet50.onnx", bindings)


# -- forms of a network


def plain(graph: KernelGraph) -> list[dict[str, Any]]:
    return [
        {"op": k.op, "macs": k.macs, "in_elems": k.in_elems, "out_elems": k.out_elems, "weight_elems": k.weight_elems}
        for k in graph.kernels
    ]


def test_a_list_and_its_graph_agree() -> None:
    whole, listed = predict(RESNET, "xavier-nx"), predict(plain(RESNET), "xavier-nx")
    assert listed.latency_ms == whole.latency_ms and listed.memory_mb == whole.memory_mb


@pytest.mark.parametrize(
    "name", ["resnet50", "alexnet", "densenet121", "vgg11", "squeezenet1_0", "efficientvit_b1_224"]
)
def test_a_file_and_the_kernel_list_made_elsewhere_agree(name: str) -> None:
    path = GRAPHS / f"{name}.onnx"
    from_path = predict(path, "orin-nano-8gb")
    assert from_path.latency_ms == predict(str(path), "orin-nano-8gb").latency_ms
    assert from_path.latency_ms == predict(path.read_bytes(), "orin-nano-8gb").latency_ms
    assert from_path.latency_ms == pytest.approx(predict(LISTS[name], "orin-nano-8gb").latency_ms, rel=0.03)
    assert from_path.graph.sha256


# -- for reading


FIELDS = {
    *("latency_ms", "latency_low_ms", "latency_high_ms", "memory_mb", "power_w", "wall_power_w", "energy_mj"),
    *("provenance", "warnings"),
}


@pytest.mark.parametrize("slug", list_modules())
def test_the_dictionary_is_json_with_the_promised_fields(slug: str) -> None:
    p = predict(RESNET, slug)
    data = json.loads(json.dumps(p.to_dict(), allow_nan=False))
    assert data.keys() >= FIELDS
    assert data["latency_low_ms"] < data["latency_ms"] < data["latency_high_ms"]
    for key in FIELDS - {"provenance", "warnings"}:
        assert data[key] == pytest.approx(getattr(p, key), rel=0.01)
    assert isinstance(data["warnings"], list)


def test_text_and_html_show_the_verdicts_and_escape_names() -> None:
    p = predict(KernelGraph("<b>", RESNET.kernels), "nano-4gb")
    assert "<b>" not in p._repr_html_() and "&lt;b&gt;" in p._repr_html_()
    assert "ms" in str(p) and "Jetson Nano" in str(p)
    assert all(value for _, value in p.rows())


def test_what_binds_a_kernel_is_its_largest_part() -> None:
    bounds = {k.bound for k in predict(LISTS["vgg16"], "nano-4gb").kernels}
    assert {"compute", "memory"} <= bounds
    assert all(k.bound == "launch" for k in predict([tiny()], "t5000").kernels)


def tiny() -> dict[str, Any]:
    return {"op": "pw", "macs": 0, "in_elems": 4, "out_elems": 4, "weight_elems": 0}


def test_a_network_of_one_kernel_takes_overheads_only() -> None:
    p = predict([tiny()], "orin-nano-8gb")
    assert p.latency_ms == pytest.approx(p.fixed_ms + p.kernels[0].launch_ms, rel=1e-3)
    assert p.macs == 0 and p.baseline_ms == 0.0
    # Nothing published says what such a network takes: the interval must say so.
    assert p.latency_high_ms > 2 * p.latency_ms


# -- compare


def test_compare_is_predict_on_each() -> None:
    found = compare(RESNET)
    assert [p.device for p in found] == list_modules()
    assert [p.latency_ms for p in found] == [predict(RESNET, slug).latency_ms for slug in list_modules()]
    every = compare(RESNET, ["nano-4gb", "tx2"], modes="all")
    assert [(p.device, p.mode) for p in every] == [(s, m) for s in ("nano-4gb", "tx2") for m in load_module(s).modes]
    fast = compare(RESNET, ["xavier-nx"], modes="fastest", precision="int8", harness="mlperf", batch=2)
    assert (
        fast[0].to_dict()
        == predict(RESNET, "xavier-nx", mode="MAXN", precision="int8", harness="mlperf", batch=2).to_dict()
    )
    assert compare(RESNET, []) == []


@pytest.mark.parametrize("bad", [{"modes": "slowest"}, {"devices": ["nano"]}, {"precision": "fp8"}])
def test_compare_refuses_what_predict_does(bad: dict[str, Any]) -> None:
    with pytest.raises(InputError):
        compare(RESNET, **bad)


# -- warnings


def warned(p: Prediction, *words: str) -> bool:
    return any(all(word in text for word in words) for text in p.warnings)


def test_a_condition_with_rows_carries_no_caveat() -> None:
    assert predict(RESNET, "nano-4gb", harness="torch2trt").warnings == ()
    assert warned(predict(RESNET, "nano-4gb", harness="trtexec"), "no calibration row", "trtexec")
    assert warned(predict(RESNET, "nano-4gb", harness="torch2trt", precision="fp32"), "no calibration row", "fp32")


def test_intervals_are_wider_where_nothing_was_measured() -> None:
    def width(slug: str, harness: str, precision: str = "fp16") -> float:
        p = predict(RESNET, slug, harness=harness, precision=precision)
        return p.latency_high_ms / p.latency_ms

    assert width("nano-4gb", "torch2trt") < width("nano-4gb", "torch2trt", "fp32")
    assert width("nano-4gb", "torch2trt") < width("nano-4gb", "trtexec")
    assert width("agx-orin-64gb", "ultralytics") < width("t5000", "ultralytics")


def test_a_family_without_rows_is_called_a_guess() -> None:
    assert warned(predict(RESNET, "t5000"), "blackwell", "guess")
    assert not warned(predict(RESNET, "agx-orin-64gb"), "guess")


def test_int8_without_hardware_for_it_is_fp16_and_says_so() -> None:
    int8, fp16 = predict(RESNET, "tx2", precision="int8"), predict(RESNET, "tx2", precision="fp16")
    assert (int8.latency_ms, int8.memory_mb, int8.power_w) == (fp16.latency_ms, fp16.memory_mb, fp16.power_w)
    assert warned(int8, "no fast INT8") and not warned(fp16, "INT8")
    assert int8.precision == "int8"


def test_a_quantised_model_says_what_runs_in_what() -> None:
    kernels = (Kernel("conv", 10**8, 10**5, 10**5, 10**5, precision="int8"), Kernel("pw", 0, 10**5, 10**5, 0))
    p = predict(KernelGraph("q", kernels), "orin-nano-8gb", precision="int8")
    assert [k.precision for k in p.kernels] == ["int8", "fp16"]
    assert warned(p, "Q/DQ")
    assert [k.precision for k in predict(KernelGraph("q", kernels), "nano-4gb", precision="int8").kernels] == [
        "fp16"
    ] * 2


def test_out_of_memory_is_said_in_words_and_numbers() -> None:
    heavy = KernelGraph(
        "language model", (Kernel("mm", 7 * 10**9, 4096, 4096, 7 * 10**9),), 7 * 10**9, 28 * 10**9, 10**6
    )
    p = predict(heavy, "nano-4gb")
    assert not p.fits and p.memory_mb > 14_000
    assert warned(p, "out of memory", "MB")
    assert "OUT OF MEMORY" in str(p) and p.to_dict()["fits"] is False
    assert predict(heavy, "agx-orin-64gb").fits


def test_an_engine_that_runs_but_cannot_be_built_says_so() -> None:
    big = KernelGraph("big", (Kernel("mm", 10**9, 4096, 4096, 10**9),), 10**9, 4 * 10**9, 10**6)
    p = predict(big, "nano-4gb")
    assert p.fits and warned(p, "building the engine")


def test_transformers_are_known_to_be_unsure() -> None:
    assert warned(predict(LISTS["bert_large_384"], "agx-orin-64gb"), "matrix products")
    assert not warned(predict(RESNET, "agx-orin-64gb"), "matrix products")


def test_an_opset_that_the_module_cannot_parse_is_a_warning() -> None:
    graph = KernelGraph("new", RESNET.kernels, opset=20)
    assert warned(predict(graph, "nano-4gb"), "opset")
    assert not warned(predict(graph, "agx-orin-64gb"), "opset")


def test_what_the_analyser_assumed_is_passed_on_once() -> None:
    graph = KernelGraph("w", RESNET.kernels, warnings=("batch taken as 1", "batch taken as 1"))
    assert predict(graph, "tx2").warnings.count("batch taken as 1") == 1


# -- measured profiles


@pytest.fixture
def board(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("ROBOTBRAIN_MEASURED", str(tmp_path))
    return tmp_path


def a_measurement(sha256: str, **changes: Any) -> MeasuredProfile:
    values: dict[str, Any] = {
        "module": "orin-nano-8gb",
        "mode": "15W",
        "model": "resnet50",
        "sha256": sha256,
        "precision": "fp16",
        "latency": Timing(median=4.321, mean=4.4, min=4.2, max=5.0),
        "source": "trtexec on a desk",
        "date": datetime(2026, 1, 2, tzinfo=UTC),
    }
    return MeasuredProfile(**{**values, **changes})


def test_a_measurement_takes_precedence_for_exactly_its_conditions(board: Path) -> None:
    path = GRAPHS / "resnet50.onnx"
    before = predict(path, "orin-nano-8gb", mode="15W")
    a_measurement(before.graph.sha256).write(board)
    after = predict(path, "orin-nano-8gb", mode="15w")
    assert after.provenance == "measured" and after.sources == ("trtexec on a desk",)
    assert after.latency_ms == after.latency_low_ms == after.latency_high_ms == 4.321
    assert not warned(after, "no calibration row")
    # What was not measured is as predicted.
    assert (after.power_w, after.memory_mb) == (before.power_w, before.memory_mb)
    for other in (
        predict(path, "orin-nano-8gb", mode="7W"),
        predict(path, "orin-nano-8gb", mode="15W", precision="int8"),
        predict(path, "orin-nano-8gb", mode="15W", harness="torch2trt"),
        predict(path, "orin-nano-8gb", mode="15W", batch=2),
        predict(path, "orin-nano-8gb-super", mode="15W"),
        predict(RESNET, "orin-nano-8gb", mode="15W"),
        predict(GRAPHS / "alexnet.onnx", "orin-nano-8gb", mode="15W"),
    ):
        assert other.provenance == "predicted"


def test_measured_power_and_memory_replace_predicted_ones(board: Path) -> None:
    path = GRAPHS / "resnet50.onnx"
    before = predict(path, "orin-nano-8gb")
    power = Power(mean=20.0, peak=25.0, samples=100, rails=("VDD_IN",), sampler="tegrastats")
    a_measurement(before.graph.sha256, power=power, memory_mb=100.0).write(board)
    after = predict(path, "orin-nano-8gb")
    assert after.power_w == 20.0
    assert after.energy_mj == pytest.approx(20.0 * 4.321)
    # At the wall it is that, the carrier board and the supply's loss: never less than the module draws.
    module = load_module("orin-nano-8gb")
    assert after.wall_power_w == pytest.approx((20.0 + module.carrier_power_w) / SUPPLY_EFFICIENCY)
    assert after.memory_mb == pytest.approx(100 * 2**20 / 1e6 + before.memory.context_mb)
    assert after.temperature_c > before.temperature_c
    assert warned(after, "budget")


def test_a_damaged_measurement_is_not_passed_over(board: Path) -> None:
    folder = board / "orin-nano-8gb"
    folder.mkdir()
    (folder / "broken.toml").write_text("format = ", encoding="utf-8")
    with pytest.raises(InputError, match=r"broken\.toml"):
        predict(GRAPHS / "resnet50.onnx", "orin-nano-8gb")
    # A network that came from no file has no checksum, so nothing is looked for.
    assert math.isfinite(predict(RESNET, "orin-nano-8gb").latency_ms)

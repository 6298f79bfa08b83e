"""``robotbrain jetson``: what it prints, what it promises in JSON, and what it says when it cannot."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from twin_builders import quick_run

from robotbrain import cli
from robotbrain.jetson import calibrate_command
from robotbrain.jetson.catalogue import list_modules, load_module
from robotbrain.jetson.commands import SUBCOMMANDS
from robotbrain.jetson.software import load_headlines, load_jetpacks
from robotbrain.jetson.twin import predict
from robotbrain.jetson.twin.calibrate import CalibrationRun, to_json
from robotbrain.jetson.twin.data import load_kernel_lists

REPO = Path(__file__).resolve().parents[2]
RESNET = REPO / "tests" / "data" / "graphs" / "resnet18.onnx"
PROMISED = {
    "latency_ms": float, "latency_low_ms": float, "latency_high_ms": float, "memory_mb": float, "power_w": float,
    "wall_power_w": float, "energy_mj": float, "provenance": str, "warnings": list,
}  # fmt: skip


class Out:
    """Runs the command line in this process."""

    def __init__(self, capsys: pytest.CaptureFixture[str]) -> None:
        self.capsys = capsys
        self.text = self.error = ""

    def __call__(self, *words: object, code: int = 0) -> str:
        self.capsys.readouterr()
        try:
            returned = cli.main(["jetson", *map(str, words)])
        except SystemExit as left:  # argparse leaves this way
            returned = int(left.code or 0)
        self.text, self.error = self.capsys.readouterr()
        assert returned == code, self.error
        assert "Traceback" not in self.error
        return self.text

    def json(self, *words: object) -> dict[str, Any]:
        found: dict[str, Any] = json.loads(self(*words, "--json"))
        return found


@pytest.fixture
def jetson(capsys: pytest.CaptureFixture[str]) -> Out:
    return Out(capsys)


# ---- the table of subcommands ----


@pytest.mark.parametrize("name", SUBCOMMANDS)
def test_every_subcommand_explains_itself(jetson: Out, name: str) -> None:
    text = jetson(name, "--help")
    assert f"robotbrain jetson {name}" in text
    assert SUBCOMMANDS[name].help in text


@pytest.mark.parametrize("words", [["--help"], ["jetson", "--help"], ["jetson", "predict", "--help"]])
def test_help_loads_no_heavy_library(words: list[str]) -> None:
    code = (
        f"import sys, contextlib\nfrom robotbrain import cli\nwith contextlib.suppress(SystemExit): cli.main({words})\n"
        "loaded = set(sys.modules)\n"
        "assert not {'onnx', 'scipy', 'onnxruntime', 'torch', 'matplotlib', 'tqdm'} & loaded\n"
        "assert 'robotbrain.jetson.twin' not in loaded\n"
        "assert not {'robotbrain.jetson.catalogue_command', 'robotbrain.jetson.calibrate_command'} & loaded"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert "jetson" in done.stdout


def test_without_or_with_an_unknown_subcommand_it_says_what_there_is(jetson: Out) -> None:
    jetson(code=2)
    jetson("flash", code=2)
    assert "predict" in jetson.error and "compare" in jetson.error


# ---- the catalogue ----


def test_list_names_every_module(jetson: Out) -> None:
    lines = jetson("list").splitlines()
    for slug in list_modules():
        (line,) = [line for line in lines if line.split()[:1] == [slug]]
        module = load_module(slug)
        assert module.headline in line and module.default_mode.name in line
    data = jetson.json("list")["modules"]
    assert [module["slug"] for module in data] == list_modules()
    assert len(data) == 16


@pytest.mark.parametrize("slug", ["nano-4gb", "T5000", "Xavier-NX"])
def test_show_has_every_number_with_its_origin(jetson: Out, slug: str) -> None:
    module = load_module(slug)
    text = jetson("show", slug)
    lines = text.splitlines()
    tail = lines[lines.index("Sources") :]
    listed = " ".join(line.strip() for line in tail)
    for key, figure in module.figures.items():
        (line,) = [line for line in lines if line.split()[:1] == [key]]
        assert f"{figure.value:g}" in line and figure.unit in line and figure.provenance in line
        number = line[line.index("[") : line.index("]") + 1]
        after = listed.partition(f"{number} ")[2]
        assert after.startswith(figure.source), (key, number)
    for mode in module.modes.values():
        assert any(mode.name in line and mode.provenance in line for line in lines)
        assert all(alias in text for alias in mode.aliases)
    assert all(any(line.startswith(f"{version} ") for line in lines) for version in module.jetpacks)


def test_show_as_json(jetson: Out) -> None:
    module = load_module("orin-nano-8gb")
    data = jetson.json("show", "ORIN-NANO-8GB")
    assert data["figures"]["gpu.max_mhz"] == {
        "value": 625, "unit": "MHz", "provenance": "datasheet", "source": module.figures["gpu.max_mhz"].source,
        "note": "",
    }  # fmt: skip
    assert set(data["figures"]) == set(module.figures)
    assert [mode["name"] for mode in data["modes"]] == list(module.modes)
    assert [release["version"] for release in data["jetpacks"]] == list(module.jetpacks)


def test_show_puts_the_outlines_headline_beside_the_data_sheets(jetson: Out) -> None:
    for headline in load_headlines():
        text = " ".join(jetson("show", headline.module.slug).split())
        assert headline.outline.text in text and headline.datasheet.text in text and headline.why in text
    assert "outline" not in jetson("show", "tx2")


def test_jetpack_table(jetson: Out) -> None:
    text = jetson("jetpack")
    for release in load_jetpacks():
        (line,) = [line for line in text.splitlines() if line.startswith(f"{release.version} ") and "." in line[9:14]]
        assert release.tensorrt.text in line and f"{release.onnx_opset.value:g}" in line
    assert len(jetson.json("jetpack")["jetpacks"]) == len(load_jetpacks())


def test_jetpack_says_who_parses_an_opset(jetson: Out) -> None:
    verdicts = jetson.json("jetpack", "--opset", 17)["modules"]
    assert verdicts["nano-4gb"]["ok"] is False and verdicts["xavier-nx"]["ok"] is True
    text = jetson("jetpack", "--opset", 17)
    (nano,) = [line for line in text.splitlines() if line.startswith("nano-4gb")]
    assert "NO" in nano.split() and "opset_version=13" in text
    jetson("jetpack", "--opset", 0, code=2)


# ---- predict ----


def test_predict_as_json_is_one_object_with_what_is_promised(jetson: Out) -> None:
    data = jetson.json("predict", RESNET, "--device", "orin-nano-8gb")
    for name, kind in PROMISED.items():
        assert isinstance(data[name], kind), name
    assert 0 < data["latency_low_ms"] < data["latency_ms"] < data["latency_high_ms"]
    assert 0 < data["power_w"] < data["wall_power_w"]
    assert data["energy_mj"] == pytest.approx(data["power_w"] * data["latency_ms"], rel=0.01)
    assert data["provenance"] == "predicted"
    assert all(isinstance(warning, str) for warning in data["warnings"])
    assert jetson.error == ""


def test_the_command_and_the_python_api_agree(jetson: Out) -> None:
    words = ["predict", RESNET, "--device", "agx-orin-64gb", "--mode", "maxn", "--precision", "int8", "--batch", 4]
    data = jetson.json(*words, "--harness", "mlperf")
    same = predict(RESNET, "agx-orin-64gb", mode="MAXN", precision="int8", harness="mlperf", batch=4)
    assert data == same.to_dict()


@pytest.mark.parametrize(
    ("device", "mode", "precision", "harness"),
    [("XAVIER-NX", "mode_15w_6core", "FP16", "TRTEXEC"), ("Xavier-Nx", "15W 6Core", "Fp16", "trtExec")],
)
def test_upper_and_lower_case_are_alike(jetson: Out, device: str, mode: str, precision: str, harness: str) -> None:
    words = ["--mode", mode, "--precision", precision, "--harness", harness]
    found = jetson.json("predict", RESNET, "--device", device, *words)
    same = ["--mode", "MODE_15W_6CORE", "--precision", "fp16", "--harness", "trtexec"]
    assert found == jetson.json("predict", RESNET, "--device", "xavier-nx", *same)


@pytest.mark.parametrize(
    ("device", "alias", "mode"),
    [("orin-nano-8gb", "maxn", "15W"), ("agx-orin-64gb", "50w", "MODE_50W"), ("nano-4gb", "1", "5W"),
     ("nano-4gb", None, "MAXN")],
)  # fmt: skip
def test_aliases_of_modes(jetson: Out, device: str, alias: str | None, mode: str) -> None:
    words = [] if alias is None else ["--mode", alias]
    assert jetson.json("predict", RESNET, "--device", device, *words)["mode"] == mode


@pytest.mark.parametrize(
    ("words", "helpful"),
    [
        (["--device", "orin-nano"], "orin-nano-8gb"),
        (["--device", "nano-4gb", "--mode", "20W"], "MAXN (0), 5W (1)"),
        (["--device", "nano-4gb", "--precision", "fp8"], "fp32, fp16, int8"),
        (["--device", "nano-4gb", "--harness", "trtexe"], "Did you mean 'trtexec'?"),
        (["--device", "nano-4gb", "--batch", "0"], "1 or more"),
        (["--device", "nano-4gb", "--bind", "batch"], "AXIS=N"),
        (["--device", "nano-4gb", "--bind", "batch=0"], "AXIS=N"),
        (["--device", "nano-4gb", "--kernels", "0"], "1 or more"),
        (["--device", "nano-4gb", "--plot", "figure.gif"], ".png"),
        ([], "--device"),
    ],
)
def test_what_cannot_be_used_is_refused_with_help(jetson: Out, words: list[str], helpful: str) -> None:
    assert jetson("predict", RESNET, *words, "--json", code=2) == ""
    assert helpful in jetson.error
    assert jetson.error.strip().splitlines()[-1].startswith("robotbrain jetson")


@pytest.mark.parametrize(
    ("name", "content", "helpful"),
    [
        ("none.onnx", None, "Check the path"),
        ("broken.onnx", "not a network", "ONNX"),
        ("none.json", None, "readable JSON file"),
        ("broken.json", "[{", "readable JSON file"),
        ("empty.json", "[]", "at least one"),
        ("number.json", "5", "a list of objects"),
        ("words.json", '["conv"]', "a list of objects"),
        ("op.json", '[{"op": 5}]', "a list of objects"),
        ("short.json", '[{"op": "conv"}]', "in_elems"),
        ("text.json", '[{"op": "pw", "macs": "0", "in_elems": 1, "out_elems": 1, "weight_elems": 0}]', "whole number"),
        ("many.json", '{"a": [], "b": []}', "many.json#a"),
    ],
)
def test_files_that_are_no_network(jetson: Out, tmp_path: Path, name: str, content: str | None, helpful: str) -> None:
    path = tmp_path / name
    if content is not None:
        path.write_text(content)
    jetson("predict", path, "--device", "nano-4gb", code=2)
    assert helpful in jetson.error
    jetson("compare", path, code=2)


def test_lists_of_kernels_are_taken_too(jetson: Out, tmp_path: Path) -> None:
    kernels = [
        {key: getattr(k, key) for key in ("op", "macs", "in_elems", "out_elems", "weight_elems")}
        for k in load_kernel_lists()["resnet18"].kernels
    ]
    path = tmp_path / "Mine.JSON"
    path.write_text(json.dumps(kernels))
    words = ["--device", "tx2", "--harness", "tf_to_trt"]
    mine = jetson.json("predict", path, *words)
    assert mine == {**predict(kernels, "tx2", harness="tf_to_trt").to_dict(), "model": "Mine"}
    path.write_text(json.dumps({"other": kernels[:1], "r18": kernels}))
    assert jetson.json("predict", f"{path}#r18", *words) == {**mine, "model": "r18"}


def test_dynamic_axes_are_bound(jetson: Out, tmp_path: Path) -> None:
    import onnx
    from onnx import TensorProto, helper

    image = helper.make_tensor_value_info("x", TensorProto.FLOAT, ["n", 3, "side", "side"])
    out = helper.make_tensor_value_info("y", TensorProto.FLOAT, None)
    weight = helper.make_tensor("w", TensorProto.FLOAT, [8, 3, 3, 3], [0.0] * 216)
    node = helper.make_node("Conv", ["x", "w"], ["y"], kernel_shape=[3, 3])
    graph = helper.make_graph([node], "g", [image], [out], [weight])
    path = tmp_path / "free.onnx"
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)]), path)
    words = ["predict", path, "--device", "orin-nano-8gb"]
    small = jetson.json(*words, "--bind", "n=1", "side=34")
    large = jetson.json(*words, "--bind", "n=1", "--bind", "side=66")
    assert large["gmacs"] == pytest.approx(4 * small["gmacs"], rel=2e-3)  # rounded
    jetson(*words, code=2)
    assert "side" in jetson.error


def test_the_slowest_kernels(jetson: Out) -> None:
    text = jetson("predict", RESNET, "--device", "nano-4gb", "--kernels", 3)
    prediction = predict(RESNET, "nano-4gb")
    slowest = max(range(len(prediction.kernels)), key=lambda i: prediction.kernels[i].total_ms)
    table = text.partition("bound by")[2].splitlines()[2:5]
    assert int(table[0].split()[0]) == slowest
    assert prediction.kernels[slowest].bound in table[0]
    data = jetson.json("predict", RESNET, "--device", "nano-4gb", "--kernels", 1000)
    times = [kernel["latency_ms"] for kernel in data["slowest_kernels"]]
    assert times == sorted(times, reverse=True) and len(times) == len(prediction.kernels)
    assert sum(times) + prediction.fixed_ms == pytest.approx(data["latency_ms"], rel=1e-3)


def test_out_of_memory_is_loud_but_no_error(jetson: Out, tmp_path: Path) -> None:
    path = tmp_path / "huge.json"
    huge = {"op": "mm", "macs": 10**9, "in_elems": 10**6, "out_elems": 10**6, "weight_elems": 3 * 10**9}
    path.write_text(json.dumps([huge]))
    assert jetson("predict", path, "--device", "nano-4gb").startswith("*** OUT OF MEMORY")
    data = jetson.json("predict", path, "--device", "nano-4gb")
    assert data["fits"] is False and any("out of memory" in warning for warning in data["warnings"])
    text = jetson("compare", path)
    (line,) = [line for line in text.splitlines() if line.startswith("t5000")]
    assert "OUT OF MEMORY" not in line
    assert text.count("OUT OF MEMORY") > 2
    assert "OUT OF MEMORY" not in jetson("predict", RESNET, "--device", "nano-4gb")


@pytest.mark.parametrize("subcommand", [["predict", "--device", "tx2"], ["compare", "--devices", "tx2,t5000"]])
def test_plots_are_written_beside_clean_json(jetson: Out, tmp_path: Path, subcommand: list[str]) -> None:
    path = tmp_path / "figure.png"
    jetson.json(subcommand[0], RESNET, *subcommand[1:], "--plot", path)
    assert path.read_bytes().startswith(b"\x89PNG")
    assert str(path) in jetson.error


# ---- compare ----


def test_compare_covers_every_module_fastest_first(jetson: Out) -> None:
    data = jetson.json("compare", RESNET)
    rows = data["predictions"]
    assert {row["device"] for row in rows} == set(list_modules())
    assert len(rows) == 16
    latencies = [row["latency_ms"] for row in rows]
    assert latencies == sorted(latencies)
    assert all(isinstance(row[name], kind) for row in rows for name, kind in PROMISED.items())
    (orin,) = [row for row in rows if row["device"] == "orin-nano-8gb"]
    assert orin == jetson.json("predict", RESNET, "--device", "orin-nano-8gb")


def test_compare_prints_a_table(jetson: Out) -> None:
    text = jetson("compare", RESNET, "--devices", "T5000, nano-4gb,,t5000")
    shown = [line.split()[0] for line in text.splitlines() if line.startswith(("t5000", "nano-4gb"))]
    assert shown == ["t5000", "nano-4gb"]
    assert "blackwell" in text  # the warnings, each with whom it is about


@pytest.mark.parametrize("modes", ["fastest", "ALL"])
def test_compare_takes_other_modes(jetson: Out, modes: str) -> None:
    rows = jetson.json("compare", RESNET, "--devices", "xavier-nx,nano-4gb", "--modes", modes)["predictions"]
    count = {slug: sum(row["device"] == slug for row in rows) for slug in ("xavier-nx", "nano-4gb")}
    one = {"xavier-nx": 1, "nano-4gb": 1}
    assert count == (one if modes == "fastest" else {slug: len(load_module(slug).modes) for slug in one})


@pytest.mark.parametrize("words", [["--devices", ","], ["--devices", "nano"], ["--modes", "slowest"]])
def test_compare_refuses_what_it_does_not_know(jetson: Out, words: list[str]) -> None:
    jetson("compare", RESNET, *words, code=2)
    assert "expected" in jetson.error


# ---- calibrate ----


@pytest.fixture(scope="module")
def run() -> CalibrationRun:
    return quick_run()


@pytest.fixture
def profiles(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, run: CalibrationRun) -> Path:
    """Return a copy of the profiles that stands in for them; calibrating gives the stored result again."""
    copy = tmp_path / "profiles"
    shutil.copytree(REPO / "autograder" / "profiles", copy)
    monkeypatch.setenv("ROBOTBRAIN_PROFILES", str(copy))
    monkeypatch.setattr(calibrate_command, "run_with_bar", lambda: run)
    return copy


def test_calibrate_check_compares_and_writes_nothing(
    jetson: Out, profiles: Path, run: CalibrationRun, monkeypatch: pytest.MonkeyPatch
) -> None:
    stored = profiles / "calibration" / "fit.json"
    before = stored.read_bytes()
    assert "up to date" in jetson("calibrate", "--check")
    assert f"{100 * run.calibration.errors['mixed']['median']:.1f} %" in jetson.text
    for changed in (
        replace(run.calibration, scale=1.01 * run.calibration.scale),
        replace(run.calibration, digest="0" * 64),
        replace(run.calibration, measured=frozenset([*run.calibration.measured, ("volta", "fp16", "mlperf")])),
    ):
        other = replace(run, calibration=changed)
        monkeypatch.setattr(calibrate_command, "run_with_bar", lambda other=other: other)
        jetson("calibrate", "--check", code=1)
        assert "out of date" in jetson.error
    rounded = replace(run, calibration=replace(run.calibration, scale=1.0002 * run.calibration.scale))
    monkeypatch.setattr(calibrate_command, "run_with_bar", lambda: rounded)
    jetson("calibrate", "--check")
    assert stored.read_bytes() == before


def test_calibrate_writes_the_fit_and_the_report(jetson: Out, profiles: Path, run: CalibrationRun) -> None:
    stored, page = profiles / "calibration" / "fit.json", profiles.parent / "report.html"
    stored.unlink()
    text = jetson("calibrate", "--report", page)
    assert stored.read_text(encoding="utf-8") == to_json(run.calibration)
    assert str(stored) in text and str(page) in text
    assert "</html>" in page.read_text(encoding="utf-8")
    jetson("calibrate", "--report", "report.txt", code=2)


def test_calibrate_stopped_half_way_leaves_the_fit_alone(
    jetson: Out, profiles: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = (profiles / "calibration" / "fit.json").read_bytes()

    def stop() -> CalibrationRun:
        raise KeyboardInterrupt

    monkeypatch.setattr(calibrate_command, "run_with_bar", stop)
    jetson("calibrate", code=130)
    assert (profiles / "calibration" / "fit.json").read_bytes() == before


def test_the_bar_follows_the_calibration(monkeypatch: pytest.MonkeyPatch, run: CalibrationRun) -> None:
    from robotbrain.jetson.twin import calibrate as twin_calibrate

    seen = []

    def calibrate(progress: Any) -> CalibrationRun:
        for done in range(1, 4):
            progress(done, 3)
            seen.append(done)
        return run

    monkeypatch.setattr(twin_calibrate, "calibrate", calibrate)
    assert calibrate_command.run_with_bar() is run
    assert seen == [1, 2, 3]


def test_differences_name_the_place() -> None:
    stored = {"a": [1.0, 2.0], "b": {"c": "x"}, "gone": 1}
    made = {"a": [1.0, 2.1], "b": {"c": "y"}, "new": 1}
    found = calibrate_command.differences(stored, made)
    assert [line.split()[0].rstrip(":") for line in found] == ["a[1]", "b.c", "gone", "new"]
    assert calibrate_command.differences(stored, stored) == []
    assert calibrate_command.differences([1.0], [1.0, 2.0]) and calibrate_command.differences(1, True)
    assert calibrate_command.differences(1000.0, 1000.9) == [] and calibrate_command.differences(1000.0, 1001.1)

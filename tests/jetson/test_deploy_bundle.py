"""Making bundles: what is in one, that the same input gives the same bytes, and what is refused before the board."""

from __future__ import annotations

import hashlib
import itertools
import json
import tarfile
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from deploy_builders import bundle, files_of, network, quantised
from onnx import TensorProto, helper, numpy_helper

from robotbrain import cli
from robotbrain.errors import InputError
from robotbrain.jetson.deploy import Preprocessing, verify_bundle
from robotbrain.jetson.deploy import network as networks
from robotbrain.jetson.deploy.target import check_opset, check_precision, target_of
from robotbrain.jetson.software import load_jetpacks
from robotbrain.jetson.twin import predict
from robotbrain.optimisation import calibrate


def manifest(path: Path) -> dict[str, Any]:
    return dict(json.loads((path / "manifest.json").read_text()))


def test_what_a_bundle_says(tmp_path: Path) -> None:
    model = network(tmp_path)
    data = manifest(bundle(tmp_path, model=model, mode="7w"))
    assert data["network"]["sha256"] == hashlib.sha256(model.read_bytes()).hexdigest()
    assert data["network"]["inputs"] == [{"name": "image", "dtype": "float32", "shape": [1, 3, 16, 16]}]
    assert data["network"]["opset"] == 13 and data["network"]["dynamic"]
    target = data["target"]
    assert (target["mode"], target["tensorrt"], target["cuda"], target["jetson_linux"]) == (
        "7W",
        "10.3",
        "12.6",
        "36.4.3",
    )
    assert target["parts"] == ["3767-0003", "3767-0005"]
    said, twin = data["prediction"], predict(model, "orin-nano-8gb", mode="7W", precision="fp16")
    assert said["label"] == "prediction of the twin, not a measurement" and said["provenance"] == "predicted"
    assert said["latency_ms"] == pytest.approx(twin.latency_ms, rel=1e-3)
    assert said["latency_low_ms"] < said["latency_ms"] < said["latency_high_ms"]
    assert data["preprocessing"]["classes"] == ["background", "floor", "obstacle", "marker"]
    assert data["kit"] and "date" not in json.dumps(data)


def test_test_vectors_are_what_the_network_computes(tmp_path: Path) -> None:
    import onnxruntime

    path = bundle(tmp_path)
    session = onnxruntime.InferenceSession(path / "model.onnx")
    for vector in manifest(path)["numerics"]["vectors"]:
        image = np.fromfile(path / vector["inputs"]["image"], "<f4").reshape(1, 3, 16, 16)
        expected = np.fromfile(path / vector["outputs"]["logits"]["file"], "<f4").reshape(1, 4, 16, 16)
        np.testing.assert_allclose(session.run(None, {"image": image})[0], expected, rtol=1e-4, atol=1e-5)


def test_the_same_input_gives_the_same_bytes_in_each_form(tmp_path: Path) -> None:
    model = network(tmp_path)
    for out in ("a", "a.tar.gz", "a.zip"):
        first, second = bundle(tmp_path, out, model), bundle(tmp_path, "x" + out, model)
        if first.is_dir():
            assert files_of(first) == files_of(second)
        else:
            assert first.read_bytes() == second.read_bytes()
    with tarfile.open(tmp_path / "a.tar.gz") as tar:
        assert {m.name.partition("/")[0] for m in tar} == {"net-orin-nano-8gb-fp16"}
        tar.extractall(tmp_path / "t", filter="data")
    with zipfile.ZipFile(tmp_path / "a.zip") as archive:
        archive.extractall(tmp_path / "z")
    for unpacked in (tmp_path / "t", tmp_path / "z"):
        assert files_of(unpacked / "net-orin-nano-8gb-fp16") == files_of(tmp_path / "a")
    assert (tmp_path / "t" / "net-orin-nano-8gb-fp16" / "run.sh").stat().st_mode & 0o777 == 0o755
    assert files_of(bundle(tmp_path, "b", model, seed=1)) != files_of(tmp_path / "a")


def test_only_a_bundle_is_replaced(tmp_path: Path) -> None:
    out = bundle(tmp_path)
    assert bundle(tmp_path, seed=1) == out and manifest(out)["parameters"]["seed"] == 1
    (out / "thesis of somebody.txt").write_text("years of work")
    with pytest.raises(InputError, match="--out"):
        bundle(tmp_path)
    assert (out / "thesis of somebody.txt").exists()
    extension = tmp_path / "extension"  # others have a manifest.json, too
    extension.mkdir()
    for name, text in (("manifest.json", "{}"), ("background.js", "years of work")):
        (extension / name).write_text(text)
    with pytest.raises(InputError, match="--out"):
        bundle(tmp_path, "extension")
    assert (extension / "background.js").read_text() == "years of work"
    (tmp_path / "notes").write_text("text")
    with pytest.raises(InputError, match="--out"):
        bundle(tmp_path, "notes")
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(".")]


def test_int8_with_qdq_is_linted_and_verifies(tmp_path: Path) -> None:
    assert manifest(bundle(tmp_path))["lint"]["findings"] == []  # nobody asked for INT8
    path = bundle(tmp_path, model=quantised(tmp_path), precision="int8")
    data = manifest(path)
    assert data["network"]["quantised"] and data["calibration"] is None
    assert data["numerics"]["arithmetic"] == "int8"
    assert all(finding["severity"] != "error" for finding in data["lint"]["findings"])
    verify_bundle(path)


def test_a_qdq_file_that_tensorrt_would_refuse_is_refused(tmp_path: Path) -> None:
    from onnxruntime.quantization import CalibrationDataReader, QuantFormat, quantize_static

    class Reader(CalibrationDataReader):  # type: ignore[misc]
        def __init__(self) -> None:
            self.rest = iter([{"image": np.ones((1, 3, 16, 16), np.float32)}])

        def get_next(self) -> Any:
            return next(self.rest, None)

    out = tmp_path / "default.onnx"
    quantize_static(network(tmp_path), out, Reader(), quant_format=QuantFormat.QDQ)
    with pytest.raises(InputError, match=r"zero-point|asymmetric|bias-dq"):
        bundle(tmp_path, model=out, precision="int8")
    assert not (tmp_path / "bundle").exists()


def test_a_calibration_belongs_to_its_network(tmp_path: Path) -> None:
    model, images = network(tmp_path), np.random.default_rng(0).normal(size=(4, 3, 16, 16)).astype(np.float32)
    table = calibrate(model, images, "entropy")
    path = bundle(tmp_path, model=model, precision="int8", calibration=table, module="xavier-nx", jetpack="5.1")
    assert (path / "calibration.cache").read_text().startswith("TRT-")
    assert manifest(path)["numerics"]["arithmetic"] == "int8-calibrated"
    verify_bundle(path)
    saved = table.save(tmp_path / "table.json")
    options: dict[str, Any] = {"precision": "int8", "module": "xavier-nx", "jetpack": "5.1"}
    again = bundle(tmp_path, "again", model, calibration=saved, **options)
    assert files_of(again) == files_of(path)
    with pytest.raises(InputError, match="SHA-256"):
        bundle(tmp_path, "other", network(tmp_path, seed=1, name="other"), calibration=table, **options)
    with pytest.raises(InputError, match="carries its own scales"):
        bundle(tmp_path, "other", quantised(tmp_path), calibration=_of(quantised(tmp_path), images), **options)


def _of(model: Path, images: Any) -> Any:
    return calibrate(model, images)


def test_given_inputs_become_the_vectors(tmp_path: Path) -> None:
    images = np.random.default_rng(0).normal(size=(5, 3, 16, 16)).astype(np.float32)
    path = bundle(tmp_path, inputs=images)
    data = manifest(path)
    assert data["parameters"]["vectors_from"] == "given inputs"
    found = [np.fromfile(path / vector["inputs"]["image"], "<f4") for vector in data["numerics"]["vectors"]]
    np.testing.assert_array_equal(np.concatenate(found), images[:3].ravel())
    for wrong in (images[:2], images[:, :2], images.astype(np.float64), np.full_like(images, np.nan)):
        with pytest.raises(InputError, match="inputs"):
            bundle(tmp_path, inputs=wrong)


def test_a_batch_of_several(tmp_path: Path) -> None:
    path = bundle(tmp_path, batch=4)
    assert manifest(path)["network"]["inputs"][0]["shape"] == [4, 3, 16, 16]
    verify_bundle(path)
    with pytest.raises(InputError, match="first dimension"):
        bundle(tmp_path, model=network(tmp_path, batch=1, name="fixed"), batch=4)
    with pytest.raises(InputError, match="--batch"):
        bundle(tmp_path, batch=0)


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"module": "nano-4gb", "jetpack": "4.6.1", "precision": "int8"}, "no INT8"),
        ({"precision": "int8"}, "calibration"),
        ({"precision": "int4"}, "precision"),
        ({"jetpack": "4.6"}, "6.2"),
        ({"jetpack": "9.9"}, "6.2"),
        ({"module": "orin-nano-9gb"}, "orin-nano-8gb"),
        ({"mode": "99W"}, "15W"),
        ({"preprocessing": None, "seed": -1}, "seed"),
    ],
)
def test_what_cannot_run_on_the_board_is_refused(tmp_path: Path, changes: dict[str, Any], word: str) -> None:
    with pytest.raises(InputError, match=word):
        bundle(tmp_path, **changes)
    assert not (tmp_path / "bundle").exists()


def test_an_opset_that_the_parser_does_not_take_is_refused(tmp_path: Path) -> None:
    model = network(tmp_path, opset=17)
    bundle(tmp_path, model=model)
    with pytest.raises(InputError, match=r"opset: got 17.*opset_version=13"):
        bundle(tmp_path, "old", model, module="nano-4gb", jetpack="4.6.1")


def test_rules_of_opset_hold_for_every_jetpack() -> None:
    for release in load_jetpacks():
        target = target_of(release.modules[0], None, release.version)
        newest = int(release.onnx_opset.value)
        check_opset(target, newest)
        for opset in (8, newest + 1):
            with pytest.raises(InputError, match="opset"):
                check_opset(target, opset)


@pytest.mark.parametrize("tensorrt", ["8.2", "10.3", "11.0"])
@pytest.mark.parametrize("precision", ["fp32", "fp16", "int8"])
@pytest.mark.parametrize("kind", ["float", "half", "quantised", "calibrated"])
def test_which_network_gives_which_precision(tensorrt: str, precision: str, kind: str) -> None:
    target = {**target_of("orin-nano-8gb", None, "6.2"), "tensorrt": tensorrt}
    weak = not tensorrt.startswith("11")
    right = {
        "float": precision == "fp32" or (precision == "fp16" and weak),
        "half": precision == "fp16",
        "quantised": precision == "int8",
        "calibrated": (precision == "int8" and weak) or precision == "fp32" or (precision == "fp16" and weak),
    }[kind]
    flags = {"quantised": kind == "quantised", "half": kind == "half", "calibrated": kind == "calibrated"}
    if right:
        check_precision(target, precision, **flags)
    else:
        with pytest.raises(InputError, match="precision"):
            check_precision(target, precision, **flags)


def test_files_that_are_no_network(tmp_path: Path) -> None:
    for content in (b"", b"\x08\xff\xff", b"not an onnx file"):
        (tmp_path / "m.onnx").write_bytes(content)
        with pytest.raises(InputError, match="model"):
            bundle(tmp_path, model=tmp_path / "m.onnx")
    with pytest.raises(InputError, match="model"):
        bundle(tmp_path, model=tmp_path / "missing.onnx")


def test_weights_in_another_file_are_refused(tmp_path: Path) -> None:
    model = onnx.load(network(tmp_path))
    onnx.save(model, tmp_path / "ext.onnx", save_as_external_data=True, location="weights.bin", size_threshold=0)
    with pytest.raises(InputError, match="weights in another file"):
        bundle(tmp_path, model=tmp_path / "ext.onnx")


@pytest.mark.parametrize("where", ["function", "sparse"])
def test_weights_elsewhere_are_found_wherever_they_are_named(
    tmp_path: Path, where: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A hostile file could have ONNX Runtime read files from where it runs."""
    secret = TensorProto(name="c", data_type=1, dims=[4], data_location=TensorProto.EXTERNAL)
    secret.external_data.add(key="location", value="secret.bin")
    (tmp_path / "secret.bin").write_bytes(np.arange(4, dtype=np.float32).tobytes())
    monkeypatch.chdir(tmp_path)
    sides = [helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, 4]) for name in "xy"]
    node, functions, opsets = helper.make_node("Add", ["x", "c"], ["y"]), [], [helper.make_opsetid("", 13)]
    if where == "function":
        constant = helper.make_node("Constant", [], ["c"])
        constant.attribute.add(name="value", type=onnx.AttributeProto.TENSOR).t.CopyFrom(secret)
        functions = [helper.make_function("own", "F", ["x"], ["y"], [constant, node], opsets)]
        node = helper.make_node("F", ["x"], ["y"], domain="own")
        opsets = [*opsets, helper.make_opsetid("own", 1)]
    graph = helper.make_graph([node], "g", sides[:1], sides[1:])
    if where == "sparse":
        indices = numpy_helper.from_array(np.arange(4), "i")
        graph.sparse_initializer.add(values=secret, indices=indices, dims=[4])
    model = helper.make_model(graph, opset_imports=opsets, ir_version=8, functions=functions)
    with pytest.raises(InputError, match="weights in another file"):
        networks.inspect(model.SerializeToString())


def test_what_a_function_does_counts() -> None:
    sides = [helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, 4]) for name in "xy"]
    opsets = [helper.make_opsetid("", 13), helper.make_opsetid("own", 1)]
    inside = [
        helper.make_node("Constant", [], ["s"], value_float=0.1),
        helper.make_node("QuantizeLinear", ["x", "s"], ["q"]),
        helper.make_node("DequantizeLinear", ["q", "s"], ["y"]),
    ]
    function = helper.make_function("own", "F", ["x"], ["y"], inside, opsets[:1])
    graph = helper.make_graph([helper.make_node("F", ["x"], ["y"], domain="own")], "g", sides[:1], sides[1:])
    model = helper.make_model(graph, opset_imports=opsets, ir_version=8, functions=[function])
    assert networks.inspect(model.SerializeToString()).quantised


def test_a_network_without_an_end_is_stopped(monkeypatch: pytest.MonkeyPatch) -> None:
    def info(name: str, kind: int, shape: list[int]) -> Any:
        return helper.make_tensor_value_info(name, kind, shape)

    one, many, go = np.float32(1), np.int64(2**62), np.array(True)
    body = helper.make_graph(
        [helper.make_node("Identity", ["c"], ["d"]), helper.make_node("Mul", ["v", "one"], ["w"])], "body",
        [info("i", 7, []), info("c", 9, []), info("v", 1, [1, 4])], [info("d", 9, []), info("w", 1, [1, 4])],
        [numpy_helper.from_array(one, "one")],
    )  # fmt: skip
    graph = helper.make_graph(
        [helper.make_node("Loop", ["many", "go", "x"], ["y"], body=body)], "g", [info("x", 1, [1, 4])],
        [info("y", 1, [1, 4])], [numpy_helper.from_array(many, "many"), numpy_helper.from_array(go, "go")],
    )  # fmt: skip
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    monkeypatch.setattr(networks, "TIME_LIMIT_S", 0.2)
    with pytest.raises(InputError, match="terminate"):
        networks.run(model.SerializeToString(), [{"x": np.zeros((1, 4), np.float32)}])


def test_sizes_that_no_bundle_holds_are_refused_before_they_are_made(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="smaller --batch"):
        bundle(tmp_path, batch=10**9)
    weight = numpy_helper.from_array(np.ones(1, np.float32), "w")
    out = helper.make_tensor_value_info("y", TensorProto.FLOAT, [1])
    graph = helper.make_graph([helper.make_node("Relu", ["w"], ["y"])], "g", [], [out], [weight])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    with pytest.raises(InputError, match="no input"):
        networks.inspect(model.SerializeToString())


@pytest.mark.parametrize("change", ["name", "type", "free height", "not finite"])
def test_networks_that_a_bundle_cannot_hold(tmp_path: Path, change: str) -> None:
    kind = TensorProto.DOUBLE if change == "type" else TensorProto.FLOAT
    shape: list[Any] = [1, 3, "height" if change == "free height" else 8, 8]
    name = "an image" if change == "name" else "image"
    scale = numpy_helper.from_array(
        np.array(np.inf if change == "not finite" else 1, np.float64 if change == "type" else np.float32), "s"
    )
    graph = helper.make_graph(
        [helper.make_node("Mul", [name, "s"], ["out"])],
        "g",
        [helper.make_tensor_value_info(name, kind, shape)],
        [helper.make_tensor_value_info("out", kind, shape)],
        [scale],
    )
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8), tmp_path / "m.onnx")
    with pytest.raises(InputError):
        bundle(tmp_path, model=tmp_path / "m.onnx")


def test_preprocessing_is_checked() -> None:
    for mean, std in [((0.5,), (0.0,)), ((0.5, 0.5), (1.0,)), ((float("nan"),), (1.0,)), ((), ())]:
        with pytest.raises(InputError, match="preprocessing"):
            Preprocessing(mean, std)


def test_tolerances_widen_with_fewer_bits() -> None:
    rows = [networks.TOLERANCES[name] for name in ("fp32", "fp16", "int8", "int8-calibrated")]
    for finer, coarser in itertools.pairwise(rows):
        assert finer["rms"] < coarser["rms"] and finer["peak"] < coarser["peak"]
        assert finer["agreement"] > coarser["agreement"]


def test_rounding_weights_to_float16_stays_within_the_tolerance(tmp_path: Path) -> None:
    model = onnx.load(network(tmp_path))
    feeds = networks.make_inputs(networks.inspect(model.SerializeToString()), Preprocessing(), None, 0)
    (right, *_) = networks.run(model.SerializeToString(), feeds)
    for tensor in model.graph.initializer:
        rounded = numpy_helper.to_array(tensor).astype(np.float16).astype(np.float32)
        tensor.CopyFrom(numpy_helper.from_array(rounded, tensor.name))
    (found, *_) = networks.run(model.SerializeToString(), feeds)
    error = found["logits"] - right["logits"]
    relative = np.sqrt(np.mean(error**2) / np.mean(right["logits"] ** 2))
    assert networks.TOLERANCES["fp32"]["rms"] < relative < networks.TOLERANCES["fp16"]["rms"]


def test_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    model, out = network(tmp_path), tmp_path / "b.zip"
    np.savez(tmp_path / "images.npz", images=np.random.default_rng(0).integers(0, 256, (6, 16, 16, 3), dtype=np.uint8))
    words = ["jetson", "deploy", model, "--module", "xavier-nx", "--jetpack", "5.1", "--calibration",
             tmp_path / "images.npz", "--out", out, "--classes", "a,b,c,d"]  # fmt: skip
    assert cli.main([*map(str, words)]) == 0
    shown = capsys.readouterr().out
    assert "TensorRT 8.5" in shown and "not a measurement" in shown and "sh run.sh" in shown
    assert cli.main(["jetson", "verify", str(out), "--json"]) == 0
    data = json.loads(capsys.readouterr().out)
    assert data["calibration"]["method"] == "entropy" and data["preprocessing"]["classes"] == list("abcd")
    raw = bytearray(out.read_bytes())
    raw[len(raw) // 2] ^= 1
    out.write_bytes(raw)
    assert cli.main(["jetson", "verify", str(out)]) == 2
    assert "bundle" in capsys.readouterr().err
    torn = tmp_path / "torn.npz"
    torn.write_bytes((tmp_path / "images.npz").read_bytes()[:-100])
    names = ["--classes", ",".join(f"a class with number {index}" for index in range(80))]  # longer than a path may be
    (tmp_path / "latin").write_bytes(b"stra\xdfe\n")
    for wrong in (["--mean", "1,2,3"], ["--mean", "a,b", "--std", "1,1"], ["--inputs", str(model)], names,
                  ["--inputs", str(torn)], ["--classes", str(tmp_path / "latin")]):  # fmt: skip
        assert cli.main([*map(str, words), *wrong]) == 2
        assert "expected" in capsys.readouterr().err


def test_classes_and_channels_are_the_networks_own(tmp_path: Path) -> None:
    found = networks.inspect(network(tmp_path).read_bytes())
    own = networks.preprocessing_of(found, None)
    assert own is not None and len(own.classes) == 4
    seven = replace(found, outputs=(replace(found.outputs[0], shape=(0, 7, 16, 16)),))
    unnamed = networks.preprocessing_of(seven, None)
    assert unnamed is not None and unnamed.classes == ()  # nobody said what they are
    for wrong in (Preprocessing(classes=("a", "b")), Preprocessing((0.5,), (0.5,))):
        with pytest.raises(InputError, match="--classes"):
            networks.preprocessing_of(found, wrong)
    policy = replace(found, inputs=(replace(found.inputs[0], shape=(1, 48)),))
    assert networks.preprocessing_of(policy, None) is None
    with pytest.raises(InputError, match="no image"):
        networks.preprocessing_of(policy, Preprocessing())


def test_a_network_of_numbers(tmp_path: Path) -> None:
    weight = numpy_helper.from_array(np.random.default_rng(0).normal(size=(6, 2)).astype(np.float32), "w")
    sides = [helper.make_tensor_value_info(n, TensorProto.FLOAT, ["b", size]) for n, size in (("obs", 6), ("act", 2))]
    graph = helper.make_graph([helper.make_node("MatMul", ["obs", "w"], ["act"])], "g", sides[:1], sides[1:], [weight])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    onnx.save(model, tmp_path / "policy.onnx")
    path = bundle(tmp_path, model=tmp_path / "policy.onnx")
    assert manifest(path)["preprocessing"] is None
    verify_bundle(path)

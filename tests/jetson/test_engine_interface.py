"""One way to open a network, whatever computes; every latency says where it comes from."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper
from tests.jetson.engine_models import images, write

from robotbrain.errors import InputError, MissingDependencyError
from robotbrain.jetson import load_profile, profiles
from robotbrain.jetson.engine import BACKENDS, Latency, OnnxEngine, open_engine
from robotbrain.jetson.engine.runtime import TensorRTRuntime, genuine_runtime
from robotbrain.jetson.engine.simulated import SimulatedCuda, simulated_runtime
from robotbrain.jetson.engine.timing import SOURCES, summarise


@pytest.fixture
def model(tmp_path: Path) -> Path:
    return write(tmp_path / "tiny.onnx")


def every_engine(model: Path, monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    monkeypatch.setattr(profiles, "_network_ms", lambda *_: (12.0, "predicted", "kit:a test"))
    return [
        open_engine(model),
        open_engine(model, "twin", profile="orin-nano-8gb"),
        open_engine(model, "tensorrt", runtime=simulated_runtime("10.3"), cache=model.parent),
    ]


def test_the_backends_are_interchangeable(model: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    engines = every_engine(model, monkeypatch)
    assert [engine.backend for engine in engines] == ["onnxruntime", "twin", "simulated tensorrt"]
    assert [engine.latency_ns for engine in engines] == [0, 12_000_000, 0]
    assert [engine.timing for engine in engines] == ["", "twin", ""]
    given = images(3)
    expected = engines[0].infer(given)
    for engine in engines:
        assert engine.path == model and engine.resource == "gpu" and engine.input_shape[1:] == (3, 6, 6)
        np.testing.assert_allclose(engine.infer(given), expected, atol=1e-5)
        for wrong in (given.astype(np.float64), given[..., 1:], given[0], given[:0], given * np.inf):
            with pytest.raises(InputError, match="network input"):
                engine.infer(wrong)
        engine.close()
        engine.close()
        with pytest.raises(InputError, match=r"close\(\)"):
            engine.infer(given)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"backend": "cuda"}, "onnxruntime, twin, tensorrt"),
        ({"backend": "twin"}, "orin-nano-8gb"),
        ({"backend": "twin", "profile": "orin-nano"}, "orin-nano-8gb"),
        ({"profile": "orin-nano-8gb"}, "backend twin"),
        ({"precision": "int8"}, "twin or tensorrt"),
        ({"cache": "folder"}, "backend tensorrt"),
        ({"backend": "tensorrt", "precision": "fp8", "runtime": "simulated"}, "fp32, fp16, int8"),
        ({"path": "missing.onnx"}, "ONNX file"),
        ({"path": "missing.onnx", "backend": "tensorrt", "runtime": "simulated"}, "ONNX file or a plan"),
        ({"path": "model.plan"}, "Only TensorRT reads plans"),
    ],
)
def test_what_does_not_go_together_is_explained(model: Path, arguments: dict[str, Any], words: str) -> None:
    if arguments.get("runtime"):
        arguments = {**arguments, "runtime": simulated_runtime("10.3")}
    with pytest.raises(InputError, match=words):
        open_engine(**{"path": model, **arguments})


def test_without_tensorrt_the_message_names_the_packages(model: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "tensorrt", None)  # makes `import tensorrt` fail
    genuine_runtime.cache_clear()
    with pytest.raises(MissingDependencyError, match=r"nvidia-jetpack.*python3-libnvinfer.*system-site-packages"):
        open_engine(model, "tensorrt")


@pytest.mark.parametrize("version", ["8.4.3", "7.1.3", "12.0.0", "dev"])
def test_versions_that_the_engine_was_not_written_for_are_refused(version: str) -> None:
    module: Any = simulated_runtime("8.5").trt
    module.__version__ = version
    with pytest.raises(InputError, match=r"8\.5 to 11"):
        TensorRTRuntime(module, SimulatedCuda())


def test_precision_of_the_twin_reaches_the_profile(model: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def answer(path: Path, slug: str, mode: str, precision: str, size: object) -> tuple[float, str, str]:
        asked.append((slug, mode, precision))
        return 3.0, "predicted", "kit:a test"

    monkeypatch.setattr(profiles, "_network_ms", answer)
    for arguments in ({"profile": "nano-4gb:5W"}, {"profile": load_profile("nano-4gb"), "precision": "fp32"}):
        engine = open_engine(model, "twin", **arguments)
        assert isinstance(engine, OnnxEngine) and str(engine.predicted()).endswith(asked[-1][2])
        assert engine.predicted().source == engine.timing == "twin" and "twin" in str(engine.predicted())
    assert asked == [("nano-4gb", "5W", "fp16"), ("nano-4gb", load_profile("nano-4gb").power_mode, "fp32")]
    with pytest.raises(InputError, match="load_profile"):
        OnnxEngine(model).predicted()


def test_a_measurement_here_says_here_even_with_a_profile(model: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for engine in every_engine(model, monkeypatch)[:2]:
        latency = engine.measure(images(2), runs=5, warmup=1)
        assert latency.source == "measured on this host" and "ONNX Runtime" in latency.harness
        assert (latency.runs, latency.batch) == (5, 2) and 0 < latency.median_ms <= latency.p99_ms
        assert "measured on this host" in str(latency) and "Jetson" not in str(latency)
        assert engine.measure(runs=1, warmup=0).batch == 1
        for wrong in ({"runs": 0}, {"warmup": -1}):
            with pytest.raises(InputError, match="runs and warmup"):
                engine.measure(**wrong)


def test_latencies_are_summarised_and_never_without_a_source() -> None:
    times = [float(i) for i in range(1, 102)]
    latency = summarise(times[::-1], batch=1, source=SOURCES[2], harness="h")
    assert (latency.median_ms, latency.p99_ms, latency.runs) == (51.0, 100.0, 101)
    for source in SOURCES:
        assert source in str(Latency(1.0, 1.0, 0, 1, source, "h"))
    for wrong in ("", "simulated", "TensorRT"):
        with pytest.raises(InputError, match="source"):
            Latency(1.0, 1.0, 0, 1, wrong, "h")
    for bad in ([], [-1.0], [float("nan")], [[1.0]]):
        with pytest.raises(InputError):
            summarise(bad, batch=1, source=SOURCES[0], harness="h")  # type: ignore[arg-type]


def test_the_package_is_cheap_to_import() -> None:
    code = (
        "import sys; import robotbrain.jetson.engine as e; e.TensorRTEngine, e.open_engine, e.Latency, e.BACKENDS;"
        "assert not {'onnx', 'onnxruntime', 'torch', 'tensorrt', 'robotbrain.jetson.twin'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
    assert BACKENDS == ("onnxruntime", "twin", "tensorrt")


@pytest.mark.parametrize("change", ["two inputs", "float64", "no input"])
def test_networks_of_other_inputs_are_refused_when_opened(tmp_path: Path, change: str) -> None:
    kind = TensorProto.DOUBLE if change == "float64" else TensorProto.FLOAT
    names = {"two inputs": ["a", "b"], "float64": ["a", "a"], "no input": ["w", "w"]}[change]
    sides = [helper.make_tensor_value_info(name, kind, [1, 2]) for name in dict.fromkeys(names) if name != "w"]
    graph = helper.make_graph(
        [helper.make_node("Add", names, ["y"])], "g", sides, [helper.make_tensor_value_info("y", kind, [1, 2])],
        [numpy_helper.from_array(np.ones((1, 2), np.float32), "w")],
    )  # fmt: skip
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    onnx.save(model, tmp_path / "m.onnx")
    with pytest.raises(InputError, match="one float32 input"):
        open_engine(tmp_path / "m.onnx")

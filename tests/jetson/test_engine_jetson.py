"""The engine on a genuine TensorRT. Nothing else in the tests needs a board; this skips, and says so, without one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from tests.jetson.engine_models import images, write

from robotbrain.errors import RobotBrainError
from robotbrain.jetson.engine import OnnxEngine, TensorRTEngine
from robotbrain.jetson.engine.build import BuildOptions
from robotbrain.jetson.engine.runtime import TensorRTRuntime, genuine_runtime


@pytest.fixture
def runtime() -> TensorRTRuntime:
    try:
        return genuine_runtime()
    except RobotBrainError as error:
        # Not tests.conftest.need: CI has no board, and may skip this one file (ROBOTBRAIN_NO_SKIP or not).
        pytest.skip(
            "NOT TESTED ON TensorRT: needs an NVIDIA Jetson with JetPack 7 (its Python is new enough for these "
            f"tests; the smallest is an Orin Nano 4GB), or a PC with an NVIDIA GPU and `pip install tensorrt`. {error}"
        )


def test_a_genuine_tensorrt_agrees_and_is_measured(tmp_path: Path, runtime: TensorRTRuntime) -> None:
    path = write(tmp_path / "m.onnx")
    reference = OnnxEngine(path)
    with TensorRTEngine(path, BuildOptions("fp32", max_batch=4), runtime=runtime) as engine:
        for batch in (1, 4, 2):
            given = images(batch, seed=batch)
            # TF32 keeps ten bits of mantissa.
            np.testing.assert_allclose(engine.infer(given), reference.infer(given), rtol=2e-3, atol=2e-3)
        latency = engine.measure(images(1), runs=100, warmup=20)
        assert latency.source == "TensorRT on this board" and 0 < latency.median_ms <= latency.p99_ms
        print(latency)
    with TensorRTEngine(engine.plan_path, runtime=runtime) as again:
        assert again.infer(images(1)).shape == (1, 4)


def test_a_genuine_tensorrt_runs_q_dq_nodes(tmp_path: Path, runtime: TensorRTRuntime) -> None:
    path = write(tmp_path / "m.onnx", quantised=True)
    with TensorRTEngine(path, BuildOptions("int8"), runtime=runtime) as engine:
        given = images(2)
        np.testing.assert_allclose(engine.infer(given), OnnxEngine(path).infer(given), rtol=0.05, atol=0.05)

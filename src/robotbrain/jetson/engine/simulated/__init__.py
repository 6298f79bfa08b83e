"""A stand-in for TensorRT and CUDA, to see the order of calls: it computes with ONNX Runtime and has no latency.

``simulated_runtime("10.3")`` is what ``open_engine(path, backend="tensorrt", runtime=...)`` takes where there is no
GPU. It says that it is simulated in its name, its repr and its plans. See ``memory`` for what it catches.
"""

from __future__ import annotations

from typing import Any, cast

from robotbrain.errors import InputError
from robotbrain.jetson.engine.runtime import TensorRTRuntime
from robotbrain.jetson.engine.simulated.memory import DEVICE_NAME, MisuseError, SimulatedCuda
from robotbrain.jetson.engine.simulated.versions import VERSIONS

__all__ = ["VERSIONS", "MisuseError", "SimulatedCuda", "simulated_runtime"]


def simulated_runtime(
    version: str = "10.3", *, device: str = DEVICE_NAME, memory_bytes: int = 1 << 30
) -> TensorRTRuntime:
    """Return a simulated TensorRT on an imaginary GPU.

    Args:
        version: one of :data:`VERSIONS`; the stand-in has the names that this version has.
        device: what the GPU is called.
        memory_bytes: of the GPU.

    Raises:
        InputError: for another version.
    """
    if version not in VERSIONS:
        raise InputError(
            "version of the simulated TensorRT",
            given=version,
            expected="one of " + ", ".join(VERSIONS),
            fix="Choose one of these.",
        )
    from robotbrain.jetson.engine.simulated.module import make_module

    cuda = SimulatedCuda(device, memory_bytes)
    return TensorRTRuntime(cast("Any", make_module(version, cuda)), cuda)

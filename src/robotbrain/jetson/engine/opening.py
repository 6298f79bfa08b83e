"""Opening a network with the backend of one's choice."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from robotbrain.errors import InputError
from robotbrain.jetson.engine.plan import SUFFIXES

if TYPE_CHECKING:
    from robotbrain.jetson.engine.build import Progress
    from robotbrain.jetson.engine.interface import InferenceEngine
    from robotbrain.jetson.engine.runtime import TensorRTRuntime
    from robotbrain.jetson.profiles import JetsonProfile

BACKENDS = ("onnxruntime", "twin", "tensorrt")
"""What can compute: ONNX Runtime here; the same with a Jetson's time charged in simulation; TensorRT on a board."""


def open_engine(
    path: str | Path,
    backend: str = "onnxruntime",
    *,
    profile: JetsonProfile | str | None = None,
    precision: str | None = None,
    max_batch: int = 8,
    cache: str | Path | None = None,
    progress: Progress | None = None,
    runtime: TensorRTRuntime | None = None,
) -> InferenceEngine:
    """Open a network.

    Args:
        path: of an ONNX file; for ``tensorrt`` also of a plan built on this GPU.
        backend: one of :data:`BACKENDS`.
        profile: for ``twin``: whose time is charged; a profile, or a module with or without its power mode
            (``"orin-nano-8gb"``, ``"nano-4gb:5W"``).
        precision: ``fp32``, ``fp16`` or ``int8``: what ``twin`` charges for and ``tensorrt`` builds. None: ``fp16``
            for the twin, the types in the file for TensorRT.
        max_batch: for ``tensorrt``: largest batch to build for.
        cache, progress: for ``tensorrt``: see :class:`~robotbrain.jetson.engine.TensorRTEngine`.
        runtime: for ``tensorrt``: what to run on instead of this machine's, e.g. a simulated one.

    Raises:
        InputError: for an unknown backend, arguments that the backend does not take, or an unsuitable file.
        MissingDependencyError: for ``tensorrt`` where it is not installed.
    """
    if backend not in BACKENDS:
        raise InputError("backend", given=backend, expected="one of " + ", ".join(BACKENDS), fix="Choose one of these.")
    if backend != "twin" and profile is not None:
        raise _misplaced("profile", backend, "twin", "Only the twin charges a Jetson's time.")
    if backend != "tensorrt" and (runtime is not None or cache is not None or progress is not None):
        raise _misplaced("runtime, cache or progress", backend, "tensorrt", "Only TensorRT builds plans.")
    if backend == "tensorrt":
        from robotbrain.jetson.engine.build import BuildOptions
        from robotbrain.jetson.engine.tensorrt_engine import TensorRTEngine

        options = BuildOptions(precision, max_batch)
        return TensorRTEngine(path, options, cache=cache, progress=progress, runtime=runtime)
    from robotbrain.jetson.engine.ort import OnnxEngine
    from robotbrain.jetson.profiles import PRECISION, load_profile

    if Path(path).suffix.lower() in SUFFIXES:
        raise InputError(
            "model",
            given=str(path),
            expected=f"an ONNX file for the backend {backend}",
            fix="Only TensorRT reads plans. Give the ONNX file that it was built from.",
        )
    if backend == "onnxruntime":
        if precision not in (None, "fp32"):
            raise _misplaced(
                f"precision {precision!r}", backend, "twin or tensorrt", "ONNX Runtime runs what it is given."
            )
        return OnnxEngine(path)
    if profile is None:
        raise InputError(
            "profile",
            given=None,
            expected="the Jetson whose time is charged",
            fix='For example profile="orin-nano-8gb" (`robotbrain jetson list` shows all).',
        )
    jetson = load_profile(profile) if isinstance(profile, str) else profile
    return OnnxEngine(path, jetson, precision=precision or PRECISION)


def _misplaced(what: str, backend: str, wanted: str, why: str) -> InputError:
    return InputError("backend", given=f"{backend!r} with {what}", expected=f"the backend {wanted}", fix=why)

"""Running a network behind one interface: ONNX Runtime here, the twin's time in simulation, TensorRT on a board.

``open_engine(path)`` picks a backend; whatever it returns is an :class:`InferenceEngine`, and so is what the brain's
nodes take. Names are imported on first use. The TensorRT modules (``interface``, ``timing``, ``cuda``, ``plan``,
``build``, ``tensorrt_engine``) need nothing but numpy and run on Python 3.8 and later, because JetPack's TensorRT
belongs to the board's own Python: 3.8 on JetPack 5, 3.10 on JetPack 6 (``TENSORRT_TODAY.md``).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from robotbrain.lazy import lazy

if TYPE_CHECKING:
    from robotbrain.jetson.engine.interface import InferenceEngine
    from robotbrain.jetson.engine.opening import BACKENDS, open_engine
    from robotbrain.jetson.engine.ort import OnnxEngine
    from robotbrain.jetson.engine.tensorrt_engine import TensorRTEngine
    from robotbrain.jetson.engine.timing import Latency

__all__ = ["BACKENDS", "InferenceEngine", "Latency", "OnnxEngine", "TensorRTEngine", "open_engine"]

_HOMES = {
    "BACKENDS": "opening",
    "InferenceEngine": "interface",
    "Latency": "timing",
    "OnnxEngine": "ort",
    "TensorRTEngine": "tensorrt_engine",
    "open_engine": "opening",
}

__getattr__, __dir__ = lazy(__name__, _HOMES, globals())

"""NVIDIA Jetson modules without the hardware: a catalogue, a model of them (the twin), and the way to a real one.

Names are imported on first use, so that ``import robotbrain.jetson`` stays cheap.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from robotbrain.jetson.catalogue import Module, PowerMode, list_modules, load_module
    from robotbrain.jetson.engine import InferenceEngine, OnnxEngine, TensorRTEngine, open_engine
    from robotbrain.jetson.graph import analyse
    from robotbrain.jetson.kernels import Kernel, KernelGraph
    from robotbrain.jetson.profiles import JetsonProfile, list_profiles, load_profile
    from robotbrain.jetson.reference import load_reference
    from robotbrain.jetson.twin import Prediction, compare, predict

__all__ = [
    "InferenceEngine",
    "JetsonProfile",
    "Kernel",
    "KernelGraph",
    "Module",
    "OnnxEngine",
    "PowerMode",
    "Prediction",
    "TensorRTEngine",
    "analyse",
    "compare",
    "list_modules",
    "list_profiles",
    "load_module",
    "load_profile",
    "load_reference",
    "open_engine",
    "predict",
]

_HOMES = {
    "catalogue": ("Module", "PowerMode", "list_modules", "load_module"),
    "engine": ("InferenceEngine", "OnnxEngine", "TensorRTEngine", "open_engine"),
    "graph": ("analyse",),
    "kernels": ("Kernel", "KernelGraph"),
    "profiles": ("JetsonProfile", "list_profiles", "load_profile"),
    "reference": ("load_reference",),
    "twin": ("Prediction", "compare", "predict"),
}


def __getattr__(name: str) -> Any:
    for home, names in _HOMES.items():
        if name in names:
            return getattr(importlib.import_module(f"{__name__}.{home}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)

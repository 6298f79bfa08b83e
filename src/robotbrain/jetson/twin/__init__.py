"""The Jetson twin: what a network takes on a module, calibrated on published measurements."""

from robotbrain.jetson.twin.conditions import HARNESSES, PRECISIONS
from robotbrain.jetson.twin.prediction import KernelTime, Prediction
from robotbrain.jetson.twin.predictor import as_graph, compare, predict
from robotbrain.jetson.twin.runtime import simulate_heat, thermal_model

__all__ = [
    "HARNESSES",
    "PRECISIONS",
    "KernelTime",
    "Prediction",
    "as_graph",
    "compare",
    "predict",
    "simulate_heat",
    "thermal_model",
]

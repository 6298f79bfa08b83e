"""Faults to inject into a run, to see what a brain makes of them.

Each fault is a description; ``install(context)`` puts it into a simulation and returns a function that takes it out
again. ``drive(seed, attach=[fault.install])`` injects it into a drive; several compose, in the order given. The same
fault with the same ``seed`` does the same in every run: what it draws depends on nothing but that.
"""

from __future__ import annotations

from robotbrain.monitoring.faults_base import Fault, MessageFault, Remover, Window
from robotbrain.monitoring.faults_device import CpuHog, HeatLog, Slowdown, ThermalThrottling
from robotbrain.monitoring.faults_messages import (
    Blackout,
    DropFrames,
    FrozenSensor,
    LateFrames,
    StampOffset,
    WrongFrameId,
)
from robotbrain.monitoring.faults_numbers import Noise, Outliers, SensorBias

__all__ = [
    "Blackout",
    "CpuHog",
    "DropFrames",
    "Fault",
    "FrozenSensor",
    "HeatLog",
    "LateFrames",
    "MessageFault",
    "Noise",
    "Outliers",
    "Remover",
    "SensorBias",
    "Slowdown",
    "StampOffset",
    "ThermalThrottling",
    "Window",
    "WrongFrameId",
]

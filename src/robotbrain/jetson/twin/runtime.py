"""What running a network costs besides its kernels: memory, and heat over time (figures in ``runtime.toml``)."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from robotbrain.errors import InputError
from robotbrain.jetson.catalogue import Module, all_modules
from robotbrain.jetson.figures import Figure, read_table
from robotbrain.jetson.kernels import KernelGraph
from robotbrain.jetson.paths import find_part
from robotbrain.jetson.twin.conditions import BYTES

_FIGURES: dict[str, tuple[str, float, float]] = {
    "memory.system_mb": ("MB", 0, 1e5),
    "memory.desktop_mb": ("MB", 0, 1e5),
    "memory.context_mb": ("MB", 0, 1e5),
    "memory.context_legacy_mb": ("MB", 0, 1e5),
    "memory.activation_overhead": ("ratio", 1, 10),
    "memory.build_ratio": ("ratio", 1, 100),
    "memory.reserved_ratio": ("ratio", 0, 0.9),
    "power.cpu_core_w": ("W", 0.01, 50),
    "thermal.ambient_c": ("degC", -40, 80),
    "thermal.full_load_rise_c": ("degC", 1, 200),
    "thermal.passive_ratio": ("ratio", 1, 10),
    "thermal.time_constant_s": ("s", 1, 1e4),
    "thermal.hysteresis_c": ("degC", 0.1, 50),
}


_SECTIONS = ("memory", "power", "thermal")


@functools.lru_cache(maxsize=8)
def _read(path: Path, _changed: int) -> dict[str, Figure]:
    root = read_table(path)
    root.only(("sources", *_SECTIONS))
    figures = {}
    for section in _SECTIONS:
        table = root.table(section)
        table.only(key.partition(".")[2] for key in _FIGURES if key.startswith(section))
    for key, (unit, low, high) in _FIGURES.items():
        section, _, name = key.partition(".")
        figures[key] = root.table(section).figure(name, unit, low, high)
    return figures


def runtime_figures() -> dict[str, Figure]:
    """Return the figures of ``runtime.toml`` by name (``memory.system_mb`` ...).

    Raises:
        InputError: for a file that does not hold what it must.
    """
    path = find_part("runtime.toml")
    return _read(path, path.stat().st_mtime_ns)


@dataclass(frozen=True)
class MemoryUse:
    """Memory of one engine, MB (1e6 bytes).

    Attributes:
        weights_mb, activations_mb, context_mb: what it is made of.
        available_mb: what the module leaves after firmware and system, without a desktop.
        building_mb: at the peak of building the engine on the module itself.
    """

    weights_mb: float
    activations_mb: float
    context_mb: float
    available_mb: float
    building_mb: float

    @property
    def total_mb(self) -> float:
        """Everything the process holds while it runs."""
        return self.weights_mb + self.activations_mb + self.context_mb

    @property
    def fits(self) -> bool:
        """Whether the engine runs without running out of memory."""
        return self.total_mb <= self.available_mb

    @property
    def builds(self) -> bool:
        """Whether the engine can be built on the module itself."""
        return self.building_mb <= self.available_mb


def memory_use(graph: KernelGraph, module: Module, precision: str) -> MemoryUse:
    """Return what an engine of the graph takes of a module's memory."""
    figures = runtime_figures()
    size = BYTES[precision]
    weights = graph.weight_elems * size / 1e6
    activations = graph.peak_activation_elems * size * figures["memory.activation_overhead"].value / 1e6
    legacy = all(version.startswith("4") for version in module.jetpacks)
    context = figures["memory.context_legacy_mb" if legacy else "memory.context_mb"].value
    usable = module.memory_gb * 2**30 / 1e6 * (1 - figures["memory.reserved_ratio"].value)
    # The builder holds the model as read (32 bits) and tries kernels with buffers of their own.
    building = context + figures["memory.build_ratio"].value * (weights + activations) + graph.weight_elems * 4 / 1e6
    return MemoryUse(weights, activations, context, usable - figures["memory.system_mb"].value, building)


Cooling = Literal["fan", "passive"]


@dataclass(frozen=True)
class ThermalModel:
    """One thermal mass between chip and air: ``tau dT/dt = ambient + R P - T``.

    Attributes:
        ambient_c: temperature of the air, degC.
        resistance_c_per_w: R.
        time_constant_s: tau.
        throttle_c, shutdown_c: trip points, degC.
        hysteresis_c: clocks rise again this far below ``throttle_c``.
    """

    ambient_c: float
    resistance_c_per_w: float
    time_constant_s: float
    throttle_c: float
    shutdown_c: float
    hysteresis_c: float

    def steady_c(self, power_w: float) -> float:
        """Return the temperature that a constant power leads to, degC, throttling aside."""
        return self.ambient_c + self.resistance_c_per_w * power_w

    def after(self, temperature_c: float, power_w: float, seconds: float) -> float:
        """Return the temperature after a time at constant power, degC (exact)."""
        goal = self.steady_c(power_w)
        return goal + (temperature_c - goal) * math.exp(-seconds / self.time_constant_s)


def _cooled_for_w(module: Module) -> float:
    """Return the power that the developer kit's heat sink is made for: the Super variants are the same hardware."""
    base = module.slug.removesuffix("-super")
    twins = [twin for twin in all_modules() if twin.slug in (base, f"{base}-super")]
    return max(twin.max_power_w for twin in [module, *twins])


def thermal_model(module: Module, cooling: Cooling = "fan", ambient_c: float | None = None) -> ThermalModel:
    """Return the thermal model of a module on its developer kit.

    Args:
        module: which.
        cooling: the kit's heat sink with its fan on, or off.
        ambient_c: degC, -40 to 80; a room by default.

    Raises:
        InputError: for another cooling, or air outside the range.
    """
    figures = runtime_figures()
    if cooling not in ("fan", "passive"):
        raise InputError("cooling", given=cooling, expected="'fan' or 'passive'", fix="Choose one of the two.")
    ambient = figures["thermal.ambient_c"].value if ambient_c is None else float(ambient_c)
    if not -40 <= ambient <= 80:
        raise InputError("ambient_c", given=ambient_c, expected="-40 to 80 degC", fix="Give degrees Celsius.")
    resistance = figures["thermal.full_load_rise_c"].value / _cooled_for_w(module)
    if cooling == "passive":
        resistance *= figures["thermal.passive_ratio"].value
    return ThermalModel(
        ambient,
        resistance,
        figures["thermal.time_constant_s"].value,
        module.gpu_throttle_c,
        module.shutdown_c,
        figures["thermal.hysteresis_c"].value,
    )


@dataclass(frozen=True)
class ThermalTrace:
    """Temperature and clocks over time.

    Attributes:
        time_s, temperature_c: (T,)
        power_w: (T,) from this time to the next.
        clock: (T,) GPU clock over that of the power mode, from this time to the next.
        throttled_s: how long clocks were lowered.
        shut_down: whether the module reached its shutdown temperature; the trace ends there.
    """

    time_s: NDArray[np.float64]
    temperature_c: NDArray[np.float64]
    power_w: NDArray[np.float64]
    clock: NDArray[np.float64]
    throttled_s: float
    shut_down: bool


def simulate_heat(
    model: ThermalModel,
    power_w: Callable[[float, float], float],
    seconds: float,
    *,
    step_s: float = 1.0,
    start_c: float | None = None,
) -> ThermalTrace:
    """Follow a module's temperature, lowering clocks at the trip point and raising them again below it.

    Args:
        model: of the module.
        power_w: ``(time s, clock share) -> W``.
        seconds: how long, > 0.
        step_s: between decisions of the governor, > 0.
        start_c: degC; the air's temperature by default.

    Raises:
        InputError: for times that are not positive, a start that is no number, or a power that is no number of watts.
    """
    if not (0 < step_s <= seconds and math.isfinite(seconds)):
        raise InputError(
            "seconds, step_s", given=(seconds, step_s), expected="0 < step_s <= seconds", fix="Give both in seconds."
        )
    temperature = model.ambient_c if start_c is None else float(start_c)
    if not math.isfinite(temperature):
        raise InputError("start_c", given=start_c, expected="a finite temperature", fix="Give degrees Celsius.")
    clock = 1.0
    rows: list[tuple[float, float, float, float]] = []
    shut_down = False
    for step in range(round(seconds / step_s) + 1):
        # The governor moves the clock by a tenth at a time, as thermal cooling devices do in steps.
        if temperature >= model.throttle_c:
            clock = max(0.2, round(clock - 0.1, 1))
        elif temperature < model.throttle_c - model.hysteresis_c:
            clock = min(1.0, round(clock + 0.1, 1))
        now = step * step_s
        power = float(power_w(now, clock))
        if not (math.isfinite(power) and power >= 0):
            raise InputError(
                f"power_w({now:g}, {clock:g})", given=power, expected="watts, 0 or more", fix="Correct the function."
            )
        rows.append((now, temperature, power, clock))
        shut_down = temperature >= model.shutdown_c
        if shut_down:
            break
        temperature = model.after(temperature, power, step_s)
    columns = np.array(rows).T
    throttled = step_s * float(np.count_nonzero(columns[3][:-1] < 1.0))
    return ThermalTrace(columns[0], columns[1], columns[2], columns[3], throttled, shut_down)

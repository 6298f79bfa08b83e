"""What the twin says about a network on a module."""

from __future__ import annotations

import html
from dataclasses import dataclass
from typing import Any

from robotbrain.jetson.kernels import Kernel, KernelGraph
from robotbrain.jetson.modes import PowerMode
from robotbrain.jetson.module import Module
from robotbrain.jetson.twin.conditions import Conditions
from robotbrain.jetson.twin.runtime import MemoryUse


@dataclass(frozen=True, slots=True)
class KernelTime:
    """Time of one kernel.

    Attributes:
        kernel: which.
        compute_ms, memory_ms, launch_ms: for arithmetic, for moving data, for the launch.
        total_ms: all together (the first two overlap).
        flops, bytes_moved: what it does.
        precision: it runs in.
    """

    kernel: Kernel
    compute_ms: float
    memory_ms: float
    launch_ms: float
    total_ms: float
    flops: float
    bytes_moved: float
    precision: str

    @property
    def bound(self) -> str:
        """What takes most of its time: ``"compute"``, ``"memory"`` or ``"launch"``."""
        parts = {"compute": self.compute_ms, "memory": self.memory_ms, "launch": self.launch_ms}
        return max(parts, key=lambda name: parts[name])


@dataclass(frozen=True)
class Prediction:
    """Latency, memory, power and temperature of a network on a module, and how sure that is.

    Attributes:
        model: name of the network.
        device: slug of the module.
        mode: power mode, as nvpmodel spells it.
        precision, harness, batch: as asked for.
        latency_ms: of one inference.
        latency_low_ms, latency_high_ms: 80 % interval (equal to ``latency_ms`` if measured).
        macs: multiply-accumulates of one inference.
        memory: what it takes of the module's memory.
        power_w: of the module, running without pause.
        wall_power_w: of a developer kit with its adapter, as MLPerf measures it.
        temperature_c: that this power leads to in the end, on a developer kit with its fan on in a room, degC.
        throttles: whether that is above the point at which clocks are lowered.
        provenance: ``"predicted"``, or ``"measured"`` if a measured profile was found for exactly this.
        sources: of the latency.
        warnings: what to beware of.
        kernels: each kernel's time (of the prediction, also where the total was measured).
        fixed_ms: of the prediction: cost of an inference besides its kernels.
        dla_share: share of the multiply-accumulates that a DLA could take; 0 where there is none.
        graph, module, power_mode, where: what it was computed from.
    """

    model: str
    device: str
    mode: str
    precision: str
    harness: str
    batch: int
    latency_ms: float
    latency_low_ms: float
    latency_high_ms: float
    macs: int
    memory: MemoryUse
    power_w: float
    wall_power_w: float
    temperature_c: float
    throttles: bool
    provenance: str
    sources: tuple[str, ...]
    warnings: tuple[str, ...]
    kernels: tuple[KernelTime, ...]
    fixed_ms: float
    dla_share: float
    graph: KernelGraph
    module: Module
    power_mode: PowerMode
    where: Conditions

    @property
    def memory_mb(self) -> float:
        """Memory of the process, MB."""
        return self.memory.total_mb

    @property
    def fits(self) -> bool:
        """Whether it runs without running out of memory."""
        return self.memory.fits

    @property
    def energy_mj(self) -> float:
        """Energy that the module spends on one inference, running without pause, mJ."""
        return self.power_w * self.latency_ms

    @property
    def throughput(self) -> float:
        """Inputs per second, one inference after another."""
        return 1e3 * self.batch / self.latency_ms

    @property
    def baseline_ms(self) -> float:
        """What FLOPs over the dense peak would say, ms: a bound that no network comes near."""
        from robotbrain.jetson.twin.conditions import PRECISIONS

        return 2e3 * self.macs / self.where.peak[PRECISIONS.index(self.where.precision)]

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON; units are in the names."""
        return {
            "model": self.model,
            "device": self.device,
            "mode": self.mode,
            "precision": self.precision,
            "harness": self.harness,
            "batch": self.batch,
            "latency_ms": round(self.latency_ms, 4),
            "latency_low_ms": round(self.latency_low_ms, 4),
            "latency_high_ms": round(self.latency_high_ms, 4),
            "throughput_per_s": round(self.throughput, 2),
            "gmacs": round(self.macs / 1e9, 6),
            "kernels": len(self.kernels),
            "memory_mb": round(self.memory_mb, 1),
            "memory_available_mb": round(self.memory.available_mb, 1),
            "fits": self.fits,
            "power_w": round(self.power_w, 2),
            "wall_power_w": round(self.wall_power_w, 2),
            "energy_mj": round(self.energy_mj, 3),
            "temperature_c": round(self.temperature_c, 1),
            "throttles": self.throttles,
            "dla_share": round(self.dla_share, 3),
            "provenance": self.provenance,
            "sources": list(self.sources),
            "warnings": list(self.warnings),
        }

    def rows(self) -> list[tuple[str, str]]:
        """Return what to show of it, as (what, value with its unit)."""
        interval = (
            f" (80 %: {_short(self.latency_low_ms)} to {_short(self.latency_high_ms)} ms)"
            if self.provenance == "predicted"
            else ""
        )
        verdict = "fits" if self.fits else "OUT OF MEMORY"
        return [
            ("module", f"{self.module.name}, mode {self.mode}"),
            ("network", f"{self.model}, {self.macs / 1e9:.3g} GMAC in {len(self.kernels)} kernels, batch {self.batch}"),
            ("precision", f"{self.precision}, timed as by {self.harness}"),
            ("latency", f"{_short(self.latency_ms)} ms{interval}, {self.provenance}"),
            ("throughput", f"{_short(self.throughput)} per second"),
            ("memory", f"{self.memory_mb:.0f} of {self.memory.available_mb:.0f} MB: {verdict}"),
            ("power", f"{self.power_w:.1f} W of the module, {self.wall_power_w:.1f} W at the wall"),
            ("energy", f"{_short(self.energy_mj)} mJ for each inference"),
            ("temperature", f"{self.temperature_c:.0f} degC in the end" + (": THROTTLES" if self.throttles else "")),
        ]

    def __str__(self) -> str:
        lines = [f"{what + ':':12} {value}" for what, value in self.rows()]
        return "\n".join(lines + [f"{'warning:':12} {text}" for text in self.warnings])

    def _repr_html_(self) -> str:
        body = "".join(
            f"<tr><th style='text-align:left'>{html.escape(what)}</th><td style='text-align:left'>"
            f"{html.escape(value)}</td></tr>"
            for what, value in self.rows()
        )
        notes = "".join(f"<li>{html.escape(text)}</li>" for text in self.warnings)
        from robotbrain.jetson.plots import plot_prediction, to_html

        figure = f"<details><summary>Roofline and timeline</summary>{to_html(plot_prediction(self))}</details>"
        return f"<table>{body}</table>" + (f"<ul>{notes}</ul>" if notes else "") + figure


def _short(value: float) -> str:
    return f"{value:.3g}" if value < 1000 else f"{value:.0f}"

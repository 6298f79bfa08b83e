"""Readings of a simulated Jetson: use from the simulation, power and temperature as the twin predicts them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from robotbrain.errors import InputError
from robotbrain.monitoring.resources.reading import Missing, Reading

if TYPE_CHECKING:
    from robotbrain.jetson.twin.runtime import Cooling
    from robotbrain.ros import SimContext

_NOT_MODELLED = Missing("the twin does not follow memory over time")


class TwinSource:
    """A simulated Jetson. Nothing of it is measured: use is simulated, power and temperature are predicted.

    Args:
        context: a simulation on a device.
        profile: the Jetson, as ``slug`` or ``slug:mode``.
        mode: its power mode; None for the default, or that of the profile.
        use: share of the GPU's peak that the network reaches while it runs, 0 to 1; None: what is typical.
        cooling: ``fan`` or ``passive``.
        ambient_c: of the air; a room by default.

    Raises:
        InputError: for a simulation without a device, or another name or range.
    """

    name = "twin"

    def __init__(
        self,
        context: SimContext,
        profile: str,
        mode: str | int | None = None,
        *,
        use: float | None = None,
        cooling: Cooling = "fan",
        ambient_c: float | None = None,
    ) -> None:
        from robotbrain.jetson.catalogue import load_module
        from robotbrain.jetson.profiles import load_profile
        from robotbrain.jetson.twin.calibrate import load_calibration
        from robotbrain.jetson.twin.power import TYPICAL_USE
        from robotbrain.jetson.twin.runtime import thermal_model

        if context.resources is None:
            raise InputError(
                "context",
                given="a simulation without a device",
                expected="one made with SimContext(resources=DeviceResources(...))",
                fix="drive() makes one: drive(..., attach=[lambda context: ...]).",
            )
        self._context, self._device = context, context.resources
        chosen = load_profile(profile, mode)
        self._module = load_module(chosen.slug)
        self._mode = self._module.mode(chosen.power_mode)
        self._use = TYPICAL_USE if use is None else use
        self._power = load_calibration().power
        self._thermal = thermal_model(self._module, cooling, ambient_c)
        self._temperature_c = self._thermal.steady_c(self._power_w(0.0, 0.0))
        self._hot = False
        self._last_ns, self._busy = context.now_ns, self._device.busy_ns
        self._share = dict.fromkeys(self._device.names, 0.0)

    def _power_w(self, gpu_busy: float, cores_busy: float) -> float:
        from robotbrain.jetson.twin.power import cpu_power_w

        return self._power.module_w(self._module, self._mode, self._use, gpu_busy) + cpu_power_w(self._mode, cores_busy)

    def read(self) -> Reading:
        """Return use since the last reading, and what power and temperature would be. Times are simulated."""
        now, busy = self._context.now_ns, self._device.busy_ns
        elapsed = now - self._last_ns
        if elapsed > 0:
            cores = {name: self._device.cpu_cores if name == "cpu" else 1 for name in busy}
            self._share = {name: (busy[name] - self._busy[name]) / (elapsed * cores[name]) for name in busy}
            self._last_ns, self._busy = now, busy
        power = self._power_w(self._share.get("gpu", 0.0), self._share["cpu"] * self._device.cpu_cores)
        if elapsed > 0:
            self._temperature_c = self._thermal.after(self._temperature_c, power, elapsed * 1e-9)
        # As the governor does: clocks go down at the trip point and rise again well below it.
        limit = self._thermal.throttle_c - (self._thermal.hysteresis_c if self._hot else 0.0)
        self._hot = self._temperature_c >= limit
        no_gpu = Missing("this device has no GPU")
        return Reading(
            time_s=now * 1e-9,
            source=self.name,
            cpu_percent=100 * self._share["cpu"],
            cpu_per_core_percent=Missing("the simulated processor shares its cores evenly"),
            memory_used_mb=_NOT_MODELLED,
            memory_total_mb=self._module.memory_gb * 2**30 / 1e6,
            process_rss_mb=_NOT_MODELLED,
            gpu_percent=100 * self._share["gpu"] if "gpu" in self._share else no_gpu,
            gpu_memory_used_mb=Missing("a Jetson's GPU shares the machine's memory"),
            gpu_memory_total_mb=Missing("a Jetson's GPU shares the machine's memory"),
            temperatures_c={"predicted": self._temperature_c},
            power_w=power,
            cpu_mhz=float(self._mode.cpu_mhz),
            gpu_mhz=float(self._mode.gpu_mhz),
            throttled=self._hot,
        )

    def close(self) -> None:
        """Do nothing: it holds nothing."""

"""Readings of a board's sensors while a network runs, whoever took them, and their summary.

Module power is read from the supply rails that INA3221 monitors sit on. Which rails make up the module differs:

========================  =======================================  ==================================================
family                    rails                                    source
========================  =======================================  ==================================================
Nano                      ``POM_5V_IN``                            module input; jetson_stats ``jtop/core/power.py``
TX2, Xavier NX, Orin NX,  ``VDD_IN``                               "the total power of module": NVIDIA developer forum,
Orin Nano                                                          topic 200883
AGX Xavier                ``GPU CPU SOC CV VDDRQ SYS5V``, summed   AGX Xavier design guide DG-09840, section 5.6.2:
                                                                   supplies beside each other, none contains another
AGX Orin                  ``VDD_GPU_SOC VDD_CPU_CV VIN_SYS_5V0``   Jetson Linux developer guide, Orin power monitors.
                                                                   ``VDDQ_VDD2_1V8AO`` (0.3 W) is left out: JetPack 6
                                                                   no longer reports it
AGX Thor                  ``VDD_GPU VDD_CPU_SOC_MSS VIN_SYS_5V0``  rails of tegrastats on Jetson Linux 38.4; ``VIN`` is
                                                                   the kit's input with its carrier board (NVIDIA
                                                                   developer forum, topic 366461), not the module
========================  =======================================  ==================================================
"""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime

from robotbrain.jetson.measured import Power

MODULE_RAILS: tuple[tuple[str, ...], ...] = (
    ("POM_5V_IN",),
    ("VDD_IN",),
    ("GPU", "CPU", "SOC", "CV", "VDDRQ", "SYS5V"),
    ("VDD_GPU_SOC", "VDD_CPU_CV", "VIN_SYS_5V0"),
    ("VDD_GPU", "VDD_CPU_SOC_MSS", "VIN_SYS_5V0"),
)
"""Rails that make up the module, by family (see the table above)."""

ON_THE_DIE = ("cpu", "gpu", "mcpu", "bcpu", "tj", "soc", "cv")
"""How names of sensors at the processors begin; others are the board's, constants (PMIC) or averages (thermal)."""


@dataclass(frozen=True)
class Sample:
    """One reading.

    Attributes:
        time: wall clock of the board, if known.
        rails_w: power by supply rail, W. Idle rails may read slightly below 0.
        temperatures_c: by sensor, degC; sensors that are powered off are left out.
        gpu_mhz, emc_mhz, cpu_mhz: clocks; the CPU's is the mean over the cores that are online.
        gpu_load: 0..1.
        ram_used_mb, ram_total_mb: MiB.
    """

    time: datetime | None = None
    rails_w: Mapping[str, float] = field(default_factory=dict)
    temperatures_c: Mapping[str, float] = field(default_factory=dict)
    gpu_mhz: float | None = None
    emc_mhz: float | None = None
    cpu_mhz: float | None = None
    gpu_load: float | None = None
    ram_used_mb: float | None = None
    ram_total_mb: float | None = None

    @property
    def module_rails(self) -> tuple[str, ...] | None:
        """The rails that make up the module, if all of a family's are there."""
        return next((rails for rails in MODULE_RAILS if all(rail in self.rails_w for rail in rails)), None)

    @property
    def module_w(self) -> float | None:
        """Power of the module, W, or None if its rails are not there."""
        rails = self.module_rails
        return None if rails is None else max(0.0, sum(self.rails_w[rail] for rail in rails))

    @property
    def die_c(self) -> float | None:
        """Temperature of the hottest sensor on the die, degC."""
        values = [value for name, value in self.temperatures_c.items() if name.casefold().startswith(ON_THE_DIE)]
        return max(values, default=None)


@dataclass(frozen=True)
class Telemetry:
    """Summary of readings; what no reading had is None."""

    samples: int
    power: Power | None
    temperature_mean_c: float | None
    temperature_peak_c: float | None
    gpu_mhz: float | None
    emc_mhz: float | None
    cpu_mhz: float | None
    system_memory_mb: float | None


def summarise(samples: Sequence[Sample], sampler: str) -> Telemetry:
    """Return means and peaks over readings taken at a steady rate."""
    measured = [(s.module_w, s.module_rails) for s in samples]
    rails = next((r for w, r in measured if w is not None), None)
    # A truncated line can lack a rail and match another family: only readings of the same rails are averaged.
    watts = [w for w, r in measured if w is not None and r == rails]
    power = Power(_mean(watts) or 0.0, round(max(watts), 3), len(watts), rails, sampler) if watts and rails else None
    heat = [s.die_c for s in samples if s.die_c is not None]
    return Telemetry(
        samples=len(samples),
        power=power,
        temperature_mean_c=_mean(heat),
        temperature_peak_c=max(heat, default=None),
        gpu_mhz=_mean(s.gpu_mhz for s in samples),
        emc_mhz=_mean(s.emc_mhz for s in samples),
        cpu_mhz=_mean(s.cpu_mhz for s in samples),
        system_memory_mb=max((s.ram_used_mb for s in samples if s.ram_used_mb is not None), default=None),
    )


def within(samples: Iterable[Sample], start: datetime, end: datetime) -> list[Sample]:
    """Return the readings with a time from ``start`` to ``end``, both included."""
    return [sample for sample in samples if sample.time is not None and start <= sample.time <= end]


def _mean(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return round(statistics.fmean(known), 3) if known else None

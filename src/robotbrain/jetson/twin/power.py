"""The power model: what a developer kit draws at the wall, and what of it the module draws.

At the wall, running a network without pause::

    W = rest + sum over (clock tree, arithmetic) of  c x cores x GHz x V^2 x (1, use)  +  m x memory GHz x bus bytes

``cores`` are CUDA cores that are on, V the relative voltage at the GPU's clock (assumed linear in it), ``use`` the
share of the peak that the network reaches. The coefficients are fitted, with priors, to the wall power of MLPerf's MaxQ
submissions (adapter, carrier board and idle included). Families without such rows take the prior.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from robotbrain.jetson.catalogue import Module, load_module
from robotbrain.jetson.modes import PowerMode
from robotbrain.jetson.twin.conditions import BYTES, conditions
from robotbrain.jetson.twin.data import PowerRow
from robotbrain.jetson.twin.runtime import runtime_figures

Array = NDArray[np.float64]

SUPPLY_EFFICIENCY = 0.88
"""Power that leaves the wall adapter over power that enters it (assumed: a typical external supply at part load)."""

TYPICAL_USE = 0.5
"""Share of the peak taken for networks whose kernels are not known (assumed: a large, dense network)."""

_PRIORS: tuple[tuple[str, float, float], ...] = (
    ("clock", math.log(3e-3), 0.7),  # W per CUDA core and GHz, at V = 1
    ("arithmetic", math.log(8e-3), 0.7),
    ("memory", math.log(0.4), 0.7),  # W per GHz and byte of bus width
)
_FAMILY_SD = 0.35
_REST_SD = 0.35
_NOISE = 0.1

PROCESS = {
    "maxwell": math.log(2.5),
    "pascal": math.log(2.0),
    "volta": math.log(1.5),
    "ampere": 0.0,
    "blackwell": math.log(0.5),
}
"""Prior log ratio of a core's dynamic power to Ampere's, by family (assumed, from the generations of silicon)."""


def relative_voltage(mode: PowerMode) -> float:
    """Return the GPU's voltage over that at 1.3 GHz (assumed linear in the clock; not published)."""
    return 0.55 + 0.45 * min(mode.gpu_mhz, 1800.0) / 1300.0


@dataclass(frozen=True)
class PowerFit:
    """Fitted coefficients, as logarithms.

    Attributes:
        values: by name: ``clock``, ``arithmetic``, ``memory``, ``family=...`` (on the first two), ``rest=<module>``,
            ``rest family=...`` (mean deviation of that from what the catalogue assumes).
        median_error: relative, leave-one-out; NaN if not computed.
    """

    values: Mapping[str, float]
    median_error: float = math.nan

    def wall_w(self, module: Module, mode: PowerMode, use: float, busy: float = 1.0) -> float:
        """Return the power at the wall, W.

        Args:
            module, mode: which, and its clocks.
            use: share of the dense peak while the GPU is busy, 0 to 1.
            busy: share of the time that the GPU is busy, 0 to 1.
        """
        get = self.values.get
        family = math.exp(get(f"family={module.family}", PROCESS[module.family]))
        cores = module.cuda_cores * mode.sms_on / module.sm_count
        dynamic = cores * mode.gpu_mhz / 1000 * relative_voltage(mode) ** 2 * family
        clock = math.exp(self.values["clock"]) * dynamic
        arithmetic = math.exp(self.values["arithmetic"]) * dynamic * min(max(use, 0.0), 1.0)
        memory = math.exp(self.values["memory"]) * mode.emc_mhz / 1000 * module.memory_bus_bits / 8
        # A module without rows is as far from what the catalogue assumes as its family's are.
        unseen = math.log(_rest_prior(module)) + get(f"rest family={module.family}", 0.0)
        rest = math.exp(get(f"rest={module.slug}", unseen))
        # At rest the clocks of GPU and memory are gated: half of the memory's power stays, a tenth of the clock tree's.
        return rest + busy * (clock + arithmetic + memory) + (1 - busy) * (0.1 * clock + 0.5 * memory)

    def module_w(self, module: Module, mode: PowerMode, use: float, busy: float = 1.0) -> float:
        """Return the power of the module alone, W: wall power less the supply's loss and the carrier board."""
        wall = self.wall_w(module, mode, use, busy)
        return max(SUPPLY_EFFICIENCY * wall - module.carrier_power_w, 0.5 * module.idle_power_w)


def cpu_power_w(mode: PowerMode, cores_busy: float) -> float:
    """Return what a number of busy CPU cores add to a module's power, W (assumed, see ``runtime.toml``).

    Args:
        mode: power mode, for the CPU's clock.
        cores_busy: cores at work on average, 0 or more.
    """
    core_w = runtime_figures()["power.cpu_core_w"].value
    ghz = mode.cpu_mhz / 1000
    # Voltage taken as linear in the clock, as for the GPU: 1 at 2 GHz.
    return core_w * max(0.0, cores_busy) * (ghz / 2) * (0.55 + 0.45 * ghz / 2) ** 2


def wall_from_module_w(module: Module, power_w: float) -> float:
    """Return the power at the wall, W, where the module's own is known (say, from its sensors)."""
    return (power_w + module.carrier_power_w) / SUPPLY_EFFICIENCY


def _rest_prior(module: Module) -> float:
    return wall_from_module_w(module, module.idle_power_w)


def use_of(row: PowerRow) -> float:
    """Return the share of the peak that a row's network reached: its FLOPs over its latency, or TYPICAL_USE."""
    if row.gflop is None or row.latency_ms is None or row.scenario != "SingleStream":
        return TYPICAL_USE
    where = conditions(load_module(row.module), row.mode, row.precision, "mlperf")
    peak = where.peak[list(BYTES).index(row.precision)]
    return min(1.0, 1e12 * row.gflop / row.latency_ms / peak)


def fit_power(rows: Sequence[PowerRow]) -> PowerFit:
    """Fit the model to rows of wall power."""
    modules = {row.module: load_module(row.module) for row in rows}
    families = sorted({module.family for module in modules.values()})
    names = [name for name, _, _ in _PRIORS]
    names += [f"family={family}" for family in families] + [f"rest={slug}" for slug in sorted(modules)]
    mean = [m for _, m, _ in _PRIORS] + [PROCESS[family] for family in families]
    mean += [math.log(_rest_prior(modules[slug])) for slug in sorted(modules)]
    sd = [s for _, _, s in _PRIORS] + [_FAMILY_SD] * len(families) + [_REST_SD] * len(modules)
    prior, spread = np.array(mean), np.array(sd)
    uses = [use_of(row) for row in rows]

    def residuals(values: Array) -> Array:
        fitted = PowerFit(dict(zip(names, (float(v) for v in values), strict=True)))
        errors = [
            math.log(fitted.wall_w(modules[row.module], row.mode, use) / row.wall_power_w) / _NOISE
            for row, use in zip(rows, uses, strict=True)
        ]
        # Robust: residuals beyond 1.5 count by their root.
        robust = [math.copysign(math.sqrt(4.5 * (math.hypot(1, e / 1.5) - 1)), e) for e in errors]
        return np.array([*robust, *((values - prior) / spread)])

    solution = least_squares(residuals, prior, xtol=1e-10, ftol=1e-10)
    values = dict(zip(names, (float(v) for v in solution.x), strict=True))
    for family in families:
        deviations = [
            values[f"rest={slug}"] - math.log(_rest_prior(module))
            for slug, module in modules.items()
            if module.family == family
        ]
        # Shrunk towards none, as if one more module had been just as assumed.
        values[f"rest family={family}"] = sum(deviations) / (len(deviations) + 1)
    return PowerFit(values)


def power_errors(rows: Sequence[PowerRow]) -> list[tuple[PowerRow, float]]:
    """Return each row with its relative error when its network is left out on its module."""
    result = []
    for unit in sorted({(row.module, row.network) for row in rows}):
        fitted = fit_power([row for row in rows if (row.module, row.network) != unit])
        module = load_module(unit[0])
        for row in rows:
            if (row.module, row.network) == unit:
                result.append((row, fitted.wall_w(module, row.mode, use_of(row)) / row.wall_power_w - 1))
    return result

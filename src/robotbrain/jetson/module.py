"""A Jetson module and what a power mode leaves of it.

Peaks are dense: two operations for each multiply-accumulate, no structured sparsity. A power mode caps clocks and
switches off CPU cores and streaming multiprocessors (SMs); peak and bandwidth scale with what it leaves.
"""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from dataclasses import dataclass

from robotbrain.errors import InputError
from robotbrain.jetson.figures import Figure, Statement
from robotbrain.jetson.modes import PowerMode, resolve_mode

FAMILIES = {"maxwell": 128, "pascal": 128, "volta": 64, "ampere": 128, "blackwell": 128}
"""FP32 lanes (CUDA cores) per SM by GPU family."""

CPU_UNIT = "7-Zip MIPS"
"""Unit of the CPU benchmark: rating of ``7z b -mmt=1`` of p7zip 16.02 (compression and decompression, one thread)."""

PRECISIONS = ("fp32", "tf32", "fp16", "int8")
"""Precisions a peak can be asked for."""


@dataclass(frozen=True)
class Module:
    """A Jetson module. The plain numbers repeat ``figures``, where each has its unit and its origin.

    Attributes:
        slug: short name, e.g. ``orin-nano-8gb``.
        name: full name.
        family: of the GPU, one of FAMILIES.
        architecture: of the GPU, in words.
        compute_capability: of the GPU, e.g. ``"8.7"``.
        sm_count, cuda_cores, tensor_cores: of the GPU.
        gpu_max_mhz: highest GPU clock.
        fp32_tflops: dense FP32 peak of the CUDA cores.
        tf32_tflops: dense TF32 peak of the tensor cores, None if they have none.
        fp16_tflops: dense FP16 peak, of the tensor cores where there are any.
        int8_tops: dense INT8 peak of the GPU, None where the GPU does not speed INT8 up.
        memory_gb: shared by CPU and GPU.
        memory_bus_bits, emc_max_mhz: width and clock of the memory bus (two transfers per clock).
        bandwidth_gbs: peak of the memory bus, GB/s.
        cpu: cores in words.
        cpu_cores, cpu_max_mhz: of the CPU.
        cpu_single_thread: single-thread benchmark of a core, at ``cpu_single_thread_mhz``.
        dla_count: deep-learning accelerators.
        dla_max_mhz: their highest clock, None without a DLA.
        dla_int8_tops: dense INT8 peak of all of them, None without a DLA.
        gpu_throttle_c, shutdown_c: temperatures at which clocks are lowered, and at which the module shuts down, degC.
        max_power_w: what the module is specified to draw at most.
        idle_power_w: what it draws at rest, without the carrier board.
        carrier_power_w: what carrier board and supply add at the wall.
        headline: performance as advertised.
        figures: every number, by its key in the file (``gpu.max_mhz`` ...).
        statements: every fact in words, by its key in the file.
        modes: power modes by name, as nvpmodel spells it.
        notes: what to beware of.
    """

    slug: str
    name: str
    family: str
    architecture: str
    compute_capability: str
    sm_count: int
    cuda_cores: int
    tensor_cores: int
    gpu_max_mhz: float
    fp32_tflops: float
    tf32_tflops: float | None
    fp16_tflops: float
    int8_tops: float | None
    memory_gb: float
    memory_bus_bits: int
    emc_max_mhz: float
    bandwidth_gbs: float
    cpu: str
    cpu_cores: int
    cpu_max_mhz: float
    cpu_single_thread: Figure
    cpu_single_thread_mhz: float
    dla_count: int
    dla_max_mhz: float | None
    dla_int8_tops: float | None
    gpu_throttle_c: float
    shutdown_c: float
    max_power_w: float
    idle_power_w: float
    carrier_power_w: float
    headline: str
    figures: Mapping[str, Figure]
    statements: Mapping[str, Statement]
    modes: Mapping[str, PowerMode]
    notes: tuple[str, ...] = ()

    @property
    def mode_names(self) -> tuple[str, ...]:
        """Names of the power modes in the order of their numbers."""
        return tuple(self.modes)

    @property
    def default_mode(self) -> PowerMode:
        """The power mode the module starts in."""
        return next(mode for mode in self.modes.values() if mode.default)

    @property
    def power_budget_w(self) -> float:
        """Budget of the default mode, or what the module draws at most where that mode has none."""
        watts = self.default_mode.watts
        return self.max_power_w if watts is None else watts

    @property
    def jetpacks(self) -> tuple[str, ...]:
        """JetPack releases that support the module, oldest first."""
        from robotbrain.jetson.software import jetpacks_for

        return tuple(release.version for release in jetpacks_for(self.slug))

    def mode(self, name: str | int | PowerMode | None = None) -> PowerMode:
        """Return a power mode by name, alias or number; None is the default mode (see modes.resolve_mode).

        Raises:
            InputError: for a name that fits no mode, or a mode of another module.
        """
        return resolve_mode(self.name, self.modes, name)

    def runs_as(self, precision: str) -> str:
        """Return the precision whose arithmetic the GPU uses when asked for ``precision``.

        INT8 falls back to FP16 where nothing speeds it up (Nano, TX2), and TF32 to FP32 before Ampere.

        Raises:
            InputError: for a precision that is not in PRECISIONS.
        """
        if precision not in PRECISIONS:
            near = difflib.get_close_matches(str(precision).lower(), PRECISIONS, n=1)
            raise InputError(
                "precision",
                given=precision,
                expected="one of " + ", ".join(PRECISIONS),
                fix=f"Did you mean {near[0]!r}?" if near else "Choose one of these.",
            )
        if precision == "int8" and self.int8_tops is None:
            return "fp16"
        if precision == "tf32" and self.tf32_tflops is None:
            return "fp32"
        return precision

    def highest_flops(self, precision: str) -> float:
        """Return the dense GPU peak at the highest clock with all SMs on, operations per second (see peak_flops).

        Raises:
            InputError: for an unknown precision.
        """
        tera = {
            "fp32": self.fp32_tflops,
            "tf32": self.tf32_tflops,
            "fp16": self.fp16_tflops,
            "int8": self.int8_tops,
        }[self.runs_as(precision)]
        assert tera is not None
        return tera * 1e12

    def peak_flops(self, precision: str, mode: str | int | PowerMode | None = None) -> float:
        """Return the dense GPU peak in a power mode, operations per second (two for each multiply-accumulate).

        Args:
            precision: one of PRECISIONS; see runs_as for what falls back to what.
            mode: power mode, None for the default mode.

        Raises:
            InputError: for an unknown precision or mode.
        """
        chosen = self.mode(mode)
        return self.highest_flops(precision) * (chosen.gpu_mhz / self.gpu_max_mhz) * (chosen.sms_on / self.sm_count)

    def dla_peak_flops(self, mode: str | int | PowerMode | None = None) -> float:
        """Return the dense INT8 peak of all DLAs in a power mode, operations per second; 0 without a DLA."""
        clock = self.mode(mode).dla_mhz
        if clock is None or self.dla_int8_tops is None or self.dla_max_mhz is None:
            return 0.0
        return self.dla_int8_tops * 1e12 * clock / self.dla_max_mhz

    def bandwidth(self, mode: str | int | PowerMode | None = None) -> float:
        """Return the peak of the memory bus in a power mode, bytes per second."""
        return self.bandwidth_gbs * 1e9 * self.mode(mode).emc_mhz / self.emc_max_mhz

    def cpu_score(self, mode: str | int | PowerMode | None = None) -> float:
        """Return the single-thread benchmark (CPU_UNIT) at a power mode's CPU clock: it scales with the clock."""
        return self.cpu_single_thread.value * self.mode(mode).cpu_mhz / self.cpu_single_thread_mhz

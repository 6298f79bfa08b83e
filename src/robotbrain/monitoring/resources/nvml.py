"""Readings of an NVIDIA GPU through NVML, the library that ``nvidia-smi`` reads too (package ``nvidia-ml-py``)."""

from __future__ import annotations

import contextlib
import importlib
import time
from typing import Any

from robotbrain.errors import MissingDependencyError, RobotBrainError
from robotbrain.monitoring.resources.reading import Missing, Reading, number_or_missing

_HELD_DOWN = 0x04 | 0x08 | 0x20 | 0x40 | 0x80
"""Reasons for lower clocks that mean heat or power: power cap, slowdowns by hardware and by software, power brake."""


class NvmlError(RobotBrainError):
    """NVML is there but does not work: no driver, no such GPU."""


class NvmlSource:
    """One GPU. (A Jetson's integrated GPU has no NVML before JetPack 7: use jtop or tegrastats there.)

    Args:
        index: which GPU.
        library: stands in for the ``pynvml`` module.

    Raises:
        MissingDependencyError: the package is not installed.
        NvmlError: it is, but there is no driver or no such GPU.
    """

    name = "nvml"

    def __init__(self, index: int = 0, library: Any = None) -> None:
        if library is None:
            try:
                library = importlib.import_module("pynvml")
            except ImportError as error:
                raise MissingDependencyError(
                    "nvidia-ml-py", needed_for="reading NVIDIA GPUs", install="pip install nvidia-ml-py"
                ) from error
        self._nvml = library
        try:
            library.nvmlInit()
            self._gpu = library.nvmlDeviceGetHandleByIndex(index)
        except Exception as error:
            raise NvmlError(f"NVML cannot read GPU {index}: {error}") from error

    def read(self) -> Reading:
        """Read now; what this GPU does not tell is missing."""
        nvml, gpu = self._nvml, self._gpu
        temperature = number_or_missing(
            lambda: nvml.nvmlDeviceGetTemperature(gpu, nvml.NVML_TEMPERATURE_GPU), "GPU temperature"
        )
        return Reading(
            time_s=time.monotonic(),
            source=self.name,
            gpu_percent=number_or_missing(lambda: nvml.nvmlDeviceGetUtilizationRates(gpu).gpu, "GPU use"),
            gpu_memory_used_mb=number_or_missing(lambda: nvml.nvmlDeviceGetMemoryInfo(gpu).used / 1e6, "GPU memory"),
            gpu_memory_total_mb=number_or_missing(lambda: nvml.nvmlDeviceGetMemoryInfo(gpu).total / 1e6, "GPU memory"),
            temperatures_c=temperature if isinstance(temperature, Missing) else {"GPU": temperature},
            power_w=number_or_missing(lambda: nvml.nvmlDeviceGetPowerUsage(gpu) / 1e3, "GPU power"),
            gpu_mhz=number_or_missing(lambda: nvml.nvmlDeviceGetClockInfo(gpu, nvml.NVML_CLOCK_SM), "GPU clock"),
            throttled=self._throttled(),
        )

    def _throttled(self) -> bool | Missing:
        # Drivers of 2023 and later call the reasons events.
        name = "nvmlDeviceGetCurrentClocksEventReasons"
        ask = getattr(self._nvml, name, None) or self._nvml.nvmlDeviceGetCurrentClocksThrottleReasons
        try:
            return bool(int(ask(self._gpu)) & _HELD_DOWN)
        except Exception as error:
            return Missing(f"GPU throttling: {error}")

    def close(self) -> None:
        """Let go of the library."""
        with contextlib.suppress(Exception):
            self._nvml.nvmlShutdown()

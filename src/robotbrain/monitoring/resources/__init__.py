"""What the machine is doing: processors, memory, temperatures, power, behind one interface.

::

    with Sampler(local_source(), period_s=0.5) as sampler:
        ...
        print(sampler.latest)

Sources: psutil everywhere; NVML where there is an NVIDIA GPU with its driver; jtop or tegrastats on a Jetson; the twin
for a simulated Jetson. (The GPUtil package, which many tutorials name, has had no release since 2018 and calls
``nvidia-smi`` for every reading; NVML is what that program itself reads.) What a source cannot read is
:class:`Missing`, with the reason, and never 0.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from robotbrain.monitoring.resources.reading import UNITS, Missing, Reading, Source, merge
from robotbrain.monitoring.resources.sampler import Sampler

if TYPE_CHECKING:
    from robotbrain.monitoring.resources.host import PsutilSource
    from robotbrain.monitoring.resources.jetson import JtopSource, TegrastatsSource
    from robotbrain.monitoring.resources.local import Combined, local_source
    from robotbrain.monitoring.resources.nvml import NvmlSource
    from robotbrain.monitoring.resources.twin import TwinSource

__all__ = [
    "UNITS",
    "Combined",
    "JtopSource",
    "Missing",
    "NvmlSource",
    "PsutilSource",
    "Reading",
    "Sampler",
    "Source",
    "TegrastatsSource",
    "TwinSource",
    "local_source",
    "merge",
]

_HOMES = {
    "host": ("PsutilSource",),
    "jetson": ("JtopSource", "TegrastatsSource"),
    "local": ("Combined", "local_source"),
    "nvml": ("NvmlSource",),
    "twin": ("TwinSource",),
}


def __getattr__(name: str) -> Any:
    for home, names in _HOMES.items():
        if name in names:
            return getattr(importlib.import_module(f"{__name__}.{home}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)

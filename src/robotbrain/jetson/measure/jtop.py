"""Readings through jtop (the ``jetson-stats`` package and its service), where a board has it.

jtop 4 gives nested mappings: ``power["rail"][name]["power"]`` and ``power["tot"]`` in mW,
``temperature[name]["temp"]`` in degC, ``gpu[name]["freq"]["cur"]`` in kHz and ``memory["RAM"]["used"]`` in KiB.
"""

from __future__ import annotations

import importlib
import statistics
from collections.abc import Mapping
from typing import Any

from robotbrain.jetson.measure.samples import Sample


def read(power: object, temperature: object, gpu: object, memory: object, cpu: object = None) -> Sample:
    """Return the reading in jtop's mappings; whatever is not of the form above is left out."""
    rails = {name: _number(rail, "power") for name, rail in _items(_get(power, "rail"))}
    total = _get(power, "tot")
    name = _get(total, "name")  # the rail that jtop took for the total; it is missing from the others then
    if isinstance(name, str):
        rails[name] = _number(total, "power")
    heat = {
        sensor: _number(value, "temp") for sensor, value in _items(temperature) if _get(value, "online") is not False
    }
    chips = [chip for _, chip in _items(gpu)]
    load = next((x for chip in chips if (x := _number(_get(chip, "status"), "load")) is not None), None)
    clocks = [mhz for chip in chips if (mhz := _number(_get(chip, "freq"), "cur")) is not None]
    cores = _get(cpu, "cpu")
    core_clocks = [
        khz
        for core in (cores if isinstance(cores, list) else [])
        if _get(core, "online") and (khz := _number(_get(core, "freq"), "cur")) is not None
    ]
    ram = _get(memory, "RAM")
    used, whole, emc = _number(ram, "used"), _number(ram, "tot"), _number(_get(memory, "EMC"), "cur")
    return Sample(
        rails_w={rail: mw / 1000 for rail, mw in rails.items() if mw is not None},
        temperatures_c={sensor: c for sensor, c in heat.items() if c is not None and c > -200},
        gpu_mhz=max(clocks) / 1000 if clocks and max(clocks) > 0 else None,
        emc_mhz=emc / 1000 if emc else None,
        cpu_mhz=statistics.fmean(core_clocks) / 1000 if core_clocks else None,
        gpu_load=None if load is None else min(1.0, load / 100),
        ram_used_mb=None if used is None else used / 1024,
        ram_total_mb=None if whole is None else whole / 1024,
    )


def connect() -> Any | None:
    """Return a started jtop client, or None if the package is missing or its service does not answer."""
    try:
        client = importlib.import_module("jtop").jtop(interval=0.2)
        client.start()
        return client if client.ok() else None
    except Exception:  # jtop raises its own errors, and OSError where its socket is not there
        return None


def poll(client: Any) -> Sample:
    """Return what a started client last received."""
    return read(client.power, client.temperature, client.gpu, client.memory, getattr(client, "cpu", None))


def _get(value: object, key: str) -> object:
    return value.get(key) if isinstance(value, Mapping) else None


def _items(value: object) -> list[tuple[str, object]]:
    return [(str(name), item) for name, item in value.items()] if isinstance(value, Mapping) else []


def _number(value: object, key: str) -> float | None:
    found = _get(value, key)
    return float(found) if isinstance(found, int | float) and not isinstance(found, bool) else None

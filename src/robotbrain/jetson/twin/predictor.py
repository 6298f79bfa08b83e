"""Predicting a network on a module: the twin's front door."""

from __future__ import annotations

import functools
import hashlib
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from robotbrain.errors import InputError
from robotbrain.jetson import measured
from robotbrain.jetson.catalogue import list_modules, load_module
from robotbrain.jetson.kernels import KernelGraph
from robotbrain.jetson.modes import PowerMode
from robotbrain.jetson.module import Module
from robotbrain.jetson.software import compatible
from robotbrain.jetson.twin.calibrate import Calibration, load_calibration
from robotbrain.jetson.twin.conditions import PRECISIONS, RELATIVES, Conditions, check_choice, conditions
from robotbrain.jetson.twin.latency import Batch, Work, explicit_precision, kernel_precisions, make_work
from robotbrain.jetson.twin.power import wall_from_module_w
from robotbrain.jetson.twin.prediction import KernelTime, Prediction
from robotbrain.jetson.twin.runtime import MemoryUse, memory_use, thermal_model
from robotbrain.jetson.twin.validate import Z80

__all__ = ["as_graph", "compare", "predict"]


def as_graph(model: Any, bindings: Mapping[str, int] | None = None) -> KernelGraph:
    """Return the kernels of a network.

    Args:
        model: path or bytes of an ONNX file, an ``onnx.ModelProto``, a KernelGraph, or a list of kernels as plain
            mappings (see KernelGraph.from_list).
        bindings: lengths of dynamic axes by name (see jetson.graph.analyse).

    Raises:
        InputError: for a file that cannot be analysed, or a list that is not one of kernels.
    """
    from robotbrain.jetson.graph import analyse

    if isinstance(model, KernelGraph):
        return model
    if isinstance(model, list | tuple):
        return KernelGraph.from_list(model)
    try:
        key = tuple(sorted((bindings or {}).items()))
        hash(key)
    except (AttributeError, TypeError):  # no bindings at all: the analyser says what is wrong with them
        return analyse(model, bindings=bindings)
    if isinstance(model, str | Path) and Path(model).is_file():
        path = Path(model).resolve()
        if path.stat().st_size > 2**31:
            return analyse(path, bindings=bindings)  # which refuses it in good order
        with path.open("rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
        return _analysed(path, digest, key)
    return analyse(model, bindings=bindings)


@functools.lru_cache(maxsize=32)
def _analysed(path: Path, _digest: str, bindings: tuple[tuple[str, int], ...]) -> KernelGraph:
    from robotbrain.jetson.graph import analyse

    return analyse(path, bindings=dict(bindings) or None)


def predict(
    model: Any,
    device: str | Module,
    *,
    mode: str | int | PowerMode | None = None,
    precision: str = "fp16",
    harness: str = "trtexec",
    batch: int = 1,
    bindings: Mapping[str, int] | None = None,
    calibration: Calibration | None = None,
) -> Prediction:
    """Predict latency, memory, power and temperature of a network on a Jetson module.

    A measured profile of the same file under the same conditions takes precedence over the model's latency (and over
    its power and memory, where it has them).

    Args:
        model: see :func:`as_graph`.
        device: slug of the module, or the module.
        mode: power mode by name, alias or number; the module's default mode if None.
        precision: ``fp32``, ``fp16`` or ``int8`` (whole network; Q/DQ nodes in the model go first).
        harness: kind of timing to predict, one of twin.conditions.HARNESSES.
        batch: inputs in one inference, 1 or more; multiplies a graph of one input.
        bindings: lengths of the model's dynamic axes.
        calibration: another than the stored one.

    Raises:
        InputError: for anything unknown, out of range or unreadable.
    """
    module = device if isinstance(device, Module) else load_module(device)
    power_mode = module.mode(mode)
    asked = check_choice("precision", precision, PRECISIONS)
    where = conditions(module, power_mode, asked, harness)
    single = as_graph(model, bindings)
    graph = single.at_batch(batch)
    if not graph.kernels:
        raise InputError(
            f"network {graph.name!r}", given="no kernels", expected="at least one", fix="It has nothing to compute."
        )
    fitted = calibration or load_calibration()
    work = make_work(graph, where)
    kernels, fixed_ms = _kernel_times(graph, work, where, fitted)
    latency = fixed_ms + sum(kernel.total_ms for kernel in kernels)
    spread = math.exp(Z80 * fitted.scale * fitted.latency.log_sd(work, where))
    low, high, provenance = latency / spread, latency * spread, "predicted"
    sources: tuple[str, ...] = ("kit:twin calibrated on published latencies, autograder/profiles/calibration",)
    memory = memory_use(graph, module, where.precision)
    use = 2e3 * graph.macs / latency / where.peak[PRECISIONS.index(where.precision)]
    power_w, wall_w = fitted.power.module_w(module, power_mode, use), fitted.power.wall_w(module, power_mode, use)
    found = _measured(graph.sha256, module.slug, power_mode.name, asked, where.harness, batch)
    if found is not None:
        latency = low = high = found.latency_ms
        provenance, sources = "measured", (found.source,)
        if found.power is not None:
            power_w = found.power.mean
            wall_w = wall_from_module_w(module, power_w)
        if found.memory_mb is not None:
            engine_mb = found.memory_mb * 2**20 / 1e6
            memory = MemoryUse(engine_mb, 0.0, memory.context_mb, memory.available_mb, memory.building_mb)
    heat = thermal_model(module)
    temperature = heat.steady_c(power_w)
    dla = sum(k.macs for k in graph.kernels if not k.dla_reason) / max(1, graph.macs) if module.dla_count else 0.0
    return Prediction(
        model=graph.name,
        device=module.slug,
        mode=power_mode.name,
        precision=asked,
        harness=where.harness,
        batch=batch,
        latency_ms=latency,
        latency_low_ms=low,
        latency_high_ms=high,
        macs=graph.macs,
        memory=memory,
        power_w=power_w,
        wall_power_w=wall_w,
        temperature_c=temperature,
        throttles=temperature >= heat.throttle_c,
        provenance=provenance,
        sources=sources,
        warnings=_warnings(graph, module, power_mode, asked, where, fitted, memory, power_w, kernels, provenance),
        kernels=kernels,
        fixed_ms=fixed_ms,
        dla_share=dla,
        graph=graph,
        module=module,
        power_mode=power_mode,
        where=where,
    )


def compare(
    model: Any,
    devices: Sequence[str | Module] | None = None,
    *,
    precision: str = "fp16",
    harness: str = "trtexec",
    batch: int = 1,
    bindings: Mapping[str, int] | None = None,
    modes: str = "default",
) -> list[Prediction]:
    """Predict one network on several modules.

    Args:
        model: see :func:`as_graph`.
        devices: slugs; all modules if None.
        precision, harness, batch, bindings: see :func:`predict`.
        modes: ``"default"``, ``"fastest"`` or ``"all"`` power modes of each.

    Raises:
        InputError: as :func:`predict`.
    """
    from robotbrain.jetson.twin.data import fastest_mode

    modes = check_choice("modes", modes, ("default", "fastest", "all"))
    chosen_devices = [devices] if isinstance(devices, str | Module) else devices
    graph = as_graph(model, bindings)
    predictions = []
    for device in list_modules() if chosen_devices is None else chosen_devices:
        module = device if isinstance(device, Module) else load_module(device)
        chosen = {
            "default": [module.default_mode],
            "fastest": [fastest_mode(module)],
            "all": list(module.modes.values()),
        }[modes]
        for mode in chosen:
            predictions.append(predict(graph, module, mode=mode, precision=precision, harness=harness, batch=batch))
    return predictions


def _kernel_times(
    graph: KernelGraph, work: Work, where: Conditions, calibration: Calibration
) -> tuple[tuple[KernelTime, ...], float]:
    theta = calibration.latency.parameters([where])
    compute, memory, launch = Batch([work], [where]).kernel_ms(theta)
    total = np.hypot(compute, memory) + launch
    precision = kernel_precisions(graph, where)
    times = tuple(
        KernelTime(
            kernel,
            compute_ms=float(compute[i]),
            memory_ms=float(memory[i]),
            launch_ms=float(launch[i]),
            total_ms=float(total[i]),
            flops=float(work.flops[i]),
            bytes_moved=float(work.bytes_moved[i]),
            precision=PRECISIONS[precision[i]],
        )
        for i, kernel in enumerate(graph.kernels)
    )
    return times, float(np.exp(theta["fixed"][0]))


def _measured(
    sha256: str, slug: str, mode: str, precision: str, harness: str, batch: int
) -> measured.MeasuredProfile | None:
    if not sha256:
        return None
    for cuda_graph in (False, True):
        found = measured.find(sha256, slug, mode, precision, harness, batch, cuda_graph=cuda_graph)
        if found is not None:
            return found
    return None


def _warnings(
    graph: KernelGraph,
    module: Module,
    mode: PowerMode,
    asked: str,
    where: Conditions,
    calibration: Calibration,
    memory: MemoryUse,
    power_w: float,
    kernels: Sequence[KernelTime],
    provenance: str,
) -> tuple[str, ...]:
    notes = list(graph.warnings)
    if asked != where.precision:
        notes.append(f"{module.name} has no fast {asked.upper()}: TensorRT runs such an engine in FP16")
    if module.int8_tops is None and explicit_precision(graph):
        notes.append(f"TensorRT refuses Q/DQ nodes on {module.name}: export the network without them")
    elif asked == "int8" and explicit_precision(graph):
        notes.append("INT8 between the model's Q/DQ nodes only; the rest runs in FP16")
    if not memory.fits:
        notes.append(
            f"out of memory: it needs {memory.total_mb:.0f} MB and the module leaves {memory.available_mb:.0f} MB"
        )
    elif not memory.builds:
        notes.append(
            f"building the engine on the module itself needs about {memory.building_mb:.0f} MB of "
            f"{memory.available_mb:.0f} MB: expect to run out of memory, add swap"
        )
    if graph.opset:
        verdict = compatible(graph.opset, module.slug)
        if not verdict.ok:
            notes.append(verdict.advice)
    if mode.watts is not None and power_w > 1.1 * mode.watts:
        notes.append(f"more than the mode's budget of {mode.watts:g} W: a real module lowers its clocks")
    if provenance == "predicted":
        notes += _caveats(module, where, calibration, kernels)
    return tuple(dict.fromkeys(notes))


def _caveats(module: Module, where: Conditions, calibration: Calibration, kernels: Sequence[KernelTime]) -> list[str]:
    notes = []
    families = {family for family, _, _ in calibration.measured}
    if module.family not in families:
        notes.append(
            f"nothing published was measured on GPUs of the {module.family} family: it is taken to behave as "
            f"{RELATIVES.get(module.family, 'others')} does, and the interval is a guess"
        )
    elif (module.family, where.precision, where.harness) not in calibration.measured:
        notes.append(
            f"no calibration row of {where.harness} in {where.precision} on GPUs of the {module.family} family: "
            "carried over from others, hence the wide interval"
        )
    total = sum(kernel.total_ms for kernel in kernels)
    products = sum(k.total_ms for k in kernels if k.kernel.op == "mm")
    if len(kernels) > 20 and products > 0.5 * total:
        notes.append("mostly matrix products: transformers are hardly represented in the calibration, expect 30-60 %")
    return notes

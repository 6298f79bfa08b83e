"""The same brain on several Jetsons: what the hardware changes about how it drives."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from robotbrain.errors import InputError
from robotbrain.jetson.paths import find_part
from robotbrain.jetson.profiles import PRECISION
from robotbrain.pipeline.deployment import Deployment

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from robotbrain.pipeline.brain import RunResult

DEVICES = ("nano-4gb:5W", "nano-4gb:MAXN", "xavier-nx:15W", "orin-nano-8gb:15W", "agx-orin-64gb:MAXN")
"""Modules and power modes of the comparison, from small to large."""

TIME_LIMIT = 90.0
"""A run of the comparison that has not ended by then has failed, s (a quick brain takes about 25)."""


def detector_deployment(*, one_thread: bool = True) -> Deployment:
    """Return a deployment as on a real robot: a 640x480 camera, and a network of ResNet-50's size.

    The simulator's camera stays small and the kit's own network labels its images; what they cost is that of the
    larger ones. The network stands in for a typical detector's backbone.

    Args:
        one_thread: all nodes in one process under one ``rclpy.spin``, as a first brain is often written.
    """
    return Deployment(image_size=(640, 480), network=find_part("networks/resnet50.onnx"), one_thread=one_thread)


@dataclass(frozen=True)
class DeviceSummary:
    """How a brain drove on one Jetson over several worlds.

    Attributes:
        profile, power_mode: the Jetson.
        name: of the module.
        label: what else is special about it, may be empty.
        runs: how many worlds.
        successes: how many of them it solved.
        network_ms: latency of its network.
        control_hz: commands per second, median over the runs.
        e2e_p50_ms, e2e_p99_ms: end-to-end latency, sensor to actuator, over all commands of all runs.
        seconds: simulated time of a run, median.
        power_w: of the module while it drives, mean over the runs.
        energy_j_per_m: of the module for each metre driven, over all runs.
        reasons: why runs failed.
        results: the runs.
    """

    profile: str
    power_mode: str
    name: str
    label: str
    runs: int
    successes: int
    network_ms: float
    control_hz: float
    e2e_p50_ms: float
    e2e_p99_ms: float
    seconds: float
    power_w: float
    energy_j_per_m: float
    reasons: tuple[str, ...]
    results: tuple[RunResult, ...]

    @property
    def success_rate(self) -> float:
        """Share of worlds solved."""
        return self.successes / self.runs


def run_power_w(
    run: RunResult, network: Path, image_size: tuple[int, int] | None = None, precision: str = PRECISION
) -> float:
    """Return the mean power of the module during a run, W: GPU and memory by the twin, CPU cores on top (assumed).

    Args:
        run: with the share of time that each resource was busy.
        network: whose inferences kept the GPU busy.
        image_size: (width, height) of its images, None for the network's own.
        precision: that it runs in.
    """
    from robotbrain.jetson.catalogue import load_module
    from robotbrain.jetson.resize import at_image_size
    from robotbrain.jetson.twin import predict
    from robotbrain.jetson.twin.calibrate import load_calibration
    from robotbrain.jetson.twin.power import cpu_power_w

    module = load_module(run.profile)
    mode = module.mode(run.power_mode)
    model = network if image_size is None else at_image_size(network, image_size)
    found = predict(model, module, mode=mode, precision=precision)
    use = found.baseline_ms / found.latency_ms
    cores = run.busy.get("cpu", 0.0) * mode.cpu_online
    gpu_w = load_calibration().power.module_w(module, mode, use, run.busy.get("gpu", 0.0))
    return gpu_w + cpu_power_w(mode, cores)


def summarise(runs: Sequence[RunResult], deployment: Deployment | None = None, *, label: str = "") -> DeviceSummary:
    """Return the summary of runs on one Jetson.

    Raises:
        InputError: for no runs, or runs on different Jetsons.
    """
    from robotbrain.jetson.catalogue import load_module
    from robotbrain.jetson.profiles import load_profile
    from robotbrain.pipeline.brain import default_model

    places = {(run.profile, run.power_mode) for run in runs}
    if len(places) != 1:
        raise InputError(
            "runs", given=sorted(places), expected="runs on one Jetson in one mode", fix="Summarise each by itself."
        )
    slug, mode = places.pop()
    deployed = deployment or Deployment()
    network = Path(deployed.network or default_model())
    profile = load_profile(slug, mode)
    power = [run_power_w(run, network, deployed.image_size, deployed.precision) for run in runs]
    energy = sum(watts * run.seconds for watts, run in zip(power, runs, strict=True))
    metres = sum(run.path_length for run in runs)
    latencies = np.concatenate([run.e2e_ms for run in runs])
    return DeviceSummary(
        profile=slug,
        power_mode=mode,
        name=load_module(slug).name,
        label=label,
        runs=len(runs),
        successes=sum(run.success for run in runs),
        network_ms=profile.network_ms(network, deployed.precision, deployed.image_size),
        control_hz=float(np.median([run.control_hz for run in runs])),
        e2e_p50_ms=_percentile(latencies, 50),
        e2e_p99_ms=_percentile(latencies, 99),
        seconds=float(np.median([run.seconds for run in runs])),
        power_w=float(np.mean(power)),
        energy_j_per_m=energy / metres if metres else math.inf,
        reasons=tuple(run.reason for run in runs if not run.success),
        results=tuple(runs),
    )


def _percentile(values: NDArray[np.float64], percent: float) -> float:
    return float(np.percentile(values, percent)) if len(values) else math.nan


def compare_devices(
    seeds: Iterable[int],
    profiles: Sequence[str] = DEVICES,
    *,
    deployment: Deployment | None = None,
    time_limit: float = TIME_LIMIT,
    label: str = "",
    progress: Callable[[RunResult], None] | None = None,
) -> list[DeviceSummary]:
    """Drive the same worlds with the same brain on each Jetson.

    Args:
        seeds: of the worlds.
        profiles: Jetsons, as ``slug`` or ``slug:mode``.
        deployment: detector_deployment() if None.
        time_limit: of each run, s.
        label: for the summaries.
        progress: called after each run.
    """
    from robotbrain.pipeline.brain import drive

    deployed = deployment or detector_deployment()
    worlds = list(seeds)
    summaries = []
    for profile in profiles:
        runs = []
        for seed in worlds:
            run = drive(seed, profile=profile, deployment=deployed, time_limit=time_limit)
            runs.append(run)
            if progress is not None:
                progress(run)
        summaries.append(summarise(runs, deployed, label=label))
    return summaries


def plot_devices(summaries: Sequence[DeviceSummary]) -> tuple[Figure, str]:
    """Return a figure of end-to-end latency and success by device, and its alternative text."""
    from robotbrain.figures import BLUE, GREEN, SKY, new_figure

    names = [f"{s.name.removeprefix('Jetson ')}, {s.power_mode}" + (f"\n{s.label}" * bool(s.label)) for s in summaries]
    rows = np.arange(len(summaries))[::-1]
    figure = new_figure(11, 0.62 * len(summaries) + 1.2)
    left, right = figure.subplots(1, 2, sharey=True, width_ratios=(3, 2))
    left.barh(rows, [s.e2e_p99_ms for s in summaries], color=BLUE, label="99th percentile")
    left.barh(rows, [s.e2e_p50_ms for s in summaries], height=0.35, color=SKY, label="median")
    left.set(yticks=rows, yticklabels=names, xlabel="sensor to command (ms, simulated)")
    left.legend(loc="center right")
    right.barh(rows, [100 * s.success_rate for s in summaries], color=GREEN)
    right.set(xlim=(0, 119), xticks=range(0, 101, 25), xlabel="worlds solved (%)")
    for row, s in zip(rows, summaries, strict=True):
        right.text(100 * s.success_rate + 2, row, f"{s.successes} of {s.runs}", va="center")
    for axes in (left, right):
        axes.spines[["top", "right"]].set_visible(False)
    alt = "; ".join(
        f"{s.name} in {s.power_mode}{', ' + s.label if s.label else ''}: median {s.e2e_p50_ms:.0f} ms, 99th percentile "
        f"{s.e2e_p99_ms:.0f} ms, {s.successes} of {s.runs} worlds solved"
        for s in summaries
    )
    return figure, f"End-to-end latency and success by Jetson. {alt}."


def table(summaries: Sequence[DeviceSummary]) -> str:
    """Return a comparison as text."""
    head = ("module", "mode", "", "network ms", "control Hz", "e2e p50 ms", "p99 ms", "reached", "W", "J/m")
    rows = [
        (
            s.profile,
            s.power_mode,
            s.label,
            f"{s.network_ms:.1f}",
            f"{s.control_hz:.1f}",
            f"{s.e2e_p50_ms:.0f}",
            f"{s.e2e_p99_ms:.0f}",
            f"{s.successes}/{s.runs}",
            f"{s.power_w:.1f}",
            f"{s.energy_j_per_m:.0f}",
        )
        for s in summaries
    ]
    widths = [max(len(row[i]) for row in [head, *rows]) for i in range(len(head))]
    lines = []
    for row in [head, *rows]:
        cells = [c.ljust(w) if i < 3 else c.rjust(w) for i, (c, w) in enumerate(zip(row, widths, strict=True))]
        lines.append("  ".join(cells).rstrip())
    return "\n".join(lines)

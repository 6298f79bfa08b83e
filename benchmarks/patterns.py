"""The same brain arranged in different ways on a Jetson: simulated on nodes against closed forms.

Run: ``python benchmarks/patterns.py [--profile orin-nano-8gb:15W] [--camera-hz 30] [--kit]``. The brain is the kit's
with a 640x480 camera and a network of ResNet-50's size (``--kit``: with the simulator's small camera and the shipped
network). All times are simulated; ``err``: the simulation against the closed form, or against the bound.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from robotbrain.jetson.profiles import load_profile
from robotbrain.pipeline.devices import detector_deployment
from robotbrain.pipeline.patterns.brains import run_brain
from robotbrain.pipeline.patterns.budgets import make_budget
from robotbrain.pipeline.patterns.forms import ClosedForm, closed_form
from robotbrain.pipeline.patterns.queues import queue_form, run_queue
from robotbrain.pipeline.patterns.queues import table as queue_table
from robotbrain.pipeline.patterns.results import PatternResult
from robotbrain.pipeline.patterns.stages import Stage, brain_stages, split_stage

SECONDS = 30.0


def print_stages(stages: Sequence[Stage]) -> None:
    """What one update() of the outline's loop takes, step by step."""
    print(f"{'update(), step':<22}{'resource and ms':<40}{'ms':>8}{'done at':>9}")
    done = 0.0
    for number, stage in enumerate(stages, start=1):
        done += stage.ms
        parts = ", ".join(f"{resource} {length / 1e6:.2f}" for resource, length in stage.segments)
        print(f"{number} {stage.name:<20}{parts:<40}{stage.ms:>8.2f}{done:>9.2f}")
    slowest = max(stages, key=lambda stage: stage.ns)
    print(f"sum {done:.2f} ms: at most {1000 / done:.1f} updates/s in turn; ", end="")
    print(f"slowest {slowest.name} {slowest.ms:.2f} ms: at most {1000 / slowest.ms:.1f}/s in a pipeline\n")


def percent(simulated: float, theory: float) -> float:
    """Deviation of the simulation from theory, %."""
    return 100 * (simulated / theory - 1)


def print_row(name: str, run: PatternResult, form: ClosedForm) -> float:
    """One brain; return its largest error, %, of throughput, latency and age."""
    pairs = [
        (run.throughput_hz, form.throughput_hz),
        (float(run.latency_ms.mean()), form.latency_ns / 1e6),
        (run.mean_age_ms, form.mean_age_ns / 1e6),
    ]
    cells = "".join(f"{got:>9.2f}{theory:>9.2f}{percent(got, theory):>7.2f}" for got, theory in pairs)
    lost = 100 * sum(run.drops.values()) / run.frames
    print(
        f"{name:<30}{cells}{run.peak_age_ms:>10.1f}{lost:>8.0f}{100 * run.busy['cpu']:>6.0f}"
        f"{100 * run.busy['gpu']:>6.0f}  {form.accuracy}, {form.limited_by}"
    )
    return max(abs(percent(*pair)) for pair in pairs)


def print_brains(stages: Sequence[Stage], profile: str, camera_hz: float) -> None:
    """Brains on one profile at one camera rate."""
    device = load_profile(profile)
    cases: list[tuple[str, str, Sequence[Stage], int]] = [
        ("sequential: update()", "sequential", stages, 1),
        ("pipelined", "pipelined", stages, 1),
        ("pipelined, perception split", "pipelined", split_stage(stages, "perception"), 1),
        ("pipelined, 2 in perception", "pipelined", stages, 2),
        ("parallel, control 50 Hz", "parallel", stages, 1),
        ("parallel, 2 in perception", "parallel", stages, 2),
    ]
    print(f"{device.name}, {device.power_mode}, {device.cpu_cores} cores; camera {camera_hz:g} Hz, {SECONDS:g} s")
    groups = "".join(f"{name:>25}" for name in ("frames/s", "latency ms", "mean age ms"))
    print(f"{'':<30}{groups}{'peak age':>10}{'lost':>8}{'busy %':>12}")
    print(f"{'':<30}" + f"{'simul.':>9}{'closed':>9}{'err %':>7}" * 3 + f"{'ms':>10}{'%':>8}{'CPU':>6}{'GPU':>6}  form")
    runs: dict[str, PatternResult] = {}
    worst, exact = 0.0, True
    for name, kind, parts, at_once in cases:
        run = run_brain(
            kind,  # type: ignore[arg-type]
            parts,
            device,
            camera_hz=camera_hz,
            seconds=SECONDS,
            frames_at_once=at_once,
        )
        form = closed_form(kind, parts, device, run.period_ns, frames_at_once=at_once)
        error = print_row(name, run, form)
        runs[name] = run
        if len(runs) <= 2:
            worst = max(worst, error)
            exact = exact and form.accuracy == "exact"
    one, other = runs["sequential: update()"], runs["pipelined"]
    print(
        f"pipelined against sequential: {other.throughput_hz / one.throughput_hz:.2f} x the frames/s, latency "
        f"{one.latency_ms.mean():.1f} -> {other.latency_ms.mean():.1f} ms, mean age {one.mean_age_ms:.1f} -> "
        f"{other.mean_age_ms:.1f} ms, peak age {one.peak_age_ms:.1f} -> {other.peak_age_ms:.1f} ms; "
        + (f"largest error {worst:.2f} %\n" if exact else "shared cores: closed forms are bounds\n")
    )


def print_queues() -> None:
    """Queue policies under overload, and their closed forms."""
    period, service = round(1e9 / 30), 45_000_000
    print("queue policies: 30 frames/s of 640x480, 45 ms for each, 10 s")
    found = [
        run_queue(policy, service_ms=45.0, seconds=10.0, capacity=capacity)  # type: ignore[arg-type]
        for policy, capacity in (
            ("keep_all", 1),
            ("keep_last", 10),
            ("keep_last", 1),
            ("drop_newest", 10),
            ("drop_newest", 1),
            ("throttle", 1),
            ("skip", 1),
            ("credit", 1),
        )
    ]
    lines = queue_table(found).splitlines()
    print(lines[0] + "   closed form: latency, largest, peak age")
    for line, run in zip(lines[1:], found, strict=True):
        form = queue_form(run.policy, period, service, run.capacity)  # type: ignore[arg-type]
        theory = f"{form.latency_ms:9.1f}{form.latency_max_ms:9.1f}{form.peak_age_ms:9.1f}"
        if form.growth:
            theory = f"  grows by {1000 * form.growth:.0f} ms each second without end"
        print(f"{line}   {theory}")
    print()


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description="The same brain arranged in different ways.")
    parser.add_argument("--profile", default="orin-nano-8gb:15W", help="slug:mode of a Jetson")
    parser.add_argument("--camera-hz", type=float, nargs="+", default=[15.0, 30.0, 60.0], help="rates of the camera")
    parser.add_argument("--kit", action="store_true", help="the simulator's camera and the shipped network")
    options = parser.parse_args()
    stages = brain_stages(load_profile(options.profile), None, None if options.kit else detector_deployment())
    print_stages(stages)
    for camera_hz in options.camera_hz:
        print_brains(stages, options.profile, camera_hz)
    print_queues()
    run = run_brain("pipelined", stages, load_profile(options.profile), camera_hz=30, seconds=10)
    budget = make_budget(2.2 * sum(stage.ms for stage in stages), stages, 30)
    print("a latency budget for the pipelined brain, camera 30 Hz")
    print(budget.table(run))


if __name__ == "__main__":
    main()

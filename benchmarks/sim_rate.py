"""How fast the simulator is: physics step, camera frame, lidar scan, world, training image, replay page.

Run with ``python benchmarks/sim_rate.py``. One core; medians over worlds of default difficulty.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable

import numpy as np

from robotbrain.sim import Replay, RobotSim, generate_world, render_dataset

STEP_NS = 5_000_000


def seconds(action: Callable[[], object], repeat: int) -> float:
    """Median duration of ``action`` over ``repeat`` calls."""
    durations = []
    for _ in range(repeat):
        began = time.perf_counter()
        action()
        durations.append(time.perf_counter() - began)
    return float(np.median(durations))


def measure(worlds: int) -> list[tuple[str, float, str, str]]:
    """Rows of (what, value, unit, target)."""
    steps, frames, scans, generated = [], [], [], []
    for seed in range(worlds):
        began = time.perf_counter()
        world = generate_world(seed)
        generated.append(time.perf_counter() - began)
        sim, replay = RobotSim(world), Replay(world)
        began = time.perf_counter()
        for k in range(1, 101):  # 10 s of circling near the start, commands at 10 Hz
            sim.set_twist(0.15, 0.8)
            sim.advance_to(k * 20 * STEP_NS)
        steps.append((time.perf_counter() - began) / 2000)
        frames.append(seconds(sim.read_camera, 30))
        scans.append(seconds(sim.read_lidar, 30))
        for t in range(600):
            angle = t / 20
            replay.add_state(t / 10, type(world.start)(math.cos(angle), math.sin(angle), angle))
    page = replay.static_html()
    images = seconds(lambda: render_dataset(range(5), 32), 1) / (5 * 32)
    return [
        ("physics step with firmware", float(np.median(steps)) * 1e6, "us", "< 60"),
        ("camera frame 64x64 RGB-D", float(np.median(frames)) * 1e3, "ms", "about 1.5"),
        ("lidar scan, 120 rays", float(np.median(scans)) * 1e3, "ms", "-"),
        ("world, default difficulty", float(np.median(generated)) * 1e3, "ms", "-"),
        ("training images", 60.0 / images, "per minute", "> 3000"),
        ("replay page of 60 s", len(page) / 1e6, "MB", "about 0.9"),
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--worlds", type=int, default=8)
    rows = measure(parser.parse_args().worlds)
    print(f"{'what':<28} {'measured':>10} {'unit':<11} target")
    for what, value, unit, target in rows:
        print(f"{what:<28} {value:>10.4g} {unit:<11} {target}")


if __name__ == "__main__":
    main()

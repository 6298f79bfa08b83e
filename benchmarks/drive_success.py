"""Drive many unseen worlds and print one table: success, collisions, time, speed of the simulation.

Usage: python benchmarks/drive_success.py [--first 5000] [--worlds 100]
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import Any

import numpy as np
from tqdm import tqdm

from robotbrain.jetson import OnnxEngine
from robotbrain.pipeline.brain import RunResult, default_model, drive
from robotbrain.pipeline.nodes.perception import PerceptionNode
from robotbrain.sim import CameraExtrinsics


class Blind(PerceptionNode):
    """Sees noise where the network would have answered."""

    def segment(self, image: np.ndarray) -> np.ndarray:
        # A function of the image alone: one world's noise does not depend on the worlds before.
        return np.random.default_rng(int(image.sum())).integers(0, 4, image.shape[:2]).astype(np.uint8)


def blind() -> Blind:
    mount = CameraExtrinsics()
    return Blind(OnnxEngine(default_model()), (mount.x, mount.y, mount.z, mount.pitch))


CASES: dict[str, tuple[float, dict[str, Any]]] = {
    "nominal robot": (1.0, {}),
    "surrogate robot": (0.3, {"robot": "surrogate"}),
    "noise instead of the network": (0.3, {"parts": {"perception": blind}}),
}


def measure(name: str, run_one: Callable[[int], RunResult], seeds: range) -> str:
    runs = [run_one(seed) for seed in tqdm(seeds, desc=name, unit="world")]
    for run in runs:
        if not run.success and name == "nominal robot":
            print(f"  world {run.seed}: {run.reason}")
    wins = [run for run in runs if run.success]
    hits = sum(bool(run.collisions) for run in runs)
    seconds = f"{np.median([r.seconds for r in wins]):.1f}" if wins else "-"
    factor = np.median([r.real_time_factor for r in runs])
    return f"| {name} | {len(runs)} | {len(wins)} | {hits} | {seconds} | {factor:.1f} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--first", type=int, default=5000, help="seed of the first world")
    parser.add_argument("--worlds", type=int, default=100, help="worlds for the nominal robot")
    arguments = parser.parse_args()
    rows = []
    for name, (share, options) in CASES.items():
        count = max(int(share * arguments.worlds), 1)
        seeds = range(arguments.first, arguments.first + count)
        rows.append(measure(name, lambda seed, options=options: drive(seed, **options), seeds))
    print("\n| case | worlds | reached the goal | touched something | median time (s) | x real time |")
    print("| --- | --- | --- | --- | --- | --- |")
    print("\n".join(rows))


if __name__ == "__main__":
    main()

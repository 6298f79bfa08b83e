"""The gap between simulation and surrogate arms, with and without randomisation, and what running a policy costs.

Without options it measures speed and prints the shipped study. --train makes the study anew (10 trainings of about
80 s of processor time each; an interrupted one goes on where it was), --ship makes its outcome the shipped one.

Usage: python benchmarks/rl_sim_to_real.py [--train FOLDER [--ship]]
"""

from __future__ import annotations

import argparse
import shutil
import time
from pathlib import Path

import numpy as np

from robotbrain.rl.gap import (
    RESULTS,
    SERIALS,
    WEIGHTS,
    StudyOptions,
    measure,
    shipped_policy,
    shipped_report,
    study,
)
from robotbrain.rl.gap_report import GapReport
from robotbrain.rl.onnx_policy import OnnxPolicy
from robotbrain.rl.surrogate import SurrogateReachEnv


def ship(report: GapReport, folder: Path) -> None:
    """Copy the report, and of each variant the policy that is median on surrogates, into the package."""
    report.save(RESULTS / "reach_gap.json")
    for variant in ("plain", "randomised"):
        found = report.values(variant, "surrogate")
        seeds = list(report.rows[variant])
        seed = seeds[int(np.argsort(found, kind="stable")[len(found) // 2])]
        shutil.copyfile(folder / f"{variant}_{seed}.onnx", WEIGHTS / f"reach_{variant}.onnx")
        print(f"shipped: {variant}, seed {seed}")


def speed(arms: int = 100, steps: int = 50) -> None:
    """Print how fast surrogates step, and how long one decision of the policy takes."""
    policy = OnnxPolicy(shipped_policy())
    env = SurrogateReachEnv(SERIALS[:arms])
    readings, runner = env.reset(), env.runner(policy)
    took = []
    began = time.perf_counter()
    for _ in range(steps):
        before = time.perf_counter()
        target = runner.act(readings.joint_pos, readings.joint_vel, env.target)
        took.append(time.perf_counter() - before)
        readings, _ = env.step(target)
    rate = arms * steps / (time.perf_counter() - began)
    one = SurrogateReachEnv(SERIALS[:1])
    readings, runner = one.reset(), one.runner(policy)
    single = []
    for _ in range(200):
        before = time.perf_counter()
        runner.act(readings.joint_pos, readings.joint_vel, one.target)
        single.append(time.perf_counter() - before)
    print(f"{arms} surrogates, one thread: {rate:,.0f} control steps/s ({rate / 25:,.0f} arms in real time)")
    print(f"one decision for one arm: {1e3 * np.median(single):.2f} ms (median), of 40 ms")


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--train", type=Path, metavar="FOLDER", help="train the study's policies into this folder")
    parser.add_argument("--variants", nargs="+", default=["plain", "randomised"])
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--ship", action="store_true", help="make the outcome the shipped one")
    arguments = parser.parse_args()
    if arguments.train is not None:
        report = study(StudyOptions(arguments.variants, tuple(range(arguments.seeds))), arguments.train)
        if arguments.ship:
            ship(report, arguments.train)
    else:
        report = shipped_report()
    print(report.table())
    if arguments.train is None:
        unseen = measure(OnnxPolicy(shipped_policy()), range(7000, 7200), episodes=1, seed=99)
        print("shipped policy, 200 other surrogates: " + ", ".join(f"{p} {m.success:.1%}" for p, m in unseen.items()))
    speed()


if __name__ == "__main__":
    main()

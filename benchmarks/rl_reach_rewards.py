"""Learning curves of reach with the plain distance as reward, and with the precision term; lesson 5 shows them.

Usage: python benchmarks/rl_reach_rewards.py [--seeds 3] [--steps 64000] [--out FILE.json]

A finished training is stored at once: an interrupted run goes on where it was.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from robotbrain import files
from robotbrain.rl.ddpg import train_ddpg
from robotbrain.rl.envs.gym import TaskVectorEnv
from robotbrain.rl.tasks.reach import ReachDistanceEnvCfg, ReachEnvCfg, ReachEvaluation, reach_ddpg_config

HOME = Path(__file__).parents[1] / "src" / "robotbrain" / "rl" / "results" / "reach_rewards.json"
REWARDS = {"distance": ReachDistanceEnvCfg, "distance and precision": ReachEnvCfg}
KEPT = ("step", "seconds", "success", "error_m")


def main() -> None:
    """Train what is missing, and print one table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--steps", type=int, default=64_000)
    parser.add_argument("--out", type=Path, default=HOME)
    arguments = parser.parse_args()
    found = json.loads(arguments.out.read_text(encoding="utf-8")) if arguments.out.exists() else {}
    found |= {"command": "python benchmarks/rl_reach_rewards.py", "steps": arguments.steps}
    curves = found.setdefault("curves", {name: {} for name in REWARDS})
    judge = ReachEvaluation(episodes=200)
    for seed in range(arguments.seeds):
        for name, cfg in REWARDS.items():
            if str(seed) in curves[name]:
                continue
            recipe = reach_ddpg_config(total_steps=arguments.steps, actor_every=1, averaged=False)  # the plain DDPG
            done = train_ddpg(lambda cfg=cfg: TaskVectorEnv(cfg()), recipe, seed=seed, evaluate=judge)
            curves[name][str(seed)] = [{k: round(point[k], 5) for k in KEPT} for point in done.curve]
            files.write_text(arguments.out, json.dumps(found, indent=1) + "\n")
    print("| reward | seed | reached | off, cm |\n| --- | --- | --- | --- |")
    for name, runs in curves.items():
        for seed, curve in runs.items():
            print(f"| {name} | {seed} | {curve[-1]['success']:.1%} | {100 * curve[-1]['error_m']:.2f} |")


if __name__ == "__main__":
    main()

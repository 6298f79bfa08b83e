"""The navigation policy in rooms it never saw, and in place of the lab's controller: print both tables.

The shipped policy was made with the command in src/robotbrain/rl/weights/navigation_recipe.json. With --run a
training's folder is examined instead, and with --ship its newest checkpoint becomes the shipped one.

Usage: python benchmarks/rl_navigation.py [--worlds 20] [--episodes 512] [--run FOLDER [--ship]]
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import rl_shipping
from tqdm import tqdm

from robotbrain import files
from robotbrain.monitoring.accuracy import wilson_interval
from robotbrain.pipeline.brain import drive
from robotbrain.pipeline.nodes.policy_controller import policy_controller
from robotbrain.rl.tasks.navigation_spec import default_policy, policy_meta

ORIN, NANO = "orin-nano-8gb", "nano-4gb:5W"
DISTANCES = ((0.5, 3.0), (0.5, 1.5), (1.5, 3.0), (3.0, 4.5))
"""Of the goal from the start (m): that of the training, its halves, and beyond it."""
CASES: tuple[tuple[str, dict[str, Any]], ...] = (
    ("nominal robot", {"profile": ORIN}),
    ("nominal robot, crowded room", {"profile": ORIN, "difficulty": 1.0}),
    ("surrogate robots", {"profile": ORIN, "robot": "surrogate"}),
    ("nominal robot, Jetson Nano at 5 W", {"profile": NANO}),
)


CURVE = {
    "return": "train/return",
    "episode_length_steps": "train/episode_length",
    "goal_reached": "env/Episode_Termination/goal_reached",
    "collision": "env/Episode_Termination/collision",
}
POINTS = 100


def rooms(model: Path, distance: tuple[float, float], episodes: int) -> dict[str, Any]:
    """Return the figures of one range of distances."""
    from robotbrain.rl.envs import ManagerBasedRLEnv
    from robotbrain.rl.evaluate import run_episodes
    from robotbrain.rl.export import OnnxPolicy
    from robotbrain.rl.tasks.navigation import NavigationEnvCfg

    cfg = NavigationEnvCfg()
    cfg.play_mode()
    cfg.scene.num_envs = 64
    cfg.commands.goal.distance = distance
    names = ("goal_reached", "collision")
    table = run_episodes(
        ManagerBasedRLEnv(cfg, num_threads=1),
        OnnxPolicy(model),
        episodes,
        measure=lambda env, step: {name: env.termination_manager.get_term(name).float() for name in names},
        tail=1,
    )
    reached, touched = (table.tail[name][:, -1] > 0.5 for name in names)
    seconds = float(np.median(table.lengths[reached])) * cfg.decimation * cfg.sim.dt
    return {
        "goal_at_m": list(distance),
        "episodes": len(table),
        "reached": int(reached.sum()),
        "collisions": int(touched.sum()),
        "median_s": round(seconds, 1),
    }


def lab(model: Path | None, options: dict[str, Any], seeds: Sequence[int], name: str) -> str:
    """Drive the lab's worlds with the policy (or, without a model, the classic controller); return a row."""
    runs = []
    for seed in tqdm(seeds, desc=name, unit="world"):
        chosen = dict(options)
        if "robot" in chosen:
            chosen["surrogate_seed"] = seed
        if model is not None:
            chosen["parts"] = {"controller": policy_controller(model, chosen["profile"])}
        run = drive(seed, **chosen)
        runs.append(run)
        if not run.success:
            print(f"  {name}, world {run.seed}: {run.reason}")
    wins = [run for run in runs if run.success]
    hits = sum(bool(run.collisions) for run in runs)
    cells = (
        f"{len(runs)}",
        f"{len(wins)}",
        f"{hits}",
        f"{np.median([r.seconds for r in wins]):.1f}" if wins else "-",
        f"{np.median([r.path_length for r in wins]):.1f}" if wins else "-",
        f"{sum(r.deadline_misses['controller'] for r in runs)}",
    )
    return " | ".join(cells)


def ship(folder: Path, rows: list[dict[str, Any]]) -> None:
    """Make the training in ``folder`` the shipped one: ONNX, curve and recipe."""
    from robotbrain.rl.checkpoint import load_checkpoint
    from robotbrain.rl.logs import read_run
    from robotbrain.rl.ppo_train import CHECKPOINT_FILE, KIND
    from robotbrain.rl.tasks import navigation

    saved, run = load_checkpoint(folder / CHECKPOINT_FILE, kind=KIND), read_run(folder)
    recipe = {
        **rl_shipping.recipe("navigation", saved, run, navigation.config_hash()),
        "evaluation": rows,
    }
    files.write_text(navigation.SHIPPED_RECIPE, json.dumps(recipe, indent=1) + "\n")
    files.write_text(navigation.SHIPPED_CURVE, json.dumps(rl_shipping.curve(run, saved["steps"], CURVE, POINTS)) + "\n")
    _export(folder, default_policy(), rl_shipping.origin(recipe))


def _export(folder: Path, target: Path, origin: dict[str, Any]) -> Path:
    from robotbrain.rl.export import export_policy
    from robotbrain.rl.ppo_train import CHECKPOINT_FILE, load_actor

    return export_policy(load_actor(folder / CHECKPOINT_FILE), target, policy_meta(origin))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--first", type=int, default=5000, help="seed of the first world of the lab")
    parser.add_argument("--worlds", type=int, default=20, help="worlds for each case; 0: rooms only")
    parser.add_argument("--episodes", type=int, default=512, help="episodes for each range of distances")
    parser.add_argument("--run", type=Path, help="folder of a training; the shipped policy by default")
    parser.add_argument("--ship", action="store_true", help="make it the shipped policy")
    arguments = parser.parse_args()
    if arguments.ship and arguments.run is None:
        parser.error("--ship needs --run")
    with tempfile.TemporaryDirectory() as scratch:
        model = default_policy()
        if arguments.run is not None:
            model = _export(arguments.run, Path(scratch) / "policy.onnx", {})
        rows = [rooms(model, distance, arguments.episodes) for distance in DISTANCES]
        print("| goal at (m) | episodes | reached, 95 % interval | touched something | median time (s) |")
        print("| --- | --- | --- | --- | --- |")
        for row in rows:
            share, touched = wilson_interval(row["reached"], row["episodes"]), row["collisions"] / row["episodes"]
            near, far = row["goal_at_m"]
            print(f"| {near} to {far} | {row['episodes']} | {share} | {touched:.3f} | {row['median_s']} |", flush=True)
        if arguments.ship:
            ship(arguments.run, rows)
        seeds = range(arguments.first, arguments.first + arguments.worlds)
        if not seeds:
            return
        lab_rows = []
        for name, options in CASES:
            for controller, file in (("classic", None), ("policy", model)):
                figures = lab(file, options, seeds, f"{name}, {controller}")
                lab_rows.append(f"| {name} | {controller} | {figures} |")
    head = "| lab | controller | worlds | reached the goal | touched something | median time (s) | median path (m) |"
    print(f"\n{head} late commands |\n| --- | --- | --- | --- | --- | --- | --- | --- |")
    print("\n".join(lab_rows))


if __name__ == "__main__":
    main()

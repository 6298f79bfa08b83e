"""Does the shipped quadruped go where it is told? 200 commands that no training has seen, 20 s each.

Error: planar norm of the command minus the mean velocity in the trunk's frame after the first 2 s, m/s; of the yaw
rate likewise, rad/s. A fall is an episode that the task ended: trunk on the floor or tilted by 72 degrees.

The policy was made with the command in src/robotbrain/rl/weights/velocity_recipe.json. With --run a training's folder
is examined instead, and with --ship its newest checkpoint becomes the shipped one.

Usage: python benchmarks/rl_velocity.py [--commands 200] [--run FOLDER [--ship]] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import rl_shipping

from robotbrain import files
from robotbrain.rl.checkpoint import load_checkpoint, save_checkpoint
from robotbrain.rl.evaluate import clopper_pearson
from robotbrain.rl.export import export_policy
from robotbrain.rl.logs import read_run
from robotbrain.rl.ppo_train import CHECKPOINT_FILE, KIND, load_actor
from robotbrain.rl.tasks import velocity
from robotbrain.rl.tasks.velocity_eval import draw_commands, track

CONDITIONS = {
    "nominal robot": {},
    "nominal robot, pushes": {"pushes": True},
    "random robots, sensor noise, pushes": {"pushes": True, "randomised": True},
}
CURVE = {
    "return": "train/return",
    "episode_length_steps": "train/episode_length",
    "velocity_error_m_s": "env/Metrics/base_velocity/error_vel_xy",
    "yaw_rate_error_rad_s": "env/Metrics/base_velocity/error_vel_yaw",
}
POINTS = 200


def examine(checkpoint: Path, commands: int, threads: int | None) -> list[dict[str, Any]]:
    """Return one row of figures for each condition."""
    actor, told = load_actor(checkpoint), draw_commands(commands)
    rows = []
    for name, options in CONDITIONS.items():
        result = track(actor, told, num_threads=threads, **options)
        error, yaw = result.error.numpy(), result.yaw_error.numpy()
        falls = int(result.fell.sum())
        rows.append(
            {
                "condition": name,
                "commands": commands,
                "error_mean_m_s": round(float(np.nanmean(error)), 4),
                "error_p95_m_s": round(float(np.nanquantile(error, 0.95)), 4),
                "within_0.25_m_s": round(float(np.mean(error < 0.25)), 4),
                "yaw_error_mean_rad_s": round(float(np.nanmean(yaw)), 4),
                "falls": falls,
                "falls_upper_95": round(clopper_pearson(falls, commands, side="upper").high, 4),
            }
        )
    return rows


def table(rows: list[dict[str, Any]]) -> str:
    """Return the rows as text."""
    lines = [
        f"{'':38s}{'error m/s':>22s}{'< 0.25':>9s}{'yaw error':>11s}{'falls':>8s}",
        f"{'condition':38s}{'mean':>11s}{'p95':>11s}{'m/s':>9s}{'rad/s':>11s}{'':>8s}",
    ]
    lines += [
        f"{r['condition']:38s}{r['error_mean_m_s']:11.3f}{r['error_p95_m_s']:11.3f}{r['within_0.25_m_s']:9.1%}"
        f"{r['yaw_error_mean_rad_s']:11.3f}{r['falls']:4d}/{r['commands']}"
        for r in rows
    ]
    return "\n".join(lines)


def ship(folder: Path, rows: list[dict[str, Any]], note: str) -> None:
    """Make the training in ``folder`` the shipped one: checkpoint without the simulation, ONNX, curve and recipe."""
    saved, run = load_checkpoint(folder / CHECKPOINT_FILE, kind=KIND), read_run(folder)
    recipe = {
        **rl_shipping.recipe("velocity", saved, run, velocity.config_hash()),
        "observations": [list(pair) for pair in velocity.OBSERVATIONS],
        "action_scale": velocity.ACTION_SCALE,
        "note": note,
        "evaluation": rows,
    }
    keep = {
        name: saved[name] for name in ("agent", "iteration", "steps", "num_envs", "obs_sizes", "num_actions", "cfg")
    }
    save_checkpoint(
        velocity.SHIPPED_CHECKPOINT,
        {**keep, "env": None, "obs": None, "episodes": None},
        kind=KIND,
        keep_previous=False,
    )
    files.write_text(velocity.SHIPPED_RECIPE, json.dumps(recipe, indent=1) + "\n")
    files.write_text(velocity.SHIPPED_CURVE, json.dumps(rl_shipping.curve(run, saved["steps"], CURVE, POINTS)) + "\n")
    meta = velocity.policy_meta(rl_shipping.origin(recipe))
    export_policy(load_actor(velocity.SHIPPED_CHECKPOINT), velocity.SHIPPED_ONNX, meta)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--commands", type=int, default=200)
    parser.add_argument("--run", type=Path, help="folder of a training; the shipped policy by default")
    parser.add_argument("--ship", action="store_true", help="make it the shipped policy")
    parser.add_argument("--note", default="", help="goes into the recipe of what is shipped")
    parser.add_argument("--json", type=Path, help="write the rows here too")
    parser.add_argument("--threads", type=int, help="of the simulation")
    options = parser.parse_args(arguments)
    if options.ship and options.run is None:
        parser.error("--ship needs --run")
    checkpoint = velocity.SHIPPED_CHECKPOINT if options.run is None else options.run / CHECKPOINT_FILE
    rows = examine(checkpoint, options.commands, options.threads)
    print(table(rows))
    if options.json:
        files.write_text(options.json, json.dumps(rows, indent=1) + "\n")
    if options.ship:
        ship(options.run, rows, options.note)
    return 0


if __name__ == "__main__":
    sys.exit(main())

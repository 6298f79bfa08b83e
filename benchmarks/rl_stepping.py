"""What managers, observations, rewards and resets cost on top of raw batched physics, and against Gymnasium's ways.

Run with ``python benchmarks/rl_stepping.py``. For each task the kit's environment and the bare batch take turns on the
same states with the same controls (A/B in short blocks; medians over the blocks). The bare batch gets the controls
and runs the same physics steps, for navigation also the lidar's rays: what a hand-written loop could not do without.
Then the same task as single environments in numpy (``rl_peers.py``) under Gymnasium's vector environments.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import torch
from rl_peers import PEERS

from robotbrain.rl import make

Seconds = list[float]


def timed(action: Callable[[], object]) -> float:
    began = time.perf_counter()
    action()
    return time.perf_counter() - began


def against_batch(task: str, num_envs: int, threads: int, blocks: int, steps: int) -> tuple[Seconds, Seconds]:
    """Seconds per control step of the environment and of the bare batch, one of each per block."""
    env = make(task, num_envs=num_envs, seed=0, num_threads=threads)
    env.reset()
    generator = torch.Generator().manual_seed(0)
    actions = [torch.rand(num_envs, env.num_actions, generator=generator) * 2 - 1 for _ in range(steps)]
    world = env.scene.world
    lidar = env.scene.sensors.get("lidar")
    controls = np.zeros((steps, *world.ctrl.shape))

    def run() -> None:
        for action, ctrl in zip(actions, controls, strict=True):
            env.step(action)
            ctrl[:] = world.ctrl

    def run_bare() -> None:
        for ctrl in controls:
            world.ctrl[:] = ctrl
            world.batch.step(nstep=env.cfg.decimation)
            if lidar is not None:
                world.mark_written(None)
                lidar.data.ranges.torch  # noqa: B018

    ours, bare = [], []
    for block in range(blocks + 1):
        start = world.rows.copy()
        one = timed(run) / steps
        end = world.rows.copy()
        world.rows[:] = start
        two = timed(run_bare) / steps
        world.rows[:] = end
        world.mark_written(None)
        if block:  # the first one warms up
            ours.append(one)
            bare.append(two)
    return ours, bare


def against_gymnasium(task: str, num_envs: int, kind: str, blocks: int, steps: int) -> Seconds:
    """Seconds per control step of ``num_envs`` single environments under one of Gymnasium's vector environments."""
    vector = getattr(gymnasium.vector, kind)([PEERS[task]] * num_envs)
    vector.action_space.seed(0)
    actions = [vector.action_space.sample() for _ in range(steps)]
    vector.reset(seed=0)
    found = [timed(lambda: [vector.step(action) for action in actions]) / steps for _ in range(blocks + 1)]
    vector.close()
    return found[1:]


def median(values: Seconds) -> float:
    return float(np.median(values))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--envs", type=int, default=64)
    parser.add_argument("--threads", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--blocks", type=int, default=15)
    parser.add_argument("--steps", type=int, default=40, help="control steps per block")
    parser.add_argument("--tasks", nargs="*", default=list(PEERS), choices=list(PEERS))
    parser.add_argument("--no-gymnasium", action="store_true")
    args = parser.parse_args()
    torch.set_num_threads(1)
    print(f"{args.envs} environments, {args.threads} threads; environment steps/s; medians, range over blocks")
    print("| task | raw batch | kit | kit / raw | AsyncVectorEnv | kit / async | SyncVectorEnv | kit / sync |")
    print("|---|---|---|---|---|---|---|---|")
    for task in args.tasks:
        print(row(task, args), flush=True)


def row(task: str, args: Any) -> str:
    ours, bare = against_batch(task, args.envs, args.threads, args.blocks, args.steps)
    share = [b / o for o, b in zip(ours, bare, strict=True)]
    cells = [f"{args.envs / median(bare):,.0f}", f"{args.envs / median(ours):,.0f}"]
    cells.append(f"{median(share):.2f} ({min(share):.2f}..{max(share):.2f})")
    for kind in () if args.no_gymnasium else ("AsyncVectorEnv", "SyncVectorEnv"):
        seconds = median(against_gymnasium(task, args.envs, kind, max(5, args.blocks // 3), max(5, args.steps // 4)))
        cells += [f"{args.envs / seconds:,.0f}", f"{seconds / median(ours):.1f}"]
    return f"| {task} | " + " | ".join(cells) + " |"


if __name__ == "__main__":
    main()

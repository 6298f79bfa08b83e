"""What managers, observations, rewards and resets cost on top of raw batched physics, and against Gymnasium's ways.

Run with ``python benchmarks/rl_stepping.py``. For each task the kit's environment and the raw batch take turns (A/B in
short blocks; medians over the blocks). The raw batch repeats each control step from the state and controls that the
kit stepped from, so that both compute the same physics and the same contacts; it knows no reward, observation or end
of an episode. ``plain`` is ``Batch.step`` alone. ``raw`` is that plus what a hand-written loop could not do without:
poses at the new state for reach (the hand's position) and navigation, and there also the lidar's rays. ``--cpu`` counts
processor time of this process (use it with ``--threads 1``) instead of what the clock says, for a machine that is busy.
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
Clock = Callable[[], float]


def timed(action: Callable[[], object], clock: Clock = time.perf_counter) -> float:
    began = clock()
    action()
    return clock() - began


def against_batch(
    task: str, num_envs: int, threads: int, blocks: int, steps: int, clock: Clock
) -> tuple[Seconds, Seconds, Seconds]:
    """Seconds per control step of the environment, of the raw batch and of plain steps, one of each per block."""
    env = make(task, num_envs=num_envs, seed=0, num_threads=threads)
    env.reset()
    generator = torch.Generator().manual_seed(0)
    actions = [torch.rand(num_envs, env.num_actions, generator=generator) * 2 - 1 for _ in range(steps)]
    world = env.scene.world
    lidar = env.scene.sensors.get("lidar")
    states = [(np.zeros_like(world.rows), np.zeros_like(world.ctrl)) for _ in range(steps)]
    decimation, current = env.cfg.decimation, [0]

    def record() -> None:  # its copies cost what restoring them costs the raw batch
        rows, ctrl = states[current[0]]
        rows[:], ctrl[:] = world.rows, world.ctrl

    def run() -> None:
        for current[0], action in enumerate(actions):
            env.step(action)

    def run_raw(with_poses: bool) -> None:
        for rows, ctrl in states:
            world.rows[:], world.ctrl[:] = rows, ctrl
            if not with_poses:
                world.batch.step(nstep=decimation)
            elif lidar is None:
                world.batch.step(nstep=decimation, stage=world.stage)
            else:
                world.step(decimation)
                lidar.data.ranges.torch  # noqa: B018

    times: tuple[Seconds, Seconds, Seconds] = ([], [], [])
    for block in range(blocks + 1):
        world.before_step.append(record)
        ours = timed(run, clock) / steps
        world.before_step.remove(record)
        end = world.rows.copy()
        raw, plain = (timed(lambda with_poses=kind: run_raw(with_poses), clock) / steps for kind in (True, False))
        world.rows[:] = end
        world.mark_written(None)
        world.flush()
        if block:  # the first one warms up
            for values, value in zip(times, (ours, raw, plain), strict=True):
                values.append(value)
    return times


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
    parser.add_argument("--cpu", action="store_true", help="processor time instead of wall-clock time (raw batch only)")
    parser.add_argument("--tasks", "--task", nargs="*", default=list(PEERS), choices=list(PEERS))
    parser.add_argument("--no-gymnasium", action="store_true")
    args = parser.parse_args()
    torch.set_num_threads(1)
    print(f"{args.envs} environments, {args.threads} threads; environment steps/s; medians, range over blocks")
    print("| task | raw | kit | kit / raw | kit / plain | AsyncVectorEnv | kit / async | SyncVectorEnv | kit / sync |")
    print("|---|---|---|---|---|---|---|---|---|")
    for task in args.tasks:
        print(row(task, args), flush=True)


def row(task: str, args: Any) -> str:
    clock = time.process_time if args.cpu else time.perf_counter
    ours, raw, plain = against_batch(task, args.envs, args.threads, args.blocks, args.steps, clock)
    cells = [f"{args.envs / median(raw):,.0f}", f"{args.envs / median(ours):,.0f}"]
    for reference in (raw, plain):
        share = [r / o for o, r in zip(ours, reference, strict=True)]
        cells.append(f"{median(share):.2f} ({min(share):.2f}..{max(share):.2f})")
    for kind in () if args.no_gymnasium else ("AsyncVectorEnv", "SyncVectorEnv"):
        seconds = median(against_gymnasium(task, args.envs, kind, max(5, args.blocks // 3), max(5, args.steps // 4)))
        cells += [f"{args.envs / seconds:,.0f}", f"{seconds / median(ours):.1f}"]
    return f"| {task} | " + " | ".join(cells) + " |"


if __name__ == "__main__":
    main()

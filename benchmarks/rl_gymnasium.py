"""The kit's DDPG on Gymnasium's MuJoCo tasks beside Stable-Baselines3's, with equal hyper-parameters.

Run with ``python benchmarks/rl_gymnasium.py --results DIR``. Each finished run is one JSON file in DIR, so it can be
stopped at any time and started again; ``--table`` only prints what is there. Both learn with one environment, one
update per step, networks of 256-256 units, the same noise, learning rates and warm-up; both policies are then judged
without noise on the same episodes. One PyTorch thread, and one run at a time. Needs ``pip install stable-baselines3``.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import sys
import time
import types
from collections.abc import Callable
from pathlib import Path

import gymnasium
import numpy as np
import torch
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from robotbrain.files import write_text
from robotbrain.rl.ddpg import DDPGConfig, train_ddpg

TASKS = {"InvertedPendulum-v5": 20_000, "Reacher-v5": 100_000, "Pusher-v5": 100_000, "HalfCheetah-v5": 100_000}
COMMON = {"gamma": 0.99, "tau": 0.005, "batch_size": 64, "buffer_size": 100_000}
LEARNING_RATE = 1e-3  # of actor and critic: Stable-Baselines3 has one for both
WARMUP, NOISE_STD = 1_000, 0.1
EPISODES = 20
FIRST_EVALUATION_SEED = 100_000

# Gymnasium's MuJoCo tasks import their renderers, which mujoco-core does not bring along. Nothing is rendered here.
for _module in ("glfw", "imageio"):
    if importlib.util.find_spec(_module) is None:
        sys.modules[_module] = types.ModuleType(_module)


def train_own(task: str, steps: int, seed: int) -> Callable[[np.ndarray], np.ndarray]:
    config = DDPGConfig(
        total_steps=steps,
        warmup_steps=WARMUP,
        actor_lr=LEARNING_RATE,
        critic_lr=LEARNING_RATE,
        noise_std=NOISE_STD,
        eval_every=steps,
        **COMMON,
    )
    result = train_ddpg(
        lambda: SyncVectorEnv([lambda: gymnasium.make(task)], autoreset_mode=AutoresetMode.SAME_STEP), config, seed=seed
    )
    return lambda obs: result.policy(obs[None].astype(np.float32))[0]


def train_peer(task: str, steps: int, seed: int) -> Callable[[np.ndarray], np.ndarray]:
    from stable_baselines3 import DDPG
    from stable_baselines3.common.noise import NormalActionNoise

    env = gymnasium.make(task)
    size = env.action_space.shape[0]
    model = DDPG(
        "MlpPolicy",
        env,
        learning_rate=LEARNING_RATE,
        learning_starts=WARMUP,
        train_freq=1,
        gradient_steps=1,
        action_noise=NormalActionNoise(np.zeros(size), NOISE_STD * np.ones(size)),
        policy_kwargs={"net_arch": [256, 256]},
        seed=seed,
        device="cpu",
        **COMMON,
    )
    model.learn(steps)
    return lambda obs: model.predict(obs, deterministic=True)[0]


LEARNERS = {"robotbrain": train_own, "stable-baselines3": train_peer}


def returns(task: str, policy: Callable[[np.ndarray], np.ndarray]) -> list[float]:
    """Undiscounted returns of the evaluation episodes."""
    env, found = gymnasium.make(task), []
    for episode in range(EPISODES):
        obs, _ = env.reset(seed=FIRST_EVALUATION_SEED + episode)
        total, ended = 0.0, False
        while not ended:
            obs, reward, terminated, truncated, _ = env.step(policy(obs))
            total, ended = total + float(reward), terminated or truncated
        found.append(total)
    return found


def run(task: str, learner: str, seed: int, results: Path) -> None:
    path = results / f"{task}.{learner}.{seed}.json"
    if path.exists():
        return
    began, cpu = time.perf_counter(), time.process_time()
    policy = LEARNERS[learner](task, TASKS[task], seed)
    figures = {
        "task": task,
        "learner": learner,
        "seed": seed,
        "steps": TASKS[task],
        "wall_s": round(time.perf_counter() - began, 1),
        "cpu_s": round(time.process_time() - cpu, 1),
        "returns": returns(task, policy),
    }
    write_text(path, json.dumps(figures, indent=1) + "\n")
    print(f"{task} {learner} seed {seed}: {np.mean(figures['returns']):.1f} in {figures['wall_s']} s", flush=True)


def interval(runs: list[list[float]], draws: int = 4000) -> tuple[float, float, float]:
    """Mean and 95 % interval by bootstrap over seeds and, within each, over episodes (of one seed: episodes alone)."""
    rng, table = np.random.default_rng(0), np.array(runs)
    seeds = rng.integers(len(table), size=(draws, len(table), 1))
    episodes = rng.integers(table.shape[1], size=(draws, len(table), table.shape[1]))
    low, high = np.quantile(table[seeds, episodes].mean(axis=(1, 2)), (0.025, 0.975))
    return float(table.mean()), float(low), float(high)


def table(results: Path) -> None:
    found: dict[tuple[str, str], list[dict]] = {}
    for path in sorted(results.glob("*.json")):
        figures = json.loads(path.read_text(encoding="utf-8"))
        found.setdefault((figures["task"], figures["learner"]), []).append(figures)
    print(f"\n{'task':22}{'learner':20}{'seeds':>6}{'return':>10}{'95 % interval':>22}{'CPU s per run':>15}")
    for task in TASKS:
        bounds = {}
        for learner in LEARNERS:
            if runs := found.get((task, learner)):
                mean, low, high = bounds[learner] = interval([one["returns"] for one in runs])
                cpu = float(np.median([one["cpu_s"] for one in runs]))
                span = f"[{low:.1f}, {high:.1f}]"
                print(f"{task:22}{learner:20}{len(runs):6}{mean:10.1f}{span:>22}{cpu:15.0f}")
        if len(bounds) == 2:
            not_below = bounds["robotbrain"][2] >= bounds["stable-baselines3"][1]
            print(f"{'':22}{'not below the peer' if not_below else 'BELOW the peer'}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--results", type=Path, required=True, help="folder for one JSON file per finished run")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--tasks", nargs="+", choices=TASKS, default=list(TASKS))
    parser.add_argument("--table", action="store_true", help="only print the table of the finished runs")
    options = parser.parse_args()
    torch.set_num_threads(1)
    options.results.mkdir(parents=True, exist_ok=True)
    if not options.table:
        for seed in range(options.seeds):
            for task in options.tasks:
                for learner in LEARNERS:
                    run(task, learner, seed, options.results)
    table(options.results)


if __name__ == "__main__":
    main()

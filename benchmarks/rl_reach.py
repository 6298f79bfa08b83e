"""Wall-clock time until the arm reaches 95 % of 500 unseen targets: the kit's DDPG beside Stable-Baselines3's.

Run with ``python benchmarks/rl_reach.py --results DIR``. Learners take turns, seed after seed, on the same environment,
reward, discount, exploration noise, network (256-256) and one PyTorch thread; training time is counted, evaluation is
not. Each finished run is one JSON file in DIR, so it can be stopped at any time and started again; ``--table`` only
prints what is there. A run that is not done after ``--cap`` seconds of training counts as "at least" that long.

The kit updates its actor after every second update of its critic and is judged by the average of its latest actors
(``actor_every``, ``averaged``). Stable-Baselines3's DDPG has neither, and runs with its defaults otherwise: with 16
environments and 4 updates per step of all of them, with the same and the kit's learning rates, target rate and batch
size, and with one environment as it comes. Every learner is judged after each 100 updates: on 100 targets, and where it
reaches 90 of them on the 500 that count. A policy that passes is tried on 500 more, for the record. Needs
``pip install stable-baselines3``.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch

from robotbrain.files import write_text
from robotbrain.rl.ddpg import Policy, train_ddpg
from robotbrain.rl.registry import make_vec
from robotbrain.rl.tasks.reach import ReachEvaluation, reach_ddpg_config

GOAL = 0.95
TARGETS = 500
UPDATES_BETWEEN = 100
"""Updates between two evaluations, of every learner."""
SCREENING_TARGETS, SCREENING_GOAL, SCREENING_SEED = 100, 0.9, 3_000_003
"""A policy that fails here is not worth the 500."""
CONFIRMATION_SEED = 2_000_003

Report = Callable[[float, float, int, Policy], bool]
"""Wall and CPU seconds of training so far, environment steps, policy -> whether to stop."""


class Stopwatch:
    """Wall and CPU time of training, with breaks."""

    def __init__(self) -> None:
        self.wall = self.cpu = 0.0
        self.go_on()

    def go_on(self) -> None:
        self._wall, self._cpu = time.perf_counter(), time.process_time()

    def take_break(self) -> None:
        self.wall += time.perf_counter() - self._wall
        self.cpu += time.process_time() - self._cpu


def train_own(seed: int, report: Report) -> None:
    recipe = reach_ddpg_config()
    every = round(UPDATES_BETWEEN / recipe.updates_per_step)
    config = dataclasses.replace(recipe, total_steps=1_000_000, eval_every=every)
    env = make_vec("reach", seed=seed)
    watch = Stopwatch()
    latest: dict[str, Policy] = {}

    def evaluate(policy: Policy) -> dict[str, float]:
        watch.take_break()
        latest["policy"] = policy
        return {}

    def callback(point: dict[str, float]) -> bool:
        done = report(watch.wall, watch.cpu, int(point["step"]), latest["policy"])
        watch.go_on()
        return done

    train_ddpg(lambda: env, config, seed=seed, evaluate=evaluate, callback=callback)


def train_peer(seed: int, report: Report, envs: int, updates: int, **settings: Any) -> None:
    from stable_baselines3 import DDPG
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.noise import NormalActionNoise

    own = reach_ddpg_config()
    every = UPDATES_BETWEEN * envs // updates

    class Evaluate(BaseCallback):
        def _on_step(self) -> bool:
            if self.num_timesteps // every == (self.num_timesteps - envs) // every:
                return True
            watch.take_break()
            done = report(
                watch.wall, watch.cpu, self.num_timesteps, lambda obs: model.predict(obs, deterministic=True)[0]
            )
            watch.go_on()
            return not done

    env = peer_env(make_vec("reach", num_envs=envs, seed=seed))
    model = DDPG(
        "MlpPolicy",
        env,
        gamma=own.gamma,
        train_freq=1,
        gradient_steps=updates,
        action_noise=NormalActionNoise(np.zeros(7), own.noise_std * np.ones(7)),
        policy_kwargs={"net_arch": list(own.hidden)},
        seed=seed,
        device="cpu",
        **settings,
    )
    watch = Stopwatch()
    model.learn(10_000_000, callback=Evaluate())


def peer_env(tasks: gymnasium.vector.VectorEnv) -> Any:
    """Stable-Baselines3's own interface to vector environments."""
    from stable_baselines3.common.vec_env import VecEnv

    class Adapter(VecEnv):
        def __init__(self) -> None:
            super().__init__(tasks.num_envs, tasks.single_observation_space, tasks.single_action_space)

        def reset(self) -> np.ndarray:
            return tasks.reset(seed=None)[0]

        def step_async(self, actions: np.ndarray) -> None:
            self.actions = actions

        def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict]]:
            obs, reward, terminated, truncated, info = tasks.step(self.actions)
            infos: list[dict] = [{} for _ in range(self.num_envs)]
            for i in np.flatnonzero(terminated | truncated):
                cut = bool(truncated[i] and not terminated[i])
                infos[i] = {"terminal_observation": info["final_obs"][i], "TimeLimit.truncated": cut}
            return obs, reward, terminated | truncated, infos

        def close(self) -> None: ...

        def get_attr(self, attr_name: str, indices: Any = None) -> list:
            return [None] * self.num_envs

        def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None: ...

        def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list:
            return [None] * self.num_envs

        def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
            return [False] * self.num_envs

    return Adapter()


def _kit_settings() -> dict[str, Any]:
    own = reach_ddpg_config()
    return {"learning_rate": own.critic_lr, "tau": own.tau, "batch_size": own.batch_size}


LEARNERS: dict[str, Callable[[int, Report], None]] = {
    "robotbrain": train_own,
    "sb3, 16 envs": lambda seed, report: train_peer(seed, report, envs=16, updates=4),
    "sb3, 16 envs, kit's rates": lambda seed, report: train_peer(seed, report, envs=16, updates=4, **_kit_settings()),
    "sb3, 1 env": lambda seed, report: train_peer(seed, report, envs=1, updates=1),
}


def run(name: str, seed: int, cap: float, results: Path) -> None:
    path = results / f"{name.replace(', ', '-').replace(' ', '-')}.{seed}.json"
    if path.exists():
        return
    screen = ReachEvaluation(episodes=SCREENING_TARGETS, seed=SCREENING_SEED)
    judge = ReachEvaluation(episodes=TARGETS)
    curve: list[dict[str, float]] = []
    final: dict[str, Any] = {}

    def report(wall: float, cpu: float, steps: int, policy: Policy) -> bool:
        figures, targets = screen(policy), SCREENING_TARGETS
        if figures["success"] >= SCREENING_GOAL:
            figures, targets = judge(policy), TARGETS
        curve.append({"wall_s": round(wall, 2), "cpu_s": round(cpu, 2), "steps": steps, "targets": targets, **figures})
        if done := targets == TARGETS and figures["success"] >= GOAL:
            final["confirmed"] = ReachEvaluation(episodes=TARGETS, seed=CONFIRMATION_SEED)(policy)["success"]
        return done or wall > cap

    LEARNERS[name](seed, report)
    solved = "confirmed" in final
    figures = {"learner": name, "seed": seed, "solved": solved, **curve[-1], **final, "cap_s": cap, "curve": curve}
    figures["load"] = os.getloadavg() if hasattr(os, "getloadavg") else None
    write_text(path, json.dumps(figures, indent=1) + "\n")
    print(
        f"{name}, seed {seed}: {'' if solved else 'NOT SOLVED after '}{figures['wall_s']:.1f} s "
        f"({figures['cpu_s']:.1f} s CPU), {figures['steps']} steps, success {figures['success']:.3f}",
        flush=True,
    )


def row(cells: tuple[Any, ...]) -> str:
    first, *rest = cells
    return f"{first:28}" + "".join(
        f"{cell:>{width}}" for cell, width in zip(rest, (6, 7, 10, 16, 8, 9, 8, 11), strict=True)
    )


def table(results: Path) -> None:
    runs = [json.loads(path.read_text(encoding="utf-8")) for path in sorted(results.glob("*.json"))]
    titles = ("learner", "seeds", "solved", "median s", "range", "CPU s", "steps", "ratio", "CPU ratio")
    print("\n" + row(titles))
    base: dict[str, float] = {}
    for name in LEARNERS:
        mine = [one for one in runs if one["learner"] == name]
        if not mine:
            continue
        wall, cpu, steps = (np.array([one[key] for one in mine]) for key in ("wall_s", "cpu_s", "steps"))
        solved = sum(one["solved"] for one in mine)
        bound = "" if solved > len(mine) / 2 else ">"  # more than half are capped: so is the median
        middle = {"wall": float(np.median(wall)), "cpu": float(np.median(cpu))}
        base = base or middle
        cells = (
            name,
            len(mine),
            solved,
            bound + format(middle["wall"], ".1f"),
            f"{wall.min():.0f} .. {wall.max():.0f}",
            f"{middle['cpu']:.0f}",
            f"{np.median(steps):.0f}",
            *(f"{bound}{middle[key] / base[key]:.1f}" for key in ("wall", "cpu")),
        )
        print(row(cells))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--results", type=Path, required=True, help="folder for one JSON file per finished run")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--cap", type=float, default=600.0, help="seconds of training after which a run is given up")
    parser.add_argument("--learners", nargs="+", choices=LEARNERS, default=list(LEARNERS))
    parser.add_argument("--table", action="store_true", help="only print the table of the finished runs")
    options = parser.parse_args()
    torch.set_num_threads(1)
    options.results.mkdir(parents=True, exist_ok=True)
    if not options.table:
        for seed in range(options.seeds):
            for name in options.learners:
                run(name, seed, options.cap, options.results)
    table(options.results)


if __name__ == "__main__":
    main()

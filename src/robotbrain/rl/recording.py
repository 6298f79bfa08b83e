"""Recording what a policy does in a task's own simulation, to watch it with :mod:`robotbrain.rl.view`."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np

from robotbrain.errors import InputError
from robotbrain.rl.view import Motion


def record_task(policy: str | Path, *, task: str | None = None, seconds: float = 10.0, seed: int = 0) -> Motion:
    """Let a policy act in its task and return the motion: one episode, or its first ``seconds``.

    Args:
        policy: folder of a run, checkpoint, or ONNX file.
        task: registered name; what the policy was trained in by default.
        seconds: of simulated time, > 0.
        seed: of everything that the task draws.

    Raises:
        InputError: no such policy or task, or a policy for other observations.
    """
    from robotbrain.rl.envs.gym import TaskVectorEnv
    from robotbrain.rl.policies import load_policy
    from robotbrain.rl.registry import task_cfg

    loaded = load_policy(policy)
    name = task or loaded.command.get("task")
    if not name:
        raise InputError("task", given=None, expected="a registered task", fix="Say which with --task.")
    if not 0.0 < seconds < np.inf:
        raise InputError("seconds", given=seconds, expected="> 0", fix="Try 10.")
    cfg = task_cfg(name)
    cfg.play_mode()
    cfg.scene.num_envs, cfg.seed = 1, seed
    env = TaskVectorEnv(cfg, num_threads=1)
    world = env.env.scene.world
    obs, _ = env.reset(seed=seed)
    model = _as_it_stands(world.batch)
    qpos = [world.qpos[0].copy()]
    for _ in range(max(1, round(seconds / env.env.step_dt))):
        obs, _, terminated, truncated, _ = env.step(loaded.act(obs))
        if terminated[0] or truncated[0]:
            break  # what follows is another episode
        qpos.append(world.qpos[0].copy())
    traced = "ee" if name == "reach" else "base"
    targets = env.env.command_manager.get_command("ee_pose")[0, :3].numpy() if name == "reach" else None
    return Motion(f"{name}, simulation", model, np.stack(qpos), float(env.env.step_dt), targets, trace=traced)


def _as_it_stands(batch: mujoco.batch.Batch) -> mujoco.MjModel:
    """Return the first environment's model with its movable fixtures (mocap bodies) where they are now."""
    model = batch.get_model(0)
    for body in np.flatnonzero(model.body_mocapid >= 0):
        place = int(model.body_mocapid[body])
        model.body_pos[body], model.body_quat[body] = batch.mocap_pos[0, place], batch.mocap_quat[0, place]
    return model

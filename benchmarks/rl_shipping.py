"""What rl_velocity.py and rl_navigation.py write beside a policy that they ship: how it was trained, and its curve."""

from __future__ import annotations

import datetime
import os
import platform
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

import robotbrain


def recipe(task: str, saved: Mapping[str, Any], run: Any, config_hash: str) -> dict[str, Any]:
    """Return what a training was: command, seed, size, cost and versions.

    Args:
        task: its name.
        saved: checkpoint of the training.
        run: its log (`robotbrain.rl.logs.read_run`).
        config_hash: fingerprint of the task and of PPO's settings.
    """
    cost = run["train/return"]
    at = int(np.searchsorted(cost.step, saved["steps"], side="right")) - 1
    return {
        "command": f"robotbrain rl train {task} --seed {saved['cfg']['seed']} --iterations {saved['iteration']}",
        "task": task,
        "algorithm": "PPO (robotbrain.rl.ppo) with left-right mirror images",
        "seed": saved["cfg"]["seed"],
        "num_envs": saved["num_envs"],
        "iterations": saved["iteration"],
        "env_steps": saved["steps"],
        "minutes": round(float(cost.elapsed_s[at]) / 60, 1),
        "machine": f"{os.cpu_count()} CPU cores ({_processor()}), no GPU, shared with other work",
        "threads": run.settings.get("threads"),
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "kit_version": robotbrain.__version__,
        "torch": torch.__version__.split("+")[0],
        "config_hash": config_hash,
    }


def origin(made: Mapping[str, Any]) -> dict[str, Any]:
    """Return the part of a recipe that goes into the policy's own file."""
    return {name: made[name] for name in ("command", "env_steps", "config_hash", "date")}


def curve(run: Any, last_step: int, sources: Mapping[str, str], points: int) -> dict[str, Any]:
    """Return figures of a training, each of ``points`` points the mean over its share of the steps.

    Args:
        run: the log.
        last_step: of the checkpoint.
        sources: name of a figure -> what it is called in the log.
        points: of the curve.
    """
    edges = np.linspace(0, last_step, points + 1)
    found: dict[str, Any] = {"env_steps": edges[1:].astype(int).tolist()}
    for name, source in sources.items():
        series = run[source]
        place = np.digitize(series.step, edges, right=True) - 1
        means = [float(np.nanmean(v)) if (v := series.value[place == i]).size else None for i in range(points)]
        found[name] = [None if m is None else round(m, 4) for m in means]
    return found


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    lines = info.read_text(encoding="utf-8").splitlines() if info.is_file() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()

"""A trained policy by where it lies: a run's folder, a checkpoint of any of the learners, or an ONNX file."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray

from robotbrain.errors import InputError
from robotbrain.rl.checkpoint import load_checkpoint
from robotbrain.rl.ppo_train import CHECKPOINT_FILE

if TYPE_CHECKING:
    from torch import nn

Array = NDArray[np.float32]
COMMAND_FILE = "command.json"
"""What ``robotbrain rl train`` was asked for, in the run's folder."""
_COMMAND_KEYS = frozenset({"task", "algorithm", "seed", "num_envs", "set"})


@dataclass(frozen=True)
class LoadedPolicy:
    """A policy, ready to act.

    Attributes:
        act: observations (n, O) to actions (n, A), within the bounds of the actions.
        module: the network, (n, O) to (n, A), not clipped; None for ONNX.
        command: what it was trained with (see ``COMMAND_FILE``); empty where nobody wrote that down. Of an ONNX file,
            which may be a stranger's, only the task: what else it says could make the task endless or trivial.
        provenance: algorithm and how long it was trained; of an ONNX file, what it says itself, ``set`` included.
    """

    act: Callable[[Array], Array]
    module: nn.Module | None
    command: dict[str, Any] = field(default_factory=dict)
    provenance: dict[str, Any] = field(default_factory=dict)


def read_command(run_dir: str | Path) -> dict[str, Any]:
    """Return what ``robotbrain rl train`` was asked for in this folder.

    Raises:
        InputError: for a folder that it did not make.
    """
    path = Path(run_dir) / COMMAND_FILE
    try:
        command: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        if not (isinstance(command, dict) and command.keys() >= _COMMAND_KEYS):
            raise ValueError(f"{COMMAND_FILE} does not say {', '.join(sorted(_COMMAND_KEYS))}")
    except (OSError, ValueError) as error:
        raise InputError(
            "run folder",
            given=str(run_dir),
            expected=f"a folder of `robotbrain rl train`, with {COMMAND_FILE}",
            fix=f"It prints its folder when it begins. ({error})",
        ) from error
    return command


def load_policy(path: str | Path) -> LoadedPolicy:
    """Return the policy of a run's folder, a checkpoint (``.pt``) or an ONNX file.

    Raises:
        InputError: for anything else, or a file that is missing or damaged.
    """
    source = Path(path)
    if source.suffix == ".onnx":
        return _onnx(source)
    if source.is_dir():
        source = source / CHECKPOINT_FILE
    saved = load_checkpoint(source)
    command = read_command(source.parent) if (source.parent / COMMAND_FILE).is_file() else {}
    if "cfg" in saved:  # PPO, of the kit or of rsl-rl
        from robotbrain.rl.ppo_cfg import model_cfg
        from robotbrain.rl.ppo_train import actor_from_state
        from robotbrain.rl.rsl_rl_runner import network_from_rsl_rl

        ours = "actor" in saved["agent"]
        actor_cfg = model_cfg(saved["cfg"]["actor"])
        module: nn.Module = (
            actor_from_state(saved) if ours else network_from_rsl_rl(saved["agent"]["actor_state_dict"], actor_cfg)
        )
        algorithm, limit, steps = ("ppo" if ours else "rsl-rl"), saved["cfg"]["clip_actions"], saved["steps"]
    elif "config" in saved:
        module, algorithm, limit, steps = _ddpg_actor(saved), "ddpg", 1.0, saved["step"]
    else:
        raise InputError("checkpoint", given=str(source), expected="one of a training", fix="Give the run's folder.")
    provenance = {"algorithm": algorithm, "steps": int(steps)}
    provenance |= {name: command[name] for name in ("seed", "num_envs") if name in command}
    return LoadedPolicy(_acting(module, limit), module, command, provenance)


def _ddpg_actor(saved: Mapping[str, Any]) -> nn.Module:
    from robotbrain.rl.ddpg import Actor

    state = saved["agent"]["actor_target" if saved["config"].get("averaged") else "actor"]  # as `DDPG.policy`
    weights = [x for name, x in state.items() if name.endswith(".weight")]
    actor = Actor(weights[0].shape[1], weights[-1].shape[0], tuple(saved["config"]["hidden"]))
    actor.load_state_dict(state)
    return actor.eval()


def _acting(module: nn.Module, limit: float | None) -> Callable[[Array], Array]:
    width = next(x.shape[1] for name, x in module.state_dict().items() if name.endswith(".weight"))

    @torch.no_grad()
    def act(obs: Array) -> Array:
        if obs.shape[-1] != width:
            raise InputError(
                "policy observation",
                given=f"{obs.shape[-1]} numbers",
                expected=f"{width}, as in its training",
                fix="Try the policy on the task that it was trained on.",
            )
        actions: Array = module(torch.from_numpy(np.asarray(obs, np.float32))).numpy()
        return actions if limit is None else actions.clip(-limit, limit)

    return act


def _onnx(path: Path) -> LoadedPolicy:
    from robotbrain.rl.onnx_policy import OnnxPolicy

    policy = OnnxPolicy(path)
    low, high = (
        np.array(bound, np.float32) if bound else None for bound in (policy.meta.action_low, policy.meta.action_high)
    )

    def act(obs: Array) -> Array:
        actions: Array = policy(obs)
        return actions if low is None and high is None else np.clip(actions, low, high)

    provenance = dict(policy.meta.provenance)
    changed = provenance.get("set", [])
    if not (isinstance(changed, list) and all(isinstance(text, str) for text in changed)):
        raise InputError(
            "policy metadata 'provenance', set",
            given=changed,
            expected="a list of texts such as env.episode_length_s=10",
            fix="Correct it where the policy is exported.",
        )
    return LoadedPolicy(act, None, {"task": policy.meta.task, "set": []}, provenance)

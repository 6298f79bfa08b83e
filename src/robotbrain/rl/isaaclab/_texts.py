"""The texts around an exported task: the head of the module, and the notes about order."""

from __future__ import annotations

import textwrap

from robotbrain.rl.envs import ManagerBasedRLEnvCfg
from robotbrain.rl.isaaclab._robot import RobotFiles
from robotbrain.rl.isaaclab.names import ISAACLAB_VERSION


def header(name: str, cfg: ManagerBasedRLEnvCfg, robots: dict[str, RobotFiles]) -> str:
    """The docstring of the module: how to run it, and what differs there."""
    ((_, robot),) = robots.items()
    differences = [
        "The physics is Newton with MuJoCo Warp, the backend nearest to the kit's MuJoCo. Settings of friction,\n"
        "  contact and solver are not the same numbers in the two: look at the robot in simulation before you train.",
    ]
    if cfg.only_positive_rewards:
        differences.append(
            "The kit clips a step's total reward at zero (only_positive_rewards); Isaac Lab does not. Begin with\n"
            "  smaller penalties (a curriculum with mdp.modify_reward_weight), or the policy may learn to fall."
        )
    if robot.left_out:
        left_out = "Left out of the robot's file: " + ", ".join(dict.fromkeys(robot.left_out)) + "."
        differences.append(textwrap.fill(left_out, 118, subsequent_indent="  "))
    listed = "\n".join(f"- {line}" for line in differences)
    module, task = f"{name}_isaaclab", f"RobotBrain-{pascal(name)}"
    return f'''"""Task {task} for Isaac Lab {ISAACLAB_VERSION}, exported from robotbrain.

Install (Python 3.12, NVIDIA GPU; the extra imports MJCF):
    pip install "isaaclab[importers]=={ISAACLAB_VERSION}"
Train and play, in this folder:
    export PYTHONPATH=$PWD          # Windows: set PYTHONPATH=%CD%
    isaaclab train --rl_library rsl_rl --task {task} --external_callback {module}.register
    isaaclab play --rl_library rsl_rl --task {task} --external_callback {module}.register \\
        --checkpoint latest
Fewer environments for a small GPU: --num_envs 1024.

What is different there:
{listed}
"""
'''


def order_notes(name: str, cfg: ManagerBasedRLEnvCfg, robots: dict[str, RobotFiles]) -> str:
    """What a policy has to know to run on both sides."""
    ((_, robot),) = robots.items()
    groups = cfg.observations.items() if isinstance(cfg.observations, dict) else vars(cfg.observations).items()
    lines = [f"# Order of observations and actions: {name}", ""]
    for key, group in groups:
        if group is not None:
            terms = [k for k, v in vars(group).items() if hasattr(v, "func")]
            lines += [f"Observation group `{key}`: " + ", ".join(f"`{term}`" for term in terms) + ".", ""]
    actions = cfg.actions.items() if isinstance(cfg.actions, dict) else vars(cfg.actions).items()
    lines += ["Action terms: " + ", ".join(f"`{key}`" for key, term in actions if term is not None) + ".", ""]
    lines += ["Joints: " + ", ".join(f"`{joint}`" for joint in robot.joint_names) + ".", ""]
    lines += [f"Control step: {cfg.sim.dt * cfg.decimation:.6g} s ({cfg.decimation} physics steps).", ""]
    lines += [
        "Quaternions are (x, y, z, w). A policy trained here runs there (and the other way round) if these orders",
        "",
    ]
    lines[-2] += " agree; `joint_ordering` in the generated file sees to that."
    return "\n".join(lines)


def pascal(name: str) -> str:
    """``my_task`` as ``MyTask``."""
    return "".join(part[:1].upper() + part[1:] for part in name.split("_"))

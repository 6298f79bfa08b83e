"""Environments: the task's configuration, the batched environment, and its Gymnasium faces.

The configuration is cheap to import; the rest brings in MuJoCo, torch and Gymnasium when it is first used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from robotbrain.lazy import lazy
from robotbrain.rl.envs.manager_based_rl_env_cfg import ManagerBasedRLEnvCfg
from robotbrain.rl.scene.scene_cfg import SimulationCfg

if TYPE_CHECKING:
    from robotbrain.rl.envs.gym import TaskEnv, TaskVectorEnv
    from robotbrain.rl.envs.manager_based_rl_env import ManagerBasedRLEnv

__all__ = ["ManagerBasedRLEnv", "ManagerBasedRLEnvCfg", "SimulationCfg", "TaskEnv", "TaskVectorEnv"]

_MODULE_OF = {"ManagerBasedRLEnv": "manager_based_rl_env", "TaskEnv": "gym", "TaskVectorEnv": "gym"}
__getattr__, __dir__ = lazy(__name__, _MODULE_OF, globals())

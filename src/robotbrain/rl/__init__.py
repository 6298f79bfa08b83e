"""Reinforcement learning: tasks in the style of Isaac Lab on batched MuJoCo, learners, export and deployment.

A task is a configuration of named terms (``managers``, ``mdp``) that ``envs.ManagerBasedRLEnv`` runs; ``make`` makes
one by name. The names here are loaded when first used, so that importing the package stays cheap.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from robotbrain.lazy import lazy

if TYPE_CHECKING:
    from robotbrain.rl.configclass import MISSING, configclass
    from robotbrain.rl.envs.gym import TaskEnv, TaskVectorEnv
    from robotbrain.rl.envs.manager_based_rl_env import ManagerBasedRLEnv
    from robotbrain.rl.envs.manager_based_rl_env_cfg import ManagerBasedRLEnvCfg
    from robotbrain.rl.managers.manager_term_cfg import (
        CurriculumTermCfg,
        EventTermCfg,
        ObservationGroupCfg,
        ObservationTermCfg,
        RewardTermCfg,
        TerminationTermCfg,
    )
    from robotbrain.rl.managers.scene_entity_cfg import SceneEntityCfg
    from robotbrain.rl.registry import TASKS, make, make_vec, task_cfg

_MODULE_OF = {
    "MISSING": "configclass",
    "configclass": "configclass",
    "TaskEnv": "envs.gym",
    "TaskVectorEnv": "envs.gym",
    "ManagerBasedRLEnv": "envs.manager_based_rl_env",
    "ManagerBasedRLEnvCfg": "envs.manager_based_rl_env_cfg",
    "CurriculumTermCfg": "managers.manager_term_cfg",
    "EventTermCfg": "managers.manager_term_cfg",
    "ObservationGroupCfg": "managers.manager_term_cfg",
    "ObservationTermCfg": "managers.manager_term_cfg",
    "RewardTermCfg": "managers.manager_term_cfg",
    "TerminationTermCfg": "managers.manager_term_cfg",
    "SceneEntityCfg": "managers.scene_entity_cfg",
    "TASKS": "registry",
    "make": "registry",
    "make_vec": "registry",
    "task_cfg": "registry",
}

__all__ = [
    "MISSING",
    "TASKS",
    "CurriculumTermCfg",
    "EventTermCfg",
    "ManagerBasedRLEnv",
    "ManagerBasedRLEnvCfg",
    "ObservationGroupCfg",
    "ObservationTermCfg",
    "RewardTermCfg",
    "SceneEntityCfg",
    "TaskEnv",
    "TaskVectorEnv",
    "TerminationTermCfg",
    "configclass",
    "make",
    "make_vec",
    "task_cfg",
]
__getattr__, __dir__ = lazy(__name__, _MODULE_OF, globals())

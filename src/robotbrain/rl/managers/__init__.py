"""Managers and terms of a task: observations, actions, commands, rewards, terminations, events, curriculum.

Configurations (``...Cfg``) are cheap to import; the managers bring in torch when they are first used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from robotbrain.lazy import lazy
from robotbrain.rl.managers.manager_term_cfg import (
    ActionTermCfg,
    CommandTermCfg,
    CurriculumTermCfg,
    EventTermCfg,
    ManagerTermBaseCfg,
    ObservationGroupCfg,
    ObservationTermCfg,
    RewardTermCfg,
    TerminationTermCfg,
)
from robotbrain.rl.managers.scene_entity_cfg import SceneEntityCfg

if TYPE_CHECKING:
    from robotbrain.rl.managers.action_manager import ActionManager, ActionTerm
    from robotbrain.rl.managers.command_manager import CommandManager, CommandTerm
    from robotbrain.rl.managers.curriculum_manager import CurriculumManager
    from robotbrain.rl.managers.event_manager import EventManager
    from robotbrain.rl.managers.manager_base import ManagerBase, ManagerTermBase
    from robotbrain.rl.managers.observation_manager import ObservationManager
    from robotbrain.rl.managers.reward_manager import RewardManager
    from robotbrain.rl.managers.termination_manager import TerminationManager

__all__ = [
    "ActionManager",
    "ActionTerm",
    "ActionTermCfg",
    "CommandManager",
    "CommandTerm",
    "CommandTermCfg",
    "CurriculumManager",
    "CurriculumTermCfg",
    "EventManager",
    "EventTermCfg",
    "ManagerBase",
    "ManagerTermBase",
    "ManagerTermBaseCfg",
    "ObservationGroupCfg",
    "ObservationManager",
    "ObservationTermCfg",
    "RewardManager",
    "RewardTermCfg",
    "SceneEntityCfg",
    "TerminationManager",
    "TerminationTermCfg",
]

_MODULE_OF = {
    "ActionManager": "action_manager",
    "ActionTerm": "action_manager",
    "CommandManager": "command_manager",
    "CommandTerm": "command_manager",
    "CurriculumManager": "curriculum_manager",
    "EventManager": "event_manager",
    "ManagerBase": "manager_base",
    "ManagerTermBase": "manager_base",
    "ObservationManager": "observation_manager",
    "RewardManager": "reward_manager",
    "TerminationManager": "termination_manager",
}
__getattr__, __dir__ = lazy(__name__, _MODULE_OF, globals())

"""Configuration of a task (fields and units as in Isaac Lab 3.0's ``ManagerBasedRLEnvCfg``)."""

from __future__ import annotations

from dataclasses import field
from typing import Any

from robotbrain.rl.configclass import MISSING, Config, configclass
from robotbrain.rl.scene.scene_cfg import InteractiveSceneCfg, SimulationCfg


@configclass
class ManagerBasedRLEnvCfg(Config):
    """A task.

    Attributes:
        sim: physics settings.
        scene: what is in the simulation, and the number of environments.
        decimation: physics steps per control step.
        episode_length_s: time limit of an episode [s].
        observations, actions, rewards, terminations: objects whose fields are the terms.
        commands, events, curriculum: likewise, or ``None``.
        seed: of all random draws; ``None``: a new one each time.
        is_finite_horizon: whether running out of time belongs to the task. Learners then treat it as termination.
        compute_final_obs: whether ``extras["final_obs"]`` holds the observations before resets.
        only_positive_rewards: clip the sum of a step's reward terms at zero from below. Not in Isaac Lab (its rough
            ancestor of 2021 had it): without it a policy that earns little learns to end the episode early.
    """

    sim: SimulationCfg = field(default_factory=SimulationCfg)
    scene: InteractiveSceneCfg = MISSING
    decimation: int = MISSING
    episode_length_s: float = MISSING
    observations: Any = MISSING
    actions: Any = MISSING
    rewards: Any = MISSING
    terminations: Any = MISSING
    commands: Any = None
    events: Any = None
    curriculum: Any = None
    seed: int | None = None
    is_finite_horizon: bool = False
    compute_final_obs: bool = False
    only_positive_rewards: bool = False

    def play_mode(self) -> None:
        """Settings to watch a policy: at most 50 environments, no observation noise."""
        self.scene.num_envs = min(self.scene.num_envs, 50)
        for group in vars(self.observations).values():
            if hasattr(group, "enable_corruption"):
                group.enable_corruption = False

"""The environment: many copies of a task, stepped together, each reset in the step in which its episode ends."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from robotbrain.errors import InputError
from robotbrain.rl.envs.manager_based_rl_env_cfg import ManagerBasedRLEnvCfg
from robotbrain.rl.managers.action_manager import ActionManager
from robotbrain.rl.managers.command_manager import CommandManager
from robotbrain.rl.managers.curriculum_manager import CurriculumManager
from robotbrain.rl.managers.event_manager import EventManager
from robotbrain.rl.managers.observation_manager import Observation, ObservationManager
from robotbrain.rl.managers.reward_manager import RewardManager
from robotbrain.rl.managers.termination_manager import TerminationManager
from robotbrain.rl.scene.interactive_scene import InteractiveScene

StepReturn = tuple[dict[str, Observation], torch.Tensor, torch.Tensor, torch.Tensor, dict[str, Any]]
STATE_VERSION = 1


class ManagerBasedRLEnv:
    """A task on ``num_envs`` simulations.

    Tensors are float32 on the CPU, the environments' dimension first. Observations are new tensors at every step;
    rewards, ``terminated`` and ``time_outs`` are too. All random draws come from ``generator``, physics draws nothing:
    equal seeds and actions give equal bytes, with any number of threads.

    An environment whose state is not finite any more terminates and starts anew; the others go on. It is counted in
    ``extras["log"]["Episode_Termination/non_finite_state"]`` and the first time a warning tells.

    Args:
        cfg: the task; it is copied.
        num_threads: of the simulation; ``None``: all processors.

    Attributes:
        cfg: the copy.
        scene: simulations, robots and sensors.
        generator: source of all random draws of the terms.
        episode_length_buf: control steps since the last reset, (num_envs,) long.
        common_step_counter: control steps so far.
        obs_buf, reward_buf, extras: what the last step returned.

    Raises:
        InputError: a configuration that cannot work, with the field at fault.
    """

    def __init__(self, cfg: ManagerBasedRLEnvCfg, *, num_threads: int | None = None) -> None:
        cfg.validate()
        self.cfg = cfg = cfg.copy()
        _check(cfg)
        self.device = torch.device("cpu")
        self.generator = torch.Generator()
        self.seed(cfg.seed)
        self.common_step_counter = 0
        self.episode_length_buf = torch.zeros(cfg.scene.num_envs, dtype=torch.long)
        self.extras: dict[str, Any] = {}
        self.non_finite_count = 0
        self._warned = False
        with torch.no_grad():
            self.scene = InteractiveScene(cfg.scene, cfg.sim, num_threads or 0)
            self.scene.reset()
            self.command_manager = CommandManager(cfg.commands, self)
            self.action_manager = ActionManager(cfg.actions, self)
            self.event_manager = EventManager(cfg.events, self)
            self.termination_manager = TerminationManager(cfg.terminations, self)
            self.observation_manager = ObservationManager(cfg.observations, self)
            self.reward_manager = RewardManager(cfg.rewards, self)
            self.curriculum_manager = CurriculumManager(cfg.curriculum, self)
            self.event_manager.apply("startup")
        self.obs_buf: dict[str, Observation] = {}
        self.reward_buf = torch.zeros(self.num_envs)
        self._was_reset = False

    # -- properties

    @property
    def num_envs(self) -> int:
        """Number of environments."""
        return self.scene.num_envs

    @property
    def physics_dt(self) -> float:
        """Physics time step [s]."""
        return self.cfg.sim.dt

    @property
    def step_dt(self) -> float:
        """Control time step [s]."""
        return self.cfg.sim.dt * self.cfg.decimation

    @property
    def max_episode_length_s(self) -> float:
        """Time limit of an episode [s]."""
        return self.cfg.episode_length_s

    @property
    def max_episode_length(self) -> int:
        """Time limit of an episode in control steps."""
        return math.ceil(round(self.cfg.episode_length_s / self.step_dt, 6))

    @property
    def num_actions(self) -> int:
        """Number of components of the action."""
        return self.action_manager.total_action_dim

    @property
    def unwrapped(self) -> ManagerBasedRLEnv:
        """The environment itself."""
        return self

    # -- operations

    def seed(self, seed: int | None = None) -> int:
        """Seed all random draws; ``None``: with a new seed, which is returned.

        Raises:
            InputError: no whole number, or a negative one.
        """
        if seed is None:
            seed = int(np.random.SeedSequence().generate_state(1)[0])
        if isinstance(seed, bool) or not isinstance(seed, (int, np.integer)) or seed < 0:
            raise InputError("seed", given=seed, expected="a whole number, 0 or more", fix="Give e.g. seed=0.")
        self.generator.manual_seed(int(seed) % 2**63)
        return int(seed)

    def reset(
        self, seed: int | None = None, env_ids: Sequence[int] | torch.Tensor | None = None
    ) -> tuple[dict[str, Observation], dict[str, Any]]:
        """Start new episodes.

        Args:
            seed: seeds the draws anew when given.
            env_ids: the environments; ``None``: all.

        Returns:
            Observations of all environments by group, and extras.

        Raises:
            InputError: an environment that is not there.
        """
        if seed is not None:
            self.seed(seed)
        ids = (
            torch.arange(self.num_envs)
            if env_ids is None
            else torch.from_numpy(np.unique(np.asarray(env_ids, dtype=np.int64)))
        )
        if len(ids) and not (int(ids[0]) >= 0 and int(ids[-1]) < self.num_envs):
            raise InputError(
                "env_ids", given=ids.tolist(), expected=f"indices in 0..{self.num_envs - 1}", fix="Count from 0."
            )
        self.extras = {}
        with torch.inference_mode():
            self._reset_idx(ids)
            obs = self.observation_manager.compute(update_history=True)
        self._was_reset = True
        self.obs_buf = _ordinary(obs)
        return self.obs_buf, self.extras

    def step(self, action: torch.Tensor) -> StepReturn:
        """Advance all environments by one control step; those whose episode ends start a new one at once.

        Args:
            action: (num_envs, num_actions).

        Returns:
            Observations by group (of the new episode where one has begun), reward (num_envs,), terminated and
            time_outs (num_envs,) bool, extras. ``extras["log"]`` is there when an episode ended, and so is
            ``extras["final_obs"]``, the observations of all environments before the resets, if the task asks for it.

        Raises:
            InputError: an action of another shape or not finite, or a step before the first reset.
        """
        if not self._was_reset:
            raise InputError("step", given="no reset yet", expected="reset() first", fix="Call env.reset(seed=...).")
        self.extras = {}
        with torch.inference_mode():  # a tenth quicker than no_grad
            obs, *signals = self._step(action)
        # What leaves is copied: tensors made in inference mode may not take part in training.
        self.obs_buf = _ordinary(obs)
        self.reward_buf, terminated, time_outs = (signal.clone() for signal in signals)
        if "final_obs" in self.extras:
            self.extras["final_obs"] = _ordinary(self.extras["final_obs"])
        return self.obs_buf, self.reward_buf, terminated, time_outs, self.extras

    def _step(self, action: torch.Tensor) -> tuple[dict[str, Observation], torch.Tensor, torch.Tensor, torch.Tensor]:
        self.action_manager.process_action(action)
        diverged = self._simulate()
        self.episode_length_buf += 1
        self.common_step_counter += 1
        terminations = self.termination_manager
        ended = terminations.compute(diverged)
        reward = self.reward_manager.compute(self.step_dt)
        if diverged is not None:
            # These environments stand in their default state already: what the terms see there was not earned.
            self.reward_manager.forget(diverged.nonzero().flatten())
        if not math.isfinite(reward.sum().item()):
            ended = self._drop_rewards(reward)
        if self.cfg.only_positive_rewards:
            reward.clamp_(min=0.0)
        signals = reward, terminations.terminated, terminations.time_outs
        if ended.any().item():
            if self.cfg.compute_final_obs:
                self.extras["final_obs"] = self.observation_manager.peek()
            self._reset_idx(ended.nonzero().flatten())
            self.extras["log"]["Episode_Termination/non_finite_state"] = self.non_finite_count
        self.command_manager.compute(self.step_dt)
        self.event_manager.apply("interval", dt=self.step_dt)
        return self.observation_manager.compute(update_history=True), *signals

    def get_observations(self) -> dict[str, Observation]:
        """The observations that the last step or reset returned."""
        return self.obs_buf

    def close(self) -> None:
        """Nothing to close; for the sake of the interface."""

    # -- state

    @torch.no_grad()
    def state_dict(self) -> dict[str, Any]:
        """Everything a later run needs to continue exactly: tensors, numbers and texts in nested dictionaries."""
        world = self.scene.world
        return {
            "version": STATE_VERSION,
            "physics": torch.from_numpy(world.rows.copy()),
            "model": world.expanded_fields(),
            "own_constants": world.has_own_constants,
            "stage": world.stage,
            "generator": self.generator.get_state(),
            "episode_length_buf": self.episode_length_buf.clone(),
            "common_step_counter": self.common_step_counter,
            "non_finite_count": self.non_finite_count,
            "was_reset": self._was_reset,
            "obs": _ordinary(self.obs_buf),
            "sensors": {k: s.state_dict() for k, s in self.scene.sensors.items() if hasattr(s, "state_dict")},
            "assets": {k: a.state_dict() for k, a in self.scene.articulations.items()},
            "managers": {name: getattr(self, name).state_dict() for name in _MANAGERS},
        }

    @torch.inference_mode()
    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from :meth:`state_dict` of an environment with the same configuration.

        Raises:
            InputError: the state of another task or another number of environments.
        """
        world = self.scene.world
        physics = state.get("physics") if isinstance(state, dict) else None
        if not isinstance(physics, torch.Tensor) or tuple(physics.shape) != world.rows.shape:
            raise InputError(
                "state",
                given=None if physics is None else tuple(physics.shape),
                expected=f"a state of {world.rows.shape[0]} environments with {world.rows.shape[1]} numbers each",
                fix="Load it into an environment made from the same configuration.",
            )
        for name in _MANAGERS:
            getattr(self, name).load_state_dict(state["managers"][name])
        world.load_expanded_fields(state["model"], bool(state.get("own_constants", False)))
        world.stage = max(world.stage, int(state["stage"]))
        np.copyto(world.rows, physics.numpy())
        world.mark_written(None)
        world.flush()
        for name, part in state["sensors"].items():
            self.scene.sensors[name].load_state_dict(part)
        for name, part in state["assets"].items():
            self.scene.articulations[name].load_state_dict(part)
        self.episode_length_buf.copy_(state["episode_length_buf"])
        self.common_step_counter = state["common_step_counter"]
        self.non_finite_count = state["non_finite_count"]
        self._was_reset = state["was_reset"]
        self.obs_buf = state["obs"]
        self.generator.set_state(state["generator"])

    # -- parts of a step

    def _simulate(self) -> torch.Tensor | None:
        """Run the physics of a control step; returns which environments diverged (put into their default state)."""
        world, decimation = self.scene.world, self.cfg.decimation
        if self.action_manager.apply_every_substep:
            found = None
            for substep in range(1, decimation + 1):
                self.action_manager.apply_action()
                bad = world.step(1, is_last=substep == decimation)
                if bad is not None:
                    self.scene.reset(np.flatnonzero(bad))
                    found = bad if found is None else found | bad
        else:
            self.action_manager.apply_action()
            found = world.step(decimation)
            if found is not None:
                self.scene.reset(np.flatnonzero(found))
        self.scene.update(self.step_dt)
        if found is None:
            return None
        ids = np.flatnonzero(found)
        for sensor in self.scene.sensors.values():
            sensor.reset(ids)
        self._count_non_finite(ids.tolist(), "the physics diverged")
        return torch.from_numpy(found)

    def _drop_rewards(self, reward: torch.Tensor) -> torch.Tensor:
        """End environments whose reward is not finite; returns which ones end now."""
        ids = (~torch.isfinite(reward)).nonzero().flatten()
        if len(ids):
            names = self.reward_manager.forget(ids)
            self.termination_manager.end(ids)
            self._count_non_finite(ids.tolist(), f"reward {', '.join(names)} is not finite")
        return self.termination_manager.dones

    def _count_non_finite(self, ids: list[int], reason: str) -> None:
        self.non_finite_count += len(ids)
        if not self._warned:
            self._warned = True
            warnings.warn(
                f"environment {ids[0]} was ended and reset at step {self.common_step_counter}: {reason}. Others go on; "
                "extras['log'] counts such events (this warning comes once).",
                RuntimeWarning,
                stacklevel=4,
            )

    def _reset_idx(self, env_ids: torch.Tensor) -> None:
        """Start new episodes in these environments."""
        self.curriculum_manager.compute(env_ids)
        self.scene.reset(env_ids)
        self.event_manager.apply("reset", env_ids, global_env_step_count=self.common_step_counter)
        log = self.extras["log"] = {}
        for name in _RESET_ORDER:
            log.update(getattr(self, name).reset(env_ids))
        self.episode_length_buf[env_ids] = 0


_RESET_ORDER = (
    "observation_manager",
    "action_manager",
    "reward_manager",
    "curriculum_manager",
    "command_manager",
    "event_manager",
    "termination_manager",
)
_MANAGERS = _RESET_ORDER


def _ordinary(obs: dict[str, Any]) -> dict[str, Any]:
    """Copies of all tensors in the nested dictionary."""
    return {k: v.clone() if isinstance(v, torch.Tensor) else _ordinary(v) for k, v in obs.items()}


def _check(cfg: ManagerBasedRLEnvCfg) -> None:
    if not isinstance(cfg.decimation, int) or cfg.decimation < 1:
        raise InputError("decimation", given=cfg.decimation, expected="a whole number, 1 or more", fix="Give e.g. 4.")
    for name, value in (("sim.dt", cfg.sim.dt), ("episode_length_s", cfg.episode_length_s)):
        if not (isinstance(value, (int, float)) and math.isfinite(value) and value > 0):
            raise InputError(name, given=value, expected="a positive time [s]", fix=f"Set cfg.{name}.")
    if str(cfg.sim.device) != "cpu":
        raise InputError("sim.device", given=cfg.sim.device, expected="'cpu'", fix="MuJoCo's batch runs on the CPU.")

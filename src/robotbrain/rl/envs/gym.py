"""Tasks behind Gymnasium's interfaces: all environments as a ``VectorEnv``, or a single one as an ``Env``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
import torch
from gymnasium.vector.utils import batch_space

from robotbrain.errors import InputError
from robotbrain.rl.envs.manager_based_rl_env import ManagerBasedRLEnv
from robotbrain.rl.envs.manager_based_rl_env_cfg import ManagerBasedRLEnvCfg

Float32 = npt.NDArray[np.float32]
Bool = npt.NDArray[np.bool_]


class TaskVectorEnv(gymnasium.vector.VectorEnv):  # type: ignore[misc]
    """A task as a vector environment, in numpy, with same-step resets.

    The observation is the group ``"policy"``, float32. Where an episode ends, the observation returned is the first of
    the next one; ``info["final_obs"]`` (num_envs, dim) holds the last ones and ``info["_final_obs"]`` tells where.
    ``info["log"]`` are the means that the task logs. A task with ``is_finite_horizon`` reports running out of time as
    termination.

    Args:
        cfg: the task, or an environment made from it with ``compute_final_obs``.
        num_threads: of the simulation; ``None``: all processors.
        action_limit: bound of the action space; ``None``: actions are unbounded.
        obs_group: the group to show.

    Raises:
        InputError: no such group, one that is a dictionary, or an environment without final observations.
    """

    def __init__(
        self,
        cfg: ManagerBasedRLEnvCfg | ManagerBasedRLEnv,
        *,
        num_threads: int | None = None,
        action_limit: float | None = 1.0,
        obs_group: str = "policy",
    ) -> None:
        if isinstance(cfg, ManagerBasedRLEnv):
            self.env = cfg
        else:
            cfg = cfg.copy()  # not replace(): that would run __post_init__ again, over what the caller has changed
            cfg.compute_final_obs = True
            self.env = ManagerBasedRLEnv(cfg, num_threads=num_threads)
        if not self.env.cfg.compute_final_obs:
            raise InputError(
                "environment",
                given="compute_final_obs=False",
                expected="an environment that keeps final observations",
                fix="Set cfg.compute_final_obs = True before you make the environment.",
            )
        dims = self.env.observation_manager.group_obs_dim
        shape = dims.get(obs_group)
        if not isinstance(shape, tuple):
            raise InputError(
                "obs_group",
                given=obs_group,
                expected=f"a concatenated group of {list(dims)}",
                fix="Name the group that the policy sees 'policy'.",
            )
        self._group = obs_group
        self.num_envs = self.env.num_envs
        self.metadata = {
            "autoreset_mode": gymnasium.vector.AutoresetMode.SAME_STEP,
            "render_modes": [],
            "render_fps": round(1.0 / self.env.step_dt),
        }
        bound = np.inf if action_limit is None else action_limit
        self.single_observation_space = gymnasium.spaces.Box(-np.inf, np.inf, shape, np.float32)
        self.single_action_space = gymnasium.spaces.Box(-bound, bound, (self.env.num_actions,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Float32, dict[str, Any]]:
        """Start new episodes in all environments.

        Args:
            seed: of all draws; a sequence (one per environment) is combined into one seed, as the environments share
                their draws.
            options: ``reset_mask`` (num_envs,) bool chooses the environments; nothing else.

        Raises:
            InputError: a seed or mask that cannot be used.
        """
        mask: Any = (options or {}).get("reset_mask")
        env_ids = None if mask is None else torch.from_numpy(np.flatnonzero(mask))
        if env_ids is not None and np.shape(mask) != (self.num_envs,):
            raise InputError(
                "reset_mask", given=np.shape(mask), expected=f"({self.num_envs},)", fix="One flag per environment."
            )
        obs, _ = self.env.reset(seed=_one_seed(seed), env_ids=env_ids)
        return self._observation(obs), {}

    def step(self, actions: npt.ArrayLike) -> tuple[Float32, Float32, Bool, Bool, dict[str, Any]]:
        """Advance all environments by one control step.

        Args:
            actions: (num_envs, action_dim).

        Returns:
            Observation, reward, terminated, truncated, info.

        Raises:
            InputError: actions of another shape or not finite.
        """
        tensor = torch.from_numpy(np.ascontiguousarray(actions, dtype=np.float32))
        obs, reward, terminated, time_outs, extras = self.env.step(tensor)
        ended, cut = terminated.numpy(), time_outs.numpy()
        if self.env.cfg.is_finite_horizon:
            ended, cut = ended | cut, np.zeros_like(cut)
        info: dict[str, Any] = {}
        if "final_obs" in extras:
            info = {"final_obs": self._observation(extras["final_obs"]), "_final_obs": ended | cut}
            info["log"] = extras["log"]
        return self._observation(obs), reward.numpy(), ended, cut, info

    def state_dict(self) -> dict[str, Any]:
        """Everything a later run needs to continue exactly."""
        return self.env.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from :meth:`state_dict`."""
        self.env.load_state_dict(state)

    @property
    def observation(self) -> Float32:
        """What the last step or reset returned, (num_envs, dim)."""
        return self._observation(self.env.get_observations())

    def render(self) -> None:
        """Nothing is drawn here; see ``robotbrain.rl.view``."""

    def close_extras(self, **kwargs: Any) -> None:
        """Nothing to close."""

    def _observation(self, obs: dict[str, Any]) -> Float32:
        result: Float32 = obs[self._group].numpy()
        return result


class TaskEnv(gymnasium.Env):  # type: ignore[misc]
    """A task with a single environment as a plain Gymnasium environment.

    Args:
        cfg: the task; its number of environments is ignored.
        action_limit: bound of the action space; ``None``: actions are unbounded.
        obs_group: the group of observations to show.
    """

    def __init__(
        self, cfg: ManagerBasedRLEnvCfg, *, action_limit: float | None = 1.0, obs_group: str = "policy"
    ) -> None:
        cfg = cfg.copy()
        cfg.scene.num_envs = 1
        self._vector = TaskVectorEnv(cfg, num_threads=1, action_limit=action_limit, obs_group=obs_group)
        self.observation_space = self._vector.single_observation_space
        self.action_space = self._vector.single_action_space
        self.metadata = {"render_modes": [], "render_fps": self._vector.metadata["render_fps"]}
        self.render_mode = None

    @property
    def task(self) -> ManagerBasedRLEnv:
        """The environment underneath."""
        return self._vector.env

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Float32, dict[str, Any]]:
        """Start a new episode.

        Args:
            seed: of all draws from here on.
            options: none are known.
        """
        super().reset(seed=seed)
        obs, info = self._vector.reset(seed=seed)
        return obs[0], info

    def step(self, action: npt.ArrayLike) -> tuple[Float32, float, bool, bool, dict[str, Any]]:
        """Advance by one control step; after the end of an episode :meth:`reset` starts the next one."""
        obs, reward, terminated, truncated, info = self._vector.step(np.asarray(action, dtype=np.float32)[None])
        last = info.get("final_obs", obs)
        log = {"log": info["log"]} if "log" in info else {}
        return last[0], float(reward[0]), bool(terminated[0]), bool(truncated[0]), log


def _one_seed(seed: int | Sequence[int | None] | None) -> int | None:
    if seed is None or isinstance(seed, (int, np.integer)):
        return None if seed is None else int(seed)
    numbers = [s for s in seed if s is not None]
    if not numbers or any(s < 0 for s in numbers):
        return None if not numbers else _bad_seed(seed)
    return int(np.random.SeedSequence(numbers).generate_state(1)[0])


def _bad_seed(seed: object) -> int:
    raise InputError("seed", given=seed, expected="whole numbers, 0 or more", fix="Give e.g. seed=0.")

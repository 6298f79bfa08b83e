"""Configurations of the terms a task is made of (field names, units and defaults as in Isaac Lab 3.0)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import field
from typing import TYPE_CHECKING, Any, Literal

from robotbrain.errors import InputError
from robotbrain.rl.configclass import MISSING, Config, configclass

if TYPE_CHECKING:
    from robotbrain.rl.managers.action_manager import ActionTerm
    from robotbrain.rl.managers.command_manager import CommandTerm
    from robotbrain.rl.noise_cfg import NoiseCfg


@configclass
class ManagerTermBaseCfg(Config):
    """A term: what to call and with which keyword arguments.

    Attributes:
        func: a function ``func(env, **params)`` or a subclass of :class:`ManagerTermBase`, created once.
        params: its keyword arguments; every :class:`SceneEntityCfg` in it is resolved when the environment is made.
    """

    func: Callable[..., Any] = MISSING
    params: dict[str, Any] = field(default_factory=dict)


@configclass
class ObservationTermCfg(ManagerTermBaseCfg):
    """An observation term: ``func`` returns (num_envs, ...); then noise, clip, scale, delay, history, in this order.

    Attributes:
        noise: corruption, applied only when the group has ``enable_corruption``.
        clip: lower and upper bound, in the unit of ``func``.
        scale: factor, one number or one per component.
        delay_min_lag, delay_max_lag: bounds of a delay in control steps, drawn per environment at its reset; 0: none.
        delay_hold_prob: probability to keep the lag at a step, else it is drawn anew.
        history_length: number of samples kept, oldest first; 0: only the present one, without a time axis.
        flatten_history_dim: (num_envs, history * dim) instead of (num_envs, history, dim).
    """

    noise: NoiseCfg | None = None
    clip: tuple[float, float] | None = None
    scale: tuple[float, ...] | float | None = None
    delay_min_lag: int = 0
    delay_max_lag: int = 0
    delay_hold_prob: float = 1.0
    history_length: int = 0
    flatten_history_dim: bool = True

    def validate_config(self) -> None:
        """Check the delay's bounds.

        Raises:
            InputError: lags that are no integers with ``0 <= min <= max``, or a probability outside 0..1.
        """
        lags = (self.delay_min_lag, self.delay_max_lag)
        if not all(type(lag) is int for lag in lags) or not 0 <= lags[0] <= lags[1]:
            raise InputError(
                "delay_min_lag, delay_max_lag",
                given=lags,
                expected="whole control steps with 0 <= min <= max",
                fix="Give the delay in control steps, e.g. delay_min_lag=0, delay_max_lag=2.",
            )
        if not 0.0 <= self.delay_hold_prob <= 1.0:
            raise InputError(
                "delay_hold_prob", given=self.delay_hold_prob, expected="a probability", fix="Give a number in 0..1."
            )


@configclass
class ObservationGroupCfg(Config):
    """A group of observation terms, e.g. what the policy sees.

    Attributes:
        concatenate_terms: one tensor (num_envs, sum of dims) in the order of the terms, else a dictionary.
        concatenate_dim: the dimension to concatenate along, not counting the batch dimension when positive.
        enable_corruption: whether the terms' noise is applied.
        history_length: overrides that of every term when given.
        flatten_history_dim: goes with ``history_length``.
        history_order: ``"term"`` keeps each term's samples together, ``"time"`` each step's terms.
    """

    concatenate_terms: bool = True
    concatenate_dim: int = -1
    enable_corruption: bool = False
    history_length: int | None = None
    flatten_history_dim: bool = True
    history_order: Literal["term", "time"] = "term"


@configclass
class RewardTermCfg(ManagerTermBaseCfg):
    """A reward term: ``func`` returns (num_envs,); it counts ``weight * step_dt`` times (so weights are per second)."""

    weight: float = MISSING


@configclass
class TerminationTermCfg(ManagerTermBaseCfg):
    """A termination term: ``func`` returns (num_envs,) bool; ``time_out``: the episode is cut off, not at its end."""

    time_out: bool = False


@configclass
class CurriculumTermCfg(ManagerTermBaseCfg):
    """A curriculum term: ``func(env, env_ids, **params)`` runs before a reset; what it returns is logged."""


@configclass
class EventTermCfg(ManagerTermBaseCfg):
    """An event: ``func(env, env_ids, **params)`` changes the simulation.

    Attributes:
        mode: ``"startup"`` once, ``"reset"`` at each reset, ``"interval"`` again and again.
        interval_range_s: bounds of the time between two applications [s] (``"interval"`` only).
        is_global_time: one timer for all environments instead of one each.
        resample_interval_on_reset: whether a reset draws that environment's timer anew.
        min_step_count_between_reset: control steps that must lie between two applications (``"reset"`` only).
    """

    mode: str = MISSING
    interval_range_s: tuple[float, float] | None = None
    is_global_time: bool = False
    resample_interval_on_reset: bool = True
    min_step_count_between_reset: int = 0


@configclass
class ActionTermCfg(Config):
    """An action term: ``class_type(cfg, env)`` turns part of the action into commands of the asset's joints.

    Attributes:
        class_type: subclass of :class:`ActionTerm`.
        asset_name: the asset's name in the scene.
        debug_vis: kept for Isaac Lab's sake; nothing is drawn.
        clip: bounds of the processed action by joint name (regular expressions).
    """

    class_type: type[ActionTerm] = MISSING
    asset_name: str = MISSING
    debug_vis: bool = False
    clip: dict[str, tuple[float, float]] | None = None


@configclass
class CommandTermCfg(Config):
    """A command: ``class_type(cfg, env)`` generates what the robot shall do.

    Attributes:
        class_type: subclass of :class:`CommandTerm`.
        resampling_time_range: bounds of the time a command lasts [s].
        debug_vis: kept for Isaac Lab's sake; nothing is drawn.
    """

    class_type: type[CommandTerm] = MISSING
    resampling_time_range: tuple[float, float] = MISSING
    debug_vis: bool = False

"""The batch of simulations under a scene: stepping, and which data are out of date.

State (``qpos``, ``qvel``, ``ctrl`` ...) is written at once and read back as written. Derived data (body poses, sensors)
follow the state: :meth:`World.derived` first runs the forward computation of those environments that were written to,
in one call. A step computes derived data at its new state only as far as somebody has ever asked for them. ``tick``
numbers the states, so that whoever caches something computed from them knows when it is stale.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any, TypeAlias

import mujoco
import numpy as np
import numpy.typing as npt
import torch
from mujoco.batch import Batch, SimulationError

from robotbrain.errors import InputError

Tensor = torch.Tensor
Float64 = npt.NDArray[np.float64]
EnvIds: TypeAlias = "torch.Tensor | slice | list[int] | npt.NDArray[np.integer] | None"

STATE_LIMIT = 1.0e10
"""MuJoCo calls a state bad beyond this (mjMAXVAL)."""
_NONE, _POS, _VEL, _ACC = (int(getattr(mujoco.mjtStage, f"mjSTAGE_{n}")) for n in ("NONE", "POS", "VEL", "ACC"))
_STAGE_OF = {"xpos": _POS, "xquat": _POS, "xmat": _POS, "subtree_com": _POS, "site_xpos": _POS, "geom_xpos": _POS}
BOUND = ("xpos", "xquat", "xmat", "cvel", "subtree_com", "qacc", "qfrc_actuator", "sensordata")
"""Derived fields that are bound from the start; others are when they are first asked for."""


class World:
    """``num_envs`` simulations of one model.

    MuJoCo's automatic reset is switched off: it would put a diverged simulation back to the model's default state
    without a word. :meth:`step` reports diverged environments instead.

    Args:
        model: MuJoCo model (its disable flags are changed).
        num_envs: number of environments.
        num_threads: of the batch; 0: all processors. Results do not depend on it.

    Raises:
        InputError: ``num_envs`` or ``num_threads`` out of range.
    """

    def __init__(self, model: mujoco.MjModel, num_envs: int, num_threads: int = 0) -> None:
        if not isinstance(num_envs, int) or num_envs < 1:
            raise InputError("num_envs", given=num_envs, expected="a positive number", fix="Give e.g. num_envs=64.")
        if not isinstance(num_threads, int) or num_threads < 0:
            raise InputError("num_threads", given=num_threads, expected="0 (all) or more", fix="Leave it out.")
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        self.model, self.num_envs = model, num_envs
        self.batch = Batch(model, num_envs, num_threads)
        self.time: Float64 = self.batch.bind("time")
        self.qpos: Float64 = self.batch.bind("qpos")
        self.qvel: Float64 = self.batch.bind("qvel")
        self.ctrl: Float64 = self.batch.bind("ctrl")
        self.rows: Float64 = self.qpos.base  # (num_envs, nstate): everything that makes up the state
        assert self.rows.shape == (num_envs, self.batch.nstate) and self.time.base is self.rows
        start = (self.qpos.ctypes.data - self.rows.ctypes.data) // self.rows.itemsize
        self._motion = torch.from_numpy(self.rows[:, start : start + model.nq + model.nv])
        assert self.qvel.ctypes.data == self.qpos.ctypes.data + model.nq * self.rows.itemsize
        self.motion = torch.zeros(num_envs, model.nq + model.nv)
        """Positions and velocities, (num_envs, nq + nv) float32; call :meth:`read_motion` before reading it."""
        self._motion_tick = -1
        self.tick = 0
        self._written_tick = np.zeros(num_envs, dtype=np.int64)
        self._dirty = np.zeros(num_envs, dtype=bool)
        self._any_dirty = False
        self._const_dirty: npt.NDArray[np.bool_] | None = None
        self._derived: dict[str, Float64] = {name: self.batch.bind(name) for name in BOUND}
        self._derived_tensors: dict[str, torch.Tensor] = {}
        self._stepped_tick = 0
        self.stage = _NONE
        """What a step computes at its new state: the highest mjtStage that anything asked for has needed."""
        self._computed = _ACC
        self._expanded: dict[str, npt.NDArray[Any]] = {}
        self.before_step: list[Callable[[], None]] = []
        self.batch.reset(stage=_NONE)
        self._initial: Float64 = self.rows[0].copy()
        self.mark_written(None)

    def ids(self, env_ids: EnvIds) -> npt.NDArray[np.int64]:
        """The environments as an array of indices."""
        if env_ids is None:
            return np.arange(self.num_envs)
        if isinstance(env_ids, slice):
            return np.arange(self.num_envs)[env_ids]
        if isinstance(env_ids, torch.Tensor) and env_ids.ndim == 1 and env_ids.dtype is torch.int64:
            found: npt.NDArray[np.int64] = env_ids.numpy()
            return found
        return np.atleast_1d(np.asarray(env_ids)).astype(np.int64, copy=False)

    def step(self, nstep: int, *, is_last: bool = True) -> npt.NDArray[np.bool_] | None:
        """Advance by ``nstep`` physics steps.

        Args:
            nstep: physics steps.
            is_last: whether derived data are wanted at the new state; without they are computed if somebody asks.

        Returns:
            Which environments diverged (non-finite or huge state), (num_envs,) bool; ``None``: none of them.
        """
        for hook in self.before_step:
            hook()
        self._apply_constants()
        failed = None
        stage = self.stage if is_last else _NONE
        try:
            self.batch.step(nstep=nstep, stage=stage)
        except SimulationError as error:
            failed = error.ids
        self.tick += 1
        self._stepped_tick = self.tick
        self._computed = stage
        if self._any_dirty:
            self._any_dirty = False
            self._dirty.fill(False)
        if failed is None and abs(self.read_motion().sum().item()) < STATE_LIMIT:  # false for NaN too
            return None
        diverged: npt.NDArray[np.bool_] = ~(np.abs(self._motion.numpy()) < STATE_LIMIT).all(axis=1)
        if failed is not None:
            diverged[failed] = True
        return diverged if diverged.any() else None

    def reset(self, env_ids: EnvIds) -> None:
        """Put environments to the model's default state (the forward computation follows when it is needed)."""
        ids = self.ids(env_ids)
        self.rows[ids] = self._initial
        self.mark_written(ids)

    def mark_written(self, env_ids: EnvIds) -> None:
        """Tell that the state of these environments was written to."""
        self.tick += 1
        index = slice(None) if env_ids is None else self.ids(env_ids)
        self._dirty[index] = True
        self._written_tick[index] = self.tick
        self._any_dirty = True

    def mark_const_dirty(self, env_ids: EnvIds = None) -> None:
        """Tell that model parameters were written to from which MuJoCo derives constants (masses, inertias ...)."""
        if self._const_dirty is None:
            self._const_dirty = np.zeros(self.num_envs, dtype=bool)
        self._const_dirty[slice(None) if env_ids is None else self.ids(env_ids)] = True
        self.mark_written(env_ids)

    def changed_since(self, tick: int) -> npt.NDArray[np.int64] | None:
        """The environments whose state changed after ``tick``; ``None``: all of them."""
        if tick < self._stepped_tick:
            return None
        return np.flatnonzero(self._written_tick > tick)

    def written_since(self, tick: int) -> npt.NDArray[np.int64]:
        """The environments that were written to after ``tick``, not by physics."""
        return np.flatnonzero(self._written_tick > tick)

    def read_motion(self) -> torch.Tensor:
        """:attr:`motion`, up to date: one copy per state, however often it is asked for."""
        if self._motion_tick != self.tick:
            self.motion.copy_(self._motion)
            self._motion_tick = self.tick
        return self.motion

    def derived(self, name: str) -> Float64:
        """A derived field of all environments (``xpos``, ``sensordata`` ...) at the present state; read-only."""
        needed = _STAGE_OF.get(name, _VEL)
        self.stage = max(self.stage, needed)
        found = self.measured(name)
        if self._computed < needed:  # the first time only: from now on each step computes it
            self._recompute(None)
            self._computed = _ACC
        return found

    def measured(self, name: str) -> Float64:
        """A derived field as the last physics step left it, for what belongs to it (``qacc``, forces); read-only.

        Environments whose state was written to since have the values of their new state.
        """
        found = self._derived.get(name)
        if found is None:
            found = self._derived[name] = self.batch.bind(name)
            self._recompute(None)
        self.flush()
        return found

    def derived_tensor(self, name: str) -> torch.Tensor:
        """The memory of :meth:`derived` as a tensor; it must not be written to."""
        return self._tensor(name, self.derived(name))

    def measured_tensor(self, name: str) -> torch.Tensor:
        """The memory of :meth:`measured` as a tensor; it must not be written to."""
        return self._tensor(name, self.measured(name))

    def _tensor(self, name: str, values: Float64) -> torch.Tensor:
        found = self._derived_tensors.get(name)
        if found is None:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)  # that the array is read-only: so is our use of it
                found = self._derived_tensors[name] = torch.from_numpy(values)
        return found

    def flush(self) -> None:
        """Run the forward computation of the environments that were written to."""
        if self._any_dirty:
            self._apply_constants()
            self._recompute(np.flatnonzero(self._dirty))
            self._dirty.fill(False)
            self._any_dirty = False

    def expand(self, name: str) -> npt.NDArray[Any]:
        """A model field with values of its own in every environment, live, (num_envs, ...)."""
        found = self._expanded.get(name)
        if found is None:
            found = self._expanded[name] = self.batch.expand(name)
        return found

    def expanded_fields(self) -> dict[str, torch.Tensor]:
        """Copies of the model fields that differ between environments."""
        return {name: torch.from_numpy(values.copy()) for name, values in self._expanded.items()}

    @property
    def has_own_constants(self) -> bool:
        """Whether derived constants were ever computed anew from fields that differ between environments."""
        return self._const_dirty is not None

    def load_expanded_fields(self, fields: dict[str, torch.Tensor], constants: bool = False) -> None:
        """Put back :meth:`expanded_fields`; MuJoCo's derived constants follow.

        Args:
            fields: as given there.
            constants: :attr:`has_own_constants` of the world they come from.
        """
        for name in {*fields, *self._expanded}:
            live = self.expand(name)
            np.copyto(live, fields[name].numpy() if name in fields else _model_value(self.model, name))
        if constants or self.has_own_constants:
            self.mark_const_dirty(None)

    def _recompute(self, ids: npt.NDArray[np.int64] | None) -> None:
        try:
            self.batch.forward(ids)
        except SimulationError as error:
            raise InputError(
                "simulation state",
                given=f"environments {error.ids.tolist()}",
                expected="a state MuJoCo can compute",
                fix=f"MuJoCo says: {error}",
            ) from error

    def _apply_constants(self) -> None:
        if self._const_dirty is not None and self._const_dirty.any():
            self.batch.set_const(np.flatnonzero(self._const_dirty))
            self._const_dirty.fill(False)


def _model_value(model: mujoco.MjModel, name: str) -> npt.NDArray[Any]:
    value: Any = model
    for part in name.split("."):
        value = getattr(value, part)
    return np.array(value)


class TensorView:
    """A field of an asset's data; ``.torch`` is the tensor, computed when the state has changed since the last look.

    The tensor is the same object each time and is overwritten in place: clone it to keep a value.
    """

    __slots__ = ("_columns", "_source", "_tensor")

    def __init__(self, tensor: Tensor, source: Source | None = None) -> None:
        self._tensor, self._source = tensor, source
        self._columns: dict[tuple[Any, ...], Tensor] = {}

    @property
    def torch(self) -> Tensor:
        """The up-to-date tensor."""
        source = self._source
        if source is not None and source.tick != source.world.tick:
            source.compute()
            source.tick = source.world.tick
        return self._tensor

    def columns(self, ids: slice | Tensor) -> Tensor:
        """``torch[:, ids]``; for a slice a view that is made once, which saves its cost at every step."""
        tensor = self.torch
        if not isinstance(ids, slice):
            return tensor[:, ids]
        key = (ids.start, ids.stop, ids.step)
        found = self._columns.get(key)
        if found is None:
            found = self._columns[key] = tensor[:, ids]
        return found


class Source:
    """Something computed from the state, at most once per state.

    Attributes:
        world: whose state.
        compute: writes the result into tensors of its own.
        tick: of the state that it was computed from.
    """

    __slots__ = ("compute", "tick", "world")

    def __init__(self, world: World, compute: Callable[[], object]) -> None:
        self.world, self.compute, self.tick = world, compute, -1

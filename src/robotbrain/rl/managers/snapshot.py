"""Saving and restoring what managers and terms remember, as plain dictionaries of tensors and numbers."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import torch

from robotbrain.errors import InputError

_PLAIN = (bool, int, float, str, type(None))
_SKIP = frozenset({"_env", "_asset", "asset", "robot", "_robot", "env", "_world", "_scene", "scene"})


def capture(thing: Any) -> Any:
    """A copy of the tensors, arrays, numbers and texts in an object's attributes, nested.

    References to the environment and its assets are left out, and so is everything that is no data (functions ...).
    """
    return _capture(thing, set())


def restore(thing: Any, state: Any) -> Any:
    """Put back what :func:`capture` gave; tensors in place, so that whoever shares them sees the old values.

    Returns:
        The value to keep, for what cannot be changed in place.

    Raises:
        InputError: a tensor of another shape, i.e. a state of another task.
    """
    if isinstance(thing, torch.Tensor) and isinstance(state, torch.Tensor):
        if thing.shape != state.shape and not thing.numel():  # made at its first use, so shared with nobody yet
            return state.clone()
        if thing.shape != state.shape:
            raise InputError(
                "state",
                given=tuple(state.shape),
                expected=f"a tensor {tuple(thing.shape)}",
                fix="Load it into an environment with the same configuration.",
            )
        if not torch.equal(thing, state):  # expanded tensors cannot be written to, and need not be
            thing.copy_(state)
        return thing
    if isinstance(thing, np.ndarray) and isinstance(state, torch.Tensor):
        if thing.flags.writeable:
            np.copyto(thing, state.numpy())
        return thing
    if isinstance(thing, dict) and isinstance(state, dict):
        for key, value in state.items():
            thing[key] = restore(thing.get(key), value)
        return thing
    if isinstance(thing, list) and isinstance(state, dict):
        for key, value in state.items():
            thing[int(key)] = restore(thing[int(key)], value)
        return thing
    if isinstance(state, dict):
        if thing is not None:
            for key, value in state.items():
                old = getattr(thing, key, None)
                new = restore(old, value)
                if new is not old:
                    setattr(thing, key, new)
        return thing
    return state.clone() if isinstance(state, torch.Tensor) else state


def _capture(thing: Any, seen: set[int]) -> Any:
    if isinstance(thing, torch.Tensor):
        return thing.detach().clone()
    if isinstance(thing, np.ndarray):
        return torch.from_numpy(thing.copy()) if thing.dtype.kind in "fiub" else None
    if isinstance(thing, _PLAIN):
        return thing
    if isinstance(thing, tuple):
        return thing if all(isinstance(item, _PLAIN) for item in thing) else None
    if id(thing) in seen:
        return None
    seen.add(id(thing))
    if isinstance(thing, dict):
        return _kept({str(k): v for k, v in thing.items() if isinstance(k, str)}, seen)
    if isinstance(thing, list):
        return _kept({str(i): v for i, v in enumerate(thing)}, seen)
    if dataclasses.is_dataclass(thing) and not isinstance(thing, type):
        if thing.__dataclass_params__.frozen:  # type: ignore[attr-defined]  # a setting: cannot have changed
            return None
        return _kept({f.name: getattr(thing, f.name) for f in dataclasses.fields(thing)}, seen)
    if hasattr(thing, "__dict__") and not callable_only(thing):
        return _kept({k: v for k, v in vars(thing).items() if k not in _SKIP}, seen)
    return None


def _kept(items: dict[str, Any], seen: set[int]) -> dict[str, Any]:
    """The items that hold data; ``None`` stays where it was a value."""
    found = {key: _capture(value, seen) for key, value in items.items()}
    return {k: v for k, v in found.items() if (v is not None and v != {}) or items[k] is None}


def callable_only(thing: Any) -> bool:
    """Whether it is a function, a class or a module."""
    return isinstance(thing, type) or type(thing).__name__ in ("function", "builtin_function_or_method", "module")

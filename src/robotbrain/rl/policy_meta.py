"""What a policy file says about itself: which observations in which order, what its actions mean, how often it runs.

The names follow what exporters around Isaac Lab write into an ONNX file (``observation_names``, ``joint_names``,
``default_joint_pos``, ``action_scale`` ...); every value in the file is JSON.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

import robotbrain
from robotbrain.errors import InputError

FORMAT = "robotbrain-policy/1"
ACTION_KINDS: Mapping[str, str] = MappingProxyType(
    {
        "joint_position": "joint angles: default_joint_pos (or action_offset) + action_scale * action, rad",
        "relative_joint_position": "joint angles: those of every physics step + action_scale * action, rad",
        "held_relative_joint_position": "joint angles: those when the action was made + action_scale * action, rad",
        "joint_velocity": "joint speeds: action_offset + action_scale * action, rad/s",
        "joint_effort": "joint torques: action_offset + action_scale * action, N m",
        "body_velocity": "of the base: action_offset + action_scale * action; forward m/s, turning rad/s",
    }
)
"""What actions can mean. An action is clipped to ``action_low`` .. ``action_high`` before it is scaled."""
MAX_VALUE_CHARS = 65_536
MAX_KEYS = 64

Numbers = tuple[float, ...]


@dataclass(frozen=True)
class PolicyMeta:
    """Everything a robot must know to run a policy that it did not train.

    Tuples of numbers have one entry per action, unless stated otherwise; an empty tuple means "not stated".

    Args:
        task: registered name, e.g. ``"reach"``.
        observation_names: (term, size) pairs in the order in which they are concatenated.
        control_dt: time from one action to the next, s.
        action_kind: one of ``ACTION_KINDS``.
        action_names: of the actions; the joints by default.
        action_scale: from action to command; one number stands for all.
        action_offset: added after scaling.
        action_low, action_high: the action is clipped to them first.
        observation_scales: per term: factors that were multiplied into it before the policy saw it, one or one per
            entry; the policy expects scaled values.
        joint_names: in the order of all joint tuples.
        default_joint_pos: rad.
        joint_stiffness: of the position servos, N m/rad.
        joint_damping: of the servos, N m s/rad.
        command_names: of the command terms among the observations.
        provenance: how it was trained (JSON types only).
        kit_version: of this kit.

    Raises:
        InputError: a field of the wrong kind, not finite, or of the wrong length.
    """

    task: str
    observation_names: tuple[tuple[str, int], ...]
    control_dt: float
    action_kind: str
    action_names: tuple[str, ...] = ()
    action_scale: float | Numbers = 1.0
    action_offset: Numbers = ()
    action_low: Numbers = ()
    action_high: Numbers = ()
    observation_scales: tuple[Numbers, ...] = ()
    joint_names: tuple[str, ...] = ()
    default_joint_pos: Numbers = ()
    joint_stiffness: Numbers = ()
    joint_damping: Numbers = ()
    command_names: tuple[str, ...] = ()
    provenance: Mapping[str, Any] = field(default_factory=dict, hash=False)
    kit_version: str = robotbrain.__version__

    def __post_init__(self) -> None:
        put = object.__setattr__
        for name in ("task", "action_kind", "kit_version"):
            _require(isinstance(getattr(self, name), str), name, getattr(self, name), "text")
        _require(self.action_kind in ACTION_KINDS, "action_kind", self.action_kind, "one of " + ", ".join(ACTION_KINDS))
        put(self, "observation_names", _pairs(self.observation_names))
        put(self, "control_dt", _number("control_dt", self.control_dt))
        _require(self.control_dt > 0.0, "control_dt", self.control_dt, "seconds, more than 0")
        for name in ("action_names", "joint_names", "command_names"):
            put(self, name, _texts(name, getattr(self, name)))
        if not self.action_names:
            put(self, "action_names", self.joint_names)
        for name in _PER_ACTION:
            put(self, name, _numbers(name, getattr(self, name)))
        scale = self.action_scale
        put(
            self,
            "action_scale",
            _number("action_scale", scale) if _is_number(scale) else _numbers("action_scale", scale),
        )
        put(
            self,
            "observation_scales",
            tuple(_numbers("observation_scales", s) for s in _items(self.observation_scales)),
        )
        put(self, "provenance", _plain_json(self.provenance))
        self._check_lengths()

    def _check_lengths(self) -> None:
        count = self.action_dim
        _require(count > 0, "action_names", (), "the names of the actions (or joint_names)")
        for name in (*_PER_ACTION, "action_scale", "joint_names"):
            value = getattr(self, name)
            if isinstance(value, tuple) and value:
                _require(len(value) == count, name, value, f"{count} entries, one per action")
        if self.action_low and self.action_high:
            fits = all(low <= high for low, high in zip(self.action_low, self.action_high, strict=True))
            _require(fits, "action_low", self.action_low, "nowhere above action_high")
        scales, sizes = self.observation_scales, [size for _, size in self.observation_names]
        fits = not scales or (
            len(scales) == len(sizes) and all(len(s) in (1, size) for s, size in zip(scales, sizes, strict=True))
        )
        _require(fits, "observation_scales", scales, "for each observation term one factor or one per entry")

    @property
    def observation_dim(self) -> int:
        """Length of the observation vector."""
        return sum(size for _, size in self.observation_names)

    @property
    def action_dim(self) -> int:
        """Length of the action vector."""
        return len(self.action_names)

    def clip(self, actions: ArrayLike) -> NDArray[np.float64]:
        """Return actions (..., A) within ``action_low`` and ``action_high``."""
        low = np.asarray(self.action_low) if self.action_low else -np.inf
        high = np.asarray(self.action_high) if self.action_high else np.inf
        clipped: NDArray[np.float64] = np.clip(np.asarray(actions, dtype=np.float64), low, high)
        return clipped

    def commands(self, actions: ArrayLike, joint_pos: ArrayLike | None = None) -> NDArray[np.float64]:
        """Return what the actions (..., A) ask of the robot, see ``ACTION_KINDS``.

        Args:
            actions: the policy's output.
            joint_pos: joint angles (..., A) now, rad; only for the relative kinds.

        Raises:
            InputError: a relative kind without ``joint_pos``.
        """
        change: NDArray[np.float64] = self.clip(actions) * np.asarray(self.action_scale)
        if self.action_kind.endswith("relative_joint_position"):
            if joint_pos is None:
                raise InputError(
                    "joint_pos",
                    given=None,
                    expected="joint angles (rad)",
                    fix=f"{self.action_kind} is relative to them.",
                )
            return np.asarray(joint_pos, dtype=np.float64) + change
        offset = self.action_offset
        if not offset and self.action_kind == "joint_position":
            offset = self.default_joint_pos
        return change + np.asarray(offset) if offset else change

    def to_metadata(self) -> dict[str, str]:
        """Return the metadata of an ONNX file: JSON by key, keys sorted."""
        data: dict[str, Any] = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        data["observation_names"] = [name for name, _ in self.observation_names]
        data["observation_dims"] = [size for _, size in self.observation_names]
        data["format"] = FORMAT
        return {key: json.dumps(data[key], ensure_ascii=False, sort_keys=True, allow_nan=False) for key in sorted(data)}

    @classmethod
    def from_metadata(cls, metadata: Mapping[str, str]) -> PolicyMeta:
        """Read what :meth:`to_metadata` wrote; the file may be a stranger's.

        Raises:
            InputError: a key is missing, is no JSON, or has a value that makes no sense.
        """
        keys = {f.name for f in dataclasses.fields(cls)} | {"observation_dims", "format"}
        if len(metadata) > MAX_KEYS:
            raise _error("number of keys", len(metadata), f"at most {MAX_KEYS}")
        data = {key: _parse(key, text) for key, text in metadata.items() if key in keys}
        for key in (
            "format",
            "task",
            "observation_names",
            "observation_dims",
            "control_dt",
            "action_kind",
            "action_names",
        ):
            if key not in data:
                raise _error(key, "nothing", "this key", "Export the policy with robotbrain.rl.export.export_policy.")
        _require(data.pop("format") == FORMAT, "format", metadata["format"], repr(FORMAT))
        names, dims = _items(data.pop("observation_names")), _items(data.pop("observation_dims"))
        _require(len(names) == len(dims), "observation_dims", dims, f"{len(names)} sizes, one per observation term")
        return cls(observation_names=tuple(zip(names, dims, strict=True)), **data)


_PER_ACTION = (
    "action_offset",
    "action_low",
    "action_high",
    "default_joint_pos",
    "joint_stiffness",
    "joint_damping",
)


def _error(key: str, given: object, expected: str, fix: str = "Correct it where the policy is exported.") -> InputError:
    return InputError(f"policy metadata {key!r}", given=given, expected=expected, fix=fix)


def _require(holds: bool, key: str, given: object, expected: str) -> None:
    if not holds:
        raise _error(key, given, expected)


def _is_number(value: object) -> bool:
    return isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)


def _number(key: str, value: Any) -> float:
    # A JSON integer may have more digits than a float has range.
    _require(_is_number(value) and abs(value) < 1e30 and math.isfinite(value), key, value, "a finite number")
    return float(value)


def _items(values: Any) -> tuple[Any, ...]:
    return tuple(values) if isinstance(values, list | tuple | np.ndarray) else (values,)


def _numbers(key: str, values: Any) -> Numbers:
    return tuple(_number(key, value) for value in _items(values))


def _texts(key: str, values: Any) -> tuple[str, ...]:
    found = _items(values)
    _require(all(isinstance(v, str) and v for v in found), key, values, "names")
    _require(len(set(found)) == len(found), key, values, "names that differ")
    return found


def _pairs(values: Any) -> tuple[tuple[str, int], ...]:
    expected = "(term, size) pairs with sizes from 1 to 1000000"
    pairs = []
    for pair in _items(values):
        _require(isinstance(pair, list | tuple) and len(pair) == 2, "observation_names", values, expected)
        name, size = pair
        whole = isinstance(size, int | np.integer) and not isinstance(size, bool) and 1 <= size <= 1_000_000
        _require(bool(whole), "observation_dims", values, expected)
        pairs.append((name, int(size)))
    _texts("observation_names", [name for name, _ in pairs])
    _require(len(pairs) > 0, "observation_names", values, expected)
    return tuple(pairs)


def _plain_json(values: Any) -> dict[str, Any]:
    expected = "a mapping from text to JSON types, numbers finite"
    _require(isinstance(values, Mapping), "provenance", type(values).__name__, expected)
    try:
        copied = json.loads(json.dumps(dict(values), allow_nan=False))
    except (TypeError, ValueError, RecursionError) as error:
        raise _error("provenance", str(error), expected) from error
    _require(isinstance(copied, dict), "provenance", copied, expected)
    return dict(copied)


def _parse(key: str, text: str) -> Any:
    if len(text) > MAX_VALUE_CHARS:
        raise _error(key, f"{len(text)} characters", f"at most {MAX_VALUE_CHARS}")

    def refuse(constant: str) -> None:
        raise ValueError(f"{constant} is not JSON")

    try:
        return json.loads(text, parse_constant=refuse)
    except (ValueError, RecursionError) as error:
        expected = 'JSON, e.g. [0.3, 0.3] or "reach"'
        raise _error(key, text, expected, "Export the policy with robotbrain.rl.export.export_policy.") from error

"""From a policy file to joint commands, without ROS and without a simulator: observation by name, action, limits.

The same object runs in the policy node on a robot, and in the judge's batch evaluation on surrogates: what is judged
is what is deployed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robotbrain.errors import InputError
from robotbrain.rl.policy_meta import PolicyMeta

Array = NDArray[np.float64]


class Policy(Protocol):
    """What :class:`robotbrain.rl.export.OnnxPolicy` offers: metadata, and actions (n, A) for observations (n, O)."""

    @property
    def meta(self) -> PolicyMeta:
        """What the policy expects and means."""
        ...

    def __call__(self, obs: ArrayLike, /) -> NDArray[np.float32]:
        """Return the actions."""
        ...


@dataclass
class RobotView:
    """What is known on the robot's own computer, for n robots; joints in the order of the policy's metadata.

    Args:
        joint_pos: (rad), (n, J).
        joint_vel: (rad/s), (n, J).
        last_action: the policy's last output, (n, A); zeros at first.
        sensed: anything else by observation name, (n, d): goal position, hand position, commands, base velocity.
    """

    joint_pos: Array
    joint_vel: Array
    last_action: Array
    sensed: Mapping[str, Array] = field(default_factory=dict)


JOINT_POS = ("joint_pos", "joint_pos_rel")
JOINT_VEL = ("joint_vel", "joint_vel_rel")
LAST_ACTION = ("actions", "last_action", "action")
GOAL = ("target_pos", "target", "goal", "pose_command", "ee_pose", "generated_commands", "command")
HAND = ("ee_pos", "ee_position", "hand_pos", "hand", "body_pos_b")
TO_GOAL = ("ee_to_target", "hand_to_target", "to_target", "to_goal", "body_to_command_b", "goal_error", "error")
"""Names of observation terms that the kit's reaching policies use; joint angles are relative to the default pose."""

BEYOND_RAD = 0.5
"""Encoders may read a little beyond the limits, by their offsets; what is further out is a mistake (rad)."""
REACH_MARGIN = 0.05
"""Share by which a goal may be further away than the hand has been found to come."""


@dataclass(frozen=True)
class NodeOptions:
    """How a policy node behaves.

    Args:
        base_frame: goals must be in this frame; the policy's base frame.
        stale_s: joint states older than this are no basis for a command (s).
        on_stale: ``"hold"``: command the last known position once, and go on when data comes back; ``"stop"``: the
            same, and wait for a new goal.
        time_from_start_s: the controller reaches each target in this time (s); None: half a control period, which
            avoids jumps and delays little.
        max_step: a target is never further than this from where the joint is (rad).
    """

    base_frame: str = "base"
    stale_s: float = 0.2
    on_stale: Literal["hold", "stop"] = "hold"
    time_from_start_s: float | None = None
    max_step: float = 0.5

    def __post_init__(self) -> None:
        if not 0.0 < self.stale_s < np.inf:
            raise InputError("stale_s", given=self.stale_s, expected="seconds > 0", fix="Try 0.2.")
        if self.on_stale not in ("hold", "stop"):
            raise InputError("on_stale", given=self.on_stale, expected="'hold' or 'stop'", fix="Try 'hold'.")


class PolicyRunner:
    """Runs a policy on n robots: assembles observations, asks the policy, turns actions into safe joint targets.

    Args:
        policy: with metadata.
        limits: joint limits (rad), (J, 2), in the order of ``meta.joint_names``.
        hand: place of the hand in the base frame (m), (n, 3), from joint angles (n, J) in that order; only for
            policies that observe it.
        count: number of robots.
        max_step: a target is never further than this from where the joint is (rad).

    Raises:
        InputError: the policy names no joints, its actions are no joint angles, or an observation that nothing here
            can supply (see ``extra_terms``).
    """

    def __init__(
        self,
        policy: Policy,
        limits: ArrayLike,
        *,
        hand: Callable[[Array], Array] | None = None,
        count: int = 1,
        max_step: float = 0.5,
        extra_terms: Sequence[str] = (),
    ) -> None:
        self.policy, self.meta, self._hand = policy, policy.meta, hand
        meta = self.meta
        if not meta.joint_names or not meta.action_kind.endswith("joint_position"):
            raise InputError(
                "policy",
                given=f"action_kind {meta.action_kind!r}, joints {meta.joint_names}",
                expected="joint names and actions that mean joint angles",
                fix="Export it with joint_names and one of the joint_position kinds.",
            )
        joints = len(meta.joint_names)
        self.limits = np.asarray(limits, float)
        if self.limits.shape != (joints, 2) or not (self.limits[:, 0] < self.limits[:, 1]).all():
            raise InputError(
                "joint limits", given=self.limits.shape, expected=f"({joints}, 2), low < high", fix="Order?"
            )
        if not 0.0 < max_step < np.inf:
            raise InputError("max_step", given=max_step, expected="rad > 0", fix="Try 0.5.")
        self._max_step = max_step
        self._default = np.asarray(meta.default_joint_pos or np.zeros(joints))
        known = (*JOINT_POS, *JOINT_VEL, *LAST_ACTION, *GOAL, *((*HAND, *TO_GOAL) if hand else ()), *extra_terms)
        for name, _ in meta.observation_names:
            if name not in known:
                raise InputError(
                    "observation of the policy",
                    given=name,
                    expected="one of " + ", ".join(known),
                    fix="This robot does not measure it; train without it, or supply it in RobotView.sensed.",
                )
        self._last = np.zeros((count, meta.action_dim))

    def reset(self, ids: ArrayLike | None = None) -> None:
        """Forget the last actions of the robots ``ids``; all by default."""
        self._last[slice(None) if ids is None else np.asarray(ids, np.int64)] = 0.0

    def observe(self, view: RobotView, goal: Array | None) -> NDArray[np.float32]:
        """Return the observation vector (n, O), float32, as the metadata spells it.

        Args:
            view: of the robots.
            goal: place to reach in the base frame (m), (n, 3), or pose with quaternion xyzw, (n, 7).

        Raises:
            InputError: a term comes out with another size than the metadata says, or is missing.
        """
        hand: Array | None = None
        parts = []
        scales = self.meta.observation_scales or ((1.0,),) * len(self.meta.observation_names)
        for (name, size), scale in zip(self.meta.observation_names, scales, strict=True):
            if (name in HAND or name in TO_GOAL) and hand is None and self._hand is not None:
                hand = self._hand(view.joint_pos)
            value = self._term(name, size, view, goal, hand)
            if value is None or value.shape != (len(view.joint_pos), size):
                raise InputError(
                    f"observation {name!r}",
                    given="nothing" if value is None else value.shape,
                    expected=f"({len(view.joint_pos)}, {size})",
                    fix="Supply it as the policy's metadata says.",
                )
            parts.append(value * np.asarray(scale))
        return np.concatenate(parts, axis=1).astype(np.float32)

    def _term(self, name: str, size: int, view: RobotView, goal: Array | None, hand: Array | None) -> Array | None:
        if name in view.sensed:
            return view.sensed[name]
        if name in JOINT_POS:
            return np.asarray(view.joint_pos - self._default)
        if name in JOINT_VEL:
            return view.joint_vel
        if name in LAST_ACTION:
            return view.last_action
        if goal is None:
            return None
        if name in GOAL:
            if size == 7 and goal.shape[1] == 3:
                return np.concatenate([goal, np.tile([0.0, 0.0, 0.0, 1.0], (len(goal), 1))], axis=1)
            return np.asarray(goal[:, :size])
        if hand is None:
            return None
        return hand if name in HAND else np.asarray(goal[:, :3] - hand)

    def act(
        self, joint_pos: Array, joint_vel: Array, goal: Array | None, sensed: Mapping[str, Array] | None = None
    ) -> Array:
        """Return joint targets (rad), (n, J), within the joint limits and ``max_step`` of where the joints are."""
        view = RobotView(joint_pos, joint_vel, self._last, sensed or {})
        action = self.policy(self.observe(view, goal))
        self._last = self.meta.clip(action)  # as it was used: in training the policy sees no other
        target = self.meta.commands(action, joint_pos)
        near = np.clip(target, joint_pos - self._max_step, joint_pos + self._max_step)
        return np.clip(near, self.limits[:, 0], self.limits[:, 1])


def check_joint_pos(names: Sequence[str], joint_pos: Array, limits: Array) -> None:
    """Check that joint angles (rad), (J,), lie within ``limits`` (rad), (J, 2), or at most ``BEYOND_RAD`` beyond.

    Raises:
        InputError: naming the joint that is furthest out.
    """
    beyond = np.maximum(limits[:, 0] - joint_pos, joint_pos - limits[:, 1])
    worst = int(beyond.argmax())
    if beyond[worst] > BEYOND_RAD:
        low, high = limits[worst]
        raise InputError(
            f"angle of {names[worst]}",
            given=f"{joint_pos[worst]:.3f} rad",
            expected=f"{low:.3f} to {high:.3f} rad",
            fix="Degrees? A turn too many? Another zero? Calibrate the joint, or give the limits of this robot.",
        )


def reach_bound(hand: Callable[[Array], Array], limits: Array) -> float:
    """Return how far from the base the hand comes within the joint limits (m), and ``REACH_MARGIN`` more.

    The best of random poses is improved joint by joint; the same arm gives the same bound.

    Args:
        hand: place of the hand (m), (n, 3), for joint angles (rad), (n, J).
        limits: (rad), (J, 2); those of joints without a stop may be infinite.
    """
    low, high = np.clip(limits, -np.pi, np.pi).T
    poses = low + (high - low) * np.random.default_rng(0).random((1000, len(limits)))
    best = poses[np.linalg.norm(hand(poses), axis=1).argmax()]
    for _ in range(4):
        for joint in range(len(limits)):
            tried = np.tile(best, (33, 1))
            tried[:-1, joint] = np.linspace(low[joint], high[joint], 32)
            best = tried[np.linalg.norm(hand(tried), axis=1).argmax()]
    return float(np.linalg.norm(hand(best[None]))) * (1.0 + REACH_MARGIN)


def joint_order(wanted: Sequence[str], offered: Sequence[str]) -> NDArray[np.int64]:
    """Return where each wanted joint is among the offered ones, (len(wanted),): ``offered[order[i]] == wanted[i]``.

    Raises:
        InputError: a joint is missing, or named twice.
    """
    offered = list(offered)
    missing = [name for name in wanted if name not in offered]
    twice = sorted({name for name in wanted if offered.count(name) > 1})
    if missing or twice:
        raise InputError(
            "joint names",
            given=", ".join(offered) or "none",
            expected="each once: " + ", ".join(wanted),
            fix=(f"Missing: {', '.join(missing)}." if missing else f"Named twice: {', '.join(twice)}.")
            + " Is this the robot that the policy was trained for?",
        )
    return np.array([offered.index(name) for name in wanted], dtype=np.int64)

"""Left and right of the velocity task: observations and actions of the quadruped as seen in a mirror.

Learning from mirror images halves the samples that walking needs, and a trained robot does not limp.
"""

from __future__ import annotations

from typing import Any

import torch

from robotbrain.rl.robots.quadruped import JOINT_NAMES

Tensor = torch.Tensor

OBSERVATIONS = (
    ("base_lin_vel", 3),
    ("base_ang_vel", 3),
    ("projected_gravity", 3),
    ("velocity_commands", 3),
    ("joint_pos", 12),
    ("joint_vel", 12),
    ("actions", 12),
)
"""What the policy sees, in order: 48 numbers, unscaled, velocities in the trunk's frame (m/s, rad/s)."""


def mirror_left_right(env: Any = None, obs: Any = None, actions: Tensor | None = None) -> tuple[Any, Tensor | None]:
    """Append the mirror images (left and right swapped) to observations and actions, as rsl-rl's symmetry wants it.

    Args:
        env: not used.
        obs: mapping from group to (B, 48); a ``TensorDict`` comes back as one.
        actions: (B, 12).

    Returns:
        Observations (2 B, 48) and actions (2 B, 12), originals first; None for what was not given.
    """
    if obs is not None:
        images = {name: torch.cat([x, x[:, OBS_MIRROR] * OBS_SIGN.to(x.device)]) for name, x in obs.items()}
        rows = len(next(iter(images.values())))
        obs = type(obs)(images, batch_size=[rows]) if hasattr(obs, "batch_size") else images
    if actions is not None:
        actions = torch.cat([actions, actions[:, JOINT_MIRROR] * JOINT_SIGN.to(actions.device)])
    return obs, actions


def _joint_mirror() -> tuple[Tensor, Tensor]:
    other = {"L": "R", "R": "L"}  # "FL_hip_joint" -> "FR_hip_joint"
    order = [JOINT_NAMES.index(name[0] + other[name[1]] + name[2:]) for name in JOINT_NAMES]
    return torch.tensor(order), torch.tensor([-1.0 if "_hip_" in name else 1.0 for name in JOINT_NAMES])


def _obs_mirror() -> tuple[Tensor, Tensor]:
    vector, axial = [1.0, -1.0, 1.0], [-1.0, 1.0, -1.0]
    signs = {"base_ang_vel": axial, "velocity_commands": [1.0, -1.0, -1.0]}
    order: list[Tensor] = []
    sign: list[Tensor] = []
    start = 0
    for name, size in OBSERVATIONS:
        jointwise = size == len(JOINT_NAMES)
        order.append(start + (JOINT_MIRROR if jointwise else torch.arange(size)))
        sign.append(JOINT_SIGN if jointwise else torch.tensor(signs.get(name, vector)))
        start += size
    return torch.cat(order), torch.cat(sign)


JOINT_MIRROR, JOINT_SIGN = _joint_mirror()
"""Mirror image of joint values x (..., 12): ``x[..., JOINT_MIRROR] * JOINT_SIGN``."""
OBS_MIRROR, OBS_SIGN = _obs_mirror()
"""Mirror image of observations, likewise."""

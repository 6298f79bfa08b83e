"""Rotations, frames and random draws in torch; names as in ``isaaclab.utils.math``.

Quaternions are xyzw and of unit length, angles in rad, the last dimension holds the components. Draws take a generator.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch

Tensor = torch.Tensor


def wrap_to_pi(angles: Tensor) -> Tensor:
    """The same angles within [-pi, pi]; odd multiples of pi keep their sign."""
    wrapped = torch.remainder(angles + math.pi, 2.0 * math.pi) - math.pi
    return torch.where((wrapped == -math.pi) & (angles > 0), math.pi, wrapped)


def scale_transform(x: Tensor, lower: Tensor, upper: Tensor) -> Tensor:
    """Map [lower, upper] linearly to [-1, 1]."""
    return 2.0 * (x - (lower + upper) * 0.5) / (upper - lower)


def unscale_transform(x: Tensor, lower: Tensor, upper: Tensor) -> Tensor:
    """Map [-1, 1] linearly to [lower, upper]."""
    return (lower + upper) * 0.5 + x * (upper - lower) * 0.5


def normalize(x: Tensor, eps: float = 1.0e-9) -> Tensor:
    """Vectors of length 1 (shorter ones than ``eps`` are divided by it)."""
    length: Tensor = torch.linalg.vector_norm(x, dim=-1, keepdim=True)
    return x / length.clamp(min=eps)


def quat_unique(q: Tensor) -> Tensor:
    """Of the two quaternions of each rotation the one with w >= 0."""
    return torch.where(q[..., 3:] < 0, -q, q)


def quat_conjugate(q: Tensor) -> Tensor:
    """The inverse rotation."""
    return q * _CONJUGATE[q.dtype]


def quat_inv(q: Tensor, eps: float = 1.0e-9) -> Tensor:
    """The inverse, also of quaternions that are not of unit length."""
    return quat_conjugate(q) / q.pow(2).sum(-1, keepdim=True).clamp(min=eps)


# The components of a product of quaternions and the rotation matrix of one are linear in products of components. One
# multiplication with a constant matrix then does what otherwise takes a dozen calls on small tensors.


def _product_table() -> Tensor:
    """(16, 4): products a_i b_j of two quaternions' components -> components of the quaternion a b."""
    table = torch.zeros(4, 4, 4, dtype=torch.float64)
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        table[i, j, k], table[j, i, k] = 1.0, -1.0
        table[i, 3, i] = table[3, i, i] = 1.0
        table[i, i, 3] = -1.0
    table[3, 3, 3] = 1.0
    return table.reshape(16, 4)


def _matrix_table() -> Tensor:
    """(16, 9): products of a unit quaternion's components with each other -> its rotation matrix, row by row."""
    table = torch.zeros(4, 4, 3, 3, dtype=torch.float64)
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        table[i, i, i, i] = table[3, 3, i, i] = 1.0
        table[j, j, i, i] = table[k, k, i, i] = -1.0
        table[i, j, i, j] = table[i, j, j, i] = 2.0
        table[k, 3, i, j], table[k, 3, j, i] = -2.0, 2.0
    return table.reshape(16, 9)


_PRODUCT = {torch.float64: _product_table(), torch.float32: _product_table().float()}
_MATRIX = {torch.float64: _matrix_table(), torch.float32: _matrix_table().float()}
_CONJUGATE = {dtype: torch.tensor([-1.0, -1.0, -1.0, 1.0], dtype=dtype) for dtype in (torch.float64, torch.float32)}


def _products(q1: Tensor, q2: Tensor) -> Tensor:
    return (q1.unsqueeze(-1) * q2.unsqueeze(-2)).flatten(-2)


def quat_mul(q1: Tensor, q2: Tensor) -> Tensor:
    """The rotation ``q2`` followed by ``q1`` (both about fixed axes)."""
    return _products(q1, q2) @ _PRODUCT[q1.dtype]


def matrix_from_quat(quaternions: Tensor) -> Tensor:
    """Rotation matrices (..., 3, 3) that rotate column vectors."""
    matrices = _products(quaternions, quaternions) @ _MATRIX[quaternions.dtype]
    return matrices.view(*quaternions.shape[:-1], 3, 3)


def quat_apply(quat: Tensor, vec: Tensor) -> Tensor:
    """Rotate vectors (..., 3)."""
    u = quat[..., :3]
    t = torch.linalg.cross(u, vec)
    t += t
    turned: Tensor = torch.addcmul(vec, quat[..., 3:], t) + torch.linalg.cross(u, t)
    return turned


def quat_apply_inverse(quat: Tensor, vec: Tensor) -> Tensor:
    """Rotate vectors (..., 3) the other way: from the outer frame into the rotated one."""
    return quat_apply(quat_conjugate(quat), vec)


def yaw_quat(quat: Tensor) -> Tensor:
    """The rotation about z that has the same heading."""
    x, y, z, w = quat.unbind(-1)
    half = 0.5 * torch.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    zero = torch.zeros_like(half)
    return torch.stack((zero, zero, half.sin(), half.cos()), -1)


def quat_apply_yaw(quat: Tensor, vec: Tensor) -> Tensor:
    """Rotate vectors by the heading alone."""
    return quat_apply(yaw_quat(quat), vec)


def quat_from_euler_xyz(roll: Tensor, pitch: Tensor, yaw: Tensor) -> Tensor:
    """The rotation about the fixed x axis by ``roll``, then y by ``pitch``, then z by ``yaw``."""
    half = torch.stack((roll, pitch, yaw)) * 0.5
    (cr, cp, cy), (sr, sp, sy) = half.cos().unbind(), half.sin().unbind()
    cc, cs, sc, ss = cr * cp, cr * sp, sr * cp, sr * sp
    return torch.stack((sc * cy - cs * sy, cs * cy + sc * sy, cc * sy - ss * cy, cc * cy + ss * sy), -1)


def euler_xyz_from_quat(quat: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Roll, pitch and yaw of :func:`quat_from_euler_xyz`; roll and yaw within [-pi, pi]."""
    x, y, z, w = quat.unbind(-1)
    roll = torch.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    pitch = torch.asin((2.0 * (w * y - z * x)).clamp(-1.0, 1.0))
    yaw = torch.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return roll, pitch, yaw


def quat_from_angle_axis(angle: Tensor, axis: Tensor) -> Tensor:
    """The rotation by ``angle`` about ``axis`` (of any length but zero)."""
    half = angle.unsqueeze(-1) * 0.5
    return torch.cat((normalize(axis) * half.sin(), half.cos().expand(*axis.shape[:-1], 1)), -1)


def axis_angle_from_quat(quat: Tensor, eps: float = 1.0e-6) -> Tensor:
    """Rotation vector: axis times angle within [0, pi]."""
    q = quat_unique(quat)
    length = q[..., :3].norm(dim=-1, keepdim=True)
    angle = 2.0 * torch.atan2(length, q[..., 3:])
    return q[..., :3] * torch.where(length > eps, angle / length.clamp(min=eps), torch.full_like(angle, 2.0))


def quat_error_magnitude(q1: Tensor, q2: Tensor) -> Tensor:
    """Angle of the rotation between two orientations, within [0, pi]."""
    relative = quat_mul(q1, quat_conjugate(q2))
    return 2.0 * torch.atan2(relative[..., :3].norm(dim=-1), relative[..., 3].abs())


def combine_frame_transforms(
    t01: Tensor, q01: Tensor, t12: Tensor | None = None, q12: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Pose of frame 2 in frame 0 from those of 1 in 0 and 2 in 1 (left out: no offset, no rotation)."""
    quat = q01 if q12 is None else quat_mul(q01, q12)
    return (t01 if t12 is None else t01 + quat_apply(q01, t12)), quat


def subtract_frame_transforms(
    t01: Tensor, q01: Tensor, t02: Tensor | None = None, q02: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Pose of frame 2 in frame 1 from those of 1 and 2 in 0 (left out: frame 2 is frame 0)."""
    inverse = quat_conjugate(q01)
    quat = inverse if q02 is None else quat_mul(inverse, q02)
    return quat_apply(inverse, (-t01 if t02 is None else t02 - t01)), quat


def sample_uniform(lower: Tensor | float, upper: Tensor | float, size: Sequence[int], gen: torch.Generator) -> Tensor:
    """Uniform draws from [lower, upper), which broadcast against ``size``."""
    return torch.rand(*size, generator=gen) * (upper - lower) + lower


def sample_log_uniform(
    lower: Tensor | float, upper: Tensor | float, size: Sequence[int], gen: torch.Generator
) -> Tensor:
    """Draws whose logarithm is uniform between those of the bounds (which are positive)."""
    low, high = torch.as_tensor(lower).log(), torch.as_tensor(upper).log()
    return torch.exp(torch.rand(*size, generator=gen) * (high - low) + low)


def sample_gaussian(mean: Tensor | float, std: Tensor | float, size: Sequence[int], gen: torch.Generator) -> Tensor:
    """Normal draws."""
    return torch.randn(*size, generator=gen) * std + mean


def random_orientation(num: int, gen: torch.Generator) -> Tensor:
    """Orientations uniform over all rotations, (num, 4)."""
    return normalize(torch.randn(num, 4, generator=gen))


def random_yaw_orientation(num: int, gen: torch.Generator) -> Tensor:
    """Rotations about z by angles uniform in [-pi, pi), (num, 4)."""
    half = (torch.rand(num, generator=gen) - 0.5) * math.pi
    zero = torch.zeros(num)
    return torch.stack((zero, zero, half.sin(), half.cos()), -1)

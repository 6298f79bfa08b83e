"""The state of an articulation as tensors, computed when asked for and once per state.

Everything is float32, (num_envs, ...), in SI units; quaternions are xyzw; ``_w`` is the world frame, ``_b`` the root
body's. Velocities are those of a body's frame origin (Isaac Lab's short names mean the centre of mass; the two are the
same where the frame's origin is the centre of mass).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import torch

from robotbrain.rl.scene.layout import ArticulationLayout
from robotbrain.rl.scene.world import Source, TensorView, World

if TYPE_CHECKING:
    from robotbrain.rl.scene.properties import PropertyView

_XYZW = torch.tensor([1, 2, 3, 0])


def _rotation_from_products() -> torch.Tensor:
    """(16, 12): turns products of a wxyz quaternion's components into its rotation matrix and minus the last row."""
    matrix = torch.zeros(4, 4, 3, 3)
    w, x, y, z = range(4)
    for i, (a, b, c) in enumerate(((x, y, z), (y, z, x), (z, x, y))):
        j, k = (i + 1) % 3, (i + 2) % 3
        matrix[w, w, i, i] = matrix[a, a, i, i] = 1.0
        matrix[b, b, i, i] = matrix[c, c, i, i] = -1.0
        matrix[a, b, i, j] = matrix[a, b, j, i] = 2.0
        matrix[w, c, i, j], matrix[w, b, i, k] = -2.0, 2.0
    flat = matrix.reshape(16, 9)
    return torch.cat((flat, -flat[:, 6:]), 1)


_FRAME_OF_PRODUCTS = _rotation_from_products()


class ArticulationData:
    """Fields of one articulation; each has a ``.torch`` (see :class:`TensorView`).

    Args:
        world: the simulations.
        layout: where the articulation is in the model.
        soft_limit_factor: part of the joint ranges that are the soft limits.
    """

    # put here by ArticulationProperties
    body_mass: PropertyView
    body_inertia: PropertyView
    body_com_pose_b: PropertyView
    joint_stiffness: PropertyView
    joint_damping: PropertyView
    joint_effort_limits: PropertyView
    joint_armature: PropertyView
    default_joint_armature: PropertyView
    joint_friction_coeff: PropertyView
    joint_viscous_friction_coeff: PropertyView
    joint_vel_limits: TensorView
    soft_joint_vel_limits: TensorView
    body_pose_w: PropertyView
    GRAVITY_VEC_W: PropertyView

    def __init__(self, world: World, layout: ArticulationLayout, soft_limit_factor: float) -> None:
        self._world, self._layout = world, layout
        n, j, b = world.num_envs, layout.num_joints, len(layout.body_ids)
        nq = world.model.nq
        motion = world.motion
        state = Source(world, world.read_motion)
        self._floating = layout.free_qpos is not None
        self._init_joints(state, j, nq, motion)

        self.body_pos_w, self._body_pos = self._derived((n, b, 3), self._compute_body_pos)
        self.body_quat_w, self._body_quat = self._derived((n, b, 4), self._compute_body_quat)
        vel_source = Source(world, self._compute_body_vel)
        self._body_vel = torch.zeros(n, b, 6)
        self.body_vel_w = TensorView(self._body_vel, vel_source)
        self.body_lin_vel_w = TensorView(self._body_vel[..., :3], vel_source)
        self.body_ang_vel_w = TensorView(self._body_vel[..., 3:], vel_source)

        self._init_root(state, n, nq, motion)
        self._init_defaults(n, j, soft_limit_factor)

    def _init_joints(self, state: Source, j: int, nq: int, motion: torch.Tensor) -> None:
        world, layout, n = self._world, self._layout, self._world.num_envs
        q, v = layout.joint_qpos, layout.joint_dof
        if layout.contiguous:
            first_q, first_v = (int(q[0]), int(v[0])) if j else (0, 0)
            self.joint_pos = TensorView(motion[:, first_q : first_q + j], state)
            self.joint_vel = TensorView(motion[:, nq + first_v : nq + first_v + j], state)
        else:
            at_q, at_v = torch.from_numpy(q.astype(np.int64)), torch.from_numpy(v.astype(np.int64)) + nq
            pos, vel = torch.zeros(n, j), torch.zeros(n, j)
            self.joint_pos = TensorView(
                pos, Source(world, lambda: torch.index_select(world.read_motion(), 1, at_q, out=pos))
            )
            self.joint_vel = TensorView(
                vel, Source(world, lambda: torch.index_select(world.read_motion(), 1, at_v, out=vel))
            )
        self.joint_acc, _ = self._dof_field("qacc")
        self.applied_torque, _ = self._dof_field("qfrc_actuator")

    def _init_root(self, state: Source, n: int, nq: int, motion: torch.Tensor) -> None:
        world, layout = self._world, self._layout
        self._root = layout.root_body
        if layout.free_qpos is not None and layout.free_dof is not None:
            a, d = layout.free_qpos, nq + layout.free_dof
            self.root_pos_w = TensorView(motion[:, a : a + 3], state)
            self._root_lin = motion[:, d : d + 3]
            self.root_lin_vel_w = TensorView(self._root_lin, state)
            self.root_ang_vel_b = TensorView(motion[:, d + 3 : d + 6], state)  # MuJoCo keeps it in the body's frame
            self._quat_wxyz = motion[:, a + 3 : a + 7]
            self.root_quat_w, self._root_quat = self._derived((n, 4), self._compute_root_quat)
        else:
            pose = torch.from_numpy(layout.fixed_pose).float().expand(n, 7)
            self.root_pos_w = TensorView(pose[:, :3].contiguous())
            self.root_quat_w = TensorView(pose[:, 3:].contiguous())
            zero = torch.zeros(n, 3)
            self._root_lin = zero
            self.root_lin_vel_w, self.root_ang_vel_b = TensorView(zero), TensorView(zero)
        self._frame = torch.zeros(n, 12)  # rotation matrix, and gravity's direction as the root sees it
        self._rotation = self._frame[:, :9].view(n, 3, 3)
        self._products, self._turned = torch.zeros(n, 4, 4), torch.zeros(n, 3, 3)
        self._lin_b = torch.zeros(n, 3)
        frame = Source(world, self._compute_root_frame) if self._floating else None
        self.root_is_world = frame is None and layout.fixed_pose.tolist() == [0.0] * 6 + [1.0]
        """Whether the root's frame is the world's and stays so: then nothing has to be transformed."""
        if frame is None:
            self._set_frame(self.root_quat_w.torch[:, [3, 0, 1, 2]])
        self.root_rotation_w = TensorView(self._rotation, frame)
        self.projected_gravity_b = TensorView(self._frame[:, 9:], frame)
        self.root_lin_vel_b = TensorView(self._lin_b, frame)
        self.root_ang_vel_w, self._ang_w = self._derived((n, 3), self._compute_root_ang_vel_w)
        self.root_vel_w, self._root_vel = self._derived((n, 6), self._compute_root_vel)
        self.root_pose_w, self._root_pose = self._derived((n, 7), self._compute_root_pose)
        self.root_state_w, self._root_state = self._derived((n, 13), self._compute_root_state)
        self.heading_w, self._heading = self._derived((n,), self._compute_heading)
        for short in ("pos_w", "quat_w", "lin_vel_w", "ang_vel_w", "pose_w", "vel_w", "lin_vel_b", "ang_vel_b"):
            setattr(self, f"root_link_{short}", getattr(self, f"root_{short}"))
        for short in ("pos_w", "quat_w", "lin_vel_w", "ang_vel_w", "vel_w"):
            setattr(self, f"body_link_{short}", getattr(self, f"body_{short}"))

    def _init_defaults(self, n: int, j: int, soft_limit_factor: float) -> None:
        layout = self._layout
        limits = torch.from_numpy(layout.joint_range).float().expand(n, j, 2).contiguous()
        middle, half = limits.mean(-1), (limits[..., 1] - limits[..., 0]) * 0.5 * soft_limit_factor
        soft = torch.stack((middle - half, middle + half), -1)
        unlimited = torch.isinf(limits).any(-1, keepdim=True)
        self.joint_pos_limits = TensorView(limits)
        self.soft_joint_pos_limits = TensorView(torch.where(unlimited, limits, soft))
        self.default_joint_pos = TensorView(torch.from_numpy(layout.default_joint_pos).float().expand(n, j).clone())
        self.default_joint_vel = TensorView(torch.from_numpy(layout.default_joint_vel).float().expand(n, j).clone())
        self.default_root_pose = TensorView(torch.from_numpy(layout.default_root_pose).float().expand(n, 7).clone())
        self.default_root_vel = TensorView(torch.from_numpy(layout.default_root_vel).float().expand(n, 6).clone())
        self.joint_pos_target = TensorView(self.default_joint_pos.torch.clone())
        self.joint_vel_target = TensorView(torch.zeros(n, j))
        self.joint_effort_target = TensorView(torch.zeros(n, j))

    @property
    def default_root_state(self) -> TensorView:
        """Default pose and velocity of the root, (num_envs, 13)."""
        return TensorView(torch.cat((self.default_root_pose.torch, self.default_root_vel.torch), 1))

    def _derived(self, shape: tuple[int, ...], compute: Callable[[], object]) -> tuple[TensorView, torch.Tensor]:
        tensor = torch.zeros(shape)
        return TensorView(tensor, Source(self._world, compute)), tensor

    def _dof_field(self, name: str) -> tuple[TensorView, torch.Tensor]:
        world, layout = self._world, self._layout
        tensor = torch.zeros(world.num_envs, layout.num_joints)
        source = world.measured_tensor(name)
        if layout.contiguous:
            first = int(layout.joint_dof[0]) if layout.num_joints else 0
            source = source[:, first : first + layout.num_joints]
            index = None
        else:
            index = torch.from_numpy(layout.joint_dof.astype(np.int64))

        def compute() -> None:
            world.flush()
            tensor.copy_(source if index is None else source[:, index])

        return TensorView(tensor, Source(world, compute)), tensor

    def _compute_body_pos(self) -> None:
        self._body_pos.copy_(self._world.derived_tensor("xpos")[:, self._layout.body_slice])

    def _compute_body_quat(self) -> None:
        quat = self._world.derived_tensor("xquat")[:, self._layout.body_slice]
        self._body_quat.copy_(quat.index_select(2, _XYZW))

    def _compute_body_vel(self) -> None:
        world, bodies = self._world, self._layout.body_slice
        twist = world.derived_tensor("cvel")[:, bodies]  # (angular, linear) at the tree's centre of mass
        about = world.derived_tensor("subtree_com")[:, self._layout.tree_root].unsqueeze(1)
        arm = world.derived_tensor("xpos")[:, bodies] - about
        self._body_vel[..., :3] = twist[..., 3:] + torch.linalg.cross(twist[..., :3], arm)
        self._body_vel[..., 3:] = twist[..., :3]

    def _compute_root_quat(self) -> None:
        self._world.read_motion()
        torch.index_select(self._quat_wxyz, 1, _XYZW, out=self._root_quat)

    def _compute_root_frame(self) -> None:
        self._world.read_motion()
        self._set_frame(self._quat_wxyz)
        torch.mul(self._rotation, self._root_lin.unsqueeze(2), out=self._turned)
        torch.sum(self._turned, 1, out=self._lin_b)

    def _set_frame(self, quat_wxyz: torch.Tensor) -> None:
        torch.mul(quat_wxyz.unsqueeze(2), quat_wxyz.unsqueeze(1), out=self._products)
        torch.mm(self._products.view(-1, 16), _FRAME_OF_PRODUCTS, out=self._frame)

    def _compute_root_ang_vel_w(self) -> None:
        torch.sum(self.root_rotation_w.torch * self.root_ang_vel_b.torch.unsqueeze(1), 2, out=self._ang_w)

    def _compute_root_vel(self) -> None:
        self._root_vel[:, :3] = self.root_lin_vel_w.torch
        self._root_vel[:, 3:] = self.root_ang_vel_w.torch

    def _compute_root_pose(self) -> None:
        self._root_pose[:, :3] = self.root_pos_w.torch
        self._root_pose[:, 3:] = self.root_quat_w.torch

    def _compute_root_state(self) -> None:
        self._root_state[:, :7] = self.root_pose_w.torch
        self._root_state[:, 7:] = self.root_vel_w.torch

    def _compute_heading(self) -> None:
        rotation = self.root_rotation_w.torch
        torch.atan2(rotation[:, 1, 0], rotation[:, 0, 0], out=self._heading)

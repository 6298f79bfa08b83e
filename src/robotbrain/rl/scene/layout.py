"""Where an articulation is in a MuJoCo model: its bodies, joints, actuators and default state."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
import numpy.typing as npt

from robotbrain.errors import InputError
from robotbrain.rl.configclass import did_you_mean
from robotbrain.rl.scene.names import values_by_name
from robotbrain.rl.scene.scene_cfg import ArticulationCfg, InitialStateCfg

Float64 = npt.NDArray[np.float64]
Int = npt.NDArray[np.int64]

_FREE, _SLIDE, _HINGE = (int(getattr(mujoco.mjtJoint, f"mjJNT_{n}")) for n in ("FREE", "SLIDE", "HINGE"))
_JOINT = int(mujoco.mjtTrn.mjTRN_JOINT)
_BIAS_AFFINE = int(mujoco.mjtBias.mjBIAS_AFFINE)


@dataclass(frozen=True, slots=True)
class ArticulationLayout:
    """Indices into the model and default values.

    Attributes:
        root_body: id of the root body.
        tree_root: id of the body under the world that carries the tree.
        body_ids, body_names: the tree's bodies, the root first.
        joint_ids, joint_names: its hinges and slides, in the order of the model.
        joint_qpos, joint_dof: their addresses in ``qpos`` and ``qvel``.
        contiguous: whether these addresses are consecutive.
        free_qpos, free_dof: addresses of the root's free joint; ``None``: the root is fixed.
        fixed_pose: pose of a fixed root, position and xyzw quaternion.
        joint_range: lower and upper limits, (joints, 2), infinite where there are none.
        default_joint_pos, default_joint_vel, default_root_pose, default_root_vel: default state (xyzw).
        position_ctrl, velocity_ctrl, effort_ctrl: for each kind of actuator (joints' indices, addresses in ``ctrl``).
    """

    root_body: int
    tree_root: int
    body_ids: Int
    body_names: list[str]
    joint_ids: Int
    joint_names: list[str]
    joint_qpos: Int
    joint_dof: Int
    contiguous: bool
    free_qpos: int | None
    free_dof: int | None
    fixed_pose: Float64
    joint_range: Float64
    default_joint_pos: Float64
    default_joint_vel: Float64
    default_root_pose: Float64
    default_root_vel: Float64
    position_ctrl: tuple[Int, Int]
    velocity_ctrl: tuple[Int, Int]
    effort_ctrl: tuple[Int, Int]

    @property
    def num_joints(self) -> int:
        """Number of hinges and slides."""
        return len(self.joint_ids)

    @property
    def body_slice(self) -> slice | Int:
        """The bodies as a slice where they are consecutive in the model."""
        first, count = int(self.body_ids[0]), len(self.body_ids)
        consecutive = bool((self.body_ids == np.arange(first, first + count)).all())
        return slice(first, first + count) if consecutive else self.body_ids


def find_layout(model: mujoco.MjModel, cfg: ArticulationCfg) -> ArticulationLayout:
    """Look up an articulation in a model.

    Raises:
        InputError: no such root body, no joints, ball joints, or unknown names in the default state.
    """
    root = _root_body(model, cfg.root_body)
    bodies = np.array([b for b in range(1, model.nbody) if _is_under(model, b, root)], dtype=np.int64)
    under = set(bodies.tolist())
    free = [j for j in range(model.njnt) if int(model.jnt_bodyid[j]) == root and int(model.jnt_type[j]) == _FREE]
    joints = [j for j in range(model.njnt) if int(model.jnt_bodyid[j]) in under and j not in free]
    for j in joints:
        if int(model.jnt_type[j]) not in (_SLIDE, _HINGE):
            raise InputError(
                f"joint {model.joint(j).name!r}",
                given="a ball or free joint",
                expected="hinges and slides inside an articulation",
                fix="Model it with three hinges.",
            )
    ids = np.array(joints, dtype=np.int64)
    qpos, dof = model.jnt_qposadr[ids].astype(np.int64), model.jnt_dofadr[ids].astype(np.int64)
    names = [model.joint(j).name for j in joints]
    limits = np.where(model.jnt_limited[ids, None].astype(bool), model.jnt_range[ids], [[-np.inf, np.inf]])
    fixed = np.concatenate((model.body_pos[root], model.body_quat[root][[1, 2, 3, 0]]))
    free_qpos = int(model.jnt_qposadr[free[0]]) if free else None
    base_qpos, base_qvel = _base_state(model)
    if free_qpos is not None:
        fixed = base_qpos[free_qpos : free_qpos + 7][[0, 1, 2, 4, 5, 6, 3]]
    pose, velocity, joint_pos, joint_vel = _defaults(cfg.init_state, names, fixed, base_qpos[qpos], base_qvel[dof])
    step = np.arange(len(joints))
    return ArticulationLayout(
        root_body=root,
        tree_root=int(model.body_rootid[root]),
        body_ids=bodies,
        body_names=[model.body(int(b)).name for b in bodies],
        joint_ids=ids,
        joint_names=names,
        joint_qpos=qpos,
        joint_dof=dof,
        contiguous=not joints or bool((qpos - qpos[0] == step).all() and (dof - dof[0] == step).all()),
        free_qpos=free_qpos,
        free_dof=int(model.jnt_dofadr[free[0]]) if free else None,
        fixed_pose=fixed,
        joint_range=limits.astype(np.float64).reshape(len(joints), 2),
        default_joint_pos=joint_pos,
        default_joint_vel=joint_vel,
        default_root_pose=pose,
        default_root_vel=velocity,
        **_actuators(model, joints),
    )


def _root_body(model: mujoco.MjModel, name: str | None) -> int:
    names = [model.body(b).name for b in range(model.nbody)]
    if name is not None:
        if name not in names:
            raise InputError(
                "ArticulationCfg.root_body", given=name, expected="a body of the model", fix=did_you_mean(name, names)
            )
        return names.index(name)
    for body in range(1, model.nbody):
        tree = [b for b in range(1, model.nbody) if _is_under(model, b, body)]
        if int(model.body_parentid[body]) == 0 and any(int(model.body_jntnum[b]) for b in tree):
            return body
    raise InputError(
        "ArticulationCfg.model", given=names, expected="a body with joints", fix="Add joints, or name the root_body."
    )


def _is_under(model: mujoco.MjModel, body: int, root: int) -> bool:
    while body > root:
        body = int(model.body_parentid[body])
    return body == root


def _base_state(model: mujoco.MjModel) -> tuple[Float64, Float64]:
    if model.nkey:
        return model.key_qpos[0].copy(), model.key_qvel[0].copy()
    return model.qpos0.copy(), np.zeros(model.nv)


def _defaults(
    cfg: InitialStateCfg, names: list[str], pose: Float64, joint_pos: Float64, joint_vel: Float64
) -> tuple[Float64, Float64, Float64, Float64]:
    pose, joint_pos, joint_vel = pose.copy(), joint_pos.copy(), joint_vel.copy()
    if cfg.pos is not None:
        pose[:3] = cfg.pos
    if cfg.rot is not None:
        length = float(np.linalg.norm(cfg.rot))
        if not 0.5 < length < 2.0:
            raise InputError(
                "init_state.rot", given=cfg.rot, expected="a unit quaternion xyzw", fix="(0, 0, 0, 1) is no rotation."
            )
        pose[3:] = np.asarray(cfg.rot) / length
    for target, values in ((joint_pos, cfg.joint_pos), (joint_vel, cfg.joint_vel)):
        if values:
            index, _, numbers = values_by_name(values, names, what="joint")
            target[index] = numbers
    return pose, np.array([*cfg.lin_vel, *cfg.ang_vel], dtype=np.float64), joint_pos, joint_vel


def _actuators(model: mujoco.MjModel, joints: list[int]) -> dict[str, tuple[Int, Int]]:
    kinds: dict[str, tuple[list[int], list[int]]] = {k: ([], []) for k in ("position", "velocity", "effort")}
    for a in range(model.nu):
        if int(model.actuator_trntype[a]) != _JOINT or int(model.actuator_trnid[a, 0]) not in joints:
            continue
        bias = model.actuator_biasprm[a]
        kind = "effort"
        if int(model.actuator_biastype[a]) == _BIAS_AFFINE:
            kind = "position" if bias[1] != 0 else "velocity"
        kinds[kind][0].append(joints.index(int(model.actuator_trnid[a, 0])))
        kinds[kind][1].append(a)
    return {f"{k}_ctrl": (np.array(j, dtype=np.int64), np.array(a, dtype=np.int64)) for k, (j, a) in kinds.items()}

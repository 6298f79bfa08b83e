"""Events that change physical parameters, per environment; those of ``isaaclab.envs.mdp.events`` 3.0.

Each starts from the model's own values, however often it is called. ``operation`` says what a draw does to them:
``"add"``, ``"scale"`` or ``"abs"`` (take its place); ``distribution`` is ``"uniform"`` or ``"log_uniform"`` over
(low, high), or ``"gaussian"`` with (mean, standard deviation). Every environment and every chosen body or joint gets a
draw of its own. The kit's own events are in :mod:`robotbrain.rl.mdp.extra_events`.
"""

# ruff: noqa: N801  (Isaac Lab's names)
from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch

from robotbrain.errors import InputError
from robotbrain.rl.managers import ManagerTermBase, SceneEntityCfg
from robotbrain.rl.mdp._sampling import Bounds, Distribution, Operation, check_law, combine, draw, uniform, uniform_axes
from robotbrain.rl.mdp.events import EnvIds, resolve_env_ids

if TYPE_CHECKING:
    from robotbrain.rl.envs import ManagerBasedRLEnv
    from robotbrain.rl.managers import EventTermCfg

Tensor = torch.Tensor


def _check(cfg: EventTermCfg, *names: str, positive_scale: bool = False) -> None:
    for name in names:
        check_law(
            cfg.params,
            name,
            operation=cfg.params["operation"],
            distribution=cfg.params["distribution"],
            positive_scale=positive_scale,
        )


class randomize_rigid_body_material(ManagerTermBase):
    """Sliding friction of the chosen bodies' collision geoms, uniform over ``static_friction_range``.

    MuJoCo has one coefficient, as Isaac Lab's Newton backend: ``dynamic_friction_range``, ``num_buckets`` and
    ``make_consistent`` are taken for Isaac Lab's sake and change nothing. It has no restitution either, so
    ``restitution_range`` has to be (0, 0). Between two geoms the larger friction counts, unless one has priority.
    """

    def __init__(self, cfg: EventTermCfg, env: ManagerBasedRLEnv) -> None:
        super().__init__(cfg, env)
        restitution, friction = cfg.params["restitution_range"], cfg.params["static_friction_range"]
        if any(restitution):
            raise InputError(
                "randomize_rigid_body_material: restitution_range",
                given=restitution,
                expected="(0.0, 0.0): MuJoCo has no restitution",
                fix="Set it to (0.0, 0.0).",
            )
        if not 0 <= friction[0] <= friction[1]:
            raise InputError(
                "randomize_rigid_body_material: static_friction_range",
                given=friction,
                expected="(low, high) with 0 <= low <= high",
                fix="Correct the bounds.",
            )
        asset_cfg = cfg.params["asset_cfg"]
        asset = env.scene[asset_cfg.name]
        self._asset = asset
        bodies = torch.tensor(asset.body_ids_in_model)[asset_cfg.body_ids]
        collides = (asset.default_model_param("geom_contype") != 0) | (
            asset.default_model_param("geom_conaffinity") != 0
        )
        mine = torch.isin(asset.default_model_param("geom_bodyid").long(), bodies) & collides
        self._geoms = mine.nonzero().flatten()
        if not len(self._geoms):
            raise InputError(
                "randomize_rigid_body_material: asset_cfg",
                given=asset_cfg.body_names,
                expected="bodies with a geom that can collide",
                fix="Choose bodies that touch something.",
            )

    def __call__(
        self,
        env: ManagerBasedRLEnv,
        env_ids: EnvIds,
        static_friction_range: Bounds,
        dynamic_friction_range: Bounds,
        restitution_range: Bounds,
        num_buckets: int,
        asset_cfg: SceneEntityCfg,
        make_consistent: bool = False,
    ) -> None:
        """Draw and write the friction."""
        ids = resolve_env_ids(env, env_ids)
        friction = uniform(env, static_friction_range, (len(ids), len(self._geoms)))
        self._asset.model_param("geom_friction")[ids.unsqueeze(1), self._geoms, 0] = friction.double()


class randomize_rigid_body_mass(ManagerTermBase):
    """Masses of the chosen bodies [kg], at least ``min_mass``.

    ``recompute_inertia`` scales the inertia with the mass, as for a body of another density. Where MuJoCo compensates
    gravity (``gravcomp``) it compensates the new mass too.
    """

    def __init__(self, cfg: EventTermCfg, env: ManagerBasedRLEnv) -> None:
        super().__init__(cfg, env)
        _check(cfg, "mass_distribution_params", positive_scale=True)
        if cfg.params["min_mass"] < 1e-6:
            raise InputError(
                "randomize_rigid_body_mass: min_mass",
                given=cfg.params["min_mass"],
                expected="at least 1e-6 kg",
                fix="A body without mass cannot be simulated; leave min_mass out.",
            )
        data = env.scene[cfg.params["asset_cfg"].name].data
        self._default_mass, self._default_inertia = data.body_mass.torch, data.body_inertia.torch

    def __call__(
        self,
        env: ManagerBasedRLEnv,
        env_ids: EnvIds,
        asset_cfg: SceneEntityCfg,
        mass_distribution_params: Bounds,
        operation: Operation,
        distribution: Distribution = "uniform",
        recompute_inertia: bool = True,
        min_mass: float = 1e-6,
    ) -> None:
        """Draw and write the masses, and the inertias that go with them."""
        ids, bodies = resolve_env_ids(env, env_ids), asset_cfg.body_ids
        asset = env.scene[asset_cfg.name]
        default = self._default_mass[ids][:, bodies]
        masses = combine(default, draw(env, mass_distribution_params, default.shape, distribution), operation)
        masses = masses.clamp(min=min_mass)
        asset.set_masses_index(masses=masses, body_ids=bodies, env_ids=ids)
        if recompute_inertia:
            inertias = self._default_inertia[ids][:, bodies] * (masses / default).unsqueeze(-1)
            asset.set_inertias_index(inertias=inertias, body_ids=bodies, env_ids=ids)


class randomize_rigid_body_com(ManagerTermBase):
    """Centres of mass of the chosen bodies: the model's plus a draw uniform over ``com_range`` (``x, y, z`` [m]).

    As in Isaac Lab, an environment's bodies share one draw.
    """

    def __init__(self, cfg: EventTermCfg, env: ManagerBasedRLEnv) -> None:
        super().__init__(cfg, env)
        self._default = env.scene[cfg.params["asset_cfg"].name].data.body_com_pose_b.torch

    def __call__(
        self,
        env: ManagerBasedRLEnv,
        env_ids: EnvIds,
        com_range: dict[str, Bounds],
        asset_cfg: SceneEntityCfg,
    ) -> None:
        """Draw and write the centres of mass."""
        ids, bodies = resolve_env_ids(env, env_ids), asset_cfg.body_ids
        offset = uniform_axes(env, "randomize_rigid_body_com: com_range", com_range, len(ids), ("x", "y", "z"))
        coms = self._default[ids][:, bodies].clone()
        coms[..., :3] += offset.unsqueeze(1)
        env.scene[asset_cfg.name].set_coms_index(coms=coms, body_ids=bodies, env_ids=ids)


class randomize_actuator_gains(ManagerTermBase):
    """Stiffness [N m/rad] and damping [N m s/rad] of the chosen joints' servos; a law that is None changes nothing."""

    def __init__(self, cfg: EventTermCfg, env: ManagerBasedRLEnv) -> None:
        super().__init__(cfg, env)
        _check(cfg, "stiffness_distribution_params", positive_scale=True)
        _check(cfg, "damping_distribution_params")
        data = env.scene[cfg.params["asset_cfg"].name].data
        self._stiffness, self._damping = data.joint_stiffness.torch, data.joint_damping.torch

    def __call__(
        self,
        env: ManagerBasedRLEnv,
        env_ids: EnvIds,
        asset_cfg: SceneEntityCfg,
        stiffness_distribution_params: Bounds | None = None,
        damping_distribution_params: Bounds | None = None,
        operation: Operation = "abs",
        distribution: Distribution = "uniform",
    ) -> None:
        """Draw and write the gains."""
        ids, joints = resolve_env_ids(env, env_ids), asset_cfg.joint_ids
        asset = env.scene[asset_cfg.name]
        if stiffness_distribution_params is not None:
            default = self._stiffness[ids][:, joints]
            gain = combine(default, draw(env, stiffness_distribution_params, default.shape, distribution), operation)
            asset.write_joint_stiffness_to_sim_index(stiffness=gain, joint_ids=joints, env_ids=ids)
        if damping_distribution_params is not None:
            default = self._damping[ids][:, joints]
            gain = combine(default, draw(env, damping_distribution_params, default.shape, distribution), operation)
            asset.write_joint_damping_to_sim_index(damping=gain, joint_ids=joints, env_ids=ids)


class randomize_joint_parameters(ManagerTermBase):
    """Friction, armature and limits of the chosen joints; a law that is None changes nothing.

    As in Isaac Lab the friction's law is drawn from twice: for dry friction (here a torque [N m]) and for viscous
    friction [N m s/rad], both at least 0. Armature [kg m^2], limits [rad or m].
    """

    def __init__(self, cfg: EventTermCfg, env: ManagerBasedRLEnv) -> None:
        super().__init__(cfg, env)
        _check(cfg, "friction_distribution_params", "armature_distribution_params")
        for name in ("lower_limit_distribution_params", "upper_limit_distribution_params"):
            signed = {**cfg.params, "operation": "add"} if cfg.params["operation"] == "scale" else cfg.params
            check_law(signed, name, operation=signed["operation"], distribution=cfg.params["distribution"])
        data = env.scene[cfg.params["asset_cfg"].name].data
        self._friction, self._viscous = data.joint_friction_coeff.torch, data.joint_viscous_friction_coeff.torch
        self._armature, self._limits = data.joint_armature.torch, data.joint_pos_limits.torch.clone()

    def __call__(
        self,
        env: ManagerBasedRLEnv,
        env_ids: EnvIds,
        asset_cfg: SceneEntityCfg,
        friction_distribution_params: Bounds | None = None,
        armature_distribution_params: Bounds | None = None,
        lower_limit_distribution_params: Bounds | None = None,
        upper_limit_distribution_params: Bounds | None = None,
        operation: Operation = "abs",
        distribution: Distribution = "uniform",
    ) -> None:
        """Draw and write the parameters.

        Raises:
            InputError: a lower limit was drawn above the upper one.
        """
        ids, joints = resolve_env_ids(env, env_ids), asset_cfg.joint_ids
        asset: Any = env.scene[asset_cfg.name]

        def drawn(default: Tensor, law: Bounds) -> Tensor:
            mine = default[ids][:, joints]
            return combine(mine, draw(env, law, mine.shape, distribution), operation)

        if friction_distribution_params is not None:
            asset.write_joint_friction_coefficient_to_sim_index(
                joint_friction_coeff=drawn(self._friction, friction_distribution_params).clamp(min=0.0),
                joint_viscous_friction_coeff=drawn(self._viscous, friction_distribution_params).clamp(min=0.0),
                joint_ids=joints,
                env_ids=ids,
            )
        if armature_distribution_params is not None:
            armature = drawn(self._armature, armature_distribution_params).clamp(min=0.0)
            asset.write_joint_armature_to_sim_index(armature=armature, joint_ids=joints, env_ids=ids)
        laws = (lower_limit_distribution_params, upper_limit_distribution_params)
        if laws != (None, None):
            bounds = [
                self._limits[ids][:, joints, side] if law is None else drawn(self._limits[..., side], law)
                for side, law in enumerate(laws)
            ]
            if (bounds[0] > bounds[1]).any():
                raise InputError(
                    "randomize_joint_parameters: limits",
                    given=laws,
                    expected="lower limits below the upper ones",
                    fix="Narrow the laws so that they cannot cross.",
                )
            asset.write_joint_position_limit_to_sim_index(
                limits=torch.stack(bounds, -1), joint_ids=joints, env_ids=ids, warn_limit_violation=False
            )


class randomize_physics_scene_gravity(ManagerTermBase):
    """Gravity [m/s^2], each environment its own.

    ``gravity_distribution_params``: two lists, (low, high) or (mean, standard deviation), of three numbers (x, y, z).
    ``projected_gravity`` keeps telling the direction of the world's z axis, as an inertial sensor at rest would not.
    """

    def __init__(self, cfg: EventTermCfg, env: ManagerBasedRLEnv) -> None:
        super().__init__(cfg, env)
        first, second = cfg.params["gravity_distribution_params"]
        operation, distribution = cfg.params["operation"], cfg.params["distribution"]
        if len(first) != 3 or len(second) != 3:
            raise InputError(
                "gravity_distribution_params",
                given=(first, second),
                expected="two lists of three numbers, for x, y and z",
                fix="Give e.g. ([0.0, 0.0, -10.3], [0.0, 0.0, -9.3]).",
            )
        for axis, pair in zip("xyz", zip(first, second, strict=True), strict=True):
            name = f"gravity_distribution_params[{axis}]"
            check_law(
                {name: pair}, name, operation="add" if operation == "scale" else operation, distribution=distribution
            )
        self._default = torch.tensor(env.cfg.sim.gravity, device=env.device)

    def __call__(
        self,
        env: ManagerBasedRLEnv,
        env_ids: EnvIds,
        gravity_distribution_params: tuple[list[float], list[float]],
        operation: Operation,
        distribution: Distribution = "uniform",
    ) -> None:
        """Draw and write gravity."""
        ids = resolve_env_ids(env, env_ids)
        first, second = torch.tensor(gravity_distribution_params, device=env.device)
        sample = draw(env, (first, second), (len(ids), 3), distribution)
        asset = next(iter(env.scene.articulations.values()))
        asset.model_param("opt.gravity")[ids] = combine(self._default.expand(len(ids), 3), sample, operation).double()
        env.scene.world.mark_written(ids)

"""What the names of older courses are called today, in Isaac Lab 3.0, and how to install it.

``OUTDATED_NAMES.md`` is written from this table (:func:`page`), and the conformance tests look every name of
``found_as`` up in the genuine wheel. Nothing here needs Isaac Lab.
"""

from __future__ import annotations

from dataclasses import dataclass

ISAACLAB_VERSION = "3.0.0"
"""The release that the table, the terms and the exporter are checked against."""


@dataclass(frozen=True, slots=True)
class OutdatedName:
    """An old name and what to write instead.

    Attributes:
        old: as older texts have it.
        today: what to write with Isaac Lab 3.0.
        since: the release that brought the new name, or why the old one never worked.
        note: what else changed.
        found_as: ``module:object`` paths that have to exist in the genuine wheel.
        in_kit: the same thing in this kit, empty where there is none.
    """

    old: str
    today: str
    since: str
    note: str = ""
    found_as: tuple[str, ...] = ()
    in_kit: str = ""


_VELOCITY = "isaaclab_tasks.core.velocity"
_MDP = "isaaclab.envs.mdp"

NAMES = (
    OutdatedName(
        "omni.isaac.orbit_tasks",
        "isaaclab_tasks",
        "Orbit became Isaac Lab 1.0 (omni.isaac.lab_tasks), 2.0 dropped the prefix",
        "3.0 divides its tasks into isaaclab_tasks.core and isaaclab_tasks.contrib. omni.isaac.orbit is isaaclab.",
        ("isaaclab_tasks.core:", "isaaclab_tasks.contrib:", "isaaclab:"),
        "robotbrain.rl.tasks",
    ),
    OutdatedName(
        "omni.isaac.orbit_tasks.locomotion.velocity.velocity_env_cfg",
        f"{_VELOCITY}.velocity_env_cfg",
        "3.0 (2.x: isaaclab_tasks.manager_based.locomotion.velocity)",
        "",
        (f"{_VELOCITY}.velocity_env_cfg:",),
        "robotbrain.rl.tasks.velocity",
    ),
    OutdatedName(
        "LocomotionVelocityCfg",
        "LocomotionVelocityRoughEnvCfg, or a robot's own AnymalDFlatEnvCfg",
        "the name never existed",
        "The base configuration has no robot (MISSING): take one of a robot, or derive your own.",
        (
            f"{_VELOCITY}.velocity_env_cfg:LocomotionVelocityRoughEnvCfg",
            f"{_VELOCITY}.config.anymal_d.flat_env_cfg:AnymalDFlatEnvCfg",
        ),
        "robotbrain.rl.tasks.velocity.VelocityEnvCfg",
    ),
    OutdatedName(
        "from omni.isaac.orbit_tasks.utils import parse_env_cfg; parse_env_cfg(env_cfg)",
        "from isaaclab_tasks.utils import parse_env_cfg; parse_env_cfg('Isaac-Velocity-Flat-AnymalD', num_envs=4096)",
        "2.0 (the module); it always took a task's name",
        "It makes a configuration from the name of a registered task. One you have made yourself needs no parsing.",
        ("isaaclab_tasks.utils:parse_env_cfg",),
        "robotbrain.rl.registry.task_cfg",
    ),
    OutdatedName(
        "manager_based_rl_envs.gym_wrapper.task_make(task_cfg=..., num_envs=..., device=...)",
        "gymnasium.make(task, cfg=env_cfg), or ManagerBasedRLEnv(cfg=env_cfg)",
        "the name never existed",
        "Number of environments and device are env_cfg.scene.num_envs and env_cfg.sim.device.",
        ("isaaclab.envs:ManagerBasedRLEnv",),
        "robotbrain.rl.registry.make",
    ),
    OutdatedName(
        "create_env(env_cfg)",
        "ManagerBasedRLEnv(cfg=env_cfg)",
        "the name never existed",
        "reset() returns (observations, extras); step() returns five values, terminated and truncated apart.",
        ("isaaclab.envs:ManagerBasedRLEnv",),
        "robotbrain.rl.envs.ManagerBasedRLEnv",
    ),
    OutdatedName(
        "init_algorithm_cfg(env_cfg.rl_games_cfg_path)",
        "load_cfg_from_registry(task, 'rsl_rl_cfg_entry_point')",
        "the name never existed",
        "A task is registered with one configuration for each learning library it knows.",
        ("isaaclab_tasks.utils:load_cfg_from_registry", "isaaclab_rl.rsl_rl:RslRlOnPolicyRunnerCfg"),
        "robotbrain.rl.ppo_cfg",
    ),
    OutdatedName(
        "train_agents(cfg=..., env=..., logger_cfg=...)",
        "isaaclab train --rl_library rsl_rl --task Isaac-Velocity-Flat-AnymalD",
        "3.0 (2.x: scripts/reinforcement_learning/rsl_rl/train.py); the name never existed",
        "Play the result with isaaclab play.",
        ("isaaclab_rl.entrypoints:run_train_cli", "isaaclab_rl.entrypoints:run_play_cli"),
        "robotbrain rl train",
    ),
    OutdatedName(
        "agent_cfg.model_params.network.pretrained_encoder_path",
        "agent_cfg.actor and agent_cfg.critic (RslRlMLPModelCfg)",
        "3.0 (rsl-rl 5; 2.x: agent_cfg.policy)",
        "There is no encoder in a task without images.",
        ("isaaclab_rl.rsl_rl:RslRlMLPModelCfg",),
        "robotbrain.rl.ppo_cfg.RslRlMLPModelCfg",
    ),
    OutdatedName(
        "env_cfg.log, env_cfg.rl_games_cfg_path",
        "agent_cfg.logger, agent_cfg.experiment_name; gymnasium.spec(task).kwargs",
        "the names never existed",
        "",
        ("isaaclab_rl.rsl_rl:RslRlOnPolicyRunnerCfg",),
        "robotbrain.rl.logs",
    ),
    OutdatedName(
        "env_cfg.scene.robot.init_state.rot = [1.0, 0.0, 0.0, 0.0]",
        "env_cfg.scene.robot.init_state.rot = (0.0, 0.0, 0.0, 1.0)",
        "3.0",
        "Quaternions are (x, y, z, w) everywhere since 3.0. The old line still runs and turns the robot upside down.",
        ("isaaclab.assets:ArticulationCfg.InitialStateCfg", "isaaclab.utils.math:quat_mul"),
        "robotbrain.rl.scene.InitialStateCfg",
    ),
    OutdatedName(
        "env_cfg.domain_rand.push_interval = 200, push_robot_thresh",
        "EventTermCfg(func=mdp.push_by_setting_velocity, mode='interval', interval_range_s=(10.0, 15.0), ...)",
        "legged_gym's name; Isaac Lab has had events since 1.0",
        "The interval is in seconds, not in steps; the strength is params={'velocity_range': {...}}.",
        (f"{_MDP}:push_by_setting_velocity", "isaaclab.managers:EventTermCfg"),
        "robotbrain.rl.mdp.push_by_setting_velocity",
    ),
    OutdatedName(
        "env_cfg.domain_rand.randomize_friction = True, friction_range",
        "EventTermCfg(func=mdp.randomize_rigid_body_material, mode='startup', ...)",
        "legged_gym's name; Isaac Lab has had events since 1.0",
        "params: static_friction_range, dynamic_friction_range, restitution_range, num_buckets, asset_cfg.",
        (f"{_MDP}:randomize_rigid_body_material",),
        "robotbrain.rl.mdp.randomize_rigid_body_material",
    ),
    OutdatedName(
        "env_cfg.domain_rand.randomize_base_mass = True, added_mass_range",
        "EventTermCfg(func=mdp.randomize_rigid_body_mass, mode='startup', ...)",
        "legged_gym's name; Isaac Lab has had events since 1.0",
        "params: asset_cfg, mass_distribution_params=(-1.0, 3.0), operation='add'.",
        (f"{_MDP}:randomize_rigid_body_mass",),
        "robotbrain.rl.mdp.randomize_rigid_body_mass",
    ),
    OutdatedName(
        "ReachEnvCfg()",
        "isaaclab_tasks.core.reach.reach_env_cfg.ReachEnvCfg, for a robot FrankaReachEnvCfg",
        "3.0 (2.x: isaaclab_tasks.manager_based.manipulation.reach)",
        "ReachEnvCfg itself has no robot (MISSING). Rewards are terms of env_cfg.rewards, not a function of env.",
        (
            "isaaclab_tasks.core.reach.reach_env_cfg:ReachEnvCfg",
            "isaaclab_tasks.core.reach.config.franka.franka_reach_env_cfg:FrankaReachEnvCfg",
        ),
        "robotbrain.rl.tasks.reach.ReachEnvCfg",
    ),
    OutdatedName(
        "env.scene.ee_positions, env.scene.target_positions",
        "env.scene['robot'].data.body_pos_w.torch[:, body_ids], env.command_manager.get_command('ee_pose')",
        "the names never existed; .torch since 3.0",
        "Data are Warp arrays since 3.0: .torch gives the tensor. The command is in the robot's own frame.",
        (f"{_MDP}:position_command_error", f"{_MDP}:UniformPoseCommandCfg"),
        "robotbrain.rl.mdp.position_command_error",
    ),
    OutdatedName(
        "mdp.image(data_type='rgb')",
        "mdp.image_rgb()",
        "3.0",
        "One term for each kind of picture: image_rgb, image_depth, image_normals, image_segmentation.",
        (f"{_MDP}:image_rgb", f"{_MDP}:image_depth"),
    ),
    OutdatedName(
        "https://github.com/NVIDIA-Omniverse/IsaacLab.git",
        "https://github.com/isaac-sim/IsaacLab.git",
        "1.0",
        "",
    ),
)
"""In the order in which an older course brings them up."""


@dataclass(frozen=True, slots=True)
class Route:
    """A way to install Isaac Lab.

    Attributes:
        name: of the route.
        commands: to type.
        note: what it is good for, and what it needs.
    """

    name: str
    commands: tuple[str, ...]
    note: str


ROUTES = (
    Route(
        "pip",
        (
            "python3.12 -m venv env_isaaclab && . env_isaaclab/bin/activate",
            f'pip install "isaaclab[importers]=={ISAACLAB_VERSION}"',
        ),
        "Python 3.12 and no other. The extra brings the importer of MJCF and URDF robots. The Newton backend (MuJoCo "
        "Warp) needs an NVIDIA GPU to be quick and no Isaac Sim.",
    ),
    Route(
        "uv",
        (
            "uv venv --python 3.12 env_isaaclab && . env_isaaclab/bin/activate",
            f'uv pip install "isaaclab[importers]=={ISAACLAB_VERSION}"',
        ),
        "The same, with uv, which also fetches Python 3.12.",
    ),
    Route(
        "source",
        ("git clone https://github.com/isaac-sim/IsaacLab.git && cd IsaacLab", "./isaaclab.sh -i"),
        "For changing Isaac Lab itself. `./isaaclab.sh -i` installs the repository's packages into the active "
        "environment; `./isaaclab.sh -i core` takes fewer of them. Release 3.0 calls the script legacy and recommends "
        "uv, and the main branch no longer has it: check out a release's tag first.",
    ),
    Route(
        "container",
        ("git clone https://github.com/isaac-sim/IsaacLab.git && cd IsaacLab", "./docker/container.py start"),
        "Linux with the NVIDIA Container Toolkit; for servers.",
    ),
    Route(
        "this kit",
        ('pip install "robotbrain"', "robotbrain rl --help"),
        "No GPU: the same terms on MuJoCo. Write and try a task here, then `robotbrain rl export-isaaclab`.",
    ),
)
"""Today's ways to get it. Rendering and the PhysX backend of Isaac Sim need an RTX GPU; importing, configuring and the
conformance tests need none."""


def page() -> str:
    """The page ``OUTDATED_NAMES.md``."""
    rows = "\n".join(
        "| " + " | ".join((_code(n.old), _code(n.today), n.since, _code(n.in_kit), n.note)) + " |" for n in NAMES
    )
    routes = "\n\n".join(f"### {r.name}\n\n```sh\n" + "\n".join(r.commands) + f"\n```\n\n{r.note}" for r in ROUTES)
    return f"""# Outdated names, and today's

Isaac Lab has changed its name twice (Orbit, `omni.isaac.lab`, `isaaclab`) and its interfaces more often. Left: what
older texts say. The new names were looked up in the genuine wheel, release {ISAACLAB_VERSION}
(`make conformance-isaaclab`). "Never existed" marks names that no release has had.

| Older texts | Isaac Lab {ISAACLAB_VERSION} | Since | In this kit | Note |
|---|---|---|---|---|
{rows}

## Installing it today

{routes}

What needs a GPU: training thousands of environments at once (any recent NVIDIA GPU), and cameras and the PhysX backend
of Isaac Sim (an RTX GPU). Reading and checking configurations needs none.

This file is written by `python -m robotbrain.rl.isaaclab.names`.
"""


def _code(text: str) -> str:
    return f"`{text}`" if text else ""


def main() -> None:
    """Write the page next to this module."""
    from pathlib import Path

    from robotbrain.files import write_text

    write_text(Path(__file__).with_name("OUTDATED_NAMES.md"), page())


if __name__ == "__main__":
    main()

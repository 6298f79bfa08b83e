"""Each event draws from the law its configuration names, and the physics feels it."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import mujoco
import pytest
import torch
from scipy import stats

from robotbrain.errors import InputError
from robotbrain.rl import math_utils, mdp
from robotbrain.rl.configclass import configclass
from robotbrain.rl.managers import EventTermCfg, SceneEntityCfg
from robotbrain.rl.managers.event_manager import EventManager
from robotbrain.rl.mdp._latency import CommandDelay
from robotbrain.rl.robots import quadruped_mjcf
from robotbrain.rl.scene import ArticulationCfg, InteractiveSceneCfg, SimulationCfg
from robotbrain.rl.scene.interactive_scene import InteractiveScene

N = 600
ALPHA = 1e-4  # chance of a false alarm of a test; the seeds are fixed, so it passes always or never
ROBOT = SceneEntityCfg("robot")

ARM = """<mujoco><compiler angle="radian"/><option timestep="0.002" integrator="Euler"/>
<default><joint damping="0"/></default><worldbody>
<body name="root"><geom size="0.1" mass="3"/>
 <body name="cart" pos="0 1 0"><joint name="slide" type="slide" axis="1 0 0"/><geom size="0.1" mass="2"/></body>
 <body name="wheel" pos="0 -1 0" simple="false"><joint name="hinge" axis="0 1 0" range="-2 2" limited="true"/>
  <geom type="box" size="0.1 0.1 0.1" mass="1.5"/></body>
</body></worldbody>
<actuator><motor name="push" joint="slide"/><position name="turn" joint="hinge" kp="20" kv="2" forcerange="-3 3"/>
</actuator></mujoco>"""

BLOCK = """<mujoco><option timestep="0.002" cone="elliptic" impratio="10"/>
<worldbody><geom type="plane" size="50 50 1" friction="0.1 0 0"/>
<body name="block" pos="0 0 0.01"><freejoint/>
<geom type="box" size="0.5 0.5 0.01" mass="1" priority="1" friction="0.7 0.005 0.0001"/></body></worldbody></mujoco>"""


@configclass
class SceneCfg(InteractiveSceneCfg):
    robot: ArticulationCfg = ArticulationCfg()


def make_env(mjcf: str, num_envs: int = N, *, gravity: float = -9.81, slope: float = 0.0, seed: int = 0) -> Any:
    """As much of an environment as an event needs; ``slope`` tilts gravity towards x."""
    cfg = SceneCfg(num_envs=num_envs, robot=ArticulationCfg(model=mjcf))
    sim = SimulationCfg(dt=0.002, gravity=(-slope * gravity, 0.0, gravity))
    scene = InteractiveScene(cfg, sim, num_threads=1)
    scene.reset()
    generator = torch.Generator().manual_seed(seed)
    return SimpleNamespace(
        scene=scene,
        num_envs=num_envs,
        device=torch.device("cpu"),
        generator=generator,
        cfg=SimpleNamespace(sim=sim, decimation=4),
    )


def fire(env: Any, func: Any, env_ids: Any = None, **params: Any) -> EventManager:
    """Run an event as a task does."""
    manager = EventManager({"event": EventTermCfg(func=func, mode="startup", params=params)}, env)
    manager.apply("startup", env_ids)
    return manager


def assert_uniform(values: torch.Tensor, low: float, high: float) -> None:
    flat = values.flatten().double()
    assert flat.min() >= low - 1e-6 and flat.max() <= high + 1e-6
    assert stats.kstest(flat.numpy(), stats.uniform(low, high - low).cdf).pvalue > ALPHA


def assert_independent(values: torch.Tensor) -> None:
    """Columns of (num_envs, k) draws are not correlated."""
    off = torch.corrcoef(values.T.double()) - torch.eye(values.shape[1])
    assert off.abs().max() < 4.5 / math.sqrt(len(values))


def only(**kwargs: Any) -> SceneEntityCfg:
    return SceneEntityCfg("robot", **kwargs)


# -- masses, centres of mass, friction


@pytest.mark.parametrize(
    ("operation", "params", "low", "high"),
    [("add", (-1.0, 3.0), 1.0, 5.0), ("scale", (0.5, 1.5), 1.0, 3.0), ("abs", (0.3, 0.9), 0.3, 0.9)],
)
def test_mass_follows_its_law_and_changes_the_acceleration(
    operation: str, params: tuple[float, float], low: float, high: float
) -> None:
    env = make_env(ARM)
    fire(
        env,
        mdp.randomize_rigid_body_mass,
        asset_cfg=only(body_names="cart"),
        mass_distribution_params=params,
        operation=operation,
    )
    robot = env.scene["robot"]
    mass = robot.data.body_mass.torch[:, 1]
    assert_uniform(mass, low, high)
    assert (robot.data.body_mass.torch[:, [0, 2]] == torch.tensor([3.0, 1.5])).all()  # the others keep theirs
    robot.set_joint_effort_target(torch.tensor([[6.0, 0.0]]).expand(N, 2))
    env.scene.world.step(1)
    torch.testing.assert_close(robot.data.joint_vel.torch[:, 0], 6.0 / mass * 0.002)


def test_the_laws_of_mass() -> None:
    env, cart = make_env(ARM, 2000), only(body_names="cart")
    common = {"asset_cfg": cart, "operation": "abs"}
    fire(env, mdp.randomize_rigid_body_mass, **common, mass_distribution_params=(0.1, 10.0), distribution="log_uniform")
    assert_uniform(env.scene["robot"].data.body_mass.torch[:, 1].log(), math.log(0.1), math.log(10.0))
    fire(env, mdp.randomize_rigid_body_mass, **common, mass_distribution_params=(3.0, 0.4), distribution="gaussian")
    mass = env.scene["robot"].data.body_mass.torch[:, 1]
    assert stats.kstest(mass.numpy(), stats.norm(3.0, 0.4).cdf).pvalue > ALPHA
    fire(env, mdp.randomize_rigid_body_mass, **common, mass_distribution_params=(-5.0, 1.0), min_mass=0.5)
    assert env.scene["robot"].data.body_mass.torch[:, 1].min() == 0.5


@pytest.mark.parametrize("recompute", [True, False])
def test_inertia_goes_with_the_mass_when_asked(recompute: bool) -> None:
    env = make_env(ARM, 50)
    inertia = 1.5 * (0.2**2 + 0.2**2) / 12  # of a cube of edge 0.2 m about an axis through its centre
    fire(
        env,
        mdp.randomize_rigid_body_mass,
        asset_cfg=only(body_names="wheel"),
        mass_distribution_params=(0.5, 2.0),
        operation="scale",
        recompute_inertia=recompute,
    )
    robot = env.scene["robot"]
    expected = inertia * (robot.data.body_mass.torch[:, 2] / 1.5 if recompute else torch.ones(50))
    torch.testing.assert_close(robot.data.body_inertia.torch[:, 2, 4], expected, rtol=1e-4, atol=1e-7)
    robot.set_joint_position_target(torch.tensor([[0.0, 0.05]]).expand(50, 2))  # 20 N m/rad * 0.05 rad = 1 N m
    env.scene.world.step(1)
    torch.testing.assert_close(robot.data.joint_vel.torch[:, 1], 1.0 / expected * 0.002, rtol=1e-4, atol=1e-6)


def test_centre_of_mass_follows_its_law_and_makes_a_pendulum() -> None:
    env = make_env(ARM)
    where = {"x": (-0.05, 0.05), "z": (0.01, 0.02)}
    fire(env, mdp.randomize_rigid_body_com, asset_cfg=only(body_names="wheel"), com_range=where)
    robot = env.scene["robot"]
    com = robot.data.body_com_pose_b.torch[:, 2]
    assert_uniform(com[:, 0], -0.05, 0.05)
    assert_uniform(com[:, 2], 0.01, 0.02)
    assert (com[:, 1] == 0.0).all()
    assert_independent(com[:, [0, 2]])
    # it falls to the side its mass is on: torque m g x about the y axis, inertia by the parallel axes theorem
    inertia = 1.5 * 0.08 / 12 + 1.5 * (com[:, 0] ** 2 + com[:, 2] ** 2)
    robot.set_joint_position_target(torch.zeros(N, 2))
    env.scene.world.step(1)
    expected = 1.5 * 9.81 * com[:, 0] / inertia * 0.002
    torch.testing.assert_close(robot.data.joint_vel.torch[:, 1], expected, rtol=1e-3, atol=1e-5)
    # the geoms stay where they are on the body
    offset = torch.from_numpy(env.scene.world.derived("geom_xpos")[:, 2]) - robot.data.body_pos_w.torch[:, 2]
    assert offset.abs().max() < 1e-6


def test_a_moved_centre_of_mass_counts_where_frames_coincide_and_moves_nothing_else() -> None:
    env = make_env(quadruped_mjcf(), 20)  # MuJoCo compiles its trunk as: centre of mass, geoms and sites at the origin
    world, trunk = env.scene.world, int(env.scene.world.model.body("base").id)
    assert int(world.model.body_sameframe[trunk]) == int(mujoco.mjtSameFrame.mjSAMEFRAME_BODY)
    places = {name: world.derived(name).copy() for name in ("geom_xpos", "site_xpos", "xpos")}
    ranges = {"x": (0.05, 0.1), "y": (-0.1, 0.1)}
    fire(env, mdp.randomize_rigid_body_com, asset_cfg=only(body_names="base"), com_range=ranges)
    com = env.scene["robot"].data.body_com_pose_b.torch[:, 0, :3].double()
    offset = torch.from_numpy(world.derived("xipos")[:, trunk] - world.derived("xpos")[:, trunk])
    torch.testing.assert_close(offset, com, rtol=0.0, atol=1e-6)
    for name, before in places.items():
        assert abs(world.derived(name) - before).max() < 1e-9, name


def test_friction_follows_its_law_and_holds_a_block_on_a_slope() -> None:
    env = make_env(BLOCK, slope=0.9)
    fire(
        env,
        mdp.randomize_rigid_body_material,
        asset_cfg=only(body_names=".*"),
        static_friction_range=(0.5, 1.25),
        dynamic_friction_range=(0.5, 1.25),
        restitution_range=(0.0, 0.0),
        num_buckets=64,
    )
    robot = env.scene["robot"]
    friction = robot.model_param("geom_friction")[:, 1, 0].float()
    assert_uniform(friction, 0.5, 1.25)
    assert (robot.model_param("geom_friction")[:, 0, 0] == 0.1).all()  # the ground is not the robot
    env.scene.world.step(200)
    slid = robot.data.root_pos_w.torch[:, 0]
    assert (slid[friction > 0.95] < 0.01).all()
    assert (slid[friction < 0.85] > 0.02).all()


# -- joints and servos


def test_gains_follow_their_laws_and_the_servo_obeys() -> None:
    env = make_env(ARM, gravity=0.0)
    laws = {"stiffness_distribution_params": (0.8, 1.2), "damping_distribution_params": (0.5, 1.5)}
    fire(env, mdp.randomize_actuator_gains, asset_cfg=only(joint_names="hinge"), **laws, operation="scale")
    robot = env.scene["robot"]
    stiffness, damping = robot.data.joint_stiffness.torch[:, 1], robot.data.joint_damping.torch[:, 1]
    assert_uniform(stiffness, 16.0, 24.0)
    assert_uniform(damping, 1.0, 3.0)
    assert_independent(torch.stack((stiffness, damping), 1))
    robot.write_joint_state_to_sim(torch.tensor([[0.0, 0.1]]).expand(N, 2), torch.tensor([[0.0, 0.2]]).expand(N, 2))
    robot.set_joint_position_target(torch.zeros(N, 2))
    env.scene.world.flush()
    torch.testing.assert_close(robot.actuators.applied_effort.torch[:, 1], -0.1 * stiffness - 0.2 * damping)


def test_motor_strength_scales_gains_and_the_largest_torque() -> None:
    env = make_env(ARM, gravity=0.0)
    fire(env, mdp.randomize_motor_strength, asset_cfg=only(joint_names="hinge"), strength_range=(0.6, 1.1))
    robot = env.scene["robot"]
    strength = robot.data.joint_stiffness.torch[:, 1] / 20.0
    assert_uniform(strength, 0.6, 1.1)
    torch.testing.assert_close(robot.data.joint_damping.torch[:, 1], 2.0 * strength)
    robot.set_joint_position_target(torch.tensor([[0.0, 1.0]]).expand(N, 2))  # asks for 20 N m, gets 3 times strength
    env.scene.world.mark_written(None)
    torch.testing.assert_close(robot.actuators.applied_effort.torch[:, 1], 3.0 * strength)
    torch.testing.assert_close(robot.actuators.computed_effort.torch[:, 1], 20.0 * strength)


def test_joint_parameters_follow_their_laws() -> None:
    env = make_env(ARM, gravity=0.0)
    fire(
        env,
        mdp.randomize_joint_parameters,
        asset_cfg=only(joint_names="slide"),
        friction_distribution_params=(0.0, 2.0),
        armature_distribution_params=(0.5, 1.0),
    )
    robot = env.scene["robot"]
    data = robot.data
    friction, viscous = data.joint_friction_coeff.torch[:, 0], data.joint_viscous_friction_coeff.torch[:, 0]
    assert_uniform(friction, 0.0, 2.0)
    assert_uniform(viscous, 0.0, 2.0)
    assert_independent(torch.stack((friction, viscous), 1))
    assert_uniform(data.joint_armature.torch[:, 0], 0.5, 1.0)
    robot.set_joint_effort_target(torch.tensor([[1.0, 0.0]]).expand(N, 2))
    env.scene.world.step(100)
    moved = data.joint_pos.torch[:, 0]
    assert (moved[friction > 1.1].abs() < 1e-3).all() and (moved[friction < 0.5] > 1e-3).all()


def test_armature_is_felt_as_inertia() -> None:
    env = make_env(ARM, 40, gravity=0.0)
    fire(env, mdp.randomize_joint_parameters, asset_cfg=only(joint_names="slide"),
         armature_distribution_params=(0.5, 2.0))  # fmt: skip
    robot = env.scene["robot"]
    robot.set_joint_effort_target(torch.tensor([[1.0, 0.0]]).expand(40, 2))
    env.scene.world.step(1)
    expected = 0.002 / (2.0 + robot.data.joint_armature.torch[:, 0])
    torch.testing.assert_close(robot.data.joint_vel.torch[:, 0], expected)


def test_limits_are_drawn_and_hold() -> None:
    env = make_env(ARM, 100, gravity=0.0)
    fire(
        env,
        mdp.randomize_joint_parameters,
        asset_cfg=only(joint_names="hinge"),
        upper_limit_distribution_params=(0.1, 0.3),
    )
    robot = env.scene["robot"]
    upper = robot.data.joint_pos_limits.torch[:, 1, 1]
    assert_uniform(upper, 0.1, 0.3)
    assert (robot.data.joint_pos_limits.torch[:, 1, 0] == -2.0).all()
    robot.set_joint_position_target(torch.tensor([[0.0, 1.0]]).expand(100, 2))
    env.scene.world.step(1500)
    assert (robot.data.joint_pos.torch[:, 1] - upper).abs().max() < 0.05
    with pytest.raises(InputError, match="lower limits"):
        fire(
            env,
            mdp.randomize_joint_parameters,
            asset_cfg=only(joint_names="hinge"),
            lower_limit_distribution_params=(5.0, 6.0),
        )


# -- gravity, pushes, forces, resets


def test_gravity_follows_its_law_and_things_fall_with_it() -> None:
    env = make_env(BLOCK)
    law = ([0.0, 0.0, -1.0], [0.0, 0.0, 2.0])
    fire(env, mdp.randomize_physics_scene_gravity, gravity_distribution_params=law, operation="add")
    robot = env.scene["robot"]
    pose = robot.data.default_root_pose.torch.clone()
    pose[:, 2] += 5.0
    robot.write_root_pose_to_sim_index(root_pose=pose)
    env.scene.world.step(1)
    gravity = robot.data.root_lin_vel_w.torch[:, 2] / 0.002
    assert_uniform(gravity, -10.81, -7.81)


def test_push_adds_exactly_what_it_draws() -> None:
    env = make_env(BLOCK)
    robot = env.scene["robot"]
    tilt = math_utils.quat_from_euler_xyz(*torch.tensor([[0.4], [-0.3], [1.0]]).expand(3, N))
    robot.write_root_pose_to_sim_index(root_pose=torch.cat((torch.zeros(N, 3), tilt), 1))
    robot.write_root_velocity_to_sim_index(root_velocity=torch.arange(6.0).expand(N, 6))
    before = robot.data.root_vel_w.torch.clone()
    fire(env, mdp.push_by_setting_velocity, velocity_range={"x": (-0.5, 0.5), "y": (-0.5, 0.5), "yaw": (0.1, 0.2)})
    push = robot.data.root_vel_w.torch - before
    for axis, bounds in ((0, (-0.5, 0.5)), (1, (-0.5, 0.5)), (5, (0.1, 0.2))):
        assert_uniform(push[:, axis], *bounds)
    assert push[:, 2:5].abs().max() < 1e-5
    assert_independent(push[:, [0, 1, 5]])


def test_external_forces_act_in_the_bodys_frame_until_the_reset() -> None:
    env = make_env(BLOCK, gravity=0.0)
    robot = env.scene["robot"]
    quarter = torch.tensor([0.0, 0.0, 5.0, 0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5)]).expand(N, 7)
    robot.write_root_pose_to_sim_index(root_pose=quarter)
    fire(env, mdp.apply_external_force_torque, force_range=(1.0, 2.0), torque_range=(0.0, 0.0), asset_cfg=ROBOT)
    env.scene.world.step(1)
    acceleration = robot.data.root_lin_vel_w.torch / 0.002  # of 1 kg
    assert_uniform(acceleration[:, 1], 1.0, 2.0)  # the body's x axis is the world's y axis
    assert_uniform(-acceleration[:, 0], 1.0, 2.0)
    assert_independent(acceleration)
    env.scene.reset(torch.arange(10))
    env.scene.world.step(1)
    assert robot.data.root_lin_vel_w.torch[:10].abs().max() < 1e-6
    assert (robot.data.root_lin_vel_w.torch[10:].abs() > 0).all()


def test_root_reset_is_the_default_plus_uniform_draws() -> None:
    env = make_env(BLOCK)
    pose = {"x": (-1.0, 2.0), "yaw": (-math.pi, math.pi)}
    fire(env, mdp.reset_root_state_uniform, pose_range=pose, velocity_range={"z": (0.0, 0.4), "pitch": (-1.0, 1.0)})
    data = env.scene["robot"].data
    assert_uniform(data.root_pos_w.torch[:, 0], -1.0, 2.0)
    assert (data.root_pos_w.torch[:, 1:] == torch.tensor([0.0, 0.01])).all()
    assert_uniform(data.heading_w.torch, -math.pi, math.pi)
    assert (data.projected_gravity_b.torch[:, 2] + 1.0).abs().max() < 1e-6
    assert_uniform(data.root_lin_vel_w.torch[:, 2], 0.0, 0.4)
    assert_uniform(data.root_ang_vel_w.torch[:, 1], -1.0, 1.0)


@pytest.mark.parametrize("how", ["scale", "offset"])
def test_joint_resets(how: str) -> None:
    env = make_env(ARM)
    robot = env.scene["robot"]
    robot.data.default_joint_pos.torch[:] = torch.tensor([0.5, 1.5])
    func = mdp.reset_joints_by_scale if how == "scale" else mdp.reset_joints_by_offset
    fire(env, func, position_range=(0.5, 1.5), velocity_range=(-0.2, 0.2), asset_cfg=ROBOT)
    position, velocity = robot.data.joint_pos.torch, robot.data.joint_vel.torch
    low, high = (0.25, 0.75) if how == "scale" else (1.0, 2.0)
    assert_uniform(position[:, 0], low, high)
    assert position[:, 1].max() == 2.0  # drawn up to 2.25 or 3.0, held within the soft limits
    if how == "offset":
        assert_uniform(velocity, -0.2, 0.2)
    else:
        assert (velocity == 0.0).all()


# -- latency


@pytest.mark.parametrize("decimation", [1, 3, 4])
def test_delay_is_that_of_a_line_of_physics_steps(decimation: int) -> None:
    generator = torch.Generator().manual_seed(3)
    latency = torch.arange(9)
    delay = CommandDelay(9, decimation, "cpu")
    delay.set(slice(None), latency, 8)
    line: list[torch.Tensor] = []  # what was commanded at each physics step of the episode
    for _ in range(8):
        command = torch.randn(9, 2, generator=generator)
        delay.push(command)
        for _ in range(decimation):
            line.append(command)
            expected = torch.stack([line[max(len(line) - 1 - int(d), 0)][i] for i, d in enumerate(latency)])
            assert torch.equal(delay.now(), expected)
    delay.reset(torch.tensor([8]))
    fresh = torch.ones(9, 2)
    delay.push(fresh)
    assert torch.equal(delay.now()[8], fresh[8])  # nothing from the episode before


def test_latency_is_uniform_over_whole_physics_steps() -> None:
    delay = CommandDelay(N, 4, "cpu")
    term = SimpleNamespace(delay=delay, apply_every_substep=False)
    env = SimpleNamespace(
        num_envs=N,
        device="cpu",
        generator=torch.Generator().manual_seed(0),
        action_manager=SimpleNamespace(get_term=lambda name: term),
    )
    mdp.randomize_action_latency(env, None, "joint_pos", (2, 6))
    counts = torch.bincount(delay.latency, minlength=7)
    assert (counts[:2] == 0).all() and stats.chisquare(counts[2:].numpy()).pvalue > ALPHA
    assert term.apply_every_substep
    mdp.randomize_action_latency(env, torch.tensor([1, 5]), "joint_pos", (0, 0))
    assert (delay.latency[[1, 5]] == 0).all() and not (delay.latency == 0)[[0, 2, 3, 4]].any()


# -- what holds for all of them

LAWS: dict[str, tuple[Any, dict[str, Any]]] = {
    "mass": (
        mdp.randomize_rigid_body_mass,
        {"asset_cfg": ROBOT, "mass_distribution_params": (0.5, 2.0), "operation": "scale"},
    ),
    "com": (mdp.randomize_rigid_body_com, {"asset_cfg": only(body_names="wheel"), "com_range": {"y": (-0.1, 0.1)}}),
    "gains": (
        mdp.randomize_actuator_gains,
        {
            "asset_cfg": only(joint_names="hinge"),
            "stiffness_distribution_params": (0.5, 2.0),
            "damping_distribution_params": (0.5, 2.0),
            "operation": "scale",
        },
    ),
    "joints": (
        mdp.randomize_joint_parameters,
        {"asset_cfg": ROBOT, "friction_distribution_params": (0.1, 1.0), "armature_distribution_params": (0.1, 1.0)},
    ),
    "strength": (
        mdp.randomize_motor_strength,
        {"asset_cfg": only(joint_names="hinge"), "strength_range": (0.5, 2.0)},
    ),
    "material": (
        mdp.randomize_rigid_body_material,
        {
            "asset_cfg": ROBOT,
            "static_friction_range": (0.1, 1.0),
            "dynamic_friction_range": (0.1, 1.0),
            "restitution_range": (0.0, 0.0),
            "num_buckets": 8,
        },
    ),
    "gravity": (
        mdp.randomize_physics_scene_gravity,
        {"gravity_distribution_params": ([0.5, 0.5, 0.5], [2.0, 2.0, 2.0]), "operation": "add"},
    ),
}


@pytest.mark.parametrize("name", LAWS)
def test_events_are_reproducible_do_not_compound_and_touch_only_their_environments(name: str) -> None:
    func, params = LAWS[name]
    env, twin = make_env(ARM, 6, seed=1), make_env(ARM, 6, seed=1)
    torch.manual_seed(1)
    untouched = torch.get_rng_state()
    manager = fire(env, func, **params)
    torch.manual_seed(2)
    fire(twin, func, **params)
    first = {k: v.clone() for k, v in env.scene.world.expanded_fields().items()}
    for field, value in twin.scene.world.expanded_fields().items():
        assert torch.equal(value, first[field]), field  # the same seed, whatever torch's global generator does
    torch.manual_seed(1)
    assert torch.equal(torch.get_rng_state(), untouched)
    state = env.generator.get_state()
    manager.apply("startup", torch.tensor([2, 4]))
    changed = env.scene.world.expanded_fields()
    moved = set()
    for field, value in changed.items():
        moved |= set((value != first[field]).flatten(1).any(1).nonzero().flatten().tolist())
    assert moved == {2, 4}
    env.generator.set_state(state)
    manager.apply("startup", torch.tensor([2, 4]))
    for field, value in env.scene.world.expanded_fields().items():
        assert torch.equal(value, changed[field]), field  # the same draw again: nothing adds up


@pytest.mark.parametrize(
    ("func", "params", "words"),
    [
        (mdp.randomize_rigid_body_mass, {"mass_distribution_params": (3.0, 1.0), "operation": "add"}, "low <= high"),
        (mdp.randomize_rigid_body_mass, {"mass_distribution_params": (0.0, 1.0), "operation": "scale"}, "positive"),
        (mdp.randomize_rigid_body_mass, {"mass_distribution_params": (1.0, 2.0), "operation": "plus"}, "operation"),
        (mdp.randomize_rigid_body_com, {"com_range": {"roll": (0.0, 1.0)}}, "axis"),
        (mdp.randomize_actuator_gains, {"stiffness_distribution_params": (1.0, 2.0)}, "position servo"),
    ],
)
def test_wrong_laws_are_refused(func: Any, params: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError, match=words):
        fire(make_env(ARM, 2), func, asset_cfg=SceneEntityCfg("robot"), **params)


def test_a_body_compiled_as_simple_is_refused() -> None:
    with pytest.raises(InputError, match="simple='false'"):
        fire(make_env(ARM, 2), mdp.randomize_rigid_body_com, asset_cfg=only(body_names="cart"), com_range={})


def test_restitution_is_refused_because_mujoco_has_none() -> None:
    with pytest.raises(InputError, match="no restitution"):
        fire(
            make_env(BLOCK, 2),
            mdp.randomize_rigid_body_material,
            asset_cfg=SceneEntityCfg("robot"),
            static_friction_range=(0.5, 1.0),
            dynamic_friction_range=(0.5, 1.0),
            restitution_range=(0.0, 0.5),
            num_buckets=8,
        )

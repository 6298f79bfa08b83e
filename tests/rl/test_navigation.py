"""Navigation: its rooms against the lab's geometry, its base against the lab's robot, its terms by definition."""

from __future__ import annotations

import itertools
import json
import math
from typing import Any

import mujoco
import numpy as np
import pytest
import torch

from robotbrain.errors import InputError
from robotbrain.rl import registry
from robotbrain.rl.envs import ManagerBasedRLEnv
from robotbrain.rl.evaluate import run_episodes
from robotbrain.rl.export import OnnxPolicy
from robotbrain.rl.robots import base_mjcf
from robotbrain.rl.tasks import layouts, navigation, navigation_spec
from robotbrain.rl.tasks import navigation_mdp as nav
from robotbrain.rl.tasks.layouts import LayoutSpec, draw_layouts
from robotbrain.rl.tasks.navigation import OBS_MIRROR, OBS_SIGN, NavigationEnvCfg, mirror_left_right
from robotbrain.sim import IDEAL_SENSORS, Obstacle, Pose2D, RobotParams, RobotSim, World, WorldSpec, generate_world
from robotbrain.sim.geometry import distance_to_rectangle
from robotbrain.sim.geometry import rectangle_gap as lab_gap
from robotbrain.sim.lidar import LidarSpec, RayLidar
from robotbrain.sim.scene import build_scene
from robotbrain.sim.world import Point2D

torch.set_num_threads(1)


def room(count: int, seed: int = 0, **spec: Any) -> torch.Tensor:
    return draw_layouts(count, LayoutSpec(**spec), torch.Generator().manual_seed(seed))


def make(num_envs: int, *, quiet: bool = True, seed: int = 0) -> ManagerBasedRLEnv:
    """The task with few rooms; quiet: without noise, latency and differing motors."""
    cfg = NavigationEnvCfg()
    cfg.scene.num_envs, cfg.seed = num_envs, seed
    cfg.events.layout.params = {**cfg.events.layout.params, "layouts": 32}
    if quiet:
        cfg.observations.policy.enable_corruption = False
        lidar = cfg.observations.policy.lidar_log_range
        lidar.params = {**lidar.params, "noise": (0.0, 0.0)}
        cfg.events.latency = cfg.events.motor_lag = None
    env = ManagerBasedRLEnv(cfg, num_threads=1)
    env.reset(seed=seed)
    return env


def place(env: ManagerBasedRLEnv, index: int, x: float, y: float, yaw: float) -> None:
    pose = torch.tensor([[x, y, 0.0, 0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)]])
    env.scene["robot"].write_root_pose_to_sim_index(root_pose=pose, env_ids=torch.tensor([index]))


class TestLayouts:
    def test_distances_agree_with_the_labs(self) -> None:
        rectangles, points = room(1)[0], 8.0 * torch.rand(50, 2) - 4.0
        got = layouts.rectangle_distance(points[:, None], rectangles[None])
        for k, rectangle in enumerate(rectangles.tolist()):
            assert got[:, k].numpy() == pytest.approx(distance_to_rectangle(points.numpy(), *rectangle), abs=1e-4)

    def test_gaps_agree_with_the_labs_also_where_boxes_cross(self) -> None:
        rng = np.random.default_rng(0)
        boxes = rng.uniform((-1, -1, -3, 0.05, 0.05), (1, 1, 3, 1.0, 0.6), (40, 5)).astype(np.float32)
        got = layouts.rectangle_gap(torch.from_numpy(boxes[:20]), torch.from_numpy(boxes[20:]))
        wanted = [lab_gap(tuple(a), tuple(b)) for a, b in zip(boxes[:20].tolist(), boxes[20:].tolist(), strict=True)]
        assert got.numpy() == pytest.approx(np.array(wanted), abs=1e-5)
        assert 0 < sum(w == 0.0 for w in wanted) < 20

    def test_every_gap_lets_the_robot_through_and_everything_is_in_the_room(self) -> None:
        for layout in room(40):
            used = layout[layout[:, 0] < layouts.PARKED]
            assert 1 <= len(used) <= 12
            assert float(layouts.corners(used).abs().max()) < 4.0 + 1e-4
            for a, b in itertools.combinations(used.tolist(), 2):
                assert lab_gap(tuple(a), tuple(b)) >= 0.7 - 1e-4

    def test_the_seed_decides_and_others_give_other_rooms(self) -> None:
        assert torch.equal(room(5, 1), room(5, 1))
        assert not torch.equal(room(5, 1), room(5, 2))

    def test_a_gap_narrower_than_the_robot_is_refused(self) -> None:
        with pytest.raises(InputError, match="wide"):
            LayoutSpec(gap=(0.3, 0.5))


class TestBase:
    @pytest.mark.parametrize("lag", [0.04, 0.1])
    def test_it_moves_as_the_labs_robot_does(self, lag: float) -> None:
        # The firmware limits acceleration before the motor's lag, the model after it: a change of command is carried
        # out sooner by less than the lag, so the poses differ by less than the lag times the largest change.
        params = RobotParams(motor_lag_s=lag)
        model = mujoco.MjModel.from_xml_string(base_mjcf(params=params))
        data = mujoco.MjData(model)
        empty = World(WorldSpec(0, 0.0), 90.0, 90.0, (), Pose2D(0, 0, 0), Point2D(9, 9), generate_world(0, 0.0).look)
        lab, rng = RobotSim(empty, params, IDEAL_SENSORS), np.random.default_rng(3)
        for tick in range(60):
            if tick % 8 == 0:
                v, w = rng.uniform(-0.2, 0.5), rng.uniform(-1.2, 1.2)
            data.ctrl[:2] = v, w
            lab.set_twist(v, w)
            mujoco.mj_step(model, data, 2)
            lab.advance_to(100_000_000 * (tick + 1))
            pose, yaw = lab.truth.pose, 2.0 * math.atan2(data.qpos[6], data.qpos[3])
            assert math.hypot(data.qpos[0] - pose.x, data.qpos[1] - pose.y) < 0.02 + 0.7 * lag
            assert abs(math.remainder(yaw - pose.yaw, math.tau)) < 0.02 + 2.4 * lag
        assert lab.truth.path_length > 0.9
        assert np.abs(data.qpos[[2, 4, 5]]).max() < 1e-9  # it stays on the floor, upright

    def test_it_never_accelerates_faster_than_the_firmware_allows(self) -> None:
        model = mujoco.MjModel.from_xml_string(base_mjcf())
        data, before = mujoco.MjData(model), np.zeros(6)
        for v, w in ((0.5, 1.2), (-0.2, -1.2), (9.0, 9.0)):
            data.ctrl[:2] = v, w
            for _ in range(30):
                mujoco.mj_step(model, data)
                change = np.abs(data.qvel - before) / model.opt.timestep
                assert math.hypot(*change[:2]) < 1.0 + 0.5 * 1.8 + 1e-6  # along the path, and across it in a curve
                assert change[5] < 4.0 + 1e-6
                before = data.qvel.copy()
        assert math.hypot(*data.qvel[:2]) == pytest.approx(0.6, abs=0.02)  # the command was clamped


class TestEnvironment:
    def test_its_lidar_sees_what_the_labs_lidar_sees(self) -> None:
        env = make(1, seed=3)
        rectangles = nav.obstacle_rectangles(env)[0]
        rectangles = rectangles[rectangles[:, 0] < layouts.PARKED].double().tolist()
        assert rectangles
        x, y = env.scene["robot"].data.root_pos_w.torch[0, :2].tolist()
        pose = Pose2D(x, y, float(env.scene["robot"].data.heading_w.torch[0]))
        blocks = tuple(
            Obstacle(f"shelf_{i}", "shelf", *values, 0.4, False, (0.5, 0.5, 0.5, 1.0))
            for i, values in enumerate(rectangles)
        )
        world = World(WorldSpec(0), 4.0, 4.0, blocks, pose, Point2D(3, 3), generate_world(0, 0.0).look)
        scene = build_scene(world)
        data = mujoco.MjData(scene.model)
        ranges = RayLidar(scene, LidarSpec(rays=144, range_max=8.0)).scan(data.qpos)
        # 144 rays hold those of the task: every second one, from the second on.
        got = env.scene.sensors["lidar"].data.ranges.torch[0].numpy()
        assert np.where(np.isfinite(ranges), ranges, 8.0)[1::2] == pytest.approx(got, abs=2e-3)

    def test_the_robots_observation_is_the_tasks(self) -> None:
        """The controller node computes from points what the terms compute from the simulation."""
        env = make(4)
        for _ in range(5):
            actions = torch.rand(4, 2, generator=env.generator) * 2 - 1
            seen = env.step(actions)[0]["policy"]
        robot = env.scene["robot"].data
        angles = np.asarray(env.cfg.scene.lidar.angles)
        for i in range(4):
            if env.episode_length_buf[i] == 0:
                continue
            c, s = math.cos(robot.heading_w.torch[i]), math.sin(robot.heading_w.torch[i])
            line = env.command_manager.get_term("goal").pos_command_w[i, :2] - robot.root_pos_w.torch[i, :2]
            dx, dy = line.tolist()
            ranges = env.scene.sensors["lidar"].data.ranges.torch[i].double().numpy()
            points = ranges[:, None] * np.stack([np.cos(angles), np.sin(angles)], 1)
            row = navigation_spec.observation(
                (robot.root_lin_vel_b.torch[i, 0], robot.root_ang_vel_b.torch[i, 2]),
                (c * dx + s * dy, c * dy - s * dx),
                navigation_spec.sector_ranges(points, half_width=0.0),
                actions[i].numpy(),
            )
            assert row[0] == pytest.approx(seen[i].numpy(), abs=2e-5)

    def test_the_mirror_image_of_a_room_looks_like_the_mirrored_observation(self) -> None:
        env = make(2)
        world, flip = env.scene.world, np.array([1.0, -1.0])
        world.batch.mocap_pos[1, :, :2] = world.batch.mocap_pos[0, :, :2] * flip
        world.batch.mocap_quat[1] = world.batch.mocap_quat[0] * np.array([1.0, 1.0, 1.0, -1.0])
        world.expand("geom_size")[1] = world.expand("geom_size")[0]
        world.expand("geom_rbound")[1] = world.expand("geom_rbound")[0]
        x, y = env.scene["robot"].data.root_pos_w.torch[0, :2].tolist()
        place(env, 0, x, y, 0.3)
        place(env, 1, x, -y, -0.3)
        goal = env.command_manager.get_term("goal").pos_command_w
        goal[1] = goal[0] * torch.tensor([1.0, -1.0, 1.0])
        actions = torch.tensor([[0.4, 0.6]])
        obs, pair = mirror_left_right(obs={"policy": torch.zeros(1, 43)}, actions=actions)
        assert obs["policy"].shape == (2, 43)
        seen = env.step(pair)[0]["policy"]
        assert not (env.episode_length_buf == 0).any()
        assert seen[1].numpy() == pytest.approx((seen[0, OBS_MIRROR] * OBS_SIGN).numpy(), abs=1e-4)

    def test_progress_adds_up_to_how_much_nearer_the_robot_came(self) -> None:
        env = make(1, seed=4)
        place(env, 0, 0.0, 0.0, 0.2)
        env.scene.world.batch.mocap_pos[:, :, 1] = 50.0
        env.command_manager.get_term("goal").pos_command_w[0, :2] = torch.tensor([3.0, 1.0])
        before, total = float(nav.goal_distance(env, "goal")), 0.0
        for _ in range(30):
            env.step(torch.tensor([[1.0, 0.1]]))
            total += float(nav.progress_to_goal(env, "goal")) * env.step_dt
        assert before - float(nav.goal_distance(env, "goal")) == pytest.approx(total, abs=0.05)
        assert total > 1.0

    def test_an_episode_ends_at_the_goal_and_at_the_first_touch(self) -> None:
        env = make(3)
        env.scene.world.batch.mocap_pos[:, :, 1] = 50.0
        goal = env.command_manager.get_term("goal").pos_command_w
        goal[:, :2] = torch.tensor([1.0, 0.0])
        place(env, 0, 0.93, 0.0, 0.0)  # 7 cm from the goal
        place(env, 1, 4.0 - 0.17, 1.0, 0.0)  # 17 cm from the wall: the robot's radius is 18 cm
        place(env, 2, 4.0 - 0.19, 1.0, 0.0)
        stand_still = torch.tensor([[-0.15 / 0.35, 0.0]]).repeat(3, 1)
        _, reward, terminated, _, _ = env.step(stand_still)
        assert terminated.tolist() == [True, True, False]
        assert env.termination_manager.get_term("goal_reached").tolist() == [True, False, False]
        assert env.termination_manager.get_term("collision").tolist() == [False, True, False]
        assert reward[0] > 4.0 and reward[1] < -10.0 and -1.0 < reward[2] < 0.0

    def test_starts_and_goals_are_clear_and_rooms_differ(self) -> None:
        env = make(24)
        assert float(nav.obstacle_clearance(env).min()) > 0.25 - 1e-4
        goal = env.command_manager.get_term("goal").pos_command_w[:, None, :2]
        assert float(layouts.clearance(goal, nav.obstacle_rectangles(env), 4.0).min()) > 0.2
        assert len({tuple(r.flatten().tolist()) for r in nav.obstacle_rectangles(env)}) > 12
        distance = nav.goal_distance(env, "goal")
        assert float(distance.min()) > 0.5 - 1e-4 and float(distance.max()) < 3.0 + 1e-4

    def test_a_reset_draws_another_room_for_that_environment_only(self) -> None:
        env = make(3)
        before = nav.obstacle_rectangles(env)
        env.reset(env_ids=[1])
        after = nav.obstacle_rectangles(env)
        assert [bool(torch.equal(a, b)) for a, b in zip(before, after, strict=True)] == [True, False, True]

    def test_evaluation_has_rooms_of_its_own(self) -> None:
        cfg = NavigationEnvCfg()
        train = cfg.events.layout.params["seed"]
        cfg.play_mode()
        assert cfg.events.layout.params["seed"] != train
        assert NavigationEnvCfg().events.layout.params["seed"] == train

    def test_a_late_command_takes_effect_late(self) -> None:
        speeds = []
        for steps in (0, 2):
            env = make(1)
            env.scene.world.batch.mocap_pos[:, :, 1] = 50.0
            place(env, 0, 0.0, 0.0, 0.0)
            env.action_manager.get_term("body_velocity").delay.set(slice(None), torch.tensor([steps]), 2)
            stop, go = torch.tensor([[-0.15 / 0.35, 0.0]]), torch.tensor([[1.0, 0.0]])
            env.step(stop)
            env.step(go)
            speeds.append(float(nav.body_velocity(env)[0, 0]))
        assert speeds[0] > 0.03 and abs(speeds[1]) < 1e-6

    def test_a_run_is_resumed_exactly_with_its_rooms(self) -> None:
        env, other = make(3, quiet=False), make(3, quiet=False, seed=9)
        act = torch.rand(3, 2) * 2 - 1
        for _ in range(3):
            env.step(act)
        other.load_state_dict(env.state_dict())
        for _ in range(25):
            (a, *_), (b, *_) = env.step(act), other.step(act)
            assert torch.equal(a["policy"], b["policy"])

    def test_a_store_for_another_number_of_obstacles_is_refused(self) -> None:
        cfg = registry.task_cfg("navigation")
        cfg.scene.num_envs = 1
        cfg.events.layout.params = {"spec": LayoutSpec(obstacles=5), "layouts": 4, "seed": 0}
        with pytest.raises(InputError, match="obstacles"):
            ManagerBasedRLEnv(cfg, num_threads=1)


class TestSectors:
    def test_each_sector_holds_its_nearest_point(self) -> None:
        rng = np.random.default_rng(0)
        bearing, distance = rng.uniform(-math.pi, math.pi, 400), rng.uniform(0.2, 5.0, 400)
        got = navigation_spec.sector_ranges(
            np.stack([distance * np.cos(bearing), distance * np.sin(bearing)], 1), half_width=0.0
        )
        for i in range(36):
            inside = (bearing >= -math.pi + i * math.pi / 18) & (bearing < -math.pi + (i + 1) * math.pi / 18)
            assert got[i] == pytest.approx(min(distance[inside].min(initial=3.0), 3.0))

    def test_a_point_straight_behind_is_seen_on_both_sides_and_nothing_means_far(self) -> None:
        got = navigation_spec.sector_ranges([[-1.0, 0.0]])
        assert got[0] == got[-1] == 1.0 and (got[1:-1] == 3.0).all()
        assert (navigation_spec.sector_ranges(np.zeros((0, 2))) == 3.0).all()


class TestShippedPolicy:
    def test_its_recipe_is_of_this_task_and_the_file_says_so(self) -> None:
        recipe = json.loads(navigation.SHIPPED_RECIPE.read_text(encoding="utf-8"))
        meta = OnnxPolicy(navigation_spec.default_policy()).meta
        navigation_spec.check_meta(meta)
        assert recipe["config_hash"] == meta.provenance["config_hash"] == navigation.config_hash()
        assert (
            recipe["command"]
            == meta.provenance["command"]
            == (f"robotbrain rl train navigation --seed 0 --iterations {recipe['iterations']}")
        )
        curve = json.loads(navigation.SHIPPED_CURVE.read_text(encoding="utf-8"))
        assert curve["env_steps"][-1] == recipe["env_steps"] and curve["goal_reached"][-1] > curve["goal_reached"][0]

    def test_it_reaches_goals_in_rooms_that_it_never_saw(self) -> None:
        cfg = NavigationEnvCfg()
        cfg.play_mode()
        cfg.scene.num_envs = 32
        cfg.events.layout.params = {**cfg.events.layout.params, "layouts": 64}
        table = run_episodes(
            ManagerBasedRLEnv(cfg, num_threads=1),
            OnnxPolicy(navigation_spec.default_policy()),
            64,
            measure=lambda env, step: {"reached": env.termination_manager.get_term("goal_reached").float()},
            tail=1,
        )
        # The benchmark says 0.88; 64 episodes of such a policy fall below 0.75 less than once in two hundred times.
        assert np.mean(table.tail["reached"]) > 0.75

"""Nodes count the work that they do, profiles turn it into time, and a watch follows stamps from sensor to command."""

from __future__ import annotations

import dataclasses
import itertools
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from robotbrain.errors import InputError
from robotbrain.jetson import profiles
from robotbrain.jetson.profiles import JetsonProfile, load_profile
from robotbrain.jetson.work import load_work
from robotbrain.pipeline import control
from robotbrain.pipeline.brain import drive
from robotbrain.pipeline.control import PathTracker
from robotbrain.pipeline.costs import CALLBACKS, KINDS, SCALES_WITH, ProfileCosts
from robotbrain.pipeline.deployment import Deployment
from robotbrain.pipeline.estimation import ScanMatcher
from robotbrain.pipeline.exploration import ViewMemory
from robotbrain.pipeline.grid import GridFrame
from robotbrain.pipeline.mapping import OccupancyMapper
from robotbrain.pipeline.nodes.planner import PlannerNode
from robotbrain.pipeline.planning import astar_search, inflate, plan_path
from robotbrain.pipeline.watch import Watch
from robotbrain.ros import DeviceResources, SimContext, charge
from robotbrain.sim import generate_world

MS = 1_000_000


@pytest.fixture(autouse=True)
def network_takes_5_ms(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(profiles, "_network_ms", lambda *_: (5.0, "assumed", "kit:a test"))


@pytest.fixture(scope="module")
def charged() -> Iterator[dict[str, list[float]]]:
    """Units of every charge of a short drive, by kind."""
    seen: dict[str, list[float]] = defaultdict(list)
    original = SimContext.charge_work

    def spy(self: SimContext, kind: str, units: float) -> bool:
        seen[kind].append(units)
        return original(self, kind, units)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(profiles, "_network_ms", lambda *_: (5.0, "assumed", "kit:a test"))
        patch.setattr(SimContext, "charge_work", spy)
        drive(5, time_limit=6.0)
    yield seen


# ------------------------------------------------------------ the table and the nodes agree


def test_the_table_holds_every_kind_and_every_callback() -> None:
    table = load_work()
    assert set(table.kinds) == set(KINDS)
    assert {(k.unit, k.what) for k in table.kinds.values()} == set(KINDS.values())
    assert {name: (c.role, c.kind, c.topic) for name, c in table.callbacks.items()} == dict(CALLBACKS)
    assert all(kind.fixed_ns + kind.unit_ns > 0 for kind in table.kinds.values())


def test_the_nodes_charge_every_kind_and_no_other(charged: dict[str, list[float]]) -> None:
    middleware = {"message_in", "message_out"}
    assert set(charged) == set(KINDS) - middleware
    assert all(np.isfinite(units).all() and min(units) >= 0 < max(units) for units in charged.values())


def test_the_camera_is_paid_by_the_pixel(charged: dict[str, list[float]]) -> None:
    for kind in ("preprocess", "decode", "back_project", "label_points"):
        assert set(charged[kind]) == {64 * 64}
    assert set(charged["near_points"]) == {120}


# ------------------------------------------------------------ units are counted right


def test_icp_counts_the_neighbours_it_looks_up(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    angles = np.linspace(-np.pi, np.pi, 120, endpoint=False)
    room = np.stack([np.clip(3 * np.cos(angles), -2, 2), np.clip(3 * np.sin(angles), -2, 2)], axis=1)
    matcher = ScanMatcher()
    assert matcher.match(room, (0.0, 0.0, 0.0)) is None and matcher.queries == 0
    assert matcher.keep(room, (0.0, 0.0, 0.0)) and 0 < matcher.point_count <= 120
    tree, asked = matcher._tree, []

    class Spy:
        def query(self, points: Any, **options: Any) -> Any:
            asked.append(len(points))
            assert tree is not None
            return tree.query(points, **options)

    monkeypatch.setattr(matcher, "_tree", Spy())
    for _ in range(3):
        asked.clear()
        matcher.match(room + rng.normal(0, 0.01, room.shape), (0.05, -0.03, 0.02))
        assert matcher.queries == sum(asked) > 120  # more than one iteration


def test_a_plan_counts_its_cells() -> None:
    occupancy = np.zeros((60, 80), dtype=np.int8)
    occupancy[[0, -1], :] = occupancy[:, [0, -1]] = 100
    occupancy[20:, 40] = 100
    frame = GridFrame(0.05, (0.0, 0.0), (60, 80))
    result = plan_path(occupancy, frame, (0.5, 1.5), (3.5, 1.5))
    found = astar_search(inflate(occupancy, 0.05), frame.to_cell(0.5, 1.5), frame.to_cell(3.5, 1.5))
    assert found.path is not None
    assert (result.cells, result.expanded, result.path_cells) == (60 * 80, found.expanded, len(found.path))


def test_the_mapper_counts_its_points() -> None:
    mapper = OccupancyMapper(GridFrame.centred(8.0, 0.05))
    mapper.add_points((0.0, 0.0, 0.3), np.array([[1.0, 0.0], [2.0, 0.1], [9.0, 0.0]]), np.array([[1.5, 0.0]]))
    assert mapper.written == 3  # the one beyond the camera's range is left out
    mapper.add_scan((0.0, 0.0, 0.0), np.array([2.0]), np.array([0.0]))
    beam = np.arange(0.0, 6.0, 0.7 * 0.05)
    assert mapper.written == int((beam < 2.0 - 0.05).sum()) + 1


def test_looking_counts_the_cells_along_the_rays() -> None:
    views = ViewMemory(GridFrame.centred(8.0, 0.05))
    occupancy = np.full((320, 320), -1, dtype=np.int8)
    occupancy[150:170, 150:200] = 0
    views.look((0.0, 0.0, 0.0), occupancy)
    p = views.params
    rays = int(np.ceil(2 * p.half_angle * p.reach / 0.05)) + 1
    assert views.looked == rays * len(np.arange(0.0, p.reach, 0.035))
    views.next_target((0.0, 0.0, 0.0), occupancy)
    assert views.searched == 20 * 50


def test_the_controller_counts_the_distances_of_its_arcs(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[int] = []
    original = control.arc_clearance

    def spy(speed: float, turn: float, points: Any, horizon: float, steps: int = 12) -> float:
        calls.append(len(points) * steps)
        return original(speed, turn, points, horizon, steps)

    monkeypatch.setattr(control, "arc_clearance", spy)
    tracker, path = PathTracker(), np.array([[0.0, 0.0], [2.0, 0.0]])
    wall = np.stack([np.full(30, 0.45), np.linspace(-0.5, 0.5, 30)], axis=1)
    for obstacles in (wall, wall + np.array([0.5, 0.0]), np.zeros((0, 2))):
        calls.clear()
        tracker.command(0.0, (0.0, 0.0, 0.0), path, None, obstacles)
        assert (tracker.arcs, tracker.distances) == (len(calls), sum(calls))
    tracker.command(0.0, (0.0, 0.0, 0.0), np.zeros((0, 2)), None, wall)
    assert (tracker.arcs, tracker.distances) == (0, 0)


# ------------------------------------------------------------ from units to time


def test_work_costs_its_units_times_the_module() -> None:
    profile = load_profile("nano-4gb:5W")
    costs, kind = ProfileCosts(profile), load_work().kind("astar")
    for units in (0, 1, 12_345):
        expected = (kind.fixed_ns + kind.unit_ns * units) * profile.cpu_factor
        assert costs.work_ns("astar", units) == pytest.approx(expected, abs=1)
    with pytest.raises(InputError, match="astar"):
        costs.work_ns("a_star", 1)


def test_only_nodes_of_the_brain_pay_and_strangers_to_the_kit_pay_the_typical_price() -> None:
    profile = load_profile("nano-4gb")
    costs = ProfileCosts(profile)
    costs.assign("/ours", "planner")
    costs.assign("/theirs", "planner", foreign=True)
    costs.assign("/c", "controller", foreign=True)
    assert costs.uncharged_ns("/ours", "service", "/plan") == 0
    assert costs.uncharged_ns("/robot", "service", "/plan") == 0
    planning = costs.uncharged_ns("/theirs", "service", "/plan")
    messages = profile.callback_ns("planner") - planning
    assert planning > 0 and 0 < messages < planning
    assert costs.uncharged_ns("/theirs", "subscription", "/map") == 0
    assert costs.uncharged_ns("/c", "timer", "whatever") > 0  # a role's timer, whatever it is called
    assert costs.traffic_ns("/robot", 1000, [1000]) == 0
    one = costs.traffic_ns("/ours", 1000, []), costs.traffic_ns("/ours", None, [500])
    assert costs.traffic_ns("/ours", 1000, [500, 500]) == one[0] + 2 * one[1]


def test_a_plan_takes_time_by_the_cell() -> None:
    profile = load_profile("xavier-nx")
    unit = load_work().kind("astar").unit_ns * profile.cpu_factor
    assert profile.planning_ns(9000) - profile.planning_ns(1000) == pytest.approx(8000 * unit, abs=2)
    assert profile.planning_ns(0) > 0


def test_a_students_planner_that_charges_nothing_is_not_free() -> None:
    class Mine(PlannerNode):
        def _plan(self, request: Any, response: Any) -> Any:
            return response

    free = drive(5, time_limit=6.0, parts={"planner": Mine})
    profile = load_profile("orin-nano-8gb")
    # alone on its core, or shared: never less than the typical plan, and that is what most take
    typical = profile.callback_ms["planner"]
    assert len(free.planning_ms) and free.planning_ms.min() > 0.9 * typical
    assert np.median(free.planning_ms) == pytest.approx(typical, rel=0.1)


# ------------------------------------------------------------ a run on a device


def slow(profile: JetsonProfile, factor: float) -> JetsonProfile:
    return dataclasses.replace(profile, cpu_factor=factor * profile.cpu_factor)


def test_slower_devices_answer_later_and_are_busier() -> None:
    base = load_profile("agx-orin-64gb")
    runs = [drive(5, time_limit=3.0, profile=slow(base, factor)) for factor in (1, 3, 9)]
    assert np.all(np.diff([np.median(run.perception_ms) for run in runs]) > 0)
    assert np.all(np.diff([np.percentile(run.e2e_ms, 99) for run in runs]) > 0)
    assert np.all(np.diff([run.busy["cpu"] for run in runs]) > 0)
    assert all(0 < share < 1 for run in runs for share in (run.busy["cpu"], run.busy["gpu"]))
    assert runs[0].control_hz == pytest.approx(20.0, abs=0.2)
    assert {run.power_mode for run in runs} == {base.power_mode}


def test_the_gpu_is_busy_for_as_long_as_the_network_takes() -> None:
    run = drive(5, time_limit=3.0)
    # one image each 100 ms, 5 ms of GPU each
    assert run.busy["gpu"] == pytest.approx(0.05, abs=0.003)
    assert np.median(run.perception_ms) > 5.0


def test_an_overloaded_device_misses_deadlines_and_loses_images() -> None:
    profile = slow(load_profile("nano-4gb:5W"), 40)
    run = drive(5, time_limit=3.0, profile=profile)
    assert run.busy["cpu"] > 0.95
    assert run.deadline_misses["perception"] > 10 and run.deadline_misses["estimator_scan"] > 5
    assert drive(5, time_limit=3.0, profile="agx-orin-64gb").deadline_misses["perception"] == 0


def test_one_seed_and_profile_give_one_log_and_modes_differ() -> None:
    runs = [drive(5, time_limit=3.0, profile="nano-4gb", mode=mode) for mode in ("5W", "5W", None)]
    assert runs[0].log_sha256 == runs[1].log_sha256 != runs[2].log_sha256
    assert (runs[0].power_mode, runs[2].power_mode) == ("5W", "MAXN")
    with pytest.raises(InputError, match="mode"):
        drive(5, time_limit=1.0, profile=load_profile("nano-4gb"), mode="5W")


# ------------------------------------------------------------ deployments


def test_a_deployment_charges_for_its_sensors_and_nothing_else() -> None:
    profile = load_profile("nano-4gb")
    scales = Deployment(image_size=(640, 480), scan_rays=360).scales(64 * 64, 120)
    assert scales == {"image": 75.0, "scan": 3.0}
    assert Deployment().scales(64 * 64, 120) == {"image": 1.0, "scan": 1.0}
    plain, large = ProfileCosts(profile), ProfileCosts(profile, scales)
    for kind in KINDS:
        factor = scales.get(SCALES_WITH.get(kind, ""), 1.0)
        call, unit = profile.work_cost(kind)
        assert large.work_ns(kind, 1000) == pytest.approx(call + 1000 * factor * unit, abs=1)
    assert large.uncharged_ns("/n", "timer", "x") == 0
    for costs in (plain, large):
        costs.assign("/n", "perception", foreign=True)
    image = ("/n", "subscription", "/camera/image")
    assert 10 < large.uncharged_ns(*image) / plain.uncharged_ns(*image) < 75


def test_a_vga_camera_makes_perception_slower_but_sees_the_same() -> None:
    small, large = drive(5, time_limit=0.45), drive(5, time_limit=0.45, deployment=Deployment(image_size=(640, 480)))
    assert len(small.perception_ms) >= len(large.perception_ms) >= 3
    profile = load_profile("orin-nano-8gb")
    pixels = sum(profile.work_cost(k)[1] for k in ("preprocess", "decode", "back_project", "label_points"))
    extra = 74 * 64 * 64 * pixels * 1e-6
    assert large.perception_ms.min() - small.perception_ms.min() == pytest.approx(extra, rel=0.05)


def test_another_network_can_be_charged_for(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    other = tmp_path / "other.onnx"
    other.write_bytes(b"")
    monkeypatch.setattr(
        profiles, "_network_ms", lambda model, *_: (40.0 if model == other else 5.0, "assumed", "kit:a")
    )
    runs = [drive(5, time_limit=1.0, deployment=Deployment(network=network)) for network in (None, other)]
    assert [run.busy["gpu"] for run in runs] == pytest.approx([0.05, 0.4], rel=0.15)
    with pytest.raises(InputError, match="network"):
        Deployment(network=tmp_path / "nowhere.onnx")


def test_one_thread_runs_one_callback_at_a_time() -> None:
    ends: list[tuple[int, int]] = []

    def run(one_thread: bool) -> float:
        ends.clear()
        original = Watch._on_callback

        def spy(self: Watch, record: Any) -> None:
            if self._costs.role(record.node) and record.end_ns > record.start_ns:
                ends.append((record.start_ns, record.end_ns))
            original(self, record)

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(Watch, "_on_callback", spy)
            deployed = Deployment(image_size=(640, 480), one_thread=one_thread)
            result = drive(5, time_limit=2.0, profile="nano-4gb:5W", deployment=deployed)
        return float(np.percentile(result.e2e_ms, 99))

    apart = run(False)
    overlapping = sum(b[0] < a[1] for a, b in itertools.pairwise(sorted(ends)))
    together = run(True)
    assert overlapping > 10 and not any(b[0] < a[1] for a, b in itertools.pairwise(sorted(ends)))
    assert together > apart


@pytest.mark.parametrize("bad", [{"image_size": (640, 0)}, {"image_size": 640}, {"scan_rays": 0}, {"scan_rays": 1.5}])
def test_impossible_deployments_are_refused(bad: dict[str, Any]) -> None:
    with pytest.raises(InputError, match="whole number"):
        Deployment(**bad)


# ------------------------------------------------------------ the watch, in closed form


def test_ages_are_followed_from_the_stamp_to_the_command() -> None:
    """Scan and image every 100 ms; estimator 7 ms, perception 30 ms; odometry every 20 ms; controller 3 ms at 20 Hz."""
    from geometry_msgs.msg import Twist
    from nav_msgs.msg import Odometry
    from sensor_msgs.msg import JointState, LaserScan, PointCloud2

    from robotbrain.ros.conversions import ns_to_time
    from robotbrain.ros.node import Node

    context = SimContext(resources=DeviceResources(cpu_cores=8))
    costs = ProfileCosts(load_profile("nano-4gb"))
    watch = Watch(context, costs)
    body, estimator, perception, controller = (
        Node(name, context=context) for name in ("body", "estimator", "perception", "controller")
    )
    for node in (estimator, perception, controller):
        costs.assign(node.get_fully_qualified_name(), node.get_name())

    def stamped(cls: Any, stamp: int) -> Any:
        message = cls()
        message.header.stamp = ns_to_time(stamp)
        return message

    scans = body.create_publisher(LaserScan, "scan", 10)
    wheels = body.create_publisher(JointState, "joint_states", 10)
    body.create_timer(0.1, lambda: scans.publish(stamped(LaserScan, context.now_ns)))
    body.create_timer(0.02, lambda: wheels.publish(stamped(JointState, context.now_ns)))

    odometry = estimator.create_publisher(Odometry, "odometry/filtered", 10)
    estimator.create_subscription(LaserScan, "scan", lambda m: charge(7 * MS), 10)
    estimator.create_subscription(
        JointState, "joint_states", lambda m: odometry.publish(stamped(Odometry, context.now_ns)), 10
    )
    points = perception.create_publisher(PointCloud2, "perception/points", 10)

    def see() -> None:
        charge(30 * MS)
        points.publish(stamped(PointCloud2, context.now_ns))

    perception.create_timer(0.1, see)
    commands = controller.create_publisher(Twist, "cmd_vel", 10)
    controller.create_subscription(Odometry, "odometry/filtered", lambda m: None, 10)
    controller.create_subscription(PointCloud2, "perception/points", lambda m: None, 10)

    def steer() -> None:
        charge(3 * MS)
        commands.publish(Twist())

    controller.create_timer(0.05, steer)
    context.run_until(2_000 * MS)
    # The controller looks at 0, 50, 100 ... ms and speaks 3 ms later. At 50 it has the points of the image at 0 (there
    # since 30); at 100 still those. The scan taken at 0 is in the pose from 7 on, in the odometry of 20, so at 50 and,
    # since the odometry of 100 waits for the scan of 100, at 100 too.
    assert set(np.round(watch.camera_age_ms, 6)) == {53.0, 103.0}
    assert set(np.round(watch.scan_age_ms, 6)) == {53.0, 103.0}
    assert watch.control_hz == pytest.approx(20.0)
    assert watch.deadline_misses == {"controller": 0, "perception": 0, "estimator_scan": 0, "estimator_wheels": 0}


def test_a_command_before_any_input_has_no_age() -> None:
    run = drive(generate_world(5), time_limit=0.05)
    assert len(run.e2e_ms) == len(run.camera_age_ms) == len(run.scan_age_ms) == 0

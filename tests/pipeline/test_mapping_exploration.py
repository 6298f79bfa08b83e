"""Mapping and looking around in rooms small enough to check by eye."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import binary_dilation

from robotbrain.errors import InputError
from robotbrain.pipeline.exploration import MarkerTracker, ViewMemory
from robotbrain.pipeline.grid import GridFrame
from robotbrain.pipeline.mapping import OccupancyMapper

FRAME = GridFrame.centred(4.0, 0.05)
ANGLES = -np.pi + 2 * np.pi / 360 * np.arange(360)


def at(grid: np.ndarray, x: float, y: float) -> int:
    return int(grid[FRAME.to_cell(x, y)])


def square_room(half: float) -> np.ndarray:
    return half / np.maximum(np.abs(np.cos(ANGLES)), np.abs(np.sin(ANGLES)))


def test_a_square_room_is_mapped_free_inside_occupied_at_the_wall_unknown_beyond() -> None:
    mapper = OccupancyMapper(FRAME)
    for _ in range(5):
        mapper.add_scan((0.0, 0.0, 0.0), square_room(2.0), ANGLES)
    grid = mapper.occupancy()
    assert at(grid, 1.0, 0.5) < 20
    assert at(grid, 2.01, 0.3) > 80
    assert at(grid, 3.0, 0.0) == -1


def test_the_map_does_not_depend_on_the_robots_heading() -> None:
    grids = []
    for yaw in (0.0, 1.234):
        mapper = OccupancyMapper(FRAME)
        world = ANGLES + yaw
        ranges = 2.0 / np.maximum(np.abs(np.cos(world)), np.abs(np.sin(world)))
        mapper.add_scan((0.0, 0.0, yaw), ranges, ANGLES)
        grids.append(mapper.occupancy() >= 65)
    # The wall lies on a cell border, so a hit may fall to either side; beyond that the maps agree.
    for one, other in (grids, grids[::-1]):
        assert one.sum() > 200
        assert (one & ~binary_dilation(other, np.ones((3, 3)))).sum() == 0


def test_no_return_clears_but_marks_nothing_and_nan_is_ignored() -> None:
    mapper = OccupancyMapper(FRAME)
    mapper.add_scan((0, 0, 0), np.array([np.inf, np.inf, np.nan]), np.array([0.0, 0.02, np.pi / 2]))
    grid = mapper.occupancy()
    assert at(grid, 3.0, 0.01) < 50 and at(grid, 3.0, 0.01) >= 0
    assert (grid >= 65).sum() == 0
    assert at(grid, 0.01, 2.0) == -1


def test_a_beam_too_near_to_measure_clears_nothing() -> None:
    mapper = OccupancyMapper(FRAME)
    mapper.add_scan((0, 0, 0), np.full(360, -np.inf), ANGLES)
    assert (mapper.occupancy() == -1).all()


def test_a_lone_silent_beam_between_returns_is_a_lost_echo() -> None:
    mapper = OccupancyMapper(FRAME)
    ranges = square_room(2.0)
    ranges[180] = np.inf
    mapper.add_scan((0, 0, 0), ranges, ANGLES)
    assert at(mapper.occupancy(), 3.0, 0.01) == -1


def test_lidar_free_space_does_not_erase_a_low_box_seen_by_the_camera() -> None:
    mapper = OccupancyMapper(FRAME)
    box = np.array([[1.0, 0.0], [1.0, 0.05]])
    for _ in range(3):
        mapper.add_points((0, 0, 0), np.zeros((0, 2)), box)
    for _ in range(30):
        mapper.add_scan((0, 0, 0), square_room(2.0), ANGLES)
    assert at(mapper.occupancy(), 1.01, 0.01) >= 65
    # but the camera may forget what it sees gone
    for _ in range(30):
        mapper.add_points((0, 0, 0), box, np.zeros((0, 2)))
    assert at(mapper.occupancy(), 1.01, 0.01) < 50


def test_a_viewed_cell_is_not_behind_an_obstacle() -> None:
    occupancy = np.zeros(FRAME.shape, dtype=np.int8)
    wall = FRAME.to_cells([[1.0, y] for y in np.arange(-1, 1, 0.02)])
    occupancy[wall[:, 0], wall[:, 1]] = 100
    memory = ViewMemory(FRAME)
    memory.look((0.0, 0.0, 0.0), occupancy)
    assert memory.viewed[FRAME.to_cell(0.8, 0.0)]
    assert not memory.viewed[FRAME.to_cell(1.5, 0.0)]
    assert not memory.viewed[FRAME.to_cell(-0.8, 0.0)]


@pytest.mark.parametrize("yaw", np.linspace(-3, 3, 9))
def test_the_next_target_is_never_underfoot(yaw: float) -> None:
    memory = ViewMemory(FRAME)
    occupancy = np.zeros(FRAME.shape, dtype=np.int8)
    memory.look((0.3, -0.2, yaw), occupancy)
    target = memory.next_target((0.3, -0.2, yaw), occupancy)
    assert target is not None
    assert np.hypot(target[0] - 0.3, target[1] + 0.2) > 0.4


def test_exploration_visits_all_it_can_reach_and_nothing_else() -> None:
    occupancy = np.full(FRAME.shape, -1, dtype=np.int8)
    inside = FRAME.to_points(np.argwhere(np.ones(FRAME.shape)))
    room = (np.abs(inside) < 2.0).all(axis=1)
    occupancy[tuple(np.argwhere(np.ones(FRAME.shape))[room].T)] = 0
    wall = FRAME.to_cells([[1.0, y] for y in np.arange(-2, 2, 0.02)])
    occupancy[wall[:, 0], wall[:, 1]] = 100
    memory = ViewMemory(FRAME)
    pose = (0.0, 0.0, 0.0)
    for _ in range(60):
        memory.look(pose, occupancy)
        target = memory.next_target(pose, occupancy)
        if target is None:
            break
        assert target[0] < 0.75  # never beyond the wall
        yaw = float(np.arctan2(target[1] - pose[1], target[0] - pose[0]))
        # Face it first; go there if facing it was not enough.
        pose = (pose[0], pose[1], yaw) if pose[2] != yaw else (target[0], target[1], yaw)
    else:
        pytest.fail("exploration does not end")
    rows, columns = np.nonzero((occupancy == 0) & ~memory.viewed)
    points = FRAME.to_points(np.stack([rows, columns], axis=1))
    reachable = (points[:, 0] < 0.6) & (np.abs(points) < 1.6).all(axis=1)
    assert reachable.sum() < 0.03 * (occupancy == 0).sum()


def test_looking_again_goes_nearer() -> None:
    occupancy = np.zeros(FRAME.shape, dtype=np.int8)
    memory = ViewMemory(FRAME)
    memory.look((-3.0, 0.0, 0.0), occupancy)
    assert memory.viewed[FRAME.to_cell(1.0, 0.0)]
    memory.look_again()
    assert not memory.viewed.any()
    memory.look((-3.0, 0.0, 0.0), occupancy)
    assert memory.viewed[FRAME.to_cell(-1.0, 0.0)]
    assert not memory.viewed[FRAME.to_cell(1.0, 0.0)]


def test_a_target_is_reachable_and_was_never_viewed() -> None:
    rng = np.random.default_rng(4)
    for _ in range(40):
        occupancy = np.zeros(FRAME.shape, dtype=np.int8)
        memory = ViewMemory(FRAME)
        for _ in range(rng.integers(1, 6)):
            pose = (rng.uniform(-3, 3), rng.uniform(-3, 3), rng.uniform(-3, 3))
            memory.look(pose, occupancy)
        target = memory.next_target(pose, occupancy)
        if target is not None:
            assert not memory.viewed[FRAME.to_cell(*target)]


def test_a_robot_off_the_map_marks_nothing() -> None:
    memory = ViewMemory(FRAME)
    memory.look((-12.0, -12.0, np.pi), np.zeros(FRAME.shape, dtype=np.int8))
    assert not memory.viewed.any()


def test_memory_moves_with_a_map_that_grows() -> None:
    memory = ViewMemory(FRAME)
    memory.look((0.0, 0.0, 0.0), np.zeros(FRAME.shape, dtype=np.int8))
    memory.reject(-2.0, -2.0)
    larger = GridFrame.centred(6.0, 0.05)
    moved = memory.moved_to(larger)
    assert moved.viewed.sum() == memory.viewed.sum()
    assert moved.viewed[larger.to_cell(2.0, 0.0)] and not moved.viewed[larger.to_cell(-2.0, 0.0)]


def test_one_point_and_many_points_fall_into_the_same_cells() -> None:
    borders = 0.05 * np.arange(-79, 80)
    many = FRAME.to_cells(np.stack([borders, borders[::-1]], axis=1))
    assert [FRAME.to_cell(float(x), float(y)) for x, y in zip(borders, borders[::-1], strict=True)] == [
        tuple(cell) for cell in many.tolist()
    ]
    with pytest.raises(InputError, match="finite"):
        FRAME.to_cell(float("nan"), 0.0)


def test_a_rejected_target_is_not_proposed_again() -> None:
    occupancy = np.zeros(FRAME.shape, dtype=np.int8)
    memory = ViewMemory(FRAME)
    first = memory.next_target((0, 0, 0), occupancy)
    assert first is not None
    memory.reject(*first)
    second = memory.next_target((0, 0, 0), occupancy)
    assert second is not None and second != first


def test_a_discarded_track_is_gone_for_good_and_only_it() -> None:
    tracker = MarkerTracker(confirm=2)
    for _ in range(3):
        tracker.add((1.0, 0.0), 1.0)
    for _ in range(2):
        tracker.add((5.0, 5.0), 1.0)
    tracker.discard()
    assert tracker.estimate() == pytest.approx((5.0, 5.0))
    for _ in range(9):
        tracker.add((1.1, 0.1), 1.0)
    assert tracker.estimate() == pytest.approx((5.0, 5.0))


def test_tracker_confirms_converges_and_shrugs_off_strays() -> None:
    rng = np.random.default_rng(0)
    tracker = MarkerTracker(confirm=3)
    tracker.add((9.0, 9.0), 4.0)
    assert tracker.estimate() is None
    for distance in np.linspace(4.0, 0.5, 30):
        tracker.add(np.array([2.0, -1.0]) + rng.normal(0, 0.02 + 0.05 * distance, 2), distance)
    assert tracker.estimate() == pytest.approx((2.0, -1.0), abs=0.06)

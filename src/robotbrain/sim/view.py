"""Looking at worlds and runs: a meshcat scene in a notebook or a file, and a top-down figure.

Nothing here starts a server: the view is a page of its own (about 0.9 MB) that works in a remote JupyterLab, from
a file, and offline.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robotbrain import files
from robotbrain.errors import InputError
from robotbrain.sim.camera import marker_second_tone, tile_second_tone
from robotbrain.sim.geometry import Array, Point2D, Pose2D
from robotbrain.sim.plot import describe, plot_topdown
from robotbrain.sim.robot import CHASSIS_BOTTOM, CHASSIS_RADIUS, CHASSIS_TOP, LIDAR_HEIGHT, RobotParams
from robotbrain.sim.world import MARKER_MAT_RADIUS, MARKER_SIGN_BOTTOM, MARKER_SIGN_HALF, World

__all__ = ["Replay", "SceneView", "describe", "plot_topdown"]

if TYPE_CHECKING:
    from robotbrain.sim.meshcat_page import MeshcatPage
    from robotbrain.sim.simulation import RobotSim

PLAN_COLOUR = (0.0, 0.45, 0.70)  # Okabe and Ito's colour-blind-safe blue, orange, vermilion
DRIVEN_COLOUR = (0.90, 0.62, 0.0)
DETECTION_COLOUR = (0.84, 0.37, 0.0)
_HOLD_S = 2.0  # how long the last moment stays before the replay starts again


@dataclass
class Replay:
    """A recorded run.

    Args:
        world: where it happened.
        every_s: shortest time between two recorded moments (s).
    """

    world: World
    every_s: float = 0.1
    times_s: list[float] = field(default_factory=list)
    robot: list[Pose2D] = field(default_factory=list)
    boxes: list[tuple[Pose2D, ...]] = field(default_factory=list)
    plans: list[tuple[float, Array]] = field(default_factory=list)
    detections: list[tuple[float, Point2D]] = field(default_factory=list)

    def record(self, sim: RobotSim) -> None:
        """Note where robot and boxes are, unless the last note is younger than ``every_s``."""
        t = sim.now_ns * 1e-9
        if not self.times_s or t - self.times_s[-1] >= self.every_s - 1e-9:
            self.add_state(t, sim.truth.pose, sim.truth.obstacle_poses())

    def add_state(self, t_s: float, robot: Pose2D, boxes: tuple[Pose2D, ...] = ()) -> None:
        """Note a state at ``t_s``; ``boxes`` are poses of ``world.movable``, or empty where they began.

        Raises:
            InputError: time does not increase, or the number of boxes is wrong.
        """
        if self.times_s and t_s <= self.times_s[-1]:
            raise InputError(
                "replay time",
                given=t_s,
                expected=f"a time after the last, {self.times_s[-1]:g} s",
                fix="Record states in order of time.",
            )
        resting = tuple(Pose2D(o.x, o.y, o.yaw) for o in self.world.movable)
        if len(boxes) not in (0, len(resting)):
            raise InputError(
                "replay boxes", given=len(boxes), expected=f"0 or {len(resting)} poses", fix="Pass all of them."
            )
        self.times_s.append(t_s)
        self.robot.append(robot)
        self.boxes.append(tuple(boxes) or resting)

    def add_plan(self, t_s: float, points: ArrayLike) -> None:
        """Note that from ``t_s`` on the plan is this polyline (n, 2) in the world frame (m).

        Take points of the map frame there with ``geometry.to_parent(world.start, points)``.
        """
        polyline = np.asarray(points, float)
        if polyline.ndim != 2 or polyline.shape[1] != 2 or not np.isfinite(polyline).all():
            raise InputError(
                "plan", given=polyline.shape, expected="finite points of shape (n, 2)", fix="Pass x and y only."
            )
        self.plans.append((t_s, polyline.copy()))

    def add_detection(self, t_s: float, point: Point2D) -> None:
        """Note that at ``t_s`` the marker was believed at ``point`` (world frame)."""
        self.detections.append((t_s, point))

    def static_html(self, title: str = "robotbrain replay") -> str:
        """Return a self-contained page; the replay plays on load and repeats."""
        page = _scene_page(self.world, title)
        if self.times_s:
            self._draw_run(page)
        return page.html()

    def to_html(self, path: str | Path, title: str = "robotbrain replay") -> Path:
        """Write ``static_html`` to ``path`` and return it."""
        return files.write_text(path, self.static_html(title))

    def show(self, height: int = 480) -> Any:
        """Return an object that shows the replay in a notebook cell ``height`` pixels high."""
        return _notebook_html(self.static_html(), height)

    def _repr_html_(self) -> str:
        return str(self.show().data)

    def _draw_run(self, page: MeshcatPage) -> None:
        from robotbrain.sim.meshcat_page import pose_matrix, ribbon

        times = np.asarray(self.times_s) - self.times_s[0]
        end = float(times[-1])
        times, last = np.append(times, end + _HOLD_S), len(times) - 1
        order = [*range(len(times) - 1), last]
        page.animate_pose("robot", times, [self.robot[i] for i in order])
        for j, box in enumerate(self.world.movable):
            poses = [state[j] for state in self.boxes]
            if any(abs(p.x - box.x) + abs(p.y - box.y) > 1e-3 for p in poses):
                page.animate_pose(f"boxes/{box.name}", times, [poses[i] for i in order])
        driven = np.array([[p.x, p.y] for p in self.robot])
        driven = driven[np.append(True, np.linalg.norm(np.diff(driven, axis=0), axis=1) > 1e-3)]
        if len(driven) > 1:
            page.add("driven", ribbon(driven, 0.03, 0.012), DRIVEN_COLOUR, glow=True)
        self._draw_plans(page, end + _HOLD_S)
        for k, (t, point) in enumerate(self.detections):
            _draw_flag(page, f"detected/{k}", point)
            until = self.detections[k + 1][0] if k + 1 < len(self.detections) else None
            page.animate_visible(f"detected/{k}", _shown(t - self.times_s[0], until, self.times_s[0], end + _HOLD_S))
        page.place("robot", pose_matrix(self.robot[0].x, self.robot[0].y, 0.0, self.robot[0].yaw))

    def _draw_plans(self, page: MeshcatPage, end: float) -> None:
        from robotbrain.sim.meshcat_page import ribbon

        first = self.times_s[0]
        plans = [(t, points) for t, points in self.plans if len(points) > 1]
        for k, (t, points) in enumerate(plans):
            page.add(f"plan/{k}", ribbon(points, 0.06, 0.02), PLAN_COLOUR, glow=True)
            until = plans[k + 1][0] if k + 1 < len(plans) else None
            page.animate_visible(f"plan/{k}", _shown(t - first, until, first, end))


class SceneView:
    """A world as an interactive scene; a cell that ends with one shows it.

    Args:
        world: what to show.
        height: of the view in a notebook (pixels).
    """

    def __init__(self, world: World, height: int = 480) -> None:
        self.world, self.height = world, height

    def static_html(self, title: str = "robotbrain world") -> str:
        """Return a self-contained page."""
        return _scene_page(self.world, title).html()

    def to_html(self, path: str | Path, title: str = "robotbrain world") -> Path:
        """Write ``static_html`` to ``path`` and return it."""
        return files.write_text(path, self.static_html(title))

    def show(self) -> Any:
        """Return an object that shows the scene in a notebook cell."""
        return _notebook_html(self.static_html(), self.height)

    def _repr_html_(self) -> str:
        return str(self.show().data)


def _shown(start: float, until: float | None, first: float, end: float) -> list[tuple[float, bool]]:
    """Key frames that show a node from ``start`` to ``until`` (absolute; None is for good) and hide it else."""
    changes = [] if start <= 0.0 else [(0.0, False)]
    changes.append((max(start, 0.0), True))
    if until is not None and until - first > changes[-1][0]:
        changes.append((until - first, False))
    if changes[-1][0] < end:
        changes.append((end, changes[-1][1]))
    return changes


def _notebook_html(page: str, height: int) -> Any:
    from IPython.display import HTML

    from robotbrain.sim.meshcat_page import inline_frame

    return HTML(inline_frame(page, height))


def _scene_page(world: World, title: str) -> MeshcatPage:
    from robotbrain.sim.meshcat_page import MeshcatPage

    page = MeshcatPage(title)
    page.set_property("/Grid", "visible", False)
    page.set_property("/Axes", "visible", False)
    page.set_property("/Background", "top_color", [0.93, 0.95, 0.98])
    page.set_property("/Background", "bottom_color", [0.78, 0.82, 0.88])
    page.set_property("/Lights/FillLight/<object>", "intensity", 0.25)
    page.look_from((0.0, -1.15 * world.half_y, 2.3 * world.half_x), 1.6)
    _draw_room(page, world)
    _draw_marker(page, world)
    _draw_robot(page, world.start)
    return page


def _draw_room(page: MeshcatPage, world: World) -> None:
    from meshcat import geometry as g

    from robotbrain.sim.meshcat_page import pose_matrix

    size = (2 * world.half_x, 2 * world.half_y, 0.02)
    page.add("floor", g.Box(size), texture=floor_image(world), transform=pose_matrix(0.0, 0.0, -0.01))
    for wall in world.outer_walls:
        # drawn low, so that the room can be looked into
        box = g.Box([2 * wall.half_x, 2 * wall.half_y, 0.4])
        page.add(f"walls/{wall.name}", box, wall.rgba[:3], transform=pose_matrix(wall.x, wall.y, 0.2))
    for o in world.obstacles:
        box = g.Box([2 * o.half_x, 2 * o.half_y, o.height])
        path = f"boxes/{o.name}" if o.movable else f"fixed/{o.name}"
        page.add(f"{path}/body", box, o.rgba[:3], transform=pose_matrix(0.0, 0.0, o.half_z))
        page.place(path, pose_matrix(o.x, o.y, 0.0, o.yaw))


def _draw_marker(page: MeshcatPage, world: World) -> None:
    from meshcat import geometry as g

    from robotbrain.sim.meshcat_page import pose_matrix, ribbon, upright_cylinder

    x, y = world.goal.x, world.goal.y
    hx, hy, hz = MARKER_SIGN_HALF
    mat, sign = marker_images(world)
    page.add("marker/mat", g.Cylinder(0.01, MARKER_MAT_RADIUS), texture=mat, transform=upright_cylinder(x, y, 0.005))
    angle = np.linspace(0.0, 2 * np.pi, 49)
    rim = np.stack([x + MARKER_MAT_RADIUS * np.cos(angle), y + MARKER_MAT_RADIUS * np.sin(angle)], -1)
    page.add("marker/rim", ribbon(rim, 0.05, 0.014), world.look.marker[0], glow=True)
    page.add(
        "marker/sign",
        g.Box([2 * hx, 2 * hy, 2 * hz]),
        texture=sign,
        transform=pose_matrix(x, y, MARKER_SIGN_BOTTOM + hz),
    )


def _draw_robot(page: MeshcatPage, start: Pose2D) -> None:
    from meshcat import geometry as g

    from robotbrain.sim.meshcat_page import pose_matrix, upright_cylinder

    p = RobotParams()
    middle = (CHASSIS_BOTTOM + CHASSIS_TOP) / 2
    dark, body, lens = (0.1, 0.1, 0.12), (0.12, 0.35, 0.6), (0.9, 0.9, 0.95)
    page.add(
        "robot/chassis",
        g.Cylinder(CHASSIS_TOP - CHASSIS_BOTTOM, CHASSIS_RADIUS),
        body,
        transform=upright_cylinder(0.0, 0.0, middle),
    )
    for side, y in (("left", p.track / 2), ("right", -p.track / 2)):
        place = pose_matrix(0.0, y, p.wheel_radius)
        page.add(f"robot/{side}_wheel", g.Cylinder(0.03, p.wheel_radius), dark, transform=place)
    page.add("robot/lidar", g.Cylinder(0.05, 0.05), dark, transform=upright_cylinder(0.0, 0.0, LIDAR_HEIGHT))
    page.add("robot/camera", g.Box([0.03, 0.09, 0.03]), lens, transform=pose_matrix(0.10, 0.0, 0.26))
    page.add("robot/mast", g.Box([0.02, 0.02, 0.11]), dark, transform=pose_matrix(0.09, 0.0, 0.205))
    page.place("robot", pose_matrix(start.x, start.y, 0.0, start.yaw))


def _draw_flag(page: MeshcatPage, path: str, point: Point2D) -> None:
    from meshcat import geometry as g

    from robotbrain.sim.meshcat_page import upright_cylinder

    page.add(
        f"{path}/pole", g.Cylinder(1.7, 0.03), DETECTION_COLOUR, transform=upright_cylinder(point.x, point.y, 0.85)
    )


def floor_image(world: World, pixels: int = 320) -> NDArray[np.uint8]:
    """The floor from above, uint8 (pixels, pixels, 3), north up."""
    x = (np.arange(pixels) + 0.5) / pixels * 2 - 1
    xs, ys = np.meshgrid(x * world.half_x, -x * world.half_y)
    second = tile_second_tone(world.look, xs, ys)
    return _two_tones(second, world.look.floor)


def marker_images(world: World, pixels: int = 32) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Patterns of the marker's mat (pixels, pixels, 3) and of one side of its sign, uint8."""
    u = (np.arange(pixels) + 0.5) / pixels * 2 - 1
    xs, ys = np.meshgrid(u * MARKER_MAT_RADIUS, -u * MARKER_MAT_RADIUS)
    mat = marker_second_tone(world.look, np.stack([xs, ys, np.zeros_like(xs)]))
    xs, zs = np.meshgrid(u * MARKER_SIGN_HALF[0], -u * MARKER_SIGN_HALF[2])
    sides = np.full_like(xs, -MARKER_SIGN_HALF[1])
    sign = marker_second_tone(world.look, np.stack([xs, sides, zs + MARKER_SIGN_BOTTOM + MARKER_SIGN_HALF[2]]))
    return _two_tones(mat, world.look.marker), _two_tones(sign, world.look.marker)


def _two_tones(second: NDArray[np.bool_], tones: tuple[Any, Any]) -> NDArray[np.uint8]:
    colour = np.where(second[..., None], np.asarray(tones[1]), np.asarray(tones[0]))
    return np.asarray(colour * 255.0, np.uint8)

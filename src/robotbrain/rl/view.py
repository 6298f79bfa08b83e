"""Watching robots of the reinforcement-learning tasks: recorded motions as a meshcat page, side by side.

Record generalised positions while a policy runs, then look at them in a notebook or a file of its own (about 1 MB).
No server, no OpenGL. ``robotbrain rl watch`` does it for a policy file.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from robotbrain import files
from robotbrain.errors import InputError

if TYPE_CHECKING:
    from meshcat.geometry import Geometry

    from robotbrain.sim.meshcat_page import MeshcatPage

Array = NDArray[np.float64]

TARGET_COLOUR = (0.84, 0.37, 0.0)  # Okabe and Ito's vermilion, blue, green: safe for the colour-blind
PATH_COLOURS = ((0.0, 0.45, 0.70), (0.90, 0.62, 0.0), (0.0, 0.62, 0.45))
FRAME_S = 0.04
"""Shortest time between two key frames of a page (s)."""
_HOLD_S = 1.0
_NEAR_M = 8.0  # task worlds park what they do not use far away


@dataclass(frozen=True, eq=False)
class Motion:
    """What one robot did.

    Args:
        label: what is shown, for the caption.
        model: MJCF text, or the compiled model.
        qpos: generalised positions, (T, nq).
        dt_s: time between two of them (s).
        targets: place to reach in the world frame (m), (T, 3) or (3,); none by default.
        trace: site or body whose path is drawn, such as ``"ee"``; none by default.

    Raises:
        InputError: shapes that do not fit, values that are not finite, or a site that does not exist.
    """

    label: str
    model: str | mujoco.MjModel
    qpos: ArrayLike
    dt_s: float
    targets: ArrayLike | None = None
    trace: str | None = None

    def __post_init__(self) -> None:
        if isinstance(self.model, str):
            object.__setattr__(self, "model", mujoco.MjModel.from_xml_string(self.model))
        assert isinstance(self.model, mujoco.MjModel)
        qpos = np.array(self.qpos, float)
        if qpos.ndim != 2 or not len(qpos) or qpos.shape[1] != self.model.nq or not np.isfinite(qpos).all():
            raise InputError(
                "motion qpos",
                given=f"shape {qpos.shape}",
                expected=f"finite, (T, {self.model.nq}) with T >= 1",
                fix="Record the simulator's qpos once per step.",
            )
        if not (np.isfinite(self.dt_s) and self.dt_s > 0):
            raise InputError("motion dt_s", given=self.dt_s, expected="seconds > 0", fix="Pass the control period.")
        object.__setattr__(self, "qpos", qpos)
        if self.targets is not None:
            targets = np.asarray(self.targets, float)
            if targets.shape not in ((3,), (len(qpos), 3)) or not np.isfinite(targets).all():
                raise InputError(
                    "motion targets", given=targets.shape, expected=f"(3,) or ({len(qpos)}, 3)", fix="One per step."
                )
            object.__setattr__(self, "targets", np.broadcast_to(targets, (len(qpos), 3)))
        if self.trace is not None and self.trace not in _names(self.model):
            raise InputError("motion trace", given=self.trace, expected="a site or body of the model", fix="Try 'ee'.")


class MotionReplay:
    """Motions side by side, playing at the same time; a cell that ends with one shows it.

    Args:
        motions: from left to right, one or more.
        title: of the page.
        spacing_m: between two neighbours; wide enough for the robots by default.
        height: of the view in a notebook (pixels).
    """

    def __init__(
        self,
        motions: Sequence[Motion],
        title: str = "robotbrain motion",
        *,
        spacing_m: float | None = None,
        height: int = 480,
    ) -> None:
        self.motions, self.title, self.height = tuple(motions), title, height
        if not self.motions:
            raise InputError(
                "motions", given=(), expected="one or more", fix="Record one with robotbrain.rl.gap.record."
            )
        self._spacing = spacing_m

    def static_html(self) -> str:
        """Return a self-contained page; the motions play on load and repeat."""
        from robotbrain.sim.meshcat_page import MeshcatPage

        names = " | ".join(m.label for m in self.motions)
        page = MeshcatPage(self.title, caption=f"{names} (left to right)" if len(self.motions) > 1 else names)
        for key, value in (("top_color", [0.93, 0.95, 0.98]), ("bottom_color", [0.78, 0.82, 0.88])):
            page.set_property("/Background", key, value)
        page.set_property("/Grid", "visible", False)
        page.set_property("/Axes", "visible", False)
        page.set_property("/Lights/FillLight/<object>", "intensity", 0.25)
        worlds = [_world(m) for m in self.motions]
        spread = [_extent(w) for w in worlds]
        width = max(high[1] - low[1] for low, high in spread)
        spacing = self._spacing or width + 0.5
        end = max((len(w.places) - 1) * m.dt_s for w, m in zip(worlds, self.motions, strict=True)) + _HOLD_S
        low, high = np.min([s[0] for s in spread], axis=0), np.max([s[1] for s in spread], axis=0)
        middle = (low + high) / 2
        for k, (motion, world) in enumerate(zip(self.motions, worlds, strict=True)):
            shift = np.array([0.0, (k - (len(worlds) - 1) / 2) * spacing, 0.0]) - middle
            _draw(page, f"motion{k}", motion, world, shift, end, PATH_COLOURS[k % len(PATH_COLOURS)])
        across = width + spacing * (len(worlds) - 1)
        _look(page, across, float(high[0] - low[0]), float(high[2] - low[2]))
        return page.html()

    def to_html(self, path: str | Path) -> Path:
        """Write the page to ``path`` and return it."""
        return files.write_text(path, self.static_html())

    def show(self) -> Any:
        """Return an object that shows the page in a notebook cell."""
        from IPython.display import HTML

        from robotbrain.sim.meshcat_page import inline_frame

        return HTML(inline_frame(self.static_html(), self.height))

    def _repr_html_(self) -> str:
        return str(self.show().data)


def _site_names(model: mujoco.MjModel) -> set[str]:
    return {model.site(i).name for i in range(model.nsite)}


def _names(model: mujoco.MjModel) -> set[str]:
    return _site_names(model) | {model.body(i).name for i in range(model.nbody)}


@dataclass(frozen=True, eq=False)
class _World:
    """Poses of the bodies over time: places (T, nbody, 3), turns (T, nbody, 4) xyzw; path of the traced site.

    ``fixed`` are corners of what the world itself consists of, such as walls, (k, 3).
    """

    places: Array
    turns: Array
    path: Array
    fixed: Array


def _world(motion: Motion) -> _World:
    model, qpos = motion.model, np.asarray(motion.qpos)
    assert isinstance(model, mujoco.MjModel)
    data, sites = mujoco.MjData(model), _site_names(model)
    places, turns = np.zeros((len(qpos), model.nbody, 3)), np.zeros((len(qpos), model.nbody, 4))
    path = np.zeros((len(qpos) if motion.trace else 0, 3))
    for t, position in enumerate(qpos):
        data.qpos[:] = position
        mujoco.mj_kinematics(model, data)
        places[t], turns[t] = data.xpos, data.xquat[:, [1, 2, 3, 0]]
        if motion.trace:
            path[t] = data.site(motion.trace).xpos if motion.trace in sites else data.body(motion.trace).xpos
    walls = [i for i in range(model.body_geomnum[0]) if shapes(int(model.geom_type[i]), model.geom_size[i])]
    corners = [model.geom_pos[i] + sign * model.geom_size[i] for i in walls for sign in (-1.0, 1.0)]
    return _World(places, turns, path, np.array(corners).reshape(-1, 3))


def _near(world: _World) -> NDArray[np.bool_]:
    """Which bodies belong to the scene, (nbody,): what moves, and what stands within ``_NEAR_M`` of that."""
    moves = np.ptp(world.places, axis=0).max(1) + np.ptp(world.turns, axis=0).max(1) > 1e-4
    moves = moves if moves.any() else np.arange(world.places.shape[1]) > 0
    low, high = world.places[:, moves].min((0, 1)), world.places[:, moves].max((0, 1))
    outside = np.maximum(low - world.places[0], world.places[0] - high).max(1)
    return np.asarray(outside < _NEAR_M)


def _extent(world: _World) -> tuple[Array, Array]:
    """Corners of the box of what is seen, with a margin for the bodies' own size (m)."""
    bodies = np.concatenate([world.places[:, 1:][:, _near(world)[1:]].reshape(-1, 3), world.fixed])
    return bodies.min(0) - np.array([0.2, 0.2, 0.0]), bodies.max(0) + np.array([0.2, 0.2, 0.1])


def _look(page: MeshcatPage, across: float, deep: float, tall: float) -> None:
    # meshcat's camera looks at the origin; at distance d and zoom z it sees about 1.5 d / z across
    distance = 1.2 * max(across, deep, tall, 0.8)
    # a room is looked into from above, a robot from the side
    height = 1.1 if deep > 3.0 * tall else 0.4
    page.look_from((0.95 * distance, -0.2 * distance, height * distance), 1.7)


def _draw(page: MeshcatPage, root: str, motion: Motion, world: _World, shift: Array, end: float, colour: Any) -> None:
    from meshcat import geometry as g

    from robotbrain.sim.meshcat_page import pose_matrix

    model = motion.model
    assert isinstance(model, mujoco.MjModel)
    page.place(root, pose_matrix(*shift.tolist()))
    low, high = _extent(world)
    middle_x, middle_y, _ = ((low + high) / 2).tolist()
    floor = pose_matrix(middle_x, middle_y, -0.012)
    size = [float(high[0] - low[0]), float(high[1] - low[1]), 0.02]
    page.add(f"{root}/floor", g.Box(size), (0.85, 0.88, 0.90), transform=floor)
    every = max(1, round(FRAME_S / motion.dt_s))
    steps = np.unique(np.append(np.arange(0, len(world.places), every), len(world.places) - 1))
    times = np.append(steps * motion.dt_s, end)
    steps = np.append(steps, steps[-1])
    for body in np.flatnonzero(_near(world)).tolist():
        path = f"{root}/body{body}"
        if not _add_geoms(page, path, model, body):
            continue
        moves = np.ptp(world.places[:, body], axis=0).max() > 1e-4 or np.ptp(world.turns[:, body], axis=0).max() > 1e-4
        page.place(path, _matrix(world.places[0, body], world.turns[0, body]))
        if moves:
            page.animate(path, times, world.places[steps, body], _continuous(world.turns[steps, body]))
    if motion.targets is not None:
        targets = np.asarray(motion.targets)
        page.add(f"{root}/target/ball", g.Sphere(0.02), TARGET_COLOUR, opacity=0.75)
        page.place(f"{root}/target", pose_matrix(*targets[0].tolist()))
        if np.ptp(targets, axis=0).max() > 0:
            upright = np.tile([0.0, 0.0, 0.0, 1.0], (len(steps), 1))
            page.animate(f"{root}/target", times, targets[steps], upright)
    if len(world.path) > 1:
        _draw_path(page, f"{root}/path", world.path, colour)


def _draw_path(page: MeshcatPage, path: str, points: Array, colour: Any) -> None:
    """A thin tube along the path, of three flat sides."""
    from meshcat import geometry as g

    keep = np.append(True, np.linalg.norm(np.diff(points, axis=0), axis=1) > 1e-3)
    points = points[keep]
    if len(points) < 2:
        return
    along = np.gradient(points, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True) + 1e-12
    side = np.cross(along, [0.0, 0.0, 1.0])
    side = np.where(np.linalg.norm(side, axis=1, keepdims=True) > 1e-6, side, [1.0, 0.0, 0.0])
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    up = np.cross(side, along)
    angles = (0.0, 2 * np.pi / 3, 4 * np.pi / 3)
    rings = np.stack([points + 0.004 * (np.cos(a) * side + np.sin(a) * up) for a in angles], axis=1)
    n = len(points)
    faces = [
        [3 * i + a, 3 * i + b, 3 * i + 3 + a] if first else [3 * i + b, 3 * i + 3 + b, 3 * i + 3 + a]
        for i in range(n - 1)
        for a, b in ((0, 1), (1, 2), (2, 0))
        for first in (True, False)
    ]
    page.add(path, g.TriangularMeshGeometry(rings.reshape(-1, 3), np.array(faces, np.uint32)), colour, glow=True)


def _add_geoms(page: MeshcatPage, path: str, model: mujoco.MjModel, body: int) -> bool:
    """Draw a body's visible geoms; tell whether there were any."""
    drawn = False
    for i in range(model.body_geomadr[body], model.body_geomadr[body] + model.body_geomnum[body]):
        r, g_, b, opacity = model.geom_rgba[i].tolist()
        if opacity == 0.0:
            continue
        frame = _matrix(model.geom_pos[i], model.geom_quat[i][[1, 2, 3, 0]])
        for k, (shape, local) in enumerate(shapes(int(model.geom_type[i]), model.geom_size[i])):
            page.add(f"{path}/geom{i}_{k}", shape, (r, g_, b), opacity=opacity, transform=frame @ local)
            drawn = True
    return drawn


def shapes(kind: int, size: Array) -> list[tuple[Geometry, Array]]:
    """Return meshcat's shapes for a MuJoCo geom, each with its 4x4 place in the geom's frame.

    Args:
        kind: ``mjtGeom``; planes and what has no primitive shape give nothing.
        size: MuJoCo's sizes of it (m).
    """
    from meshcat import geometry as g

    a, b, c = (float(v) for v in size)
    # meshcat's cylinders stand along y, MuJoCo's along z
    upright = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
    here = np.eye(4)
    if kind == int(mujoco.mjtGeom.mjGEOM_BOX):
        return [(g.Box([2 * a, 2 * b, 2 * c]), here)]
    if kind == int(mujoco.mjtGeom.mjGEOM_SPHERE):
        return [(g.Sphere(a), here)]
    if kind == int(mujoco.mjtGeom.mjGEOM_ELLIPSOID):
        return [(g.Ellipsoid([a, b, c]), here)]
    if kind == int(mujoco.mjtGeom.mjGEOM_CYLINDER):
        return [(g.Cylinder(2 * b, a), upright)]
    if kind == int(mujoco.mjtGeom.mjGEOM_CAPSULE):
        ends = [(g.Sphere(a), _matrix(np.array([0.0, 0.0, s * b]), np.array([0.0, 0.0, 0.0, 1.0]))) for s in (-1, 1)]
        return [(g.Cylinder(2 * b, a), upright), *ends]
    return []


def _matrix(place: Array, turn_xyzw: Array) -> Array:
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, np.asarray(turn_xyzw, float)[[3, 0, 1, 2]])
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation.reshape(3, 3), place
    return matrix


def _continuous(turns: Array) -> Array:
    """Quaternions of the same rotations without jumps of sign, which an interpolating viewer would show as spins."""
    flips = np.where((turns[1:] * turns[:-1]).sum(1) < 0.0, -1.0, 1.0)
    return np.asarray(turns * np.append(1.0, np.cumprod(flips))[:, None])


def watch_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``robotbrain rl watch``."""
    parser.add_argument(
        "policy", type=Path, nargs="?", help="ONNX file, checkpoint or run folder (default: the shipped reach policy)"
    )
    parser.add_argument("--task", help="where to watch it (default: where it was trained)")
    parser.add_argument("--serial", type=int, help="reach, ONNX: beside it the surrogate with this serial number")
    parser.add_argument("--episodes", type=int, default=5, help="reach, ONNX: one after the other (default 5)")
    parser.add_argument("--seconds", type=float, default=10.0, help="other tasks: how long (default 10)")
    parser.add_argument("--seed", type=int, default=0, help="of targets, rooms, commands (default 0)")
    parser.add_argument("--html", type=Path, default=Path("watch.html"), help="file to write (default watch.html)")


def watch_main(arguments: argparse.Namespace) -> int:
    """Let a policy act, record it, and write a page."""
    from robotbrain.rl.gap import record_reach
    from robotbrain.rl.onnx_policy import OnnxPolicy
    from robotbrain.rl.recording import record_task

    path = arguments.policy
    exported = path is None or path.suffix == ".onnx"
    if exported and (arguments.task or (OnnxPolicy(path).meta.task if path else "reach")) == "reach":
        serials = [None] if arguments.serial is None else [None, arguments.serial]
        motions = [record_reach(path, serial=s, episodes=arguments.episodes, seed=arguments.seed) for s in serials]
    elif arguments.serial is not None:
        raise InputError(
            "--serial", given=arguments.serial, expected="an ONNX policy of reach", fix="Export it, or leave it out."
        )
    else:
        motions = [record_task(path, task=arguments.task, seconds=arguments.seconds, seed=arguments.seed)]
    print(MotionReplay(motions, "robotbrain rl watch").to_html(arguments.html))
    return 0

"""RGB-D and segmentation camera by ray casting: no OpenGL, no GPU, the same pixels on every machine.

One ray per pixel through its centre, cast by ``mujoco.batch.Batch.ray`` (``mj_multiRay`` would miss visual-only
geoms outside their body's collision bounds), Lambert shading from the surface normals, and patterns computed
from the hit points. The optical frame follows REP 103: z forward, x right, y down.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from robotbrain.errors import InputError
from robotbrain.sim.checks import check_range
from robotbrain.sim.geometry import Array
from robotbrain.sim.rays import RayCaster, rotation_from_quaternion
from robotbrain.sim.robot import SensorParams
from robotbrain.sim.scene import GROUP_SOLID, GROUP_VISUAL, Pattern, Scene
from robotbrain.sim.world import MARKER_SIGN_BOTTOM, Look

_OPTICAL_FROM_FORWARD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
SHELF_PERIOD = 0.36
"""Height of one shelf board and the space above it (m), of the pattern on shelves."""


@dataclass(frozen=True, slots=True)
class CameraIntrinsics:
    """A pinhole without distortion; pixel (0, 0) is the top left one and its centre is at (0, 0).

    Args:
        width: pixels.
        height: pixels.
        fx: focal length along a row (pixels).
        fy: focal length along a column (pixels).
        cx: column of the optical axis.
        cy: row of the optical axis.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    @classmethod
    def from_fov(
        cls, width: int = 64, height: int = 64, horizontal_deg: float = 80.0, vertical_deg: float = 64.4
    ) -> CameraIntrinsics:
        """Intrinsics of a camera that sees these angles. The defaults are a 4:3 camera of 80 deg squeezed
        to a square image, as networks get it, so ``fx`` and ``fy`` differ.
        """
        check_range("camera width", width, 1, 4096)
        check_range("camera height", height, 1, 4096)
        check_range("camera horizontal_deg", horizontal_deg, 1.0, 170.0)
        check_range("camera vertical_deg", vertical_deg, 1.0, 170.0)
        fx = width / 2.0 / math.tan(math.radians(horizontal_deg) / 2.0)
        fy = height / 2.0 / math.tan(math.radians(vertical_deg) / 2.0)
        return cls(width, height, fx, fy, (width - 1) / 2.0, (height - 1) / 2.0)

    @property
    def matrix(self) -> Array:
        """The camera matrix K, (3, 3)."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def rays(self) -> Array:
        """Direction of every pixel centre in the optical frame with z = 1, (height, width, 3)."""
        u, v = np.meshgrid(np.arange(self.width, dtype=float), np.arange(self.height, dtype=float))
        return np.stack([(u - self.cx) / self.fx, (v - self.cy) / self.fy, np.ones_like(u)], -1)


@dataclass(frozen=True, slots=True)
class CameraExtrinsics:
    """Where the camera sits on the robot.

    Args:
        x: position of the optical centre in ``base_link`` (m).
        y: (m).
        z: (m).
        pitch: downward tilt (rad).
    """

    x: float = 0.10
    y: float = 0.0
    z: float = 0.26
    pitch: float = 0.14

    @property
    def position(self) -> Array:
        """Position of the optical centre in ``base_link`` (m), (3,)."""
        return np.array([self.x, self.y, self.z])

    @property
    def rotation(self) -> Array:
        """Rotation matrix from the optical frame to ``base_link``, (3, 3)."""
        c, s = math.cos(self.pitch), math.sin(self.pitch)
        tilt = np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
        return np.asarray(tilt @ _OPTICAL_FROM_FORWARD)

    @property
    def quaternion_xyzw(self) -> Array:
        """Rotation from the optical frame to ``base_link`` as a ROS quaternion (x, y, z, w), (4,)."""
        wxyz = np.empty(4)
        mujoco.mju_mat2Quat(wxyz, np.ascontiguousarray(self.rotation).ravel())
        return wxyz[[1, 2, 3, 0]]

    def to_base(self, points: ArrayLike) -> Array:
        """Points (..., 3) of the optical frame in ``base_link``."""
        return np.asarray(np.asarray(points, float) @ self.rotation.T + self.position)


@dataclass(frozen=True, slots=True)
class CameraImage:
    """One frame before it becomes a sensor reading.

    Args:
        rgb: uint8 (height, width, 3).
        depth: metres along the optical axis, float32 (height, width); +inf where nothing is hit.
        classes: ``SegmentationClass`` of each pixel, uint8 (height, width): the truth, for training and judging.
        geom_id: geom of each pixel, int32 (height, width); -1 where nothing is hit.
    """

    rgb: NDArray[np.uint8]
    depth: NDArray[np.float32]
    classes: NDArray[np.uint8]
    geom_id: NDArray[np.int32]


class RayCamera:
    """Camera on the robot of a scene.

    Args:
        scene: what it looks at.
        intrinsics: image size and angles; 64x64 by default.
        extrinsics: mounting on the robot.
        caster: shared with another sensor of the same scene to save memory; its own by default.
    """

    def __init__(
        self,
        scene: Scene,
        intrinsics: CameraIntrinsics | None = None,
        extrinsics: CameraExtrinsics | None = None,
        caster: RayCaster | None = None,
    ) -> None:
        self.scene = scene
        self.intrinsics = intrinsics or CameraIntrinsics.from_fov()
        self.extrinsics = extrinsics or CameraExtrinsics()
        self._caster = caster or RayCaster(scene.model, (GROUP_SOLID, GROUP_VISUAL))
        optical = self.intrinsics.rays().reshape(-1, 3)
        self._length = np.linalg.norm(optical, axis=1)
        self._rays = (optical / self._length[:, None]) @ self.extrinsics.rotation.T
        # one more row, reached by geom id -1: the background
        self._classes = np.append(scene.geom_class, np.uint8(0))
        self._patterns = np.append(scene.geom_pattern, np.uint8(0))
        self._colours = np.vstack([scene.geom_colour, np.zeros(3, np.float32)])
        self.look = scene.world.look

    @property
    def look(self) -> Look:
        """Colours and light; may be exchanged between frames (domain randomisation)."""
        return self._look

    @look.setter
    def look(self, look: Look) -> None:
        self._look = look
        self._colours[-1] = look.background
        self._light = np.asarray(look.light, np.float32)
        self._gain = np.asarray(look.tint, np.float32) * np.float32(255.0)

    def set_colours(self, colours: ArrayLike) -> None:
        """Exchange the plain colours of all geoms, (ngeom, 3) in [0, 1] (domain randomisation)."""
        given = np.asarray(colours, np.float32)
        if given.shape != self.scene.geom_colour.shape:
            raise InputError(
                "camera colours",
                given=given.shape,
                expected=f"shape {self.scene.geom_colour.shape}",
                fix="Pass one colour for each geom.",
            )
        self._colours[:-1] = given

    def render(
        self, qpos: Array, sensors: SensorParams | None = None, rng: np.random.Generator | None = None
    ) -> CameraImage:
        """Take a frame of the scene in configuration ``qpos`` (nq,).

        Args:
            qpos: state of the scene's model; the robot's pose comes first.
            sensors: tint, exposure and noise; a perfect camera by default.
            rng: source of the noise; without it there is none.
        """
        base = rotation_from_quaternion(qpos[3:7])
        origin = qpos[:3] + base @ self.extrinsics.position
        directions = self._rays @ base.T
        distance, geom, normal = self._caster.cast(qpos, origin, directions)
        hit = geom >= 0
        rgb = self._surface_colours(origin, directions, distance, geom)
        light = self._look.ambient + (1.0 - self._look.ambient) * np.maximum(normal @ self._light, 0.0)
        rgb *= np.where(hit, light, 1.0).astype(np.float32)[:, None]
        depth = np.where(hit, distance / self._length, np.inf).astype(np.float32)
        gain = self._gain
        if sensors is not None:
            gain = gain * np.asarray(sensors.camera_tint, np.float32) * np.float32(sensors.camera_exposure)
        rgb *= gain
        if sensors is not None and rng is not None:
            rgb += np.float32(sensors.camera_noise) * rng.standard_normal(rgb.shape, np.float32)
            spread = np.float32(sensors.depth_noise) * np.where(hit, depth, np.float32(0.0)) ** 2
            depth += spread * rng.standard_normal(depth.shape, np.float32)
        shape = (self.intrinsics.height, self.intrinsics.width)
        return CameraImage(
            np.clip(rgb, 0.0, 255.0).astype(np.uint8).reshape(*shape, 3),
            depth.reshape(shape),
            self._classes[geom].reshape(shape),
            geom.reshape(shape),
        )

    def _surface_colours(
        self, origin: Array, directions: Array, distance: Array, geom: NDArray[np.int32]
    ) -> NDArray[np.float32]:
        """Unlit colour of every pixel (n, 3): the geom's, changed where it carries a pattern."""
        look = self._look
        rgb = self._colours.take(geom, axis=0, mode="wrap")  # -1, a miss, wraps to the background
        patterns = self._patterns[geom]
        index = np.flatnonzero(patterns == Pattern.TILES)
        if index.size:
            x, y, _ = self._hit_points(origin, directions, distance, index)
            second = tile_second_tone(look, x, y)
            rgb[index] = np.where(
                second[:, None], np.asarray(look.floor[1], np.float32), np.asarray(look.floor[0], np.float32)
            )
        index = np.flatnonzero(patterns == Pattern.SHELF)
        if index.size:
            _, _, z = self._hit_points(origin, directions, distance, index)
            rgb[index] *= np.where(z % SHELF_PERIOD < 0.3 * SHELF_PERIOD, 1.0, 0.72).astype(np.float32)[:, None]
        index = np.flatnonzero(patterns == Pattern.MARKER)
        if index.size:
            goal = self.scene.world.goal
            points = self._hit_points(origin, directions, distance, index) - [[goal.x], [goal.y], [0.0]]
            second = marker_second_tone(look, points)
            rgb[index] = np.where(
                second[:, None], np.asarray(look.marker[1], np.float32), np.asarray(look.marker[0], np.float32)
            )
        return rgb

    @staticmethod
    def _hit_points(origin: Array, directions: Array, distance: Array, index: NDArray[np.intp]) -> Array:
        """World coordinates of the chosen hits, (3, n)."""
        return np.asarray(origin[:, None] + directions[index].T * distance[index])


def tile_second_tone(look: Look, x: Array, y: Array) -> NDArray[np.bool_]:
    """Where the second colour of the floor tiles shows, for floor points (m)."""
    c, s = math.cos(look.floor_yaw) / look.floor_tile, math.sin(look.floor_yaw) / look.floor_tile
    return np.asarray((np.floor(x * c + y * s) + np.floor(y * c - x * s)) % 2.0 > 0.5)


def marker_second_tone(look: Look, points: Array) -> NDArray[np.bool_]:
    """Where on the marker the second tone shows, for points (3, ...) relative to the goal (m).

    Stripes run level around the sign, straight across its underside and the mat; the chequer is of cubes in space.
    """
    x, y, z = points
    period = look.marker_period
    if look.marker_pattern == "stripes":
        return np.asarray(np.floor(np.where(z < MARKER_SIGN_BOTTOM + 1e-3, x, z) / period) % 2.0 > 0.5)
    cells = np.floor(x / period) + np.floor(y / period) + np.floor(z / period)
    return np.asarray(cells % 2.0 > 0.5)

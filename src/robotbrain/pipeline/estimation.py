"""State estimation: an extended Kalman filter over wheel encoders, gyro and lidar.

The state is (x, y, yaw, gyro bias). Wheel travel and the unbiased gyro rate predict it, a standstill observes the bias,
and the lidar observes the pose by matching each scan to the scans kept so far (point-to-line ICP).

Sources: Thrun, Burgard and Fox, "Probabilistic Robotics", 2005, ch. 3 and 5; Censi, "An ICP variant using a
point-to-line metric", ICRA 2008.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from robotbrain.pipeline.geometry import Pose, transform, wrap

GATE_3DOF_999 = 16.27
"""99.9 % quantile of the chi-square distribution with 3 degrees of freedom: innovations beyond are outliers."""


@dataclass(frozen=True)
class FilterParams:
    """Noise densities of the filter.

    Attributes:
        wheel_noise: standard deviation of wheel travel, m per sqrt(m).
        gyro_noise: standard deviation of the yaw rate integral, rad per sqrt(s).
        slip_noise: standard deviation of yaw per radian turned (wheels slip when turning on the spot).
        bias_walk: random walk of the gyro bias, rad/s per sqrt(s).
        bias_initial: initial standard deviation of the bias, rad/s.
        still_noise: standard deviation of one gyro reading at standstill, rad/s.
    """

    wheel_noise: float = 0.03
    gyro_noise: float = 0.003
    slip_noise: float = 0.01
    bias_walk: float = 2e-4
    bias_initial: float = 0.03
    still_noise: float = 0.01


class PoseFilter:
    """Extended Kalman filter of a differential-drive robot in the plane.

    Attributes:
        state: (4,) x m, y m, yaw rad, gyro bias rad/s.
        covariance: (4, 4), symmetric positive definite.
    """

    def __init__(self, params: FilterParams | None = None) -> None:
        self.params = params or FilterParams()
        self.state = np.zeros(4)
        self.covariance = np.diag([1e-6, 1e-6, 1e-6, self.params.bias_initial**2])

    @property
    def pose(self) -> Pose:
        """The estimated x, y, yaw."""
        return (float(self.state[0]), float(self.state[1]), float(self.state[2]))

    @property
    def bias(self) -> float:
        """The estimated gyro bias, rad/s."""
        return float(self.state[3])

    def predict(self, travel: float, gyro_rate: float, dt: float) -> None:
        """Move the state by ``travel`` metres and (``gyro_rate`` - bias) times ``dt`` radians.

        Args:
            travel: mean travel of the two wheels, m.
            gyro_rate: yaw rate as measured, rad/s.
            dt: time step, s; non-positive steps are ignored.
        """
        if dt <= 0:
            return
        p = self.params
        turn = (gyro_rate - float(self.state[3])) * dt
        middle = float(self.state[2]) + turn / 2
        cos, sin = math.cos(middle), math.sin(middle)
        self.state[0] += travel * cos
        self.state[1] += travel * sin
        self.state[2] = wrap(float(self.state[2]) + turn)
        jacobian = np.array(
            [
                [1.0, 0.0, -travel * sin, travel * sin * dt / 2],
                [0.0, 1.0, travel * cos, -travel * cos * dt / 2],
                [0.0, 0.0, 1.0, -dt],
                [0.0, 0.0, 0.0, 1.0],
            ]
        )
        along = p.wheel_noise**2 * abs(travel)
        yaw = p.gyro_noise**2 * dt + (p.slip_noise * turn) ** 2
        # Travel acts along the heading; half of the yaw noise bends the step.
        spread = np.array(
            [[cos, -travel * sin / 2, 0.0], [sin, travel * cos / 2, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
        )
        noise = np.array([along, yaw, p.bias_walk**2 * dt])
        self.covariance = jacobian @ self.covariance @ jacobian.T + (spread * noise) @ spread.T

    def observe_standstill(self, gyro_rate: float) -> None:
        """Use a gyro reading taken while the wheels stand still: it shows the bias alone."""
        self._update(
            np.array([gyro_rate - self.state[3]]),
            np.array([[0.0, 0.0, 0.0, 1.0]]),
            np.array([[self.params.still_noise**2]]),
        )

    def observe_pose(self, innovation: NDArray[np.float64], noise: NDArray[np.float64]) -> bool:
        """Use a measured pose, as its difference from the predicted one.

        Args:
            innovation: (3,) measured minus predicted x, y, yaw (yaw is wrapped here).
            noise: (3, 3) covariance of the measurement.

        Returns:
            Whether the innovation passed the 99.9 % gate and was used.
        """
        innovation = np.asarray(innovation, dtype=float).copy()
        innovation[2] = wrap(innovation[2])
        observe = np.eye(3, 4)
        total = observe @ self.covariance @ observe.T + noise
        if float(innovation @ np.linalg.solve(total, innovation)) > GATE_3DOF_999:
            return False
        self._update(innovation, observe, noise)
        return True

    def _update(
        self, innovation: NDArray[np.float64], observe: NDArray[np.float64], noise: NDArray[np.float64]
    ) -> None:
        total = observe @ self.covariance @ observe.T + noise
        gain = np.linalg.solve(total, observe @ self.covariance).T
        self.state = self.state + gain @ innovation
        self.state[2] = wrap(float(self.state[2]))
        # Joseph form: stays symmetric and positive definite under rounding.
        keep = np.eye(4) - gain @ observe
        self.covariance = keep @ self.covariance @ keep.T + gain @ noise @ gain.T


@dataclass(frozen=True)
class MatchParams:
    """Scan matching.

    Attributes:
        iterations: Gauss-Newton steps at most.
        reject_distance: pairs farther apart than this are dropped, m (halved as the match settles).
        range_noise: standard deviation assumed per beam, m.
        min_pairs: fewer pairs than this are no match.
        keyframe_distance, keyframe_angle: a scan is kept when the robot has moved or turned this far, m and rad.
        keyframes: scans kept at most; the oldest are forgotten.
    """

    iterations: int = 8
    reject_distance: float = 0.3
    range_noise: float = 0.02
    min_pairs: int = 25
    keyframe_distance: float = 0.5
    keyframe_angle: float = 0.5
    keyframes: int = 40


@dataclass(frozen=True)
class ScanMatch:
    """A pose measured by matching a scan.

    Attributes:
        pose: x, y, yaw in the map frame.
        covariance: (3, 3) of that pose.
        rms: root mean square point-to-line distance of the used pairs, m.
    """

    pose: Pose
    covariance: NDArray[np.float64]
    rms: float


class ScanMatcher:
    """Matches scans to the scans kept so far, by point-to-line ICP.

    Attributes:
        queries: nearest neighbours looked up by the last :meth:`match` (its unit of CPU work).
    """

    def __init__(self, params: MatchParams | None = None) -> None:
        self.params = params or MatchParams()
        self.queries = 0
        self._keyframes: list[tuple[Pose, NDArray[np.float64], NDArray[np.float64]]] = []
        self._tree: cKDTree | None = None
        self._points = np.zeros((0, 2))
        self._normals = np.zeros((0, 2))

    @property
    def keyframe_count(self) -> int:
        """How many scans are kept."""
        return len(self._keyframes)

    @property
    def point_count(self) -> int:
        """How many points the kept scans have."""
        return len(self._points)

    def match(self, points: NDArray[np.float64], guess: Pose) -> ScanMatch | None:
        """Return where ``points`` (N, 2), given in the robot's frame, fit best near ``guess``, or None."""
        self.queries = 0
        if self._tree is None or len(points) < self.params.min_pairs:
            return None
        p = self.params
        pose = np.array(guess)
        reject = p.reject_distance
        hessian = np.zeros((3, 3))
        residual = np.zeros(0)
        for _ in range(p.iterations):
            world = transform(pose, points)
            self.queries += len(points)
            distance, index = self._tree.query(world, distance_upper_bound=reject)
            used = np.isfinite(distance)
            if int(used.sum()) < p.min_pairs:
                return None
            normal = self._normals[index[used]]
            residual = ((world[used] - self._points[index[used]]) * normal).sum(axis=1)
            arm = world[used] - pose[:2]
            jacobian = np.column_stack([normal, normal[:, 1] * arm[:, 0] - normal[:, 0] * arm[:, 1]])
            # Huber weights: a pushed box or a person is an outlier, not a reason to move the map.
            weight = np.minimum(1.0, 2 * p.range_noise / np.maximum(np.abs(residual), 1e-12))
            hessian = (jacobian * weight[:, None]).T @ jacobian
            step = np.linalg.solve(hessian + 1e-6 * np.eye(3), -(jacobian * weight[:, None]).T @ residual)
            pose += step
            reject = max(0.1, reject * 0.7)
            if np.abs(step[:2]).max() < 5e-4 and abs(step[2]) < 3e-4:
                break
        rms = float(np.sqrt((residual**2).mean()))
        # A floor under the covariance: neighbouring beams share their errors (normals, discretisation).
        scale = max(p.range_noise, rms) ** 2 * 4
        inverted = np.linalg.inv(hessian + 1e-3 * np.eye(3))
        covariance = np.asarray(scale * inverted + np.diag([1e-5, 1e-5, 1e-6]), dtype=np.float64)
        return ScanMatch((float(pose[0]), float(pose[1]), wrap(float(pose[2]))), covariance, rms)

    def keep(self, points: NDArray[np.float64], pose: Pose) -> bool:
        """Keep the scan as a keyframe if the robot has moved far enough since the nearest one."""
        p = self.params
        for other, _, _ in reversed(self._keyframes):
            near = np.hypot(other[0] - pose[0], other[1] - pose[1]) < p.keyframe_distance
            if near and abs(wrap(other[2] - pose[2])) < p.keyframe_angle:
                return False
        normals, valid = scan_normals(points)
        if int(valid.sum()) < p.min_pairs:
            return False
        turned = (0.0, 0.0, pose[2])
        self._keyframes.append((pose, transform(pose, points[valid]), transform(turned, normals[valid])))
        del self._keyframes[: -p.keyframes]
        self._points = np.concatenate([frame[1] for frame in self._keyframes])
        self._normals = np.concatenate([frame[2] for frame in self._keyframes])
        self._tree = cKDTree(self._points)
        return True


def scan_normals(points: NDArray[np.float64], max_gap: float = 0.5) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return unit normals (N, 2) of an ordered scan and which of them can be trusted (N,).

    A normal is perpendicular to the chord between a point's neighbours; it is trusted where both neighbours are within
    ``max_gap`` metres and lie on a line with the point (corners are left out).
    """
    before, after = np.roll(points, 1, axis=0), np.roll(points, -1, axis=0)
    chord = after - before
    length = np.linalg.norm(chord, axis=1)
    tangent = chord / np.maximum(length, 1e-9)[:, None]
    normals = np.column_stack([-tangent[:, 1], tangent[:, 0]])
    left, right = np.linalg.norm(points - before, axis=1), np.linalg.norm(after - points, axis=1)
    bend = np.abs(((points - before) * normals).sum(axis=1))
    valid = (left < max_gap) & (right < max_gap) & (bend < 0.15 * np.minimum(left, right) + 0.02) & (length > 1e-6)
    return normals, valid

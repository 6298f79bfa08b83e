"""An occupancy grid from lidar scans and labelled camera points.

Two log-odds layers, because the sensors see different things: the lidar's plane passes over low boxes, so its free
space must not erase what the camera saw there. The published map is the worse of the two.

Source: Moravec and Elfes, "High Resolution Maps from Wide Angle Sonar", 1985; Thrun, Burgard and Fox, "Probabilistic
Robotics", 2005, ch. 9.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robotbrain.pipeline.geometry import Pose, transform
from robotbrain.pipeline.grid import UNKNOWN, GridFrame


@dataclass(frozen=True)
class MapParams:
    """Sensor models of the two layers, as log-odds added per observation.

    Attributes:
        hit, miss: lidar evidence for an obstacle and against one.
        camera_hit, camera_miss: camera evidence, per frame in which a cell is seen.
        limit: log-odds stay within [-limit, limit], so that a moved box can be forgotten.
        lidar_range: farther returns clear space up to here but mark nothing, m.
        camera_range: farther camera points are ignored (a pixel covers too much floor), m.
    """

    hit: float = 1.2
    miss: float = 0.4
    camera_hit: float = 0.9
    camera_miss: float = 0.5
    limit: float = 4.0
    lidar_range: float = 6.0
    camera_range: float = 3.0


class OccupancyMapper:
    """Accumulates observations into an occupancy grid.

    Args:
        frame: where the grid lies in the map frame.
        params: sensor models.

    Attributes:
        written: points, free and occupied, that the last observation brought (the mapper's unit of CPU work).
    """

    def __init__(self, frame: GridFrame, params: MapParams | None = None) -> None:
        self.frame = frame
        self.params = params or MapParams()
        self.written = 0
        self._lidar = np.zeros(frame.shape, dtype=np.float32)
        self._camera = np.zeros(frame.shape, dtype=np.float32)
        self._lidar_seen = np.zeros(frame.shape, dtype=bool)
        self._camera_seen = np.zeros(frame.shape, dtype=bool)
        self._owner = np.zeros(frame.shape[0] * frame.shape[1], dtype=np.int64)

    def add_scan(self, pose: Pose, ranges: NDArray[np.float64], angles: NDArray[np.float64]) -> None:
        """Add one lidar scan.

        Args:
            pose: of the lidar in the map frame when the scan was taken.
            ranges: (N,) m, all around; inf where nothing returned, NaN where the beam is invalid. A lone inf between
                two returns is taken for a lost echo, not for open space.
            angles: (N,) rad, counter-clockwise from the lidar's x axis.
        """
        step = 0.7 * self.frame.resolution
        # REP 117: +inf is no return; -inf (too near to measure) says nothing about what is free.
        ranges = np.where(np.isneginf(ranges), np.nan, ranges)
        silent = np.isinf(ranges)
        lost = silent & ~np.roll(silent, 1) & ~np.roll(silent, -1)
        ranges = np.where(lost, np.nan, ranges)
        reach = np.where(np.isinf(ranges), self.params.lidar_range, ranges)
        valid = np.isfinite(reach)
        reach, angles = np.minimum(reach[valid], self.params.lidar_range), angles[valid]
        hit = ranges[valid] <= self.params.lidar_range
        directions = np.stack([np.cos(angles), np.sin(angles)], axis=1)
        samples = np.arange(0.0, self.params.lidar_range, step)
        # Stop a cell short of the return, so that a beam never clears the cell it ends in.
        along = samples[None, :] < (reach - self.frame.resolution)[:, None]
        beam, sample = np.nonzero(along)
        free = transform(pose, directions[beam] * samples[sample, None])
        ends = transform(pose, directions[hit] * (reach[hit] + 0.2 * self.frame.resolution)[:, None])
        self._update(self._lidar, self._lidar_seen, free, ends, self.params.miss, self.params.hit)

    def add_points(self, pose: Pose, floor: NDArray[np.float64], obstacles: NDArray[np.float64]) -> None:
        """Add labelled camera points, both (N, 2) in the frame of ``pose``, m."""
        near = self.params.camera_range
        floor = floor[np.hypot(floor[:, 0], floor[:, 1]) < near]
        obstacles = obstacles[np.hypot(obstacles[:, 0], obstacles[:, 1]) < near]
        self._update(
            self._camera,
            self._camera_seen,
            transform(pose, floor),
            transform(pose, obstacles),
            self.params.camera_miss,
            self.params.camera_hit,
        )

    def occupancy(self) -> NDArray[np.int8]:
        """Return the (H, W) occupancy in percent, -1 where nothing was observed."""
        odds = np.where(self._lidar_seen, self._lidar, -np.inf)
        odds = np.maximum(odds, np.where(self._camera_seen, self._camera, -np.inf))
        percent = np.rint(100.0 / (1.0 + np.exp(-odds))).astype(np.int8)
        percent[~(self._lidar_seen | self._camera_seen)] = UNKNOWN
        return percent

    def _update(
        self,
        layer: NDArray[np.float32],
        seen: NDArray[np.bool_],
        free: NDArray[np.float64],
        occupied: NDArray[np.float64],
        miss: float,
        hit: float,
    ) -> None:
        """Count each cell once per observation; an occupied verdict wins over a free one."""
        self.written = len(free) + len(occupied)
        cells_free, cells_occupied = self._flat(free), self._flat(occupied)
        cells = np.concatenate([cells_free, cells_occupied])
        order = np.arange(len(cells))
        # Every cell remembers who wrote last; obstacles write after free space, so they win, and each cell counts once.
        self._owner[cells] = order
        last = self._owner[cells] == order
        touched = cells[last]
        change = np.where(order[last] < len(cells_free), np.float32(-miss), np.float32(hit))
        flat = layer.reshape(-1)
        flat[touched] = np.clip(flat[touched] + change, -self.params.limit, self.params.limit)
        seen.reshape(-1)[touched] = True

    def _flat(self, points: NDArray[np.float64]) -> NDArray[np.intp]:
        cells = self.frame.to_cells(points)
        cells = cells[self.frame.inside(cells)]
        return cells[:, 0] * self.frame.shape[1] + cells[:, 1]

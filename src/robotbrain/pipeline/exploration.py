"""Where to look and where the goal is: memory of what the camera has viewed, and a tracker of the marker."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from robotbrain.pipeline.geometry import Pose, wrap_angle
from robotbrain.pipeline.grid import OCCUPIED_FROM, UNKNOWN, GridFrame


@dataclass(frozen=True)
class ViewParams:
    """How the camera views the floor.

    Attributes:
        half_angle: half of the horizontal field of view that is relied on, rad.
        reach: distance up to which a marker would be recognised, m.
        clearance: candidates for the next view keep this far from obstacles, m.
        block: candidates are taken from blocks of this many cells a side.
        underfoot: cells this near to the robot count as viewed, m.
        turn_cost: metres of detour that one radian of turning is worth.
    """

    half_angle: float = 0.6
    reach: float = 4.5
    clearance: float = 0.3
    block: int = 5
    underfoot: float = 0.5
    turn_cost: float = 0.35


class ViewMemory:
    """Which free cells the camera has looked at, and where to look next.

    Args:
        frame: grid of the map.
        params: the camera's reach.

    Attributes:
        looked: cells that the last :meth:`look` went through (its unit of CPU work).
        searched: cells that the last :meth:`next_target` went through.
    """

    def __init__(self, frame: GridFrame, params: ViewParams | None = None) -> None:
        self.frame = frame
        self.params = params or ViewParams()
        self.reach = self.params.reach
        self.looked = self.searched = 0
        self.viewed = np.zeros(frame.shape, dtype=bool)
        self._rejected = np.zeros(frame.shape, dtype=bool)

    def look(self, pose: Pose, occupancy: NDArray[np.int8]) -> None:
        """Mark the cells in the camera's field of view that no occupied cell hides."""
        p = self.params
        # Dense enough that no cell falls between two rays, even at the far end.
        rays = int(np.ceil(2 * p.half_angle * self.reach / self.frame.resolution)) + 1
        angles = pose[2] + np.linspace(-p.half_angle, p.half_angle, rays)
        along = np.arange(0.0, self.reach, 0.7 * self.frame.resolution)
        points = (
            np.asarray(pose[:2]) + along[None, :, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)[:, None, :]
        )
        cells = self.frame.to_cells(points)
        self.looked = cells.size // 2
        inside = self.frame.inside(cells)
        rows = np.clip(cells[..., 0], 0, self.frame.shape[0] - 1)
        columns = np.clip(cells[..., 1], 0, self.frame.shape[1] - 1)
        blocked = (occupancy[rows, columns] >= OCCUPIED_FROM) | ~inside
        visible = ~np.maximum.accumulate(blocked, axis=1)
        self.viewed[rows[visible], columns[visible]] = True
        # Where the robot stands there is nothing to look for; a target underfoot could never be faced.
        self._around(self.viewed, pose[0], pose[1], p.underfoot)

    def moved_to(self, frame: GridFrame) -> ViewMemory:
        """Return this memory on another grid, as when a mapper grows its map; new cells count as not viewed."""
        moved = ViewMemory(frame, self.params)
        moved.reach = self.reach
        for old, new in ((self.viewed, moved.viewed), (self._rejected, moved._rejected)):
            cells = frame.to_cells(self.frame.to_points(np.argwhere(old)))
            cells = cells[frame.inside(cells)]
            new[cells[:, 0], cells[:, 1]] = True
        return moved

    def look_again(self) -> None:
        """Forget what was viewed and trust the camera less far: the marker was missed, so look again, from nearer."""
        self.viewed[:] = False
        self._rejected[:] = False
        self.reach = max(0.6 * self.reach, 1.5)

    def reject(self, x: float, y: float, radius: float = 0.4) -> None:
        """Never propose targets within ``radius`` metres of a point that turned out to be unreachable."""
        self._around(self._rejected, x, y, radius)

    def _around(self, grid: NDArray[np.bool_], x: float, y: float, radius: float) -> None:
        reach = int(radius / self.frame.resolution)
        row, column = self.frame.to_cell(x, y)
        rows = slice(max(row - reach, 0), max(row + reach + 1, 0))
        grid[rows, max(column - reach, 0) : max(column + reach + 1, 0)] = True

    def next_target(self, pose: Pose, occupancy: NDArray[np.int8]) -> tuple[float, float] | None:
        """Return the most worthwhile reachable point that the camera has not viewed, x, y in m; None if all is viewed.

        Only cells known to be free, connected to the robot and clear of obstacles count. Near points are preferred, and
        points ahead over points behind.
        """
        p = self.params
        known = occupancy != UNKNOWN
        self.searched = 0
        rows, columns = np.flatnonzero(known.any(axis=1)), np.flatnonzero(known.any(axis=0))
        if rows.size == 0:
            return None
        top, left = int(rows.min()), int(columns.min())
        window = (slice(top, int(rows.max()) + 1), slice(left, int(columns.max()) + 1))
        grid = occupancy[window]
        self.searched = grid.size
        obstacle = grid >= OCCUPIED_FROM
        distance = ndimage.distance_transform_edt(~obstacle) if obstacle.any() else np.full(grid.shape, np.inf)
        open_cells = (grid != UNKNOWN) & (np.asarray(distance) * self.frame.resolution > p.clearance)
        row, column = self.frame.to_cell(pose[0], pose[1])
        row, column = row - top, column - left
        # The robot may stand within the clearance; it can still leave.
        reach = int(0.3 / self.frame.resolution)
        near = np.zeros_like(open_cells)
        near[max(row - reach, 0) : max(row + reach + 1, 0), max(column - reach, 0) : max(column + reach + 1, 0)] = True
        open_cells |= near & ~obstacle
        labels, _ = ndimage.label(open_cells)
        here = labels[min(max(row, 0), labels.shape[0] - 1), min(max(column, 0), labels.shape[1] - 1)]
        if here == 0:
            return None
        wanted = (labels == here) & ~self.viewed[window] & ~self._rejected[window]
        # Blocks that are mostly unviewed: single cells in corners are not worth a trip.
        b = p.block
        height, width = (wanted.shape[0] // b) * b, (wanted.shape[1] // b) * b
        if height == 0 or width == 0:
            return None
        share = wanted[:height, :width].reshape(height // b, b, width // b, b).mean(axis=(1, 3))
        blocks = np.argwhere(share > 0.5)
        if len(blocks) == 0:
            return None
        points = self.frame.to_points(blocks * b + (b - 1) / 2 + np.array([top, left]))
        offset = points - np.asarray(pose[:2])
        turn = np.abs(wrap_angle(np.arctan2(offset[:, 1], offset[:, 0]) - pose[2]))
        cost = np.hypot(offset[:, 0], offset[:, 1]) + p.turn_cost * turn
        block = blocks[int(np.argmin(cost))] * b
        # The block's middle may have been viewed; its wanted cell nearest to the middle was not.
        cells = np.argwhere(wanted[block[0] : block[0] + b, block[1] : block[1] + b])
        nearest = cells[int(np.argmin(((cells - (b - 1) / 2) ** 2).sum(axis=1)))]
        x, y = self.frame.to_points(block + nearest + np.array([top, left]))
        return float(x), float(y)


@dataclass(eq=False)
class _Track:
    position: NDArray[np.float64]
    information: float
    hits: int


class MarkerTracker:
    """Fuses sightings of the goal marker into one position in the map frame.

    Sightings near a track refine it by inverse-variance weighting; a track counts once it has been seen ``confirm``
    times. The spread of a sighting grows with its range.

    Args:
        gate: sightings within this distance of a track belong to it, m.
        confirm: sightings needed.
    """

    def __init__(self, gate: float = 0.8, confirm: int = 5) -> None:
        self.gate = gate
        self.confirm = confirm
        self._tracks: list[_Track] = []
        self._mistakes: list[NDArray[np.float64]] = []

    def add(self, position: ArrayLike, distance: float) -> None:
        """Add a sighting.

        Args:
            position: (2,) x, y in the map frame, m.
            distance: from the camera, m.
        """
        point = np.asarray(position, dtype=float)
        if any(float(np.linalg.norm(mistake - point)) < self.gate for mistake in self._mistakes):
            return
        information = 1.0 / (0.05 + 0.06 * distance) ** 2
        nearest = min(self._tracks, key=lambda t: float(np.linalg.norm(t.position - point)), default=None)
        if nearest is None or float(np.linalg.norm(nearest.position - point)) > self.gate:
            self._tracks.append(_Track(point, information, 1))
            return
        # Old sightings fade, so that near, exact ones soon outweigh many far ones.
        nearest.information *= 0.95
        total = nearest.information + information
        nearest.position = nearest.position + (information / total) * (point - nearest.position)
        nearest.information = total
        nearest.hits += 1

    def discard(self) -> None:
        """Give up the track that :meth:`estimate` returns, and ignore sightings there from now on."""
        best = max(self._tracks, key=lambda t: t.hits, default=None)
        if best is not None:
            self._tracks.remove(best)
            self._mistakes.append(best.position)

    def forgive(self) -> None:
        """Take sightings everywhere seriously again."""
        self._mistakes.clear()

    def estimate(self) -> tuple[float, float] | None:
        """Return the position of the track seen most often, x, y in m; None until one is confirmed."""
        best = max(self._tracks, key=lambda t: t.hits, default=None)
        if best is None or best.hits < self.confirm:
            return None
        return float(best.position[0]), float(best.position[1])

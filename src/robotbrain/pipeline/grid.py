"""A metric grid: where its cells lie in the world, and nothing else.

Cells are indexed ``(row, column)``; rows grow with y, columns with x, as in ``nav_msgs/OccupancyGrid``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robotbrain.errors import InputError

UNKNOWN = -1
"""Value of an occupancy grid (``nav_msgs/OccupancyGrid``) where nothing is known; elsewhere it is percent."""

OCCUPIED_FROM = 65
"""Occupancy in percent from which a cell counts as an obstacle (the default of Nav2's static layer)."""

Cell = tuple[int, int]


@dataclass(frozen=True)
class GridFrame:
    """Placement of a grid in the map frame.

    Attributes:
        resolution: side of a cell, m.
        origin: (x, y) of the outer corner of cell (0, 0), m.
        shape: (rows, columns).
    """

    resolution: float
    origin: tuple[float, float]
    shape: tuple[int, int]

    def __post_init__(self) -> None:
        if not (np.isfinite(self.resolution) and self.resolution > 0):
            raise InputError(
                "grid resolution",
                given=self.resolution,
                expected="a positive number of metres per cell",
                fix="Pass resolution in metres, for example 0.05.",
            )

    @classmethod
    def centred(cls, half_extent: float, resolution: float) -> GridFrame:
        """Return a square frame that covers [-half_extent, half_extent] m on both axes."""
        cells = 2 * int(np.ceil(half_extent / resolution))
        corner = -cells * resolution / 2
        return cls(resolution, (corner, corner), (cells, cells))

    def to_cells(self, xy: ArrayLike) -> NDArray[np.intp]:
        """Return the (..., 2) row, column of (..., 2) points x, y in metres; may lie outside the grid."""
        points = np.asarray(xy, dtype=float)
        cells = np.floor((points - np.asarray(self.origin)) / self.resolution).astype(np.intp)
        return np.asarray(cells[..., ::-1])

    def to_cell(self, x: float, y: float) -> Cell:
        """Return the (row, column) of one point in metres."""
        # The same formula as to_cells: floor division rounds otherwise on the borders between cells.
        if not (math.isfinite(x) and math.isfinite(y)):
            raise InputError(
                "point", given=(x, y), expected="finite x, y in metres", fix="Check the pose or goal it came from."
            )
        return (
            math.floor((y - self.origin[1]) / self.resolution),
            math.floor((x - self.origin[0]) / self.resolution),
        )

    def to_points(self, cells: ArrayLike) -> NDArray[np.float64]:
        """Return the centres x, y in metres, (..., 2), of (..., 2) row, column cells."""
        index = np.asarray(cells, dtype=float)
        return np.asarray(self.origin) + (index[..., ::-1] + 0.5) * self.resolution

    def inside(self, cells: ArrayLike) -> NDArray[np.bool_]:
        """Return which of the (..., 2) cells lie in the grid."""
        index = np.asarray(cells)
        row, column = index[..., 0], index[..., 1]
        return np.asarray((row >= 0) & (row < self.shape[0]) & (column >= 0) & (column < self.shape[1]))

    def contains(self, cell: Cell) -> bool:
        """Return whether one cell lies in the grid."""
        return 0 <= cell[0] < self.shape[0] and 0 <= cell[1] < self.shape[1]

"""Occupancy grids as messages and back, with the kit's ``GridFrame``."""

from __future__ import annotations

from typing import Any

import numpy as np
from nav_msgs.msg import OccupancyGrid
from numpy.typing import NDArray

from robotbrain.pipeline.grid import GridFrame
from robotbrain.ros.conversions import grid_to_numpy, numpy_to_grid


def grid_from_msg(msg: OccupancyGrid) -> tuple[NDArray[np.int8], GridFrame]:
    """Return the (rows, columns) occupancy of a map and where its cells lie."""
    grid = grid_to_numpy(msg)
    rows, columns = grid.cells.shape
    return grid.cells, GridFrame(grid.resolution, (grid.origin[0], grid.origin[1]), (rows, columns))


def grid_to_msg(occupancy: NDArray[np.int8], frame: GridFrame, stamp: Any, frame_id: str = "map") -> OccupancyGrid:
    """Return an occupancy grid as a message."""
    return numpy_to_grid(occupancy, frame.resolution, frame.origin, stamp=stamp, frame_id=frame_id)

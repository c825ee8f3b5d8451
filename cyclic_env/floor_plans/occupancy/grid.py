"""Occupancy grids, and the drawing of floor plans as grids."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import shapely
from scipy import ndimage

from cyclic_env.errors import FloorPlanError
from cyclic_env.floor_plans.floor_plan import COORDINATE_MAX, FloorPlan, Pose
from cyclic_env.validation import short_repr

FREE, OCCUPIED, UNKNOWN = 0, 100, -1
"""Values of a cell, as in ``nav_msgs/OccupancyGrid``; values between the first two are percentages."""

FREE_BELOW = 50
"""Percentage below which a cell counts as free, because it is more likely free than occupied."""

RESOLUTION_MIN = 1e-6
"""Metres per pixel; floor plans are written to the micrometre."""

CELLS_MAX = 64_000_000
"""Greatest number of pixels of an image; tracing so many takes some 3 GB of memory."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class OccupancyGrid:
    """A map of square cells, like ``nav_msgs/OccupancyGrid``, with the other contents of its file.

    Parameters
    ----------
    cells : (rows, columns) int8
        Percentage of occupancy, 0 (free) to 100 (occupied), or -1 (unknown). Row 0 has the lowest y.
    resolution : float
        Side of a cell, metres.
    origin : (x, y, yaw)
        World pose of the outer corner of cell (0, 0), metres and radians. Rows and columns are turned about it by
        `yaw`, counter-clockwise.
    name, title, source, licence : str
        As in a `FloorPlan`.
    start : (x, y, heading), optional
        World pose at which the robot starts.
    doubtful : int
        Number of cells that the thresholds make unknown although their shade says that they are more likely free.

    Raises
    ------
    FloorPlanError
        If there are no cells or too many, or the resolution is out of range.
    """

    cells: np.ndarray
    resolution: float
    origin: Pose = (0.0, 0.0, 0.0)
    name: str = "unnamed"
    title: str = ""
    source: str = ""
    licence: str = ""
    start: Pose | None = None
    doubtful: int = 0

    def __post_init__(self) -> None:
        if self.cells.ndim != 2:
            raise FloorPlanError(f"an occupancy grid has rows and columns, got an array of shape {self.cells.shape}.")
        check_size(*self.cells.shape)
        check_resolution(self.resolution)

    @property
    def free(self) -> np.ndarray:
        """Which cells are free, `(rows, columns)` bool; unknown cells are not."""
        return (self.cells >= FREE) & (self.cells < FREE_BELOW)

    def to_world(self, points: np.ndarray) -> np.ndarray:
        """Convert points `(n, 2)`, as column and row from the grid's outer corner, to x and y in metres."""
        x, y, yaw = self.origin
        across, up = self.resolution * np.asarray(points, dtype=float).T
        return np.stack(
            [x + math.cos(yaw) * across - math.sin(yaw) * up, y + math.sin(yaw) * across + math.cos(yaw) * up], axis=1
        )

    def to_grid(self, points: np.ndarray) -> np.ndarray:
        """Convert world points `(n, 2)`, metres, to column and row from the grid's outer corner."""
        x, y, yaw = self.origin
        east, north = (np.asarray(points, dtype=float) - (x, y)).T / self.resolution
        return np.stack(
            [math.cos(yaw) * east + math.sin(yaw) * north, math.cos(yaw) * north - math.sin(yaw) * east], axis=1
        )


def check_resolution(resolution: float) -> None:
    """Raise a `FloorPlanError` unless the size of a pixel, in metres, is in range."""
    if not RESOLUTION_MIN <= resolution <= COORDINATE_MAX:
        raise FloorPlanError(
            f"resolution: expected metres per pixel, from {RESOLUTION_MIN:g} to {COORDINATE_MAX:g}, "
            f"got {short_repr(resolution)}."
        )


def check_size(height: int, width: int) -> None:
    """Raise a `FloorPlanError` unless the number of an image's pixels is in range."""
    if not 0 < height * width <= CELLS_MAX:
        raise FloorPlanError(
            f"the image has {width:,} x {height:,} pixels; a map has from 1 to {CELLS_MAX / 1e6:g} million: make it "
            "smaller or cut it into parts."
        )


def rasterize(plan: FloorPlan, resolution: float) -> OccupancyGrid:
    """Draw a floor plan as a grid: cells with their centre in free space, a wall one cell thick, unknown space beyond.

    A wall too thin to contain the centre of a cell is still drawn one cell thick.

    Parameters
    ----------
    plan : FloorPlan
    resolution : float
        Side of a cell, metres.

    Raises
    ------
    FloorPlanError
        If the resolution is out of range, or gives too many cells or no free one.
    """
    check_resolution(resolution)
    west, south, east, north = plan.bounds
    x, y = (resolution * (math.floor(low / resolution) - 2) for low in (west, south))
    columns, rows = (math.ceil((high - low) / resolution) + 2 for low, high in ((x, east), (y, north)))
    check_size(rows, columns)
    free = _inside(plan.walls - (x, y, x, y), resolution, (rows, columns))
    free[_thin_walls(plan, resolution, (x, y))] = False
    if not free.any():
        raise FloorPlanError(
            f"resolution: at {resolution:g} m per pixel {plan.name!r} has no free cell; give a smaller one."
        )
    cells = np.full(free.shape, UNKNOWN, np.int8)
    cells[ndimage.binary_dilation(free, np.ones((3, 3), dtype=int))] = OCCUPIED
    cells[free] = FREE
    about = {name: getattr(plan, name) for name in ("name", "title", "source", "licence", "start")}
    return OccupancyGrid(cells=cells, resolution=resolution, origin=(x, y, 0.0), **about)


def _inside(walls: np.ndarray, resolution: float, shape: tuple[int, int]) -> np.ndarray:
    """Return which cells have their centre inside closed rings of walls `(W, 4)`: an odd number is to the west."""
    x1, y1, x2, y2 = (walls / resolution - 0.5).T  # centres of cells have integer coordinates
    first = np.ceil(np.minimum(y1, y2)).astype(int)
    count = np.ceil(np.maximum(y1, y2)).astype(int) - first  # rows first ... first + count - 1 cross the wall
    wall = np.repeat(np.arange(len(walls)), count)
    row = np.arange(len(wall)) - np.repeat(np.cumsum(count) - count, count) + first[wall]
    across = x1[wall] + (row - y1[wall]) * (x2 - x1)[wall] / (y2 - y1)[wall]
    crossings = np.zeros(shape, np.uint8)
    np.add.at(crossings, (row, np.ceil(across).astype(int)), 1)
    return np.bitwise_and(np.cumsum(crossings, axis=1, dtype=np.uint8), 1).astype(bool)


def _thin_walls(plan: FloorPlan, resolution: float, corner: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Return rows and columns of the cells on walls that have free space less than a cell behind them."""
    start, way = plan.walls[:, :2], plan.walls[:, 2:] - plan.walls[:, :2]
    length = np.hypot(*way.T)
    count = np.ceil(4 * length / resolution).astype(int)
    wall = np.repeat(np.arange(len(count)), count)
    share = (np.arange(len(wall)) - np.repeat(np.cumsum(count) - count, count) + 0.5) / count[wall]
    points = start[wall] + share[:, None] * way[wall]
    behind = points + resolution * (way[:, ::-1] * (1, -1) / length[:, None])[wall]  # free space is on the left
    thin = shapely.contains_xy(plan.prepared_space(), behind)
    column, row = ((points[thin] - corner) / resolution).astype(int).T
    return row, column

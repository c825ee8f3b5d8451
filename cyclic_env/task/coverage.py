"""What the laser has seen of a building: the cells of free space that a beam has passed through.

A cell counts when its centre is in free space. A scan marks the cells that its true, noise-free beams pass
through on their way to a wall, or to the end of the laser's reach. The scan at the reset marks cells, and so does one
after every further `scan_spacing` of path.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import shapely

from cyclic_env.config import CoverageConfig, LaserConfig
from cyclic_env.errors import FloorPlanError
from cyclic_env.floor_plans import FloorPlan
from cyclic_env.jit import compiled
from cyclic_env.simulation.lidar import laser_beams, scan_row
from cyclic_env.simulation.wall_index import GRID, build_wall_index, joined_grids

CELLS_MAX = 20_000_000
"""Largest number of cells of a plan; they take a gigabyte while they are built."""

ROUNDING = 1e-9
"""Cells. A beam that ends at a wall on a grid line must not enter the cell behind it by rounding."""

LATTICE_SPACINGS = (2.0, 1.0, 0.5)
"""Metres between the positions from which `visible_share` looks around."""

REACH_MIN = 4.0
"""Metres. Scans of such a reach overlap on each of these lattices."""


class CoverageGrid(NamedTuple):
    """The cells of a pool of P plans, and which of them each of N robots has seen.

    Attributes
    ----------
    cell_size : float
    grids : (P,) GRID
        The cells of each plan, and a ring of spare ones around them.
    number : (cells,) int32
        Each cell's index among the free cells of its plan; -1 where the centre is not free.
    cells_total : (P,) int64
        Number of free cells of each plan.
    seen : (N, most free cells) bool
    """

    cell_size: float
    grids: np.ndarray
    number: np.ndarray
    cells_total: np.ndarray
    seen: np.ndarray


def build_coverage_grid(plan: FloorPlan, num_robots: int, config: CoverageConfig) -> CoverageGrid:
    """Divide a plan into cells, none of them seen yet.

    Raises
    ------
    FloorPlanError
        If it has too many cells, or is so small that it has none.
    """
    size = float(config.cell_size)
    west, south, east, north = plan.bounds
    # With a ring of spare cells, so that no beam leaves the grid.
    west, south = west - size, south - size
    columns, rows = math.ceil((east - west) / size) + 1, math.ceil((north - south) / size) + 1
    if columns * rows > CELLS_MAX:
        raise FloorPlanError(
            f"floor plan {plan.name!r} has {columns} x {rows} cells of {size:g} m; make cell_size larger, "
            f"for at most {CELLS_MAX}."
        )
    x, y = np.meshgrid(west + size * (np.arange(columns) + 0.5), south + size * (np.arange(rows) + 0.5))
    free = shapely.contains_xy(plan.prepared_space(), x.ravel(), y.ravel())
    if not free.any():
        raise FloorPlanError(
            f"floor plan {plan.name!r} has no free cell of {size:g} m; make it larger or cell_size smaller."
        )
    total = int(free.sum())
    return CoverageGrid(
        cell_size=size,
        grids=np.array([(west, south, columns, rows, 0)], GRID),
        number=np.where(free, np.cumsum(free) - 1, -1).astype(np.int32),
        cells_total=np.array([total], np.int64),
        seen=np.zeros((num_robots, total), np.bool_),
    )


def joined_coverage_grid(grid: CoverageGrid, others: CoverageGrid) -> CoverageGrid:
    """Return the cells of both pools of plans, those of `others` last; what has been seen of the first pool is kept."""
    seen = grid.seen
    if seen.shape[1] < others.seen.shape[1]:
        seen = np.zeros_like(others.seen)
        seen[:, : grid.seen.shape[1]] = grid.seen
    return CoverageGrid(
        cell_size=grid.cell_size,
        grids=joined_grids(grid.grids, others.grids, len(grid.number)),
        number=np.concatenate([grid.number, others.number]),
        cells_total=np.concatenate([grid.cells_total, others.cells_total]),
        seen=seen,
    )


def seen_cells(grid: CoverageGrid, row: int, plan: int) -> np.ndarray:
    """Return what a robot has seen as a picture `(rows, columns)` int8, south first: -1 not free, 0 unseen, 1 seen."""
    _, _, columns, rows, first = grid.grids[plan]
    number = grid.number[first : first + columns * rows].reshape(rows, columns)[1:-1, 1:-1]
    return np.where(number < 0, -1, grid.seen[row][number]).astype(np.int8)


@compiled
def mark_scan(grid, plan, row, pose, beams, ranges):
    """Mark the cells that the beams of a scan pass through as seen by a robot; return how many are new.

    Parameters
    ----------
    grid : CoverageGrid
        `seen` is written to.
    plan, row : int
        The plan that the robot is in, and its row of `seen`.
    pose : tuple of 3 floats
        x, y and heading of the scan, metres and radians.
    beams : Beams
    ranges : (num_beams,) float64
        Where each beam ends, metres.
    """
    x, y, heading = pose
    cells, size, directions = grid.grids[plan], grid.cell_size, beams.directions
    cos, sin = math.cos(heading), math.sin(heading)
    # In units of a cell, from the grid's corner.
    start_x, start_y = (x - cells.west) / size, (y - cells.south) / size
    column, line = int(start_x), int(start_y)
    start = (start_x - column, start_y - line, cells.first + line * cells.columns + column)
    seen, new = grid.seen[row], 0
    for beam in range(ranges.shape[0]):
        ux = cos * directions[0, beam] - sin * directions[1, beam]
        uy = sin * directions[0, beam] + cos * directions[1, beam]
        reach = ranges[beam] / size - ROUNDING
        new += _mark_beam(grid.number, seen, cells.columns, start, (ux, uy), reach)
    return new


@compiled
def _mark_beam(number, seen, columns, start, direction, reach):
    """Mark the cells that one beam passes through; return how many are new.

    `start` is where the beam begins: how far from the west and south side of its cell, and the cell's index. These and
    `reach` are in units of a cell.
    """
    (from_west, from_south, i), (ux, uy) = start, direction
    # The beam enters the next column after next_x, and one more after every per_column; the same goes for rows.
    per_column = 1 / abs(ux) if ux != 0 else math.inf
    per_row = 1 / abs(uy) if uy != 0 else math.inf
    next_x, next_y = math.inf, math.inf
    if ux != 0:
        next_x = ((1 - from_west) if ux > 0 else from_west) * per_column
    if uy != 0:
        next_y = ((1 - from_south) if uy > 0 else from_south) * per_row
    column_step, row_step = (1 if ux > 0 else -1), (columns if uy > 0 else -columns)
    new = 0
    while True:
        cell = number[i]
        if cell >= 0 and not seen[cell]:
            seen[cell] = True
            new += 1
        if min(next_x, next_y) >= reach:
            return new
        if next_x < next_y:
            i += column_step
            next_x += per_column
        else:
            i += row_step
            next_y += per_row


def visible_share(plan: FloorPlan, robot_radius: float, range_max: float, config: CoverageConfig) -> float:
    """Return the share of the free cells that a robot can see from the positions that it can reach.

    It scans all around from ever finer lattices of reachable positions until `config.complete` is seen, and the share
    is then a lower bound. A laser that reaches less far than `REACH_MIN` is taken to reach that far.
    """
    laser = LaserConfig(range_max=max(range_max, REACH_MIN))
    beams, walls = laser_beams(laser), build_wall_index(plan, laser.range_max)
    scratch, ranges = np.empty(2 * laser.num_beams), np.empty(laser.num_beams)
    grid, area = build_coverage_grid(plan, 1, config), plan.reachable(robot_radius)
    shapely.prepare(area)
    west, south, east, north = area.bounds
    seen = _mark_from(walls, grid, np.array([plan.start[:2]]), beams, scratch, ranges)
    for spacing in LATTICE_SPACINGS:
        if seen < config.complete * grid.cells_total[0]:
            x, y = np.meshgrid(np.arange(west, east, spacing), np.arange(south, north, spacing))
            positions = np.column_stack([x.ravel(), y.ravel()])
            reached = positions[shapely.contains_xy(area, positions[:, 0], positions[:, 1])]
            seen += _mark_from(walls, grid, reached, beams, scratch, ranges)
    return float(seen / grid.cells_total[0])


@compiled
def _mark_from(walls, grid, positions, beams, scratch, ranges):
    """Mark the cells that scans from `positions` (n, 2) see; return how many are new."""
    new = 0
    for i in range(positions.shape[0]):
        pose = (positions[i, 0], positions[i, 1], 0.0)
        scan_row(walls, 0, pose, beams, scratch, ranges)
        new += mark_scan(grid, 0, 0, pose, beams, ranges)
    return new

"""What the laser has seen of a building: the cells of free space that a beam has passed.

A cell counts when its centre is in free space. A scan marks the cells that its true, noise-free beams pass
through on their way to the wall (or to the end of the laser's reach); scans mark at the reset and at every
further `scan_spacing` of path.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import shapely

from cyclic_env.config import CoverageConfig
from cyclic_env.errors import FloorPlanError
from cyclic_env.floor_plans import FloorPlan
from cyclic_env.jit import compiled
from cyclic_env.simulation.wall_index import GRID, joined_grids

CELLS_MAX = 20_000_000
"""Most cells of a plan: a gigabyte while they are built."""

ROUNDING = 1e-9
"""Cells. A beam that ends at a wall on a grid line must not enter the cell behind it by rounding."""


class CoverageGrid(NamedTuple):
    """The cells of a pool of P plans, and which of them each of N robots has seen.

    Attributes
    ----------
    cell_size : float
    grids : (P,) GRID
        The cells of each plan, and a ring of spare ones around them.
    number : (cells,) int32
        Each cell's place among the free cells of its plan; -1 where the centre is not free.
    cells_total : (P,) int64
        How many free cells each plan has.
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
        If it has too many cells, or is so small that no cell's centre is free.
    """
    size = float(config.cell_size)
    west, south, east, north = plan.bounds
    # With a ring of spare cells, so that no beam's way needs watching for the grid's end.
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
    """Return the cells of both pools of plans, those of `others` last, and what the robots have seen in the first."""
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
def mark_scan(squares, size, number, seen, x, y, heading, directions, ranges):
    """Mark the cells that the beams of a scan from (x, y, heading) pass through; return how many are new.

    Parameters
    ----------
    squares : GRID record
        The cells of the plan.
    size : float
        Side of a cell, metres.
    number : (cells,) int32
        As in `CoverageGrid`.
    seen : (free cells,) bool
        Of one robot; written to.
    x, y, heading : float
    directions : (2, >= num_beams) float64
        Unit vectors of the beams in the robot's frame.
    ranges : (num_beams,) float64
        Where each beam ends, metres.
    """
    columns = squares.columns
    cos, sin = math.cos(heading), math.sin(heading)
    # In units of a cell, from the grid's corner.
    start_x, start_y = (x - squares.west) / size, (y - squares.south) / size
    column, row = int(start_x), int(start_y)
    start = squares.first + row * columns + column
    new = 0
    for beam in range(ranges.shape[0]):
        ux = cos * directions[0, beam] - sin * directions[1, beam]
        uy = sin * directions[0, beam] + cos * directions[1, beam]
        reach = ranges[beam] / size - ROUNDING
        # The beam enters the next column after next_x, and one more after every per_column (likewise rows).
        per_column = 1 / abs(ux) if ux != 0 else math.inf
        per_row = 1 / abs(uy) if uy != 0 else math.inf
        next_x, next_y = math.inf, math.inf
        if ux != 0:
            next_x = ((column + 1 - start_x) if ux > 0 else (start_x - column)) * per_column
        if uy != 0:
            next_y = ((row + 1 - start_y) if uy > 0 else (start_y - row)) * per_row
        column_step, row_step = (1 if ux > 0 else -1), (columns if uy > 0 else -columns)
        i = start
        while True:
            cell = number[i]
            if cell >= 0 and not seen[cell]:
                seen[cell] = True
                new += 1
            if min(next_x, next_y) >= reach:
                break
            if next_x < next_y:
                i += column_step
                next_x += per_column
            else:
                i += row_step
                next_y += per_row
    return new

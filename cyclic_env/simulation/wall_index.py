"""A spatial index of walls: the few that can be seen from a position, for the laser and for lines of sight."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import shapely

from cyclic_env.errors import FloorPlanError
from cyclic_env.floor_plans.floor_plan import FloorPlan
from cyclic_env.jit import compiled

TILE_SIZE = 2.0
"""Metres. Smaller tiles have shorter lists but are more numerous; at 2 m, Killian Court's fit the cache."""

ROUNDING = 1e-6
"""Metres, and square metres. Walls out of reach, or seen from behind, by no more than this are listed, too."""

TILES_MAX = 2_000_000
"""Largest number of tiles of a plan, 8 km2; they take a gigabyte while they are built."""

GRID = np.dtype(
    [("west", "f8"), ("south", "f8"), ("columns", "i8"), ("rows", "i8"), ("first", "i8")],
)
"""Square cells over one plan, numbered row by row from the south-west corner: the position of that corner, the numbers
of columns and rows, and the number of the first cell."""


class WallIndex(NamedTuple):
    """Square tiles over one or several plans, each with the walls within reach that face it.

    Attributes
    ----------
    grids : (P,) GRID
        The tiles of each plan.
    walls : (W, 4) float64
        x1, y1, x2, y2 of all plans' walls; free space lies on the left.
    offsets : (T + 1,) int64
        Tile t's walls are ``indices[offsets[t]:offsets[t + 1]]``.
    indices : (L,) int32
        Rows of `walls`.
    """

    grids: np.ndarray
    walls: np.ndarray
    offsets: np.ndarray
    indices: np.ndarray


def build_wall_index(plan: FloorPlan, reach: float) -> WallIndex:
    """Return the walls of a plan, listed by tile: those that a point in the tile can see at most `reach` metres away.

    Raises
    ------
    FloorPlanError
        If the plan has too many tiles.
    """
    west, south, east, north = plan.bounds
    nx, ny = (int(np.ceil((high - low) / TILE_SIZE)) for low, high in ((west, east), (south, north)))
    if nx * ny > TILES_MAX:
        raise FloorPlanError(
            f"floor plan {plan.name!r} spans {east - west:.0f} m x {north - south:.0f} m; "
            f"at most {TILES_MAX * TILE_SIZE**2 / 1e6:g} km2 can be searched for walls. Cut it into parts."
        )
    x, y = np.meshgrid(west + TILE_SIZE * np.arange(nx), south + TILE_SIZE * np.arange(ny))
    boxes = shapely.box(x.ravel(), y.ravel(), x.ravel() + TILE_SIZE, y.ravel() + TILE_SIZE)
    inside = shapely.intersects(plan.prepared_space(), boxes)
    walls = np.ascontiguousarray(plan.walls)
    # Once to count the walls of each tile, and once to list them.
    counts = np.zeros(nx * ny, np.int64)
    grids = np.array([(west, south, nx, ny, 0)], GRID)
    list_walls(walls, grids[0], reach + ROUNDING, inside, counts, np.empty(0, np.int32))
    indices = np.empty(counts.sum(), np.int32)
    list_walls(walls, grids[0], reach + ROUNDING, inside, np.cumsum(counts) - counts, indices)
    return WallIndex(
        grids=grids,
        walls=walls,
        offsets=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        indices=indices,
    )


def join_wall_indices(index: WallIndex, others: WallIndex) -> WallIndex:
    """Return the index of the walls of both pools of plans, those of `others` last."""
    return WallIndex(
        grids=joined_grids(index.grids, others.grids, len(index.offsets) - 1),
        walls=np.concatenate([index.walls, others.walls]),
        offsets=np.concatenate([index.offsets, index.offsets[-1] + others.offsets[1:]]),
        indices=np.concatenate([index.indices, others.indices + np.int32(len(index.walls))]),
    )


def no_walls() -> WallIndex:
    """Return the index of a plan without walls, which has one tile."""
    return WallIndex(
        grids=np.array([(0.0, 0.0, 1, 1, 0)], GRID),
        walls=np.empty((0, 4)),
        offsets=np.zeros(2, np.int64),
        indices=np.empty(0, np.int32),
    )


def joined_grids(grids: np.ndarray, others: np.ndarray, count: int) -> np.ndarray:
    """Return the grids of both pools of plans; the first pool has `count` cells."""
    joined = np.concatenate([grids, others])
    joined["first"][len(grids) :] += count
    return joined


@compiled
def list_walls(walls, grid, reach, inside, ends, listed):
    """Count, or list, the walls that a point in each tile can see: at most `reach` metres away, and facing it.

    Parameters
    ----------
    walls : (W, 4) float64
    grid : GRID record
        The tiles.
    reach : float
    inside : (T,) bool
        Which tiles get a list.
    ends : (T,) int64
        On entry, where the list of each tile begins; on return, where it ends. Zeros become the numbers of walls.
    listed : (L,) int32
        Output, unless it is empty: the walls' indices, ascending in each tile.
    """
    west, south, columns, rows = grid.west, grid.south, grid.columns, grid.rows
    for w in range(walls.shape[0]):
        x1, y1, x2, y2 = walls[w, 0], walls[w, 1], walls[w, 2], walls[w, 3]
        first_column = max(int((min(x1, x2) - reach - west) / TILE_SIZE) - 1, 0)
        last_column = min(int((max(x1, x2) + reach - west) / TILE_SIZE) + 1, columns - 1)
        first_row = max(int((min(y1, y2) - reach - south) / TILE_SIZE) - 1, 0)
        last_row = min(int((max(y1, y2) + reach - south) / TILE_SIZE) + 1, rows - 1)
        for row in range(first_row, last_row + 1):
            for column in range(first_column, last_column + 1):
                tile = row * columns + column
                if not inside[tile]:
                    continue
                # Relative to the tile's centre, its corners are at -half and half.
                half = 0.5 * TILE_SIZE
                x, y = west + TILE_SIZE * (column + 0.5), south + TILE_SIZE * (row + 0.5)
                dx, dy = x2 - x1, y2 - y1
                area = dx * (y - y1) - dy * (x - x1)
                if area + half * (abs(dx) + abs(dy)) <= -ROUNDING:  # all of the tile is behind the wall
                    continue
                if _square_distance(x1 - x, y1 - y, x2 - x, y2 - y, half) <= reach * reach:
                    if listed.shape[0]:
                        listed[ends[tile]] = w
                    ends[tile] += 1


@compiled
def _square_distance(x1, y1, x2, y2, half):
    """Return the squared distance from the segment (x1, y1), (x2, y2) to the square from -half to half."""
    dx, dy = x2 - x1, y2 - y1
    low, high = 0.0, 1.0  # ends of the part of the segment inside the square
    for start, along in ((x1, dx), (y1, dy)):
        if along != 0:
            one, other = (-half - start) / along, (half - start) / along
            low, high = max(low, min(one, other)), min(high, max(one, other))
        elif abs(start) > half:
            high = -1.0
    if low <= high:
        return 0.0
    best = math.inf
    for x, y in ((x1, y1), (x2, y2)):
        beside_x, beside_y = max(abs(x) - half, 0.0), max(abs(y) - half, 0.0)
        best = min(best, beside_x * beside_x + beside_y * beside_y)
    for x in (-half, half):
        for y in (-half, half):
            share = min(max(((x - x1) * dx + (y - y1) * dy) / (dx * dx + dy * dy), 0.0), 1.0)
            off_x, off_y = x1 + share * dx - x, y1 + share * dy - y
            best = min(best, off_x * off_x + off_y * off_y)
    return best


@compiled
def cell_index(grid, size, x, y):
    """Return the index of the cell, of side `size`, in which (x, y) lies; the nearest one for a point outside."""
    column = min(max(int((x - grid.west) / size), 0), grid.columns - 1)
    row = min(max(int((y - grid.south) / size), 0), grid.rows - 1)
    return grid.first + row * grid.columns + column


@compiled
def line_of_sight(wall_index, plan, ax, ay, bx, by):
    """Tell whether the straight line from a to b, no longer than the index's reach, meets no wall."""
    tile = cell_index(wall_index.grids[plan], TILE_SIZE, ax, ay)
    dx, dy = bx - ax, by - ay
    west, east, south, north = min(ax, bx), max(ax, bx), min(ay, by), max(ay, by)
    for i in range(wall_index.offsets[tile], wall_index.offsets[tile + 1]):
        wall = wall_index.walls[wall_index.indices[i]]
        x1, y1, x2, y2 = wall[0], wall[1], wall[2], wall[3]
        if max(x1, x2) < west or min(x1, x2) > east or max(y1, y2) < south or min(y1, y2) > north:
            continue
        side_1 = dx * (y1 - ay) - dy * (x1 - ax)
        side_2 = dx * (y2 - ay) - dy * (x2 - ax)
        if (side_1 > 0 and side_2 > 0) or (side_1 < 0 and side_2 < 0):
            continue
        side_a = (x2 - x1) * (ay - y1) - (y2 - y1) * (ax - x1)
        side_b = (x2 - x1) * (by - y1) - (y2 - y1) * (bx - x1)
        if (side_a > 0 and side_b > 0) or (side_a < 0 and side_b < 0):
            continue
        return False
    return True

"""For every place of a building, the few walls near it: the index under the laser and the lines of sight."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import shapely

from cyclic_env.compiled import compiled
from cyclic_env.errors import FloorPlanError
from cyclic_env.floor_plans.floor_plan import FloorPlan

TILE_SIZE = 2.0
"""Metres. Smaller tiles have shorter lists, but there are more of them; 2 m keeps Killian Court's in the cache."""

TILES_MAX = 2_000_000
"""Most tiles of a plan, 8 km2: a gigabyte while they are built."""

GRID = np.dtype(
    [("west", "f8"), ("south", "f8"), ("columns", "i8"), ("rows", "i8"), ("first", "i8")],
)
"""Squares over one plan: the south-west corner, their numbers from west to east and from south to north,
and the number of the first one; they count row by row."""


class WallTiles(NamedTuple):
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


def build_wall_tiles(plans: Sequence[FloorPlan], reach: float) -> WallTiles:
    """Index the walls of `plans` by the tiles from which a point at most `reach` metres away may meet them.

    Raises
    ------
    FloorPlanError
        If a plan has too many tiles.
    """
    grids, walls, counts, indices = [], [], [], []
    num_tiles = num_walls = 0
    for plan in plans:
        west, south, east, north = plan.bounds
        nx, ny = (int(np.ceil((high - low) / TILE_SIZE)) for low, high in ((west, east), (south, north)))
        if nx * ny > TILES_MAX:
            raise FloorPlanError(
                f"floor plan {plan.name!r} spans {east - west:.0f} m x {north - south:.0f} m; "
                f"at most {TILES_MAX * TILE_SIZE**2 / 1e6:g} km2 can be searched for walls. Cut it into parts."
            )
        x, y = np.meshgrid(west + TILE_SIZE * np.arange(nx), south + TILE_SIZE * np.arange(ny))
        boxes = shapely.box(x.ravel(), y.ravel(), x.ravel() + TILE_SIZE, y.ravel() + TILE_SIZE)
        used = np.flatnonzero(shapely.intersects(plan.prepared_space(), boxes))
        tree = shapely.STRtree([shapely.LineString([wall[:2], wall[2:]]) for wall in plan.walls])
        tile, wall = tree.query(boxes[used], predicate="dwithin", distance=reach + 1e-6)
        tile = used[tile]
        x1, y1, x2, y2 = plan.walls[wall].T
        corner_x = x.ravel()[tile] + TILE_SIZE * np.array([[0], [1], [0], [1]])
        corner_y = y.ravel()[tile] + TILE_SIZE * np.array([[0], [0], [1], [1]])
        faces = (((x2 - x1) * (corner_y - y1) - (y2 - y1) * (corner_x - x1)) > -1e-6).any(axis=0)
        tile, wall = tile[faces], wall[faces]
        order = np.lexsort((wall, tile))
        walls.append(plan.walls)
        grids.append((west, south, nx, ny, num_tiles))
        counts.append(np.bincount(tile, minlength=nx * ny))
        indices.append(wall[order] + num_walls)
        num_tiles += nx * ny
        num_walls += len(plan.walls)
    return WallTiles(
        grids=np.array(grids, GRID),
        walls=np.ascontiguousarray(np.concatenate(walls)),
        offsets=np.concatenate([[0], np.cumsum(np.concatenate(counts))]).astype(np.int64),
        indices=np.concatenate(indices).astype(np.int32),
    )


@compiled
def square_at(grid, size, x, y):
    """Return the number of the square of side `size` in which (x, y) lies; the nearest one for a point outside."""
    column = min(max(int((x - grid.west) / size), 0), grid.columns - 1)
    row = min(max(int((y - grid.south) / size), 0), grid.rows - 1)
    return grid.first + row * grid.columns + column

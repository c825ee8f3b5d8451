"""The outline of a mask of cells as a polygon, and its simplification."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import numpy as np
import shapely
from contourpy import FillType, contour_generator
from shapely.geometry import Polygon

from cyclic_env.floor_plans.occupancy.grid import OccupancyGrid

DECIMALS = 6
"""Decimals of coordinates in metres, as in files: if they were rounded later, walls close together might touch."""


def trace_outline(space: np.ndarray, corner: tuple[int, int]) -> Polygon:
    """Return the polygon around a connected mask, along the sides of cells, in columns and rows of the grid."""
    # A level above a half doesn't join two cells that meet in a corner, and the walls there don't touch.
    generator = contour_generator(z=space.astype(float), fill_type=FillType.OuterOffset)
    parts: Any = generator.filled(0.75, math.inf)
    points, offsets = (part[0] for part in parts)
    exterior, *holes = (_along_sides(points[a:b], space) + corner[::-1] for a, b in pairwise(offsets))
    return Polygon(exterior, holes)


def _along_sides(ring: np.ndarray, space: np.ndarray) -> np.ndarray:
    """Turn a closed contour that passes between the centres of cells into one along their sides.

    Where two of four cells are free, crosswise, it cuts past their common corner, which it would otherwise touch twice.
    """
    column, row = np.floor((ring[:-1] + ring[1:]) / 2).astype(int).T
    crosswise = (space[row, column] == space[row + 1, column + 1]) & (space[row, column] != space[row, column + 1])
    crosswise &= space[row, column + 1] == space[row + 1, column]
    corners = np.stack([column, row], axis=1) + 1.0
    both = np.stack([ring[:-1] + 0.5, corners], axis=1).reshape(-1, 2)
    kept = np.stack([crosswise | np.roll(crosswise, 1), ~crosswise], axis=1).ravel()
    return both[kept]


def simplify_outline(outline: Polygon, tolerance: float, grid: OccupancyGrid) -> Polygon:
    """Return an outline with fewer corners, within `tolerance` cells of the given one, in metres.

    The tolerance is halved while the outline would cross or touch itself. Coordinates are rounded as in files,
    so that the outline is read back as it was written.
    """

    def placed(points: np.ndarray) -> np.ndarray:
        return np.round(grid.to_world(points), DECIMALS)

    while tolerance > 1e-3:
        simple = shapely.transform(outline.simplify(tolerance), placed)
        if isinstance(simple, Polygon) and simple.is_valid and not simple.is_empty:
            return simple
        tolerance /= 2
    return shapely.transform(outline, placed)

"""Maps drawn by hand, in metres, for the tests of the import."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import yaml
from PIL import Image
from shapely import Point

from cyclic_env.floor_plans import FloorPlan, OccupancyGrid, trace_floor_plan

RESOLUTION = 0.05


def write_map(folder: Path, image: np.ndarray | Image.Image, suffix: str = ".png", /, **keys: Any) -> Path:
    """Write an image, row 0 at the top, and its YAML file; a key that is None is left out."""
    picture = image if isinstance(image, Image.Image) else Image.fromarray(image)
    picture.save(folder / f"map{suffix}")
    data = {"image": f"map{suffix}", "resolution": RESOLUTION, "origin": [0.0, 0.0, 0.0], "negate": 0}
    data |= {"occupied_thresh": 0.65, "free_thresh": 0.196} | keys
    path = folder / "map.yaml"
    path.write_text(yaml.safe_dump({key: value for key, value in data.items() if value is not None}))
    return path


def unknown(width: float, height: float) -> np.ndarray:
    """Return the cells of unknown space of that size in metres, and 1 m around it."""
    return np.full((round(height / RESOLUTION) + 40, round(width / RESOLUTION) + 40), -1, np.int8)


def floor(width: float, height: float) -> np.ndarray:
    """Return the cells of a hall of that size in metres, with walls and 1 m of unknown space around it."""
    cells = unknown(width, height)
    cells[19:-19, 19:-19] = 100
    cells[20:-20, 20:-20] = 0
    return cells


def box(cells: np.ndarray, x: float, y: float, width: float, height: float, value: int = 100) -> None:
    """Paint a box, placed in metres from the hall's south-west corner, to the nearest cell."""
    row, column, high, wide = (round(length / RESOLUTION) for length in (y, x, height, width))
    cells[20 + row : 20 + row + high, 20 + column : 20 + column + wide] = value


def walled(cells: np.ndarray, x: float, y: float, width: float, height: float) -> None:
    """Paint a free box, with walls around it where nothing is known."""
    row, column, high, wide = (round(length / RESOLUTION) for length in (y, x, height, width))
    part = cells[18 + row : 22 + row + high, 18 + column : 22 + column + wide]
    part[part == -1] = 100
    box(cells, x, y, width, height, value=0)


def grid_of(cells: np.ndarray) -> OccupancyGrid:
    """Return cells as a grid whose hall has its south-west corner at the origin."""
    return OccupancyGrid(cells=cells, resolution=RESOLUTION, origin=(-1.0, -1.0, 0.0))


def traced(cells: np.ndarray, **options: Any) -> FloorPlan:
    """Return the plan of cells whose hall has its south-west corner at the origin."""
    return trace_floor_plan(grid_of(cells), **options).plan


def holds(plan: FloorPlan, x: float, y: float) -> bool:
    return plan.free_space.contains(Point(x, y))


def image_of(cells: np.ndarray) -> np.ndarray:
    """Return cells as ``map_saver`` paints them, row 0 at the top."""
    return np.select([cells == 0, cells == 100], [254, 0], 205).astype(np.uint8)[::-1]

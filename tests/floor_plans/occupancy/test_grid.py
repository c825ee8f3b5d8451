"""Occupancy grids, and floor plans drawn as such."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st
from scipy import ndimage

from cyclic_env.errors import FloorPlanError
from cyclic_env.floor_plans import FloorPlan, OccupancyGrid, load_floor_plan, rasterize, write_occupancy_grid
from tests.floor_plans.occupancy.drawing import RESOLUTION


def test_less_than_half_occupied_is_free() -> None:
    grid = OccupancyGrid(cells=np.array([[-1, 0, 49, 50, 100]], np.int8), resolution=1.0)
    assert grid.free.tolist() == [[False, True, True, False, False]]


@given(st.floats(-4, 4), st.floats(-50, 50), st.floats(-50, 50))
def test_world_and_grid_undo_each_other(yaw: float, x: float, y: float) -> None:
    grid = OccupancyGrid(cells=np.zeros((2, 3), np.int8), resolution=0.1, origin=(x, y, yaw))
    points = np.array([[0.0, 0.0], [3.0, 2.0], [-7.0, 5.5]])
    assert grid.to_grid(grid.to_world(points)) == pytest.approx(points, abs=1e-9)


def test_a_floor_plan_comes_back_from_a_map(plan: FloorPlan, tmp_path: Path) -> None:
    write_occupancy_grid(rasterize(plan, RESOLUTION), tmp_path / "map.yaml")
    back = load_floor_plan(tmp_path / "map.yaml")
    assert back.free_area == pytest.approx(plan.free_area, rel=0.01)
    assert back.cycles_total == plan.cycles_total
    assert back.free_space.symmetric_difference(plan.free_space).area < 0.015 * plan.free_area
    assert (back.name, back.title, back.licence, back.start) == (plan.name, plan.title, plan.licence, plan.start)
    assert len(back.walls) < 1.1 * len(plan.walls)


def test_a_grid_is_free_where_its_cells_centres_are(square_room: FloorPlan) -> None:
    grid = rasterize(square_room, 0.3)
    rows, columns = np.indices(grid.cells.shape)
    centres = grid.to_world(np.stack([columns.ravel(), rows.ravel()], axis=1) + 0.5)
    assert (grid.cells.ravel() == 0).tolist() == shapely.contains_xy(square_room.free_space, centres).tolist()


def test_walls_thinner_than_a_cell_are_drawn() -> None:
    space = shapely.box(0, 0, 10, 10).difference(shapely.box(3.031, 2, 3.033, 10))
    assert isinstance(space, shapely.Polygon)
    cells = rasterize(FloorPlan("thin", space, (1, 1, 0)), 0.1).cells
    labels = ndimage.label(cells[25:] == 0)[0]
    assert labels.max() == 2


@pytest.mark.parametrize("resolution", [0.0, -1.0, math.nan, math.inf, 1e-5])
def test_a_plan_is_not_drawn_with_cells_of_no_size(resolution: float, square_room: FloorPlan) -> None:
    with pytest.raises(FloorPlanError, match=r"resolution: expected|million"):
        rasterize(square_room, resolution)

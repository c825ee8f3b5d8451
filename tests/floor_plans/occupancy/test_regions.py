"""Which free space of a map becomes part of a floor plan, and what is said of the rest."""

from __future__ import annotations

import math

import numpy as np
import pytest

from cyclic_env.floor_plans import OccupancyGrid, trace_floor_plan
from cyclic_env.floor_plans.occupancy.dropped_places import CURES, dropped_remark
from tests.floor_plans.occupancy.drawing import RESOLUTION, box, floor, grid_of, holds, traced, unknown, walled


def looked_into(depth: float) -> np.ndarray:
    """Return the cells of a hall, 8 m x 6 m, that somebody saw 5 m from to the east, through a window 0.8 m wide.

    Behind `depth` metres of what was seen there is a room, 4 m x 4 m, with walls around it.
    """
    cells = floor(20, 6)
    box(cells, 8, -1, 13, 8, value=-1)
    box(cells, 8, 0, 0.1, 6)
    box(cells, 8, 2.6, 5, 0.8, value=0)
    x = 8 + depth
    box(cells, x, 0.9, 4.2, 4.2)
    box(cells, x + 0.1, 1, 4, 4, value=0)
    box(cells, x, 2.6, 0.1, 0.8, value=0)
    return cells


def test_what_was_only_looked_into_is_closed_unless_it_leads_on() -> None:
    assert not holds(traced(looked_into(7)), 10, 3)
    assert holds(traced(looked_into(7), door=0.0), 12.5, 3)
    on_the_way = traced(looked_into(4))
    assert holds(on_the_way, 10, 3)
    assert holds(on_the_way, 15, 3)


def loop_with_a_gap(gap: float) -> np.ndarray:
    """Return the cells of a loop of corridors 40 m x 20 m, 2 m wide, with a gap in the north."""
    cells = unknown(40, 20)
    side = (40 - gap) / 2
    for x, y, width, height in ((0, 0, 40, 2), (0, 0, 2, 20), (38, 0, 2, 20)):
        walled(cells, x, y, width, height)
    for x in (0, 40 - side):
        walled(cells, x, 18, side, 2)
    return cells


@pytest.mark.parametrize("bulge", [0.0, 1.6])
def test_a_white_corridor_that_joins_two_places_keeps_its_loop(bulge: float) -> None:
    cells = loop_with_a_gap(5)
    box(cells, 17.4, 18.45, 5.2, 1.1, value=0)  # no walls along it
    box(cells, 19, 19 - bulge / 2, bulge, bulge, value=0)
    assert traced(cells).cycles_total == 1
    box(cells, 18.2, 18, 0.1, 3)  # a wall across
    assert traced(cells).cycles_total == 0
    assert not holds(traced(cells), 20, 19)  # what is left was only looked into


def test_a_room_with_two_doors_is_kept_but_no_yard_behind_two_windows() -> None:
    cells = loop_with_a_gap(8)
    for x in (15.9, 23.2):
        box(cells, x, 18.6, 0.9, 0.8, value=0)
    box(cells, 16.8, 15, 6.4, 8, value=0)
    assert not holds(traced(cells), 20, 19)
    for y in (15, 22.95):
        box(cells, 16.8, y, 6.4, 0.05)
    assert holds(traced(cells), 20, 19)
    assert traced(cells).cycles_total == 1


def track(origin: tuple[float, float]) -> OccupancyGrid:
    """Return a race track, 3 m wide, between two lines on white paper, and put the origin of the world there."""
    cells = np.zeros((800, 1200), np.int8)
    rows, columns = np.indices(cells.shape)
    for size in (500, 440):
        cells[np.abs(np.hypot(columns - 600, 1.6 * (rows - 400)) - size) < 1.5] = 100
    return OccupancyGrid(cells=cells, resolution=RESOLUTION, origin=(-origin[0], -origin[1], 0.0))


def test_a_race_track_is_imported_without_its_infield_where_the_start_is_on_the_track() -> None:
    for start in ((0.0, 0.0, 0.0), None):
        plan = trace_floor_plan(track((6.5, 20.0)), start=start).plan
        assert plan.cycles_total == 1
        assert plan.free_area == pytest.approx(math.pi / 1.6 * (25**2 - 22**2), rel=0.1)
    assert trace_floor_plan(track((30.0, 20.0))).plan.cycles_total == 0  # the infield, where the origin is


def test_a_map_without_walls_is_kept() -> None:
    cells = looked_into(7)
    cells[cells == 100] = -1
    assert holds(traced(cells), 12.5, 3)


@pytest.mark.parametrize("framed", [False, True])
def test_the_paper_around_a_building_is_no_building_nor_is_its_courtyard(framed: bool) -> None:
    cells = floor(40, 30)
    cells[cells == -1] = 0
    if not framed:
        cells[cells == 100] = 0
    for x, y, width, height in ((5, 5, 30, 20), (11, 11, 18, 8)):  # a ring around a courtyard
        box(cells, x, y, width, height)
        box(cells, x + 0.1, y + 0.1, width - 0.2, height - 0.2, value=0)
    for x in range(7, 34, 2):  # with partitions to both sides
        box(cells, x, 5, 0.1, 4)
        box(cells, x, 21, 0.1, 4)
    plan = traced(cells)
    assert plan.bounds == pytest.approx((5.1, 5.1, 34.9, 24.9), abs=0.05)
    assert plan.cycles_total == 1


def test_what_was_dropped_is_told_with_a_cure() -> None:
    cells = np.pad(loop_with_a_gap(0), ((0, 0), (0, 400)), constant_values=-1)
    walled(cells, 4, 3.9, 10, 10)  # a room without a door
    walled(cells, 20, 4, 10, 10)
    box(cells, 25, 1.95, 0.4, 2.1, value=0)  # a room with a door that is too narrow
    box(cells, 39.9, 10, 1.9, 0.8, value=0)  # a window, behind which somebody saw a yard
    box(cells, 41.5, 5, 12, 10, value=0)
    dropped = trace_floor_plan(grid_of(cells)).dropped
    assert [place.reason for place in dropped] == ["glimpse", "narrow", "apart"]
    assert [place.area for place in dropped] == pytest.approx([120, 100, 100], rel=0.02)
    x, y = dropped[0].position
    assert (41 < x < 54, 4 < y < 15) == (True, True)
    remark = dropped_remark(dropped, 236.0)
    assert "58% of it" in remark
    assert all(cure in remark for cure in CURES.values())
    assert dropped_remark(dropped, 1e4) == ""

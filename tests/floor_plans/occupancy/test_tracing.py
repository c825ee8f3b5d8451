"""Occupancy grids traced into floor plans that a robot can drive in."""

from __future__ import annotations

import math
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely import Point

from cyclic_env import CyclicLoopEnv
from cyclic_env.errors import FloorPlanError
from cyclic_env.floor_plans import load_floor_plan, read_floor_plan, trace_floor_plan, write_floor_plan
from tests.floor_plans.occupancy.drawing import (
    RESOLUTION,
    box,
    floor,
    grid_of,
    holds,
    image_of,
    traced,
    write_map,
)


def test_a_hall_has_four_walls() -> None:
    plan = traced(floor(8, 6))
    assert len(plan.walls) == 4
    assert plan.free_area == pytest.approx(48, rel=1e-6)
    assert plan.bounds == pytest.approx((0, 0, 8, 6), abs=0.01)


def rough_hall(height: float) -> np.ndarray:
    """Return the cells of a hall 30 m long with rough walls in the south and the north."""
    cells = floor(30, height)
    rough = np.random.default_rng(0).integers(0, 2, (2, 600)).astype(bool)
    cells[20, 20:-20][rough[0]] = 100
    cells[-21, 20:-20][rough[1]] = 100
    return cells


def test_rough_walls_become_straight_ones() -> None:
    assert len(traced(rough_hall(2.4)).walls) <= 12


def test_unknown_space_is_closed() -> None:
    cells = floor(8, 6)
    box(cells, 6, 0, 2, 6, value=-1)
    plan = traced(cells)
    assert not holds(plan, 7, 3)
    assert plan.bounds[2] == pytest.approx(6, abs=0.01)


def test_specks_are_dropped_and_pillars_are_kept() -> None:
    cells = floor(8, 6)
    box(cells, 2, 3, 0.15, 0.15)
    box(cells, 6, 3, 0.3, 0.3)
    plan, specks, speck_area, *_ = trace_floor_plan(grid_of(cells))
    assert (specks, speck_area) == (1, pytest.approx(0.0225))
    assert holds(plan, 2.07, 3.07)
    assert not holds(plan, 6.15, 3.15)
    assert len(plan.free_space.interiors) == 1
    assert len(traced(cells, speck_area=0.01).free_space.interiors) == 2
    assert len(traced(cells, speck_area=0.2).free_space.interiors) == 0


def test_a_row_of_dots_is_a_wall() -> None:
    cells = floor(8, 6)
    cells[20:-20:2, 100] = 100
    assert traced(cells).bounds == pytest.approx((0, 0, 4, 6), abs=0.01)  # the larger part


def test_posts_that_hold_two_places_apart_are_no_specks_and_windows_are_closed() -> None:
    cells = floor(8, 6)
    for y in np.arange(0.0, 6.0, 0.55):
        box(cells, 5, y + 0.4, 0.15, 0.15)  # posts 0.4 m apart
    assert traced(cells).bounds == pytest.approx((0, 0, 5.15, 6), abs=0.15)


def test_noise_in_a_doorway_does_not_close_it_but_a_post_does() -> None:
    cells = floor(8, 6)
    box(cells, 4, 0, 0.2, 6)
    box(cells, 4, 2.5, 0.2, 1.0, value=0)
    box(cells, 4.05, 2.95, 0.05, 0.1)
    assert holds(traced(cells), 2, 3) == holds(traced(cells), 6, 3) is True
    box(cells, 4.05, 2.95, 0.15, 0.15)
    assert holds(traced(cells), 2, 3) != holds(traced(cells), 6, 3)


def test_a_diagonal_wall_one_cell_thin_is_tight() -> None:
    cells = floor(6, 6)
    inner = cells[20:-20, 20:-20]
    np.fill_diagonal(inner, 100)
    plan = traced(cells, start=(4.0, 1.5, 0.0))
    assert plan.free_area == pytest.approx(18, rel=0.03)
    assert not holds(plan, 1.5, 4.0)
    assert len(plan.walls) <= 5


def test_the_largest_region_is_kept_or_that_of_the_start() -> None:
    cells = floor(8, 6)
    box(cells, 3, 0, 0.1, 6)
    assert traced(cells).bounds == pytest.approx((3.1, 0, 8, 6), abs=0.01)
    plan = traced(cells, start=(1.0, 1.0, 0.5))
    assert plan.bounds == pytest.approx((0, 0, 3, 6), abs=0.01)
    assert plan.start == (1.0, 1.0, 0.5)


def test_what_the_robot_cannot_enter_is_left_out_and_a_niche_is_kept() -> None:
    cells = floor(8, 6)
    box(cells, 4, 0, 0.2, 6)
    box(cells, 4, 1, 0.2, 0.4, value=0)  # a door too narrow, to the smaller part
    cells[20 + 60 : 20 + 68, 12:20] = 0  # a niche of 0.4 m by 0.4 m in the west wall
    plan = traced(cells, start=(2.0, 3.0, 0.0))
    assert not holds(plan, 6, 3)
    assert holds(plan, -0.3, 3.2)
    box(cells, 4, 1, 0.2, 0.65, value=0)
    assert holds(traced(cells, start=(2.0, 3.0, 0.0)), 6, 3)
    assert not holds(traced(cells, start=(2.0, 3.0, 0.0), robot_radius=0.4), 6, 3)


def test_single_rays_are_dropped() -> None:
    cells = floor(8, 6)
    cells[60, :] = 0
    for i in range(19):
        cells[100 + i // 2, -1 - i] = 0
    plan = traced(cells)
    assert plan.bounds == pytest.approx((0, 0, 8, 6), abs=0.05)
    assert len(plan.walls) == 4


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_whatever_is_traced_is_read_back_as_it_was(tmp_path_factory: pytest.TempPathFactory, seed: int) -> None:
    rng = np.random.default_rng(seed)
    cells = floor(12, 8)
    for _ in range(30):  # short walls, diagonal steps among them
        row, column = rng.integers(20, (cells.shape[0] - 20, cells.shape[1] - 20))
        step = rng.integers(-1, 2, 2)
        for i in range(rng.integers(2, 25)):
            place = np.clip((row, column) + i * step, 20, np.array(cells.shape) - 21)
            cells[tuple(place)] = 100
    plan = traced(cells)
    path = tmp_path_factory.mktemp("plans") / "plan.yaml"
    write_floor_plan(plan, path)
    assert read_floor_plan(path).free_space.equals(plan.free_space)


def test_walls_that_meet_in_corners_do_not_keep_others_from_being_straight() -> None:
    cells = rough_hall(12)
    for i in range(20, 580, 20):  # short walls along the grid, and steps off their ends
        box(cells, i * RESOLUTION, 4, 0.5, 0.05)
        cells[101 + 20 - 20 + np.arange(8), 30 + i + np.arange(8)] = 100
    assert len(traced(cells, speck_area=0.0).walls) < 300


@pytest.mark.parametrize(("gap", "cycles"), [(0.4, 1), (1.0, 2)])
def test_blocks_between_which_the_robot_does_not_fit_are_one(gap: float, cycles: int) -> None:
    cells = floor(30, 15)
    box(cells, 2, 2, 12, 11)
    box(cells, 14 + gap, 2, 12, 11)
    plan = traced(cells)
    assert plan.cycles_total == cycles
    plan.reachable(0.25)


def test_wall_ends_close_together_are_joined_where_the_robot_does_not_pass() -> None:
    cells = floor(30, 30)
    box(cells, 3, 14.9, 11.8, 0.2)  # two thin walls, each long enough for a cycle, ends 0.4 m apart
    box(cells, 15.2, 14.9, 11.8, 0.2)
    plan = traced(cells)
    assert plan.cycles_total == 1
    assert not plan.free_space.contains(shapely.LineString([(15, 10), (15, 20)]))


def test_the_start_is_the_roomiest_point_and_looks_along_the_longest_way() -> None:
    cells = floor(20, 10)
    box(cells, 0, 4, 16, 6)  # an L: a wing of 20 m x 4 m, a wing of 4 m x 10 m
    plan = traced(cells)
    x, y, heading = plan.start
    clearance = plan.free_space.exterior.distance(Point(x, y))
    assert clearance == pytest.approx(4 / (1 + math.sqrt(0.5)), abs=0.1)  # touches both outer walls and the corner
    assert abs(abs(heading) - math.pi) < 0.2
    assert traced(cells).start == plan.start


def test_other_tolerances_give_more_walls_or_fewer() -> None:
    cells = floor(8, 6)
    rows, columns = np.indices(cells.shape)
    cells[np.hypot(rows - 80, columns - 100) < 25] = 100
    fine, usual, crude = (len(traced(cells, tolerance=tolerance).walls) for tolerance in (0.02, None, 0.2))
    assert fine > usual > crude >= 7


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_a_robot_passes_everywhere_in_whatever_is_traced(seed: int) -> None:
    rng = np.random.default_rng(seed)
    cells = floor(24, 16)
    for _ in range(rng.integers(3, 40)):
        width, height = rng.choice([0.1, 0.5, 2.0, 9.0], 2)
        box(cells, rng.uniform(0, 24 - width), rng.uniform(0, 16 - height), width, height, rng.choice([100, -1]))
    cells[(rng.random(cells.shape) < rng.choice([0.0, 0.001, 0.02])) & (cells == 0)] = 100
    plan = traced(cells)
    plan.reachable(0.25)
    outside = plan.free_space.difference(shapely.box(0, 0, 24, 16))
    assert outside.area < 0.1
    assert plan.free_area < 1.02 * np.count_nonzero(cells == 0) * RESOLUTION**2 + 2


def test_an_environment_drives_in_a_map(tmp_path: Path) -> None:
    cells = floor(20, 16)
    box(cells, 3, 3, 14, 10)
    path = write_map(tmp_path, image_of(cells), ".pgm", origin=[-5.0, 3.0, 0.4])
    env = gymnasium.make("cyclic_env:CyclicLoop-v0", map_name=str(path))
    observation, info = env.reset(seed=0)
    for _ in range(20):
        observation, _, _, _, info = env.step(np.array([1.0, 1.0, -1.0, 0.0], np.float32))
    assert (info["cycles_total"], info["collisions"]) == (1, 0)
    assert info["path_length_m"] > 3
    assert observation["laser"].max() > 2
    env.close()


def test_a_map_is_traced_for_the_environments_robot(tmp_path: Path) -> None:
    cells = floor(20, 16)
    box(cells, 3, 3, 14, 10)
    box(cells, 4, 4, 5, 8, value=0)
    box(cells, 3, 6, 1, 0.65, value=0)  # a door for the robot of 0.25 m
    path = write_map(tmp_path, image_of(cells), origin=[-1.0, -1.0, 0.0])
    for radius, inside in ((0.25, True), (0.35, False)):
        for map_name in (path, [load_floor_plan(path), "ring"]):
            env = CyclicLoopEnv(map_name, robot={"radius": radius})
            plan = env.floor_plans[0]
            assert (plan.robot_radius, holds(plan, 6, 8)) == (radius, inside)
            assert env.floor_plans[0] is plan


@pytest.mark.parametrize("option", ["robot_radius", "speck_area", "gap", "nook_area", "tolerance"])
@pytest.mark.parametrize("value", [-1.0, math.nan, math.inf])
def test_sizes_are_finite_and_not_negative(option: str, value: float) -> None:
    with pytest.raises(FloorPlanError, match=f"{option}: expected"):
        traced(floor(5, 5), **{option: value})

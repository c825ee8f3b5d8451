"""Maps of ROS: read as map_server does, traced into floor plans that a robot can drive in, and written again."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import shapely
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from scipy import ndimage
from shapely import Point

from cyclic_env.errors import FloorPlanError
from cyclic_env.floor_plans import (
    FloorPlan,
    OccupancyGrid,
    load_floor_plan,
    rasterise,
    read_floor_plan,
    read_occupancy_grid,
    trace_floor_plan,
    write_floor_plan,
    write_occupancy_grid,
)
from cyclic_env.floor_plans.occupancy.grid import CELLS_MAX
from cyclic_env.floor_plans.occupancy.tracing import _dilated, _grown

RESOLUTION = 0.05
SHADES = np.array([[0, 254, 205], [255, 60, 220]], np.uint8)


def write_map(folder: Path, image: np.ndarray | Image.Image, suffix: str = ".png", /, **keys: Any) -> Path:
    """Write an image, row 0 at the top, and its YAML file; a key that is None is left out."""
    picture = image if isinstance(image, Image.Image) else Image.fromarray(image)
    picture.save(folder / f"map{suffix}")
    data = {"image": f"map{suffix}", "resolution": RESOLUTION, "origin": [0.0, 0.0, 0.0], "negate": 0}
    data |= {"occupied_thresh": 0.65, "free_thresh": 0.196} | keys
    path = folder / "map.yaml"
    path.write_text(yaml.safe_dump({key: value for key, value in data.items() if value is not None}))
    return path


def read_cells(folder: Path, image: np.ndarray | Image.Image, **keys: Any) -> list[list[int]]:
    """Return the cells of a map as rows from the top."""
    return read_occupancy_grid(write_map(folder, image, **keys)).cells[::-1].tolist()


def floor(width: float, height: float) -> np.ndarray:
    """Return the cells of a hall of that size in metres, walled in, with 1 m of the unknown around."""
    columns, rows = round(width / RESOLUTION), round(height / RESOLUTION)
    cells = np.full((rows + 40, columns + 40), -1, np.int8)
    cells[19:-19, 19:-19] = 100
    cells[20:-20, 20:-20] = 0
    return cells


def box(cells: np.ndarray, x: float, y: float, width: float, height: float, value: int = 100) -> None:
    """Paint a box, metres from the hall's south-west corner, to the nearest cell."""
    row, column, high, wide = (round(length / RESOLUTION) for length in (y, x, height, width))
    cells[20 + row : 20 + row + high, 20 + column : 20 + column + wide] = value


def traced(cells: np.ndarray, **options: Any) -> FloorPlan:
    """Return the plan of cells whose hall has its south-west corner at the origin."""
    grid = OccupancyGrid(cells=cells, resolution=RESOLUTION, origin=(-1.0, -1.0, 0.0))
    return trace_floor_plan(grid, **options).plan


def holds(plan: FloorPlan, x: float, y: float) -> bool:
    return plan.free_space.contains(Point(x, y))


# Reading, as map_server does


def test_trinary_is_free_occupied_or_unknown(tmp_path: Path) -> None:
    assert read_cells(tmp_path, SHADES) == [[100, 0, -1], [0, 100, 0]]


def test_thresholds_themselves_are_unknown(tmp_path: Path) -> None:
    shades = np.array([[51, 52, 50, 204, 205, 203]], np.uint8)  # of 0.8 and 0.2, and one to each side
    assert read_cells(tmp_path, shades, occupied_thresh=0.8, free_thresh=0.2) == [[-1, -1, 100, -1, 0, -1]]


def test_negate_makes_light_walls(tmp_path: Path) -> None:
    assert read_cells(tmp_path, 255 - SHADES, negate=1) == [[100, 0, -1], [0, 100, 0]]
    assert read_cells(tmp_path, 255 - SHADES, negate=True) == [[100, 0, -1], [0, 100, 0]]


def test_scale_has_percentages_between_and_alpha_for_unknown(tmp_path: Path) -> None:
    grey = np.array([[0, 255, 127, 0]], np.uint8)
    image = Image.fromarray(np.dstack([grey, grey, grey, np.array([[255, 255, 255, 254]], np.uint8)]))
    cells = read_cells(tmp_path, image, mode="scale", occupied_thresh=0.9, free_thresh=0.1)
    assert cells == [[100, 0, round(100 * (128 / 255 - 0.1) / 0.8), -1]]


def test_raw_pixels_are_percentages(tmp_path: Path) -> None:
    assert read_cells(tmp_path, np.array([[0, 49, 100, 101, 255]], np.uint8), mode="raw") == [[0, 49, 100, -1, -1]]


def test_less_than_half_occupied_is_free() -> None:
    grid = OccupancyGrid(cells=np.array([[-1, 0, 49, 50, 100]], np.int8), resolution=1.0)
    assert grid.free.tolist() == [[False, True, True, False, False]]


def test_colours_are_averaged(tmp_path: Path) -> None:
    colours = np.array([[[255, 0, 0], [255, 255, 150], [255, 255, 100]]], np.uint8)  # 85, 220, 203.3
    assert read_cells(tmp_path, colours) == [[100, 0, -1]]


def test_trinary_averages_alpha_too(tmp_path: Path) -> None:
    pixels = np.array([[[0, 0, 0, 255], [255, 255, 255, 0], [255, 255, 255, 255]]], np.uint8)  # shares .75, .25, 0
    assert read_cells(tmp_path, pixels) == [[100, -1, 0]]


def test_sixteen_bits_and_black_and_white_are_read(tmp_path: Path) -> None:
    assert read_cells(tmp_path, SHADES.astype(np.uint16) * 257) == [[100, 0, -1], [0, 100, 0]]
    assert read_cells(tmp_path, Image.fromarray(np.array([[True, False]]))) == [[0, 100]]


def test_grey_of_map_saver_is_unknown_whatever_threshold_it_wrote(tmp_path: Path) -> None:
    painted = np.array([[0, 205, 254]], np.uint8)
    assert read_cells(tmp_path, painted, free_thresh=0.25) == [[100, -1, 0]]
    other = np.array([[0, 205, 254, 230]], np.uint8)
    assert read_cells(tmp_path, other, free_thresh=0.25) == [[100, 0, 0, 0]]


def test_light_grey_is_counted_where_the_threshold_makes_it_unknown(tmp_path: Path) -> None:
    shades = np.array([[0, 128, 128, 150, 180, 100, 254]], np.uint8)  # unseen is 128, 100 more likely occupied
    assert read_occupancy_grid(write_map(tmp_path, shades)).doubtful == 2
    assert read_occupancy_grid(write_map(tmp_path, shades, mode="scale")).doubtful == 0
    assert read_occupancy_grid(write_map(tmp_path, SHADES)).doubtful == 0


def test_keys_may_be_left_out_and_others_be_there(tmp_path: Path) -> None:
    keys = {"negate": None, "occupied_thresh": None, "free_thresh": None, "cost_scaling": 3, "mode": "Trinary"}
    assert read_cells(tmp_path, SHADES, **keys) == [[100, 0, -1], [0, 100, 0]]


def test_text_images_of_ascii_are_read(tmp_path: Path) -> None:
    (tmp_path / "ascii.pgm").write_text("P2\n# a comment\n3 1\n255\n0 254 205\n")
    path = write_map(tmp_path, SHADES, image="ascii.pgm")
    assert read_occupancy_grid(path).cells.tolist() == [[100, 0, -1]]


def test_top_of_the_image_is_north_and_yaw_turns_about_the_lower_left_corner(tmp_path: Path) -> None:
    image = np.full((60, 80), 254, np.uint8)
    image[[0, -1]] = image[:, [0, -1]] = 0
    image[1:21, 1:41] = 0  # the upper left is solid
    straight = read_floor_plan(write_map(tmp_path, image, origin=[10, 20, 0]))
    assert [holds(straight, x, y) for x, y in ((10.5, 22.5), (13.5, 22.5), (10.5, 20.5))] == [False, True, True]
    assert straight.bounds == pytest.approx((10.05, 20.05, 13.95, 22.95), abs=0.01)
    turned = read_floor_plan(write_map(tmp_path, image, origin=[10, 20, math.pi / 2]))
    assert turned.bounds == pytest.approx((7.05, 20.05, 9.95, 23.95), abs=0.01)
    assert [holds(turned, x, y) for x, y in ((7.5, 20.5), (7.5, 23.5), (9.5, 20.5))] == [False, True, True]


@given(st.floats(-4, 4), st.floats(-50, 50), st.floats(-50, 50))
def test_world_and_grid_undo_each_other(yaw: float, x: float, y: float) -> None:
    grid = OccupancyGrid(cells=np.zeros((2, 3), np.int8), resolution=0.1, origin=(x, y, yaw))
    points = np.array([[0.0, 0.0], [3.0, 2.0], [-7.0, 5.5]])
    assert grid.to_grid(grid.to_world(points)) == pytest.approx(points, abs=1e-9)


def test_a_picture_has_dark_walls_and_paper_may_be_transparent(tmp_path: Path) -> None:
    pixels = np.zeros((100, 160, 4), np.uint8)  # transparent
    pixels[20:80, 20:140] = (0, 0, 0, 255)
    pixels[24:76, 24:136] = (255, 255, 255, 255)
    Image.fromarray(pixels).save(tmp_path / "drawing.png")
    plan = trace_floor_plan(read_occupancy_grid(tmp_path / "drawing.png", resolution=0.1)).plan
    assert plan.name == "drawing"
    assert plan.bounds == pytest.approx((2.4, 2.4, 13.6, 7.6), abs=0.01)  # the hall, and not the paper around it


# Tracing


def test_a_hall_has_four_walls() -> None:
    plan = traced(floor(8, 6))
    assert len(plan.walls) == 4
    assert plan.free_area == pytest.approx(48, rel=1e-6)
    assert plan.bounds == pytest.approx((0, 0, 8, 6), abs=0.01)


def test_rough_walls_become_straight_ones() -> None:
    cells = floor(30, 2.4)
    rough = np.random.default_rng(0).integers(0, 2, (2, 600)).astype(bool)
    cells[20, 20:-20][rough[0]] = 100
    cells[-21, 20:-20][rough[1]] = 100
    assert len(traced(cells).walls) <= 12


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
    grid = OccupancyGrid(cells=cells, resolution=RESOLUTION, origin=(-1.0, -1.0, 0.0))
    plan, specks, speck_area, _ = trace_floor_plan(grid)
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


def windows() -> np.ndarray:
    """Return the cells of a hall, 5 m x 6 m, that is parted from what is beyond by posts 0.4 m apart."""
    cells = floor(8, 6)
    for y in np.arange(0.0, 6.0, 0.55):
        box(cells, 5, y + 0.4, 0.15, 0.15)
    return cells


def test_posts_that_hold_two_places_apart_are_no_specks_and_windows_are_closed() -> None:
    plan = traced(windows())
    assert plan.bounds == pytest.approx((0, 0, 5.15, 6), abs=0.15)


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
    cells = floor(30, 12)
    rough = np.random.default_rng(0).integers(0, 2, (2, 600)).astype(bool)
    cells[20, 20:-20][rough[0]] = 100
    cells[-21, 20:-20][rough[1]] = 100
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


def count_holes(mask: np.ndarray) -> int:
    return ndimage.label(~np.pad(mask, 1), np.ones((3, 3)))[1] - 1


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(0.005, 0.08))
def test_growing_back_to_the_walls_keeps_holes_and_makes_none(seed: int, density: float) -> None:
    rng = np.random.default_rng(seed)
    free = np.pad(rng.random((60, 80)) > density, 1)
    labels = ndimage.label(~_dilated(~free, 3.5))[0]
    if not labels.any():
        return
    centres = labels == 1 + np.argmax(np.bincount(labels.ravel())[1:])
    space = _grown(centres, free, 3.5, 2.0, 50.0)
    assert (space | centres == space).all()
    assert not (space & ~free).any()
    assert ndimage.label(space)[1] == 1
    assert count_holes(space) == count_holes(centres)


@given(st.integers(0, 2**32 - 1), st.floats(0.8, 9.0))
def test_discs_are_as_large_as_distances_say(seed: int, radius: float) -> None:
    mask = np.random.default_rng(seed).random((30, 40)) < 0.02
    mask[3, 4] = True
    assert (_dilated(mask, radius) == (ndimage.distance_transform_edt(~mask) < radius)).all()


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


# Writing


def test_a_floor_plan_comes_back_from_a_map(plan: FloorPlan, tmp_path: Path) -> None:
    write_occupancy_grid(rasterise(plan, RESOLUTION), tmp_path / "map.yaml")
    back = load_floor_plan(tmp_path / "map.yaml")
    assert back.free_area == pytest.approx(plan.free_area, rel=0.01)
    assert back.cycles_total == plan.cycles_total
    assert back.free_space.symmetric_difference(plan.free_space).area < 0.015 * plan.free_area
    assert (back.name, back.title, back.licence, back.start) == (plan.name, plan.title, plan.licence, plan.start)
    assert len(back.walls) < 1.1 * len(plan.walls)


def test_a_grid_is_free_where_its_cells_centres_are(square_room: FloorPlan) -> None:
    grid = rasterise(square_room, 0.3)
    rows, columns = np.indices(grid.cells.shape)
    centres = grid.to_world(np.stack([columns.ravel(), rows.ravel()], axis=1) + 0.5)
    assert (grid.cells.ravel() == 0).tolist() == shapely.contains_xy(square_room.free_space, centres).tolist()


def test_walls_thinner_than_a_cell_are_drawn() -> None:
    space = shapely.box(0, 0, 10, 10).difference(shapely.box(3.031, 2, 3.033, 10))
    assert isinstance(space, shapely.Polygon)
    cells = rasterise(FloorPlan("thin", space, (1, 1, 0)), 0.1).cells
    labels = ndimage.label(cells[25:] == 0)[0]
    assert labels.max() == 2


def test_a_written_map_is_read_back_as_it_was(tmp_path: Path) -> None:
    cells = np.array([[0, 100, -1], [30, 60, 10]], np.int8)
    about = {"name": "hut", "title": "A hüt", "source": "me", "licence": "CC0", "start": (1.0, 2.0, 0.5)}
    grid = OccupancyGrid(cells=cells, resolution=0.1, origin=(1.0, -2.0, 0.25), **about)
    write_occupancy_grid(grid, tmp_path / "hut.yaml")
    back = read_occupancy_grid(tmp_path / "hut.yaml")
    assert back.cells.tolist() == [[0, 100, -1], [-1, -1, 0]]
    assert (back.resolution, back.origin) == (0.1, (1.0, -2.0, 0.25))
    assert {key: getattr(back, key) for key in about} == about


def test_a_map_that_can_not_be_written_is_one_line(tmp_path: Path) -> None:
    grid = OccupancyGrid(cells=np.zeros((2, 2), np.int8), resolution=1.0)
    with pytest.raises(FloorPlanError, match="can't be written"):
        write_occupancy_grid(grid, tmp_path / "no" / "map.yaml")


# In the environment


def image_of(cells: np.ndarray) -> np.ndarray:
    return np.select([cells == 0, cells == 100], [254, 0], 205).astype(np.uint8)[::-1]


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


# Mistakes: each is one line that names the file

MISTAKES: dict[str, tuple[dict[str, Any], str]] = {
    "missing image": ({"image": "other.pgm"}, "image: there is no file .*other.pgm"),
    "image that is a folder": ({"image": "."}, "image: .* is no whole picture"),
    "image that is a number": ({"image": 3}, "image: expected the path of a picture, got 3"),
    "image that is no image": ({"image": "map.yaml"}, "image: .*map.yaml is no whole picture"),
    "no resolution": ({"resolution": None}, "resolution: is missing"),
    "no origin": ({"origin": None}, "origin: is missing"),
    "resolution of 0": ({"resolution": 0}, "resolution: expected metres a pixel, more than 0, got 0"),
    "negative resolution": ({"resolution": -0.05}, "resolution: expected metres a pixel, more than 0"),
    "resolution that is not a number": ({"resolution": math.nan}, "resolution: expected a number"),
    "resolution in words": ({"resolution": "5 cm"}, "resolution: expected a number.*'5 cm'"),
    "resolution near 0": ({"resolution": 1e-300}, "resolution: expected metres a pixel"),
    "image with a line feed": ({"image": "map.pgm\n"}, r"image: expected the path of a picture, got 'map.pgm\\n'"),
    "tiny resolution": ({"resolution": 1e-6}, "fits nowhere.*resolution"),
    "origin without yaw": ({"origin": [0, 0]}, r"origin: expected \[x, y, yaw\], got \[0, 0\]"),
    "origin in words": ({"origin": "here"}, "origin: expected a list, got str"),
    "origin far away": ({"origin": [0, 1e9, 0]}, r"origin\[1\]: expected a number"),
    "unknown mode": ({"mode": "binary"}, "mode: unknown mode 'binary'.*trinary"),
    "mode that is a number": ({"mode": 2}, "mode: unknown mode 2"),
    "negate in words": ({"negate": "no way"}, "negate: expected 0 or 1"),
    "thresholds crossed": ({"occupied_thresh": 0.1}, "free_thresh is 0.196 and occupied_thresh 0.1"),
    "threshold in percent": ({"occupied_thresh": 65}, "occupied_thresh 65; expected shares from 0 to 1"),
    "threshold in words": ({"free_thresh": "low"}, "free_thresh: expected a number"),
    "start in a wall": ({"start": {"x": 0.02, "y": 1}}, r"start \(0.02, 1\) is in a wall.*move it, for example"),
    "start in unknown space": ({"start": {"x": 3.5, "y": 1}}, r"start \(3.5, 1\) is in a wall, in unknown space"),
    "start outside": ({"start": {"x": 99, "y": 1}}, r"start \(99, 1\) is in a wall.*or outside the map"),
    "start at a wall": ({"start": {"x": 0.2, "y": 1}}, r"start \(0.2, 1\) is too near a wall; .*\(0.3"),
    "start without y": ({"start": {"x": 1}}, "start: expected a mapping with x, y"),
    "title that is a list": ({"title": ["a"]}, "title: expected text"),
}


@pytest.mark.parametrize(("keys", "message"), MISTAKES.values(), ids=MISTAKES.keys())
def test_a_mistake_is_one_line_that_names_the_file(keys: dict[str, Any], message: str, tmp_path: Path) -> None:
    image = np.full((40, 80), 254, np.uint8)
    image[[0, -1]] = image[:, [0, -1]] = 0
    image[:, 60:] = 205
    with pytest.raises(FloorPlanError, match=message) as caught:
        load_floor_plan(write_map(tmp_path, image, **keys))
    assert str(caught.value).startswith(f"{tmp_path / 'map.yaml'}: ")
    assert "\n" not in str(caught.value)


def test_a_map_that_is_all_wall_is_one_line(tmp_path: Path) -> None:
    path = write_map(tmp_path, np.full((40, 80), 254, np.uint8), negate=1)
    with pytest.raises(FloorPlanError, match=r"map.yaml: the map has no free cell; are the thresholds right, and neg"):
        read_floor_plan(path)


def test_a_map_in_which_the_robot_fits_nowhere_is_one_line(tmp_path: Path) -> None:
    path = write_map(tmp_path, image_of(floor(5, 0.4)))
    with pytest.raises(FloorPlanError, match=r"map.yaml: the robot fits nowhere .*resolution"):
        read_floor_plan(path)


@pytest.mark.parametrize("size", [9_000, 10_000, 30_000])
def test_a_giant_image_is_refused_by_its_header(size: int, tmp_path: Path) -> None:
    assert size**2 > CELLS_MAX
    path = write_map(tmp_path, SHADES, ".pgm")
    (tmp_path / "map.pgm").write_bytes(b"P5\n%d %d\n255\n" % (size, size))
    with pytest.raises(FloorPlanError, match=r"map.yaml: image: .*map.pgm: the image .*64 million"):
        read_floor_plan(path)


@pytest.mark.parametrize("suffix", [".pgm", ".png"])
def test_half_an_image_is_refused(suffix: str, tmp_path: Path) -> None:
    path = write_map(tmp_path, image_of(floor(5, 5)), suffix)
    image = tmp_path / f"map{suffix}"
    image.write_bytes(image.read_bytes()[: image.stat().st_size // 2])
    with pytest.raises(FloorPlanError, match=r"map.yaml: image: .* is no whole picture"):
        read_floor_plan(path)


def test_a_picture_alone_has_no_size(tmp_path: Path) -> None:
    write_map(tmp_path, SHADES)
    with pytest.raises(FloorPlanError, match=r"map.png: a picture does not say.*import_map.py"):
        load_floor_plan(tmp_path / "map.png")
    with pytest.raises(FloorPlanError, match=r"map.png: a picture does not say.*resolution"):
        read_occupancy_grid(tmp_path / "map.png")
    with pytest.raises(FloorPlanError, match=r"map.yaml: the file says itself"):
        read_occupancy_grid(tmp_path / "map.yaml", resolution=0.1)


@pytest.mark.parametrize("option", ["robot_radius", "speck_area", "gap", "nook_area", "tolerance"])
@pytest.mark.parametrize("value", [-1.0, math.nan, math.inf])
def test_sizes_are_finite_and_not_negative(option: str, value: float) -> None:
    with pytest.raises(FloorPlanError, match=f"{option}: expected"):
        traced(floor(5, 5), **{option: value})


@pytest.mark.parametrize("resolution", [0.0, -1.0, math.nan, math.inf, 1e-5])
def test_a_plan_is_not_drawn_with_cells_of_no_size(resolution: float, square_room: FloorPlan) -> None:
    with pytest.raises(FloorPlanError, match=r"resolution: expected|million"):
        rasterise(square_room, resolution)


def test_a_picture_of_32_bits_is_refused(tmp_path: Path) -> None:
    from PIL import Image

    for name, pixels in (("real", np.full((9, 9), 1e6, np.float32)), ("whole", np.full((9, 9), 70_000, np.int32))):
        Image.fromarray(pixels).save(tmp_path / f"{name}.tif")
        with pytest.raises(FloorPlanError, match=rf"{name}.tif: its pixels have 32 bits; save it with 8 or 16"):
            read_occupancy_grid(tmp_path / f"{name}.tif", 0.1)


def test_a_map_that_breaks_off_in_writing_leaves_the_one_that_was(
    tmp_path: Path, square_room: FloorPlan, monkeypatch: pytest.MonkeyPatch
) -> None:
    grid = rasterise(square_room, 0.1)
    write_occupancy_grid(grid, tmp_path / "map.yaml")
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}

    def stopped(self: Path, text: str, **options: object) -> None:
        self.write_bytes(b"half of it")
        raise KeyboardInterrupt

    monkeypatch.setattr(Path, "write_text", stopped)
    with pytest.raises(KeyboardInterrupt):
        write_occupancy_grid(grid, tmp_path / "map.yaml")
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before

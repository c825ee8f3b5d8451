"""Maps of ROS' map_server, read as map_server reads them, and written."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from cyclic_env.errors import FloorPlanError
from cyclic_env.floor_plans import (
    OccupancyGrid,
    load_floor_plan,
    read_floor_plan,
    read_occupancy_grid,
    trace_floor_plan,
    write_occupancy_grid,
)
from cyclic_env.floor_plans.occupancy.grid import CELLS_MAX
from tests.floor_plans.occupancy.drawing import floor, holds, image_of, write_map
from tests.helpers import refused

SHADES = np.array([[0, 254, 205], [255, 60, 220]], np.uint8)


def row(*pixels: Any, dtype: Any = np.uint8) -> np.ndarray:
    """Return an image of one row."""
    return np.array([pixels], dtype)


TRINARY = [[100, 0, -1], [0, 100, 0]]
ALPHA = row((0, 0, 0, 255), (255, 255, 255, 0), (255, 255, 255, 255))
LEFT_OUT = {"negate": None, "occupied_thresh": None, "free_thresh": None, "cost_scaling": 3, "mode": "Trinary"}
CELLS: dict[str, tuple[Any, dict[str, Any], list[list[int]]]] = {
    "trinary is free, occupied or unknown": (SHADES, {}, TRINARY),
    "keys may be left out and others be there": (SHADES, LEFT_OUT, TRINARY),
    "thresholds themselves are unknown": (  # of 0.8 and 0.2, and one to each side
        row(51, 52, 50, 204, 205, 203),
        {"occupied_thresh": 0.8, "free_thresh": 0.2},
        [[-1, -1, 100, -1, 0, -1]],
    ),
    "negate makes light walls": (255 - SHADES, {"negate": 1}, TRINARY),
    "negate may be a bool": (255 - SHADES, {"negate": True}, TRINARY),
    "scale has percentages between and alpha for unknown": (
        row((0, 0, 0, 255), (255, 255, 255, 255), (127, 127, 127, 255), (0, 0, 0, 254)),
        {"mode": "scale", "occupied_thresh": 0.9, "free_thresh": 0.1},
        [[100, 0, round(100 * (128 / 255 - 0.1) / 0.8), -1]],
    ),
    "raw pixels are percentages": (row(0, 49, 100, 101, 255), {"mode": "raw"}, [[0, 49, 100, -1, -1]]),
    "colors are averaged": (row((255, 0, 0), (255, 255, 150), (255, 255, 100)), {}, [[100, 0, -1]]),  # 85, 220, 203.3
    "trinary averages alpha too": (ALPHA, {}, [[100, -1, 0]]),  # shares 0.75, 0.25, 0
    "sixteen bits are read": (SHADES.astype(np.uint16) * 257, {}, TRINARY),
    "black and white is read": (row(True, False, dtype=bool), {}, [[0, 100]]),
    "map_saver's grey is unknown by any threshold": (
        row(0, 205, 254),
        {"free_thresh": 0.25},
        [[100, -1, 0]],
    ),
    "other greys are not": (row(0, 205, 254, 230), {"free_thresh": 0.25}, [[100, 0, 0, 0]]),
}


@pytest.mark.parametrize(("image", "keys", "cells"), CELLS.values(), ids=CELLS)
def test_pixels_are_read_as_map_server_reads_them(image: Any, keys: Any, cells: Any, tmp_path: Path) -> None:
    grid = read_occupancy_grid(write_map(tmp_path, Image.fromarray(image), **keys))
    assert grid.cells[::-1].tolist() == cells  # rows from the top


def test_light_grey_is_counted_where_the_threshold_makes_it_unknown(tmp_path: Path) -> None:
    shades = np.array([[0, 128, 128, 150, 180, 100, 254]], np.uint8)  # unseen is 128, 100 more likely occupied
    assert read_occupancy_grid(write_map(tmp_path, shades)).doubtful == 2
    assert read_occupancy_grid(write_map(tmp_path, shades, mode="scale")).doubtful == 0
    assert read_occupancy_grid(write_map(tmp_path, SHADES)).doubtful == 0


def test_numbers_may_be_written_with_an_exponent_alone(tmp_path: Path) -> None:
    path = write_map(tmp_path, SHADES, resolution=None)
    path.write_text(path.read_text() + "resolution: 5e-2\n")
    assert read_occupancy_grid(path).resolution == 0.05


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


def test_a_picture_has_dark_walls_and_paper_may_be_transparent(tmp_path: Path) -> None:
    pixels = np.zeros((100, 160, 4), np.uint8)  # transparent
    pixels[20:80, 20:140] = (0, 0, 0, 255)
    pixels[24:76, 24:136] = (255, 255, 255, 255)
    Image.fromarray(pixels).save(tmp_path / "drawing.png")
    plan = trace_floor_plan(read_occupancy_grid(tmp_path / "drawing.png", resolution=0.1)).plan
    assert plan.name == "drawing"
    assert plan.bounds == pytest.approx((2.4, 2.4, 13.6, 7.6), abs=0.01)  # the hall, and not the paper around it


def test_a_written_map_is_read_back_as_it_was(tmp_path: Path) -> None:
    cells = np.array([[0, 100, -1], [30, 60, 10]], np.int8)
    about = {"name": "hut", "title": "A hüt", "source": "me", "licence": "CC0", "start": (1.0, 2.0, 0.5)}
    grid = OccupancyGrid(cells=cells, resolution=0.1, origin=(1.0, -2.0, 0.25), **about)
    write_occupancy_grid(grid, tmp_path / "hut.yaml")
    back = read_occupancy_grid(tmp_path / "hut.yaml")
    assert back.cells.tolist() == [[0, 100, -1], [-1, -1, 0]]
    assert (back.resolution, back.origin) == (0.1, (1.0, -2.0, 0.25))
    assert {key: getattr(back, key) for key in about} == about


MISTAKES: dict[str, tuple[dict[str, Any], str]] = {
    "missing image": ({"image": "other.pgm"}, "image: there is no file .*other.pgm"),
    "image that is no image": ({"image": "map.yaml"}, "image: .*map.yaml is no complete picture"),
    "tiny resolution": ({"resolution": 1e-6}, "fits nowhere.*resolution"),
    "unknown mode": ({"mode": "binary"}, "mode: unknown mode 'binary'.*trinary"),
    "start in unknown space": ({"start": {"x": 3.5, "y": 1}}, r"start \(3.5, 1\) is in a wall, in unknown .*move it"),
    "start at a wall": ({"start": {"x": 0.2, "y": 1}}, r"start \(0.2, 1\) is too near a wall; .*\(0.3"),
}


@pytest.mark.parametrize(("keys", "message"), MISTAKES.values(), ids=MISTAKES.keys())
def test_a_mistake_is_one_line_that_names_the_file(keys: dict[str, Any], message: str, tmp_path: Path) -> None:
    image = np.full((40, 80), 254, np.uint8)
    image[[0, -1]] = image[:, [0, -1]] = 0 if "negate" not in keys else 254
    image[:, 60:] = 205 if "negate" not in keys else 254
    with refused(f"^{re.escape(str(tmp_path / 'map.yaml'))}: .*{message}", FloorPlanError):
        load_floor_plan(write_map(tmp_path, image, **keys))


@pytest.mark.parametrize("size", [9_000, 30_000])
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
    with pytest.raises(FloorPlanError, match=r"map.yaml: image: .* is no complete picture"):
        read_floor_plan(path)


def test_a_picture_needs_a_resolution_and_a_map_has_one(tmp_path: Path) -> None:
    write_map(tmp_path, SHADES)
    for read in (load_floor_plan, read_occupancy_grid):
        with pytest.raises(FloorPlanError, match=r"map.png: a picture does not say how large a pixel is"):
            read(tmp_path / "map.png")
    with pytest.raises(FloorPlanError, match=r"map.yaml: the file itself states"):
        read_occupancy_grid(tmp_path / "map.yaml", resolution=0.1)

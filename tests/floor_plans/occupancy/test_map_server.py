"""Maps of ROS' map_server, read as map_server reads them, and written."""

from __future__ import annotations

import math
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

SHADES = np.array([[0, 254, 205], [255, 60, 220]], np.uint8)


def read_cells(folder: Path, image: np.ndarray | Image.Image, **keys: Any) -> list[list[int]]:
    """Return the cells of a map as rows from the top."""
    return read_occupancy_grid(write_map(folder, image, **keys)).cells[::-1].tolist()


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


def test_a_map_that_can_not_be_written_is_one_line(tmp_path: Path) -> None:
    grid = OccupancyGrid(cells=np.zeros((2, 2), np.int8), resolution=1.0)
    with pytest.raises(FloorPlanError, match="can't be written"):
        write_occupancy_grid(grid, tmp_path / "no" / "map.yaml")


MISTAKES: dict[str, tuple[dict[str, Any], str]] = {
    "missing image": ({"image": "other.pgm"}, "image: there is no file .*other.pgm"),
    "image that is a number": ({"image": 3}, "image: expected the path of a picture, got 3"),
    "image that is no image": ({"image": "map.yaml"}, "image: .*map.yaml is no complete picture"),
    "no resolution": ({"resolution": None}, "resolution: is missing"),
    "resolution of 0": ({"resolution": 0}, "resolution: expected metres per pixel, .* got 0"),
    "resolution in words": ({"resolution": "5 cm"}, "resolution: expected a number.*'5 cm'"),
    "tiny resolution": ({"resolution": 1e-6}, "fits nowhere.*resolution"),
    "origin without yaw": ({"origin": [0, 0]}, r"origin: expected \[x, y, yaw\], got \[0, 0\]"),
    "unknown mode": ({"mode": "binary"}, "mode: unknown mode 'binary'.*trinary"),
    "negate in words": ({"negate": "no way"}, "negate: expected 0 or 1"),
    "thresholds crossed": ({"occupied_thresh": 0.1}, "free_thresh is 0.196 and occupied_thresh 0.1"),
    "start in unknown space": ({"start": {"x": 3.5, "y": 1}}, r"start \(3.5, 1\) is in a wall, in unknown .*move it"),
    "start at a wall": ({"start": {"x": 0.2, "y": 1}}, r"start \(0.2, 1\) is too near a wall; .*\(0.3"),
    "all wall": ({"negate": 1}, "the map has no free cell; are the thresholds right, and negate"),
}


@pytest.mark.parametrize(("keys", "message"), MISTAKES.values(), ids=MISTAKES.keys())
def test_a_mistake_is_one_line_that_names_the_file(keys: dict[str, Any], message: str, tmp_path: Path) -> None:
    image = np.full((40, 80), 254, np.uint8)
    image[[0, -1]] = image[:, [0, -1]] = 0 if "negate" not in keys else 254
    image[:, 60:] = 205 if "negate" not in keys else 254
    with pytest.raises(FloorPlanError, match=message) as caught:
        load_floor_plan(write_map(tmp_path, image, **keys))
    assert str(caught.value).startswith(f"{tmp_path / 'map.yaml'}: ")
    assert "\n" not in str(caught.value)


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


def test_a_picture_of_32_bits_is_refused(tmp_path: Path) -> None:
    from PIL import Image

    for name, pixels in (("real", np.full((9, 9), 1e6, np.float32)), ("whole", np.full((9, 9), 70_000, np.int32))):
        Image.fromarray(pixels).save(tmp_path / f"{name}.tif")
        with pytest.raises(FloorPlanError, match=rf"{name}.tif: its pixels have 32 bits; save it with 8 or 16"):
            read_occupancy_grid(tmp_path / f"{name}.tif", 0.1)

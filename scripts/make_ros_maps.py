"""Draw six buildings as maps of ROS' map_server, some as an architect draws them, one as a laser scanner maps it."""

from __future__ import annotations

if __name__ == "__main__":
    from _cli import run_script

    run_script(__file__)

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
import shapely
from scipy import ndimage
from shapely import Polygon

from cyclic_env.atomic_write import check_outputs
from cyclic_env.floor_plans import FloorPlan, OccupancyGrid, polygon_from_corridors, rasterize, write_occupancy_grid
from cyclic_env.floor_plans.occupancy.grid import FREE, OCCUPIED, UNKNOWN
from scripts._cli import command, progress_bar

SOURCE = "drawn by scripts/make_ros_maps.py"
RESOLUTION = 0.05
"""Metres per pixel, as in most scanned maps."""
WALL, DOOR = 0.2, 1.1
"""Thickness of a wall and width of a door, metres."""

BEAMS, RANGE_MAX, RANGE_SIGMA = 540, 16.0, 0.015
"""Beams of the scanner, their reach and noise, metres."""
SCAN_SPACING = 0.5
"""Distance walked between two scans, metres."""
OUTLIERS = 0.004
"""Share of the beams that return from an arbitrary distance, from the air or from beyond a wall."""
PEOPLE = 0.2
"""Probability that a person stands near the scanner and is scanned."""
PANE, MULLION = 0.4, 0.15
"""Width of the windows in outer walls, which a laser sees through, and of the posts between them, metres."""
YARD = 9.0
"""Distance from the building to what a laser meets outside, metres."""
LEGS = 0.2
"""Chair legs and the like per square metre, at most 0.15 m thick."""
OCCUPIED_FROM = 0.25
"""A cell is a wall if more than this share of the beams in it ended there."""

Point = tuple[float, float]


class Building(NamedTuple):
    """A building, and the walk of a person with a scanner through it.

    Attributes
    ----------
    plan : FloorPlan
    walk : tuple of ((x, y), (x, y))
        Straight stretches, metres.
    """

    plan: FloorPlan
    walk: tuple[tuple[Point, Point], ...]


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of the command."""

    out: Path = Path("out/ros_maps")
    """folder for the maps"""


@command(Options)
def main(args: Options) -> None:
    """Run the command."""
    check_outputs(args.out / f"{name}{suffix}" for name in MAPS for suffix in (".yaml", ".pgm"))
    for name, draw in MAPS.items():
        path = args.out / f"{name}.yaml"
        grid = draw()
        write_occupancy_grid(grid, path)
        rows, columns = grid.cells.shape
        print(f"written: {path}, {columns:,} x {rows:,} pixels")


def office_floor() -> OccupancyGrid:
    """Draw two blocks of offices with a ring of corridors around each."""
    model = building(
        "office_floor",
        "Two blocks with offices on both sides of the corridors",
        2.2,
        [_ring(76, 38), [(38, 0), (38, 38)]],
        [
            ((76, 0), (0, 0), 5.5, 9),
            ((0, 38), (76, 38), 5.5, 9),
            ((2, 0), (36, 0), 6.0, 4),
            ((40, 0), (74, 0), 6.0, 4),
            ((36, 38), (2, 38), 6.0, 4),
            ((74, 38), (40, 38), 6.0, 4),
        ],
    )
    return replace(rasterize(model.plan, RESOLUTION), start=None)


def hospital() -> OccupancyGrid:
    """Draw four courtyards with wards around them and a wing that ends blindly, at an angle to the map's frame."""
    model = building(
        "hospital",
        "Four courtyards and a wing, at an angle",
        2.6,
        [_ring(80, 48), [(38, 0), (38, 48)], [(0, 22), (104, 22)]],
        [
            ((80, 0), (0, 0), 6.5, 8),
            ((0, 48), (80, 48), 6.5, 8),
            ((0, 2), (0, 20), 5.0, 2),
            ((0, 26), (0, 46), 5.0, 2),
            ((84, 22), (104, 22), 6.0, 3),
            ((104, 22), (84, 22), 6.0, 3),
        ],
    )
    return replace(rasterize(model.plan, RESOLUTION), origin=(-40.0, 12.5, 0.3), start=None)


def laboratory() -> OccupancyGrid:
    """Draw three blocks with laboratories along the windows, as a scanner maps them on a walk through all rooms."""
    model = building(
        "laboratory",
        "Three blocks with laboratories along the windows, as a scanner leaves it",
        2.4,
        [_ring(72, 40), [(22, 0), (22, 40)], [(50, 0), (50, 40)]],
        [
            ((72, 0), (0, 0), 5.5, 8),
            ((0, 40), (72, 40), 5.5, 8),
            ((24, 0), (48, 0), 6.0, 3),
            ((48, 40), (24, 40), 6.0, 3),
        ],
        furnished=True,
    )
    return scan(model, np.random.default_rng(0))


def glimpsed_loop() -> OccupancyGrid:
    """Draw two loops, one of them closed only by a corridor without walls, and a yard that was seen through a door.

    The scanner was neither in the white corridor between the two halls in the north, 5 m x 1.1 m, nor in the yard
    behind the door in the west, which is 0.9 m wide.
    """
    corridors = [(2.2, _ring(30, 26)), (2.2, [(30, 0), (70, 0), (70, 26), (55, 26)])]
    rooms = [(30, 23, 42, 29), (47, 23, 58, 29), (41, 25.4, 48, 26.5), (1, 12, 4, 12.9), (3, 7, 13, 18)]
    plan = FloorPlan(
        "glimpsed_loop",
        polygon_from_corridors(corridors, [list(shapely.box(*room).exterior.coords[:-1]) for room in rooms]),
        (0, 0, 0),
        "A loop behind a corridor that was only looked into",
        SOURCE,
        "MIT",
    )
    grid = rasterize(plan, RESOLUTION)
    for west, south, east, north in ((42.1, 24, 46.9, 28), (1.3, 6, 14, 19)):
        columns, rows = grid.to_grid(np.array([(west, south), (east, north)])).astype(int).T
        part = grid.cells[slice(*rows), slice(*columns)]
        part[part == OCCUPIED] = UNKNOWN
    return replace(grid, start=None)


def short_laps() -> OccupancyGrid:
    """Draw two blocks, and five kiosks with laps of less than 40 m, though rooms make the rings of four longer."""
    blocks = [shapely.box(x, 2.4, x + 28, 16) for x in (2.4, 32.8)]
    kiosks = [shapely.box(x, 19, x + 8.6, 27.6) for x in (2.4, 15.2, 28.0, 40.8, 52.2)]
    rooms = [
        shapely.box(x + 0.8 + 2.6 * i, 20, x + 2.6 + 2.6 * i, 27.6) for x in (2.4, 15.2, 28.0, 40.8) for i in range(3)
    ]
    space = (
        shapely.box(0, 0, 63.2, 30).difference(shapely.union_all([*blocks, *kiosks])).union(shapely.union_all(rooms))
    )
    assert isinstance(space, Polygon)
    plan = FloorPlan(
        "short_laps", space, (1.2, 1.2, 0), "Two blocks, and five kiosks that are no cycles", SOURCE, "MIT"
    )
    return replace(rasterize(plan, RESOLUTION), start=None)


def corner_doors() -> OccupancyGrid:
    """Draw a loop of corridors with rooms of 12 m, each with a door of 0.9 m in its corner.

    From the far end of a room, of 180 beams only three or four pass through the door; 1,080 beams show it well.
    """
    parts = []
    for i in range(4):
        west = 12.2 * i
        for south, door in ((-13.3, -1.4), (20.9, 20.7)):
            parts += [shapely.box(west, south, west + 12, south + 12), shapely.box(west, door, west + 0.9, door + 0.4)]
    corridor = [(0, 0), (48.6, 0), (48.6, 19.6), (0, 19.6), (0, 0)]
    space = polygon_from_corridors([(2.2, corridor)], [list(part.exterior.coords[:-1]) for part in parts])
    plan = FloorPlan("corner_doors", space, (0, 0, 0), "Rooms of 12 m with doors in their corners", SOURCE, "MIT")
    return replace(rasterize(plan, RESOLUTION), start=None)


MAPS: dict[str, Callable[[], OccupancyGrid]] = {
    draw.__name__: draw for draw in (office_floor, hospital, laboratory, glimpsed_loop, short_laps, corner_doors)
}


def building(
    name: str,
    title: str,
    width: float,
    lines: Sequence[Sequence[Point]],
    rows: Sequence[tuple[Point, Point, float, int]],
    *,
    furnished: bool = False,
) -> Building:
    """Return a building of corridors and of rows of rooms beside them.

    Parameters
    ----------
    name, title : str
    width : float
        Width of the corridors, metres.
    lines : sequence of lines
        Centrelines of the corridors.
    rows : sequence of ((x, y), (x, y), depth, number)
        Rooms to the left of the way from one point of a centreline to another, each with a door to the corridor.
    furnished : bool
        Whether each room has a table, and a bench along its far wall.
    """
    parts, furniture, walk = [], [], [pair for line in lines for pair in pairwise(line)]
    near = width / 2 + WALL
    for start, end, depth, number in rows:
        length = math.dist(start, end)
        ahead = np.subtract(end, start) / length
        frame = np.array([start, ahead, (-ahead[1], ahead[0])])
        side = length / number
        for i in range(number):
            west, east = side * i, side * (i + 1) - WALL
            door = west + side * (0.35 if i % 2 else 0.6)
            parts.append(_box(frame, west, east, near, near + depth))
            parts.append(_box(frame, door - DOOR / 2, door + DOOR / 2, width / 2 - 0.1, near + 0.1))
            furniture.append(_box(frame, west + 0.2 * side, west + 0.5 * side, near + depth - 0.7, near + depth))
            table = west + side * (0.7 if i % 2 else 0.1)
            furniture.append(_box(frame, table, table + 1.4, near + 0.4 * depth, near + 0.4 * depth + 0.8))
            walk.append((_at(frame, door, 0.0), _at(frame, door, near + 0.5 * depth)))
    space = polygon_from_corridors([(width, line) for line in lines], [part.exterior.coords[:-1] for part in parts])
    if furnished:
        space = space.difference(shapely.union_all(furniture))
    assert isinstance(space, Polygon)
    plan = FloorPlan(name, space, (*lines[0][0], 0.0), title, SOURCE, "MIT")
    return Building(plan, tuple(walk))


def _ring(width: float, height: float) -> list[Point]:
    return [(0, 0), (width, 0), (width, height), (0, height), (0, 0)]


def _at(frame: np.ndarray, along: float, aside: float) -> Point:
    x, y = frame[0] + along * frame[1] + aside * frame[2]
    return float(x), float(y)


def _box(frame: np.ndarray, west: float, east: float, south: float, north: float) -> Polygon:
    return Polygon([_at(frame, u, v) for u, v in ((west, south), (east, south), (east, north), (west, north))])


def scan(model: Building, rng: np.random.Generator) -> OccupancyGrid:
    """Scan a building: through windows, with people, chair legs, noise and unseen corners.

    Cells that no beam passed are unknown, including those that only beams without an echo passed.
    """
    clear = rasterize(model.plan, RESOLUTION)
    margin = round(YARD / RESOLUTION)
    corner = np.subtract(clear.origin[:2], YARD)
    solid = np.pad(clear.cells != FREE, margin, constant_values=True)
    free_cells = np.argwhere(~solid)
    solid &= ~_seen_through(solid)
    solid[[0, -1]] = solid[:, [0, -1]] = True
    for row, column in rng.choice(free_cells, round(LEGS * model.plan.free_area)):
        height, width = rng.integers(1, 4, 2)
        solid[row : row + height, column : column + width] = True
    hits, passes = (np.zeros(solid.size, np.int32) for _ in range(2))
    with progress_bar(len(model.walk), "corridor", desc="scanning") as progress:
        for start, end in model.walk:
            for position in np.linspace(start, end, 1 + math.ceil(math.dist(start, end) / SCAN_SPACING)):
                _add_scan(solid, (position - corner) / RESOLUTION, hits, passes, rng)
            progress.update()
    cells = np.where(hits > OCCUPIED_FROM * passes, OCCUPIED, np.where(passes > 0, FREE, UNKNOWN))
    x, y = (float(value) for value in corner)
    return replace(clear, cells=cells.reshape(solid.shape).astype(np.int8), origin=(x, y, 0.0), start=None)


def _seen_through(solid: np.ndarray) -> np.ndarray:
    """Return which solid cells light passes through: the yard and the panes of windows in the outer wall."""
    inside = ndimage.binary_fill_holes(ndimage.binary_closing(~solid, iterations=round(WALL / RESOLUTION)))
    away, nearest = ndimage.distance_transform_edt(~inside, return_indices=True)
    row, column = np.indices(solid.shape)
    above, beside = row != nearest[0], column != nearest[1]  # both hold at the corners of the building, which are solid
    pane = (above != beside) & ((np.where(above, column, row) * RESOLUTION) % (PANE + MULLION) < PANE)
    return ~inside & ((away * RESOLUTION > WALL) | pane)


def _add_scan(
    solid: np.ndarray, place: np.ndarray, hits: np.ndarray, passes: np.ndarray, rng: np.random.Generator
) -> None:
    """Cast the beams of a scan from `place`, column and row, and count where they end and which cells they pass."""
    angles = 2 * math.pi * (np.arange(BEAMS) + rng.random()) / BEAMS
    steps = np.arange(1, int(RANGE_MAX / RESOLUTION) + 1)
    columns, rows = (
        np.clip((low + steps * way[:, None]).astype(np.int64), 0, size - 1)
        for low, way, size in zip(place, (np.cos(angles), np.sin(angles)), solid.shape[::-1], strict=True)
    )
    cells = rows * solid.shape[1] + columns
    echoes = solid.ravel()[cells]
    if rng.random() < PEOPLE:
        distance = rng.integers(15, 60)
        beams = rng.integers(BEAMS) + np.arange(round(0.4 / (distance * RESOLUTION) * BEAMS / (2 * math.pi)))
        echoes[beams % BEAMS, distance] = True
    returned = echoes.any(axis=1)
    end = np.rint(echoes.argmax(axis=1) + rng.normal(0.0, RANGE_SIGMA / RESOLUTION, BEAMS)).astype(int)
    stray = rng.random(BEAMS) < OUTLIERS
    end[stray] = rng.integers(5, len(steps), np.count_nonzero(stray))
    returned |= stray
    end = np.where(returned, np.clip(end, 0, len(steps) - 1), 0)
    np.add.at(passes, cells[np.arange(len(steps)) < end[:, None]], 1)
    np.add.at(hits, cells[returned, end[returned]], 1)

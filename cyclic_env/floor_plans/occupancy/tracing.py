"""From an occupancy grid to a floor plan: the free space that a robot can reach, cleaned, traced and simplified.

Free space is 4-connected and walls are 8-connected, so that a wall one cell thick with diagonal steps is tight. What
the robot can reach is found by its centre: cells that are a radius away from every wall, connected with the start. From
these the space is grown back to the walls cell by cell, such that it never meets itself. The plan thus has a hole for
each obstacle, or group of obstacles, that the robot can drive around, and no other holes: two walls between which the
robot does not fit are joined.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
import shapely
from shapely.geometry import Point, Polygon

from cyclic_env.config import RobotConfig
from cyclic_env.errors import FloorPlanError
from cyclic_env.floor_plans.floor_plan import COORDINATE_MAX, FloorPlan, Pose
from cyclic_env.floor_plans.occupancy.dropped_places import DroppedPlace, dropped_places
from cyclic_env.floor_plans.occupancy.grid import OccupancyGrid
from cyclic_env.floor_plans.occupancy.morphology import grow_back
from cyclic_env.floor_plans.occupancy.outline import simplify_outline, trace_outline
from cyclic_env.floor_plans.occupancy.regions import (
    FITS_NOWHERE,
    crop,
    drop_glimpses,
    drop_specks,
    reachable_centres,
)
from cyclic_env.jit import compile_notice
from cyclic_env.validation import short_repr

CLEARANCE = 0.5
"""Least distance between the robot and the centre of a wall's cell, in cells; half a cell is up to the wall's side."""

ROUNDS = 4
"""Number of attempts. If the robot does not pass everywhere in the simplified plan, each attempt closes wider passages;
the last one closes all that two simplified walls may narrow too much, each by the tolerance and a cell's corner."""

HEADINGS = 72
"""Number of headings among which that of the start is chosen."""


STAGES = ("dropping specks", "reaching cells", "dropping glimpses", "growing to the walls", "tracing the outline")


class _Sizes(NamedTuple):
    """The numeric arguments of `trace_floor_plan`, metres and square metres."""

    robot_radius: float
    speck_area: float
    gap: float
    nook_area: float
    door: float
    tolerance: float


class Tracing(NamedTuple):
    """A floor plan traced from a grid, and what was left out of it.

    Attributes
    ----------
    plan : FloorPlan
    specks : int
        Number of groups of wall cells that were too small to keep.
    speck_area, dropped_area : float
        Area of these, and of free cells that are not in the plan because they are out of reach or too narrow, m2.
    dropped : tuple of DroppedPlace
        The larger places among these cells.
    """

    plan: FloorPlan
    specks: int
    speck_area: float
    dropped_area: float
    dropped: tuple[DroppedPlace, ...]


def trace_floor_plan(
    grid: OccupancyGrid,
    *,
    start: Pose | None = None,
    robot_radius: float = RobotConfig().radius,
    speck_area: float = 0.04,
    gap: float = 0.2,
    nook_area: float = 0.5,
    door: float = 1.2,
    tolerance: float | None = None,
    progress: Callable[[str], None] = lambda stage: None,
) -> Tracing:
    """Trace the floor plan of an occupancy grid such that a robot passes everywhere in it.

    Parameters
    ----------
    grid : OccupancyGrid
        Cells that are not free, including unknown ones, are walls.
    start : (x, y, heading), optional
        World pose from which the plan can be reached, metres and radians; by default the grid's. Without one, the plan
        is the largest free space, and starts where there is most room, facing the longest line of sight.
    robot_radius : float
        Metres. Passages must be a cell or two wider than the robot, or up to five where simplified walls would
        otherwise be in its way. Narrower ones are closed, and what lies beyond is left out.
    speck_area : float
        Square metres. Smaller groups of wall cells, two cells away from others, are dropped, unless they separate two
        places, as the posts of windows do.
    gap : float
        Metres. Narrower free space, such as a single ray through a window, is closed, but not where the robot fits.
    nook_area : float
        Square metres. Free space that the robot can't enter but sees is a niche, and kept, up to this size.
    door : float
        Metres. A place behind a narrower opening that ends in unknown space rather than at walls was only looked into.
        It is closed, unless it joins places with walls or is on the way to one. 0 keeps all such places.
    tolerance : float, optional
        Metres by which simplified walls may differ from the sides of cells; by default 1.5 cells. It is halved where
        the robot would otherwise not pass.
    progress : callable
        Called with the name of each of `STAGES` when it begins.

    Raises
    ------
    FloorPlanError
        If there is no free space, the robot fits nowhere or not at the start, or an argument makes no sense.
    """
    tolerance = 1.5 * grid.resolution if tolerance is None else tolerance
    start = grid.start if start is None else start
    sizes = _Sizes(robot_radius, speck_area, gap, nook_area, door, tolerance)
    _check_arguments(grid, sizes, start)
    with compile_notice():
        grow_back(np.ones((3, 3), bool), np.ones((3, 3), bool), 1.0, 1.0, 1.0)
    with_pockets: Tracing | None = None
    problems: list[FloorPlanError] = []
    try:
        for tracing, all_reached in _tracings(grid, start, sizes, problems, progress):
            if all_reached:
                return tracing
            with_pockets = with_pockets or tracing
    except FloorPlanError as error:
        problems.append(error)
    if with_pockets is None:
        raise problems[0]
    return with_pockets


def _check_arguments(grid: OccupancyGrid, sizes: _Sizes, start: Pose | None) -> None:
    for name, value in sizes._asdict().items():
        if not 0 <= value < math.inf or (name == "robot_radius" and value == 0):
            raise FloorPlanError(f"{name}: expected metres, finite and not below 0, got {short_repr(value)}.")
    if start is not None and not all(abs(value) <= COORDINATE_MAX for value in start):  # nor NaN
        raise FloorPlanError(
            f"start: expected x, y and heading from {-COORDINATE_MAX:g} to {COORDINATE_MAX:g}, got {short_repr(start)}."
        )
    if not grid.free.any():
        raise FloorPlanError("the map has no free cell; are the thresholds right, and negate?")
    if 2 * sizes.robot_radius > grid.resolution * min(grid.cells.shape):
        raise FloorPlanError(FITS_NOWHERE)


def _tracings(
    grid: OccupancyGrid,
    start: Pose | None,
    sizes: _Sizes,
    problems: list[FloorPlanError],
    progress: Callable[[str], None],
) -> Iterator[tuple[Tracing, bool]]:
    """Yield plans that the robot can drive, traced for an ever larger robot; add the problems of others to a list.

    With each plan comes whether the robot reaches all of it, apart from nooks.
    """
    side, part = grid.resolution, crop(grid)
    progress(STAGES[0])
    specks, speck_cells = drop_specks(part.free, sizes.speck_area / side**2, sizes.robot_radius / side + CLEARANCE)
    for i in range(ROUNDS):
        radius = sizes.robot_radius / side + CLEARANCE + i / (ROUNDS - 1) * (1 + sizes.tolerance / side)
        progress(STAGES[1])
        reachable = reachable_centres(part, radius, start)
        progress(STAGES[2])
        centres = drop_glimpses(reachable, part, radius, sizes.door / side, start)
        progress(STAGES[3])
        space = grow_back(centres, part.free, radius, sizes.gap / side, sizes.nook_area / side**2)
        progress(STAGES[4])
        outline = trace_outline(space, part.corner)
        dropped = side**2 * int(np.count_nonzero(part.free) - np.count_nonzero(space))
        for share in (1.0, 0.5):
            try:
                polygon = simplify_outline(outline, share * sizes.tolerance / side, grid)
                plan = _plan(grid, polygon, start, sizes.robot_radius)
                home = plan.reachable(sizes.robot_radius)
            except FloorPlanError as error:
                problems.append(error)
                continue
            places = dropped_places(part, space, reachable & ~centres)
            tracing = Tracing(plan, specks, side**2 * speck_cells, dropped, places)
            yield tracing, not plan.unreached(home, sizes.robot_radius)


def _plan(grid: OccupancyGrid, polygon: Polygon, start: Pose | None, robot_radius: float) -> FloorPlan:
    start = _roomiest(polygon, grid.resolution) if start is None else start
    return FloorPlan(grid.name, polygon, start, grid.title, grid.source, grid.licence, robot_radius=robot_radius)


def _roomiest(polygon: Polygon, precision: float) -> Pose:
    """Return the point furthest from all walls, with the heading of the longest line of sight from there."""
    x, y = (round(value, 2) for value in shapely.maximum_inscribed_circle(polygon, precision).coords[0])
    west, south, east, north = polygon.bounds
    headings = 2 * math.pi / HEADINGS * np.arange(HEADINGS)
    far = (x, y) + math.hypot(east - west, north - south) * np.stack([np.cos(headings), np.sin(headings)], axis=1)
    rays = shapely.linestrings([[(x, y), end] for end in far])
    lengths = shapely.distance(Point(x, y), shapely.intersection(rays, polygon.boundary))
    heading = headings[np.argmax(np.round(lengths, 6))]
    return x, y, round(float(math.remainder(heading, 2 * math.pi)), 6)

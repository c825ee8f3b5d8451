"""From an occupancy grid to a floor plan: the free space that a robot can reach, cleaned, traced and simplified.

Free space is 4-connected and walls are 8-connected, so that a wall one cell thin with diagonal steps is tight. What the
robot can reach is found by its centre: cells a radius off every wall, connected with the start. From these the space is
grown back to the walls cell by cell, never by one that would join it to itself. So the plan has a hole for each
obstacle, or group of obstacles, that the robot can drive around, and for no other: where it does not fit between two
walls, they are joined.
"""

from __future__ import annotations

import math
from collections import defaultdict
from itertools import combinations, pairwise
from typing import Any, NamedTuple

import numpy as np
import shapely
from contourpy import FillType, contour_generator
from scipy import ndimage
from shapely.geometry import Point, Polygon

from cyclic_env.errors import FloorPlanError
from cyclic_env.floor_plans.floor_plan import COORDINATE_MAX, FloorPlan, Pose
from cyclic_env.floor_plans.occupancy.grid import FREE_BELOW, UNKNOWN, OccupancyGrid
from cyclic_env.jit import compile_notice, compiled
from cyclic_env.validation import short_repr

ENCLOSED_SHARE = 0.1
"""A region that the image's edge does not cut is preferred to a larger one that it does cut, such as the paper around
a drawing, down to this share of its area; and one with more walls to a larger one around it, such as the paper in a
drawing's frame."""

CLEARANCE = 0.5
"""Cells between the robot and the centre of the nearest wall cell, at least: half of one keeps it off its side."""

ROUNDS = 4
"""Where the robot does not pass through the simplified plan, wider and wider passages are closed, in the last round all
that simplified walls may narrow too far: each wall by the tolerance, and by a cell's corner."""

LONE_SHARE = 0.25
"""Share of the size of a speck from which one alone may hold two places apart."""

DECIMALS = 6
"""Of coordinates in metres, as files have them: rounded later, a wall that passes another closely might touch it."""

NEAR = 2.5
"""Cells. A wall as near as that to the end of what was seen bounds it; unknown space is more than twice as wide, and
thinner grey is the edge of a line."""

HEADINGS = 72
"""Among which the start's is chosen."""

FITS_NOWHERE = "the robot fits nowhere in the map's free space; is the resolution right?"

CONNECTED_8 = np.ones((3, 3), dtype=int)


class Tracing(NamedTuple):
    """A floor plan traced from a grid, and what was left out of it.

    Attributes
    ----------
    plan : FloorPlan
    specks : int
        Groups of walls too small to be kept.
    speck_area, dropped_area : float
        Square metres of these, and of free cells that are not in the plan: out of the robot's reach or too narrow.
    """

    plan: FloorPlan
    specks: int
    speck_area: float
    dropped_area: float


def trace_floor_plan(
    grid: OccupancyGrid,
    *,
    start: Pose | None = None,
    robot_radius: float = 0.25,
    speck_area: float = 0.04,
    gap: float = 0.2,
    nook_area: float = 0.5,
    door: float = 1.2,
    tolerance: float | None = None,
) -> Tracing:
    """Return the floor plan of an occupancy grid in which a robot passes everywhere.

    Parameters
    ----------
    grid : OccupancyGrid
        Cells that are not free, unknown ones too, are walls.
    start : (x, y, heading), optional
        World pose, metres and radians; by default the grid's. The free space that is reached from there is kept.
        Without, the largest one is kept, and the start is its roomiest point, looking along the longest line of sight.
    robot_radius : float
        Metres. Passages narrower than the robot are closed, and what lies beyond them is left out. They must be a
        cell or two wider than the robot, or up to five where simplified walls would else be in its way.
    speck_area : float
        Square metres. Smaller groups of wall cells, two cells from all others, are noise or chair legs, and dropped,
        unless they hold two places apart, as the posts of windows do.
    gap : float
        Metres. Free space narrower than this, such as single rays through windows, is closed; but none where the
        robot fits.
    nook_area : float
        Square metres. Free space that the robot can't enter but its laser sees into, such as a niche, is kept up to
        this size; what is larger lies behind a window, or a door too narrow, and is closed.
    door : float
        Metres. What lies behind an opening narrower than this and ends at unknown space rather than at walls was only
        looked into, through a window or a door, and is closed, unless it is the way to a place that has walls. 0 keeps
        it.
    tolerance : float, optional
        Metres by which simplified walls may differ from the cells' sides; by default 1.5 cells. Half of it is taken
        where walls would else become too crude for the robot to pass.

    Raises
    ------
    FloorPlanError
        If there is no free space, the robot fits nowhere or not at the start, or an argument makes no sense.
    """
    tolerance = 1.5 * grid.resolution if tolerance is None else tolerance
    sizes = {"robot_radius": robot_radius, "speck_area": speck_area, "gap": gap, "nook_area": nook_area, "door": door}
    for name, value in (sizes | {"tolerance": tolerance}).items():
        if not 0 <= value < math.inf or (name == "robot_radius" and value == 0):
            raise FloorPlanError(f"{name}: expected metres, finite and not below 0, got {short_repr(value)}.")
    start = grid.start if start is None else start
    if start is not None and not all(abs(value) <= COORDINATE_MAX for value in start):  # nor NaN
        raise FloorPlanError(
            f"start: expected x, y and heading from {-COORDINATE_MAX:g} to {COORDINATE_MAX:g}, got {short_repr(start)}."
        )
    free = grid.free
    if not free.any():
        raise FloorPlanError("the map has no free cell; are the thresholds right, and negate?")
    with compile_notice():
        _grown(np.ones((3, 3), bool), np.ones((3, 3), bool), 1.0, 1.0, 1.0)
    side = grid.resolution
    if 2 * robot_radius > side * min(free.shape):
        raise FloorPlanError(FITS_NOWHERE)
    corner, free = _cropped(free)
    specks, speck_cells = _drop_specks(free, speck_area / side**2, robot_radius / side + CLEARANCE)
    with_pockets: Tracing | None = None
    problems: list[FloorPlanError] = []
    for i in range(ROUNDS):
        radius = robot_radius / side + CLEARANCE + i / (ROUNDS - 1) * (1 + tolerance / side)
        try:
            centres = _centres(free, radius, grid, corner, start)
            centres = _entered(centres, free, radius, door / side, grid, corner, start)
        except FloorPlanError as error:
            problems.append(error)
            break
        space = _grown(centres, free, radius, gap / side, nook_area / side**2)
        outline = _outline(space, corner)
        dropped = side**2 * int(np.count_nonzero(free) - np.count_nonzero(space))
        for share in (1.0, 0.5):
            polygon = _simplified(outline, share * tolerance / side, grid)
            try:
                plan = _plan(grid, polygon, start)
                home = plan.reachable(robot_radius)
            except FloorPlanError as error:
                problems.append(error)
                continue
            tracing = Tracing(plan, specks, side**2 * speck_cells, dropped)
            if not plan.unreached(home, robot_radius):
                return tracing
            with_pockets = with_pockets or tracing
    if with_pockets is None:
        raise problems[0]
    return with_pockets


def _cropped(free: np.ndarray) -> tuple[tuple[int, int], np.ndarray]:
    """Return the part of a mask in which there is anything, with a rim of walls, and row and column of its corner."""
    row, column = (np.flatnonzero(free.any(axis=axis))[[0, -1]] for axis in (1, 0))
    part = free[row[0] : row[1] + 1, column[0] : column[1] + 1]
    return (int(row[0]) - 1, int(column[0]) - 1), np.pad(part, 1)


def _drop_specks(free: np.ndarray, cells_min: float, radius: float) -> tuple[int, int]:
    """Free the groups of fewer wall cells than that, in place; return the number of groups and of cells.

    Cells of a group are at most one other cell apart, so that a wall that the laser saw as a row of dots is one group.
    Groups that keep a robot of that radius, in cells, from going from one place to another stay too, such as the posts
    of windows; but not a single one that is very small, such as noise in a doorway.
    """
    walls = ~free
    groups = ndimage.label(_dilated(walls, 1.5), CONNECTED_8)[0]
    groups[free] = 0
    sizes = np.bincount(groups.ravel())
    small = sizes < cells_min
    small[[0, groups[0, 0]]] = False  # no wall, and the rim
    regions = ndimage.label(~_dilated(walls, radius))[0]
    margin = math.ceil(radius) + 1
    posts = defaultdict(list)
    for group, box in enumerate(ndimage.find_objects(groups), 1):
        if small[group]:
            around = tuple(slice(max(part.start - margin, 0), part.stop + margin) for part in box)
            for pair in combinations(np.unique(regions[around][regions[around] > 0]), 2):
                posts[pair].append(group)
    for together in posts.values():
        if len(together) > 1 or sizes[together[0]] >= LONE_SHARE * cells_min:
            small[together] = False
    free |= small[groups]
    return int(np.count_nonzero(small)), int(sizes[small].sum())


def _entered(
    centres: np.ndarray,
    free: np.ndarray,
    radius: float,
    door: float,
    grid: OccupancyGrid,
    corner: tuple[int, int],
    start: Pose | None,
) -> np.ndarray:
    """Return the robot's centres without what was only looked into, of parts divided by openings narrower than a door.

    A part has been looked into if more of its outline is unknown than wall. It stays if it is on the way to a part as
    wide as a door that has walls, or narrow and between two that stay. So does everything, if the start's part is like
    that, or else the largest. Lengths are in cells.
    """
    from scipy.sparse import csr_array  # a tenth of a second that plans without unknown space don't need
    from scipy.sparse.csgraph import dijkstra

    half_door = door / 2 - radius
    if half_door < 1 or not (grid.cells == UNKNOWN).any():
        return centres
    wide = _dilated(centres & ~_dilated(~centres, half_door), half_door) & centres
    parts, count_wide = ndimage.label(wide)
    narrow, count = ndimage.label(centres & ~wide)
    parts[narrow > 0] = narrow[narrow > 0] + count_wide
    count += count_wide

    (row, column), (rows, columns) = corner, free.shape
    cells = np.pad(grid.cells, 1)[row + 1 : row + 1 + rows, column + 1 : column + 1 + columns]
    unseen = cells == UNKNOWN
    if 2 * np.count_nonzero(_dilated(~_dilated(~unseen, NEAR), NEAR)) < np.count_nonzero(unseen):
        return centres  # it is the grey of lines, as in a photograph of a drawing
    bounded = _dilated((cells >= FREE_BELOW) & ~free, NEAR)
    outline = _dilated(free, 1.5) & ~free & _dilated(centres, radius + 1.5)
    nearest = ndimage.distance_transform_edt(parts == 0, return_distances=False, return_indices=True)
    part_of = parts[nearest[0][outline], nearest[1][outline]]
    around = np.bincount(part_of, minlength=count + 1)
    walls = np.bincount(part_of[bounded[outline]], minlength=count + 1)
    glimpse = 2 * walls < around
    largest = 1 + int(np.argmax(np.bincount(parts.ravel())[1:]))
    home = largest if start is None else int(parts[_cell(start, grid, corner)])
    if glimpse[home]:
        return centres

    sides = [(parts[1:], parts[:-1]), (parts[:, 1:], parts[:, :-1])]
    pairs = np.concatenate([np.stack([a, b])[:, (a != b) & (a > 0) & (b > 0)] for a, b in sides], axis=1)
    pairs = np.unique(np.concatenate([pairs, pairs[::-1]], axis=1), axis=1)
    cost = np.where(glimpse[pairs[1]], count + 1, 1)  # rather through all others than through one of these
    ways = csr_array((cost, tuple(pairs)), shape=(count + 1, count + 1))
    (far,), (before,) = dijkstra(ways, indices=[home], return_predecessors=True)
    kept = far <= count
    for part in 1 + np.flatnonzero(~glimpse[1 : count_wide + 1]):
        while not kept[part]:
            kept[part] = True
            part = before[part]
    passage = np.bincount(pairs[0][kept[pairs[1]]], minlength=count + 1) > 1
    kept[count_wide + 1 :] |= passage[count_wide + 1 :]
    return kept[parts]


def _centres(
    free: np.ndarray, radius: float, grid: OccupancyGrid, corner: tuple[int, int], start: Pose | None
) -> np.ndarray:
    """Return the cells that the centre of a robot can reach from the start, or the largest region of such cells.

    Raises
    ------
    FloorPlanError
        If the robot fits nowhere, or not at the start.
    """
    open_space = ~_dilated(~free, radius)
    labels = ndimage.label(open_space)[0]
    sizes = np.bincount(labels.ravel())[1:]
    if not len(sizes):
        raise FloorPlanError(FITS_NOWHERE)
    if start is None:
        rows, columns = (np.array(size) - radius - 1 for size in grid.cells.shape)
        cut = [
            min(box[0].start + corner[0], box[1].start + corner[1]) < radius + 1
            or box[0].stop + corner[0] > rows
            or box[1].stop + corner[1] > columns
            for box in ndimage.find_objects(labels)
        ]
        return labels == _building(labels, np.where(cut, ENCLOSED_SHARE, 1.0) * sizes)
    row, column = _cell(start, grid, corner)
    inside = 0 <= row < free.shape[0] and 0 <= column < free.shape[1]
    if inside and open_space[row, column]:
        return labels == labels[row, column]
    rows, columns = np.nonzero(open_space)
    nearest = np.argmin((rows - row) ** 2 + (columns - column) ** 2)
    x, y = grid.to_world(np.array([[columns[nearest] + corner[1] + 0.5, rows[nearest] + corner[0] + 0.5]]))[0]
    fault = "too near a wall" if inside and free[row, column] else "in a wall, in unknown space or outside the map"
    raise FloorPlanError(f"start ({start[0]:g}, {start[1]:g}) is {fault}; move it, for example to ({x:.2f}, {y:.2f}).")


def _cell(pose: Pose, grid: OccupancyGrid, corner: tuple[int, int]) -> tuple[int, int]:
    """Return row and column of the cell that a pose is in, from a corner of the grid."""
    column, row = np.floor(grid.to_grid(np.array([pose[:2]]))[0]).astype(int) - corner[::-1]
    return int(row), int(column)


def _building(labels: np.ndarray, sizes: np.ndarray) -> int:
    """Return the label of the largest region, or of one within it that has more walls, if that is not far smaller.

    The paper between a drawing's frame and the building is larger than the building, but has fewer walls; so has a
    courtyard, which lies within the building.
    """
    edge = labels[(labels > 0) & ~ndimage.binary_erosion(labels > 0)]
    walls = np.bincount(edge, minlength=len(sizes) + 1)[1:]
    boxes = ndimage.find_objects(labels)
    best = int(np.argmax(sizes))
    while True:
        rivals = (walls > walls[best]) & (sizes >= ENCLOSED_SHARE * sizes[best])
        if not rivals.any():
            return 1 + best
        part = labels[boxes[best]]
        enclosed = np.unique(part[ndimage.binary_fill_holes(part == 1 + best)])
        rivals &= np.isin(np.arange(1, len(sizes) + 1), enclosed)
        if not rivals.any():
            return 1 + best
        best = int(np.argmax(np.where(rivals, sizes, 0)))


def _grown(centres: np.ndarray, free: np.ndarray, radius: float, gap: float, nook_cells: float) -> np.ndarray:
    """Return the space of a robot's centres grown back to the walls: what the robot covers, and nooks beside it.

    Lengths are in cells. Free space narrower than `gap` is left out.
    """
    half_gap = min(max(1, round(gap / 2 + 0.5)), radius)
    wide = _dilated(~_dilated(~free, half_gap), half_gap)
    covered = _dilated(centres, radius)
    beside = ndimage.label(wide & ~covered)[0]
    nooks = np.bincount(beside.ravel()) <= nook_cells
    allowed = wide & ~centres & (covered | nooks[beside])
    space = centres.copy()
    grow(space.ravel(), allowed.ravel(), space.shape[1], np.empty(4 * np.count_nonzero(allowed), np.int64))
    return space


def _dilated(mask: np.ndarray, radius: float) -> np.ndarray:
    """Return the cells less than `radius` cells from one of `mask`, centre to centre."""
    reach = np.arange(math.ceil(radius))
    widths = np.ceil(np.sqrt(radius**2 - reach**2)).astype(np.int64) - 1
    result = mask.copy()
    stamp_discs(mask, widths, result)
    return result


@compiled
def stamp_discs(mask, widths, result):
    """Set `result` where discs around the cells of `mask` lie: i rows off, `widths[i]` cells to both sides.

    Cells amid others have their discs covered by those around them.
    """
    rows, columns = mask.shape
    for row in range(rows):
        for column in range(columns):
            if not mask[row, column]:
                continue
            if (
                0 < row < rows - 1
                and 0 < column < columns - 1
                and mask[row - 1, column]
                and mask[row + 1, column]
                and mask[row, column - 1]
                and mask[row, column + 1]
            ):
                continue
            for i in range(max(row - len(widths) + 1, 0), min(row + len(widths), rows)):
                width = widths[abs(i - row)]
                for j in range(max(column - width, 0), min(column + width + 1, columns)):
                    result[i, j] = True


@compiled
def grow(space, allowed, columns, queue):
    """Add allowed cells to `space`, nearest first, that make no new hole of it and join it nowhere to itself.

    Parameters
    ----------
    space, allowed : (rows * columns,) bool
        Row by row; no cell of either is on the rim. The space, 4-connected, is grown in place.
    columns : int
    queue : (4 * number of allowed cells,) int64
        Room for the cells that wait: each at most once for each neighbour.
    """
    steps = (1, columns, -1, -columns)
    end = 0
    for cell in range(columns, len(space) - columns):
        if space[cell]:
            for step in steps:
                if allowed[cell + step]:
                    queue[end] = cell + step
                    end += 1
    begin = 0
    while begin < end:
        cell = queue[begin]
        begin += 1
        if space[cell]:
            continue
        joined = 0  # Yokoi's connectivity number: 1 where the cell's neighbours stay as connected as they are
        for i in range(4):
            side, next_side = steps[i], steps[(i + 1) % 4]
            if space[cell + side] and not (space[cell + side + next_side] and space[cell + next_side]):
                joined += 1
        if joined != 1:
            continue
        space[cell] = True
        for step in steps:
            if allowed[cell + step] and not space[cell + step]:
                queue[end] = cell + step
                end += 1


def _outline(space: np.ndarray, corner: tuple[int, int]) -> Polygon:
    """Return the polygon of a connected mask along its cells' sides, in columns and rows of the grid."""
    # Above a half, where two cells that meet in a corner are not joined, and walls past it keep off each other.
    generator = contour_generator(z=space.astype(float), fill_type=FillType.OuterOffset)
    parts: Any = generator.filled(0.75, math.inf)
    points, offsets = (part[0] for part in parts)
    exterior, *holes = (_along_sides(points[a:b], space) + corner[::-1] for a, b in pairwise(offsets))
    return Polygon(exterior, holes)


def _along_sides(ring: np.ndarray, space: np.ndarray) -> np.ndarray:
    """Return a closed contour that passes between cells' centres as one that follows the cells' sides.

    Where four cells meet that are free crosswise, it goes on past their corner, which it else would touch twice.
    """
    column, row = np.floor((ring[:-1] + ring[1:]) / 2).astype(int).T
    crosswise = (space[row, column] == space[row + 1, column + 1]) & (space[row, column] != space[row, column + 1])
    crosswise &= space[row, column + 1] == space[row + 1, column]
    corners = np.stack([column, row], axis=1) + 1.0
    both = np.stack([ring[:-1] + 0.5, corners], axis=1).reshape(-1, 2)
    kept = np.stack([crosswise | np.roll(crosswise, 1), ~crosswise], axis=1).ravel()
    return both[kept]


def _simplified(outline: Polygon, tolerance: float, grid: OccupancyGrid) -> Polygon:
    """Return an outline in the world, with fewer corners, within `tolerance` cells of the given one.

    Or within less, where it would cross or touch itself. It is rounded as files are, so that it is no other when read.
    """

    def placed(points: np.ndarray) -> np.ndarray:
        return np.round(grid.to_world(points), DECIMALS)

    while tolerance > 1e-3:
        simple = shapely.transform(outline.simplify(tolerance), placed)
        if isinstance(simple, Polygon) and simple.is_valid and not simple.is_empty:
            return simple
        tolerance /= 2
    return shapely.transform(outline, placed)


def _plan(grid: OccupancyGrid, polygon: Polygon, start: Pose | None) -> FloorPlan:
    start = _roomiest(polygon, grid.resolution) if start is None else start
    return FloorPlan(grid.name, polygon, start, grid.title, grid.source, grid.licence)


def _roomiest(polygon: Polygon, precision: float) -> Pose:
    """Return the point furthest from all walls, and the heading of the longest line of sight from there."""
    x, y = (round(value, 2) for value in shapely.maximum_inscribed_circle(polygon, precision).coords[0])
    west, south, east, north = polygon.bounds
    headings = 2 * math.pi / HEADINGS * np.arange(HEADINGS)
    far = (x, y) + math.hypot(east - west, north - south) * np.stack([np.cos(headings), np.sin(headings)], axis=1)
    rays = shapely.linestrings([[(x, y), end] for end in far])
    lengths = shapely.distance(Point(x, y), shapely.intersection(rays, polygon.boundary))
    heading = headings[np.argmax(np.round(lengths, 6))]
    return x, y, round(float(math.remainder(heading, 2 * math.pi)), 6)

"""Perceptual aliasing: the share of a building's places that look like another place far away.

Places are the points of a square lattice where the robot can stand. The appearance of a place is its noise-free scan,
with the beams fixed to the world's axes, as a compass allows. Two places look alike when the ranges of their scans
differ by less than `TOLERANCE` on average. A place is aliased when any point more than `MIN_DISTANCE` away looks like
it. That point need not lie on the lattice, so twin halves of a building are found however the lattice falls on them.

The search compares each place with a lattice twice as fine. A pattern search with ever smaller steps
starts from each of the `NUM_CANDIDATES` points that look most like it. It may miss a look-alike, but never invents one.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import shapely

from cyclic_env.config import ClosureConfig, LaserConfig, RobotConfig
from cyclic_env.errors import FloorPlanError
from cyclic_env.floor_plans import FloorPlan
from cyclic_env.jit import compiled
from cyclic_env.simulation.lidar import Beams, laser_beams, scan_row
from cyclic_env.simulation.wall_index import WallIndex, build_wall_index

SPACING = 1.0
"""Distance between neighbouring places, metres."""

TOLERANCE = 0.25
"""Mean range difference below which two places look alike, metres. The noise of the preset `calibrated` alone makes two
scans from the same spot differ by 0.28 to 0.29 m."""

MIN_DISTANCE = ClosureConfig().gap
"""Least straight-line distance to a look-alike that counts, metres; as long as the path that a closure requires."""

NUM_CANDIDATES = 4
MAX_CANDIDATE_DISTANCE = 1.0
"""Greatest mean range difference of a candidate, metres. In a corridor, a shift by half a step of the fine lattice
changes the ranges by some 0.6 m."""

CANDIDATE_SPACING = 1.0
"""Least distance between two candidates, metres, so that the neighbours of one don't crowd out the others."""

STEPS = (0.25, 0.125, 0.0625, 0.03125)
"""Step lengths of the pattern search, metres; the first is half a step of the fine lattice."""

MAX_LATTICE_POINTS = 2_000_000
"""Greatest number of points of the fine lattice in the rectangle around a plan: some 3 GB of scans."""

CHUNK = 200
"""Places compared in one call of compiled code. Ctrl-C and progress reports have to wait for its end."""

LASER = LaserConfig()
BEAM_STRIDE = 77
"""Comparisons go through the beams in steps of 77, which reach all of them. The first few beams then already point all
around, so that most comparisons end early."""


class AliasingResult(NamedTuple):
    """The places of a building, and which of them are aliased.

    Attributes
    ----------
    positions : (n, 2) float64
        x and y of the places, metres.
    aliased : (n,) bool
        Whether a point more than `MIN_DISTANCE` away looks like the place.
    """

    positions: np.ndarray
    aliased: np.ndarray

    @property
    def share(self) -> float:
        """Share of the places that are aliased; 0 where there are no places."""
        return float(self.aliased.mean()) if len(self.aliased) else 0.0


class _Views(NamedTuple):
    """Points of a lattice, the scans from these, and the arguments for scans from elsewhere.

    Attributes
    ----------
    walls : WallIndex
    beams : Beams
    positions : (m, 2) float64
        Metres.
    scans : (m, beams) float32
        Metres.
    inverse, ranges : (2 * beams,) and (beams,) float64
        Scratch space.
    """

    walls: WallIndex
    beams: Beams
    positions: np.ndarray
    scans: np.ndarray
    inverse: np.ndarray
    ranges: np.ndarray


def perceptual_aliasing(
    plan: FloorPlan, radius: float = RobotConfig().radius, *, progress: Callable[[int, int], None] | None = None
) -> AliasingResult:
    """Find the places of a building where a robot can stand, and which of them look like another place far away.

    Parameters
    ----------
    plan : FloorPlan
    radius : float
        Radius of the robot, metres.
    progress : callable, optional
        Called now and then with the number of places compared so far and the number of all places.

    Raises
    ------
    FloorPlanError
        If the robot can't drive the plan, or the plan is too large.
    """
    positions, places = _lattice(plan.reachable(radius))
    beams = np.arange(LASER.num_beams)
    views = _Views(
        walls=build_wall_index(plan, LASER.range_max),
        beams=laser_beams(LASER),
        positions=positions,
        scans=np.empty((len(positions), len(beams)), np.float32),
        inverse=np.empty(2 * len(beams)),
        ranges=np.empty(len(beams)),
    )
    scan_all(views)
    shuffled = np.ascontiguousarray(views.scans[:, beams * BEAM_STRIDE % len(beams)])
    candidates = np.empty((len(places), NUM_CANDIDATES), np.int64)
    aliased = np.empty(len(places), np.bool_)
    for begin in range(0, len(places), CHUNK):
        chunk = slice(begin, begin + CHUNK)
        find_candidates(positions, shuffled, places[chunk], np.empty(NUM_CANDIDATES), candidates[chunk])
        find_look_alikes(views, places[chunk], candidates[chunk], aliased[chunk])
        if progress is not None:
            progress(min(chunk.stop, len(places)), len(places))
    return AliasingResult(positions[places], aliased)


def _lattice(area: shapely.Polygon) -> tuple[np.ndarray, np.ndarray]:
    """Return the points of the fine lattice inside an area, `(m, 2)`, and the rows of those that are places."""
    west, south, east, north = area.bounds
    step = SPACING / 2
    if (east - west) * (north - south) > MAX_LATTICE_POINTS * step**2:
        raise FloorPlanError(
            f"a plan of {east - west:,.0f} m x {north - south:,.0f} m is too large to be searched for look-alikes: at "
            f"most {MAX_LATTICE_POINTS * step**2:,.0f} m2; are the units metres?"
        )
    columns, rows = np.arange(np.ceil(west / step), east / step), np.arange(np.ceil(south / step), north / step)
    i, j = (axis.ravel() for axis in np.meshgrid(columns, rows))
    shapely.prepare(area)
    inside = shapely.contains_xy(area, step * i, step * j)
    i, j = i[inside], j[inside]
    return step * np.stack([i, j], axis=1), np.flatnonzero((i % 2 == 0) & (j % 2 == 0))


@compiled
def scan_all(views):
    """Write the scans from all points, with beam 0 pointing east."""
    for i in range(views.positions.shape[0]):
        _scan_from(views, views.positions[i, 0], views.positions[i, 1])
        for beam in range(views.ranges.shape[0]):
            views.scans[i, beam] = views.ranges[beam]


@compiled
def find_candidates(positions, scans, places, differences, candidates):
    """Find for each place the points far away that look most like it.

    Parameters
    ----------
    positions : (m, 2) float64
        Metres.
    scans : (m, beams) float32
        The scans from there, metres.
    places : (n,) int64
        Rows of `positions`.
    differences : (c,) float64
        Scratch space.
    candidates : (n, c) int64
        Output: rows of `positions`, most alike first, then -1 for missing candidates.
    """
    last, num_beams = candidates.shape[1] - 1, scans.shape[1]
    for p in range(places.shape[0]):
        place, best = places[p], candidates[p]
        best[:] = -1
        differences[:] = MAX_CANDIDATE_DISTANCE * num_beams
        for i in range(positions.shape[0]):
            if _within(positions[i], positions[place], MIN_DISTANCE):
                continue
            limit, difference, beam = differences[last], 0.0, 0
            while beam < num_beams and difference < limit:
                difference += abs(scans[i, beam] - scans[place, beam])
                beam += 1
            if difference >= limit:
                continue
            rank = last  # of the candidate to replace: a close neighbour of this point, or the last
            for j in range(last, -1, -1):
                if best[j] >= 0:
                    dx, dy = positions[i, 0] - positions[best[j], 0], positions[i, 1] - positions[best[j], 1]
                    if dx * dx + dy * dy < CANDIDATE_SPACING * CANDIDATE_SPACING:
                        rank = j
            if difference >= differences[rank]:
                continue
            while rank > 0 and differences[rank - 1] > difference:
                differences[rank], best[rank] = differences[rank - 1], best[rank - 1]
                rank -= 1
            differences[rank], best[rank] = difference, i


@compiled
def find_look_alikes(views, places, candidates, aliased):
    """Find which places have a look-alike, by a pattern search from each of their candidates.

    Parameters
    ----------
    views : _Views
    places : (n,) int64
        Rows of the views' positions.
    candidates : (n, c) int64
        As `find_candidates` writes them.
    aliased : (n,) bool
        Output.
    """
    for p in range(places.shape[0]):
        aliased[p] = False
        for candidate in candidates[p]:
            if candidate < 0 or aliased[p]:
                break
            aliased[p] = _least_difference(views, places[p], candidate) < TOLERANCE


@compiled
def _least_difference(views, place, candidate):
    """Return the least mean range difference to a place that a pattern search from a candidate finds, metres.

    Each step length is tried to the east, north, west and south until it improves nothing. The search ends early once
    the difference is below the tolerance.
    """
    position, scan, num_beams = views.positions[place], views.scans[place], views.ranges.shape[0]
    x, y = views.positions[candidate, 0], views.positions[candidate, 1]
    best = _difference_at(views, x, y, scan)
    for step in STEPS:
        moved = True
        while moved and best >= TOLERANCE:
            moved = False
            from_x, from_y = x, y
            for quarter in range(4):
                to_x = from_x + step * ((quarter == 0) - (quarter == 2))
                to_y = from_y + step * ((quarter == 1) - (quarter == 3))
                if _within((to_x, to_y), position, MIN_DISTANCE):
                    continue
                _scan_from(views, from_x, from_y)
                if views.ranges[quarter * num_beams // 4] <= 2 * step:  # the beam that way meets a wall too soon
                    continue
                difference = _difference_at(views, to_x, to_y, scan)
                if difference < best:
                    best, x, y, moved = difference, to_x, to_y, True
    return best


@compiled
def _difference_at(views, x, y, scan):
    """Return the mean difference between the ranges at (x, y) and those of a scan, metres."""
    _scan_from(views, x, y)
    difference = 0.0
    for beam in range(views.ranges.shape[0]):
        difference += abs(views.ranges[beam] - scan[beam])
    return difference / views.ranges.shape[0]


@compiled
def _scan_from(views, x, y):
    """Write the scan from (x, y), heading east, into the views' ranges."""
    scan_row(views.walls, 0, (x, y, 0.0), views.beams, views.inverse, views.ranges)


@compiled
def _within(a, b, distance):
    """Tell whether two points are at most that distance apart."""
    dx, dy = a[0] - b[0], a[1] - b[1]
    return dx * dx + dy * dy <= distance * distance

"""How much of a building looks like another part of it: the share of its places that have a look-alike far away.

A place is a point of a square lattice where the robot can stand. Its look is the noise-free scan there, its beams fixed
to the world's axes, as a compass allows. Two places look alike when the ranges of their scans differ by less than
`TOLERANCE` in the mean. A place has a look-alike when any point more than `FAR` away, on the lattice or off it, looks
like it: so no mere shift of a building's half against the lattice can hide that it is the other's twin.

Look-alikes are searched for among the points of a lattice twice as fine; from the `CANDIDATES` most alike, if they
differ by less than `HOPEFUL`, a pattern search moves on in ever smaller steps. It may miss one, but never invents one.
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
from cyclic_env.simulation.lidar import beam_directions, scan_row
from cyclic_env.simulation.wall_index import build_wall_index

SPACING = 1.0
"""Metres between places."""

TOLERANCE = 0.25
"""Metres of mean range difference below which two places look alike. By the noise of the preset `calibrated` alone, two
scans from the same spot differ by 0.28 to 0.29 m: what differs by less, they can't tell apart."""

FAR = ClosureConfig().gap
"""Metres, as the crow flies, from which a look-alike counts: as far as the path that makes a closure."""

CANDIDATES = 4
HOPEFUL = 1.0
"""Metres of mean range difference: half a step of the fine lattice aside, a place in a corridor differs from its twin
by some 0.6 m."""

CANDIDATES_APART = 1.0
"""Metres between two candidates at least, so that the neighbours of one don't crowd out others."""

STEPS = (0.25, 0.125, 0.0625, 0.03125)
"""Metres. The steps of the pattern search, the first half of the fine lattice's."""

LATTICE_MAX = 2_000_000
"""Most points of the fine lattice, in the rectangle around a plan: some 3 GB of scans."""

AT_ONCE = 200
"""Keyframes that are compared with all others in one call."""

LASER = LaserConfig()
SHUFFLE = 77
"""Every 77th beam comes next: coprime with their number, and far from any simple share of a turn."""


class AliasingResult(NamedTuple):
    """The places of a building, and which of them have a look-alike.

    Attributes
    ----------
    places : (n, 2) float64
        x and y, metres.
    alike : (n,) bool
        Whether another place, more than `FAR` away, looks like it.
    """

    places: np.ndarray
    alike: np.ndarray

    @property
    def share(self) -> float:
        """Share of the places that have a look-alike."""
        return float(self.alike.mean()) if len(self.alike) else 0.0


def perceptual_aliasing(
    plan: FloorPlan, radius: float = RobotConfig().radius, *, progress: Callable[[int, int], None] | None = None
) -> AliasingResult:
    """Return the places of a building where a robot of that radius can stand, and which have a look-alike far away.

    Parameters
    ----------
    plan : FloorPlan
    radius : float
        Of the robot, metres.
    progress : callable, optional
        Called now and then with the number of places that have been compared, and of all.

    Raises
    ------
    FloorPlanError
        If the robot can't drive the plan, or the plan is too large.
    """
    points, rows = _lattice(plan.reachable(radius))
    tiles, directions = build_wall_index(plan, LASER.range_max), beam_directions(LASER)
    beams = np.arange(LASER.num_beams)
    scratch = np.empty(2 * len(beams)), np.empty(len(beams))
    scans = np.empty((len(points), len(beams)), np.float32)
    scan_points(tiles, points, directions, LASER.range_max, *scratch, scans)
    chosen = np.empty((len(rows), CANDIDATES), np.int64)
    # With the beams shuffled, any few of them look all around, and most comparisons end early.
    shuffled = np.ascontiguousarray(scans[:, beams * SHUFFLE % len(beams)])
    alike = np.empty(len(rows), np.bool_)
    differences, steps = np.empty(CANDIDATES), np.array(STEPS)
    for begin in range(0, len(rows), AT_ONCE):  # Ctrl-C is heard between two calls of compiled code
        part = slice(begin, begin + AT_ONCE)
        nearest_looks(points, shuffled, rows[part], FAR, HOPEFUL, CANDIDATES_APART, differences, chosen[part])
        search_looks(
            tiles,
            points,
            scans,
            rows[part],
            chosen[part],
            directions,
            LASER.range_max,
            FAR,
            TOLERANCE,
            steps,
            *scratch,
            alike[part],
        )
        if progress is not None:
            progress(min(part.stop, len(rows)), len(rows))
    return AliasingResult(points[rows], alike)


def aliasing(plan: FloorPlan) -> float:
    """Return the share of a building's places that have a look-alike more than `FAR` away; 0 where there is none."""
    return perceptual_aliasing(plan).share


def _lattice(area: shapely.Polygon) -> tuple[np.ndarray, np.ndarray]:
    """Return the points of the fine lattice inside an area, `(m, 2)`, and the rows of those that are places."""
    west, south, east, north = area.bounds
    fine = SPACING / 2
    if (east - west) * (north - south) > LATTICE_MAX * fine**2:
        raise FloorPlanError(
            f"a plan of {east - west:,.0f} m x {north - south:,.0f} m is too large to be searched for look-alikes: at "
            f"most {LATTICE_MAX * fine**2:,.0f} m2; are the units metres?"
        )
    columns, rows = np.arange(np.ceil(west / fine), east / fine), np.arange(np.ceil(south / fine), north / fine)
    i, j = (axis.ravel() for axis in np.meshgrid(columns, rows))
    shapely.prepare(area)
    inside = shapely.contains_xy(area, fine * i, fine * j)
    i, j = i[inside], j[inside]
    return fine * np.stack([i, j], axis=1), np.flatnonzero((i % 2 == 0) & (j % 2 == 0))


@compiled
def scan_points(tiles, points, directions, range_max, inverse, ranges, scans):
    """Write the scans `(m, beams)` float32 from points `(m, 2)`, beam 0 pointing east; two arrays are scratch."""
    for i in range(points.shape[0]):
        scan_row(tiles, 0, points[i, 0], points[i, 1], 0.0, directions, range_max, inverse, ranges)
        for beam in range(ranges.shape[0]):
            scans[i, beam] = ranges[beam]


@compiled
def nearest_looks(points, scans, queries, far, hopeful, apart, differences, chosen):
    """Choose for each of some points the others that look most like it.

    Parameters
    ----------
    points : (m, 2) float64
    scans : (m, beams) float32
        What is seen there.
    queries : (n,) int64
        Rows of `points`.
    far, apart : float
        Metres between a query and its candidates, and between these, at least.
    hopeful : float
        Mean range difference from which a point is no candidate, metres.
    differences : (candidates,) float64
        Scratch space.
    chosen : (n, candidates) int64
        Written: rows of `points`, the most alike first; -1 for none.
    """
    candidates, num_beams = chosen.shape[1], scans.shape[1]
    for q in range(queries.shape[0]):
        query = queries[q]
        best = chosen[q]
        best[:] = -1
        differences[:] = hopeful * num_beams
        for i in range(points.shape[0]):
            dx, dy = points[i, 0] - points[query, 0], points[i, 1] - points[query, 1]
            if dx * dx + dy * dy <= far * far:
                continue
            limit, difference, beam = differences[candidates - 1], 0.0, 0
            while beam < num_beams and difference < limit:
                difference += abs(scans[i, beam] - scans[query, beam])
                beam += 1
            if difference >= limit:
                continue
            place = candidates - 1  # the candidate that gives way: a neighbour, else the last
            for j in range(candidates - 1, -1, -1):
                if best[j] >= 0:
                    dx, dy = points[i, 0] - points[best[j], 0], points[i, 1] - points[best[j], 1]
                    if dx * dx + dy * dy < apart * apart:
                        place = j
            if difference >= differences[place]:
                continue
            while place > 0 and differences[place - 1] > difference:
                differences[place], best[place] = differences[place - 1], best[place - 1]
                place -= 1
            differences[place], best[place] = difference, i


@compiled
def search_looks(
    tiles, points, scans, queries, chosen, directions, range_max, far, tolerance, steps, inverse, ranges, alike
):
    """Find out which of some points have a look-alike, by a pattern search from each of their candidates.

    Parameters
    ----------
    tiles : WallIndex
        Of the one plan.
    points, scans, queries, far
        As for `nearest_looks`.
    chosen : (n, candidates) int64
        As `nearest_looks` wrote them.
    directions : (2, 2 * beams) float64
    range_max : float
    tolerance : float
        Mean range difference below which two places look alike, metres.
    steps : (s,) float64
        Of the search, metres, each tried east, north, west and south until it makes nothing better.
    inverse, ranges : (2 * beams,) and (beams,) float64
        Scratch space.
    alike : (n,) bool
        Written.
    """
    num_beams = ranges.shape[0]
    for q in range(queries.shape[0]):
        query = queries[q]
        alike[q] = False
        for candidate in chosen[q]:
            if candidate < 0 or alike[q]:
                break
            x, y = points[candidate, 0], points[candidate, 1]
            best = _look_difference(tiles, x, y, directions, range_max, inverse, ranges, scans[query])
            for step in steps:
                moved = True
                while moved and best >= tolerance:
                    moved = False
                    from_x, from_y = x, y
                    for quarter in range(4):
                        to_x = from_x + step * ((quarter == 0) - (quarter == 2))
                        to_y = from_y + step * ((quarter == 1) - (quarter == 3))
                        dx, dy = to_x - points[query, 0], to_y - points[query, 1]
                        if dx * dx + dy * dy <= far * far:
                            continue
                        # Where the way there is free, it is in free space.
                        scan_row(tiles, 0, from_x, from_y, 0.0, directions, range_max, inverse, ranges)
                        if ranges[quarter * num_beams // 4] <= 2 * step:
                            continue
                        difference = _look_difference(
                            tiles, to_x, to_y, directions, range_max, inverse, ranges, scans[query]
                        )
                        if difference < best:
                            best, x, y, moved = difference, to_x, to_y, True
            alike[q] = best < tolerance


@compiled
def _look_difference(tiles, x, y, directions, range_max, inverse, ranges, scan):
    """Return the mean difference between the ranges at (x, y) and those of a scan, metres; writes `ranges`."""
    scan_row(tiles, 0, x, y, 0.0, directions, range_max, inverse, ranges)
    difference = 0.0
    for beam in range(ranges.shape[0]):
        difference += abs(ranges[beam] - scan[beam])
    return difference / ranges.shape[0]

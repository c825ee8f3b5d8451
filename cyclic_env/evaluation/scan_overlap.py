"""How much two laser scans overlap, by which some authors define a loop closure instead of by distance.

The overlap is that of OverlapNet (X. Chen et al., "OverlapNet: Loop Closing for LiDAR-based SLAM", RSS 2020) in the
plane: endpoints of one scan, seen from the true pose of the other, whose range differs by at most `EPSILON` from
what the other measured on that bearing, over the smaller number of valid beams of the two.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from cyclic_env.config import LaserConfig
from cyclic_env.jit import compiled
from cyclic_env.trajectory.poses import compose

EPSILON = 1.0
"""Metres, as the authors take it."""

REACH = 20.0
"""Metres. Scans taken farther apart are not compared."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scans:
    """Scans of one laser.

    Attributes
    ----------
    times : (n,) float64
        Seconds.
    ranges : (n, num_beams) float32
        Metres; `range_max` and more, or inf, where there was no hit.
    laser : LaserConfig
    laser_position : (x, y)
        Of the laser in the robot's frame, metres.
    """

    times: np.ndarray
    ranges: np.ndarray
    laser: LaserConfig
    laser_position: tuple[float, float] = (0.0, 0.0)


def overlaps_of(scans: Scans, poses: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Return the overlaps `(m,)` of pairs `(m, 2)` of scans, taken at poses `(n, 3)` of the robot."""
    found = np.zeros(len(pairs))
    _overlaps(*_packed(scans, poses), pairs.astype(np.int64), found)
    return found


def greatest_overlaps(scans: Scans, poses: np.ndarray, path: np.ndarray, gap: float, enough: float) -> np.ndarray:
    """Return for each scan `(n,)` the greatest overlap with one at least `gap` metres of path earlier.

    Overlaps of `enough` or more need not be the greatest.

    Parameters
    ----------
    scans, poses
        As of `overlaps_of`.
    path : (n,)
        Path length at each scan, metres.
    gap, enough : float
    """
    found = np.zeros(len(poses))
    _greatest(*_packed(scans, poses), path, gap, enough, found)
    return found


def _packed(scans: Scans, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Return the ranges, 0 without a hit; the poses of beam 0; the numbers of valid beams; the angle between beams."""
    ranges = scans.ranges.astype(np.float64)
    ranges[~(ranges < scans.laser.range_max)] = 0.0
    at = compose(poses, np.array([*scans.laser_position, scans.laser.first_bearing]))
    return ranges, at, np.count_nonzero(ranges > 0, axis=1), scans.laser.beam_spacing


@compiled
def _overlap(ranges, at, valid, spacing, a, b):
    """Return the overlap of scans a and b."""
    least = min(valid[a], valid[b])
    if least == 0:
        return 0.0
    cos, sin = math.cos(at[b, 2]), math.sin(at[b, 2])
    dx, dy, turn = at[a, 0] - at[b, 0], at[a, 1] - at[b, 1], at[a, 2] - at[b, 2]
    x0, y0 = cos * dx + sin * dy, cos * dy - sin * dx
    beams, same = ranges.shape[1], 0
    for k in range(beams):
        r = ranges[a, k]
        if r <= 0.0:
            continue
        x, y = x0 + r * math.cos(turn + k * spacing), y0 + r * math.sin(turn + k * spacing)
        beam = round(math.atan2(y, x) % (2 * math.pi) / spacing)
        if beam * spacing > 2 * math.pi - 0.5 * spacing:
            beam = 0
        if beam < beams and ranges[b, beam] > 0.0:
            same += abs(math.sqrt(x * x + y * y) - ranges[b, beam]) <= EPSILON
    return same / least


@compiled
def _overlaps(ranges, at, valid, spacing, pairs, found):
    for i in range(pairs.shape[0]):
        found[i] = _overlap(ranges, at, valid, spacing, pairs[i, 0], pairs[i, 1])


@compiled
def _greatest(ranges, at, valid, spacing, path, gap, enough, found):
    for t in range(at.shape[0]):
        for k in range(t):
            if path[t] - path[k] < gap or found[t] >= enough:
                break
            if (at[t, 0] - at[k, 0]) ** 2 + (at[t, 1] - at[k, 1]) ** 2 <= REACH * REACH:
                found[t] = max(found[t], _overlap(ranges, at, valid, spacing, t, k))

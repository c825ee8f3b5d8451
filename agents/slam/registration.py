"""How one panorama lies in another: point-to-line matching from several starts, and how well the two agree.

Beams that were not looked at (range 0) say nothing, here as everywhere.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from agents.component_config import pack
from agents.slam.scan_filters import SHORT_OF_REACH
from agents.slam.scan_matching import Estimate, MatcherConfig, MatcherValues, Prior, Reference, align, min_eigenvalue
from agents.slam.wall_lines import fit_wall_lines, measure_gaps, place_endpoints
from cyclic_env.jit import compiled

WIDE, TIGHT = 0.25, 0.10
"""Metres by which endpoints may differ that agree: that the scans show the same place, and that the pose is right."""
FEW = 25
"""Inliers below which a start is taken only if there is no other."""
GOOD_WIDE, GOOD_TIGHT, GOOD_SEEN = 0.93, 0.85, 80
"""Shares of inliers, and their number, from which no other start is tried."""


class Registration(NamedTuple):
    """A panorama as it lies in another's frame.

    Attributes
    ----------
    pose : (3,) float64
        Of the one in the frame of the other, the reference.
    information : (3, 3) float64
        Its inverse covariance, as noise alone has it.
    wide, tight : float
        Shares of the endpoints that agree within `WIDE` and `TIGHT`, among those that can be judged; the less of both
        ways round.
    seen : int
        Number of endpoints that agree; the fewer of both ways round.
    min_eigenvalue : float
        How many endpoints, at least, tell the position in any direction: few along a plain corridor.
    """

    pose: np.ndarray
    information: np.ndarray
    wide: float
    tight: float
    seen: int
    min_eigenvalue: float


@compiled
def count_inliers(reference, ranges, range_max, pose):
    """Return how many endpoints of a panorama, at a pose in a reference's frame, agree and disagree with the reference.

    One beyond the reference's own endpoint on that bearing is hidden from it and says nothing; one well before it is
    against it. The four numbers are inliers and outliers within `WIDE`, and within `TIGHT`.
    """
    n = ranges.shape[0]
    spacing = 2 * math.pi / n
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    inliers = outliers = tight_inliers = tight_outliers = 0
    for k in range(n):
        r = ranges[k]
        if r <= 0.0 or r >= range_max - SHORT_OF_REACH:
            continue
        lx, ly = r * math.cos(k * spacing), r * math.sin(k * spacing)
        x, y = pose[0] + cos * lx - sin * ly, pose[1] + sin * lx + cos * ly
        beam = math.atan2(y, x) / spacing
        low = math.floor(beam)
        a, b = reference[low % n], reference[(low + 1) % n]
        if a <= 0.0 or b <= 0.0:  # not looked at
            continue
        distance = math.sqrt(x * x + y * y)
        nearer, farther = min(a, b), max(a, b)
        outliers += distance < nearer - WIDE
        inliers += nearer - WIDE <= distance <= farther + WIDE
        tight_outliers += distance < nearer - TIGHT
        tight_inliers += nearer - TIGHT <= distance <= farther + TIGHT
    return inliers, outliers, tight_inliers, tight_outliers


@compiled
def judge_pose(reference, ranges, range_max, pose, quality):
    """Write into `quality` `(3,)` the shares of inliers within `WIDE` and `TIGHT`, and the number of those in `WIDE`.

    The less counts of both ways round.
    """
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    back = (-cos * pose[0] - sin * pose[1], sin * pose[0] - cos * pose[1], -pose[2])
    a, b, c, d = count_inliers(reference, ranges, range_max, (pose[0], pose[1], pose[2]))
    e, f, g, h = count_inliers(ranges, reference, range_max, back)
    quality[0] = min(a / max(1, a + b), e / max(1, e + f))
    quality[1] = min(c / max(1, c + d), g / max(1, g + h))
    quality[2] = min(a, e)


@compiled
def register_from(reference, panorama, endpoints, range_max, starts, std, values, trial, best, quality):
    """Match a panorama with a reference from each of the starts `(m, 3)`; the one that agrees best is the result.

    Parameters
    ----------
    reference : Reference
    panorama, endpoints : (n,)
        With its `endpoints`.
    range_max : float
    starts : (m, 3)
        Poses in the reference's frame, the expected one first.
    std : (3,)
        Standard deviations of the starts: metres, metres, radians.
    values : MatcherValues
    trial, best : Estimate
        Scratch, and the result.
    quality : (2, 3) float64
        Scratch, and the result's shares and number of inliers, as of `judge_pose`, in the second row.
    """
    highest = -1.0
    for s in range(starts.shape[0]):
        align(reference, endpoints, range_max, Prior(starts[s], std), trial, values)
        judge_pose(reference.ranges, panorama, range_max, trial.pose, quality[0])
        key = quality[0, 0] + 0.5 * quality[0, 1] - (0.5 if quality[0, 2] < FEW else 0.0)
        if key > highest:
            highest = key
            for i in range(3):
                best.pose[i], quality[1, i] = trial.pose[i], quality[0, i]
                for j in range(3):
                    best.hessian[i, j] = trial.hessian[i, j]
            if quality[1, 0] > GOOD_WIDE and quality[1, 1] > GOOD_TIGHT and quality[1, 2] > GOOD_SEEN:
                break


@compiled
def best_starts(reference, panorama, range_max, starts, scores, chosen):
    """Write into `chosen` `(c, 3)` the starts `(m, 3)` at which most endpoints lie on the reference's walls.

    `scores` `(m,)` is scratch.
    """
    for s in range(starts.shape[0]):
        inliers, outliers, _, _ = count_inliers(
            reference, panorama, range_max, (starts[s, 0], starts[s, 1], starts[s, 2])
        )
        scores[s] = inliers - outliers
    for c in range(chosen.shape[0]):
        best = 0
        for s in range(starts.shape[0]):
            if scores[s] > scores[best]:
                best = s
        for i in range(3):
            chosen[c, i] = starts[best, i]
        scores[best] = -math.inf


class PanoramaMatcher:
    """Matches panoramas, or scans, of which parts may not have been looked at.

    Parameters
    ----------
    range_max : float
        Metres beyond which nothing counts.
    config : MatcherConfig, optional
    """

    def __init__(self, range_max: float, config: MatcherConfig | None = None) -> None:
        self.range_max = range_max
        self.config = config or MatcherConfig()
        self._values = pack(MatcherValues, self.config)

    def endpoints(self, panorama: np.ndarray) -> np.ndarray:
        """Return the ranges `(n,)` that end on a wall, and `range_max` where none does."""
        return np.where((panorama > 0) & (panorama < self.range_max - SHORT_OF_REACH), panorama, self.range_max)

    def reference(self, panorama: np.ndarray) -> Reference:
        """Return a panorama as others are matched with it."""
        endpoints, (points, lines) = self.endpoints(panorama), np.empty((2, len(panorama), 3))
        place_endpoints(endpoints, points)
        fit_wall_lines(endpoints, self.range_max, points, lines, self._values)
        measure_gaps(endpoints, lines, points, self._values)
        return Reference(panorama, points, lines)

    def match(self, reference: Reference, panorama: np.ndarray, starts: np.ndarray, std: np.ndarray) -> Registration:
        """Match a panorama with a reference from several starts; see `register_from`."""
        trial, best = (Estimate(np.zeros(3), np.zeros((3, 3)), np.zeros(3)) for _ in range(2))
        quality = np.zeros((2, 3))
        endpoints = self.endpoints(panorama)
        register_from(reference, panorama, endpoints, self.range_max, starts, std, self._values, trial, best, quality)
        variance = self.config.endpoint_std**2
        wide, tight, seen = quality[1].tolist()
        weakest = min_eigenvalue(best.hessian)
        return Registration(best.pose, best.hessian / variance, wide, tight, int(seen), weakest)

    def likely_starts(self, reference: np.ndarray, panorama: np.ndarray, starts: np.ndarray, count: int) -> np.ndarray:
        """Return those `(count, 3)` of the starts at which the two panoramas agree best as they are."""
        chosen = np.empty((count, 3))
        best_starts(reference, panorama, self.range_max, starts, np.empty(len(starts)), chosen)
        return chosen

"""How one panorama lies in another: point-to-line matching from several starts, and how well the two agree.

Beams that were not looked at (range 0) say nothing, here as everywhere.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from agents.slam.scan_filters import SHORT_OF_REACH
from agents.slam.scan_matching import SPREAD, align
from cyclic_env.jit import compiled

WIDE, TIGHT = 0.25, 0.10
"""Metres by which endpoints may differ that agree: that the scans show the same place, and that the pose is right."""
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
        Endpoints that agree, likewise.
    """

    pose: np.ndarray
    information: np.ndarray
    wide: float
    tight: float
    seen: int

    @property
    def min_eigenvalue(self) -> float:
        """How many endpoints, at least, speak for the position in any direction: few along a plain corridor."""
        a, b, c = self.information[0, 0], self.information[0, 1], self.information[1, 1]
        return SPREAD**2 * (0.5 * (a + c) - math.sqrt(0.25 * (a - c) ** 2 + b * b))


@compiled
def count_inliers(reference, ranges, range_max, x0, y0, heading, counts):
    """Count the endpoints of a panorama, at a pose in a reference's frame, that agree and disagree with the reference.

    One beyond the reference's own endpoint on that bearing is hidden from it and says nothing; one well before it is
    against it. `counts` `(4,)` becomes: inliers and outliers within `WIDE`, and within `TIGHT`.
    """
    n = ranges.shape[0]
    spacing = 2 * math.pi / n
    cos, sin = math.cos(heading), math.sin(heading)
    for i in range(4):
        counts[i] = 0
    for k in range(n):
        r = ranges[k]
        if r <= 0.0 or r >= range_max - SHORT_OF_REACH:
            continue
        lx, ly = r * math.cos(k * spacing), r * math.sin(k * spacing)
        x, y = x0 + cos * lx - sin * ly, y0 + sin * lx + cos * ly
        beam = math.atan2(y, x) / spacing
        low = math.floor(beam)
        a, b = reference[low % n], reference[(low + 1) % n]
        if a <= 0.0 or b <= 0.0:
            continue
        distance = math.sqrt(x * x + y * y)
        nearer, farther = min(a, b), max(a, b)
        if distance < nearer - WIDE:
            counts[1] += 1
        elif distance <= farther + WIDE:
            counts[0] += 1
        if distance < nearer - TIGHT:
            counts[3] += 1
        elif distance <= farther + TIGHT:
            counts[2] += 1


@compiled
def judge_pose(reference, ranges, range_max, pose, counts, quality):
    """Write into `quality` `(3,)` the shares of inliers within `WIDE` and `TIGHT`, and the number of those in `WIDE`."""
    count_inliers(reference, ranges, range_max, pose[0], pose[1], pose[2], counts)
    quality[0] = counts[0] / max(1, counts[0] + counts[1])
    quality[1] = counts[2] / max(1, counts[2] + counts[3])
    quality[2] = counts[0]
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    x, y = -cos * pose[0] - sin * pose[1], sin * pose[0] - cos * pose[1]
    count_inliers(ranges, reference, range_max, x, y, -pose[2], counts)
    quality[0] = min(quality[0], counts[0] / max(1, counts[0] + counts[1]))
    quality[1] = min(quality[1], counts[2] / max(1, counts[2] + counts[3]))
    quality[2] = min(quality[2], counts[0])


@compiled
def register_from(reference, lines, panorama, ends, range_max, starts, spread, scratch, pose, hessian, quality):
    """Match a panorama with a reference from each of the starts `(m, 3)`; the one that agrees best is the result.

    Parameters
    ----------
    reference, lines : (n,) and (n, 3)
        With its `fit_wall_lines`.
    panorama, ends : (n,)
        With its `endpoints`.
    range_max : float
    starts : (m, 3)
        Poses in the reference's frame, the expected one first.
    spread : (3,)
        Standard deviations of the starts: metres, metres, radians.
    scratch : tuple of (3,), (3, 3), (3,) and (4,) int arrays
    pose, hessian : (3,) and (3, 3)
        The result, as of `align`.
    quality : (3,)
        The result's, as of `judge_pose`.
    """
    trial, trial_hessian, trial_quality, counts = scratch
    best = -1.0
    for s in range(starts.shape[0]):
        align(reference, lines, ends, range_max, starts[s], spread, trial, trial_hessian)
        judge_pose(reference, panorama, range_max, trial, counts, trial_quality)
        key = trial_quality[0] + 0.5 * trial_quality[1] - (0.5 if trial_quality[2] < 25 else 0.0)
        if key > best:
            best = key
            for i in range(3):
                pose[i], quality[i] = trial[i], trial_quality[i]
                for j in range(3):
                    hessian[i, j] = trial_hessian[i, j]
            if quality[0] > GOOD_WIDE and quality[1] > GOOD_TIGHT and quality[2] > GOOD_SEEN:
                break


@compiled
def best_starts(reference, panorama, range_max, starts, counts, scores, chosen):
    """Write into `chosen` `(c, 3)` the starts `(m, 3)` at which most endpoints lie on the reference's walls.

    `scores` `(m,)` and `counts` `(4,)` are scratch.
    """
    for s in range(starts.shape[0]):
        count_inliers(reference, panorama, range_max, starts[s, 0], starts[s, 1], starts[s, 2], counts)
        scores[s] = counts[0] - counts[1]
    for c in range(chosen.shape[0]):
        best = 0
        for s in range(starts.shape[0]):
            if scores[s] > scores[best]:
                best = s
        for i in range(3):
            chosen[c, i] = starts[best, i]
        scores[best] = -math.inf


def register(
    reference: np.ndarray,
    lines: np.ndarray,
    panorama: np.ndarray,
    ends: np.ndarray,
    starts: np.ndarray,
    spread: np.ndarray,
    range_max: float,
) -> Registration:
    """Match a panorama with a reference; see `register_from`."""
    scratch = (np.empty(3), np.empty((3, 3)), np.empty(3), np.empty(4, np.int64))
    pose, hessian, quality = np.zeros(3), np.zeros((3, 3)), np.zeros(3)
    register_from(reference, lines, panorama, ends, range_max, starts, spread, scratch, pose, hessian, quality)
    return Registration(pose, hessian / SPREAD**2, float(quality[0]), float(quality[1]), int(quality[2]))

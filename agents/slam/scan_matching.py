"""Where one scan was taken relative to another: point-to-line matching of their ends, and whether the two agree.

Chen and Medioni's point-to-line form of ICP, with a prior, so that what the walls leave undetermined (the way along a
plain corridor) stays as it was expected to be.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from agents.slam.keyframes import Keyframes
from agents.slam.scan_filters import SHORT_OF_REACH
from agents.slam.se2 import compose, relative
from cyclic_env.jit import compiled

ROUNDS = 12
SPREAD = 0.05
"""Metres of an end about its wall: the noise of two scans, and their coarseness."""
LOOSE = 2.0
"""Ends that noise and outliers put along a plain corridor, where there is nothing to tell the way along it."""
TOLERANCE = 0.25
"""Metres by which ends may differ that agree."""
FIT_BASE = 0.4
"""Metres that the points of a fitted wall span at least: ten times the noise of a range."""
FIT_ENOUGH = 1.0
"""Metres beyond which no more points are added."""
FIT_ERROR = 0.06
"""Metres of rms at most between such points and their line."""


@compiled
def fit_wall_lines(ranges, range_max, lines):
    """Write into `lines` `(beams, 3)` the walls at the beams' ends: unit normal and offset, in the frame of the scan.

    A point (x, y) is on a wall (nx, ny, offset) where nx x + ny y = offset. Lines are fitted to each end and as many of
    its neighbours on both sides as are in line with it; (0, 0, 0) where these are too few, or no wall.
    """
    n = ranges.shape[0]
    spacing = 2 * math.pi / n
    for k in range(n):
        lines[k, 0] = lines[k, 1] = lines[k, 2] = 0.0
        for reach in range(2, 9):
            count = 2 * reach + 1
            mx = my = 0.0
            wall = True
            for i in range(k - reach, k + reach + 1):
                r = ranges[i % n]
                wall = wall and r < range_max - SHORT_OF_REACH
                mx += r * math.cos(i * spacing) / count
                my += r * math.sin(i * spacing) / count
            if not wall:
                break
            a, b = ranges[(k - reach) % n], ranges[(k + reach) % n]
            base = math.sqrt(max(0.0, a * a + b * b - 2 * a * b * math.cos(2 * reach * spacing)))
            if base < FIT_BASE:
                continue
            xx = xy = yy = 0.0
            for i in range(k - reach, k + reach + 1):
                dx = ranges[i % n] * math.cos(i * spacing) - mx
                dy = ranges[i % n] * math.sin(i * spacing) - my
                xx += dx * dx
                xy += dx * dy
                yy += dy * dy
            across = 0.5 * (xx + yy - math.sqrt((xx - yy) ** 2 + 4 * xy * xy))
            if across > count * FIT_ERROR**2:
                break
            along = 0.5 * math.atan2(2 * xy, xx - yy)
            lines[k, 0], lines[k, 1] = -math.sin(along), math.cos(along)
            lines[k, 2] = lines[k, 0] * mx + lines[k, 1] * my
            if base > FIT_ENOUGH:
                break


@compiled
def align(reference, lines, ranges, range_max, prior, spread, pose, hessian):
    """Find the pose `(3,)` of a scan in the frame of a reference scan, and how well it is determined.

    Parameters
    ----------
    reference, lines : (beams,) and (beams, 3)
        The reference scan and its `fit_wall_lines`.
    ranges : (beams,)
        The scan to be matched.
    prior : (3,)
        Expected pose (x, y, heading) in the reference's frame.
    spread : (3,)
        Standard deviations of the prior: metres, metres, radians.
    pose : (3,) array
        The result.
    hessian : (3, 3) array
        Sum of the squared gradients of the ends' errors, without the prior: divided by the variance of an end it
        is the information about the pose.

    Returns
    -------
    used : int
        Ends of beams that were put on a wall.
    """
    n = ranges.shape[0]
    spacing = 2 * math.pi / n
    pose[0], pose[1], pose[2] = prior[0], prior[1], prior[2]
    used = 0
    for turn in range(ROUNDS):
        gate = max(0.15, 1.0 * 0.7**turn)
        sigma = 0.03 + 0.3 * gate
        cos, sin = math.cos(pose[2]), math.sin(pose[2])
        for i in range(3):
            for j in range(3):
                hessian[i, j] = 0.0
        g0 = g1 = g2 = 0.0
        used = 0
        for k in range(n):
            r = ranges[k]
            if r >= range_max - SHORT_OF_REACH:
                continue
            lx, ly = r * math.cos(k * spacing), r * math.sin(k * spacing)
            rx, ry = cos * lx - sin * ly, sin * lx + cos * ly
            x, y = pose[0] + rx, pose[1] + ry
            centre = round(math.atan2(y, x) / spacing)
            best, error, nx, ny = gate, 0.0, 0.0, 0.0
            for i in range(centre - 6, centre + 7):
                j = i % n
                # The scan must be on the side of the wall that the reference has seen: walls have two faces.
                side = pose[0] * lines[j, 0] + pose[1] * lines[j, 1] - lines[j, 2]
                if side * lines[j, 2] >= 0.0:  # also where there is no line
                    continue
                dx = x - reference[j] * math.cos(j * spacing)
                dy = y - reference[j] * math.sin(j * spacing)
                off = x * lines[j, 0] + y * lines[j, 1] - lines[j, 2]
                along = abs(dx * lines[j, 1] - dy * lines[j, 0])
                # Ends on a wall seen at a slant lie far apart, and the wall goes on between them.
                slant = abs(math.cos(j * spacing) * lines[j, 0] + math.sin(j * spacing) * lines[j, 1])
                along = max(0.0, along - 0.75 * reference[j] * spacing / max(slant, 0.05))
                distance = abs(off) + along
                if distance < best:
                    best, error, nx, ny = distance, off, lines[j, 0], lines[j, 1]
            if best < gate:
                used += 1
                weight = 1.0 / (1.0 + (error / sigma) ** 2)
                j2 = nx * -ry + ny * rx
                hessian[0, 0] += weight * nx * nx
                hessian[0, 1] += weight * nx * ny
                hessian[0, 2] += weight * nx * j2
                hessian[1, 1] += weight * ny * ny
                hessian[1, 2] += weight * ny * j2
                hessian[2, 2] += weight * j2 * j2
                g0 += weight * nx * error
                g1 += weight * ny * error
                g2 += weight * j2 * error
        # Along the direction in which the ends tell least, they count for less by LOOSE (the matrix becomes S H S).
        strong = 0.5 * math.atan2(2 * hessian[0, 1], hessian[0, 0] - hessian[1, 1])
        w0, w1 = -math.sin(strong), math.cos(strong)
        weak = w0 * w0 * hessian[0, 0] + 2 * w0 * w1 * hessian[0, 1] + w1 * w1 * hessian[1, 1]
        share = 1.0 - (math.sqrt(1.0 - LOOSE / weak) if weak > LOOSE else 0.0)
        h0, h1 = hessian[0, 0] * w0 + hessian[0, 1] * w1, hessian[0, 1] * w0 + hessian[1, 1] * w1
        hessian[0, 0] += share * (share * weak * w0 * w0 - 2 * h0 * w0)
        hessian[0, 1] += share * (share * weak * w0 * w1 - h0 * w1 - h1 * w0)
        hessian[1, 1] += share * (share * weak * w1 * w1 - 2 * h1 * w1)
        across, pull = w0 * hessian[0, 2] + w1 * hessian[1, 2], w0 * g0 + w1 * g1
        hessian[0, 2] -= share * across * w0
        hessian[1, 2] -= share * across * w1
        g0 -= share * pull * w0
        g1 -= share * pull * w1
        variance = SPREAD**2
        p0, p1, p2 = variance / spread[0] ** 2, variance / spread[1] ** 2, variance / spread[2] ** 2
        a, b, c = hessian[0, 0] + p0, hessian[0, 1], hessian[0, 2]
        d, e, f = hessian[1, 1] + p1, hessian[1, 2], hessian[2, 2] + p2
        turned = pose[2] - prior[2]
        g0 += p0 * (pose[0] - prior[0])
        g1 += p1 * (pose[1] - prior[1])
        g2 += p2 * turned
        # Cramer's rule on the symmetric 3 x 3 system; the prior keeps its determinant positive.
        m00, m01, m02 = d * f - e * e, c * e - b * f, b * e - c * d
        determinant = a * m00 + b * m01 + c * m02
        m11, m12, m22 = a * f - c * c, b * c - a * e, a * d - b * b
        s0 = (m00 * g0 + m01 * g1 + m02 * g2) / determinant
        s1 = (m01 * g0 + m11 * g1 + m12 * g2) / determinant
        s2 = (m02 * g0 + m12 * g1 + m22 * g2) / determinant
        pose[0] -= s0
        pose[1] -= s1
        pose[2] -= s2
        if turn > 4 and abs(s0) + abs(s1) + abs(s2) < 1e-3:
            break
    hessian[1, 0], hessian[2, 0], hessian[2, 1] = hessian[0, 1], hessian[0, 2], hessian[1, 2]
    return used


@compiled
def inlier_ratio(reference, ranges, range_max, pose, tolerance):
    """Return the share of a scan's ends that lie where the reference scan has its own, and how many these are.

    An end beyond the reference's own end on that bearing is hidden from it and counts for nothing; one well before it
    is against it. (Ask both ways round: each scan sees what the other can't.)
    """
    n = ranges.shape[0]
    spacing = 2 * math.pi / n
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    agree = against = 0
    for k in range(n):
        r = ranges[k]
        if r >= range_max - SHORT_OF_REACH:
            continue
        lx, ly = r * math.cos(k * spacing), r * math.sin(k * spacing)
        x, y = pose[0] + cos * lx - sin * ly, pose[1] + sin * lx + cos * ly
        beam = math.atan2(y, x) / spacing
        low = math.floor(beam)
        a, b = reference[low % n], reference[(low + 1) % n]
        distance = math.sqrt(x * x + y * y)
        if distance < min(a, b) - tolerance:
            against += 1
        elif distance <= max(a, b) + tolerance:
            agree += 1
    return agree / max(1, agree + against), agree


@dataclass(frozen=True, slots=True, kw_only=True)
class Match:
    """A scan matched with that of a place."""

    keyframe: int
    pose: np.ndarray
    """Of the scan, in the frame of the track, `(3,)`."""
    relative: np.ndarray
    """The same in the frame of the place, `(3,)`."""
    information: np.ndarray
    """Inverse covariance of `relative`, `(3, 3)`."""
    inlier_ratio: float
    """Share of ends that agree among those that can be judged, the less of both ways round."""
    num_inliers: int
    """Ends that agree, likewise."""

    @property
    def min_eigenvalue(self) -> float:
        """How many ends, at least, speak for the position in any direction: few along a plain corridor."""
        a, b, c = self.information[0, 0], self.information[0, 1], self.information[1, 1]
        return SPREAD**2 * (0.5 * (a + c) - math.sqrt(0.25 * (a - c) ** 2 + b * b))


def match(
    keyframes: Keyframes,
    keyframe: int,
    scan: np.ndarray,
    endpoints: np.ndarray,
    expected: np.ndarray,
    spread: np.ndarray,
    range_max: float,
) -> Match:
    """Match a scan with a place's.

    Parameters
    ----------
    keyframes : Keyframes
    keyframe : int
    scan, endpoints : (beams,)
        The scan, and its `reliable_endpoints`.
    expected, spread : (3,)
        Where it is expected to have been taken, in the frame of the track, and standard deviations of that.
    range_max : float
    """
    prior = relative(keyframes.pose[keyframe], expected)
    pose, hessian = np.empty(3), np.empty((3, 3))
    reference, lines = keyframes.scan[keyframe], keyframes.lines[keyframe]
    align(reference, lines, endpoints, range_max, prior, spread, pose, hessian)
    there, num_inliers = inlier_ratio(reference, scan, range_max, pose, TOLERANCE)
    back, num_inliers_back = inlier_ratio(scan, reference, range_max, relative(pose, np.zeros(3)), TOLERANCE)
    return Match(
        keyframe=int(keyframe),
        pose=compose(keyframes.pose[keyframe], pose),
        relative=pose,
        information=hessian / SPREAD**2,
        inlier_ratio=min(there, back),
        num_inliers=min(num_inliers, num_inliers_back),
    )

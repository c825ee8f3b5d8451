"""Where one scan was taken relative to another: point-to-line matching of their endpoints, and how well the two agree.

Iterative closest points in the point-to-line form of Chen and Medioni (1992) and Censi (2008), with a robust weight and
a prior, so that what the walls leave undetermined (the way along a plain corridor) stays as it was expected. An
iteration takes the pose q = (x, y, heading) of a scan in the frame of the reference and

1. associates each endpoint p, which lies at T(q) p there, with the nearest wall line (n, c) of the reference,
   and takes its signed distance from that line as the error,

       e(q) = n . T(q) p - c                                                   (Chen and Medioni; Censi)       (1)

2. weighs it by the function of Cauchy's distribution, where sigma shrinks from one iteration to the next,

       w = 1 / (1 + (e / sigma)^2)                                                                             (2)

3. and solves the normal equations of the weighted squares for a step d, with J = de/dq and prior q0 of standard
   deviations s (v is the variance of an endpoint about its wall),

       (sum w J' J + v S) d = -(sum w J' e + v S (q - q0)),   S = diag(1 / s^2)                                (3)
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from agents.component_config import ComponentConfig, kernel_tuple
from agents.slam.scan_filters import SHORT_OF_REACH
from cyclic_env.jit import compiled


@dataclass(frozen=True, slots=True, kw_only=True)
class MatcherConfig(ComponentConfig):
    """Fitting of wall lines, and the iterations of a match."""

    iterations: int = 12
    iterations_min: int = 6
    step_tolerance: float = 1e-3
    """Metres and radians; a smaller step is the last."""
    endpoint_std: float = 0.05
    """Standard deviation of an endpoint about its wall: the noise of two scans, and their coarseness."""
    gate: float = 1.0
    """Distance from a wall up to which an endpoint is associated with it, in the first iteration."""
    gate_decay: float = 0.7
    """By which it is multiplied from one iteration to the next."""
    gate_min: float = 0.15
    cauchy_scale: float = 0.03
    """Equation 2's sigma is this, and `cauchy_gate_share` of the gate."""
    cauchy_gate_share: float = 0.3
    search_beams: int = 6
    """Beams of the reference on either side of an endpoint's bearing at which its wall is looked for."""
    gap_share: float = 0.75
    """How far along a wall an endpoint may lie from the reference's, as a share of the distance between these."""
    incidence_min: float = 0.05
    """Sine of the flattest angle at which a beam is taken to meet a wall."""
    spurious_endpoints: float = 2.0
    """What noise and outliers pretend to know of the way along a plain corridor, in endpoints: it is discounted."""
    tolerance: float = 0.25
    """Metres between endpoints that agree."""
    line_reach_min: int = 2
    line_reach_max: int = 8
    """Neighbors on either side to which a line is fitted."""
    line_length_min: float = 0.4
    """Metres that they span at least: ten times the noise of a range."""
    line_length_enough: float = 1.0
    """Metres beyond which no more neighbors are taken."""
    line_rms_max: float = 0.06
    """Root mean square of their distances from the line, at most."""


MatcherValues = kernel_tuple("MatcherValues", MatcherConfig, __name__)


class Reference(NamedTuple):
    """A scan that others are matched with."""

    ranges: np.ndarray
    """`(beams,)`, metres."""
    points: np.ndarray
    """`(beams, 3)`: its endpoints, and how far the wall goes on there; see `place_endpoints` and `measure_gaps`."""
    lines: np.ndarray
    """`(beams, 3)`: the walls, as from `fit_wall_lines`."""


class Prior(NamedTuple):
    """An expected pose `(3,)` and its standard deviations `(3,)`, metres, metres and radians."""

    pose: np.ndarray
    std: np.ndarray


class Estimate(NamedTuple):
    """A pose `(3,)`, and the sums of equation 3: w J' J `(3, 3)` and w J' e `(3,)`."""

    pose: np.ndarray
    hessian: np.ndarray
    gradient: np.ndarray


@compiled
def associate(reference, pose, x, y, gate, values):
    """Return the distance of a point from the nearest wall of the reference, its error (1), and the wall's normal.

    The distance counts the way along the wall, too; it is `gate` if there is no wall within that.
    """
    points, lines = reference.points, reference.lines
    n = points.shape[0]
    spacing = 2 * math.pi / n
    center = round(math.atan2(y, x) / spacing)
    nearest, error, nx, ny = gate, 0.0, 0.0, 0.0
    following = (center - values.search_beams) % n
    for _ in range(2 * values.search_beams + 1):
        j = following
        following = j + 1 if j + 1 < n else 0
        # The scan must be on the side of the wall that the reference has seen: walls have two faces.
        side = pose[0] * lines[j, 0] + pose[1] * lines[j, 1] - lines[j, 2]
        if side * lines[j, 2] >= 0.0:  # also where there is no line
            continue
        off = x * lines[j, 0] + y * lines[j, 1] - lines[j, 2]
        if abs(off) >= nearest:
            continue
        dx, dy = x - points[j, 0], y - points[j, 1]
        along = max(0.0, abs(dx * lines[j, 1] - dy * lines[j, 0]) - points[j, 2])
        distance = abs(off) + along
        if distance < nearest:
            nearest, error, nx, ny = distance, off, lines[j, 0], lines[j, 1]
    return nearest, error, nx, ny


@compiled
def accumulate(estimate, weight, error, nx, ny, turning):
    """Add an endpoint to the sums of equation 3; J = (nx, ny, turning)."""
    hessian, gradient = estimate.hessian, estimate.gradient
    hessian[0, 0] += weight * nx * nx
    hessian[0, 1] += weight * nx * ny
    hessian[0, 2] += weight * nx * turning
    hessian[1, 1] += weight * ny * ny
    hessian[1, 2] += weight * ny * turning
    hessian[2, 2] += weight * turning * turning
    gradient[0] += weight * nx * error
    gradient[1] += weight * ny * error
    gradient[2] += weight * turning * error


@compiled
def linearize(reference, ranges, range_max, estimate, iteration, values):
    """Write the sums of equation 3 about the pose of the estimate; return how many endpoints are on a wall."""
    n = ranges.shape[0]
    spacing = 2 * math.pi / n
    pose = estimate.pose
    gate = max(values.gate_min, values.gate * values.gate_decay**iteration)
    sigma = values.cauchy_scale + values.cauchy_gate_share * gate
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    for i in range(3):
        estimate.gradient[i] = 0.0
        for j in range(3):
            estimate.hessian[i, j] = 0.0
    used = 0
    for k in range(n):
        r = ranges[k]
        if r >= range_max - SHORT_OF_REACH:
            continue
        lx, ly = r * math.cos(k * spacing), r * math.sin(k * spacing)
        rx, ry = cos * lx - sin * ly, sin * lx + cos * ly
        distance, error, nx, ny = associate(reference, pose, pose[0] + rx, pose[1] + ry, gate, values)
        if distance < gate:
            used += 1
            weight = 1.0 / (1.0 + (error / sigma) ** 2)  # (2)
            accumulate(estimate, weight, error, nx, ny, nx * -ry + ny * rx)
    return used


@compiled
def discount_weakest(estimate, endpoints):
    """Take some endpoints' worth of information from the direction in which the position is known least.

    With H and g the sums of equation 3 they become S H S and S g, where S shrinks that direction.
    """
    hessian, gradient = estimate.hessian, estimate.gradient
    strong = 0.5 * math.atan2(2 * hessian[0, 1], hessian[0, 0] - hessian[1, 1])
    w0, w1 = -math.sin(strong), math.cos(strong)
    weak = w0 * w0 * hessian[0, 0] + 2 * w0 * w1 * hessian[0, 1] + w1 * w1 * hessian[1, 1]
    share = 1.0 - (math.sqrt(1.0 - endpoints / weak) if weak > endpoints else 0.0)
    h0, h1 = hessian[0, 0] * w0 + hessian[0, 1] * w1, hessian[0, 1] * w0 + hessian[1, 1] * w1
    hessian[0, 0] += share * (share * weak * w0 * w0 - 2 * h0 * w0)
    hessian[0, 1] += share * (share * weak * w0 * w1 - h0 * w1 - h1 * w0)
    hessian[1, 1] += share * (share * weak * w1 * w1 - 2 * h1 * w1)
    across, pull = w0 * hessian[0, 2] + w1 * hessian[1, 2], w0 * gradient[0] + w1 * gradient[1]
    hessian[0, 2] -= share * across * w0
    hessian[1, 2] -= share * across * w1
    gradient[0] -= share * pull * w0
    gradient[1] -= share * pull * w1


@compiled
def solve(estimate, prior, variance):
    """Move the pose of the estimate by the step d of equation 3; return the step's size."""
    pose, hessian, gradient = estimate.pose, estimate.hessian, estimate.gradient
    p0, p1, p2 = variance / prior.std[0] ** 2, variance / prior.std[1] ** 2, variance / prior.std[2] ** 2
    a, b, c = hessian[0, 0] + p0, hessian[0, 1], hessian[0, 2]
    d, e, f = hessian[1, 1] + p1, hessian[1, 2], hessian[2, 2] + p2
    g0 = gradient[0] + p0 * (pose[0] - prior.pose[0])
    g1 = gradient[1] + p1 * (pose[1] - prior.pose[1])
    g2 = gradient[2] + p2 * (pose[2] - prior.pose[2])
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
    return abs(s0) + abs(s1) + abs(s2)


@compiled
def align(reference, ranges, range_max, prior, estimate, values):
    """Find the pose of a scan in the frame of a reference scan, and how well it is determined.

    Parameters
    ----------
    reference : Reference
    ranges : (beams,)
        The endpoints of the scan that are matched.
    range_max : float
    prior : Prior
        In the reference's frame.
    estimate : Estimate
        The result. Its hessian is without the prior: divided by the variance of an endpoint about its wall, it is the
        information that the walls give about the pose.
    values : MatcherValues

    Returns
    -------
    used : int
        Endpoints that are on a wall.
    """
    pose, hessian = estimate.pose, estimate.hessian
    pose[0], pose[1], pose[2] = prior.pose[0], prior.pose[1], prior.pose[2]
    used = 0
    for iteration in range(values.iterations):
        used = linearize(reference, ranges, range_max, estimate, iteration, values)
        discount_weakest(estimate, values.spurious_endpoints)
        moved = solve(estimate, prior, values.endpoint_std**2)
        if iteration + 1 >= values.iterations_min and moved < values.step_tolerance:
            break
    hessian[1, 0], hessian[2, 0], hessian[2, 1] = hessian[0, 1], hessian[0, 2], hessian[1, 2]
    return used


@compiled
def compare_endpoints(reference, ranges, range_max, pose, tolerance):
    """Return the share of a scan's endpoints that lie where the reference has its own, and how many these are.

    An endpoint beyond the reference's on that bearing is hidden from it and counts for nothing; one well before it
    contradicts it. Ask both ways round: each scan sees what the other can't.
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


def min_eigenvalue(information: np.ndarray) -> float:
    """Return the least eigenvalue of a symmetric matrix's upper left `(2, 2)`, that of the position."""
    a, b, c = information[0, 0], information[0, 1], information[1, 1]
    return 0.5 * (a + c) - math.sqrt(0.25 * (a - c) ** 2 + b * b)

"""Visibility: how far the robot can drive in a scan, which points are in sight, and where unseen space begins.

A scan is `(beams,)` ranges in metres, beam 0 straight ahead, counter-clockwise, evenly spaced; 0 where nobody looked.
The polygon that its endpoints span is free and seen. Poses are (x, y, heading) in the frame of the track; angles are
radians, and numbers of beams may be fractions. The kernels do not validate.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from agents.component_config import ComponentConfig, kernel_tuple
from agents.slam.scan_filters import SHORT_OF_REACH
from cyclic_env.jit import compiled

FIRM, DOUBTFUL, UNBOUNDED, UNCONFIRMED = 0, 1, 2, 3
"""Kinds of open points: at a corner; on a wall seen at a slant, or in an opening of it; with no wall within the laser's
reach; any of these that too few scans see through to."""


@dataclass(frozen=True, slots=True, kw_only=True)
class VisibilityConfig(ComponentConfig):
    """Settings of what counts as open and as explored; lengths in metres."""

    jump: float = 0.8
    """Difference of neighbouring ranges from which there is an opening between them."""
    jump_doubtful: float = 1.0
    """The same for ranges that may be those of one wall seen at a slant."""
    wall_clearance: float = 0.3
    """Least distance of an open point from all walls; a little more than the robot's radius."""
    wall_search_beams: int = 25
    """Number of beams on either side of a point within which walls are searched for."""
    corner_clearance: float = 1.0
    """Greatest distance behind a corner at which its open points begin."""
    reach_clearance: float = 0.3
    """Distance before the end of the longer range at which they end."""
    point_spacing: float = 0.6
    line_tolerance: float = 0.15
    """Distance from a wall's line within which an endpoint is on that wall."""
    line_length: float = 0.4
    """Length of the piece of wall that tells its direction: metres, or this share of the endpoint's range if longer."""
    line_beams: int = 11
    """Number of beams within which that piece is searched for."""
    wall_depth: float = 0.45
    """Distance behind a wall up to which a point counts as on it, because of drift, noise and useless niches."""
    edge_depth: float = 0.15
    """Least distance of an explored point from the edge of what the scan has seen."""
    beside: float = 1.0
    """Distance from a scan within which everything in sight is explored; else an opening would never be resolved."""
    near_sight: float = 0.6
    """Distance beyond an endpoint up to which a point is still in sight, at the edge of an opening or on a wall."""


VisibilityValues = kernel_tuple("VisibilityValues", VisibilityConfig, __name__)


@compiled
def clear_lengths(ranges, half_width, out):
    """Write into `out` `(beams,)` how far a body of that half width, metres, can go straight along each beam."""
    n = ranges.shape[0]
    spacing = 2 * math.pi / n
    for k in range(n):
        out[k] = ranges[k]
    for k in range(n):
        # A wall at this beam's end is in the way of all beams that pass it nearer than the half width.
        r = ranges[k]
        if r <= 0.0:  # not looked at
            continue
        aside = math.asin(half_width / r) if r > half_width else math.pi / 2
        reach = int(aside / spacing)
        for offset in range(-reach, reach + 1):
            other = (k + offset) % n
            out[other] = min(out[other], r * math.cos(offset * spacing))


@compiled
def clear_beam(clear, bearing, distance):
    """Return the bearing nearest to `bearing` along which the way is clear for `distance` metres; NaN if none is."""
    n = clear.shape[0]
    spacing = 2 * math.pi / n
    best, least = math.nan, math.inf
    for k in range(n):
        if clear[k] >= distance:
            off = k * spacing - bearing
            off -= 2 * math.pi * math.floor((off + math.pi) / (2 * math.pi))
            if abs(off) < least:
                best, least = bearing + off, abs(off)
    return best


@compiled
def inside(ranges, pose, points, margin, out):
    """Write into `out` `(n,)` which points `(n, 2)` the scan taken at a pose sees, `margin` before its endpoints."""
    n = ranges.shape[0]
    spacing = 2 * math.pi / n
    for i in range(points.shape[0]):
        dx, dy = points[i, 0] - pose[0], points[i, 1] - pose[1]
        beam = (math.atan2(dy, dx) - pose[2]) / spacing
        low = math.floor(beam)
        out[i] = math.sqrt(dx * dx + dy * dy) < min(ranges[low % n], ranges[(low + 1) % n]) - margin


@compiled
def seen_through(scans, poses, range_max, points, out):
    """Write into `out` `(n,)` how many of the scans `(m, beams)` at poses `(m, 3)` see each point `(n, 2)` as free.

    Only the beam nearest to a point counts, so the scans may be unfiltered, with wrong ranges. A beam that met no wall
    also sees points a little beyond its reach.
    """
    n = scans.shape[1]
    spacing = 2 * math.pi / n
    for i in range(points.shape[0]):
        out[i] = 0
        for k in range(scans.shape[0]):
            dx, dy = points[i, 0] - poses[k, 0], points[i, 1] - poses[k, 1]
            beam = round((math.atan2(dy, dx) - poses[k, 2]) / spacing)
            r = scans[k, beam % n]
            out[i] += r >= range_max - SHORT_OF_REACH or math.sqrt(dx * dx + dy * dy) < r


@compiled
def is_explored(scans, poses, range_max, points, out, values):
    """Write into `out` `(n,)` which points `(n, 2)` scans `(m, beams)` at poses `(m, 3)` have explored.

    A scan explores the points in front of its endpoints, those at a wall, and those in sight right beside it.
    """
    beams = scans.shape[1]
    spacing = 2 * math.pi / beams
    for i in range(points.shape[0]):
        out[i] = False
        for k in range(scans.shape[0]):
            dx, dy = points[i, 0] - poses[k, 0], points[i, 1] - poses[k, 1]
            beam = (math.atan2(dy, dx) - poses[k, 2]) / spacing
            low = math.floor(beam)
            a, b = scans[k, low % beams], scans[k, (low + 1) % beams]
            wall = max(a, b) < range_max - SHORT_OF_REACH and abs(a - b) <= values.jump
            distance = math.sqrt(dx * dx + dy * dy)
            beyond = distance - min(a, b)
            seen = beyond < (values.wall_depth if wall else -values.edge_depth)
            if seen or (distance < values.beside and beyond < values.near_sight):
                out[i] = True
                break


@compiled
def _continues(ranges, range_max, k, step, far, values):
    """Return whether the wall that ends at beam k, seen on the side of `step` (1 or -1), goes on to beam `far`."""
    n = ranges.shape[0]
    spacing = 2 * math.pi / n
    x, y = ranges[k] * math.cos(k * spacing), ranges[k] * math.sin(k * spacing)
    fx, fy = ranges[far] * math.cos(far * spacing), ranges[far] * math.sin(far * spacing)
    along = math.sqrt((fx - x) ** 2 + (fy - y) ** 2)
    for reach in range(1, values.line_beams + 1):
        i = (k + step * reach) % n
        if ranges[i] <= 0.0 or ranges[i] >= range_max - SHORT_OF_REACH:
            return False
        dx, dy = ranges[i] * math.cos(i * spacing) - x, ranges[i] * math.sin(i * spacing) - y
        base = math.sqrt(dx * dx + dy * dy)
        # The direction of a wall is as good as its base is long.
        if base >= max(values.line_length, values.line_length * along):
            off = abs((fx - x) * dy - (fy - y) * dx) / base
            return off < values.line_tolerance and (fx - x) * dx + (fy - y) * dy < 0.0
    return False


@compiled
def _on_one_wall(ranges, range_max, k, other, values):
    """Return whether the endpoints of two neighbouring beams are on one wall."""
    return _continues(ranges, range_max, k, -1, other, values) or _continues(ranges, range_max, other, 1, k, values)


@compiled
def _is_clear(ranges, range_max, r, beam, values):
    """Return whether the point (range, beam) has the clearance of open points from all walls."""
    n = ranges.shape[0]
    spacing = 2 * math.pi / n
    x, y = r * math.cos(beam * spacing), r * math.sin(beam * spacing)
    for i in range(int(beam) - values.wall_search_beams, int(beam) + values.wall_search_beams + 1):
        j = i % n
        if ranges[j] < range_max - SHORT_OF_REACH:
            dx, dy = ranges[j] * math.cos(j * spacing) - x, ranges[j] * math.sin(j * spacing) - y
            if dx * dx + dy * dy < values.wall_clearance**2:
                return False
    return True


@compiled
def open_points(ranges, range_max, out, values):
    """Write points on the open edges of a scan's polygon into `out` `(m, 3)`; return how many.

    A point is (range, beam, kind); see `FIRM`. An edge is open where the range jumps from one beam to the next, or
    where a beam met no wall: behind it lies what the scan has not seen. Points near walls are left out, and edges
    between endpoints on one wall, seen at a slant.
    """
    n = ranges.shape[0]
    free = range_max - SHORT_OF_REACH
    count = 0
    for k in range(n):
        other = (k + 1) % n
        a, b, kind = ranges[k], ranges[other], FIRM
        if a <= 0.0 or b <= 0.0:  # at the edge of what the laser looks at
            continue
        if a >= free and b >= free:
            first, last, beam, kind = range_max - values.reach_clearance, range_max, k + 0.5, UNBOUNDED
        elif abs(a - b) > values.jump:
            if _on_one_wall(ranges, range_max, k, other, values):
                # One wall seen at a slant, or an opening in it that both beams miss.
                if abs(a - b) > values.jump_doubtful and count < out.shape[0]:
                    out[count, 0], out[count, 1], out[count, 2] = 0.5 * (a + b), k + 0.5, DOUBTFUL
                    count += 1
                continue
            # The longer beam passes the corner; points along it, a little off the corner.
            first = min(a, b) + min(values.corner_clearance, 0.5 * abs(a - b))
            last, beam = max(a, b) - values.reach_clearance, float(k) if a > b else float(other)
        else:
            continue
        r = first
        while r < last and count < out.shape[0]:
            if _is_clear(ranges, range_max, r, beam, values):
                out[count, 0], out[count, 1], out[count, 2] = r, beam, kind
                count += 1
            r += values.point_spacing
    return count


def to_track(polar: np.ndarray, poses: np.ndarray, spacing: float) -> np.ndarray:
    """Return points `(n, 2)` in the frame of the track, from (range, beam, ...) `(n, 2+)` at poses `(n, 3)`."""
    angles = poses[:, 2] + polar[:, 1] * spacing
    return poses[:, :2] + polar[:, :1] * np.column_stack([np.cos(angles), np.sin(angles)])

"""What a scan sees: how far the robot can drive, which points are in sight, and where unseen space begins.

A scan is `(beams,)` ranges in metres, beam 0 straight ahead, counter-clockwise, evenly spaced. The polygon that its
endpoints span is free and seen. Poses are (x, y, heading) in the frame of the track.

The kernels do not validate; angles are radians, and "beam" numbers may be fractions.
"""

from __future__ import annotations

import math

import numpy as np

from agents.slam.scan_filters import SHORT_OF_REACH
from cyclic_env.jit import compiled

ASIDE = 0.3
"""Metres that a point to drive to is off all walls: a little more than the robot's radius."""
JUMP = 0.8
"""Metres between neighbouring ranges from which there is an opening between them."""
AT_WALL = 0.45
"""Metres behind a wall at which a point is taken to be on it: drift and noise between scans, and niches of no use."""
BESIDE = 1.0
"""Metres from a scan within which all in sight is settled, or a robot at an opening would never be done with it."""
NEAR_SIGHT = 0.6
"""Metres beyond a scan's end that still count as in sight: to the edge of an opening, or a wall."""
FIRM, DOUBTFUL, UNBOUNDED, UNCONFIRMED = 0, 1, 2, 3
"""Kinds of open points: at a corner; on a wall seen at a slant, or an opening in it; with no wall within reach; any of
these that too few scans see through to."""
OFF_WALL = 0.15
"""Metres: what is less off a wall's line is on it."""


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
        aside = math.asin(half_width / r) if r > half_width else math.pi / 2
        reach = int(aside / spacing)
        for offset in range(-reach, reach + 1):
            other = (k + offset) % n
            out[other] = min(out[other], r * math.cos(offset * spacing))


@compiled
def inside(ranges, x, y, heading, points, margin, out):
    """Write into `out` `(n,)` which points `(n, 2)` the scan taken at a pose sees, at least `margin` before its end."""
    n = ranges.shape[0]
    spacing = 2 * math.pi / n
    for i in range(points.shape[0]):
        dx, dy = points[i, 0] - x, points[i, 1] - y
        beam = (math.atan2(dy, dx) - heading) / spacing
        low = math.floor(beam)
        out[i] = math.sqrt(dx * dx + dy * dy) < min(ranges[low % n], ranges[(low + 1) % n]) - margin


@compiled
def seen_through(scans, poses, range_max, points, out):
    """Write into `out` `(n,)` by how many scans `(m, beams)` at poses `(m, 3)` each point `(n, 2)` is seen as free.

    The beam nearest to the point is asked, and it alone: the scans may be as measured, with ranges that are wrong. One
    that met no wall sees through to points a little beyond its reach too.
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
def is_explored(scans, poses, range_max, points, out):
    """Write into `out` `(n,)` which points `(n, 2)` are open no more after scans `(m, beams)` at poses `(m, 3)`.

    A scan settles what it sees beyond, what has a wall there, and what is in sight right beside it.
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
            wall = max(a, b) < range_max - SHORT_OF_REACH and abs(a - b) <= JUMP
            distance = math.sqrt(dx * dx + dy * dy)
            beyond = distance - min(a, b)
            if beyond < (AT_WALL if wall else -0.15) or (distance < BESIDE and beyond < NEAR_SIGHT):
                out[i] = True
                break


@compiled
def _continues(ranges, range_max, k, step, far):
    """Return whether the wall that ends at beam k, seen on the side of `step` (1 or -1), goes on to beam `far`."""
    n = ranges.shape[0]
    spacing = 2 * math.pi / n
    x, y = ranges[k] * math.cos(k * spacing), ranges[k] * math.sin(k * spacing)
    fx, fy = ranges[far] * math.cos(far * spacing), ranges[far] * math.sin(far * spacing)
    along = math.sqrt((fx - x) ** 2 + (fy - y) ** 2)
    for reach in range(1, 12):
        i = (k + step * reach) % n
        if ranges[i] >= range_max - SHORT_OF_REACH:
            return False
        dx, dy = ranges[i] * math.cos(i * spacing) - x, ranges[i] * math.sin(i * spacing) - y
        base = math.sqrt(dx * dx + dy * dy)
        if base >= max(0.4, 0.4 * along):  # the direction of a wall is as good as its base is long
            off = abs((fx - x) * dy - (fy - y) * dx) / base
            return off < OFF_WALL and (fx - x) * dx + (fy - y) * dy < 0.0
    return False


@compiled
def open_points(ranges, range_max, out):
    """Write points on the open edges of a scan's polygon into `out` `(m, 3)`; return how many.

    A point is (range, beam, kind); see `FIRM`.

    An edge is open where the range jumps by more than `JUMP` from one beam to the next, or where a beam ends
    at no wall: behind it lies what the scan has not seen. Points near walls are left out, and edges between ends on one
    wall, seen at a slant.
    """
    n = ranges.shape[0]
    spacing = 2 * math.pi / n
    free = range_max - SHORT_OF_REACH
    count = 0
    for k in range(n):
        other = (k + 1) % n
        a, b, kind = ranges[k], ranges[other], FIRM
        if a >= free and b >= free:
            first, last, beam, kind = range_max - 0.3, range_max, k + 0.5, UNBOUNDED
        elif abs(a - b) > JUMP:
            if _continues(ranges, range_max, k, -1, other) or _continues(ranges, range_max, other, 1, k):
                # One wall seen at a slant, or an opening in it that both beams miss.
                if abs(a - b) > 1.0 and count < out.shape[0]:
                    out[count, 0], out[count, 1], out[count, 2] = 0.5 * (a + b), k + 0.5, DOUBTFUL
                    count += 1
                continue
            # The longer beam passes the corner; points along it, a little off the corner.
            first, last, beam = (
                min(a, b) + min(1.0, 0.5 * abs(a - b)),
                max(a, b) - 0.3,
                float(k) if a > b else float(other),
            )
        else:
            continue
        r = first
        while r < last and count < out.shape[0]:
            x, y = r * math.cos(beam * spacing), r * math.sin(beam * spacing)
            aside = True
            for i in range(int(beam) - 25, int(beam) + 26):
                j = i % n
                if ranges[j] < free:
                    dx, dy = ranges[j] * math.cos(j * spacing) - x, ranges[j] * math.sin(j * spacing) - y
                    aside = aside and dx * dx + dy * dy >= ASIDE**2
            if aside:
                out[count, 0], out[count, 1], out[count, 2] = r, beam, kind
                count += 1
            r += 0.6
    return count


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


def to_track(polar: np.ndarray, poses: np.ndarray, spacing: float) -> np.ndarray:
    """Return points `(n, 2)` in the frame of the track, from (range, beam, ...) `(n, 2+)` at poses `(n, 3)`."""
    angles = poses[:, 2] + polar[:, 1] * spacing
    return poses[:, :2] + polar[:, :1] * np.column_stack([np.cos(angles), np.sin(angles)])

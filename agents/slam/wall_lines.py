"""The lines of the walls that a scan's endpoints lie on."""

from __future__ import annotations

import math

from agents.slam.scan_filters import SHORT_OF_REACH
from cyclic_env.jit import compiled


@compiled
def place_endpoints(ranges, points):
    """Write the endpoints of ranges `(beams,)` into the first two columns of `points` `(beams, 3)`, metres."""
    spacing = 2 * math.pi / ranges.shape[0]
    for k in range(ranges.shape[0]):
        points[k, 0] = ranges[k] * math.cos(k * spacing)
        points[k, 1] = ranges[k] * math.sin(k * spacing)


@compiled
def measure_gaps(ranges, lines, points, values):
    """Write into the third column of `points` `(beams, 3)` how far the wall at each endpoint goes on beside it, metres.

    Endpoints on a wall seen at a slant lie far apart, and the wall goes on between them.
    """
    spacing = 2 * math.pi / ranges.shape[0]
    for k in range(ranges.shape[0]):
        incidence = abs(math.cos(k * spacing) * lines[k, 0] + math.sin(k * spacing) * lines[k, 1])
        points[k, 2] = values.gap_share * ranges[k] * spacing / max(incidence, values.incidence_min)


@compiled
def _endpoint(ranges, points, i):
    """Return the endpoint of beam i, whose number may go on beyond a full turn."""
    n = ranges.shape[0]
    if 0 <= i < n:
        return points[i, 0], points[i, 1]
    angle = i * (2 * math.pi / n)
    return ranges[i % n] * math.cos(angle), ranges[i % n] * math.sin(angle)


@compiled
def fit_wall_lines(ranges, range_max, points, lines, values):
    """Write into `lines` `(beams, 3)` the walls at the endpoints: unit normal and offset, in the frame of the scan.

    A point (x, y) is on a wall (nx, ny, offset) where nx x + ny y = offset. A line is fitted to each endpoint and as
    many of its neighbors on both sides as are in line with it; (0, 0, 0) where these are too few, or met no wall.
    `points` are the endpoints, as from `place_endpoints`.
    """
    n = ranges.shape[0]
    spacing = 2 * math.pi / n
    for k in range(n):
        lines[k, 0] = lines[k, 1] = lines[k, 2] = 0.0
        for reach in range(values.line_reach_min, values.line_reach_max + 1):
            count = 2 * reach + 1
            mx = my = 0.0
            wall = True
            for i in range(k - reach, k + reach + 1):
                wall = wall and ranges[i % n] < range_max - SHORT_OF_REACH
                x, y = _endpoint(ranges, points, i)
                mx += x / count
                my += y / count
            if not wall:
                break
            a, b = ranges[(k - reach) % n], ranges[(k + reach) % n]
            length = math.sqrt(max(0.0, a * a + b * b - 2 * a * b * math.cos(2 * reach * spacing)))
            if length < values.line_length_min:
                continue
            xx = xy = yy = 0.0
            for i in range(k - reach, k + reach + 1):
                x, y = _endpoint(ranges, points, i)
                dx, dy = x - mx, y - my
                xx += dx * dx
                xy += dx * dy
                yy += dy * dy
            across = 0.5 * (xx + yy - math.sqrt((xx - yy) ** 2 + 4 * xy * xy))
            if across > count * values.line_rms_max**2:
                break
            along = 0.5 * math.atan2(2 * xy, xx - yy)
            lines[k, 0], lines[k, 1] = -math.sin(along), math.cos(along)
            lines[k, 2] = lines[k, 0] * mx + lines[k, 1] * my
            if length > values.line_length_enough:
                break

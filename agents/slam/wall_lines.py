"""The lines of the walls that a scan's endpoints lie on."""

from __future__ import annotations

import math

from agents.slam.scan_filters import SHORT_OF_REACH
from cyclic_env.jit import compiled


@compiled
def fit_wall_lines(ranges, range_max, lines, values):
    """Write into `lines` `(beams, 3)` the walls at the endpoints: unit normal and offset, in the frame of the scan.

    A point (x, y) is on a wall (nx, ny, offset) where nx x + ny y = offset. A line is fitted to each endpoint and as
    many of its neighbors on both sides as are in line with it; (0, 0, 0) where these are too few, or met no wall.
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
                r = ranges[i % n]
                wall = wall and r < range_max - SHORT_OF_REACH
                mx += r * math.cos(i * spacing) / count
                my += r * math.sin(i * spacing) / count
            if not wall:
                break
            a, b = ranges[(k - reach) % n], ranges[(k + reach) % n]
            length = math.sqrt(max(0.0, a * a + b * b - 2 * a * b * math.cos(2 * reach * spacing)))
            if length < values.line_length_min:
                continue
            xx = xy = yy = 0.0
            for i in range(k - reach, k + reach + 1):
                dx = ranges[i % n] * math.cos(i * spacing) - mx
                dy = ranges[i % n] * math.sin(i * spacing) - my
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

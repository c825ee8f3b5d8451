"""What the robot sees all around, from a laser that sees less: scans of the last metres, put together where it is now.

A panorama is `(n,)` ranges in metres all around, counter-clockwise from straight ahead, as a scan of 360 degrees is.
0 means not looked at: such a beam says nothing, neither that the way is free nor that there is a wall. A range of at
least `range_max` means that the laser looked and met nothing.

The kernels do not validate; angles are radians.
"""

from __future__ import annotations

import math

import numpy as np

from agents.slam.scan_filters import SHORT_OF_REACH
from cyclic_env.config import LaserConfig
from cyclic_env.jit import compiled

WALL_GAP = 0.6
"""Metres between the endpoints of neighbouring beams up to which the wall is taken to go on between them."""
FILL_STEP = 0.05
"""Metres between the points that stand for the wall there."""
SIGNATURE_SECTORS = 36
"""Sectors of a signature, of ten degrees each."""
SIGNATURE_REACH = 20.0
"""Metres: what lies farther looks alike."""


def spread_beams(ranges: np.ndarray, beams: np.ndarray, count: int) -> np.ndarray:
    """Return a panorama `(count,)` of one scan: its ranges at the given beams of the panorama, 0 elsewhere.

    Parameters
    ----------
    ranges : (m,)
    beams : (m,) int
        For each range, the panorama's beam on its bearing.
    count : int
    """
    panorama = np.zeros(count)
    panorama[beams] = np.maximum(ranges, 1e-3)
    return panorama


def panorama_beams(laser: LaserConfig) -> tuple[np.ndarray, int]:
    """Return which beam of a panorama each beam of a laser is `(num_beams,)`, and how many beams the panorama has."""
    count = round(math.tau / laser.beam_spacing)
    return (_first_beam(laser) + np.arange(laser.num_beams)) % count, count


def panorama_offset(laser: LaserConfig) -> float:
    """Return the bearing of a panorama's beam 0, radians: at most half a beam from straight ahead."""
    return laser.first_bearing - _first_beam(laser) * laser.beam_spacing


def _first_beam(laser: LaserConfig) -> int:
    return math.floor(laser.first_bearing / laser.beam_spacing + 0.5)


@compiled
def keep_steady(scan, smooth, range_max, tolerance, out):
    """Write a scan into `out` `(n,)`, 0 where it is not within `tolerance` of what takes the speckle out of it."""
    for k in range(scan.shape[0]):
        steady = scan[k] > 0.0 and abs(scan[k] - smooth[k]) <= tolerance
        out[k] = min(scan[k], range_max) if steady else 0.0


@compiled
def merge_scans(scans, poses, first, last, pose, range_max, nearest, out):
    """Write into `out` `(n,)` the panorama at a pose, from the scans `first` to `last` `(m, n)` at poses `(m, 3)`.

    On each bearing the second nearest of the scans' endpoints counts: what only one scan has seen there, well before
    all others, was passing by. `nearest` `(3, n)` is scratch.
    """
    n = out.shape[0]
    spacing = 2 * math.pi / n
    cos_at, sin_at = math.cos(pose[2]), math.sin(pose[2])
    for k in range(n):
        nearest[0, k] = nearest[1, k] = math.inf
    for q in range(last, first - 1, -1):
        for k in range(n):
            nearest[2, k] = math.inf
        turn = poses[q, 2] - pose[2]
        dx, dy = poses[q, 0] - pose[0], poses[q, 1] - pose[1]
        x0, y0 = cos_at * dx + sin_at * dy, cos_at * dy - sin_at * dx
        last_x = last_y = 0.0
        on_wall = False
        for beam in range(n + 1):
            r = scans[q, beam % n]
            if r <= 0.0 or r >= range_max - SHORT_OF_REACH:
                on_wall = False
                continue
            angle = turn + beam * spacing
            x, y = x0 + r * math.cos(angle), y0 + r * math.sin(angle)
            steps = 1
            if on_wall:
                gap = math.sqrt((x - last_x) ** 2 + (y - last_y) ** 2)
                if gap < WALL_GAP:
                    steps = int(gap / FILL_STEP) + 1
            for s in range(1, steps + 1):
                share = s / steps
                px = x if steps == 1 else last_x + (x - last_x) * share
                py = y if steps == 1 else last_y + (y - last_y) * share
                b = round(math.atan2(py, px) / spacing) % n
                nearest[2, b] = min(nearest[2, b], math.sqrt(px * px + py * py))
            last_x, last_y, on_wall = x, y, True
        for k in range(n):
            r = nearest[2, k]
            if r < nearest[0, k]:
                nearest[1, k] = nearest[0, k]
                nearest[0, k] = r
            elif r < nearest[1, k]:
                nearest[1, k] = r
    for k in range(n):
        r = nearest[1, k] if nearest[1, k] < math.inf else nearest[0, k]
        out[k] = r if r < range_max - SHORT_OF_REACH else 0.0


@compiled
def signature(panorama, out):
    """Write into `out` `(SIGNATURE_SECTORS,)` the roots of the median ranges by sector; 0 where half was not looked at.

    The root counts a metre for more where walls are near: there a place has its own look.
    """
    n, sectors = panorama.shape[0], out.shape[0]
    for s in range(sectors):
        low, high = s * n // sectors, (s + 1) * n // sectors
        seen = 0
        for k in range(low, high):
            seen += panorama[k] > 0.0
        out[s] = 0.0
        if 2 * seen < high - low or seen == 0:
            continue
        # The median: the value with half of the others below it, ties by number.
        for k in range(low, high):
            below = 0
            for j in range(low, high):
                if panorama[j] > 0.0 and (panorama[j] < panorama[k] or (panorama[j] == panorama[k] and j < k)):
                    below += 1
            if panorama[k] > 0.0 and below == seen // 2:
                out[s] = math.sqrt(min(panorama[k], SIGNATURE_REACH))


@compiled
def signature_distances(signatures, headings, rows, signature, heading, tolerance, out):
    """Write into `out` `(c,)` how unlike the signatures of rows `(c,)` are to one, turned as the headings say.

    Parameters
    ----------
    signatures, headings : (n, S) and (n,)
    rows : (c,) int
    signature, heading : (S,) and float
    tolerance : int
        Sectors by which the headings may be wrong: the best turn counts.
    out : (c,)
        Mean squared differences of the sectors that both have; inf where they share less than half.
    """
    sectors = signature.shape[0]
    for c in range(rows.shape[0]):
        row = rows[c]
        turn = round((heading - headings[row]) * sectors / (2 * math.pi))
        out[c] = math.inf
        for shift in range(turn - tolerance, turn + tolerance + 1):
            total, shared = 0.0, 0
            for s in range(sectors):
                a, b = signature[s], signatures[row, (s + shift) % sectors]
                if a > 0.0 and b > 0.0:
                    total += (a - b) ** 2
                    shared += 1
            if 2 * shared >= sectors:
                out[c] = min(out[c], total / shared)

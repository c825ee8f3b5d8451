"""What takes wrong ranges out of a scan, and tells which of its endpoints lie on walls as they were measured.

A scan is `(beams,)` ranges in metres, beam 0 straight ahead, counter-clockwise, evenly spaced. Poses are
(x, y, heading) in the frame of the track. The kernels do not validate; angles are radians.
"""

from __future__ import annotations

import math

import numpy as np

from cyclic_env.jit import compiled

SHORT_OF_REACH = 0.05
"""Metres: a range that is less short of the laser's reach than that met no wall."""
CONFIRM = 0.4
"""Metres."""
SOUND, SOUND_NOISE = 0.02, 2.5
"""Metres by which an end may be moved from where it was measured; and, for noise moves all, how many times as far as
the lower three quarters of them."""


@compiled
def _median_of_three(ranges, k):
    n = ranges.shape[0]
    a, b, c = ranges[(k - 1) % n], ranges[k % n], ranges[(k + 1) % n]
    return max(min(a, b), min(max(a, b), c))


@compiled
def despeckle(ranges, out):
    """Write into `out` `(beams,)` the median of five beams, of what the median of three has made of the ranges.

    Two wrong ranges are dropped. The median of five alone would, next to a wrong one, take the next beam's for a beam's
    on a wall seen at a slant, and see through the wall.
    """
    a, b, c, d = (
        _median_of_three(ranges, -2),
        _median_of_three(ranges, -1),
        _median_of_three(ranges, 0),
        _median_of_three(ranges, 1),
    )
    for k in range(ranges.shape[0]):
        e = _median_of_three(ranges, k + 2)
        # The least and the most of the first four can't be the median; it is that of the two left and the fifth.
        low, high = max(min(a, b), min(c, d)), min(max(a, b), max(c, d))
        out[k] = max(min(low, high), min(max(low, high), e))
        a, b, c, d = b, c, d, e


@compiled
def confirm(ranges, pose, earlier, earlier_pose, confirmed):
    """Set `confirmed` `(beams,)` where a beam's end agrees with an earlier scan, taken a short way off.

    Agreement is loose: within `CONFIRM` metres of what the earlier scan has within two beams of the end's bearing.
    """
    n = ranges.shape[0]
    spacing = 2 * math.pi / n
    for k in range(n):
        angle = pose[2] + k * spacing
        dx = pose[0] + ranges[k] * math.cos(angle) - earlier_pose[0]
        dy = pose[1] + ranges[k] * math.sin(angle) - earlier_pose[1]
        distance = math.sqrt(dx * dx + dy * dy)
        centre = round((math.atan2(dy, dx) - earlier_pose[2]) / spacing)
        least, most = math.inf, 0.0
        for i in range(centre - 2, centre + 3):
            least, most = min(least, earlier[i % n]), max(most, earlier[i % n])
        if least - CONFIRM <= distance <= most + CONFIRM:
            confirmed[k] = True


@compiled
def fill(ranges, confirmed, out):
    """Write the ranges into `out` `(beams,)`, those not confirmed replaced by the nearer of the next confirmed ones."""
    n = ranges.shape[0]
    for k in range(n):
        out[k] = ranges[k]
        if confirmed[k]:
            continue
        for offset in range(1, n // 2):
            before, after = (k - offset) % n, (k + offset) % n
            if confirmed[before] or confirmed[after]:
                out[k] = min(
                    ranges[before] if confirmed[before] else math.inf, ranges[after] if confirmed[after] else math.inf
                )
                break


def reliable_endpoints(scan: np.ndarray, measured: np.ndarray, range_max: float) -> np.ndarray:
    """Return the ranges `(..., beams)` of scans whose ends lie on walls as measured; `range_max` for all others.

    What takes the speckle out of a scan also rounds the corners that it sees, by more than noise: ends that it has
    moved would pull at a match, back to where the other scan was taken.
    """
    moved = np.abs(scan - measured)
    return np.where(moved > SOUND + SOUND_NOISE * np.quantile(moved, 0.75, axis=-1, keepdims=True), range_max, scan)

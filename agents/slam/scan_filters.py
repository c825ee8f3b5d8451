"""What takes wrong ranges out of a scan, and tells which of its endpoints lie on walls as they were measured.

A scan is `(beams,)` ranges in metres, beam 0 straight ahead, counter-clockwise, evenly spaced. Poses are
(x, y, heading) in the frame of the track; angles are radians. The kernels do not validate.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from agents.component_config import ComponentConfig
from cyclic_env.config import LaserConfig
from cyclic_env.jit import compiled

SHORT_OF_REACH = 0.05
"""Metres of rounding: a range that is less short of the laser's reach than this met no wall."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FilterConfig(ComponentConfig):
    """Which ranges are believed."""

    scans_to_confirm: int = 2
    """Earlier scans, of which one must agree with a range."""
    confirm_tolerance: float = 0.4
    confirm_beams: int = 2
    """Beams on either side within which an earlier scan is asked."""
    shift_max: float = 0.02
    """Metres by which the median filter may move an endpoint that is matched afterwards."""
    shift_noise: float = 2.5
    """Where noise makes it move all endpoints: how many times as far as `shift_quantile` of them."""
    shift_quantile: float = 0.75


BEAMS = 180
"""Beams in which a scan is read, at most: what is known of filters, matches and openings is known of so many."""


class LaserReader:
    """Reads a laser of any number of beams: each of `BEAMS` or fewer is the median of those about it.

    Parameters
    ----------
    laser : LaserConfig

    Attributes
    ----------
    laser : LaserConfig
        As it is read.
    """

    def __init__(self, laser: LaserConfig) -> None:
        beams = min(laser.num_beams, BEAMS)
        self.laser = replace(laser, num_beams=beams)
        reach = laser.num_beams // beams // 2
        spacing = laser.num_beams / beams if laser.sees_all_around else (laser.num_beams - 1) / (beams - 1)
        about = np.rint(spacing * np.arange(beams)).astype(np.int64)[:, None] + np.arange(-reach, reach + 1)
        self._about = about % laser.num_beams if laser.sees_all_around else np.clip(about, 0, laser.num_beams - 1)

    def read(self, ranges: np.ndarray) -> np.ndarray:
        """Return the ranges `(beams,)`, between 0 and the laser's reach, of a scan `(num_beams,)`."""
        ranges = np.fmax(np.fmin(ranges, self.laser.range_max), 0.0)  # of a NaN and a number, the number
        middle = self._about.shape[1] // 2
        return np.sort(ranges[self._about], axis=1)[:, middle] if middle else ranges


@compiled
def _median_of_three(ranges, k):
    n = ranges.shape[0]
    a, b, c = ranges[(k - 1) % n], ranges[k % n], ranges[(k + 1) % n]
    return max(min(a, b), min(max(a, b), c))


@compiled
def despeckle(ranges, out):
    """Write into `out` `(beams,)` the median of five beams, each of which is first the median of three.

    This drops up to two wrong ranges in a row. The median of five alone would, next to a wrong range on a wall seen at
    a slant, take the next beam's range, and so see through the wall.
    """
    a, b, c, d = (
        _median_of_three(ranges, -2),
        _median_of_three(ranges, -1),
        _median_of_three(ranges, 0),
        _median_of_three(ranges, 1),
    )
    for k in range(ranges.shape[0]):
        e = _median_of_three(ranges, k + 2)
        # The least and the greatest of the first four can't be the median: it is that of the other two and the fifth.
        low, high = max(min(a, b), min(c, d)), min(max(a, b), max(c, d))
        out[k] = max(min(low, high), min(max(low, high), e))
        a, b, c, d = b, c, d, e


@compiled
def confirm(ranges, pose, earlier, earlier_pose, confirmed, tolerance, beams):
    """Set `confirmed` `(beams,)` where an earlier scan, taken a short way off, agrees with a range.

    It agrees if the endpoint lies within `tolerance` of what the earlier scan shows within `beams` beams of it.
    """
    n = ranges.shape[0]
    spacing = 2 * math.pi / n
    for k in range(n):
        angle = pose[2] + k * spacing
        dx = pose[0] + ranges[k] * math.cos(angle) - earlier_pose[0]
        dy = pose[1] + ranges[k] * math.sin(angle) - earlier_pose[1]
        distance = math.sqrt(dx * dx + dy * dy)
        center = round((math.atan2(dy, dx) - earlier_pose[2]) / spacing)
        least, most = math.inf, 0.0
        for i in range(center - beams, center + beams + 1):
            least, most = min(least, earlier[i % n]), max(most, earlier[i % n])
        if least - tolerance <= distance <= most + tolerance:
            confirmed[k] = True


@compiled
def fill(ranges, confirmed, out):
    """Write the ranges into `out` `(beams,)`, unconfirmed ones replaced by the nearer of the next confirmed ones."""
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


def reliable_endpoints(
    scan: np.ndarray, measured: np.ndarray, range_max: float, config: FilterConfig | None = None
) -> np.ndarray:
    """Return the ranges `(..., beams)` of filtered scans that are as they were measured, `range_max` for the others.

    The filter also rounds corners, by more than noise. Matched, such endpoints would pull a scan back to where the
    other one was taken.
    """
    config = config or FilterConfig()
    shift = np.abs(scan - measured)
    typical = np.quantile(shift, config.shift_quantile, axis=-1, keepdims=True)
    return np.where(shift > config.shift_max + config.shift_noise * typical, range_max, scan)

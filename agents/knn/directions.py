"""Steps 1 to 5 of the paper: the compass direction, its indicators, the groups of rows, and the KNN vote among them."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

NORTH, EAST, SOUTH, WEST = range(4)
NAMES = "NESW"
HEADINGS = (math.pi / 2, 0.0, -math.pi / 2, math.pi)
SWITCH = math.radians(55)
"""Off a direction, from which it changes: ten degrees beyond the border, so a wobble doesn't flicker."""


def compass_direction(heading: float, current: int | None) -> int:
    """Return the direction of a heading, which stays `current` within `SWITCH` of it."""
    if current is not None and abs(math.remainder(heading - HEADINGS[current], math.tau)) <= SWITCH:
        return current
    return min(range(4), key=lambda d: abs(math.remainder(heading - HEADINGS[d], math.tau)))


def sector_features(ranges: np.ndarray, sectors: int, rounding: float) -> np.ndarray:
    """Return the properties of a place: the least range in each sector, in whole multiples of `rounding` metres.

    Parameters
    ----------
    ranges : (beams,)
        Beam 0 straight ahead, counter-clockwise.
    sectors : int
        At least 2, centred evenly from -90 to +90 degrees, and as wide as they are apart.
    rounding : float

    Returns
    -------
    (2, sectors) float64
        Looking ahead, and looking back.
    """
    n = len(ranges)
    width = n / (2 * (sectors - 1))
    features = np.empty((2, sectors))
    for side in range(2):
        for s in range(sectors):
            centre = side * n / 2 - n / 4 + s * width
            first = math.ceil(centre - width / 2)
            last = math.ceil(centre + width / 2)
            features[side, s] = ranges[np.arange(first, last) % n].min()
    return np.rint(features / rounding)


@dataclass(slots=True)
class Group:
    """One table: the rows taken while a direction was driven for the n-th time."""

    direction: int
    indicator: int
    rows: list[int] = field(default_factory=list)

    @property
    def name(self) -> str:
        """As in the paper, such as N2."""
        return f"{NAMES[self.direction]}{self.indicator}"

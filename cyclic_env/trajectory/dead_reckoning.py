"""Dead reckoning: the trajectory that the distance meter and the compass give on their own."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from cyclic_env.errors import ConfigError
from cyclic_env.trajectory.arrays import finite_column, finite_rows


def dead_reckon(distance: Any, compass: Any, start: Any = (0.0, 0.0)) -> np.ndarray:
    """Integrate the readings of the distance meter and the compass into poses.

    Each step is taken in the direction halfway between the compass readings before and after it, which is the direction
    of the chord where the robot drives an arc. The paper uses the reading after the step, which is wrong by half of
    every turn.

    Parameters
    ----------
    distance : (n,) or (n, 1)
        Readings of the distance meter, metres.
    compass : (n, 2)
        Readings of the compass: unit vectors, east and north.
    start : (x, y)
        Position at the first reading, metres.

    Returns
    -------
    (n, 3) float64
        x, y, heading; metres and radians.

    Raises
    ------
    ConfigError
        If the shapes don't match, or a number is not finite.
    """
    compass = finite_rows(compass, 2, "compass")
    distance = finite_column(distance, "distance")
    if len(distance) != len(compass):
        raise ConfigError(f"got {len(distance)} distances and {len(compass)} compass readings; expected equal numbers.")
    heading = np.arctan2(compass[:, 1], compass[:, 0])
    turn = (np.diff(heading) + math.pi) % math.tau - math.pi
    middle = heading[:-1] + 0.5 * turn
    steps = np.diff(distance)[:, None] * np.stack([np.cos(middle), np.sin(middle)], axis=1)
    positions = np.cumsum(np.concatenate([np.reshape(start, (1, 2)), steps]), axis=0)
    return np.column_stack([positions[: len(heading)], heading])

"""The error of an estimated trajectory against the true one."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from cyclic_env.errors import ConfigError
from cyclic_env.trajectory.arrays import finite_rows


def align_rigid(estimated: Any, true: Any) -> np.ndarray:
    """Return the estimated positions, rotated and translated as a whole so that they fit the true ones best.

    This is the least-squares solution of Umeyama (1991) without a scale. If all estimates coincide, they are only
    translated.

    Parameters
    ----------
    estimated, true : (n, 2)
        Positions at the same times, metres.

    Returns
    -------
    (n, 2) float64
    """
    estimated, true = _pair(estimated, true)
    a, b = estimated - estimated.mean(axis=0), true - true.mean(axis=0)
    angle = math.atan2(float((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum()), float((a * b).sum()))
    cos, sin = math.cos(angle), math.sin(angle)
    return a @ np.array([[cos, sin], [-sin, cos]]) + true.mean(axis=0)


def ate(estimated: Any, true: Any, *, align: bool = False) -> float:
    """Return the absolute trajectory error: the root mean square of the position errors, metres.

    Parameters
    ----------
    estimated, true : (n, 2)
        Positions at the same times, metres.
    align : bool
        Whether to align the estimate first, with `align_rigid`. Without alignment, the estimate is taken to know the
        true start.

    Raises
    ------
    ConfigError
        If the shapes don't match, a number is not finite, or there are no positions.
    """
    estimated, true = _pair(estimated, true)
    error = (align_rigid(estimated, true) if align else estimated) - true
    return math.sqrt(float((error**2).sum(axis=1).mean()))


def _pair(estimated: Any, true: Any) -> tuple[np.ndarray, np.ndarray]:
    estimated, true = finite_rows(estimated, 2, "the estimated positions"), finite_rows(true, 2, "the true positions")
    if len(estimated) != len(true) or not len(true):
        raise ConfigError(f"got {len(estimated)} estimated and {len(true)} true positions; expected equal numbers.")
    return estimated, true

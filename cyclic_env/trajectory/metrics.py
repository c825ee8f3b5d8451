"""The error of an estimated trajectory against the true one."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from cyclic_env.errors import ConfigError
from cyclic_env.trajectory.arrays import finite_rows
from cyclic_env.trajectory.poses import compose, relative


def rigid_alignment(estimated: Any, true: Any) -> np.ndarray:
    """Return the pose `(3,)` of the estimate's frame in the true one that fits the estimated positions best.

    This is the least-squares solution of Umeyama (1991) without a scale. If all estimates coincide, they are only
    translated.

    Parameters
    ----------
    estimated, true : (n, 2)
        Positions at the same times, metres.
    """
    estimated, true = _pair(estimated, true)
    a, b = estimated - estimated.mean(axis=0), true - true.mean(axis=0)
    angle = math.atan2(float((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum()), float((a * b).sum()))
    cos, sin = math.cos(angle), math.sin(angle)
    return np.array([*(true.mean(axis=0) - np.array([[cos, -sin], [sin, cos]]) @ estimated.mean(axis=0)), angle])


def align_rigid(estimated: Any, true: Any) -> np.ndarray:
    """Return the estimated positions `(n, 2)`, moved as a whole by `rigid_alignment`."""
    estimated, true = _pair(estimated, true)
    headless = np.column_stack([estimated, np.zeros(len(estimated))])
    return compose(rigid_alignment(estimated, true), headless)[:, :2]


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


class RelationErrors(NamedTuple):
    """How far relative poses of an estimate are from the known ones, means and standard deviations."""

    relations: int
    translation_m: float
    translation_std_m: float
    rotation_rad: float
    rotation_std_rad: float


def relation_errors(estimated: np.ndarray, pairs: np.ndarray, relations: np.ndarray) -> RelationErrors:
    """Return the errors of an estimate's relative poses (Kuemmerle et al. 2009).

    Parameters
    ----------
    estimated : (n, 3)
        Poses.
    pairs : (m, 2) int
        Two of the poses each, m at least 1.
    relations : (m, 3)
        The true pose of the second in the frame of the first.
    """
    error = relative(relations, relative(estimated[pairs[:, 0]], estimated[pairs[:, 1]]))
    metres, turns = np.hypot(error[:, 0], error[:, 1]), np.abs(error[:, 2])
    statistics = (metres.mean(), metres.std(), turns.mean(), turns.std())
    return RelationErrors(len(pairs), *(float(value) for value in statistics))


def match_times(times: np.ndarray, others: np.ndarray, tolerance: float) -> np.ndarray:
    """Return for each time the index of the nearest of `others`, or -1 where it is farther than the tolerance.

    Parameters
    ----------
    times : (n,)
    others : (m,)
        Ascending, m at least 1.
    tolerance : float
        Seconds.
    """
    after = np.clip(np.searchsorted(others, times), 1, max(len(others) - 1, 1))
    before = np.minimum(after - 1, len(others) - 1)
    after = np.minimum(after, len(others) - 1)
    nearest = np.where(np.abs(times - others[before]) <= np.abs(others[after] - times), before, after)
    return np.where(np.abs(others[nearest] - times) <= tolerance, nearest, -1)


def _pair(estimated: Any, true: Any) -> tuple[np.ndarray, np.ndarray]:
    estimated, true = finite_rows(estimated, 2, "the estimated positions"), finite_rows(true, 2, "the true positions")
    if len(estimated) != len(true) or not len(true):
        raise ConfigError(f"got {len(estimated)} estimated and {len(true)} true positions; expected equal numbers.")
    return estimated, true

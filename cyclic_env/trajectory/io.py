"""Trajectories: dead reckoning, how far an estimate is off, and the files that evo, g2o and GTSAM read.

Poses are (x, y, heading) in the world's frame, metres and radians.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cyclic_env.atomic_write import write_text_atomically
from cyclic_env.errors import ConfigError
from cyclic_env.validation import as_array

Edge = tuple[int, int, np.ndarray, np.ndarray]
"""Two poses by their numbers i and j, the pose of j in the frame of i `(3,)`, and its information `(3, 3)`."""


def dead_reckon(distance: Any, compass: Any, start: Any = (0.0, 0.0)) -> np.ndarray:
    """Return the poses that the distance meter and the compass give by themselves.

    The robot is taken to have driven each step in the direction midway between the compass's readings before and after
    it, in which the chord of an arc lies. The paper takes the reading after it, which is off by half of every turn.

    Parameters
    ----------
    distance : (n,) or (n, 1)
        Readings of the distance meter, metres.
    compass : (n, 2)
        Readings of the compass: unit vectors, east and north.
    start : (x, y)
        Position at the first reading.

    Returns
    -------
    (n, 3) float64

    Raises
    ------
    ConfigError
        If the shapes don't fit, or something is not finite.
    """
    compass = _rows(compass, 2, "compass")
    distance = _rows(np.reshape(distance, (-1, 1)), 1, "distance")[:, 0]
    if len(distance) != len(compass):
        raise ConfigError(f"there are {len(distance)} distances and {len(compass)} compass readings; expected as many.")
    heading = np.arctan2(compass[:, 1], compass[:, 0])
    turn = (np.diff(heading) + math.pi) % math.tau - math.pi
    middle = heading[:-1] + 0.5 * turn
    steps = np.diff(distance)[:, None] * np.stack([np.cos(middle), np.sin(middle)], axis=1)
    positions = np.cumsum(np.concatenate([np.reshape(start, (1, 2)), steps]), axis=0)
    return np.column_stack([positions[: len(heading)], heading])


def align_rigid(estimated: Any, true: Any) -> np.ndarray:
    """Return the estimated positions, turned and shifted as a whole to lie nearest to the true ones.

    The least-squares solution of Umeyama (1991) without a scale. Where all estimates are at one place, none is turned.

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
    """Return the absolute trajectory error: the root mean square of the positions' errors, metres.

    Parameters
    ----------
    estimated, true : (n, 2)
        Positions at the same times, metres.
    align : bool
        Align first, by `align_rigid`. Without, it is the error of who knows the start.

    Raises
    ------
    ConfigError
        If the shapes don't fit, something is not finite, or there are no positions.
    """
    estimated, true = _pair(estimated, true)
    off = (align_rigid(estimated, true) if align else estimated) - true
    return math.sqrt(float((off**2).sum(axis=1).mean()))


def write_tum(path: str | Path, times: Any, poses: Any) -> None:
    """Write a trajectory in the format of the TUM RGB-D benchmark: ``timestamp tx ty tz qx qy qz qw``.

    Parameters
    ----------
    path : str or path
    times : (n,)
        Seconds.
    poses : (n, 3)

    Raises
    ------
    ConfigError
        If the shapes don't fit, something is not finite, or the file can't be written.
    """
    poses = _rows(poses, 3, "poses")
    times = _rows(np.reshape(times, (-1, 1)), 1, "times")[:, 0]
    if len(times) != len(poses):
        raise ConfigError(f"there are {len(times)} times and {len(poses)} poses; expected as many.")
    lines = ["# timestamp tx ty tz qx qy qz qw"]
    for time, (x, y, heading) in zip(times.tolist(), poses.tolist(), strict=True):
        z, w = math.sin(heading / 2), math.cos(heading / 2)
        lines.append(f"{time:.6f} {x:.9f} {y:.9f} 0 0 0 {z:.12f} {w:.12f}")
    _write(path, lines)


def write_g2o(
    path: str | Path, poses: Any, edges: Sequence[Edge], heading_information: Any = 0.0, headings: Any = None
) -> None:
    """Write a pose graph in the format of g2o: ``VERTEX_SE2``, ``EDGE_SE2``, the first pose with ``FIX``.

    Parameters
    ----------
    path : str or path
    poses : (n, 3)
    edges : sequence of Edge
    heading_information : float
        Inverse variance of the headings.
    headings : (n,), optional
        Measured headings of the poses: each becomes an ``EDGE_PRIOR_SE2`` that says nothing of the position. Readers
        that don't know that line, as GTSAM, pass over it.

    Raises
    ------
    ConfigError
        If the shapes don't fit, something is not finite, an edge names no pose, or the file can't be written.
    """
    poses = _rows(poses, 3, "poses")
    lines = [f"VERTEX_SE2 {i} {_words(pose)}" for i, pose in enumerate(poses)]
    for i, j, measured, information in edges:
        if not (0 <= i < len(poses) and 0 <= j < len(poses)):
            raise ConfigError(f"an edge joins poses {i} and {j}; there are {len(poses)}.")
        measured = _rows(np.reshape(measured, (1, -1)), 3, "an edge")[0]
        upper = _rows(information, 3, "the information of an edge")[np.triu_indices(3)]
        lines.append(f"EDGE_SE2 {i} {j} {_words(measured)} {_words(upper)}")
    if headings is not None:
        information = _words(np.array([0.0, 0, 0, 0, 0, heading_information]))
        lines += [f"EDGE_PRIOR_SE2 {i} 0 0 {float(heading)!r} {information}" for i, heading in enumerate(headings)]
    lines += ["FIX 0"] if len(poses) else []  # last: GTSAM reads no edge after it
    _write(path, lines)


def _words(values: np.ndarray) -> str:
    """Return numbers as text that reads back to the same bits."""
    return " ".join(repr(value) for value in values.tolist())


def _write(path: str | Path, lines: list[str]) -> None:
    try:
        write_text_atomically(path, "\n".join(lines) + "\n")
    except OSError as error:
        raise ConfigError(f"can't write to {path}: {error.strerror}.") from error


def _pair(estimated: Any, true: Any) -> tuple[np.ndarray, np.ndarray]:
    estimated, true = _rows(estimated, 2, "the estimated positions"), _rows(true, 2, "the true positions")
    if len(estimated) != len(true) or not len(true):
        raise ConfigError(f"there are {len(estimated)} estimated and {len(true)} true positions; expected as many.")
    return estimated, true


def _rows(value: Any, columns: int, what: str) -> np.ndarray:
    """Return finite numbers `(n, columns)`."""
    expected = f"finite numbers in {columns} columns"
    array = as_array(value, what, expected, ConfigError).astype(np.float64)
    if array.ndim != 2 or array.shape[1] != columns or not np.isfinite(array).all():
        raise ConfigError(f"{what}: got an array of shape {array.shape}; expected {expected}.")
    return array

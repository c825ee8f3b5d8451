"""Trajectories as TUM files and pose graphs as g2o files, which evo, g2o and GTSAM read.

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
from cyclic_env.trajectory.arrays import finite_column, finite_rows

Edge = tuple[int, int, np.ndarray, np.ndarray]
"""Indices i and j of two poses, the pose of j in the frame of i `(3,)`, and its information matrix `(3, 3)`."""


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
        If the shapes don't match, a number is not finite, or the file can't be written.
    """
    poses, times = finite_rows(poses, 3, "poses"), finite_column(times, "times")
    if len(times) != len(poses):
        raise ConfigError(f"got {len(times)} times and {len(poses)} poses; expected equal numbers.")
    lines = ["# timestamp tx ty tz qx qy qz qw"]
    for time, (x, y, heading) in zip(times.tolist(), poses.tolist(), strict=True):
        z, w = math.sin(heading / 2), math.cos(heading / 2)
        lines.append(f"{time:.6f} {x:.9f} {y:.9f} 0 0 0 {z:.12f} {w:.12f}")
    _write(path, lines)


def write_g2o(
    path: str | Path, poses: Any, edges: Sequence[Edge], heading_information: Any = 0.0, headings: Any = None
) -> None:
    """Write a pose graph in the format of g2o: ``VERTEX_SE2``, ``EDGE_SE2``, and ``FIX`` for the first pose.

    Parameters
    ----------
    path : str or path
    poses : (n, 3)
    edges : sequence of Edge
    heading_information : float
        Inverse variance of `headings`.
    headings : (n,), optional
        Measured headings of the poses. Each becomes an ``EDGE_PRIOR_SE2`` without information about the position.
        Readers that don't know this line, such as GTSAM, skip it.

    Raises
    ------
    ConfigError
        If the shapes don't match, a number is not finite, an edge refers to no pose, or the file can't be written.
    """
    poses = finite_rows(poses, 3, "poses")
    lines = [f"VERTEX_SE2 {i} {_format(pose)}" for i, pose in enumerate(poses)]
    for i, j, measured, information in edges:
        if not (0 <= i < len(poses) and 0 <= j < len(poses)):
            raise ConfigError(f"an edge joins poses {i} and {j}, but there are only {len(poses)}.")
        measured = finite_rows(np.reshape(measured, (1, -1)), 3, "an edge")[0]
        upper = finite_rows(information, 3, "the information of an edge")[np.triu_indices(3)]
        lines.append(f"EDGE_SE2 {i} {j} {_format(measured)} {_format(upper)}")
    if headings is not None:
        information = _format(np.array([0.0, 0, 0, 0, 0, heading_information]))
        lines += [f"EDGE_PRIOR_SE2 {i} 0 0 {float(heading)!r} {information}" for i, heading in enumerate(headings)]
    lines += ["FIX 0"] if len(poses) else []  # last, because GTSAM reads no edge after it
    _write(path, lines)


def _format(values: np.ndarray) -> str:
    """Return numbers as text that reads back to the same bits."""
    return " ".join(map(repr, values.tolist()))


def _write(path: str | Path, lines: list[str]) -> None:
    try:
        write_text_atomically(path, "\n".join(lines) + "\n")
    except OSError as error:
        raise ConfigError(f"can't write to {path}: {error.strerror}.") from error

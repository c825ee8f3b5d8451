"""Poses `(..., 3)` in the plane: x, y, heading; metres and radians. Arithmetic: `cyclic_env.trajectory`."""

from __future__ import annotations

import numpy as np

from cyclic_env.trajectory.poses import compose, relative, wrap_angle

__all__ = ["compose", "euclidean_distances", "relative", "wrap_angle"]


def euclidean_distances(points: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Return the distances `(n,)` of points or poses `(n, 2+)` from one point or pose."""
    return np.hypot(points[:, 0] - point[0], points[:, 1] - point[1])

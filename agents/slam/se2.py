"""Arithmetic of poses (x, y, heading), metres and radians, `(..., 3)`."""

from __future__ import annotations

import math

import numpy as np


def wrap(angle: float) -> float:
    """Return the angle in [-pi, pi) that differs from `angle` by whole turns."""
    return (angle + math.pi) % math.tau - math.pi


def wrap_all(angles: np.ndarray) -> np.ndarray:
    """Return the angles in [-pi, pi) that differ from `angles` by whole turns."""
    return (angles + math.pi) % math.tau - math.pi


def relative(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return poses b in the frames of poses a."""
    cos, sin = np.cos(a[..., 2]), np.sin(a[..., 2])
    dx, dy = b[..., 0] - a[..., 0], b[..., 1] - a[..., 1]
    return np.stack([cos * dx + sin * dy, cos * dy - sin * dx, wrap_all(b[..., 2] - a[..., 2])], axis=-1)


def compose(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return poses b, which are given in the frames of poses a, in the frame in which a are given."""
    cos, sin = np.cos(a[..., 2]), np.sin(a[..., 2])
    x, y = a[..., 0] + cos * b[..., 0] - sin * b[..., 1], a[..., 1] + sin * b[..., 0] + cos * b[..., 1]
    return np.stack([x, y, wrap_all(a[..., 2] + b[..., 2])], axis=-1)


def euclidean_distances(points: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Return the distances `(n,)` of points or poses `(n, 2+)` from one point or pose."""
    return np.hypot(points[:, 0] - point[0], points[:, 1] - point[1])

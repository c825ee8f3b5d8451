"""Poses in the plane: arrays `(..., 3)` of x, y, heading; metres and radians."""

from __future__ import annotations

import math
from typing import Any

import numpy as np


def wrap_angle(angle: Any) -> Any:
    """Return the angle in [-pi, pi) that differs from `angle` by whole turns."""
    return (angle + math.pi) % math.tau - math.pi


def compose(first: Any, second: Any) -> np.ndarray:
    """Return poses `second`, given in the frames of poses `first`, in the frame in which `first` is given."""
    first, second = np.asarray(first, np.float64), np.asarray(second, np.float64)
    cos, sin = np.cos(first[..., 2]), np.sin(first[..., 2])
    x = first[..., 0] + cos * second[..., 0] - sin * second[..., 1]
    y = first[..., 1] + sin * second[..., 0] + cos * second[..., 1]
    return np.stack([x, y, wrap_angle(first[..., 2] + second[..., 2])], axis=-1)


def relative(first: Any, second: Any) -> np.ndarray:
    """Return poses `second` in the frames of poses `first`; both are given in the same frame."""
    first, second = np.asarray(first, np.float64), np.asarray(second, np.float64)
    cos, sin = np.cos(first[..., 2]), np.sin(first[..., 2])
    x, y = second[..., 0] - first[..., 0], second[..., 1] - first[..., 1]
    return np.stack([cos * x + sin * y, cos * y - sin * x, wrap_angle(second[..., 2] - first[..., 2])], axis=-1)


def interpolate(times: np.ndarray, stamps: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Return the poses at `times` `(n,)`, linearly between `poses` `(m, 3)` at increasing `stamps` `(m,)`."""
    columns = (poses[:, 0], poses[:, 1], np.unwrap(poses[:, 2]))
    x, y, heading = (np.interp(times, stamps, column) for column in columns)
    return np.stack([x, y, wrap_angle(heading)], axis=-1)

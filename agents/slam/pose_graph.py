"""Least squares over a graph of poses: the trajectory that fits all relative measurements and compass readings best.

The formulation is Lu and Milios's (1997): minimise the sum over the edges of e' W e, where e is the measured relative
pose less the current one and W its information, plus the compass's squared errors over their variance. It is solved by
Gauss-Newton on the sparse normal equations, as g2o and GTSAM do.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.linalg import splu

from agents.component_config import ComponentConfig
from agents.slam.se2 import relative, wrap_angle


@dataclass(frozen=True, slots=True, kw_only=True)
class PoseGraphConfig(ComponentConfig):
    """When Gauss-Newton stops."""

    iterations: int = 5
    step_tolerance: float = 1e-3
    """Metres and radians; a smaller step is the last."""


def optimize(
    poses: np.ndarray,
    edges: np.ndarray,
    measured: np.ndarray,
    information: np.ndarray,
    headings: np.ndarray,
    heading_information: np.ndarray,
    config: PoseGraphConfig | None = None,
) -> np.ndarray:
    """Return the poses that fit best; the first one stays where it is.

    Parameters
    ----------
    poses : (n, 3)
        The first guess.
    edges : (m, 2) int
        The two poses of each measurement.
    measured : (m, 3)
        The second pose of each edge in the frame of the first.
    information : (m, 3, 3)
        Inverse covariances of these.
    headings, heading_information : (n,)
        What the compass read at each pose, and its inverse variance.
    config : PoseGraphConfig, optional

    Returns
    -------
    (n, 3) float64
    """
    config = config or PoseGraphConfig()
    poses = poses.copy()
    n, unary = len(poses), 3 * np.arange(len(poses)) + 2
    i, j = edges.T
    for _ in range(config.iterations):
        error = residuals(poses, edges, measured)
        values, rows, columns, gradient = [], [], [], np.zeros((n, 3))
        jacobians = edge_jacobians(poses[i], poses[j])
        for a, of_a in zip((i, j), jacobians, strict=True):
            weighted = of_a.transpose(0, 2, 1) @ information
            np.add.at(gradient, a, (weighted @ error[:, :, None])[:, :, 0])
            for b, of_b in zip((i, j), jacobians, strict=True):
                values.append((weighted @ of_b).ravel())
                rows.append((3 * a[:, None, None] + np.arange(3)[:, None] + np.zeros((1, 1, 3), int)).ravel())
                columns.append((3 * b[:, None, None] + np.arange(3) + np.zeros((1, 3, 1), int)).ravel())
        gradient[:, 2] += heading_information * wrap_angle(poses[:, 2] - headings)
        entries = np.concatenate([*values, heading_information])
        where = np.concatenate([*rows, unary]), np.concatenate([*columns, unary])
        hessian = coo_array((entries, where), (3 * n, 3 * n)).tocsc()
        step = -splu(hessian[3:, 3:]).solve(gradient.ravel()[3:]).reshape(-1, 3)
        poses[1:] += step
        poses[:, 2] = wrap_angle(poses[:, 2])
        if np.abs(step).max() < config.step_tolerance:
            break
    return poses


def residuals(poses: np.ndarray, edges: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """Return by how much the edges' relative poses `(m, 3)` differ from those measured."""
    error = relative(poses[edges[:, 0]], poses[edges[:, 1]]) - measured
    error[:, 2] = wrap_angle(error[:, 2])
    return error


def edge_jacobians(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the derivatives `(m, 3, 3)` of `relative(a, b)` by the poses a and by the poses b."""
    cos, sin = np.cos(a[:, 2]), np.sin(a[:, 2])
    by_b = np.zeros((len(a), 3, 3))
    by_b[:, 0, 0], by_b[:, 0, 1], by_b[:, 1, 0], by_b[:, 1, 1], by_b[:, 2, 2] = cos, sin, -sin, cos, 1
    by_a = -by_b
    dx, dy = b[:, 0] - a[:, 0], b[:, 1] - a[:, 1]
    by_a[:, 0, 2], by_a[:, 1, 2] = cos * dy - sin * dx, -cos * dx - sin * dy
    return by_a, by_b

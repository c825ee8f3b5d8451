"""Least squares over a graph of poses: what the track becomes when it is found to be back at a known place.

The formulation is Lu and Milios's (1997), solved by Gauss-Newton on the sparse normal equations (as g2o and GTSAM do).
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.linalg import splu

from agents.slam.se2 import relative, wrap_all

ROUNDS = 5
SMALL_STEP = 1e-3
"""Metres and radians; a smaller step ends the rounds."""


def optimize(
    poses: np.ndarray,
    edges: np.ndarray,
    measured: np.ndarray,
    information: np.ndarray,
    headings: np.ndarray,
    heading_information: np.ndarray,
) -> np.ndarray:
    """Return the poses that fit best, the first one held fast.

    Parameters
    ----------
    poses : (n, 3)
        As they are: where the rounds begin.
    edges : (m, 2) int
        The two poses of each measured edge.
    measured : (m, 3)
        The second pose of each edge in the frame of the first.
    information : (m, 3, 3)
        Inverse covariances of these.
    headings, heading_information : (n,)
        What the compass said at each pose, and its inverse variance.

    Returns
    -------
    (n, 3) float64
    """
    poses = poses.copy()
    n = len(poses)
    i, j = edges.T
    for _ in range(ROUNDS):
        cos, sin = np.cos(poses[i, 2]), np.sin(poses[i, 2])
        error = relative(poses[i], poses[j]) - measured
        error[:, 2] = wrap_all(error[:, 2])
        at_j = np.zeros((len(edges), 3, 3))
        at_j[:, 0, 0], at_j[:, 0, 1], at_j[:, 1, 0], at_j[:, 1, 1], at_j[:, 2, 2] = cos, sin, -sin, cos, 1
        at_i = -at_j
        dx, dy = poses[j, 0] - poses[i, 0], poses[j, 1] - poses[i, 1]
        at_i[:, 0, 2], at_i[:, 1, 2] = cos * dy - sin * dx, -cos * dx - sin * dy
        values, rows, columns, gradient = [], [], [], np.zeros((n, 3))
        for a, of_a in ((i, at_i), (j, at_j)):
            weighted = of_a.transpose(0, 2, 1) @ information
            np.add.at(gradient, a, (weighted @ error[:, :, None])[:, :, 0])
            for b, of_b in ((i, at_i), (j, at_j)):
                values.append((weighted @ of_b).ravel())
                rows.append((3 * a[:, None, None] + np.arange(3)[:, None] + np.zeros((1, 1, 3), int)).ravel())
                columns.append((3 * b[:, None, None] + np.arange(3) + np.zeros((1, 3, 1), int)).ravel())
        values.append(heading_information)
        rows.append(3 * np.arange(n) + 2)
        columns.append(3 * np.arange(n) + 2)
        gradient[:, 2] += heading_information * wrap_all(poses[:, 2] - headings)
        matrix = coo_array((np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), (3 * n, 3 * n))
        step = -splu(matrix.tocsc()[3:, 3:]).solve(gradient.ravel()[3:]).reshape(-1, 3)
        poses[1:] += step
        poses[:, 2] = wrap_all(poses[:, 2])
        if np.abs(step).max() < SMALL_STEP:
            break
    return poses

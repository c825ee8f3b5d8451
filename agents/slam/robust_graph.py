"""A pose graph in which a wrong loop closure bends nothing: graduated non-convexity.

H. Yang, P. Antonante, V. Tzoumas and L. Carlone, "Graduated Non-Convexity for Robust Spatial Perception", RA-L 2020,
with truncated least squares: a closure's weight is 1 while it fits within the threshold, 0 beyond, and in between while
the cost is made less and less convex.
"""

from __future__ import annotations

import numpy as np

from agents.slam.pose_graph import PoseGraphConfig, optimize, residuals

GROWTH = 1.6
"""By which the control parameter grows from one round to the next; the authors take 1.4."""
ROUNDS = 30


def squared_errors(poses: np.ndarray, edges: np.ndarray, measured: np.ndarray, information: np.ndarray) -> np.ndarray:
    """Return the squared errors `(m,)` of a graph's edges, in standard deviations."""
    error = residuals(poses, edges, measured)
    return np.einsum("mi,mij,mj->m", error, information, error)


def optimize_robustly(
    poses: np.ndarray,
    edges: np.ndarray,
    measured: np.ndarray,
    information: np.ndarray,
    doubtful: np.ndarray,
    headings: np.ndarray,
    heading_information: np.ndarray,
    threshold: float,
    config: PoseGraphConfig | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the poses that fit best, the first one held fast, and the weights `(m,)` that the edges were given.

    Parameters
    ----------
    poses, edges, measured, information, headings, heading_information
        As of `pose_graph.optimize`.
    doubtful : (m,) int
        Groups of edges that are right or wrong together; -1 for those that are certain.
    threshold : float
        Mean squared error, in standard deviations, up to which a group of edges is right.
    """
    groups = doubtful.max(initial=-1) + 1
    of_group = np.maximum(doubtful, 0)
    sizes = np.maximum(np.bincount(doubtful[doubtful >= 0], minlength=groups), 1)
    weights = np.ones(len(edges))
    control = 0.0
    for _ in range(ROUNDS):
        poses = optimize(
            poses, edges, measured, weights[:, None, None] * information, headings, heading_information, config
        )
        if not groups:
            break
        squares = squared_errors(poses, edges, measured, information)
        means = np.bincount(of_group, np.where(doubtful >= 0, squares, 0.0), minlength=groups) / sizes
        if control == 0.0:
            if means.max() <= threshold:
                break
            control = threshold / max(2 * means.max() - threshold, threshold)
        low, high = control / (control + 1) * threshold, (control + 1) / control * threshold
        with np.errstate(divide="ignore"):
            between = np.sqrt(threshold * control * (control + 1) / means) - control
        of_groups = np.where(means <= low, 1.0, np.where(means >= high, 0.0, between))
        fresh = np.where(doubtful >= 0, of_groups[of_group], 1.0)
        done = (np.minimum(fresh, 1 - fresh) < 1e-3).all() and (fresh == weights).all()
        weights = fresh
        if done:
            break
        control *= GROWTH
    return poses, weights

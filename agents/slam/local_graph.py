"""Least squares over the last keyframes alone: a sliding window, solved at every keyframe."""

from __future__ import annotations

import math

from cyclic_env.jit import compiled

ROUNDS = 4
SMALL_STEP = 1e-4
"""Metres and radians; a smaller step ends the rounds."""
OUTLIER = 12.0
"""Squared error of an edge, in standard deviations, from which it counts for less (Cauchy's weight)."""


@compiled
def optimize_window(poses, first, edges, matrix, vector):
    """Move the poses `first` and later `(n, 3)` to where they fit their edges to earlier poses best.

    Parameters
    ----------
    poses : (n, 3)
        Written to.
    first : int
        At least 1.
    edges : tuple of (n, s) int64, (n, s, 3) and (n, s, 3, 3)
        For each pose, up to s edges to earlier ones: the other pose, or -1; this pose in the frame of the other;
        and the inverse covariance of that.
    matrix, vector : (3 w, 3 w) and (3 w,)
        Scratch, for at least w = n - first poses.
    """
    sources, measured, information = edges
    n, slots = poses.shape[0], sources.shape[1]
    size = 3 * (n - first)
    for _ in range(ROUNDS):
        for a in range(size):
            vector[a] = 0.0
            for b in range(size):
                matrix[a, b] = 0.0
        for j in range(first, n):
            for s in range(slots):
                i = sources[j, s]
                if i < 0:
                    continue
                _add_edge(poses, i, j, first, measured[j, s], information[j, s], matrix, vector)
        if not _solve(matrix, vector, size):
            return
        largest = 0.0
        for a in range(size):
            poses[first + a // 3, a % 3] += vector[a]
            largest = max(largest, abs(vector[a]))
        if largest < SMALL_STEP:
            break
    for j in range(first, n):
        poses[j, 2] -= 2 * math.pi * math.floor((poses[j, 2] + math.pi) / (2 * math.pi))


@compiled
def _add_edge(poses, i, j, first, measured, information, matrix, vector):
    """Add an edge from pose i to pose j to the normal equations; poses before `first` are fixed."""
    cos, sin = math.cos(poses[i, 2]), math.sin(poses[i, 2])
    dx, dy = poses[j, 0] - poses[i, 0], poses[j, 1] - poses[i, 1]
    x, y = cos * dx + sin * dy, cos * dy - sin * dx
    turn = poses[j, 2] - poses[i, 2] - measured[2]
    turn -= 2 * math.pi * math.floor((turn + math.pi) / (2 * math.pi))
    e0, e1, e2 = x - measured[0], y - measured[1], turn
    square = (
        information[0, 0] * e0 * e0
        + information[1, 1] * e1 * e1
        + information[2, 2] * e2 * e2
        + 2 * (information[0, 1] * e0 * e1 + information[0, 2] * e0 * e2 + information[1, 2] * e1 * e2)
    )
    weight = 1.0 / (1.0 + square / OUTLIER)
    row_j, row_i = 3 * (j - first), 3 * (i - first)
    # The error's derivative by pose j has the rows (cos, sin, 0), (-sin, cos, 0), (0, 0, 1); by pose i these with the
    # other sign, and (y, -x, 0) by its heading.
    for a in range(3):
        ja = _column(a, cos, sin)
        ia = (-ja[0], -ja[1], -ja[2]) if a < 2 else (y, -x, -1.0)
        wj = _times(information, ja, weight)
        wi = _times(information, ia, weight)
        vector[row_j + a] -= wj[0] * e0 + wj[1] * e1 + wj[2] * e2
        for b in range(3):
            jb = _column(b, cos, sin)
            matrix[row_j + a, row_j + b] += wj[0] * jb[0] + wj[1] * jb[1] + wj[2] * jb[2]
        if i < first:
            continue
        vector[row_i + a] -= wi[0] * e0 + wi[1] * e1 + wi[2] * e2
        for b in range(3):
            jb = _column(b, cos, sin)
            ib = (-jb[0], -jb[1], -jb[2]) if b < 2 else (y, -x, -1.0)
            matrix[row_i + a, row_i + b] += wi[0] * ib[0] + wi[1] * ib[1] + wi[2] * ib[2]
            cross = wi[0] * jb[0] + wi[1] * jb[1] + wi[2] * jb[2]
            matrix[row_i + a, row_j + b] += cross
            matrix[row_j + b, row_i + a] += cross


@compiled
def _column(a, cos, sin):
    """Return the derivative of an edge's error by the coordinate a of its second pose."""
    if a == 0:
        return cos, -sin, 0.0
    if a == 1:
        return sin, cos, 0.0
    return 0.0, 0.0, 1.0


@compiled
def _times(information, column, weight):
    """Return the product of a symmetric matrix `(3, 3)` with a column, times a weight."""
    return (
        weight * (information[0, 0] * column[0] + information[0, 1] * column[1] + information[0, 2] * column[2]),
        weight * (information[1, 0] * column[0] + information[1, 1] * column[1] + information[1, 2] * column[2]),
        weight * (information[2, 0] * column[0] + information[2, 1] * column[1] + information[2, 2] * column[2]),
    )


@compiled
def _solve(matrix, vector, size):
    """Solve the equations in place by Cholesky's decomposition; return False where the matrix is singular."""
    for a in range(size):
        for b in range(a + 1):
            total = matrix[a, b]
            for k in range(b):
                total -= matrix[a, k] * matrix[b, k]
            if a == b:
                if total <= 0.0:
                    return False
                matrix[a, a] = math.sqrt(total)
            else:
                matrix[a, b] = total / matrix[b, b]
    for a in range(size):
        for k in range(a):
            vector[a] -= matrix[a, k] * vector[k]
        vector[a] /= matrix[a, a]
    for a in range(size - 1, -1, -1):
        for k in range(a + 1, size):
            vector[a] -= matrix[k, a] * vector[k]
        vector[a] /= matrix[a, a]
    return True

"""What was taken at each place along the way, and the graph that joins the places."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from cyclic_env.jit import compiled

MAX_NEIGHBORS = 16
"""Most places that one can be joined to; more add no new ways."""
CAPACITY = 256
"""Keyframes that there is room for at first."""


@compiled
def connect(neighbors, degrees, i, j):
    """Join places i and j, unless they are joined or have no joint left."""
    if i == j or degrees[i] >= neighbors.shape[1] or degrees[j] >= neighbors.shape[1]:
        return
    for k in range(degrees[i]):
        if neighbors[i, k] == j:
            return
    neighbors[i, degrees[i]] = j
    neighbors[j, degrees[j]] = i
    degrees[i] += 1
    degrees[j] += 1


@compiled
def shortest_paths(neighbors, degrees, poses, source, distances, predecessors, queue, waiting):
    """Write the lengths of the shortest ways from a place to all into `distances` `(n,)`, metres; inf where none leads.

    `predecessors` `(n,)` becomes the place before each on its way, -1 at the source; `queue` and `waiting` are scratch.
    """
    n = distances.shape[0]
    for i in range(n):
        distances[i] = math.inf
        predecessors[i] = -1
        waiting[i] = False
    distances[source] = 0.0
    queue[0], head, count = source, 0, 1
    # Label correcting with a queue: the graph is a few long chains, so few labels are corrected twice.
    while count > 0:
        i = queue[head]
        head = (head + 1) % n
        count -= 1
        waiting[i] = False
        for k in range(degrees[i]):
            j = neighbors[i, k]
            dx, dy = poses[j, 0] - poses[i, 0], poses[j, 1] - poses[i, 1]
            length = distances[i] + math.sqrt(dx * dx + dy * dy) + 1e-6
            if length < distances[j]:
                distances[j] = length
                predecessors[j] = i
                if not waiting[j]:
                    queue[(head + count) % n] = j
                    count += 1
                    waiting[j] = True


class Keyframes:
    """Columns with a row for each place, which grow as places are added, and the joints between places.

    Parameters
    ----------
    beams : int
    sectors : int

    Attributes
    ----------
    pose : (n, 3) float64
        In the frame of the track, which begins at (0, 0) with the compass's heading.
    odometry : (n, 2) float64
        Where dead reckoning alone would put it.
    scan : (n, beams) float64
    endpoints : (n, beams) float64
        Those of the scan that are on walls as measured; see `reliable_endpoints`.
    lines : (n, beams, 3) float64
        Of the walls at these ends; see `fit_wall_lines`.
    features : (n, 2, sectors) float64
        Ahead and back; see `sector_features`.
    compass : (n,) float64
        Its reading as a heading.
    direction, group, step : (n,) int64
    path : (n,) float64
        Metres driven since the reset, by the distance meter.
    """

    pose: np.ndarray
    odometry: np.ndarray
    scan: np.ndarray
    endpoints: np.ndarray
    lines: np.ndarray
    features: np.ndarray
    compass: np.ndarray
    direction: np.ndarray
    group: np.ndarray
    step: np.ndarray
    path: np.ndarray
    neighbors: np.ndarray
    degrees: np.ndarray
    queue: np.ndarray
    waiting: np.ndarray

    def __init__(self, beams: int, sectors: int) -> None:
        self.count = 0
        self._columns = {
            "pose": np.zeros((CAPACITY, 3)),
            "odometry": np.zeros((CAPACITY, 2)),
            "scan": np.zeros((CAPACITY, beams)),
            "endpoints": np.zeros((CAPACITY, beams)),
            "lines": np.zeros((CAPACITY, beams, 3)),
            "features": np.zeros((CAPACITY, 2, sectors)),
            "compass": np.zeros(CAPACITY),
            "direction": np.zeros(CAPACITY, np.int64),
            "group": np.zeros(CAPACITY, np.int64),
            "step": np.zeros(CAPACITY, np.int64),
            "path": np.zeros(CAPACITY),
            "neighbors": np.zeros((CAPACITY, MAX_NEIGHBORS), np.int64),
            "degrees": np.zeros(CAPACITY, np.int64),
            "queue": np.zeros(CAPACITY, np.int64),
            "waiting": np.zeros(CAPACITY, np.bool_),
        }
        self._show()

    def _show(self) -> None:
        """Let the attributes be the used parts of the columns."""
        for name, column in self._columns.items():
            setattr(self, name, column[: self.count])

    def add(self, **values: Any) -> int:
        """Add a place with a value for each attribute, joined to the last one; return its number."""
        if self.count == len(self._columns["step"]):
            self._columns = {name: np.concatenate([old, np.zeros_like(old)]) for name, old in self._columns.items()}
        self.count += 1
        self._show()
        for name, value in values.items():
            getattr(self, name)[-1] = value
        if self.count > 1:
            self.connect(self.count - 2, self.count - 1)
        return self.count - 1

    def connect(self, i: int, j: int) -> None:
        """Let ways lead between two places."""
        connect(self.neighbors, self.degrees, i, j)

    def geodesic_distances(self, source: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the lengths `(n,)` of the shortest ways to all places, metres, and the place before each, `(n,)`."""
        distances, predecessors = np.empty(self.count), np.empty(self.count, np.int64)
        shortest_paths(
            self.neighbors, self.degrees, self.pose, source, distances, predecessors, self.queue, self.waiting
        )
        return distances, predecessors


def route(predecessors: np.ndarray, target: int) -> list[int]:
    """Return the places on the way to `target`, the source first."""
    places = [target]
    while predecessors[places[-1]] >= 0:
        places.append(int(predecessors[places[-1]]))
    return places[::-1]

"""The keyframes along the way, and the graph of the ways between them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from agents.component_config import ComponentConfig
from cyclic_env.jit import compiled

CAPACITY = 256
"""Keyframes that there is room for at first."""


@dataclass(frozen=True, slots=True, kw_only=True)
class KeyframeConfig(ComponentConfig):
    """The graph of keyframes."""

    neighbors: int = 16
    """Keyframes that one can be connected to at most; more would add no new ways."""
    detour: float = 14.0
    """By how much a way between two places may be longer than the straight line if no unclosed loop lies between them.

    A cycle is longer than 40 m, so across one that has not been closed yet, the way is longer.
    """
    connect_radius: float = 6.0
    """Distance within which keyframes in sight of each other are connected."""
    connections: int = 4
    """How many these are for a new keyframe, at most."""
    sight_margin: float = 0.3
    """Metres short of the scan's endpoints that such a keyframe must lie."""


class Graph(NamedTuple):
    """Neighbors of each keyframe `(n, k)`, how many these are `(n,)`, and the poses `(n, 3)`."""

    neighbors: np.ndarray
    degrees: np.ndarray
    poses: np.ndarray


class Paths(NamedTuple):
    """Shortest paths from one keyframe to all others."""

    distances: np.ndarray
    """`(n,)`, metres; inf where no path leads."""
    predecessors: np.ndarray
    """The keyframe before each on its path, `(n,)`; -1 at the source."""

    def route(self, target: int) -> list[int]:
        """Return the keyframes on the path to `target`, the source first."""
        keyframes = [target]
        while self.predecessors[keyframes[-1]] >= 0:
            keyframes.append(int(self.predecessors[keyframes[-1]]))
        return keyframes[::-1]


@compiled
def connect(neighbors, degrees, i, j):
    """Connect keyframes i and j, unless they are connected or one of them has no room for another neighbor."""
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
def shortest_paths(graph, source, paths, queue, waiting):
    """Write the shortest paths from a keyframe into `paths`; `queue` and `waiting` `(n,)` are scratch."""
    distances, predecessors = paths.distances, paths.predecessors
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
        for k in range(graph.degrees[i]):
            j = graph.neighbors[i, k]
            dx, dy = graph.poses[j, 0] - graph.poses[i, 0], graph.poses[j, 1] - graph.poses[i, 1]
            length = distances[i] + math.sqrt(dx * dx + dy * dy) + 1e-6
            if length < distances[j]:
                distances[j] = length
                predecessors[j] = i
                if not waiting[j]:
                    queue[(head + count) % n] = j
                    count += 1
                    waiting[j] = True


class KeyframeTable:
    """A table with a row for each keyframe, which grows as they are added, and the connections between them.

    Its attributes are the used rows of its columns.

    Parameters
    ----------
    columns : dict of (CAPACITY, ...) arrays
        By name, all zeros. They have a ``pose`` `(3,)` and a ``step``.
    neighbors : int
        Keyframes that one can be connected to at most.
    """

    pose: np.ndarray
    step: np.ndarray
    neighbors: np.ndarray
    degrees: np.ndarray
    queue: np.ndarray
    waiting: np.ndarray

    def __init__(self, columns: dict[str, np.ndarray], neighbors: int) -> None:
        self.count = 0
        whole: dict[str, tuple[int, ...]] = {"neighbors": (neighbors,), "degrees": (), "queue": ()}
        graph = {name: np.zeros((CAPACITY, *shape), np.int64) for name, shape in whole.items()}
        self._columns = columns | graph | {"waiting": np.zeros(CAPACITY, np.bool_)}
        self._show()

    def _show(self) -> None:
        """Let the attributes be the used parts of the columns."""
        for name, column in self._columns.items():
            setattr(self, name, column[: self.count])

    def add(self, **values: Any) -> int:
        """Add a keyframe with a value for each attribute, connected to the last one; return its number."""
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
        """Let a way lead straight from one keyframe to another."""
        connect(self.neighbors, self.degrees, i, j)

    def geodesic_distances(self, source: int) -> Paths:
        """Return the shortest paths from a keyframe to all others."""
        paths = Paths(np.empty(self.count), np.empty(self.count, np.int64))
        shortest_paths(Graph(self.neighbors, self.degrees, self.pose), source, paths, self.queue, self.waiting)
        return paths


class Keyframes(KeyframeTable):
    """The keyframes of an explorer.

    Parameters
    ----------
    beams : int
        Of the laser.
    sectors : int
        Length of a keyframe's feature vectors.
    config : KeyframeConfig, optional

    Attributes
    ----------
    pose : (n, 3) float64
        In the frame of the track, whose origin is where the robot began, with the axes of the compass.
    odometry : (n, 2) float64
        The position by dead reckoning alone.
    scan : (n, beams) float64
        All around; 0 where it was not looked.
    features : (n, 2, sectors) float64
        Looking ahead and looking back; see `sector_features`.
    direction, group, step : (n,) int64
    path : (n,) float64
        Metres driven since the reset.
    """

    odometry: np.ndarray
    scan: np.ndarray
    features: np.ndarray
    direction: np.ndarray
    group: np.ndarray
    path: np.ndarray

    def __init__(self, beams: int, sectors: int, config: KeyframeConfig | None = None) -> None:
        self.config = config or KeyframeConfig()
        shapes: dict[str, tuple[int, ...]] = {
            "pose": (3,),
            "odometry": (2,),
            "scan": (beams,),
            "features": (2, sectors),
            "path": (),
        }
        columns = {name: np.zeros((CAPACITY, *shape)) for name, shape in shapes.items()}
        columns |= {name: np.zeros(CAPACITY, np.int64) for name in ("direction", "group", "step")}
        super().__init__(columns, self.config.neighbors)

    def is_direct(self, geodesic_m: np.ndarray, euclidean_m: np.ndarray, slack: float = 0.0) -> np.ndarray:
        """Return where a way is so little longer than the straight line that no unclosed loop lies between its ends.

        Parameters
        ----------
        geodesic_m, euclidean_m : arrays
            Lengths of the ways and of the straight lines.
        slack : float
            Metres more that the way may be longer.
        """
        return geodesic_m <= euclidean_m + self.config.detour + slack


def revisit_candidates(
    path: np.ndarray, driven: float, euclidean_m: np.ndarray, gap: float, leave: float
) -> np.ndarray:
    """Return the keyframes that the robot can be back at by the definition of a revisit, wherever it is.

    Parameters
    ----------
    path : (n,)
        Metres driven at each keyframe.
    driven : float
        Metres driven by now.
    euclidean_m : (n,)
        Distance of each from the robot.
    gap, leave : float
        Metres that it must have driven since, and been away in between.
    """
    farthest_since = np.maximum.accumulate(euclidean_m[::-1])[::-1]
    return np.flatnonzero((driven - path >= gap) & (farthest_since >= leave))

"""A costmap of the whole building: where the robot has hardly been, and around which obstacles it has not driven."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from agents.component_config import ComponentConfig
from agents.exploration.costmap import Costmap, CostmapConfig
from agents.slam.keyframes import Keyframes

AROUND = np.ones((3, 3), np.bool_)
"""The neighbours of an obstacle's cell that belong to it: those across sides and corners."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BuildingMapConfig(ComponentConfig):
    """Settings of the map of the whole building; lengths in metres."""

    extent_max: float = 250.0
    """Greatest side of the map, since a corrupted track may lead anywhere."""
    margin: float = 2.0
    """Margin of the map around what the keyframes can see."""
    lap_min: float = 38.0
    """Least length of a lap that may count as a cycle: 40 m, less the error of the map."""
    claim_spacing: float = 2.0
    """Length of path after a claim within which another one is not judged."""


class BuildingMap:
    """Free space as all keyframes have seen it.

    Parameters
    ----------
    keyframes : Keyframes
    range_max : float
        Reach of the laser, metres.
    costmap : CostmapConfig
        The settings of the costmap; their number of cells is not used.
    config : BuildingMapConfig, optional
    """

    def __init__(
        self, keyframes: Keyframes, range_max: float, costmap: CostmapConfig, config: BuildingMapConfig | None = None
    ) -> None:
        self.config = config or BuildingMapConfig()
        positions = keyframes.pose[:, :2]
        low, high = positions.min(axis=0), positions.max(axis=0)
        center, extent = 0.5 * (low + high), float((high - low).max()) + 2 * (range_max + self.config.margin)
        if extent > self.config.extent_max:
            center, extent = positions[-1], self.config.extent_max
        self.costmap = Costmap(range_max, replace(costmap, cells=math.ceil(extent / costmap.cell)))
        legs = np.stack([positions[:-1], positions[1:]], axis=1)
        self.costmap.draw(center, keyframes.scan, keyframes.pose, legs)

    def hardly_seen(self, pose: np.ndarray, been: np.ndarray, spacing: float) -> np.ndarray | None:
        """Return the nearest position `(2,)` that the robot can drive to and has not been near; None if there is none.

        Parameters
        ----------
        pose : (3,)
        been : (n, 2)
            Positions where the robot has been.
        spacing : float
            Greatest cost of a path, in metres at the least cost, to a position that counts as near.
        """
        costmap = self.costmap
        costmap.find_paths(costmap.cells_at(been))
        far = costmap.costs_to_go >= spacing
        costmap.find_paths(costmap.cells_at(pose[None, :2]))
        costs = np.where(far & np.isfinite(costmap.cost), costmap.costs_to_go, np.inf)
        nearest = int(np.argmin(costs))
        return costmap.centers(np.array([nearest]))[0] if np.isfinite(costs.flat[nearest]) else None

    def open_laps(
        self, keyframes: Keyframes, claims: Sequence[tuple[int, int]], pose: np.ndarray
    ) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return the laps that no claimed loop goes around, nearest first, each with a point within it.

        Parameters
        ----------
        keyframes : Keyframes
        claims : sequence of (int, int)
            The claims: the step at which the robot was back, and the one at which it was there before.
        pose : (3,)

        Returns
        -------
        list of ((2,), (m, 2))
            A point in the obstacle, and the lap around it.
        """
        self.costmap.find_paths(self.costmap.cells_at(pose[None, :2]))
        reached = np.isfinite(self.costmap.costs_to_go) & np.isfinite(self.costmap.cost)
        costs = self.costmap.costs_to_go.copy()
        labels, count = ndimage.label(~reached, AROUND)
        outside = np.unique(np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]]))
        inside = np.setdiff1d(np.arange(1, count + 1), outside)
        boxes = ndimage.find_objects(labels)
        inside = [k for k in inside.tolist() if self._may_be_cycle(boxes[k - 1])]
        if not inside:
            return []
        depth = ndimage.distance_transform_edt(~reached)
        rows, columns = np.array(ndimage.maximum_position(depth, labels, inside)).T.astype(np.int64)
        anchors = self.costmap.centers(rows * labels.shape[1] + columns)
        windings = self._windings(keyframes, claims, anchors)
        rank = np.linalg.matrix_rank(windings) if len(windings) else 0
        laps = []
        for k in range(len(inside)):
            if len(windings) and np.linalg.matrix_rank(np.vstack([windings, np.eye(len(inside))[k]])) == rank:
                continue
            lap = self._lap(int(rows[k]), int(columns[k]), reached)
            if lap is not None:
                cells = self.costmap.cells_at(lap)
                laps.append((float(costs.flat[cells].min()), anchors[k], lap))
        return [(anchor, lap) for _, anchor, lap in sorted(laps, key=lambda found: found[0])]

    def _may_be_cycle(self, box: tuple[slice, slice]) -> bool:
        """Return whether an obstacle with that bounding box, in cells, may have a lap that is long enough."""
        height, width = (side.stop - side.start for side in box)
        return 2 * self.costmap.config.cell * (height + width) >= self.config.lap_min

    def _windings(self, keyframes: Keyframes, claims: Sequence[tuple[int, int]], anchors: np.ndarray) -> np.ndarray:
        """Return how often the loops `(m, anchors)` that claims have closed wind around the anchors."""
        x, y = keyframes.pose[:, 0], keyframes.pose[:, 1]
        crossings = np.zeros((keyframes.count, len(anchors)), np.int64)
        crossings[1:] = np.cumsum(_crossings(anchors, x[:-1], y[:-1], x[1:], y[1:]), axis=0)
        judged, windings = -math.inf, []
        for now, before in claims:
            # The first steps come before the first keyframe.
            t, k = (max(0, int(np.searchsorted(keyframes.step, step, "right")) - 1) for step in (now, before))
            if keyframes.path[t] - judged < self.config.claim_spacing:
                continue
            judged = keyframes.path[t]
            closing = _crossings(anchors, x[t : t + 1], y[t : t + 1], x[k : k + 1], y[k : k + 1])[0]
            windings.append(crossings[t] - crossings[k] + closing)
        return np.array(windings)

    def _lap(self, row: int, column: int, reached: np.ndarray) -> np.ndarray | None:
        """Return the cheapest closed path `(m, 2)` around the obstacle at a cell that crosses north of it once.

        None if it is too short to count, or there is none.
        """
        costmap = self.costmap
        three = reached[row:, column - 1] & reached[row:, column] & reached[row:, column + 1]
        if not three.any():
            return None
        first = int(np.argmax(three))
        run = first + np.append(np.flatnonzero(~three[first:]), len(three) - first)[0]
        crossing = row + first + int(np.argmin(costmap.cost[row + first : row + run, column]))
        cells = reached.shape[1]
        cut = costmap.cost[row:, column].copy()
        costmap.cost[row:, column] = np.inf
        costmap.find_paths(np.array([crossing * cells + column + 1]), escape=False)
        end = crossing * cells + column - 1
        lap = costmap.path_to(end) if np.isfinite(costmap.costs_to_go.flat[end]) else None
        costmap.cost[row:, column] = cut
        if lap is None or np.hypot(*np.diff(lap, axis=0).T).sum() < self.config.lap_min:
            return None
        return lap


def _crossings(anchors: np.ndarray, ax: np.ndarray, ay: np.ndarray, bx: np.ndarray, by: np.ndarray) -> np.ndarray:
    """Return for lines from a to b, each `(n,)`, how they cross the cuts due north of anchors `(c, 2)`, `(n, c)`.

    1 to the west, -1 to the east, else 0.
    """
    ax, ay, bx, by = (values[:, None] for values in (ax, ay, bx, by))
    across = (ax < anchors[:, 0]) != (bx < anchors[:, 0])
    share = np.divide(anchors[:, 0] - ax, bx - ax, out=np.zeros(across.shape), where=across)
    north = across & (ay + share * (by - ay) > anchors[:, 1])
    return np.where(north, np.where(bx < ax, 1, -1), 0)

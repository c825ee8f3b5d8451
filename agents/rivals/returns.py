"""Returns by dead reckoning: the places where the robot believes to be back, and the graph of the ways between them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from agents.component_config import ComponentConfig
from agents.rivals.occupancy import OccupancyGrid
from agents.slam.keyframes import CAPACITY, KeyframeTable, revisit_candidates
from agents.slam.se2 import euclidean_distances


@dataclass(frozen=True, slots=True, kw_only=True)
class ReturnConfig(ComponentConfig):
    """When the robot is back somewhere, by the definition of a revisit and a bit more; lengths in metres."""

    spacing: float = 0.5
    """Between two places that are remembered."""
    radius: float = 2.0
    """Distance between two places in sight of each other that are taken for one."""
    gap: float = 20.1
    leave: float = 10.1
    connections: int = 4
    """Places that a new one is connected to, at most, besides the last."""
    neighbors: int = 64
    """Places that one can be connected to, at most."""


class Places(KeyframeTable):
    """Where the robot has been, by dead reckoning, and the ways between.

    Parameters
    ----------
    config : ReturnConfig, optional

    Attributes
    ----------
    pose : (n, 3) float64
    path : (n,) float64
        Metres driven up to each.
    step : (n,) int64
    """

    path: np.ndarray

    def __init__(self, config: ReturnConfig | None = None) -> None:
        self.config = config or ReturnConfig()
        columns = {"pose": np.zeros((CAPACITY, 3)), "path": np.zeros(CAPACITY), "step": np.zeros(CAPACITY, np.int64)}
        super().__init__(columns, self.config.neighbors)

    def visit(self, pose: np.ndarray, path: float, step: int, grid: OccupancyGrid) -> bool:
        """Remember a place, if it is far enough from the last one; return whether it was.

        Parameters
        ----------
        pose : (3,)
        path : float
            Metres driven up to now.
        step : int
        grid : OccupancyGrid
            Tells which places are in sight of each other.
        """
        if self.count and math.hypot(*(pose[:2] - self.pose[-1, :2])) < self.config.spacing:
            return False
        last = self.add(pose=pose, path=path, step=step)
        if last:
            self.connect(last - 1, last)
        distances = euclidean_distances(self.pose, pose)
        near = np.flatnonzero(distances[:-1] < self.config.radius)
        for place in near[np.argsort(distances[near], kind="stable")][: self.config.connections].tolist():
            if grid.sees(self.pose[place, :2], pose[:2]):
                self.connect(place, last)
        return True

    def returned_step(self, grid: OccupancyGrid) -> int | None:
        """Return the step of the nearest place that the robot is back at, at the last one; None without one."""
        config = self.config
        distances = euclidean_distances(self.pose, self.pose[-1])
        back = revisit_candidates(self.path, self.path[-1], distances, config.gap, config.leave)
        back = back[distances[back] < config.radius]
        for place in back[np.argsort(distances[back], kind="stable")].tolist():
            if grid.sees(self.pose[place, :2], self.pose[-1, :2]):
                return int(self.step[place])
        return None

"""An agent that only watches: it claims the places that its robot is back at, and leaves the driving to others."""

from __future__ import annotations

import math

import numpy as np

from agents.actions import Decision, match_of
from agents.base import Agent, BatchPolicy
from agents.slam.mapper import Mapper, MapperConfig
from agents.slam.scan_filters import LaserReader
from cyclic_env.config import ActionType, LaserConfig


class LoopWatcher(Agent):
    """Maps what a robot senses and claims where it is back. It is made for robots' logs, which drive by themselves.

    Parameters
    ----------
    laser : LaserConfig
    config : MapperConfig, optional

    Attributes
    ----------
    mapper : Mapper
    claims : list of (int, int)
        Steps at which the robot was back, and at which step it was there before.
    """

    def __init__(self, laser: LaserConfig, config: MapperConfig | None = None) -> None:
        self.beams = laser.num_beams
        self.reader = LaserReader(laser)
        self.mapper = Mapper(self.reader.laser, config)
        self.claims: list[tuple[int, int]] = []

    def decide(self, scan: np.ndarray, distance: float, compass: np.ndarray) -> Decision:
        """Observe, and claim; the wheels stand still."""
        step = self.mapper.observe(self.reader.read(scan), distance, math.atan2(compass[1], compass[0]))
        if step is None:
            return Decision(0.0, 0.0)
        steps = self.mapper.step + 1
        self.claims.append((steps, step))
        return Decision(0.0, 0.0, claim=True, match=match_of(step, steps))


class WatcherPolicy(BatchPolicy):
    """The `predict` of watchers.

    Parameters
    ----------
    laser : LaserConfig
        The environment's, or the log's.
    config : MapperConfig, optional
    action_type : {"wheels", "twist", "discrete"}
    """

    def __init__(
        self, laser: LaserConfig, config: MapperConfig | None = None, *, action_type: ActionType = "wheels"
    ) -> None:
        super().__init__(action_type=action_type)
        self.laser, self.config = laser, config

    def new_agent(self, beams: int, row: int, previous: Agent | None = None) -> LoopWatcher:
        """Return a watcher that remembers nothing."""
        return LoopWatcher(self.laser, self.config)

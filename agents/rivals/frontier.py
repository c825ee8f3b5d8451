"""Frontier explorers: nearest frontier, explore_lite's weighting, and active loop closing.

They see what any agent sees: laser, distance meter and compass. They draw an occupancy grid by dead reckoning, and
claim to be back where dead reckoning says so.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from agents.actions import Decision, match_of
from agents.base import Agent, BatchPolicy
from agents.component_config import ComponentConfig
from agents.exploration.planner import PlannerConfig, look_ahead, steer_to
from agents.exploration.visibility import clear_lengths
from agents.rivals.occupancy import Frontier, OccupancyConfig, OccupancyGrid
from agents.rivals.returns import Places, ReturnConfig
from agents.slam.panorama import panorama_beams, spread_beams
from agents.slam.tracker import DeadReckoningTracker
from cyclic_env.config import ActionType, LaserConfig, RobotConfig


@dataclass(frozen=True, slots=True, kw_only=True)
class ChoiceConfig(ComponentConfig):
    """Which frontiers there are, which comes first, and when to give one up; lengths in metres, times in seconds."""

    least_length: float = 0.6
    """Of a frontier: the size of the robot (Yamauchi)."""
    map_spacing: float = 0.3
    map_period: float = 1.0
    """Way and time after which a scan is added to the grid."""
    look_again: float = 4.0
    """Time after which the goal is thought over, if it is a frontier for so long."""
    arrival: float = 0.6
    """Distance from a goal at which the robot is there; a frontier that is still one there is given up."""
    banned_radius: float = 0.6
    """Distance from a goal that was given up within which nothing is a frontier any more."""
    progress: float = 0.5
    patience: float = 12.0
    """Metres of way that are progress, and the time without any after which a goal is given up."""
    potential_scale: float = 3.0
    gain_scale: float = 1.0
    lite_cell: float = 0.05
    """Of explore_lite (J. Horner, "Map-merging for multi-robot system", 2016; the values of its launch file): cost of a
    metre of way, worth of a cell of frontier, and the usual size of a cell, for which these were chosen."""
    loop_gain: float = 20.0
    """Metres that a way just found must be shorter than the one that was driven, to be taken to close a loop
    (C. Stachniss, D. Haehnel and W. Burgard, "Exploration with active loop-closing for FastSLAM", IROS 2004)."""
    loop_reach: float = 2.0
    """Length of such a way, at most, in reaches of the laser: the views from both its ends meet in the middle. When no
    frontier is left, it may be of any length."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FrontierAgentConfig:
    """A frontier explorer.

    Parameters
    ----------
    order : {"nearest", "explore_lite"}
        Which frontier comes first.
    closes_loops : bool
        Before any frontier, drive ways just found to places that were reached by a far longer way.
    choice, grid, returns, planner
        The components' own settings.
    """

    order: Literal["nearest", "explore_lite"] = "nearest"
    closes_loops: bool = False
    choice: ChoiceConfig = field(default_factory=ChoiceConfig)
    grid: OccupancyConfig = field(default_factory=OccupancyConfig)
    returns: ReturnConfig = field(default_factory=ReturnConfig)
    planner: PlannerConfig = field(default_factory=PlannerConfig)


class FrontierExplorer(Agent):
    """Drives to frontiers of its own occupancy grid until there are none, and claims by dead reckoning.

    Parameters
    ----------
    config : FrontierAgentConfig
    laser : LaserConfig
    robot : RobotConfig
    """

    def __init__(self, config: FrontierAgentConfig, laser: LaserConfig, robot: RobotConfig) -> None:
        self.config, self.beams, self.dt = config, laser.num_beams, robot.dt
        self._sees_all_around = laser.sees_all_around
        self._panorama_beams, self._count = panorama_beams(laser)
        self.grid = OccupancyGrid(laser, config.grid)
        self.places = Places(config.returns)
        self.tracker = DeadReckoningTracker()
        self.steps = 0
        self.goal: np.ndarray | None = None
        self.closing = False
        self.done = False
        self._way = np.zeros((0, 2))
        self._clear = np.zeros(self._count)
        self._least_cost, self._stuck, self._since_choice = math.inf, 0, 10**9
        self._drawn_at, self._since_drawn = np.full(2, np.inf), 0

    @property
    def belief(self) -> np.ndarray:
        """Where it believes to be, from where it started: dead reckoning."""
        return self.tracker.pose

    def decide(self, scan: np.ndarray, distance: float, compass: np.ndarray) -> Decision:
        """Draw the grid, choose a frontier, drive on, and claim where dead reckoning is back."""
        self.tracker.advance(distance, compass)
        scan = self._smooth(np.clip(scan, 0.0, self.grid.range_max))
        self._draw(scan)
        new_place = self.places.visit(self.tracker.pose, self.tracker.path, self.steps, self.grid)
        if not self.done:
            self._review()
        speed, turn = self._steer(spread_beams(scan, self._panorama_beams, self._count))
        self.steps += 1
        step = self.places.returned_step(self.grid) if new_place else None
        if step is None:
            return Decision(speed, turn)
        return Decision(speed, turn, claim=True, match=match_of(step, self.steps))

    def _smooth(self, scan: np.ndarray) -> np.ndarray:
        """Return the median of every beam and its two neighbours, which drops a single wrong range."""
        before, after = np.roll(scan, 1), np.roll(scan, -1)
        if not self._sees_all_around:
            before[0], after[-1] = scan[0], scan[-1]
        return np.maximum(np.minimum(before, scan), np.minimum(np.maximum(before, scan), after))

    def _draw(self, scan: np.ndarray) -> None:
        choice, pose = self.config.choice, self.tracker.pose
        self._since_drawn += 1
        moved = math.hypot(*(pose[:2] - self._drawn_at))
        if not moved < choice.map_spacing or self._since_drawn * self.dt >= choice.map_period:
            self.grid.add(scan, pose)
            self._drawn_at, self._since_drawn = pose[:2].copy(), 0

    def _review(self) -> None:
        """Choose a goal anew after a while and at the goal; give one up that is not resolved there, or not reached."""
        choice, pose = self.config.choice, self.tracker.pose
        self._since_choice += 1
        self._stuck += 1
        arrived = self.goal is not None and math.hypot(*(self.goal - pose[:2])) < choice.arrival
        explored = self.goal is not None and not self.closing and not self.grid.is_frontier(self.goal)
        if not (arrived or explored) and self._since_choice * self.dt < choice.look_again:
            return
        if self.goal is not None and (arrived or self._stuck * self.dt > choice.patience):
            if not self.closing or not arrived:
                self.grid.ban(self.goal, choice.banned_radius)
            self.goal, self.closing = None, False
        self._choose()

    def _choose(self) -> None:
        choice, pose, grid = self.config.choice, self.tracker.pose, self.grid
        self._since_choice = 0
        grid.find_ways(pose)
        frontiers = grid.frontiers(math.ceil(choice.least_length / grid.config.cell))
        reach = choice.loop_reach * grid.range_max if frontiers else math.inf
        cell = self._loop_to_close(reach) if self.config.closes_loops else None
        self.closing = cell is not None
        if cell is None:
            if not frontiers:
                self.goal, self.done, self._way = None, True, np.zeros((0, 2))
                return
            cell = min(frontiers, key=self._cost).goal
        self._way = grid.way_to(cell)
        cost = float(grid.costs_to(self._way[-1:])[0])
        same = self.goal is not None and math.hypot(*(self._way[-1] - self.goal)) < choice.arrival
        if not same or cost < self._least_cost - choice.progress:
            self._least_cost, self._stuck = cost, 0
        self.goal = self._way[-1]

    def _cost(self, frontier: Frontier) -> float:
        """Return by how much a frontier comes later than others."""
        choice, size = self.config.choice, self.grid.config.cell
        if self.config.order == "nearest":
            return frontier.cost
        return choice.potential_scale * frontier.cost - choice.gain_scale * frontier.cells * size / choice.lite_cell

    def _loop_to_close(self, reach: float) -> int | None:
        """Return the cell of the nearest place to which a way has been found that closes a loop; None without one.

        The way may cost as much as `reach` metres in the middle of a corridor.
        """
        choice, places = self.config.choice, self.places
        found = self.grid.costs_to(places.pose[:, :2])
        gain = places.geodesic_distances(places.count - 1).distances - found
        closes = (found < reach) & (gain > choice.loop_gain)
        if not closes.any():
            return None
        return self.grid.cell_at(places.pose[int(np.argmin(np.where(closes, found, np.inf)))])

    def _steer(self, panorama: np.ndarray) -> tuple[float, float]:
        """Return speed and turning rate along the way, as shares of the full ones."""
        planner = self.config.planner
        if not len(self._way):
            return 0.0, 0.0
        pose = self.tracker.pose
        clear_lengths(panorama, planner.half_width, self._clear)
        reach = planner.lookahead, planner.target_clearance, planner.passed
        target, bearing, distance = look_ahead(self._way, pose, self._clear, *reach)
        self._way = self._way[target:]
        return steer_to(self._clear, bearing, distance, planner.avoidance, planner)


class FrontierPolicy(BatchPolicy):
    """A `FrontierExplorer` for each robot; these are the state that `predict` returns.

    Parameters
    ----------
    config : FrontierAgentConfig
    laser : LaserConfig
    robot : RobotConfig
    action_type : {"wheels", "twist", "discrete"}
    """

    def __init__(
        self, config: FrontierAgentConfig, laser: LaserConfig, robot: RobotConfig, *, action_type: ActionType = "wheels"
    ) -> None:
        super().__init__(action_type=action_type)
        self.config, self.laser, self.robot = config, laser, robot

    def new_agent(self, beams: int, row: int, previous: Any = None) -> FrontierExplorer:
        """Return an explorer that remembers nothing."""
        return FrontierExplorer(self.config, self.laser, self.robot)

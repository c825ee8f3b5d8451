"""The paper's explorer of one robot: KNN, direction indicators, groups and the list of open areas."""

from __future__ import annotations

import math

import numpy as np

from agents.actions import Decision, match_of
from agents.base import Agent
from agents.exploration.costmap import Costmap
from agents.exploration.frontiers import Frontiers
from agents.exploration.planner import Planner
from agents.exploration.survey import Survey
from agents.knn.config import ExplorerConfig
from agents.knn.loop_detector import Detection
from agents.knn.observer import LoopObserver
from agents.slam.se2 import euclidean_distances, wrap_angle


class KnnExplorer(LoopObserver, Agent):
    """Explores a building and claims the places that it is back at.

    When nothing is left open it stops, or with `ExplorerConfig.look_again` looks for what it has missed.

    Parameters
    ----------
    config : ExplorerConfig
    beams : int
        Of the laser.

    Attributes
    ----------
    frontiers : Frontiers
        With the paper's list of open areas.
    planner : Planner
    survey : Survey or None
        Where it looks again when nothing is left open.
    done : bool
        There is nothing left to explore; with a survey that may change.
    """

    def __init__(self, config: ExplorerConfig, beams: int) -> None:
        super().__init__(config, beams)
        around = self._unseen.size
        looks = None if self.reader.laser.sees_all_around else ~self._unseen
        self.frontiers = Frontiers(around, config.range_max, config.frontiers, config.visibility, looks)
        self.planner = Planner(around, config.dt, Costmap(config.range_max, config.costmap), config.planner)
        survey = Survey(around, config.range_max, config.survey, config.building, config.costmap)
        self.survey = survey if config.look_again else None
        self._goals: Frontiers | Survey = self.frontiers
        self.on_list = False
        self.done = False
        self._look_again = round(config.observer.look_again / config.dt)
        self._since_choice = 0
        self._left_to_look = 0.0 if self.reader.laser.sees_all_around else math.tau

    def decide(self, scan: np.ndarray, distance: float, compass: np.ndarray) -> Decision:
        """Observe, and drive on: the paper's Steps 1 to 6."""
        found = Detection()
        self.sense(scan, distance, compass)  # Steps 2 to 4: direction, indicator, group
        if self.ready and not self.stopped:
            self._review()
            if self._is_due():
                found = self.add_keyframe()  # Steps 1 and 5: a row, and the comparison with earlier tables
                self._update_list(found)  # Step 1: the list of open areas
            if self._left_to_look <= 0:
                self._go_on()  # Step 6: to an open area, or on
        self.steps += 1
        speed, turn = self.planner.steer(self.tracker.pose, self.scans[0])
        if self._left_to_look > 0:
            speed, turn = self._look_around()
        step = self.claim(found)
        if step is None:
            return Decision(speed, turn)
        return Decision(speed, turn, claim=True, match=match_of(step, self.steps))

    def _look_around(self) -> tuple[float, float]:
        """Return speed and turning rate at the beginning, until the laser has looked everywhere."""
        if self.steps > 1:
            self._left_to_look -= abs(wrap_angle(self.poses[0, 2] - self.poses[1, 2]))
        return 0.0, self.config.observer.look_speed

    @property
    def belief(self) -> np.ndarray:
        """Where it believes to be, from where it started: its track."""
        return self.tracker.pose

    @property
    def stopped(self) -> bool:
        """Whether there is nothing left to explore and it doesn't look again, so that it stands still from now on."""
        return self.done and self.survey is None

    @property
    def stop_reason(self) -> str | None:
        """Why it has stopped; None as long as it goes on."""
        if not self.stopped:
            return None
        return "only openings left that it doesn't go to" if len(self.frontiers) else "list empty"

    def _is_due(self) -> bool:
        """Whether it is time for a keyframe: after a while, at the goal, and where the laser looks elsewhere."""
        arrived = self.planner.has_arrived(self.tracker.pose) and self.moved > self.config.observer.arrival_spacing
        looks_elsewhere = not self.reader.laser.sees_all_around and self.turned > self.config.field_of_view / 3
        return arrived or self.moved >= self.config.row_spacing or looks_elsewhere

    def _review(self) -> None:
        """Give up a goal that can't be reached, and verify openings by the scans before and after their keyframe."""
        keyframes, planner = self.keyframes, self.planner
        if planner.goal is not None and planner.gives_up:
            self._goals.blacklist(keyframes, planner.goal)
            planner.clear_goal()
            self._since_choice = self._look_again
        if keyframes.count and self.steps - keyframes.step[-1] == self.config.observer.scans_kept // 2:
            self.frontiers.verify(keyframes, self.measured, self.poses)

    def _update_list(self, found: Detection) -> None:
        """Resolve the open areas that have been explored, and add those that the last keyframe sees."""
        if found.connects is not None:
            self.frontiers.recheck(self.keyframes)
        self.frontiers.update(self.keyframes, self.paths.distances)
        self._since_choice = self._look_again

    def _go_on(self) -> None:
        """Choose a goal, after each keyframe and every few seconds; without one on the list, the robot is done."""
        if self._since_choice >= self._look_again:
            self._since_choice = 0
            self._goals, order = self.frontiers, self._order()
            if self.survey is not None and not len(self.frontiers):
                self._goals, order = self._look_closer(self.survey), None
            pose, scan = self.tracker.pose, self.scans[0]
            self.planner.select_goal(pose, scan, self.keyframes, self._goals, self.paths, order)
            self.done = self._goals is not self.frontiers or self.planner.goal is None
        self._since_choice += 1

    def _look_closer(self, survey: Survey) -> Frontiers | Survey:
        """Return what the survey has to look at again, or the openings that are listed again as a new round begins."""
        if survey.update(self.keyframes, self.claims, self.tracker.pose):
            config = self.config.squeezed()
            self.planner.squeeze(config.planner, Costmap(config.range_max, config.costmap))
            self.frontiers.reopen(self.keyframes, config.visibility)
        return self.frontiers if len(self.frontiers) else survey

    def _order(self) -> np.ndarray | None:
        """Return which open points come first, `(m,)`, inf for those out of the question; None if all are equal."""
        config, frontiers, goal = self.config, self.frontiers, self.planner.goal
        if config.order == "nearest" and not config.unbounded_only and not config.go_on:
            return None
        points = frontiers.points(self.keyframes)
        if self.on_list:
            # On the way to an area of the list, until it is resolved.
            from_goal = np.zeros(0) if goal is None else euclidean_distances(points, goal)
            self.on_list = len(from_goal) > 0 and bool(from_goal.min() < config.planner.same_point)
            if self.on_list:
                return np.where(frontiers.area == frontiers.area[np.argmin(from_goal)], 0.0, np.inf)
        if config.go_on and not self.visited:
            pose = self.tracker.pose
            bearings = wrap_angle(np.arctan2(points[:, 1] - pose[1], points[:, 0] - pose[0]) - pose[2])
            ahead = np.abs(bearings) < config.observer.ahead
            ahead &= frontiers.keyframe >= self.keyframes.count - config.observer.in_sight_rows
            if ahead.any():
                return np.where(ahead, 0.0, np.inf)
        sign = {"nearest": 0, "first in first out": 1, "last in first out": -1}[config.order]
        order = sign * frontiers.area.astype(np.float64)
        if config.unbounded_only:
            order[~frontiers.unbounded] = np.inf
        self.on_list = bool(np.isfinite(order).any())
        return order

"""Privileged agents: an oracle that knows the plan, and the explorer with a perfect detector of loops.

They bound from above what any agent can reach, are marked in every table, and are never ranked.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

from agents.actions import Decision, match_of
from agents.base import Agent, BatchPolicy
from agents.knn.config import ExplorerConfig
from agents.knn.explorer import KnnExplorer
from agents.knn.loop_detector import Detection, LoopDetector
from agents.rivals.route import plan_route, turning_points
from agents.slam.keyframes import Keyframes
from agents.slam.registration import Registration
from agents.slam.se2 import relative, wrap_angle
from agents.slam.tracker import MappingTracker, PoseTracker
from cyclic_env.config import ActionType
from cyclic_env.evaluation.privileged import PrivilegedView

SURE_RADIUS = 2.5
"""Metres from a step within which it is claimed: the robot drives on a little before the claim is judged."""
PASSED, TURNED = 0.45, 0.2
"""Metres from a point of the route at which the robot makes for the next; and where the route turns back."""
TURN_GAIN = 1.5
TURN_ON_SPOT = 0.9
"""Share of the full turning rate for each radian off the route; and the angle from which it turns on the spot."""
TRUE_STD = np.array([0.01, 0.01, math.radians(0.1)])
"""What a pose graph takes the truth to err by, metres and radians."""


class PrivilegedPolicy(BatchPolicy):
    """A policy whose agents see the truth about the environment that they drive in.

    Parameters
    ----------
    env : CyclicLoopEnv or CyclicLoopVectorEnv
    action_type : {"wheels", "twist", "discrete"}

    Raises
    ------
    ConfigError
        If there is no environment.
    """

    privileged = True

    def __init__(self, env: Any, *, action_type: ActionType = "wheels") -> None:
        super().__init__(action_type=action_type)
        self.view = PrivilegedView(env)

    def attach(self, env: Any) -> None:
        """Drive in another environment from now on; the harness calls this before the first episode."""
        self.view = PrivilegedView(env)


class Oracle(Agent):
    """Knows the plan: drives the closed tour of its corridors with the detours that see all, and claims every return.

    Parameters
    ----------
    view : PrivilegedView
    row : int
    """

    def __init__(self, view: PrivilegedView, row: int) -> None:
        self.view, self.row = view, row
        self.route = plan_route(view, row)
        self._reach = np.where(turning_points(self.route), TURNED, PASSED)
        self.index = 0
        self._start = view.pose(row)[:2]

    def decide(self, scan: np.ndarray, distance: float, compass: np.ndarray) -> Decision:
        """Drive to the next point of the route; what the sensors say doesn't matter."""
        pose = self.view.pose(self.row)
        while math.hypot(*(self.route[self.index] - pose[:2])) < self._reach[self.index]:
            self.index = (self.index + 1) % len(self.route)
        dx, dy = self.route[self.index] - pose[:2]
        bearing = float(wrap_angle(math.atan2(dy, dx) - pose[2]))
        speed = max(0.0, math.cos(bearing)) ** 2 if abs(bearing) < TURN_ON_SPOT else 0.0
        turn = max(-1.0, min(1.0, TURN_GAIN * bearing))
        step = self.view.returned_step(self.row, SURE_RADIUS)
        if step is None:
            return Decision(speed, turn)
        return Decision(speed, turn, claim=True, match=match_of(step, self.view.steps(self.row) + 1))

    @property
    def belief(self) -> np.ndarray:
        """The true pose, from where the robot started."""
        x, y, heading = self.view.pose(self.row)
        return np.array([x - self._start[0], y - self._start[1], heading])


class OraclePolicy(PrivilegedPolicy):
    """An `Oracle` for each robot."""

    def new_agent(self, beams: int, row: int, previous: Any = None) -> Oracle:
        """Return an oracle that has planned its route."""
        return Oracle(self.view, row)


class PerfectDetector(LoopDetector):
    """Finds every return at a keyframe, and knows the true relation to where the robot was before.

    Parameters
    ----------
    config : ExplorerConfig
    tracker : MappingTracker
    view : PrivilegedView
    row : int
    """

    def __init__(self, config: ExplorerConfig, tracker: MappingTracker, view: PrivilegedView, row: int) -> None:
        super().__init__(config)
        self.tracker, self.view, self.row = tracker, view, row
        self._true_poses: list[np.ndarray] = []

    def detect(self, keyframes: Keyframes, tracker: PoseTracker, geodesic_m: np.ndarray) -> Detection:
        """Ask the truth for the nearest keyframe of those that the robot returns to."""
        pose = self.view.pose(self.row)
        self._true_poses.append(pose)
        step = self.view.returned_step(self.row, SURE_RADIUS)
        if step is None:
            return Detection()
        near = int(np.argmin(np.abs(keyframes.step[:-1] - step)))
        between = relative(self._true_poses[near], pose)
        if math.hypot(between[0], between[1]) > SURE_RADIUS:
            return Detection()
        connects = self.indirect(keyframes, near, geodesic_m)
        if connects is not None:
            certain = len(keyframes.scan[-1])
            loop = Registration(between, np.diag(TRUE_STD**-2), 1.0, 1.0, certain, float(certain))
            self.tracker.close_loop(keyframes, near, loop)
        return Detection(int(keyframes.step[near]), connects)


class PerfectExplorer(KnnExplorer):
    """The explorer with a perfect detector; it claims in every step in which it truly is back somewhere.

    Parameters
    ----------
    config : ExplorerConfig
    beams : int
    view : PrivilegedView
    row : int
    """

    def __init__(self, config: ExplorerConfig, beams: int, view: PrivilegedView, row: int) -> None:
        super().__init__(replace(config, detector="position"), beams)  # then the map closes no loops by itself
        assert isinstance(self.tracker, MappingTracker)
        self.detector = PerfectDetector(config, self.tracker, view, row)
        self.view, self.row = view, row

    def claim(self, found: Detection) -> int | None:
        """Return the step that the robot truly returns to, whatever was found."""
        step = self.view.returned_step(self.row, SURE_RADIUS)
        if step is not None:
            self.claims.append((self.steps, step))
        return step


class PerfectDetectorPolicy(PrivilegedPolicy):
    """A `PerfectExplorer` for each robot.

    Parameters
    ----------
    config : ExplorerConfig
    env, action_type
        As for `PrivilegedPolicy`.
    """

    def __init__(self, config: ExplorerConfig, env: Any, *, action_type: ActionType = "wheels") -> None:
        super().__init__(env, action_type=action_type)
        self.config = config

    def new_agent(self, beams: int, row: int, previous: Any = None) -> PerfectExplorer:
        """Return an explorer that remembers nothing."""
        return PerfectExplorer(self.config, beams, self.view, row)

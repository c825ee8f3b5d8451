"""Privileged agents: an oracle that knows the plan, and the explorer with a perfect loop detector.

They are upper bounds on what any agent can reach, are marked in every table, and are never ranked.
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

CLAIM_RADIUS = 2.5
"""Claim a revisit only within this many metres of the earlier position; kept tight because the robot moves on before
the judge looks."""

REACHED = 0.45
"""Metres from a point of the route within which the robot heads for the next one."""

REACHED_AT_TURN = 0.2
"""The same at the points where the route turns back."""

TURN_GAIN = 1.5
"""Turn command, as a share of the full turning rate, per radian between the heading and the route."""

TURN_IN_PLACE_ANGLE = 0.9
"""Radians off the route from which the robot turns on the spot; below, it drives as it turns."""

TRUE_STD = np.array([0.01, 0.01, math.radians(0.1)])
"""Standard deviations of a true relative pose in the pose graph: x and y in metres, heading in radians."""


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
    """Knows the plan: drives the closed tour with detours to all that is not seen from it, and claims every revisit.

    Parameters
    ----------
    view : PrivilegedView
    row : int
    """

    def __init__(self, view: PrivilegedView, row: int) -> None:
        self.view, self.row = view, row
        self.route = plan_route(view, row)
        self._reach = np.where(turning_points(self.route), REACHED_AT_TURN, REACHED)
        self.index = 0
        self._start = view.pose(row)[:2]

    def decide(self, scan: np.ndarray, distance: float, compass: np.ndarray) -> Decision:
        """Drive to the next point of the route; the sensor readings are ignored."""
        pose = self.view.pose(self.row)
        for _ in range(len(self.route)):  # ends even if the whole route lies within reach
            if math.hypot(*(self.route[self.index] - pose[:2])) >= self._reach[self.index]:
                break
            self.index = (self.index + 1) % len(self.route)
        dx, dy = self.route[self.index] - pose[:2]
        bearing = float(wrap_angle(math.atan2(dy, dx) - pose[2]))
        speed = math.cos(bearing) ** 2 if abs(bearing) < TURN_IN_PLACE_ANGLE else 0.0
        turn = max(-1.0, min(1.0, TURN_GAIN * bearing))
        step = self.view.returned_step(self.row, CLAIM_RADIUS)
        if step is None:
            return Decision(speed, turn)
        steps = self.view.steps(self.row) + 1  # with the step now being taken
        return Decision(speed, turn, claim=True, match=match_of(step, steps))

    @property
    def belief(self) -> np.ndarray:
        """The true pose, its position relative to the start."""
        x, y, heading = self.view.pose(self.row)
        return np.array([x - self._start[0], y - self._start[1], heading])


class OraclePolicy(PrivilegedPolicy):
    """An `Oracle` for each robot."""

    def new_agent(self, beams: int, row: int, previous: Any = None) -> Oracle:
        """Return an oracle that has planned its route."""
        return Oracle(self.view, row)


class PerfectDetector(LoopDetector):
    """Finds every revisit at a keyframe, and the true relative pose of the two positions.

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
        self._true_poses: list[np.ndarray] = []  # of the keyframes; `detect` runs exactly once for each

    def detect(self, keyframes: Keyframes, tracker: PoseTracker, geodesic_m: np.ndarray) -> Detection:
        """Find the keyframe recorded closest in time to the step that the robot truly revisits."""
        pose = self.view.pose(self.row)
        self._true_poses.append(pose)
        step = self.view.returned_step(self.row, CLAIM_RADIUS)
        if step is None:
            return Detection()
        earlier = int(np.argmin(np.abs(keyframes.step[:-1] - step)))  # the last keyframe is the present one
        true_offset = relative(self._true_poses[earlier], pose)
        if math.hypot(true_offset[0], true_offset[1]) > CLAIM_RADIUS:
            return Detection()
        connects = self.indirect(keyframes, earlier, geodesic_m)
        if connects is not None:
            num_beams = len(keyframes.scan[-1])
            loop = Registration(
                pose=true_offset,
                information=np.diag(TRUE_STD**-2),
                wide=1.0,
                tight=1.0,
                seen=num_beams,
                min_eigenvalue=float(num_beams),  # large enough to pass any threshold
            )
            self.tracker.close_loop(keyframes, earlier, loop)
        return Detection(int(keyframes.step[earlier]), connects)


class PerfectDetectorExplorer(KnnExplorer):
    """The explorer with a perfect detector; it claims at every step that truly is a revisit.

    Parameters
    ----------
    config : ExplorerConfig
    beams : int
    view : PrivilegedView
    row : int
    """

    def __init__(self, config: ExplorerConfig, beams: int, view: PrivilegedView, row: int) -> None:
        super().__init__(replace(config, detector="position"), beams)  # so that the map closes no loops by itself
        assert isinstance(self.tracker, MappingTracker)
        self.detector = PerfectDetector(config, self.tracker, view, row)
        self.view, self.row = view, row

    def claim(self, found: Detection) -> int | None:
        """Record and return the step truly revisited; `found` is ignored."""
        step = self.view.returned_step(self.row, CLAIM_RADIUS)
        if step is not None:
            self.claims.append((self.steps, step))
        return step


class PerfectDetectorPolicy(PrivilegedPolicy):
    """A `PerfectDetectorExplorer` for each robot.

    Parameters
    ----------
    config : ExplorerConfig
    env, action_type
        As for `PrivilegedPolicy`.
    """

    def __init__(self, config: ExplorerConfig, env: Any, *, action_type: ActionType = "wheels") -> None:
        super().__init__(env, action_type=action_type)
        self.config = config

    def new_agent(self, beams: int, row: int, previous: Any = None) -> PerfectDetectorExplorer:
        """Return a new explorer, which remembers nothing."""
        return PerfectDetectorExplorer(self.config, beams, self.view, row)

"""The paper's explorer: KNN, direction indicators, groups and the open areas' list."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from agents.actions import MATCH_START, drive_actions
from agents.exploration.frontiers import DETOUR, Frontiers
from agents.exploration.planner import Planner
from agents.exploration.visibility import inside
from agents.knn.config import ExplorerConfig, preset
from agents.knn.directions import Group, compass_direction, sector_features
from agents.knn.loop_detector import Detector
from agents.slam.keyframes import Keyframes
from agents.slam.scan_filters import confirm, despeckle, fill, reliable_endpoints
from agents.slam.scan_matching import fit_wall_lines
from agents.slam.se2 import compose, euclidean_distances, relative, wrap_all
from agents.slam.tracker import PoseTracker
from cyclic_env.config import ACTION_TYPES, DISTANCE_MAX, ActionType
from cyclic_env.errors import ConfigError
from cyclic_env.validation import as_array, check_choice, short_repr

FIRST_STEPS = 2
"""Steps of standing still at first: the scans that later ones are confirmed by."""
SCANS_KEPT = 5
"""Scans that are kept as they were measured, by which openings are verified when they stand in the middle."""
LOOK_AGAIN = 15
"""Steps after which the goal is thought over, if there was no new row: three seconds."""
ADVANCE_MAX, COMPASS_MIN = 2.0, 0.5
"""Metres that no robot drives in a step, and least length of a unit vector: else the sensors are out of order."""
DISTRUST = 100
"""Steps since they were, for which nothing is claimed."""
IN_SIGHT_ROWS = 3
"""Rows back to which an opening counts as being in sight."""
AHEAD = math.radians(120)
"""Off the heading, to which a corridor goes on."""
CONNECT_RADIUS, MAX_CONNECTIONS = 6.0, 4
"""Metres within which places in sight of each other are joined, and how many to each at most."""


class Memory:
    """What the explorer remembers of one robot's episode.

    Attributes
    ----------
    steps : int
        Decisions taken.
    groups : list of Group
        The paper's tables, in the order in which they were begun.
    indicators : list of int
        NI, EI, SI, WI.
    keyframes : Keyframes
        The rows of all tables.
    tracker : PoseTracker
    frontiers : Frontiers
    claims : list of (int, int)
        Steps at which the robot claimed to be back, and at which step it was there before.
    visited : bool
        Whether the last row's place was known.
    done : bool
        The list is empty: there is nothing left to explore.
    trusted_from : int
        Step from which sensors that were out of order are trusted again, so that claims are made.
    measured, scans, poses : (SCANS_KEPT, beams), the same and (SCANS_KEPT, 3)
        The latest first: scans as measured, without speckle, and where they were taken.
    """

    def __init__(self, config: ExplorerConfig, beams: int) -> None:
        self.steps = 0
        self.direction: int | None = None
        self.indicators = [0, 0, 0, 0]
        self.groups: list[Group] = []
        self.keyframes = Keyframes(beams, config.sectors)
        self.tracker = PoseTracker(config.range_max, config.match_scans)
        self.frontiers = Frontiers(beams, config.range_max)
        self.detector = Detector(config)
        self.planner = Planner(beams)
        self.claims: list[tuple[int, int]] = []
        self.visited = False
        self.on_list = False
        self.done = False
        self.trusted_from = 0
        self.measured = np.zeros((SCANS_KEPT, beams))
        self.scans = np.zeros((SCANS_KEPT, beams))
        self.poses = np.zeros((SCANS_KEPT, 3))
        self.geodesic_m = np.zeros(0)
        self.predecessors = np.zeros(0, np.int64)
        self.since_choice = 0


class KnnExplorer:
    """Explores a building, claims the places it is back at, and stops when nothing is left open.

    Parameters
    ----------
    config : ExplorerConfig, optional
        By default the preset ``extended``.
    action_type : {"wheels", "twist", "discrete"}
        That of the environment.
    """

    def __init__(self, config: ExplorerConfig | None = None, *, action_type: ActionType = "wheels") -> None:
        if config is not None and not isinstance(config, ExplorerConfig):
            raise ConfigError(f"the config is {short_repr(config)}; expected an ExplorerConfig, as preset() makes.")
        self.config = preset("extended") if config is None else config
        self.action_type: ActionType = check_choice("action type", action_type, ACTION_TYPES)

    def predict(
        self,
        observation: np.ndarray | Mapping[str, np.ndarray],
        state: Any = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = True,
    ) -> tuple[np.ndarray, tuple[Memory, ...]]:
        """Return actions, and what to remember.

        Parameters
        ----------
        observation : dict of arrays
            ``laser`` `(N, beams)`, metres, a whole turn to the left from straight ahead; ``distance`` `(N, 1)`, metres
            driven; ``compass`` `(N, 2)`, the heading's parts east and north. Or of one robot, without the N. A range
            beyond the config's `range_max`, or that is no number, is one that met nothing.
        state : tuple of Memory, optional
            As returned by the last call, which it continues: both are the same objects; None at the first.
        episode_start : (N,) bool, optional
            Robots whose episode has just begun.
        deterministic : bool
            Makes no difference.

        Returns
        -------
        actions : (N, 4) float32, or (N, 2) int64 if discrete; without the N for one robot
        state : tuple of Memory

        Raises
        ------
        ConfigError
            If the observation is none, or the state or `episode_start` is of other robots.
        """
        laser, distance, compass = self._readings(observation)
        single = laser.ndim == 1
        laser, distance, compass = np.atleast_2d(laser), np.atleast_1d(distance), np.atleast_2d(compass)
        memories = [None] * len(laser) if state is None else state
        if not isinstance(memories, list | tuple) or not all(isinstance(one, Memory | None) for one in memories):
            raise ConfigError(f"the state is {short_repr(state)}; expected what the last predict returned, or None.")
        if len(memories) != len(laser):
            raise ConfigError(f"the state is of {len(memories)} robots, the observation of {len(laser)}.")
        if episode_start is not None:
            begun = np.asarray(episode_start, np.bool_).ravel()
            if len(begun) != len(laser):
                raise ConfigError(f"episode_start is of {len(begun)} robots, the observation of {len(laser)}.")
            memories = [None if new else memory for new, memory in zip(begun, memories, strict=True)]
        for memory in memories:
            if memory is not None and memory.scans.shape[1] != laser.shape[1]:
                raise ConfigError(
                    f"the state is of a laser with {memory.scans.shape[1]} beams, the observation of {laser.shape[1]}."
                )
        kept = tuple(Memory(self.config, laser.shape[1]) if memory is None else memory for memory in memories)
        decisions = np.array(
            [self._decide(memory, laser[row], distance[row], compass[row]) for row, memory in enumerate(kept)]
        )
        actions = drive_actions(decisions[:, :2], self.action_type, decisions[:, 2], decisions[:, 3])
        return (actions[0] if single else actions), kept

    def _readings(self, observation: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return laser `(..., beams)`, distance `(...)` and compass `(..., 2)`, checked, in double precision."""
        expected = "a dict with the arrays laser (N, beams), distance (N, 1) and compass (N, 2)"
        if not isinstance(observation, Mapping):
            raise ConfigError(f"the observation is {short_repr(observation)}; expected {expected}.")
        arrays = []
        for name in ("laser", "distance", "compass"):
            if name not in observation:
                raise ConfigError(f"the observation has no {name}; expected {expected}.")
            arrays.append(as_array(observation[name], f"the observation's {name}", expected, ConfigError))
        laser, distance, compass = (array.astype(np.float64) for array in arrays)
        robots = laser.shape[:-1]
        if laser.ndim not in (1, 2) or distance.shape != (*robots, 1) or compass.shape != (*robots, 2):
            shapes = ", ".join(str(array.shape) for array in arrays)
            raise ConfigError(f"the observation's arrays have the shapes {shapes}; expected {expected}.")
        beams, needed = laser.shape[-1], 2 * (self.config.sectors - 1)
        if beams < needed:
            raise ConfigError(f"the laser has {beams} beams; {self.config.sectors} sectors need {needed}: set fewer.")
        if not (np.abs(distance) <= DISTANCE_MAX).all():
            raise ConfigError(
                f"the observation's distance is {short_repr(distance)}; expected at most {DISTANCE_MAX:g} m."
            )
        if not np.isfinite(compass).all():
            raise ConfigError("the observation's compass is not finite; expected the heading's parts east and north.")
        return np.fmax(np.fmin(laser, self.config.range_max), 0.0), distance[..., 0], compass  # of a NaN, the other

    def _decide(
        self, memory: Memory, laser: np.ndarray, distance: float, compass: np.ndarray
    ) -> tuple[float, float, float, float]:
        """Take one robot's decision, the paper's Steps 1 to 6: speed, turning rate, claim and match."""
        keyframes, tracker, planner = memory.keyframes, memory.tracker, memory.planner
        self._sense(memory, laser, distance, compass)
        # Steps 2 to 4: a change of direction raises the new direction's indicator, and begins a group.
        direction = compass_direction(tracker.compass, memory.direction)
        if direction != memory.direction:
            memory.direction = direction
            memory.indicators[direction] += 1
            memory.groups.append(Group(direction, memory.indicators[direction]))
        match = None
        if memory.steps >= FIRST_STEPS and not memory.done:
            moved = math.inf if not keyframes.count else math.hypot(*(tracker.pose[:2] - keyframes.pose[-1, :2]))
            if planner.goal is not None and planner.gives_up:
                memory.frontiers.blacklist(keyframes, planner.goal)
                planner.clear_goal()
                memory.since_choice = LOOK_AGAIN
            if keyframes.count and memory.steps - keyframes.step[-1] == SCANS_KEPT // 2:
                memory.frontiers.verify(keyframes, memory.measured, memory.poses)
            if moved >= self.config.row_spacing or (planner.has_arrived(tracker.pose) and moved > 0.1):
                # Step 1: add a row to the group's table, and openings to the open areas' list.
                before_matching = tracker.pose.copy()
                self._add_row(memory)
                # Step 5: compare with the tables of before.
                match = self._compare(memory)
                memory.poses = compose(tracker.pose, relative(before_matching, memory.poses))
                memory.frontiers.update(keyframes, memory.geodesic_m)
                memory.since_choice = LOOK_AGAIN
            # Step 6: go to an open area, or on.
            if memory.since_choice >= LOOK_AGAIN:
                self._select_goal(memory)
            memory.since_choice += 1
        memory.steps += 1
        speed, turn = planner.steer_along(tracker.pose, memory.scans[0])
        if match is None or memory.steps < memory.trusted_from:
            return speed, turn, -1.0, MATCH_START
        memory.claims.append((memory.steps, match))
        return speed, turn, 1.0, 2 * match / memory.steps - 1

    def _sense(self, memory: Memory, laser: np.ndarray, distance: float, compass: np.ndarray) -> None:
        driven = memory.tracker.path
        memory.tracker.advance(distance, compass)
        if memory.tracker.path - driven > ADVANCE_MAX or math.hypot(*compass) < COMPASS_MIN:
            memory.trusted_from = memory.steps + DISTRUST
        for kept, new in ((memory.measured, laser), (memory.scans, laser), (memory.poses, memory.tracker.pose)):
            kept[1:] = kept[:-1]
            kept[0] = new
        despeckle(laser, memory.scans[0])

    def _add_row(self, memory: Memory) -> None:
        keyframes, tracker = memory.keyframes, memory.tracker
        scan, confirmed = memory.scans[0].copy(), np.zeros(len(memory.scans[0]), np.bool_)
        for earlier in range(1, FIRST_STEPS + 1):
            confirm(memory.scans[0], tracker.pose, memory.scans[earlier], memory.poses[earlier], confirmed)
        fill(memory.scans[0], confirmed, scan)
        memory.scans[0] = scan
        endpoints = reliable_endpoints(scan, memory.measured[0], self.config.range_max)
        tracker.localize(keyframes, scan, endpoints, memory.geodesic_m)
        lines = np.empty((len(scan), 3))
        fit_wall_lines(endpoints, self.config.range_max, lines)
        row = keyframes.add(
            pose=tracker.pose,
            odometry=tracker.odometry,
            scan=scan,
            endpoints=endpoints,
            lines=lines,
            features=sector_features(scan, self.config.sectors, self.config.rounding),
            compass=tracker.compass,
            direction=memory.direction,
            group=len(memory.groups) - 1,
            step=memory.steps,
            path=tracker.path,
        )
        memory.groups[-1].rows.append(row)
        memory.geodesic_m, memory.predecessors = keyframes.geodesic_distances(row)

    def _compare(self, memory: Memory) -> int | None:
        """Return the step at which the robot was here before, if it was; join what belongs together."""
        keyframes, tracker = memory.keyframes, memory.tracker
        last = keyframes.count - 1
        found = memory.detector.detect(keyframes, tracker, memory.geodesic_m)
        if found.connects is not None:
            keyframes.connect(found.connects, last)
        if found.loop is not None:
            tracker.add_loop_closure(keyframes, found.loop)
            found.visited = memory.detector.at_loop(keyframes, tracker)
        tracker.relax(keyframes)
        if found.connects is not None:
            memory.geodesic_m, _ = keyframes.geodesic_distances(last)
        self._connect_neighbors(memory, last)
        memory.geodesic_m, memory.predecessors = keyframes.geodesic_distances(last)
        if found.connects is not None:
            memory.frontiers.recheck(keyframes)
        memory.visited = found.visited is not None
        return None if found.visited is None else int(keyframes.step[found.visited])

    def _connect_neighbors(self, memory: Memory, last: int) -> None:
        """Let ways lead to the nearest places in sight."""
        keyframes = memory.keyframes
        euclidean_m = euclidean_distances(keyframes.pose, keyframes.pose[last])
        near = np.flatnonzero((euclidean_m < CONNECT_RADIUS) & (memory.geodesic_m <= euclidean_m + DETOUR))
        near = near[near < last - 1]
        near = near[np.argsort(euclidean_m[near], kind="stable")][:MAX_CONNECTIONS]
        seen = np.empty(len(near), np.bool_)
        inside(keyframes.scan[last], *keyframes.pose[last], keyframes.pose[near, :2], 0.3, seen)
        for keyframe in near[seen].tolist():
            keyframes.connect(keyframe, last)

    def _select_goal(self, memory: Memory) -> None:
        memory.since_choice = 0
        planner = memory.planner
        planner.select_goal(
            memory.tracker.pose,
            memory.scans[0],
            memory.keyframes,
            memory.frontiers,
            memory.geodesic_m,
            memory.predecessors,
            self._order(memory),
        )
        memory.done = planner.goal is None

    def _order(self, memory: Memory) -> np.ndarray | None:
        """Return which open points come first, `(m,)`, inf for those out of question; None if all are alike."""
        config, frontiers, goal = self.config, memory.frontiers, memory.planner.goal
        if config.order == "nearest" and not config.unbounded_only and not config.go_on:
            return None
        points = frontiers.points(memory.keyframes)
        if memory.on_list:
            # On the way to an area of the list, until it is struck off.
            memory.on_list = (
                goal is not None and len(points) > 0 and bool(euclidean_distances(points, goal).min() < 0.3)
            )
            if memory.on_list and goal is not None:
                return np.where(
                    frontiers.area == frontiers.area[np.argmin(euclidean_distances(points, goal))], 0.0, np.inf
                )
        if config.go_on and not memory.visited:
            pose = memory.tracker.pose
            bearings = wrap_all(np.arctan2(points[:, 1] - pose[1], points[:, 0] - pose[0]) - pose[2])
            ahead = (frontiers.keyframe >= memory.keyframes.count - IN_SIGHT_ROWS) & (np.abs(bearings) < AHEAD)
            if ahead.any():
                return np.where(ahead, 0.0, np.inf)
        sign = {"nearest": 0, "first in first out": 1, "last in first out": -1}[config.order]
        order = sign * frontiers.area.astype(np.float64)
        if config.unbounded_only:
            order[~frontiers.unbounded] = np.inf
        memory.on_list = bool(np.isfinite(order).any())
        return order

"""The survey: where to look again when no opening is left but the episode goes on, so that something was missed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from agents.component_config import ComponentConfig
from agents.exploration.building_map import BuildingMap, BuildingMapConfig
from agents.exploration.costmap import CostmapConfig
from agents.exploration.visibility import FIRM, inside
from agents.slam.keyframes import Keyframes
from agents.slam.se2 import euclidean_distances


@dataclass(frozen=True, slots=True, kw_only=True)
class SurveyConfig(ComponentConfig):
    """Settings of where to look again; lengths in metres."""

    spacing: float = 4.0
    """A place is visited in the first round if its path from every keyframe costs at least these metres."""
    spacing_again: float = 2.0
    """The same in later rounds."""
    squeeze: float = 0.06
    """Distance by which the robot drives closer to walls after the first round, so that no margin is left."""
    waypoint_spacing: float = 3.0
    """Distance between the points of a lap that the robot drives along."""
    arrival: float = 1.2
    """Distance from a point at which the robot counts as having been there."""
    same_lap: float = 3.0
    """Distance within which points in obstacles, before and after a correction of the track, belong to one obstacle."""


class Survey:
    """Places to go to when no opening is left, one at a time, in rounds.

    The first round visits the free space that the robot has only seen from afar, and then drives the laps around
    obstacles that no claimed loop goes around. The second round looks more closely. Later rounds forget where the robot
    has been before.

    Parameters
    ----------
    beams : int
    range_max : float
    config : SurveyConfig
    building : BuildingMapConfig
    costmap : CostmapConfig

    Attributes
    ----------
    polar : (m, 3) float64
        Range, beam and kind of the point to go to from its keyframe, as those of `Frontiers`; m is 1, or 0 without one.
    keyframe : (m,) int64
    round : int
        -1 before the first `update`.
    costmap : CostmapConfig
        The settings with which the map of the whole building is drawn.
    """

    def __init__(
        self, beams: int, range_max: float, config: SurveyConfig, building: BuildingMapConfig, costmap: CostmapConfig
    ) -> None:
        self.beams, self.range_max = beams, range_max
        self.config, self.building, self.costmap = config, building, costmap
        self.polar = np.zeros((0, 3))
        self.keyframe = np.zeros(0, np.int64)
        self.round = -1
        self._waypoints: list[tuple[int, np.ndarray]] = []  # of the lap that is being driven: keyframes, range and beam
        self._since = 0  # keyframe from which on the robot remembers where it has been
        self._given_up = np.zeros((0, 2))
        self._driven = np.zeros((0, 2))  # points within the laps of this round

    def __len__(self) -> int:
        return len(self.keyframe)

    def points(self, keyframes: Keyframes) -> np.ndarray:
        """Return the points `(m, 2)` in the frame of the track."""
        bearings = keyframes.pose[self.keyframe, 2] + self.polar[:, 1] * (math.tau / self.beams)
        offsets = self.polar[:, :1] * np.column_stack([np.cos(bearings), np.sin(bearings)])
        return keyframes.pose[self.keyframe, :2] + offsets

    def update(self, keyframes: Keyframes, claims: Sequence[tuple[int, int]], pose: np.ndarray) -> bool:
        """Choose a place to go to, if there is none or the robot has arrived; return whether a new round begins.

        Parameters
        ----------
        keyframes : Keyframes
        claims : sequence of (int, int)
            The claims: the step at which the robot was back, and the one at which it was there before.
        pose : (3,)
        """
        if self.round >= 0:
            if len(self) and euclidean_distances(self.points(keyframes), pose)[0] > self.config.arrival:
                return False
            self._set(*self._waypoints.pop(0)) if self._waypoints else self._choose(keyframes, claims, pose)
            if len(self):
                return False
        self.round += 1
        self._driven = np.zeros((0, 2))
        if self.round > 1:
            self._since, self._given_up = keyframes.count - 1, np.zeros((0, 2))
        return True

    def blacklist(self, keyframes: Keyframes, point: np.ndarray) -> None:
        """Give up a point `(2,)` that can't be reached, and the lap that it is on, for this round."""
        self._given_up = np.vstack([self._given_up, point])
        self._waypoints = []
        self._clear()

    def _choose(self, keyframes: Keyframes, claims: Sequence[tuple[int, int]], pose: np.ndarray) -> None:
        """Choose the nearest place that the robot has not been near or, if there is none, a lap."""
        self._clear()
        building = BuildingMap(keyframes, self.range_max, self.costmap, self.building)
        been = np.vstack([keyframes.pose[self._since :, :2], self._given_up])
        spacing = self.config.spacing if self.round == 0 else self.config.spacing_again
        point = building.hardly_seen(pose, been, spacing)
        if point is not None:
            self._set(*_seen_from(keyframes, point, self.beams))
            return
        for anchor, lap in building.open_laps(keyframes, claims, pose):
            if (euclidean_distances(self._driven, anchor) >= self.config.same_lap).all():
                self._driven = np.vstack([self._driven, anchor])
                points = _waypoints(lap, pose, self.config.waypoint_spacing)
                self._waypoints = [_seen_from(keyframes, point, self.beams) for point in points]
                self._set(*self._waypoints.pop(0))
                return

    def _set(self, keyframe: int, polar: np.ndarray) -> None:
        self.keyframe, self.polar = np.array([keyframe]), np.append(polar, FIRM)[None]

    def _clear(self) -> None:
        self.keyframe, self.polar = self.keyframe[:0], self.polar[:0]


def _waypoints(lap: np.ndarray, pose: np.ndarray, spacing: float) -> np.ndarray:
    """Return points along a lap `(m, 2)` that begin nearest to the robot and end a little beyond a full lap."""
    lap = np.roll(lap, -int(np.argmin(euclidean_distances(lap, pose))), axis=0)
    lap = np.vstack([lap, lap])
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(lap, axis=0).T))])
    wanted = np.arange(0.0, along[len(along) // 2] + 2.5 * spacing, spacing)
    return lap[np.searchsorted(along, wanted)]


def _seen_from(keyframes: Keyframes, point: np.ndarray, beams: int) -> tuple[int, np.ndarray]:
    """Return the nearest keyframe that sees a point `(2,)`, else the nearest, and the point's range and beam there."""
    euclidean_m = euclidean_distances(keyframes.pose, point)
    nearest = np.argsort(euclidean_m)
    seen = np.empty(1, np.bool_)
    for keyframe in nearest[:50].tolist():
        inside(keyframes.scan[keyframe], keyframes.pose[keyframe], point[None], 0.0, seen)
        if seen[0]:
            break
    else:
        keyframe = int(nearest[0])
    x, y = point - keyframes.pose[keyframe, :2]
    bearing = math.atan2(y, x) - keyframes.pose[keyframe, 2]
    return keyframe, np.array([math.hypot(x, y), bearing / (math.tau / beams)])

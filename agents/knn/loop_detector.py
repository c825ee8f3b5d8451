"""Step 5 of the paper: whether the robot is back at a place where it has been, and at which keyframe."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np

from agents.knn.config import DetectorConfig, ExplorerConfig
from agents.knn.similarity import measure_by_name
from agents.slam.keyframes import Keyframes, revisit_candidates
from agents.slam.se2 import euclidean_distances
from agents.slam.tracker import DeadReckoningTracker, MappingTracker, PoseTracker
from cyclic_env.config import LaserConfig


@dataclass(slots=True)
class Detection:
    """What was found at the last keyframe."""

    step: int | None = None
    """The step at which the robot was at the place that it is back at."""
    connects: int | None = None
    """The keyframe that the last one is to be connected to, if there was no direct way to it up to now."""


class Vote:
    """K nearest neighbours in appearance, and the groups that they belong to.

    Parameters
    ----------
    config : ExplorerConfig
        Its `measure` and `neighbours`.

    Attributes
    ----------
    compared : int
        Comparisons of two keyframes so far.
    """

    def __init__(self, config: ExplorerConfig) -> None:
        self.measure = measure_by_name(config.measure)
        self.neighbours = config.neighbours
        self.compared = 0

    def nearest(self, keyframes: Keyframes, candidates: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the candidates that look most like the last keyframe, those of the group with most votes first.

        Only candidates of the last keyframe's direction are compared.

        Parameters
        ----------
        keyframes : Keyframes
        candidates : (c,)
            Keyframes.

        Returns
        -------
        rows, similarities : (k,)
            At most `neighbours`.
        """
        rows = candidates[keyframes.direction[candidates] == keyframes.direction[-1]]
        self.compared += len(rows)
        if not len(rows):
            return rows, np.zeros(0)
        query = self.measure.prepare(keyframes.features[-1, 0])
        distances = self.measure.compare(self.measure.prepare(keyframes.features[rows, 0]), query)
        nearest = np.argsort(distances, kind="stable")[: self.neighbours]
        groups = keyframes.group[rows[nearest]]
        votes = {group: int((groups == group).sum()) for group in groups.tolist()}
        # Ties go to the group with the nearest keyframe, which comes first.
        order = sorted(range(len(nearest)), key=lambda i: (-votes[int(groups[i])], i))
        nearest = nearest[order]
        return rows[nearest], self.measure.similarity(distances[nearest])


class LoopDetector(ABC):
    """Looks for the last keyframe's place among those of the earlier ones.

    Parameters
    ----------
    config : ExplorerConfig
    """

    def __init__(self, config: ExplorerConfig) -> None:
        self.config: DetectorConfig = config.loops
        self.joins = config.join

    @property
    def compared(self) -> int:
        """Comparisons of the last keyframe with another so far."""
        return 0

    @abstractmethod
    def detect(self, keyframes: Keyframes, tracker: PoseTracker, geodesic_m: np.ndarray) -> Detection:
        """Ask whether the robot is back at a place where it has been.

        Parameters
        ----------
        keyframes : Keyframes
        tracker : PoseTracker
        geodesic_m : (n,)
            Lengths of the ways from the last keyframe.
        """

    def _back_at(self, keyframes: Keyframes, keyframe: int, geodesic_m: np.ndarray) -> Detection:
        """Return that the robot is back at a keyframe, to be connected to it unless the way there is direct."""
        return Detection(int(keyframes.step[keyframe]), self.indirect(keyframes, keyframe, geodesic_m))

    def indirect(
        self, keyframes: Keyframes, keyframe: int, geodesic_m: np.ndarray, otherwise: int | None = None
    ) -> int | None:
        """Return a keyframe at which the robot is, if the way there is not direct and it is to be joined."""
        euclidean_m = euclidean_distances(keyframes.pose[keyframe : keyframe + 1], keyframes.pose[-1])[0]
        direct = keyframes.is_direct(geodesic_m[keyframe], euclidean_m)
        return keyframe if self.joins and not direct else otherwise

    def _left_before(self, keyframes: Keyframes, euclidean_m: np.ndarray) -> np.ndarray:
        return revisit_candidates(keyframes.path, keyframes.path[-1], euclidean_m, self.config.gap, self.config.leave)


class PositionDetector(LoopDetector):
    """Position alone: the nearest keyframe by dead reckoning, without the laser."""

    def detect(self, keyframes: Keyframes, tracker: PoseTracker, geodesic_m: np.ndarray) -> Detection:
        """Ask dead reckoning."""
        euclidean_m = euclidean_distances(keyframes.odometry, keyframes.odometry[-1])
        back = self._left_before(keyframes, euclidean_m)
        if not len(back) or euclidean_m[back].min() > self.config.position_radius:
            return Detection()
        keyframe = int(back[np.argmin(euclidean_m[back])])
        return self._back_at(keyframes, keyframe, geodesic_m)


class AppearanceDetector(LoopDetector):
    """Appearance alone: the vote among earlier tables of the same direction, and a threshold of similarity."""

    def __init__(self, config: ExplorerConfig) -> None:
        super().__init__(config)
        self.least_similarity = config.least_similarity
        self.vote = Vote(config)

    @property
    def compared(self) -> int:
        """Those of the vote."""
        return self.vote.compared

    def detect(self, keyframes: Keyframes, tracker: PoseTracker, geodesic_m: np.ndarray) -> Detection:
        """Ask the vote."""
        rows, similarities = self.vote.nearest(keyframes, self.candidates(keyframes))
        if not len(rows) or similarities[0] <= self.least_similarity:
            return Detection()
        keyframe = int(rows[0])
        return self._back_at(keyframes, keyframe, geodesic_m)

    def candidates(self, keyframes: Keyframes) -> np.ndarray:
        """Return the keyframes that the last one is compared with: those of the earlier tables."""
        return np.flatnonzero(keyframes.group != keyframes.group[-1])


class CombinedDetector(AppearanceDetector):
    """Position and appearance: the vote and the threshold, among keyframes near by dead reckoning that were left."""

    def candidates(self, keyframes: Keyframes) -> np.ndarray:
        """Return the keyframes of earlier tables that the robot may be back at, by dead reckoning."""
        euclidean_m = euclidean_distances(keyframes.odometry, keyframes.odometry[-1])
        back = self._left_before(keyframes, euclidean_m)
        back = back[euclidean_m[back] <= self.config.position_radius]
        return back[keyframes.group[back] != keyframes.group[-1]]


class MappedDetector(LoopDetector):
    """The map's loops: sets of matches that bear each other out, and the corrected track on known ground."""

    def __init__(self, config: ExplorerConfig, tracker: MappingTracker) -> None:
        super().__init__(config)
        self.tracker = tracker
        self._closed = 0

    @property
    def compared(self) -> int:
        """Those of signatures."""
        return self.tracker.mapper.loops.compared

    def detect(self, keyframes: Keyframes, tracker: PoseTracker, geodesic_m: np.ndarray) -> Detection:
        """Ask the map, and connect what its latest loops have joined."""
        mapper, tracker = self.tracker.mapper, self.tracker
        found = Detection()
        for _, earlier in mapper.loops.closed[self._closed :]:
            found.connects = tracker.row_at(earlier)
        self._closed = len(mapper.loops.closed)
        back = mapper.back_at()
        if back is not None:
            found.step = int(mapper.run.step[back])
            found.connects = self.indirect(keyframes, tracker.row_at(back), geodesic_m, found.connects)
        return found


def make_tracker(config: ExplorerConfig, laser: LaserConfig) -> PoseTracker:
    """Return the tracker that the settings name."""
    return MappingTracker(laser, config.mapper_settings) if config.match_scans else DeadReckoningTracker()


def make_detector(config: ExplorerConfig, tracker: PoseTracker) -> LoopDetector:
    """Return the detector that the settings name."""
    if config.detector == "position":
        return PositionDetector(config)
    if isinstance(tracker, MappingTracker):
        return MappedDetector(config, tracker)
    return (CombinedDetector if config.detector == "both" else AppearanceDetector)(config)

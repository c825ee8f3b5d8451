"""Step 5 of the paper: whether the robot is back at a place where it has been, and at which keyframe."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np

from agents.exploration.visibility import clear_lengths
from agents.knn.config import DetectorConfig, ExplorerConfig
from agents.knn.directions import opposite
from agents.knn.similarity import measure_by_name
from agents.slam.keyframes import Keyframes
from agents.slam.scan_matching import Match, ScanMatcher
from agents.slam.se2 import compose, euclidean_distances, relative
from agents.slam.tracker import PoseTracker


@dataclass(slots=True)
class Detection:
    """What was found at the last keyframe."""

    visited: int | None = None
    """The keyframe that the robot is back at."""
    loop: Match | None = None
    """A loop that has just been closed, as the scans match."""
    connects: int | None = None
    """The keyframe that the last one is to be connected to, if there was no direct way to it up to now."""


class Vote:
    """K nearest neighbours in appearance, and the groups that they belong to.

    Parameters
    ----------
    config : ExplorerConfig
        Its `measure`, `neighbours` and `both_directions`; with `match_scans`, keyframes are compared all around and not
        only looking ahead.

    Attributes
    ----------
    compared : int
        Comparisons of two keyframes so far.
    """

    def __init__(self, config: ExplorerConfig) -> None:
        self.measure = measure_by_name(config.measure)
        self.neighbours = config.neighbours
        self.both_directions = config.both_directions
        self.all_around = config.match_scans
        self.compared = 0

    def nearest(self, keyframes: Keyframes, candidates: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the candidates that look most like the last keyframe, those of the group with most votes first.

        Candidates of the last keyframe's direction are compared as they are; with `both_directions`, those of the
        opposite direction as they look back; others not at all.

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
        direction = keyframes.direction[candidates]
        ahead = candidates[direction == keyframes.direction[-1]]
        back = candidates[direction == opposite(int(keyframes.direction[-1]))]
        if not self.both_directions:
            back = back[:0]
        rows = np.concatenate([ahead, back])
        self.compared += len(rows)
        if not len(rows):
            return rows, np.zeros(0)
        last = keyframes.features[-1]
        query = self.measure.prepare(last.ravel() if self.all_around else last[0])
        features = np.concatenate([keyframes.features[ahead], keyframes.features[back][:, ::-1]])
        features = features.reshape(len(rows), -1) if self.all_around else features[:, 0]
        distances = self.measure.compare(self.measure.prepare(features), query)
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
        self.vote = Vote(config)
        self.joins = config.join

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
        euclidean_m = euclidean_distances(keyframes.pose[keyframe : keyframe + 1], keyframes.pose[-1])[0]
        direct = keyframes.is_direct(geodesic_m[keyframe], euclidean_m)
        return Detection(visited=keyframe, connects=keyframe if self.joins and not direct else None)

    def locate(self, keyframes: Keyframes, tracker: PoseTracker) -> int | None:
        """Return the earlier keyframe that the robot is back at, once a loop is closed and the track corrected."""
        euclidean_m = euclidean_distances(keyframes.pose, tracker.pose)
        return self._nearest_in_sight(keyframes, tracker.pose, self._left_before(keyframes, euclidean_m))

    def _left_before(self, keyframes: Keyframes, euclidean_m: np.ndarray) -> np.ndarray:
        return revisit_candidates(keyframes.path, euclidean_m, self.config.gap, self.config.leave)

    def _nearest_in_sight(self, keyframes: Keyframes, pose: np.ndarray, candidates: np.ndarray) -> int | None:
        """Return the nearest of the candidates that is in sight, and within `at_keyframe`."""
        scan = keyframes.scan[-1]
        clear = np.empty(len(scan))
        clear_lengths(scan, self.config.sight_half_width, clear)
        order = np.argsort(euclidean_distances(keyframes.pose[candidates], pose), kind="stable")
        for keyframe in candidates[order].tolist():
            x, y, _ = relative(pose, keyframes.pose[keyframe])
            euclidean_m, beam = math.hypot(x, y), round(math.atan2(y, x) * len(scan) / math.tau) % len(scan)
            if euclidean_m > self.config.at_keyframe:
                break
            if euclidean_m < clear[beam]:
                return keyframe
        return None


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


class MatchedAppearanceDetector(LoopDetector):
    """Appearance, verified by matching scans, in a place without rivals and twice in a row.

    Parameters
    ----------
    config : ExplorerConfig
    matcher : ScanMatcher
    """

    def __init__(self, config: ExplorerConfig, matcher: ScanMatcher) -> None:
        super().__init__(config)
        self.matcher = matcher
        std = config.loops.guess_position_std
        self._std = np.array([std, std, config.loops.guess_heading_std])
        self._pending: tuple[int, np.ndarray] | None = None

    def detect(self, keyframes: Keyframes, tracker: PoseTracker, geodesic_m: np.ndarray) -> Detection:
        """Ask the vote among all keyframes, wherever they are."""
        euclidean_m = euclidean_distances(keyframes.pose, tracker.pose)
        back = self._left_before(keyframes, euclidean_m)
        found = self._by_appearance(keyframes, tracker, back)
        if found is None:
            return Detection()
        if keyframes.is_direct(geodesic_m[found.keyframe], euclidean_m[found.keyframe]):
            return Detection(visited=self._nearest_in_sight(keyframes, found.pose, back))
        return Detection(loop=found, connects=found.keyframe)

    def _by_appearance(self, keyframes: Keyframes, tracker: PoseTracker, candidates: np.ndarray) -> Match | None:
        """Return a match with a candidate that the vote finds, if no other rivals it and two in a row agree."""
        config = self.config
        rows, _ = self.vote.nearest(keyframes, candidates)
        matches = [self._match(keyframes, tracker, row) for row in rows]
        found = [
            match
            for match in matches
            if match.inlier_ratio > tracker.inlier_ratio - config.inlier_ratio_slack
            and match.num_inliers > config.inliers_min
            and math.hypot(match.relative[0], match.relative[1]) < config.at_keyframe
        ]
        if not found:
            return None
        best = max(found, key=lambda match: match.inlier_ratio)
        for other in found:
            apart = math.hypot(*(other.pose[:2] - best.pose[:2]))
            if apart > config.rival_distance and other.inlier_ratio > best.inlier_ratio - config.rival_margin:
                return None
        if best.min_eigenvalue < config.eigenvalue_min:
            return None
        correction = relative(tracker.pose, best.pose)
        confirmed = (
            self._pending is not None
            and keyframes.count - self._pending[0] <= config.pending
            and np.abs(correction - self._pending[1])[:2].max() < config.same_correction
        )
        self._pending = None if confirmed else (keyframes.count, correction)
        return best if confirmed else None

    def _match(self, keyframes: Keyframes, tracker: PoseTracker, row: int) -> Match:
        """Match the last keyframe with another, near which it is expected whatever the track says."""
        expected = relative(keyframes.pose[row], tracker.pose)
        expected[:2] /= max(1.0, math.hypot(expected[0], expected[1]))
        expected = compose(keyframes.pose[row], expected)
        return self.matcher.match(keyframes, row, keyframes.scan[-1], keyframes.endpoints[-1], expected, self._std)


class MatchedDetector(MatchedAppearanceDetector):
    """Position and appearance, verified: only keyframes within the track's error are asked, and known ground isn't."""

    def detect(self, keyframes: Keyframes, tracker: PoseTracker, geodesic_m: np.ndarray) -> Detection:
        """Ask the vote among the keyframes to which the robot may have come round a loop; else the corrected track."""
        euclidean_m = euclidean_distances(keyframes.pose, tracker.pose)
        back = self._left_before(keyframes, euclidean_m)
        known = keyframes.is_direct(geodesic_m[back], euclidean_m[back])
        gate = np.clip(tracker.drift * geodesic_m[back], self.config.drift_min, self.config.drift_max)
        found = self._by_appearance(keyframes, tracker, back[~known & (euclidean_m[back] < gate)])
        if found is None:
            return Detection(visited=self._nearest_in_sight(keyframes, tracker.pose, back[known]))
        return Detection(loop=found, connects=found.keyframe)


def make_detector(config: ExplorerConfig, matcher: ScanMatcher) -> LoopDetector:
    """Return the detector that the settings name."""
    if config.detector == "position":
        return PositionDetector(config)
    if config.match_scans:
        return (MatchedDetector if config.detector == "both" else MatchedAppearanceDetector)(config, matcher)
    return (CombinedDetector if config.detector == "both" else AppearanceDetector)(config)


def revisit_candidates(path: np.ndarray, euclidean_m: np.ndarray, gap: float, leave: float) -> np.ndarray:
    """Return the keyframes that the robot can be back at by the definition of a revisit, wherever it is.

    Parameters
    ----------
    path : (n,)
        Metres driven at each keyframe.
    euclidean_m : (n,)
        Distance of each from the robot, which is at the last.
    gap, leave : float
        Metres that it must have driven since, and been away in between.
    """
    farthest_since = np.maximum.accumulate(euclidean_m[::-1])[::-1]
    return np.flatnonzero((path[-1] - path >= gap) & (farthest_since >= leave))

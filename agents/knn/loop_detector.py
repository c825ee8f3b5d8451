"""Step 5 of the paper: whether a place has been visited, and at which step."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from agents.exploration.frontiers import DETOUR
from agents.exploration.visibility import clear_lengths
from agents.knn.config import ExplorerConfig
from agents.knn.directions import opposite
from agents.knn.similarity import measure_by_name
from agents.slam.keyframes import Keyframes
from agents.slam.scan_matching import Match, match
from agents.slam.se2 import compose, euclidean_distances, relative
from agents.slam.tracker import PoseTracker

LEAST_GAP = 20.1
"""Metres driven since a place before one is back at it, by the definition of a revisit, and a little more."""
LEAST_LEAVE = 10.1
"""Metres that the robot was away in between, likewise."""
AT_KEYFRAME = 2.5
"""Metres from a place at which the robot is back there: half a metre less than counts."""
SIGHT_HALF_WIDTH = 0.2
"""Metres off all walls that the line of sight to that place must be, for the track may be off by as much."""
DRIFT_MIN, DRIFT_MAX = 1.5, 25.0
"""Metres that the track may be off at least and at most; see `PoseTracker.drift`."""
POSITION_DRIFT = 0.02
"""Metres that dead reckoning alone may be off for every metre driven."""
SPREAD = np.array([1.0, 1.0, math.radians(10)])
"""Of the robot about a place that the vote has found, metres, metres, radians."""
INLIER_RATIO_SLACK, MIN_INLIERS, MIN_EIGENVALUE = 0.05, 50, 4.0
"""What a match may lack of the agreement of scans on the way, and must have of ends in common, and of ends that speak
for each direction."""
RIVAL_DISTANCE, RIVAL_WORSE = 1.5, 0.08
"""A match elsewhere, by so many metres, must agree less, by such a share; else the place is not to be told from it."""
SAME_SHIFT = 0.8
"""Metres between the corrections that two matches in a row call for, if both are right."""
FRESH = 3
"""Rows after which a match that has not been confirmed is forgotten."""


@dataclass(slots=True)
class Detection:
    """What was found at a place."""

    visited: int | None = None
    """The place that the robot is back at."""
    loop: Match | None = None
    """A loop that has just been closed, as the scans match."""
    connects: int | None = None
    """The place that the robot's is to be joined to, if the way there was longer up to now."""


class Detector:
    """Looks for the robot's place among those of before.

    It counts comparisons of rows in `compared`.
    """

    def __init__(self, config: ExplorerConfig) -> None:
        self.config = config
        self.measure = measure_by_name(config.measure)
        self.compared = 0
        self._pending: tuple[int, np.ndarray] | None = None

    def detect(self, keyframes: Keyframes, tracker: PoseTracker, geodesic_m: np.ndarray) -> Detection:
        """Ask whether the last place has been visited before.

        Parameters
        ----------
        keyframes : Keyframes
        tracker : PoseTracker
        geodesic_m : (n,)
            Of the ways from the last place, metres.
        """
        if self.config.detector == "position":
            return self._by_position(keyframes, geodesic_m)
        if not self.config.match_scans:
            return self._by_vote(keyframes)
        euclidean_m = euclidean_distances(keyframes.pose, tracker.pose)
        back = revisit_candidates(keyframes.path, euclidean_m)
        around = geodesic_m[back] <= euclidean_m[back] + DETOUR
        if self.config.detector == "knn":
            found = self._by_appearance(keyframes, tracker, back)
        else:
            gate = np.clip(tracker.drift * geodesic_m[back], DRIFT_MIN, DRIFT_MAX)
            found = self._by_appearance(keyframes, tracker, back[~around & (euclidean_m[back] < gate)])
            if found is None:
                return Detection(visited=self._in_sight(keyframes, tracker.pose, back[around]))
        if found is None:
            return Detection()
        if geodesic_m[found.keyframe] <= euclidean_m[found.keyframe] + DETOUR:
            return Detection(visited=self._in_sight(keyframes, found.pose, back))
        return Detection(loop=found, connects=found.keyframe)

    def at_loop(self, keyframes: Keyframes, tracker: PoseTracker) -> int | None:
        """Return the place of before that the robot is at, once a loop is closed and the track mended."""
        euclidean_m = euclidean_distances(keyframes.pose, tracker.pose)
        return self._in_sight(keyframes, tracker.pose, revisit_candidates(keyframes.path, euclidean_m))

    def _in_sight(self, keyframes: Keyframes, pose: np.ndarray, candidates: np.ndarray) -> int | None:
        """Return the nearest of the candidates that is in sight and no farther than `AT_KEYFRAME`."""
        scan = keyframes.scan[-1]
        clear = np.empty(len(scan))
        clear_lengths(scan, SIGHT_HALF_WIDTH, clear)
        for keyframe in candidates[
            np.argsort(euclidean_distances(keyframes.pose[candidates], pose), kind="stable")
        ].tolist():
            x, y, _ = relative(pose, keyframes.pose[keyframe])
            euclidean_m, beam = math.hypot(x, y), round(math.atan2(y, x) * len(scan) / math.tau) % len(scan)
            if euclidean_m > AT_KEYFRAME:
                break
            if euclidean_m < clear[beam]:
                return keyframe
        return None

    def _by_position(self, keyframes: Keyframes, geodesic_m: np.ndarray) -> Detection:
        """Ask dead reckoning alone: no laser, no mended track."""
        euclidean_m = euclidean_distances(keyframes.odometry, keyframes.odometry[-1])
        back = revisit_candidates(keyframes.path, euclidean_m)
        if not len(back) or euclidean_m[back].min() > 2.0:
            return Detection()
        keyframe = int(back[np.argmin(euclidean_m[back])])
        far = (
            geodesic_m[keyframe]
            > euclidean_distances(keyframes.pose[keyframe : keyframe + 1], keyframes.pose[-1])[0] + DETOUR
        )
        return Detection(visited=keyframe, connects=keyframe if far else None)

    def _by_vote(self, keyframes: Keyframes) -> Detection:
        """Ask by the paper's rule: the vote among tables of the same direction, and a threshold."""
        tables = np.flatnonzero(keyframes.group != keyframes.group[-1])
        if self.config.detector == "both":
            gate = np.clip(POSITION_DRIFT * (keyframes.path[-1] - keyframes.path[tables]), DRIFT_MIN, DRIFT_MAX)
            tables = tables[euclidean_distances(keyframes.pose[tables], keyframes.pose[-1]) < gate]
        rows, similarities = self.vote(keyframes, tables)
        if len(rows) and similarities[0] > self.config.least_similarity:
            return Detection(visited=int(rows[0]))
        return Detection()

    def _by_appearance(self, keyframes: Keyframes, tracker: PoseTracker, candidates: np.ndarray) -> Match | None:
        """Return a match with a candidate that the vote finds, if no other rivals it and two rows in a row agree."""
        rows, _ = self.vote(keyframes, candidates)
        found = []
        for row in rows:
            expected = relative(keyframes.pose[row], tracker.pose)
            expected[:2] /= max(1.0, math.hypot(expected[0], expected[1]))  # near the row, whatever the track says
            expected = compose(keyframes.pose[row], expected)
            m = match(
                keyframes, row, keyframes.scan[-1], keyframes.endpoints[-1], expected, SPREAD, self.config.range_max
            )
            if (
                m.inlier_ratio > tracker.inlier_ratio - INLIER_RATIO_SLACK
                and m.num_inliers > MIN_INLIERS
                and math.hypot(m.relative[0], m.relative[1]) < AT_KEYFRAME
            ):
                found.append(m)
        if not found:
            return None
        best = max(found, key=lambda m: m.inlier_ratio)
        for other in found:
            error_m = math.hypot(*(other.pose[:2] - best.pose[:2]))
            if error_m > RIVAL_DISTANCE and other.inlier_ratio > best.inlier_ratio - RIVAL_WORSE:
                return None
        if best.min_eigenvalue < MIN_EIGENVALUE:
            return None
        shift = relative(tracker.pose, best.pose)
        confirmed = (
            self._pending is not None
            and keyframes.count - self._pending[0] <= FRESH
            and np.abs(shift - self._pending[1])[:2].max() < SAME_SHIFT
        )
        self._pending = None if confirmed else (keyframes.count, shift)
        return best if confirmed else None

    def vote(self, keyframes: Keyframes, candidates: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the rows nearest to the last place's in looks, those of the group with most votes first.

        Rows of the last place's direction are compared as they are; with `both_directions`, those of the opposite one
        as they look back; others not at all.

        Parameters
        ----------
        keyframes : Keyframes
        candidates : (c,)
            Rows.

        Returns
        -------
        rows : (k,)
        similarities : (k,)
        """
        direction = keyframes.direction[candidates]
        ahead = candidates[direction == keyframes.direction[-1]]
        back = candidates[direction == opposite(int(keyframes.direction[-1]))]
        if not self.config.both_directions:
            back = back[:0]
        rows = np.concatenate([ahead, back])
        self.compared += len(rows)
        if not len(rows):
            return rows, np.zeros(0)
        query = self.measure.prepare(
            keyframes.features[-1].ravel() if self.config.match_scans else keyframes.features[-1, 0]
        )
        features = np.concatenate([keyframes.features[ahead], keyframes.features[back][:, ::-1]])
        features = features.reshape(len(rows), -1) if self.config.match_scans else features[:, 0]
        distances = self.measure.compare(self.measure.prepare(features), query)
        nearest = np.argsort(distances, kind="stable")[: self.config.neighbours]
        groups = keyframes.group[rows[nearest]]
        votes = {group: int((groups == group).sum()) for group in groups.tolist()}
        # Ties go to the group with the nearest row, which comes first.
        order = sorted(range(len(nearest)), key=lambda i: (-votes[int(groups[i])], i))
        nearest = nearest[order]
        return rows[nearest], self.measure.similarity(distances[nearest])


def revisit_candidates(path: np.ndarray, euclidean_m: np.ndarray) -> np.ndarray:
    """Return the places that the robot would be back at by the definition of a revisit, wherever it is.

    Parameters
    ----------
    path : (n,)
        Metres driven at each place.
    euclidean_m : (n,)
        Metres of each place from the robot, at the last.
    """
    since = np.maximum.accumulate(euclidean_m[::-1])[::-1]
    return np.flatnonzero((path[-1] - path >= LEAST_GAP) & (since >= LEAST_LEAVE))

"""Where the robot is: dead reckoning, held straight by the matching of scans, and mended when a loop is closed."""

from __future__ import annotations

import math

import numpy as np

from agents.slam.keyframes import Keyframes
from agents.slam.pose_graph import optimize
from agents.slam.scan_matching import SPREAD, Match, match
from agents.slam.se2 import compose, euclidean_distances, relative, wrap

TURN_ERROR = math.radians(0.1)
"""Of the heading that the matching of two scans a metre apart gives: measured in simulation, 0.03 to 0.12 degrees."""
SHIFT_ERROR = 0.01
"""Metres; of its position, likewise."""
STEP_SPREAD = np.array([0.05, 0.05, math.radians(4)])
"""Of dead reckoning from one place to the next, metres, metres and radians: what a worn robot does at most."""
RETURN_SPREAD = np.array([0.3, 0.3, math.radians(5)])
"""Of the track against a place nearby that was left a few places ago."""
MIN_INLIER_RATIO = 0.75
"""Share of two scans' ends that agree, from which a match on the way is taken."""
MIN_INLIERS = 40
"""Ends that both have in sight, at least."""
MEMORY = 30
"""Keyframes over which the mean agreement of matches on the way is taken, and the mean error of the compass's turns."""
LAG = 0.3
"""Share of the compass's error at a place that is taken to last until the next: its field changes slowly."""
DRIFT = 0.6
"""Share of the compass's error from place to place, radians, that may be left in the headings of a long way."""
FIELD_REACH = 100.0
"""By so much less does each reading of the compass tell than its noise says: its field is alike over metres."""
SCALE_SPREAD, SLIP = 0.03, 0.03
"""Of the distance meter: its scale's deviation from 1 before anything is known, and metres of slip at each metre."""
SCALE_ENDS, SCALE_DRIVEN, SCALE_TURN = 2.0, 0.5, 0.2
"""A match tells the scale if so many ends speak for the way driven, over so many metres, with few radians turned."""
SCALE_STEP_MAX = 0.02
"""By which one match may call for another scale, beyond what is not known of it: a few find the way far too short."""
MAX_CORRECTION = 0.5
"""Metres by which returns have pulled at the track before it is spread over the places in between."""


class PoseTracker:
    """The pose of the robot in a frame that begins at (0, 0) with the compass's heading, and its loops.

    Parameters
    ----------
    range_max : float
        Reach of the laser, metres.
    match_scans : bool
        If not, the track is dead reckoning alone.

    Attributes
    ----------
    pose : (3,) float64
    odometry : (2,) float64
        Where dead reckoning alone puts the robot: the position that the compass and the distance meter give.
    path : float
        Metres driven, forward and back.
    scale : float
        Metres driven for each that the distance meter shows, as the scans have it.
    inlier_ratio : float
        Mean of the latest matches on the way: how well two scans agree with this laser, in this building.
    edges : list
        Measured relations of places: (i, j, pose of j in i's frame `(3,)`, information `(3, 3)`).
    """

    def __init__(self, range_max: float, match_scans: bool) -> None:
        self.range_max = range_max
        self.match_scans = match_scans
        self.pose = np.zeros(3)
        self.odometry = np.zeros(2)
        self.path = 0.0
        self.scale = 1.0
        self.inlier_ratio = 1.0
        self.edges: list[tuple[int, int, np.ndarray, np.ndarray]] = []
        self._distance = 0.0
        self._compass: float | None = None
        self._bias = 0.0  # of the compass, as the scans have it
        self._compass_variance = 0.0  # mean squared error of its turns from place to place
        self._accumulated_correction = np.zeros(2)
        self._scale_information = SCALE_SPREAD**-2

    @property
    def compass(self) -> float:
        """The last reading of the compass as a heading."""
        return 0.0 if self._compass is None else self._compass

    @property
    def heading_information(self) -> float:
        """Inverse variance of the compass's readings at the places, as the graph takes it."""
        return 1 / max(FIELD_REACH * self._compass_variance, TURN_ERROR**2)

    @property
    def drift(self) -> float:
        """Metres that the track may be off for every metre of way between two places."""
        return DRIFT * math.sqrt(self._compass_variance)

    def advance(self, distance: float, compass: np.ndarray) -> None:
        """Take a reading of the distance meter and of the compass `(2,)`."""
        heading = math.atan2(compass[1], compass[0])
        before = heading if self._compass is None else self._compass
        driven = 0.0 if self._compass is None else distance - self._distance
        self._distance = distance
        middle = before + 0.5 * wrap(heading - before)  # an arc's chord points midway between its ends' headings
        self._compass = heading
        self.odometry += driven * np.array([math.cos(middle), math.sin(middle)])
        driven *= self.scale
        self.pose[:2] += driven * np.array([math.cos(middle + self._bias), math.sin(middle + self._bias)])
        self.pose[2] = wrap(heading + self._bias)
        self.path += abs(driven)

    def localize(self, keyframes: Keyframes, scan: np.ndarray, endpoints: np.ndarray, geodesic_m: np.ndarray) -> None:
        """Match a scan with the oldest place close by, or the last one, before the robot's place is added.

        Parameters
        ----------
        keyframes : Keyframes
        scan, endpoints : (beams,)
            The scan, and its `reliable_endpoints`.
        geodesic_m : (n,)
            Of the ways from the last place, metres.
        """
        last = keyframes.count - 1
        if last < 0 or not self.match_scans:
            return
        expected = self.pose.copy()
        odometry = relative(keyframes.pose[last], expected)
        known = np.flatnonzero((euclidean_distances(keyframes.pose, expected) < 2.0) & (geodesic_m < 8.0))
        if len(known) and known[0] < last - 4:
            found = match(keyframes, known[0], scan, endpoints, expected, RETURN_SPREAD, self.range_max)
            if self._fits(found):
                self._add_edge(last, keyframes.count, odometry, np.diag(STEP_SPREAD**-2))
                self._add_edge(known[0], keyframes.count, found.relative, found.information)
                self._accumulated_correction += found.pose[:2] - expected[:2]
                self._move(found.pose)
                return
        found = match(keyframes, last, scan, endpoints, expected, STEP_SPREAD, self.range_max)
        self.inlier_ratio += (found.inlier_ratio - self.inlier_ratio) / min(MEMORY, last + 1)
        if self._fits(found):
            turned = wrap(self.compass - keyframes.compass[last] - found.relative[2])
            self._compass_variance += (turned**2 - self._compass_variance) / min(MEMORY, last + 1)
            # The compass has no drift, the scans' headings drift but little: a Kalman gain holds them together.
            self._learn_scale(odometry, found)
            gain = TURN_ERROR**2 / (TURN_ERROR**2 + self._compass_variance)
            found.pose[2] = wrap(found.pose[2] + gain * wrap(self.compass - found.pose[2]))
            self._move(found.pose)
            odometry = relative(keyframes.pose[last], found.pose)
            self._add_edge(last, keyframes.count, odometry, found.information + np.diag(STEP_SPREAD**-2))
        else:
            self._add_edge(last, keyframes.count, odometry, np.diag(STEP_SPREAD**-2))

    def _learn_scale(self, odometry: np.ndarray, found: Match) -> None:
        """Weigh what a match with the last place says of the distance meter's scale; see `SCALE_SPREAD`."""
        driven = math.hypot(odometry[0], odometry[1])
        if driven < SCALE_DRIVEN or abs(found.relative[2]) > SCALE_TURN:
            return
        # Without the prior: that pulled at the match by as much as the ends did the other way.
        covariance = np.linalg.inv(found.information + 1e-3 * np.eye(3))
        free = found.relative + covariance @ ((found.relative - odometry) / STEP_SPREAD**2)
        along = np.array([odometry[0], odometry[1], 0.0]) / driven
        variance = along @ covariance @ along
        if variance > SPREAD**2 / SCALE_ENDS:
            return
        information = (driven / self.scale) ** 2 / (variance + SHIFT_ERROR**2 + SLIP**2 * driven)
        error_m = self.scale * (along @ free) / driven - self.scale
        most = math.sqrt(SCALE_STEP_MAX**2 + 1 / self._scale_information)
        self._scale_information += information
        self.scale += information / self._scale_information * max(-most, min(most, error_m))

    def _fits(self, found: Match) -> bool:
        error_m = math.hypot(*(found.pose[:2] - self.pose[:2]))
        return found.inlier_ratio > MIN_INLIER_RATIO and found.num_inliers > MIN_INLIERS and error_m < 1.0

    def _move(self, pose: np.ndarray) -> None:
        self._bias = wrap(self._bias + LAG * wrap(pose[2] - self.pose[2]))
        self.pose = pose.copy()

    def _add_edge(self, i: int, j: int, measured: np.ndarray, information: np.ndarray) -> None:
        floor = np.diag([SHIFT_ERROR**2, SHIFT_ERROR**2, TURN_ERROR**2])
        covariance = np.linalg.inv(information + 1e-6 * np.eye(3)) + floor
        self.edges.append((int(i), int(j), measured, np.linalg.inv(covariance)))

    def add_loop_closure(self, keyframes: Keyframes, found: Match) -> None:
        """Take it that the last place is at a known one as a match says, and mend all places and the pose."""
        self._add_edge(found.keyframe, keyframes.count - 1, found.relative, found.information)
        self._optimize(keyframes)

    def relax(self, keyframes: Keyframes) -> None:
        """Mend all places and the pose, if returns have pulled at the track since that was done last."""
        if math.hypot(*self._accumulated_correction) > MAX_CORRECTION:
            self._optimize(keyframes)

    def _optimize(self, keyframes: Keyframes) -> None:
        last = keyframes.pose[-1].copy()
        keyframes.pose[:] = optimize(
            keyframes.pose,
            np.array([(i, j) for i, j, _, _ in self.edges]),
            np.array([measured for _, _, measured, _ in self.edges]),
            np.array([information for *_, information in self.edges]),
            keyframes.compass,
            np.full(keyframes.count, self.heading_information),
        )
        self.pose = compose(keyframes.pose[-1], relative(last, self.pose))
        self._bias = wrap(self._bias + keyframes.pose[-1, 2] - last[2])
        self._accumulated_correction = np.zeros(2)

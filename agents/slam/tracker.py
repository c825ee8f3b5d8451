"""Where the robot is: by dead reckoning, or corrected by matching scans and closing loops."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np

from agents.component_config import ComponentConfig
from agents.slam.keyframes import Keyframes
from agents.slam.pose_graph import PoseGraphConfig, optimize
from agents.slam.scan_matching import Match, ScanMatcher
from agents.slam.se2 import compose, euclidean_distances, relative, wrap_angle


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackerConfig(ComponentConfig):
    """What is expected of the sensors, and which matches are taken."""

    heading_std: float = math.radians(0.1)
    """Of the heading that matching two scans a metre apart gives; in simulation 0.03 to 0.12 degrees."""
    position_std: float = 0.01
    """Of the position that it gives."""
    step_position_std: float = 0.05
    step_heading_std: float = math.radians(4)
    """Of dead reckoning from one keyframe to the next: what a worn robot does at most."""
    return_position_std: float = 0.3
    return_heading_std: float = math.radians(5)
    """Of the track against a keyframe nearby that was left a few keyframes ago."""
    return_radius: float = 2.0
    return_path: float = 8.0
    return_age: int = 4
    """A keyframe within this distance, and this way, and so many keyframes old is matched instead of the last."""
    inlier_ratio_min: float = 0.75
    inliers_min: int = 40
    correction_max: float = 1.0
    """A match is taken if so many endpoints agree, and it moves the robot by less than so many metres."""
    memory: int = 30
    """Keyframes over which the mean inlier ratio and the compass's variance are taken."""
    bias_gain: float = 0.3
    """Share of the compass's error at a keyframe that lasts until the next: the field in a building changes slowly."""
    drift_share: float = 0.6
    """Share of the compass's error from keyframe to keyframe that may be left in the headings of a long way."""
    compass_correlation: float = 100.0
    """Readings of the compass that count as one: its field is alike over metres."""
    scale_std: float = 0.03
    """Of the distance meter's scale, before anything is known of it."""
    slip_std: float = 0.03
    """Of the way driven, metres per square root of a metre."""
    scale_endpoints: float = 2.0
    scale_distance: float = 0.5
    scale_turn: float = 0.2
    """A match tells the scale if so many endpoints tell the way driven, over so many metres, turning less than this."""
    scale_step: float = 0.02
    """By how much one match may change the scale, beyond its uncertainty: a few find the way far too short."""
    relax_after: float = 0.5
    """Metres by which returns have corrected the track before it is spread over the keyframes in between."""


class PoseTracker(ABC):
    """The pose of the robot in a frame with its origin at the start and the axes of the compass.

    Parameters
    ----------
    config : TrackerConfig, optional

    Attributes
    ----------
    pose : (3,) float64
    odometry : (2,) float64
        The position by dead reckoning alone, from the compass and the distance meter.
    path : float
        Metres driven, forward and backward.
    scale : float
        Metres driven for each metre that the distance meter shows.
    inlier_ratio : float
        Mean over the latest matches of successive scans: how well scans agree with this laser in this building.
    compass_variance : float
        Mean squared error of the compass's turns from keyframe to keyframe, as the scans have it.
    edges : list
        Measured relations of keyframes: (i, j, pose of j in the frame of i `(3,)`, information `(3, 3)`).
    """

    def __init__(self, config: TrackerConfig | None = None) -> None:
        self.config = config or TrackerConfig()
        self.pose = np.zeros(3)
        self.odometry = np.zeros(2)
        self.path = 0.0
        self.scale = 1.0
        self.inlier_ratio = 1.0
        self.compass_variance = 0.0
        self.edges: list[tuple[int, int, np.ndarray, np.ndarray]] = []
        self._distance = 0.0
        self._compass: float | None = None
        self._compass_bias = 0.0

    @property
    def compass(self) -> float:
        """The last reading of the compass as a heading."""
        return 0.0 if self._compass is None else self._compass

    @property
    def heading_information(self) -> float:
        """Inverse variance of the compass's readings at the keyframes, as the pose graph takes it."""
        return 1 / max(self.config.compass_correlation * self.compass_variance, self.config.heading_std**2)

    @property
    def drift(self) -> float:
        """Metres by which the track may err for every metre of way between two keyframes."""
        return self.config.drift_share * math.sqrt(self.compass_variance)

    def advance(self, distance: float, compass: np.ndarray) -> None:
        """Take a reading of the distance meter, metres, and of the compass `(2,)`, east and north."""
        heading = math.atan2(compass[1], compass[0])
        before = heading if self._compass is None else self._compass
        driven = 0.0 if self._compass is None else distance - self._distance
        self._distance = distance
        # An arc's chord points midway between the headings at its ends.
        middle = before + 0.5 * wrap_angle(heading - before)
        self._compass = heading
        self.odometry += driven * np.array([math.cos(middle), math.sin(middle)])
        driven *= self.scale
        chord = middle + self._compass_bias
        self.pose[:2] += driven * np.array([math.cos(chord), math.sin(chord)])
        self.pose[2] = wrap_angle(heading + self._compass_bias)
        self.path += abs(driven)

    @abstractmethod
    def localize(self, keyframes: Keyframes, scan: np.ndarray, endpoints: np.ndarray, geodesic_m: np.ndarray) -> None:
        """Correct the pose by a scan, before its keyframe is added.

        Parameters
        ----------
        keyframes : Keyframes
        scan, endpoints : (beams,)
            The scan, and its `reliable_endpoints`.
        geodesic_m : (n,)
            Lengths of the ways from the last keyframe.
        """

    @abstractmethod
    def add_loop_closure(self, keyframes: Keyframes, found: Match) -> None:
        """Accept that the last keyframe is where a match says, and correct the pose and all keyframes."""

    @abstractmethod
    def relax(self, keyframes: Keyframes) -> None:
        """Correct the pose and all keyframes, if returns to known ground have pulled at the track since last time."""


class DeadReckoningTracker(PoseTracker):
    """The distance meter and the compass alone: nothing corrects the pose."""

    def localize(self, keyframes: Keyframes, scan: np.ndarray, endpoints: np.ndarray, geodesic_m: np.ndarray) -> None:
        """Do nothing."""

    def add_loop_closure(self, keyframes: Keyframes, found: Match) -> None:
        """Do nothing."""

    def relax(self, keyframes: Keyframes) -> None:
        """Do nothing."""


class ScanMatchingTracker(PoseTracker):
    """Dead reckoning, corrected by matching each keyframe's scan with an earlier one, and by closed loops.

    Parameters
    ----------
    matcher : ScanMatcher
    config : TrackerConfig, optional
    pose_graph : PoseGraphConfig, optional
    """

    def __init__(
        self, matcher: ScanMatcher, config: TrackerConfig | None = None, pose_graph: PoseGraphConfig | None = None
    ) -> None:
        super().__init__(config)
        config = self.config
        self.matcher = matcher
        self.pose_graph = pose_graph or PoseGraphConfig()
        self._accumulated_correction = np.zeros(2)
        self._scale_information = config.scale_std**-2
        self._step_std = np.array([config.step_position_std, config.step_position_std, config.step_heading_std])
        self._return_std = np.array([config.return_position_std, config.return_position_std, config.return_heading_std])

    def localize(self, keyframes: Keyframes, scan: np.ndarray, endpoints: np.ndarray, geodesic_m: np.ndarray) -> None:
        """Match the scan with that of the oldest keyframe close by, or of the last one."""
        last, config = keyframes.count - 1, self.config
        if last < 0:
            return
        expected = self.pose.copy()
        odometry = relative(keyframes.pose[last], expected)
        euclidean_m = euclidean_distances(keyframes.pose, expected)
        known = np.flatnonzero((euclidean_m < config.return_radius) & (geodesic_m < config.return_path))
        if len(known) and known[0] < last - config.return_age:
            found = self.matcher.match(keyframes, known[0], scan, endpoints, expected, self._return_std)
            if self._accepts(found):
                self._add_edge(last, keyframes.count, odometry, np.diag(self._step_std**-2))
                self._add_edge(known[0], keyframes.count, found.relative, found.information)
                self._accumulated_correction += found.pose[:2] - expected[:2]
                self._move(found.pose)
                return
        found = self.matcher.match(keyframes, last, scan, endpoints, expected, self._step_std)
        count = min(config.memory, last + 1)
        self.inlier_ratio += (found.inlier_ratio - self.inlier_ratio) / count
        if not self._accepts(found):
            self._add_edge(last, keyframes.count, odometry, np.diag(self._step_std**-2))
            return
        turn_error = wrap_angle(self.compass - keyframes.compass[last] - found.relative[2])
        self.compass_variance += (turn_error**2 - self.compass_variance) / count
        self._learn_scale(odometry, found)
        # The compass doesn't drift, the scans' headings drift a little: a Kalman gain holds them together.
        gain = config.heading_std**2 / (config.heading_std**2 + self.compass_variance)
        found.pose[2] = wrap_angle(found.pose[2] + gain * wrap_angle(self.compass - found.pose[2]))
        self._move(found.pose)
        odometry = relative(keyframes.pose[last], found.pose)
        self._add_edge(last, keyframes.count, odometry, found.information + np.diag(self._step_std**-2))

    def _learn_scale(self, odometry: np.ndarray, found: Match) -> None:
        """Let a match with the last keyframe correct the distance meter's scale, by a Kalman filter of one number."""
        config, endpoint_std = self.config, self.matcher.config.endpoint_std
        driven = math.hypot(odometry[0], odometry[1])
        if driven < config.scale_distance or abs(found.relative[2]) > config.scale_turn:
            return
        # Without the prior, which has pulled at the match by as much as the endpoints did the other way.
        covariance = np.linalg.inv(found.information + 1e-3 * np.eye(3))
        free = found.relative + covariance @ ((found.relative - odometry) / self._step_std**2)
        along = np.array([odometry[0], odometry[1], 0.0]) / driven
        variance = along @ covariance @ along
        if variance > endpoint_std**2 / config.scale_endpoints:
            return
        noise = variance + config.position_std**2 + config.slip_std**2 * driven
        information = (driven / self.scale) ** 2 / noise
        error = self.scale * (along @ free) / driven - self.scale
        most = math.sqrt(config.scale_step**2 + 1 / self._scale_information)
        self._scale_information += information
        self.scale += information / self._scale_information * max(-most, min(most, error))

    def _accepts(self, found: Match) -> bool:
        correction = math.hypot(*(found.pose[:2] - self.pose[:2]))
        agrees = found.inlier_ratio > self.config.inlier_ratio_min and found.num_inliers > self.config.inliers_min
        return agrees and correction < self.config.correction_max

    def _move(self, pose: np.ndarray) -> None:
        self._compass_bias = wrap_angle(self._compass_bias + self.config.bias_gain * wrap_angle(pose[2] - self.pose[2]))
        self.pose = pose.copy()

    def _add_edge(self, i: int, j: int, measured: np.ndarray, information: np.ndarray) -> None:
        floor = np.diag([self.config.position_std**2, self.config.position_std**2, self.config.heading_std**2])
        covariance = np.linalg.inv(information + 1e-6 * np.eye(3)) + floor
        self.edges.append((int(i), int(j), measured, np.linalg.inv(covariance)))

    def add_loop_closure(self, keyframes: Keyframes, found: Match) -> None:
        """Add the match to the pose graph, and solve it."""
        self._add_edge(found.keyframe, keyframes.count - 1, found.relative, found.information)
        self._optimize(keyframes)

    def relax(self, keyframes: Keyframes) -> None:
        """Solve the pose graph, if returns have corrected the track by more than `relax_after` since the last time."""
        if math.hypot(*self._accumulated_correction) > self.config.relax_after:
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
            self.pose_graph,
        )
        self.pose = compose(keyframes.pose[-1], relative(last, self.pose))
        self._compass_bias = wrap_angle(self._compass_bias + keyframes.pose[-1, 2] - last[2])
        self._accumulated_correction = np.zeros(2)

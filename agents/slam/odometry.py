"""What the scans tell of the distance meter and the compass: the one's scale, and how far the other may be trusted."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from agents.component_config import ComponentConfig
from agents.slam.registration import Registration
from agents.slam.se2 import wrap_angle


@dataclass(frozen=True, slots=True, kw_only=True)
class OdometryConfig(ComponentConfig):
    """What is expected of the distance meter and the compass before the scans tell."""

    position_std: float = 0.05
    heading_std: float = math.radians(4)
    """Of the wheels' odometry from one keyframe to the next: what a worn robot does at most."""
    memory: int = 30
    """Keyframes over which the variance of the compass's turns is taken."""
    loop_memory: int = 30
    loop_count: int = 3
    loop_std: float = math.radians(1)
    """Matches with old keyframes over which the compass is compared, how many of them tell that it does not drift, and
    by how much it may differ in them, beyond what its turns err by."""
    correlation: float = 100.0
    """Readings of the compass that count as one: its field is alike over metres."""
    scale_std: float = 0.03
    """Of the distance meter's scale, before anything is known of it."""
    slip_std: float = 0.03
    """Of the way driven, metres per square root of a metre."""
    match_std: float = 0.01
    """Of the position that a match gives."""
    scale_variance: float = 0.00125
    scale_distance: float = 0.3
    scale_turn: float = 0.2
    """A match tells the scale if it tells the way driven with that variance, over so many metres, turning less."""
    scale_step: float = 0.02
    """By how much one match may change the scale, beyond its uncertainty: a few find the way far too short."""


class OdometryModel:
    """Learns the errors of the odometry from the matches of each keyframe with the one before.

    Attributes
    ----------
    scale : float
        Metres driven for each metre that the distance meter shows.
    std : (3,) float64
        Standard deviations of the odometry from one keyframe to the next.
    turn_variance : float
        Mean squared error of the compass's turns from keyframe to keyframe, as the scans have it.
    """

    def __init__(self, config: OdometryConfig) -> None:
        self.config = config
        self.scale = 1.0
        self.turn_variance = config.heading_std**2
        self._loop_variance = 0.0
        self._turns = self._loops = 0
        self._scale_information = config.scale_std**-2
        position, heading = config.position_std, config.heading_std
        self.std = np.array([position, position, heading])

    @property
    def heading_information(self) -> float:
        """Inverse variance of the compass's readings; 0 as long as loops haven't shown that it does not drift."""
        config = self.config
        drifts = self._loop_variance > 4 * self.turn_variance + config.loop_std**2
        if drifts or self._loops < config.loop_count:
            return 0.0
        return 1 / max(config.correlation * self.turn_variance, config.loop_std**2)

    def learn_loop(self, before: float, after: float, found: Registration) -> None:
        """Compare what the compass read at two keyframes, between which the robot has driven a loop, with a match."""
        self._loops += 1
        error = wrap_angle(after - before - found.pose[2])
        self._loop_variance += (error**2 - self._loop_variance) / min(self.config.loop_memory, self._loops)

    def learn(self, odometry: np.ndarray, found: Registration) -> None:
        """Let a match with the keyframe before correct the model; both are poses in that keyframe's frame."""
        config = self.config
        self._turns += 1
        error = wrap_angle(odometry[2] - found.pose[2])
        self.turn_variance += (error**2 - self.turn_variance) / min(config.memory, self._turns + 5)
        driven = math.hypot(odometry[0], odometry[1])
        if driven < config.scale_distance or abs(found.pose[2]) > config.scale_turn:
            return
        # Without the prior, which has pulled at the match by as much as the endpoints did the other way.
        covariance = np.linalg.inv(found.information + 1e-3 * np.eye(3))
        free = found.pose + covariance @ ((found.pose - odometry) / self.std**2)
        along = np.array([odometry[0], odometry[1], 0.0]) / driven
        variance = along @ covariance @ along
        if variance > config.scale_variance:
            return
        noise = variance + config.match_std**2 + config.slip_std**2 * driven
        information = (driven / self.scale) ** 2 / noise
        wrong = self.scale * (along @ free) / driven - self.scale
        most = math.sqrt(config.scale_step**2 + 1 / self._scale_information)
        self._scale_information += information
        self.scale += float(information / self._scale_information * max(-most, min(most, wrong)))

"""A map from any laser and wheels whose heading may drift, and the places that the robot is back at, whoever drives."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from agents.component_config import ComponentConfig
from agents.slam.local_tracker import LocalTracker, LocalTrackerConfig
from agents.slam.loop_closer import LoopCloser, LoopCloserConfig, in_sight
from agents.slam.panorama import keep_steady, merge_scans, panorama_beams, signature, spread_beams
from agents.slam.pose_graph import PoseGraphConfig
from agents.slam.registration import PanoramaMatcher
from agents.slam.run_map import RunMap
from agents.slam.scan_filters import despeckle
from agents.slam.scan_matching import MatcherConfig
from agents.slam.se2 import compose, euclidean_distances, wrap_angle
from cyclic_env.config import LaserConfig


@dataclass(frozen=True, slots=True, kw_only=True)
class KeyframingConfig(ComponentConfig):
    """When a keyframe is taken and what its panorama is made of. Tuned on simulated logs."""

    range_max: float = 30.0
    """Metres beyond which nothing counts, whatever the laser's reach."""
    spacing: float = 0.4
    turn: float = math.radians(12)
    """Way and turn between keyframes."""
    steady: float = 0.3
    """By how much a range may differ from the median about it."""
    panorama_path: float = 12.0
    panorama_keyframes: int = 36
    """The scans that a panorama is made of: over that way, and at most so many."""
    compass_std: float = 0.0
    """Standard deviation of a compass's heading; 0 for a heading that drifts and tells only its changes."""
    claim_distance: float = 2.5
    """Distance of a place at which the robot is back there: half a metre less than counts."""
    closure_fit: float = 60.0
    """Mean squared error of a closure's edges, in standard deviations, up to which it is taken to be right."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MapperConfig:
    """The settings of a mapper's components."""

    keyframing: KeyframingConfig = field(default_factory=KeyframingConfig)
    tracker: LocalTrackerConfig = field(default_factory=LocalTrackerConfig)
    loops: LoopCloserConfig = field(default_factory=LoopCloserConfig)
    matcher: MatcherConfig = field(default_factory=MatcherConfig)
    pose_graph: PoseGraphConfig = field(default_factory=PoseGraphConfig)


class Mapper:
    """Takes a robot's readings step by step, and says where it is back.

    Parameters
    ----------
    laser : LaserConfig
    config : MapperConfig, optional

    Attributes
    ----------
    run : RunMap
    loops : LoopCloser
    pose : (3,) float64
        Of the robot now, in the frame of its start.
    path : float
        Metres driven.
    """

    def __init__(self, laser: LaserConfig, config: MapperConfig | None = None) -> None:
        self.config = config or MapperConfig()
        self.laser = laser
        self._beams, self._count = panorama_beams(laser)
        self.range_max = min(laser.range_max, self.config.keyframing.range_max)
        matcher = PanoramaMatcher(self.range_max, self.config.matcher)
        self.run = RunMap(self._count, self.config.tracker.matched + 2)
        self.tracker = LocalTracker(self.run, matcher, self.config.tracker)
        self.loops = LoopCloser(self.run, self.tracker, matcher, self.config.loops)
        self.matcher = matcher
        self.path = 0.0
        self.step = -1
        self._odometry = np.zeros(3)  # of the robot in the frame of the last keyframe
        self._last: tuple[float, float] | None = None
        self._nearest = np.zeros((3, self._count))

    @property
    def pose(self) -> np.ndarray:
        """The pose of the robot now, in the frame of its start, `(3,)`."""
        return compose(self.run.pose[-1], self._odometry) if self.run.count else self._odometry.copy()

    def observe(self, ranges: np.ndarray, distance: float, heading: float) -> int | None:
        """Take the readings of a step; return the earlier step at whose place the robot is back, if there is one.

        Parameters
        ----------
        ranges : (num_beams,)
            The laser's, metres.
        distance : float
            What the distance meter shows, metres.
        heading : float
            Radians: a compass's, or the odometry's.
        """
        config, run = self.config.keyframing, self.run
        self.step += 1
        before = (distance, heading) if self._last is None else self._last
        driven, turn = distance - before[0], wrap_angle(heading - before[1])
        self._last = (distance, heading)
        self.path += abs(driven)
        chord = driven * np.array([math.cos(0.5 * turn), math.sin(0.5 * turn)])
        self._odometry = compose(self._odometry, np.array([*chord, turn]))
        moved = math.hypot(self._odometry[0], self._odometry[1])
        if not run.count or moved >= config.spacing or abs(self._odometry[2]) >= config.turn:
            self._add_keyframe(ranges, heading)
        return self._back_at() if run.known[-1] else None

    def _add_keyframe(self, ranges: np.ndarray, heading: float) -> None:
        config, run = self.config.keyframing, self.run
        raw, smooth, scan = spread_beams(ranges, self._beams, self._count), *np.empty((2, self._count))
        despeckle(np.where(raw > 0, np.minimum(raw, self.range_max), self.range_max), smooth)
        keep_steady(raw, smooth, self.range_max, config.steady, scan)
        absolute = config.compass_std > 0
        i = run.add(
            scan=scan,
            step=self.step,
            path=self.path,
            heading=heading,
            heading_information=config.compass_std**-2 if absolute else 0.0,
            pose=(0.0, 0.0, heading if absolute else 0.0),
        )
        odometry, self._odometry = self._odometry, np.zeros(3)
        self.tracker.track(odometry)
        if self.laser.sees_all_around:
            run.panorama[i] = scan
        else:
            first = int(np.searchsorted(run.path, self.path - config.panorama_path))
            first = max(first, i - config.panorama_keyframes)
            merge_scans(run.scan, run.pose, first, i, run.pose[i], self.range_max, self._nearest, run.panorama[i])
        run.lines[i] = self.matcher.wall_lines(run.panorama[i])
        signature(run.panorama[i], run.signature[i])
        if self.loops.update():
            self.optimize()

    def optimize(self) -> None:
        """Fit the poses of all keyframes to all that has been measured."""
        self.run.optimize(self.config.keyframing.closure_fit, self.config.pose_graph)

    def _back_at(self) -> int | None:
        """Return the step of the nearest place in sight that counts as left."""
        run, loops, pose = self.run, self.config.loops, self.pose
        distance = euclidean_distances(run.pose, pose)
        farthest_since = np.maximum.accumulate(distance[::-1])[::-1]
        left = (self.path - run.path >= loops.gap) & (farthest_since >= loops.leave)
        back = np.flatnonzero(left & (distance < self.config.keyframing.claim_distance))
        back = back[in_sight(run.panorama[-1], run.pose[-1], run.pose[back])]
        for j in back[np.argsort(distance[back], kind="stable")].tolist():
            if in_sight(run.panorama[j], run.pose[j], pose[None])[0]:
                return int(run.step[j])
        return None

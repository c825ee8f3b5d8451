"""A map from any laser, distance meter and heading, and the places that the robot is back at, whoever drives."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from agents.component_config import ComponentConfig
from agents.slam.keyframes import revisit_candidates
from agents.slam.local_tracker import LocalTracker, LocalTrackerConfig
from agents.slam.loop_closer import LoopCloser, LoopCloserConfig, in_sight
from agents.slam.odometry import OdometryConfig, OdometryModel
from agents.slam.panorama import keep_steady, merge_scans, panorama_beams, panorama_offset, signature, spread_beams
from agents.slam.pose_graph import PoseGraphConfig
from agents.slam.registration import PanoramaMatcher, Registration
from agents.slam.run_map import RunMap
from agents.slam.scan_filters import despeckle
from agents.slam.scan_matching import MatcherConfig
from agents.slam.se2 import euclidean_distances, wrap_angle
from cyclic_env.config import LaserConfig


@dataclass(frozen=True, slots=True, kw_only=True)
class KeyframingConfig(ComponentConfig):
    """When a keyframe is taken and what its panorama is made of. Tuned on simulated logs."""

    range_max: float = 30.0
    """Metres beyond which nothing counts, whatever the laser's reach."""
    spacing: float = 0.4
    turn: float = math.radians(12)
    """Way and turn between keyframes of a laser that sees less than a full turn."""
    spacing_all_around: float = 1.0
    turn_all_around: float = math.radians(120)
    """The same where it sees all around, and shows what the one before has shown, as long as no loop may be closed."""
    steady: float = 0.3
    """By how much a range may differ from the median about it."""
    panorama_path: float = 12.0
    panorama_keyframes: int = 36
    """The scans that a panorama is made of: over that way, and at most so many."""
    claim_distance: float = 2.5
    """Distance of a place at which the robot is back there: half a metre less than counts."""
    closure_fit: float = 60.0
    """Mean squared error of a closure's edges, in standard deviations, up to which it is taken to be right."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MapperConfig:
    """The settings of a mapper's components."""

    keyframing: KeyframingConfig = field(default_factory=KeyframingConfig)
    odometry: OdometryConfig = field(default_factory=OdometryConfig)
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
    odometry : OdometryModel
    pose : (3,) float64
        Of the robot now, its heading that of a panorama's beam 0. The first keyframe is at the origin.
    path : float
        Metres driven.
    step : int
        The number of the step at hand; -1 before the first.
    """

    def __init__(self, laser: LaserConfig, config: MapperConfig | None = None) -> None:
        self.config = config or MapperConfig()
        self.laser = laser
        self._beams, self._count = panorama_beams(laser)
        self._offset = panorama_offset(laser)
        keyframing = self.config.keyframing
        self.range_max = min(laser.range_max, keyframing.range_max)
        around = laser.sees_all_around
        self._spacing = keyframing.spacing_all_around if around else keyframing.spacing
        self._turn = keyframing.turn_all_around if around else keyframing.turn
        matcher = PanoramaMatcher(self.range_max, self.config.matcher)
        self.run = RunMap(self._count, self.config.tracker.matched + 2)
        self.odometry = OdometryModel(self.config.odometry)
        self.tracker = LocalTracker(self.run, matcher, self.odometry, laser, self.config.tracker)
        self.loops = LoopCloser(self.run, self.tracker, matcher, laser.num_beams, self.config.loops)
        self.matcher = matcher
        self.pose = np.zeros(3)
        self.path = 0.0
        self.step = -1
        self._moved = np.zeros(3)  # the robot in the frame of the last keyframe
        self._last = (math.nan, 0.0)  # readings of the distance meter and the heading
        self._nearest = np.zeros((3, self._count))

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
        self.advance(distance, heading)
        if self.is_due:
            self.add_keyframe(ranges)
        back = self.back_at()
        return None if back is None else int(self.run.step[back])

    def advance(self, distance: float, heading: float) -> None:
        """Take the readings of the distance meter and the heading at a step."""
        self.step += 1
        if self.step == 0:
            self._last = (distance, heading)
            self.pose[2] = heading + self._offset
            return
        driven = self.odometry.scale * (distance - self._last[0])
        turn = float(wrap_angle(heading - self._last[1]))
        self._last = (distance, heading)
        self.path += abs(driven)
        # An arc's chord points midway between the headings at its ends.
        for pose in (self._moved, self.pose):
            chord = pose[2] - self._offset + 0.5 * turn
            pose[0] += driven * math.cos(chord)
            pose[1] += driven * math.sin(chord)
            pose[2] = math.remainder(pose[2] + turn, math.tau)

    @property
    def is_due(self) -> bool:
        """Whether the robot has gone or turned far enough for a keyframe."""
        if not self.run.count:
            return True
        spacing = self.config.keyframing.spacing if self.loops.is_near else self._spacing
        return math.hypot(self._moved[0], self._moved[1]) >= spacing or abs(self._moved[2]) >= self._turn

    @property
    def has_keyframe(self) -> bool:
        """Whether the last keyframe was taken at this step."""
        return self.run.count > 0 and self.run.step[-1] == self.step

    def add_keyframe(self, ranges: np.ndarray) -> None:
        """Take a keyframe where the robot is, and correct all poses by what it shows."""
        config, run = self.config.keyframing, self.run
        raw, smooth, scan = spread_beams(ranges, self._beams, self._count), *np.empty((2, self._count))
        despeckle(np.where(raw > 0, np.minimum(raw, self.range_max), self.range_max), smooth)
        keep_steady(raw, smooth, self.range_max, config.steady, scan)
        i = run.add(scan=scan, step=self.step, path=self.path, pose=self.pose, heading=self._last[1])
        moved, self._moved = self._moved, np.zeros(3)
        self.tracker.track(moved)
        if self.laser.sees_all_around:
            (run.panorama[i], run.points[i], run.lines[i]) = self.tracker.scans[-1]
        else:
            first = int(np.searchsorted(run.path, self.path - config.panorama_path))
            first = max(first, i - config.panorama_keyframes)
            merge_scans(run.scan, run.pose, first, i, run.pose[i], self.range_max, self._nearest, run.panorama[i])
            _, run.points[i], run.lines[i] = self.matcher.reference(run.panorama[i])
        signature(run.panorama[i], run.signature[i])
        if self.loops.update():
            self.optimize()
        self.pose = run.pose[i].copy()

    def close_loop(self, earlier: int, found: Registration) -> None:
        """Take it that the last keyframe lies in an earlier one's frame as something else has found."""
        self.run.add_loop(earlier, self.run.count - 1, found)
        self.run.closures += 1
        self.optimize()
        self.pose = self.run.pose[-1].copy()

    def optimize(self) -> None:
        """Fit the poses of all keyframes to all that has been measured."""
        self.run.optimize(self.odometry.heading_information, self.config.keyframing.closure_fit, self.config.pose_graph)

    def back_at(self) -> int | None:
        """Return the nearest keyframe in sight that counts as left, if the robot is on known ground."""
        run, loops, pose = self.run, self.config.loops, self.pose
        if not run.known[-1]:
            return None
        distance = euclidean_distances(run.pose, pose)
        left = revisit_candidates(run.path, self.path, distance, loops.gap, loops.leave)
        back = left[distance[left] < self.config.keyframing.claim_distance]
        back = back[in_sight(run.panorama[-1], run.pose[-1], run.pose[back])]
        for j in back[np.argsort(distance[back], kind="stable")].tolist():
            if in_sight(run.panorama[j], run.pose[j], pose[None])[0]:
                return j
        return None

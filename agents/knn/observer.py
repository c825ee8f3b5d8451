"""Steps 1 to 5 of the paper: from what a robot senses to keyframes, groups and recognized places, whoever drives."""

from __future__ import annotations

import math

import numpy as np

from agents.exploration.visibility import inside
from agents.knn.config import ExplorerConfig
from agents.knn.directions import Group, compass_direction, sector_features
from agents.knn.loop_detector import Detection, make_detector, make_tracker
from agents.slam.keyframes import Keyframes, Paths
from agents.slam.panorama import panorama_beams
from agents.slam.scan_filters import LaserReader, confirm, despeckle, fill
from agents.slam.se2 import compose, euclidean_distances, relative, wrap_angle
from cyclic_env.errors import ConfigError


class LoopObserver:
    """Maps what one robot senses, and recognizes the places that it is back at.

    Parameters
    ----------
    config : ExplorerConfig
    beams : int
        Of the laser.

    Attributes
    ----------
    steps : int
        Readings taken.
    groups : list of Group
        The paper's tables, in the order in which they were begun.
    indicators : list of int
        NI, EI, SI, WI.
    keyframes : Keyframes
        The rows of all tables.
    tracker : PoseTracker
    detector : LoopDetector
    paths : Paths
        The ways from the last keyframe to all others.
    claims : list of (int, int)
        Steps at which the robot was back, and at which step it was there before.
    visited : bool
        Whether the last keyframe's place was known.
    trusted_from : int
        Step from which sensors that were out of order are trusted again, so that claims are made.
    measured, scans, poses : (scans_kept, n), the same and (scans_kept, 3)
        The latest scans all around, newest first: as measured and without speckle, 0 where the laser does not look, and
        where they were taken.

    Raises
    ------
    ConfigError
        If the laser has too few beams for the sectors.
    """

    def __init__(self, config: ExplorerConfig, beams: int) -> None:
        needed = 2 * (config.sectors - 1)
        if beams < needed:
            raise ConfigError(f"the laser has {beams} beams; {config.sectors} sectors need {needed}: set fewer.")
        self.config = config
        self.beams: int | None = beams
        self.steps = 0
        self.direction: int | None = None
        self.indicators = [0, 0, 0, 0]
        self.groups: list[Group] = []
        self.reader = LaserReader(config.laser(beams))
        self._bearings, around = panorama_beams(self.reader.laser)
        self._unseen = np.ones(around, np.bool_)
        self._unseen[self._bearings] = False
        self.keyframes = Keyframes(around, config.sectors, config.keyframes)
        self.tracker = make_tracker(config, self.reader.laser)
        self.detector = make_detector(config, self.tracker)
        self.paths = Paths(np.zeros(0), np.zeros(0, np.int64))
        self.claims: list[tuple[int, int]] = []
        self.visited = False
        self.trusted_from = 0
        kept = config.observer.scans_kept
        self.measured, self.scans, self.poses = np.zeros((kept, around)), np.zeros((kept, around)), np.zeros((kept, 3))
        self._ranges = np.zeros(self.reader.laser.num_beams)

    def observe(self, scan: np.ndarray, distance: float, compass: np.ndarray) -> int | None:
        """Take one step's readings; return the step at which the robot was here before, if it is back somewhere.

        For a robot that something else drives; parameters as for `Agent.decide`.
        """
        self.sense(scan, distance, compass)
        found = self.add_keyframe() if self.ready and self.moved >= self.config.row_spacing else Detection()
        self.steps += 1
        return self.claim(found)

    def sense(self, scan: np.ndarray, distance: float, compass: np.ndarray) -> None:
        """Take one step's readings, and follow the compass's direction."""
        config, driven = self.config, self.tracker.path
        self._ranges = self.reader.read(scan)
        self.tracker.advance(distance, compass)
        advance = self.tracker.path - driven
        if advance > config.observer.advance_max or math.hypot(*compass) < config.observer.compass_min:
            self.trusted_from = self.steps + round(config.observer.distrust / config.dt)
        for kept in (self.measured, self.scans, self.poses):
            kept[1:] = kept[:-1]
        self.measured[0, self._bearings], self.poses[0] = self._ranges, self.tracker.pose
        despeckle(self.measured[0], self.scans[0])
        if self.tracker.follow(self.keyframes, self._ranges):
            self._move_scans()
        # Steps 2 to 4: a change of direction raises the new direction's indicator, and begins a group.
        direction = compass_direction(self.tracker.compass, self.direction)
        if direction != self.direction:
            self.direction = direction
            self.indicators[direction] += 1
            self.groups.append(Group(direction, self.indicators[direction]))

    @property
    def ready(self) -> bool:
        """Whether there are scans enough to confirm a keyframe's by."""
        return self.steps >= self.config.filters.scans_to_confirm

    @property
    def moved(self) -> float:
        """Metres from the last keyframe."""
        if not self.keyframes.count:
            return math.inf
        return math.hypot(*(self.tracker.pose[:2] - self.keyframes.pose[-1, :2]))

    @property
    def turned(self) -> float:
        """Radians by which the heading differs from that of the last keyframe."""
        return abs(wrap_angle(self.tracker.pose[2] - self.keyframes.pose[-1, 2])) if self.keyframes.count else math.inf

    def add_keyframe(self) -> Detection:
        """Add a keyframe where the robot is, and say whether it has been here before."""
        self._add_row()  # Step 1: a row of the group's table
        found = self._compare()  # Step 5: the comparison with earlier tables
        self._move_scans()
        return found

    def _move_scans(self) -> None:
        """Let the latest scans move with the robot, whose pose was corrected."""
        self.poses = compose(self.tracker.pose, relative(self.poses[0], self.poses))

    def claim(self, found: Detection) -> int | None:
        """Return the step that is claimed for what was found, if the sensors are trusted."""
        if found.step is None or self.steps < self.trusted_from:
            return None
        self.claims.append((self.steps, found.step))
        return found.step

    def _add_row(self) -> None:
        config, tracker = self.config, self.tracker
        filters, latest = config.filters, self.scans[0]
        scan, confirmed = latest.copy(), np.zeros(len(latest), np.bool_)
        tolerance, beams = filters.confirm_tolerance, filters.confirm_beams
        for earlier in range(1, filters.scans_to_confirm + 1):
            confirm(latest, tracker.pose, self.scans[earlier], self.poses[earlier], confirmed, tolerance, beams)
        fill(latest, confirmed, scan)
        tracker.add_row(self.keyframes, self._ranges)
        scan[self._unseen] = 0.0 if tracker.panorama is None else tracker.panorama[self._unseen]
        self.scans[0] = scan
        row = self.keyframes.add(
            pose=tracker.pose,
            odometry=tracker.odometry,
            scan=scan,
            features=sector_features(scan, config.sectors, config.rounding),
            direction=self.direction,
            group=len(self.groups) - 1,
            step=self.steps,
            path=tracker.path,
        )
        self.groups[-1].rows.append(row)
        self.paths = self.keyframes.geodesic_distances(row)

    def _compare(self) -> Detection:
        """Ask the detector, correct the track by what it finds, and connect what belongs together."""
        keyframes, tracker = self.keyframes, self.tracker
        last, asked = keyframes.count - 1, self.config.asked_rows
        found = Detection()
        if asked is None or len(self.groups[-1].rows) <= asked:
            found = self.detector.detect(keyframes, tracker, self.paths.distances)
        if found.connects is not None:
            keyframes.connect(found.connects, last)
            tracker.join(found.connects)
            self.paths = keyframes.geodesic_distances(last)
        self._connect_neighbors()
        self.paths = keyframes.geodesic_distances(last)
        self.visited = found.step is not None
        return found

    def _connect_neighbors(self) -> None:
        """Connect the last keyframe to the nearest ones in sight."""
        keyframes, config = self.keyframes, self.config.keyframes
        last = keyframes.count - 1
        euclidean_m = euclidean_distances(keyframes.pose, keyframes.pose[last])
        direct = keyframes.is_direct(self.paths.distances, euclidean_m)
        near = np.flatnonzero((euclidean_m < config.connect_radius) & direct)
        near = near[near < last - 1]
        near = near[np.argsort(euclidean_m[near], kind="stable")][: config.connections]
        seen = np.empty(len(near), np.bool_)
        inside(keyframes.scan[last], keyframes.pose[last], keyframes.pose[near, :2], config.sight_margin, seen)
        for keyframe in near[seen].tolist():
            keyframes.connect(keyframe, last)

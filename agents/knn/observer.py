"""Steps 1 to 5 of the paper: from what a robot senses to keyframes, groups and recognized places, whoever drives."""

from __future__ import annotations

import math

import numpy as np

from agents.exploration.visibility import inside
from agents.knn.config import ExplorerConfig
from agents.knn.directions import Group, compass_direction, sector_features
from agents.knn.loop_detector import Detection, make_detector
from agents.slam.keyframes import Keyframes, Paths
from agents.slam.scan_filters import confirm, despeckle, fill, reliable_endpoints
from agents.slam.scan_matching import ScanMatcher
from agents.slam.se2 import compose, euclidean_distances, relative
from agents.slam.tracker import DeadReckoningTracker, ScanMatchingTracker
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
    measured, scans, poses : (scans_kept, beams), the same and (scans_kept, 3)
        The latest scans, newest first: as measured and without speckle, and where they were taken.

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
        self.keyframes = Keyframes(beams, config.sectors, config.keyframes)
        self.matcher = ScanMatcher(config.range_max, config.matcher)
        self.tracker = (
            ScanMatchingTracker(self.matcher, config.tracker, config.pose_graph)
            if config.match_scans
            else DeadReckoningTracker(config.tracker)
        )
        self.detector = make_detector(config, self.matcher)
        self.paths = Paths(np.zeros(0), np.zeros(0, np.int64))
        self.claims: list[tuple[int, int]] = []
        self.visited = False
        self.trusted_from = 0
        kept = config.observer.scans_kept
        self.measured, self.scans, self.poses = np.zeros((kept, beams)), np.zeros((kept, beams)), np.zeros((kept, 3))

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
        scan = np.fmax(np.fmin(scan, config.range_max), 0.0)  # of a NaN and a number, the number
        self.tracker.advance(distance, compass)
        advance = self.tracker.path - driven
        if advance > config.observer.advance_max or math.hypot(*compass) < config.observer.compass_min:
            self.trusted_from = self.steps + round(config.observer.distrust / config.dt)
        for kept, new in ((self.measured, scan), (self.scans, scan), (self.poses, self.tracker.pose)):
            kept[1:] = kept[:-1]
            kept[0] = new
        despeckle(scan, self.scans[0])
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

    def add_keyframe(self) -> Detection:
        """Add a keyframe where the robot is, and say whether it has been here before."""
        before = self.tracker.pose.copy()
        self._add_row()  # Step 1: a row of the group's table
        found = self._compare()  # Step 5: the comparison with earlier tables
        self.poses = compose(self.tracker.pose, relative(before, self.poses))
        return found

    def claim(self, found: Detection) -> int | None:
        """Return the step that is claimed for what was found, if the sensors are trusted."""
        if found.visited is None or self.steps < self.trusted_from:
            return None
        step = int(self.keyframes.step[found.visited])
        self.claims.append((self.steps, step))
        return step

    def _add_row(self) -> None:
        config, tracker = self.config, self.tracker
        filters, latest = config.filters, self.scans[0]
        scan, confirmed = latest.copy(), np.zeros(len(latest), np.bool_)
        tolerance, beams = filters.confirm_tolerance, filters.confirm_beams
        for earlier in range(1, filters.scans_to_confirm + 1):
            confirm(latest, tracker.pose, self.scans[earlier], self.poses[earlier], confirmed, tolerance, beams)
        fill(latest, confirmed, scan)
        self.scans[0] = scan
        endpoints = reliable_endpoints(scan, self.measured[0], config.range_max, filters)
        tracker.localize(self.keyframes, scan, endpoints, self.paths.distances)
        row = self.keyframes.add(
            pose=tracker.pose,
            odometry=tracker.odometry,
            scan=scan,
            endpoints=endpoints,
            lines=self.matcher.wall_lines(endpoints),
            features=sector_features(scan, config.sectors, config.rounding),
            compass=tracker.compass,
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
        if found.loop is not None:
            tracker.add_loop_closure(keyframes, found.loop)
            found.visited = self.detector.locate(keyframes, tracker)
        tracker.relax(keyframes)
        if found.connects is not None:
            self.paths = keyframes.geodesic_distances(last)
        self._connect_neighbors()
        self.paths = keyframes.geodesic_distances(last)
        self.visited = found.visited is not None
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

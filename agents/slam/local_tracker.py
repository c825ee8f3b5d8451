"""The track of a robot: each scan matched with those 1, 2, 4 and 8 keyframes before it."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from agents.component_config import ComponentConfig
from agents.slam.local_graph import optimize_window
from agents.slam.odometry import OdometryModel
from agents.slam.registration import PanoramaMatcher, Registration
from agents.slam.run_map import RunMap
from agents.slam.scan_matching import Reference
from agents.slam.se2 import compose, relative
from cyclic_env.config import LaserConfig

TURNS = np.radians([0, 6, -6, 12, -12, 18, -18, 25, -25, 32, -32])
"""Headings that are tried about the expected one while no match holds it: wheels slip most where a robot turns. Scans
all around overlap so much that the others are tried only if the expected one fails."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LocalTrackerConfig(ComponentConfig):
    """What is expected of the wheels, and which matches are taken. Tuned on simulated logs."""

    guess_position_std: float = 0.1
    guess_heading_std: float = math.radians(4)
    """Of the track against a keyframe a little further back."""
    matched: int = 4
    """Earlier keyframes that are matched: those 1, 2, 4, ... before."""
    matched_all_around: int = 2
    """The same where the laser sees all around, and each match tells more."""
    path_max: float = 8.0
    """Way to the farthest of them."""
    wide_min: float = 0.75
    seen_share: float = 0.22
    correction_max: float = 0.5
    """A match is taken if that share of endpoints agrees, as many as that share of the laser's beams, and it moves the
    robot by less than so many metres."""
    window: int = 16
    """Keyframes whose poses are fitted anew at each keyframe."""


class LocalTracker:
    """Ties each keyframe to those before, and fits the last ones together.

    Parameters
    ----------
    run : RunMap
    matcher : PanoramaMatcher
    odometry : OdometryModel
    laser : LaserConfig
    config : LocalTrackerConfig

    Attributes
    ----------
    scans : deque of Reference
        Of the latest keyframes.
    """

    def __init__(
        self,
        run: RunMap,
        matcher: PanoramaMatcher,
        odometry: OdometryModel,
        laser: LaserConfig,
        config: LocalTrackerConfig,
    ) -> None:
        self.run, self.matcher, self.odometry, self.config = run, matcher, odometry, config
        self._seen_min, self._all_around = config.seen_share * laser.num_beams, laser.sees_all_around
        self._matched = config.matched_all_around if laser.sees_all_around else config.matched
        self._step_information = np.diag(odometry.std**-2)
        position, heading = config.guess_position_std, config.guess_heading_std
        self._guess_std = np.array([position, position, heading])
        size = 3 * (config.window + 1)
        self._scratch = np.zeros((size, size)), np.zeros(size)
        self.scans: deque[Reference] = deque(maxlen=2 ** (config.matched - 1) + 1)

    def track(self, odometry: np.ndarray) -> None:
        """Find the pose of the last keyframe, whose pose in the frame of the one before is `odometry` by the wheels."""
        run, config = self.run, self.config
        i = run.count - 1
        self.scans.append(self.matcher.reference(run.scan[i]))
        if i == 0:
            return
        run.pose[i] = compose(run.pose[i - 1], odometry)
        run.sources[i, 0], run.measured[i, 0], run.information[i, 0] = i - 1, odometry, self._step_information
        held = False
        for slot in range(1, self._matched + 1):
            j = i - 2 ** (slot - 1)
            if j < 0 or run.path[i] - run.path[j] > config.path_max:
                break
            found = self._match(slot, j, held)
            if found is None:
                continue
            run.set_edge(i, slot, j, found)
            if slot == 1:
                self.odometry.learn(odometry, found)
            if not held:
                run.pose[i] = compose(run.pose[j], found.pose)
            held = True
        self.fit()

    def _match(self, slot: int, j: int, held: bool) -> Registration | None:
        """Return how the last keyframe's scan matches that of keyframe j, if it does."""
        run, config, model = self.run, self.config, self.odometry
        expected = relative(run.pose[j], run.pose[-1])
        std = model.std if slot == 1 else self._guess_std
        rounds = (TURNS[:1],) if held else (TURNS[:1], TURNS[1:]) if self._all_around else (TURNS,)
        reference = self.scans[j - run.count]
        for turns in rounds:
            starts = expected + np.column_stack([np.zeros((len(turns), 2)), turns])
            found = self.matcher.match(reference, run.scan[-1], starts, std)
            agrees = found.wide > config.wide_min and found.seen > self._seen_min
            if agrees and math.hypot(*(found.pose[:2] - expected[:2])) < config.correction_max:
                return found
        return None

    def fit(self) -> None:
        """Fit the poses of the last keyframes to their edges, the earlier ones held fast."""
        run = self.run
        edges = run.sources, run.measured, run.information
        first = max(1, run.count - self.config.window)
        optimize_window(run.pose, first, edges, *self._scratch)

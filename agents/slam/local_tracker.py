"""The track of a robot whose heading drifts: each scan matched with those 1, 2, 4 and 8 keyframes before it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from agents.component_config import ComponentConfig
from agents.slam.local_graph import optimize_window
from agents.slam.registration import PanoramaMatcher
from agents.slam.run_map import RunMap
from agents.slam.scan_matching import Reference
from agents.slam.se2 import compose, relative

TURNS = np.radians([0, 6, -6, 12, -12, 18, -18, 25, -25, 32, -32])
"""Headings that are tried about the expected one while no match holds it: wheels slip most where a robot turns."""
KEPT = 16
"""Scans whose wall lines are kept."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LocalTrackerConfig(ComponentConfig):
    """What is expected of the wheels, and which matches are taken. Tuned on simulated logs."""

    step_position_std: float = 0.05
    step_heading_std: float = math.radians(4)
    """Of the wheels' odometry from one keyframe to the next."""
    guess_position_std: float = 0.1
    guess_heading_std: float = math.radians(4)
    """Of the track against a keyframe a little further back."""
    matched: int = 4
    """Earlier keyframes that are matched: those 1, 2, 4, ... before."""
    path_max: float = 8.0
    """Way to the farthest of them."""
    wide_min: float = 0.75
    seen_min: int = 40
    correction_max: float = 0.5
    """A match is taken if so many endpoints agree, and it moves the robot by less than so many metres."""
    window: int = 16
    """Keyframes whose poses are fitted anew at each keyframe."""


class LocalTracker:
    """Ties each keyframe to those before, and fits the last ones together.

    Parameters
    ----------
    run : RunMap
    matcher : PanoramaMatcher
    config : LocalTrackerConfig
    """

    def __init__(self, run: RunMap, matcher: PanoramaMatcher, config: LocalTrackerConfig) -> None:
        self.run, self.matcher, self.config = run, matcher, config
        position, heading = config.step_position_std, config.step_heading_std
        self._step_std = np.array([position, position, heading])
        position, heading = config.guess_position_std, config.guess_heading_std
        self._guess_std = np.array([position, position, heading])
        size = 3 * (config.window + 1)
        self._scratch = np.zeros((size, size)), np.zeros(size)
        self._lines = np.zeros((KEPT, run.scan.shape[1], 3))

    def track(self, odometry: np.ndarray) -> None:
        """Find the pose of the last keyframe, whose pose in the frame of the one before is `odometry` by the wheels."""
        run, config = self.run, self.config
        i = run.count - 1
        self._lines[i % KEPT] = self.matcher.wall_lines(run.scan[i])
        if i == 0:
            return
        run.pose[i] = compose(run.pose[i - 1], odometry)
        run.sources[i, 0], run.measured[i, 0], run.information[i, 0] = i - 1, odometry, np.diag(self._step_std**-2)
        held = False
        for slot in range(1, config.matched + 1):
            j = i - 2 ** (slot - 1)
            if j < 0 or run.path[i] - run.path[j] > config.path_max:
                continue
            expected = relative(run.pose[j], run.pose[i])
            starts = expected[None] if held else expected + np.column_stack([np.zeros((len(TURNS), 2)), TURNS])
            std = self._step_std if slot == 1 else self._guess_std
            found = self.matcher.match(Reference(run.scan[j], self._lines[j % KEPT]), run.scan[i], starts, std)
            correction = math.hypot(*(found.pose[:2] - expected[:2]))
            if found.wide > config.wide_min and found.seen > config.seen_min and correction < config.correction_max:
                run.set_edge(i, slot, j, found)
                if not held:
                    run.pose[i] = compose(run.pose[j], found.pose)
                held = True
        self.fit()

    def fit(self) -> None:
        """Fit the poses of the last keyframes to their edges, the earlier ones held fast."""
        run = self.run
        edges = run.sources, run.measured, run.information
        first = max(1, run.count - self.config.window)
        optimize_window(run.pose, first, edges, run.heading, run.heading_information, *self._scratch)

"""Loop-closure detectors that read a robot's log and make claims."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from agents.knn.config import preset
from agents.knn.observer import LoopObserver
from agents.knn.similarity import measure_by_name
from agents.slam.mapper import MapperConfig
from agents.slam.panorama import signature_distances
from agents.watcher import LoopWatcher
from cyclic_env import ClosureConfig, RobotConfig, RobotLog
from cyclic_env.trajectory.poses import compose, relative

CLIPPED = 10.0
"""Metres to which ranges are clipped before raw scans are compared."""
SECTORS = 7
MAP_RANGE = 15.0
"""Maximum range, in metres, of the endpoints in the map that is drawn."""
RADIUS = 2.5
"""Metres within which the position detector claims: half a metre less than the radius of a revisit."""


@dataclass(kw_only=True, eq=False)
class Detection:
    """What a detector found in a log.

    Attributes
    ----------
    claims : (m, 2) int
        Pairs of scans: the one at which the robot is said to be back, and the earlier one.
    scores : (m,) or None
        Confidence in each claim; higher is surer.
    track : (n, 3) or None
        Final estimate of the robot's pose at each scan, in a frame of its own.
    points : (k, 2) or None
        Endpoints of scans in that frame: the map.
    seconds : list of float
        Computing time of each scan.
    """

    claims: np.ndarray
    scores: np.ndarray | None = None
    track: np.ndarray | None = None
    points: np.ndarray | None = None
    edges: list[Any] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)


def detect(name: str, log: RobotLog, gate: float, progress: Callable[[Any], Any] = lambda scans: scans) -> Detection:
    """Run a detector on a log.

    A claim belongs to the step that follows the observation, as in an environment.

    Parameters
    ----------
    name : str
        One of `DETECTORS`.
    log : RobotLog
    gate : float
        For the mapper: the maximum distance of candidates, as a share of the path to them.
    progress : callable, optional
        Wraps an iteration over the log's scans.
    """
    return DETECTORS[name](log, gate, progress)


def _readings(log: RobotLog, progress: Callable[[Any], Any]) -> Iterator[tuple[np.ndarray, float, np.ndarray]]:
    """Yield the arguments of `Agent.decide` for each scan but the last, which no step follows to claim in."""
    observed = {name: values.astype(np.float64) for name, values in log.observations().items()}
    for i in progress(range(len(log) - 1)):
        yield observed["laser"][i], float(observed["distance"][i, 0]), observed["compass"][i]


def _by_mapper(log: RobotLog, gate: float, progress: Callable[[Any], Any]) -> Detection:
    """Claim as the watcher of `agents.watcher` does, with panoramas, sets of matches and a pose graph."""
    config = MapperConfig()
    watcher = LoopWatcher(log.laser, replace(config, loops=replace(config.loops, gate_share=gate)))
    seconds = []
    for reading in _readings(log, progress):
        began = time.perf_counter()
        watcher.decide(*reading)
        seconds.append(time.perf_counter() - began)
    run = watcher.mapper.run
    last = np.searchsorted(run.step, np.arange(len(log)), side="right") - 1
    moved = relative(log.odometry[run.step[last]], log.odometry)
    track = compose(run.pose[last], moved)
    return Detection(
        claims=_pairs(watcher.claims),
        track=track,
        points=_endpoints(log, track),
        edges=[
            (int(run.step[loop.earlier]), int(run.step[loop.later]), loop.measured, loop.information)
            for loop in run.loops
        ],
        seconds=seconds,
    )


def _by_paper(log: RobotLog, gate: float, progress: Callable[[Any], Any]) -> Detection:
    """Claim by the paper's tables of rows, by position and appearance, as in the preset ``paper``."""
    observer = LoopObserver(preset("paper").fitted(log.laser, RobotConfig()), log.laser.num_beams)
    for reading in _readings(log, progress):
        observer.observe(*reading)
    return Detection(claims=_pairs(observer.claims))


def _by_position(log: RobotLog, gate: float, progress: Callable[[Any], Any]) -> Detection:
    """Claim by odometry alone: the nearest earlier position that the robot has left since."""
    rules, path = ClosureConfig(), _path(log)
    claims, scores = [], []
    for i in progress(range(len(log) - 1)):
        away = np.hypot(*(log.odometry[: i + 1, :2] - log.odometry[i, :2]).T)
        left = (path[i] - path[: i + 1] >= rules.gap) & (np.maximum.accumulate(away[::-1])[::-1] >= rules.leave_radius)
        nearest = int(np.argmin(np.where(left, away, np.inf)))
        if left.any() and away[nearest] < RADIUS:
            claims.append((i + 1, nearest))
            scores.append(-away[nearest])
    return Detection(claims=_pairs(claims), scores=np.array(scores))


def _by_scans(log: RobotLog, gate: float, progress: Callable[[Any], Any]) -> Detection:
    """Claim by raw scans: the least mean difference of the ranges, beam by beam."""
    ranges = np.minimum(log.observations()["laser"], CLIPPED)
    return _most_alike(log, lambda i, earlier: -np.abs(ranges[earlier] - ranges[i]).mean(axis=1), progress)


def _by_sectors(log: RobotLog, gate: float, progress: Callable[[Any], Any]) -> Detection:
    """Claim by features like the paper's: the cosine of the rounded least ranges of seven sectors."""
    sectors = np.array_split(log.observations()["laser"].astype(np.float64), SECTORS, axis=1)
    features = np.column_stack([np.rint(ranges.min(axis=1) / preset("paper").rounding) for ranges in sectors])
    cosine = measure_by_name("cosine")
    rows = cosine.prepare(features)
    return _most_alike(log, lambda i, earlier: 1 - cosine.compare(rows[earlier], rows[i]), progress)


def _by_panorama(log: RobotLog, gate: float, progress: Callable[[Any], Any]) -> Detection:
    """Claim by the signatures of the mapper's panoramas at any rotation: appearance alone, without a gate."""
    watcher = LoopWatcher(log.laser)
    for reading in _readings(log, progress):
        watcher.decide(*reading)
    run = watcher.mapper.run
    number = np.full(len(log), -1)
    number[run.step] = np.arange(run.count)
    any_turn = run.signature.shape[1] // 2

    def likeness(i: int, earlier: np.ndarray) -> np.ndarray:
        rows, unlike = number[earlier], np.full(len(earlier), np.inf)
        known = np.flatnonzero(rows >= 0)
        if number[i] >= 0 and len(known):
            found = np.empty(len(known))
            mine = run.signature[number[i]]
            signature_distances(run.signature, run.pose[:, 2], rows[known], mine, 0.0, any_turn, found)
            unlike[known] = found
        return -unlike

    return _most_alike(log, likeness, progress)


def _most_alike(
    log: RobotLog, likeness: Callable[[int, np.ndarray], np.ndarray], progress: Callable[[Any], Any]
) -> Detection:
    """At every scan, claim the most similar one among those that are far enough back along the path."""
    path, gap = _path(log), ClosureConfig().gap
    claims, scores = [], []
    for i in progress(range(len(log) - 1)):
        earlier = np.arange(int(np.searchsorted(path, path[i] - gap, side="right")))
        if len(earlier):
            alike = likeness(i, earlier)
            best = int(np.argmax(alike))
            if np.isfinite(alike[best]):
                claims.append((i + 1, best))
                scores.append(float(alike[best]))
    return Detection(claims=_pairs(claims), scores=np.array(scores))


DETECTORS = {
    "mapper": _by_mapper,
    "paper": _by_paper,
    "position": _by_position,
    "scans": _by_scans,
    "sectors": _by_sectors,
    "panorama": _by_panorama,
}
"""The detectors by name."""


def _pairs(claims: list[tuple[int, int]]) -> np.ndarray:
    return np.array(claims, np.int64).reshape(-1, 2)


def _path(log: RobotLog) -> np.ndarray:
    """Return the path length at each scan by the odometry, metres."""
    step = np.diff(log.odometry[:, :2], axis=0)
    return np.append(0.0, np.cumsum(np.hypot(step[:, 0], step[:, 1])))


def _endpoints(log: RobotLog, track: np.ndarray) -> np.ndarray:
    """Return the endpoints `(k, 2)` of the scans, taken at poses `(n, 3)` of the robot."""
    rows, beams = np.nonzero(log.ranges < min(MAP_RANGE, log.laser.range_max))
    lasers = compose(track, np.array([*log.laser_position, 0.0]))[rows]
    angles = lasers[:, 2] + log.laser.bearings[beams]
    return lasers[:, :2] + log.ranges[rows, beams][:, None] * np.column_stack([np.cos(angles), np.sin(angles)])

"""Whether the robot is on known ground, and where: sets of matches that bear each other out close a loop."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from agents.component_config import ComponentConfig
from agents.slam.consistency import find_consistent, grow_set
from agents.slam.keyframes import revisit_candidates
from agents.slam.local_tracker import LocalTracker
from agents.slam.panorama import signature_distances
from agents.slam.registration import PanoramaMatcher, Registration
from agents.slam.run_map import RunMap
from agents.slam.se2 import compose, euclidean_distances, relative, wrap_angle

SEARCH = np.array([(x, 0.0, math.radians(turn)) for x in (0, -1, 1, -2, 2) for turn in (0, 7, -7, 14, -14)])
"""Where a panorama is tried about a candidate: the best of these are matched."""
SEARCH_STD = np.array([1.0, 1.0, math.radians(10)])
HOLD_STD = np.array([0.3, 0.3, math.radians(5)])


SIGHT_HALF_WIDTH = 0.2
"""Metres; see `in_sight`."""
NEAR = 0.3
"""Metres from a pose within which all is in sight."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LoopCloserConfig(ComponentConfig):
    """When a loop is closed and known ground is held. Tuned on simulated logs."""

    gap: float = 20.1
    leave: float = 10.1
    """Metres driven since a keyframe, and been away in between, from which the robot can be back: a little more than
    a revisit needs."""
    detour: float = 6.0
    """A keyframe is known ground if the way there is longer than the straight line by no more."""
    familiar: float = 40.0
    """With a way that short a single match that would close a loop is enough."""
    near: float = 3.0
    """Radius of known ground."""
    gate_share: float = 0.06
    gate_min: float = 2.0
    gate_max: float = 40.0
    """Distance of candidates: a share of the way to them, at least and at most so many metres."""
    candidates: int = 8
    candidate_spacing: float = 1.0
    """How many candidates are matched at a keyframe, the most alike first, and the way between them."""
    starts: int = 3
    """From how many starts each is matched."""
    close_wide: float = 0.85
    close_tight: float = 0.75
    hold_wide: float = 0.70
    hold_tight: float = 0.55
    seen_share: float = 0.33
    """Shares of endpoints that agree in a match that may close a loop, and in one on known ground, and how many these
    must be, as a share of the laser's beams."""
    offset_max: float = 2.5
    """Distance between two panoramas that are matched, at most."""
    correction_max: float = 1.0
    """By how much a match on known ground may move the robot."""
    set_path: float = 15.0
    """Way over which matches are collected."""
    set_size: float = 6.0
    set_span: float = 2.5
    set_firm: float = 3.0
    """How many keyframes' matches must agree, over what way, and how many of them must tell both directions."""
    firm: float = 6.0
    """Endpoints that tell each direction in such a match."""
    position_error: float = 0.5
    heading_error: float = math.radians(4)
    position_drift: float = 0.03
    heading_drift: float = math.radians(0.3)
    """By how much two matches that agree may differ, and how much more for each metre driven between them."""
    drift: float = 0.006
    drift_min: float = 0.5
    """Share of the way by which the track is expected to err, and metres: the drift of closed loops raises it."""
    surprise_min: float = 0.5
    surprise_max: float = 3.0
    """A closure that moves the track by more than is expected needs that many times the evidence, at least the first;
    one that moves it by more than the second times what is expected is not made, since it leads to a place that
    looks alike."""
    rival_distance: float = 1.5
    rival_heading: float = 0.35
    rival_margin: float = 2.0
    rival_share: float = 0.6
    """What another set may be worth at most that puts the robot elsewhere."""
    lost_after: int = 4
    lost_radius: float = 6.0
    """After so many failures to hold known ground it is searched for around."""
    relax_after: float = 0.3
    """Metres by which known ground has moved the track before all poses are fitted anew."""


BY_APPEARANCE: dict[str, float] = {
    "near": 0.0,
    "detour": 0.0,
    "familiar": 0.0,
    "gate_min": 1e4,
    "gate_max": 1e4,
    "surprise_min": 1.0,
    "drift_min": 1e4,
}
"""Changes of a `LoopCloserConfig` with which the track says nothing of where the robot may be back."""
NEVER: dict[str, float] = {"familiar": 0.0, "candidates": 0}
"""Changes with which no loop is closed."""


class Candidate(NamedTuple):
    """A match that may close a loop."""

    later: int
    earlier: int
    found: Registration


class LoopCloser:
    """Holds the track on known ground, and finds the way back to it.

    Parameters
    ----------
    run : RunMap
    tracker : LocalTracker
    matcher : PanoramaMatcher
    beams : int
        Of the laser.
    config : LoopCloserConfig

    Attributes
    ----------
    drift : float
        Share of the way by which the track errs, as the loops have shown.
    closed : list of (int, int)
        The loops: keyframes, the later one first.
    is_near : bool
        Whether the last keyframe matches some that the robot may have come back to, so that a loop may be closed soon.
    compared : int
        Comparisons of two keyframes' signatures so far.
    """

    def __init__(
        self, run: RunMap, tracker: LocalTracker, matcher: PanoramaMatcher, beams: int, config: LoopCloserConfig
    ) -> None:
        self.run, self.tracker, self.matcher, self.config = run, tracker, matcher, config
        self._seen_min = config.seen_share * beams
        self.drift = config.drift
        self.closed: list[tuple[int, int]] = []
        self._pending: list[Candidate] = []
        self.is_near = False
        self.compared = 0
        self._failures = 0
        self._correction = np.zeros(2)
        self._limits = np.array(
            [config.position_error, config.heading_error, config.position_drift, config.heading_drift]
        )

    def update(self) -> bool:
        """Look where the last keyframe is; return whether all poses should be fitted anew."""
        run, config = self.run, self.config
        i = run.count - 1
        euclidean_m = euclidean_distances(run.pose, run.pose[i])
        back = revisit_candidates(run.path, run.path[-1], euclidean_m, config.gap, config.leave)
        self.is_near = False
        if not len(back):
            return False
        geodesic_m = run.geodesic_distances(i).distances
        direct = geodesic_m <= euclidean_m + config.detour
        near = back[(direct[back] | (geodesic_m[back] < config.familiar)) & (euclidean_m[back] < config.near)]
        near = near[in_sight(run.panorama[i], run.pose[i], run.pose[near])]
        if len(near):
            j = int(near[np.argmin(euclidean_m[near])])
            self._hold(i, j, bool(direct[j]))
        gate = np.clip(config.gate_share * geodesic_m[back], config.gate_min, config.gate_max)
        candidates = back[~direct[back] & (euclidean_m[back] < gate)]
        if self._failures >= config.lost_after:
            candidates = back[euclidean_m[back] < np.maximum(gate, config.lost_radius)]
        found = self._search(i, candidates)
        self._pending = [p for p in self._pending if run.path[i] - run.path[p.later] < config.set_path] + found
        if found and self._agree(i, geodesic_m):
            return True
        self.is_near = bool(found)
        relaxes = math.hypot(*self._correction) > config.relax_after
        if relaxes:
            self._correction = np.zeros(2)
        return relaxes

    def _match(self, j: int, i: int, starts: np.ndarray, std: np.ndarray) -> Registration:
        run = self.run
        return self.matcher.match(run.reference(j), run.panorama[i], starts, std)

    def _hold(self, i: int, j: int, direct: bool) -> None:
        """Tie the last keyframe to known ground, if it matches."""
        run, config = self.run, self.config
        expected = relative(run.pose[j], run.pose[i])
        found = self._match(j, i, expected[None], HOLD_STD)
        wide, tight = (config.hold_wide, config.hold_tight) if direct else (config.close_wide, config.close_tight)
        moved = math.hypot(*(found.pose[:2] - expected[:2]))
        agrees = found.wide > wide and found.tight > tight and found.seen > self._seen_min
        if not agrees or moved >= config.correction_max:
            self._failures += 1
            return
        run.set_edge(i, -1, j, found)
        self.tracker.odometry.learn_loop(run.heading[j], run.heading[i], found)
        run.closure[i] = run.closures - 1
        run.connect(j, i)
        before = run.pose[i, :2].copy()
        self.tracker.fit()
        self._correction += run.pose[i, :2] - before
        run.known[i] = True
        self._failures = 0

    def _search(self, i: int, candidates: np.ndarray) -> list[Candidate]:
        """Return the matches of the last keyframe with the candidates that look most like it."""
        run, config = self.run, self.config
        unlike = np.empty(len(candidates))
        self.compared += len(candidates)
        signature_distances(run.signature, run.pose[:, 2], candidates, run.signature[i], run.pose[i, 2], 2, unlike)
        picked: list[int] = []
        for q in np.argsort(unlike, kind="stable"):
            if not np.isfinite(unlike[q]) or len(picked) == config.candidates:
                break
            if (np.abs(run.path[candidates[q]] - run.path[picked]) > config.candidate_spacing).all():
                picked.append(int(candidates[q]))
        found = []
        for j in picked:
            expected = relative(run.pose[j], run.pose[i])
            expected[:2] /= max(1.0, math.hypot(expected[0], expected[1]))  # near it, whatever the track says
            starts = self.matcher.likely_starts(run.panorama[j], run.panorama[i], expected + SEARCH, config.starts)
            match = self._match(j, i, starts, SEARCH_STD)
            agrees = match.wide > config.close_wide and match.tight > config.close_tight
            if agrees and match.seen > self._seen_min and math.hypot(*match.pose[:2]) < config.offset_max:
                found.append(Candidate(i, j, match))
        return found

    def _agree(self, i: int, geodesic_m: np.ndarray) -> bool:
        """Close a loop if enough matches agree about where the robot is, and clearly more than about elsewhere."""
        run, config, pending = self.run, self.config, self._pending
        later, earlier = np.array([(p.later, p.earlier) for p in pending]).T
        measured = np.array([p.found.pose for p in pending])
        now = compose(compose(run.pose[earlier], measured), relative(run.pose[later], run.pose[i]))
        agrees = np.zeros((len(pending), len(pending)), np.bool_)
        find_consistent(now, later, run.path[later], self._limits, agrees)
        sets = [_grown(agrees, start) for start in range(len(pending))]
        # What a set is worth: the more it would move the track beyond what is expected, the less.
        moved = euclidean_distances(now, run.pose[i])
        expected = config.drift_min + self.drift * geodesic_m[earlier]
        surprise = np.maximum(moved / expected, config.surprise_min)
        worth = np.array([len(members) for members in sets]) / surprise
        agreement = np.array([p.found.wide + 0.5 * p.found.tight for p in pending])
        latest = np.flatnonzero(later == i)
        best = latest[np.lexsort([-agreement[latest], -worth[latest]])[0]]
        elsewhere = euclidean_distances(now, now[best]) > config.rival_distance
        elsewhere |= np.abs(wrap_angle(now[:, 2] - now[best, 2])) > config.rival_heading
        rival = worth[elsewhere].max(initial=0.0)
        members = sets[best]
        firm = sum(pending[k].found.min_eigenvalue > config.firm for k in members)
        span = run.path[i] - run.path[later[members]].min()
        if (
            worth[best] < max(config.set_size, rival + config.rival_margin, rival / config.rival_share)
            or firm < surprise[best] * config.set_firm
            or span < surprise[best] * config.set_span
            or surprise[best] > config.surprise_max
        ):
            return False
        for before, after, found in ((pending[k].earlier, pending[k].later, pending[k].found) for k in members):
            run.add_loop(before, after, found)
            self.tracker.odometry.learn_loop(float(run.heading[before]), float(run.heading[after]), found)
        run.closures += 1
        self.closed.append((i, int(earlier[best])))
        unexpected = moved[best] - config.drift_min
        self.drift = max(self.drift, float(unexpected / geodesic_m[earlier[best]]))
        self._pending, self._correction = [], np.zeros(2)
        run.known[i] = True
        return True


def _grown(agrees: np.ndarray, start: int) -> np.ndarray:
    """Return the members of the set of matches that grows from one."""
    members, scratch = np.zeros(len(agrees), np.int64), np.zeros(len(agrees), np.bool_)
    return members[: grow_set(agrees, start, members, scratch)]


def in_sight(panorama: np.ndarray, pose: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return which of the poses `(m, 3)` a panorama at a pose sees, `(m,)`; where it didn't look, it sees nothing.

    The line of sight must be `SIGHT_HALF_WIDTH` from all walls, for the track may err by as much.
    """
    n = len(panorama)
    offset = relative(pose, others)
    distance = np.hypot(offset[:, 0], offset[:, 1])
    beams = np.rint(np.arctan2(offset[:, 1], offset[:, 0]) * n / math.tau).astype(np.int64)
    aside = np.arcsin(SIGHT_HALF_WIDTH / np.maximum(distance, NEAR)) * n / math.tau
    reach = max(1, round(n / 90), math.ceil(aside.max(initial=0.0)))
    steps = np.arange(-reach, reach + 1)
    around = panorama[(beams[:, None] + steps) % n]
    asked = np.abs(steps) <= np.maximum(max(1, round(n / 90)), aside[:, None])
    nearest = np.where((around > 0) & asked, around, np.inf).min(axis=1)
    return (distance < NEAR) | (np.isfinite(nearest) & (nearest > distance + 0.1))

"""What robots make of their observations: tracks, maps, candidates to claim, and the features of all these."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from agents.rl.headings.grid import (
    UNREACHED,
    Ahead,
    Grid,
    SearchScratch,
    allocate_grid,
    allocate_search_scratch,
    clear_map,
    draw_scan,
    search,
)
from agents.rl.headings.tracking import (
    AT_KEYFRAME,
    KEYFRAME_SPACING,
    MENDS_BELOW,
    MENDS_EIGENVALUE,
    MENDS_INLIERS,
    ROBOT,
    SAME_SHIFT,
    REDRAW,
    Keyframes,
    MatchScratch,
    add_keyframe,
    allocate_keyframes,
    allocate_match_scratch,
    dead_reckon,
    enlarged,
    localize,
    match_keyframe,
    mend,
    set_prior,
    wrap,
)
from agents.slam.scan_filters import SOUND, SOUND_NOISE, clear_beam, clear_lengths, despeckle
from agents.slam.tracker import DRIFT
from cyclic_env.config import ClosureConfig, LaserConfig, RobotConfig
from cyclic_env.jit import compiled

HEADINGS = 16
"""Headings to choose from, relative to the robot's, counter-clockwise."""
CANDIDATES = 3
"""Most places that can be claimed at a time."""
HOLD = 5
"""Steps of the environment for which a decision holds: a second."""
PER_HEADING, PER_CANDIDATE, PER_ROBOT = 6, 10, 10
"""Features of each heading, of each candidate, and of the robot as a whole."""
BEAMS_MIN, BEAMS_MAX = 60, 120
"""Beams of a scan that are matched: where the laser has more, evenly spaced ones."""
MARGIN = 0.5
"""Metres by which a candidate must have been left for longer, and farther, than the rules of closure ask for."""
GATE_MIN, GATE_MAX = 3.0, 12.0
"""Metres from the track within which keyframes are candidates, at least and at most."""
CANDIDATE_SPACING = 2.5
"""Metres between two candidates."""
PRIOR_DISTANCE = 2.0
"""Metres from a candidate at which its match begins, at most."""
PRIOR_SPREAD = (2.0, 2.0, 0.1)
"""Standard deviations of the robot's pose about a candidate, metres, metres and radians."""
RIVAL_DISTANCE, RIVAL_BELOW = 1.5, 0.08
"""A match that calls for a pose so many metres away rivals one whose inlier ratio is better by less than that."""
FRESH = 3.0
"""Metres driven after which a match that has not been confirmed is forgotten."""
CLEARANCE = 0.06
"""Metres beside the robot that a way must be wider than it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Rules:
    """What the features depend on: the laser, the robot, and what counts as being back."""

    laser: LaserConfig = LaserConfig()
    robot: RobotConfig = RobotConfig()
    closure: ClosureConfig = ClosureConfig()

    @property
    def stride(self) -> int:
        """Every how many-th beam is matched."""
        beams = self.laser.num_beams
        strides = [s for s in range(1, beams + 1) if beams % s == 0 and BEAMS_MIN <= beams // s <= BEAMS_MAX]
        return min(strides, default=1)


class Limits(NamedTuple):
    """The rules as the compiled code takes them."""

    range_max: float
    half_width: float
    advance_max: float
    gap: float
    leave: float
    claim_spacing: float
    stride: int


class Memory(NamedTuple):
    """What is kept of N robots, and what was measured and made of it last."""

    robots: np.ndarray
    keyframes: Keyframes
    grid: Grid
    laser: np.ndarray
    scans: np.ndarray
    endpoints: np.ndarray
    clear: np.ndarray
    headings: np.ndarray
    candidates: np.ndarray
    robot: np.ndarray
    candidate_keyframes: np.ndarray


class Scratch(NamedTuple):
    """Working memory of one thread."""

    match: MatchScratch
    search: SearchScratch
    ahead: Ahead
    steering: np.ndarray
    steering_clear: np.ndarray
    matched: np.ndarray


class Perception:
    """The memory of N robots, and features of it; rows do not depend on each other.

    Parameters
    ----------
    robots : int
    rules : Rules

    Attributes
    ----------
    memory : Memory
        Its `headings` `(N, HEADINGS, PER_HEADING)`, `candidates` `(N, CANDIDATES, PER_CANDIDATE)` and `robot`
        `(N, PER_ROBOT)`, float32, are the features; see `CyclicLoopHeadingsEnv` for what they are.
    """

    def __init__(self, robots: int, rules: Rules) -> None:
        beams, stride = rules.laser.num_beams, rules.stride
        self.rules = rules
        self._matched_beams = beams // stride
        self._limits = Limits(
            range_max=rules.laser.range_max,
            half_width=rules.robot.radius + CLEARANCE,
            advance_max=rules.robot.advance_max * HOLD,
            gap=rules.closure.gap + MARGIN,
            leave=rules.closure.leave_radius + MARGIN,
            claim_spacing=rules.closure.claim_spacing,
            stride=stride,
        )
        self.memory = Memory(
            robots=np.zeros(robots, ROBOT),
            keyframes=allocate_keyframes(robots, self._matched_beams),
            grid=allocate_grid(robots),
            laser=np.zeros((robots, beams)),
            scans=np.zeros((robots, beams)),
            endpoints=np.zeros((robots, beams)),
            clear=np.zeros((robots, beams)),
            headings=np.zeros((robots, HEADINGS, PER_HEADING), np.float32),
            candidates=np.zeros((robots, CANDIDATES, PER_CANDIDATE), np.float32),
            robot=np.zeros((robots, PER_ROBOT), np.float32),
            candidate_keyframes=np.full((robots, CANDIDATES), -1),
        )
        self._scratches: list[Scratch] = []
        self._threads: ThreadPoolExecutor | None = None

    def begin(self, rows: np.ndarray) -> None:
        """Forget everything of the robots `rows`, whose episodes begin."""
        begin_rows(self.memory, rows)

    def sense(self, observation: dict[str, np.ndarray], rows: np.ndarray) -> None:
        """Take the observation of a step, of the robots `rows`."""
        self.memory.laser[rows] = observation["laser"][rows]
        distance, compass = observation["distance"].astype(np.float64), observation["compass"].astype(np.float64)
        sense_rows(self.memory, distance, compass, rows)

    def decide(self, headings: np.ndarray, rows: np.ndarray) -> None:
        """Set the headings `(n,)` that the robots `rows` are to drive to."""
        robots = self.memory.robots
        robots["target"][rows] = robots["heading"][rows] + headings * (2 * math.pi / HEADINGS)

    def claim(self, choices: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return which of the robots `rows` claim a candidate, and the steps `(n,)` at which they were there.

        Parameters
        ----------
        choices : (n,) int
            0 for no claim, else the number of a candidate from 1 on; one that there isn't is no claim.
        rows : (n,)
        """
        robots = self.memory.robots
        keyframes = self.memory.candidate_keyframes[rows, np.maximum(choices - 1, 0)]
        claims = (choices > 0) & (keyframes >= 0) & self._may_claim(rows)
        claiming = rows[claims]
        robots["claim_path"][claiming] = robots["path"][claiming]
        return claiming, self.memory.keyframes.step[claiming, keyframes[claims]]

    def _may_claim(self, rows: np.ndarray) -> np.ndarray:
        robots = self.memory.robots[rows]
        return robots["path"] - robots["claim_path"] >= self._limits.claim_spacing

    def action_masks(self) -> np.ndarray:
        """Return which choices there are, `(N, HEADINGS + 1 + CANDIDATES)` bool."""
        rows = np.arange(len(self.memory.robots))
        masks = np.ones((len(rows), HEADINGS + 1 + CANDIDATES), np.bool_)
        masks[:, HEADINGS + 1 :] = (self.memory.candidate_keyframes >= 0) & self._may_claim(rows)[:, None]
        return masks

    def steer(self, rows: np.ndarray, actions: np.ndarray) -> None:
        """Write speed and turning rate of the robots `rows` into `actions` `(N, 2+)`, as shares of a full twist."""
        self._in_threads(lambda share, scratch: steer_rows(self.memory, self._limits, scratch, share, actions), rows)

    def observe(self, rows: np.ndarray) -> None:
        """Bring tracks, maps and features of the robots `rows` up to date, at the end of a decision."""
        if not len(rows):
            return
        if self.memory.robots["keyframes"].max() >= self.memory.keyframes.path.shape[1]:
            self.memory = self.memory._replace(keyframes=enlarged(self.memory.keyframes))
        self._in_threads(self._observe, rows)

    def _observe(self, rows: np.ndarray, scratch: Scratch) -> None:
        memory = self.memory
        despeckle_rows(memory, rows)
        scans = memory.scans[rows]
        moved = np.abs(scans - memory.laser[rows])
        noise = np.quantile(moved, 0.75, axis=1, keepdims=True)
        memory.endpoints[rows] = np.where(moved > SOUND + SOUND_NOISE * noise, self._limits.range_max, scans)
        observe_rows(memory, self._limits, scratch, rows)

    def _in_threads(self, work: Callable[[np.ndarray, Scratch], None], rows: np.ndarray) -> None:
        """Let as many threads as there are cores do the work, each for a share of the rows."""
        count = min(num_cores(), -(-len(rows) // 4))
        while len(self._scratches) < count:
            self._scratches.append(self._scratch())
        if count < 2:
            work(rows, self._scratches[0])
            return
        if self._threads is None:
            self._threads = ThreadPoolExecutor(num_cores() - 1, thread_name_prefix="headings")
        first, *others = [rows[i::count] for i in range(count)]
        pending = [self._threads.submit(work, *one) for one in zip(others, self._scratches[1:], strict=False)]
        work(first, self._scratches[0])
        for future in pending:
            future.result()

    def _scratch(self) -> Scratch:
        beams = self._matched_beams
        return Scratch(
            match=allocate_match_scratch(beams),
            search=allocate_search_scratch(),
            ahead=Ahead(*np.zeros((len(Ahead._fields), HEADINGS))),
            steering=np.zeros(beams),
            steering_clear=np.zeros(beams),
            matched=np.zeros((CANDIDATES, 4)),
        )

    def close(self) -> None:
        """End the threads."""
        if self._threads is not None:
            self._threads.shutdown()
            self._threads = None

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_threads": None, "_scratches": []}


def num_cores() -> int:
    """Return how many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@compiled
def begin_rows(memory, rows):
    """Forget everything of the robots `rows`."""
    for i in rows:
        clear_map(memory.grid, i)
        robot = memory.robots[i]
        robot.x, robot.y, robot.heading, robot.compass, robot.distance = 0.0, 0.0, 0.0, 0.0, 0.0
        robot.bias, robot.compass_variance, robot.inlier_ratio = 0.0, 0.0, 1.0
        robot.path, robot.advance, robot.claim_path, robot.target = 0.0, 0.0, -math.inf, 0.0
        robot.shift_x, robot.shift_y, robot.shift_path, robot.strain = 0.0, 0.0, -math.inf, 0.0
        robot.steps, robot.decisions, robot.keyframes, robot.anchor, robot.begun = 0, 0, 0, 0, False
        memory.candidate_keyframes[i] = -1


@compiled
def sense_rows(memory, distance, compass, rows):
    """Dead reckon the robots `rows` by distances `(N, 1)` and compass readings `(N, 2)`."""
    for i in rows:
        begun = memory.robots[i].begun
        dead_reckon(memory.robots[i], distance[i, 0], compass[i, 0], compass[i, 1])
        if not begun:
            memory.robots[i].target = memory.robots[i].heading


@compiled
def despeckle_rows(memory, rows):
    """Take the speckle out of the scans of the robots `rows`."""
    for i in rows:
        despeckle(memory.laser[i], memory.scans[i])


@compiled
def steer_rows(memory, limits, scratch, rows, actions):
    """Write the drive of the robots `rows` towards their targets, or the nearest bearing that is clear."""
    scan, clear, stride = scratch.steering, scratch.steering_clear, limits.stride
    for i in rows:
        ranges, robot = memory.laser[i], memory.robots[i]
        n = ranges.shape[0]
        for k in range(scan.shape[0]):
            scan[k] = math.inf
            for b in range(k * stride - stride // 2, k * stride + stride // 2 + 1):
                # A range far below those beside it is noise.
                beside = 0.5 * (ranges[(b - 1) % n] + ranges[(b + 1) % n]) - 0.5
                scan[k] = min(scan[k], max(ranges[b % n], beside))
        clear_lengths(scan, limits.half_width, clear)
        bearing = wrap(robot.target - robot.heading)
        for needed in (1.0, 0.5):
            free = clear_beam(clear, bearing, needed)
            if abs(free - bearing) < 1.2:
                bearing = wrap(free)
                break
        # Turn on the spot when the way is off to the side or behind, and slow down for what is ahead.
        speed = math.cos(bearing) ** 4 if abs(bearing) < 1.2 else 0.0
        actions[i, 0] = speed * min(1.0, max(0.15, (clear[0] - limits.half_width) / 0.8))
        actions[i, 1] = 0.8 * max(-1.0, min(1.0, 1.6 * bearing))


@compiled
def observe_rows(memory, limits, scratch, rows):
    """Bring track, map and features of the robots `rows` up to date with their last scans."""
    keyframes, match = memory.keyframes, scratch.match
    for i in rows:
        robot, scan = memory.robots[i], memory.scans[i]
        for b in range(match.scan.shape[0]):
            match.scan[b] = scan[b * limits.stride]
            match.endpoints[b] = memory.endpoints[i, b * limits.stride]
        last = robot.keyframes - 1
        moved = math.inf
        if last >= 0:
            moved = math.sqrt((robot.x - keyframes.pose[i, last, 0]) ** 2 + (robot.y - keyframes.pose[i, last, 1]) ** 2)
        added = moved >= KEYFRAME_SPACING
        if added:
            if last >= 0:
                localize(robot, keyframes, i, match, limits.range_max)
            add_keyframe(robot, keyframes, i, match, limits.range_max)
        draw_scan(memory.grid, i, robot.x, robot.y, robot.heading, scan, limits.range_max, robot.decisions)
        find_candidates(memory, i, limits, scratch)
        match_candidates(memory, i, limits, scratch)
        if added:
            mend_track(memory, i, scratch)
        if robot.strain > REDRAW:
            redraw(memory, i, limits, match)
        search(memory.grid, i, robot, scratch.search, scratch.ahead)
        describe_headings(memory, i, limits, scratch.ahead)
        describe_robot(memory, i, limits, scratch.ahead)
        robot.advance = 0.0
        robot.decisions += 1


@compiled
def redraw(memory, i, limits, scratch):
    """Draw the map of robot i anew, from its keyframes where they are now."""
    robot, keyframes = memory.robots[i], memory.keyframes
    clear_map(memory.grid, i)
    for k in range(robot.keyframes):
        for b in range(scratch.reference.shape[0]):
            scratch.reference[b] = keyframes.scan[i, k, b]
        pose, decision = keyframes.pose[i, k], keyframes.decision[i, k]
        draw_scan(memory.grid, i, pose[0], pose[1], pose[2], scratch.reference, limits.range_max, decision)
    draw_scan(
        memory.grid, i, robot.x, robot.y, robot.heading, memory.scans[i], limits.range_max, robot.decisions
    )
    robot.strain = 0.0


@compiled
def find_candidates(memory, i, limits, scratch):
    """Choose the keyframes nearest to the track of those that the robot would be back at by the rules."""
    robot, keyframes, chosen = memory.robots[i], memory.keyframes, memory.candidate_keyframes[i]
    drift = DRIFT * math.sqrt(robot.compass_variance)
    for c in range(CANDIDATES):
        chosen[c] = -1
        nearest, farthest = math.inf, 0.0
        for k in range(robot.keyframes - 1, -1, -1):
            x, y = keyframes.pose[i, k, 0], keyframes.pose[i, k, 1]
            distance = math.sqrt((x - robot.x) ** 2 + (y - robot.y) ** 2)
            farthest = max(farthest, distance)
            gap = robot.path - keyframes.path[i, k]
            gate = min(max(drift * gap, GATE_MIN), GATE_MAX)
            if distance >= nearest or distance > gate or farthest < limits.leave or gap < limits.gap:
                continue
            apart = True
            for other in range(c):
                dx, dy = x - keyframes.pose[i, chosen[other], 0], y - keyframes.pose[i, chosen[other], 1]
                apart = apart and math.sqrt(dx * dx + dy * dy) >= CANDIDATE_SPACING
            if apart:
                nearest, chosen[c] = distance, k
        if chosen[c] < 0:
            for other in range(c + 1, CANDIDATES):
                chosen[other] = -1
            return


@compiled
def match_candidates(memory, i, limits, scratch):
    """Match the scan with each candidate's, and write what came out as its features and, in the track, `matched`."""
    robot, keyframes, match = memory.robots[i], memory.keyframes, scratch.match
    scan = memory.scans[i]
    n = scan.shape[0]
    for c in range(CANDIDATES):
        features, k = memory.candidates[i, c], memory.candidate_keyframes[i, c]
        features[:] = 0.0
        scratch.matched[c, 3] = -1.0
        if k < 0:
            continue
        x, y, heading = keyframes.pose[i, k, 0], keyframes.pose[i, k, 1], keyframes.pose[i, k, 2]
        set_prior(robot, x, y, heading, match)
        distance = math.sqrt(match.prior[0] ** 2 + match.prior[1] ** 2)
        match.prior[0] /= max(1.0, distance / PRIOR_DISTANCE)
        match.prior[1] /= max(1.0, distance / PRIOR_DISTANCE)
        for b in range(3):
            match.spread[b] = PRIOR_SPREAD[b]
        ratio, inliers, eigenvalue = match_keyframe(keyframes, i, k, match, limits.range_max)
        pose = match.pose
        matched_distance = math.sqrt(pose[0] ** 2 + pose[1] ** 2)
        cos, sin = math.cos(heading), math.sin(heading)
        matched_x, matched_y = x + cos * pose[0] - sin * pose[1], y + sin * pose[0] + cos * pose[1]
        shift = math.sqrt((matched_x - robot.x) ** 2 + (matched_y - robot.y) ** 2)
        beam = round(math.atan2(match.inverse[1], match.inverse[0]) * n / (2 * math.pi)) % n
        features[0] = 1.0
        features[1] = distance / 4
        features[2] = ratio
        features[3] = min(max(4 * (ratio - robot.inlier_ratio), -1.0), 1.0)
        features[4] = inliers
        features[5] = min(10 * eigenvalue, 1.0)
        features[6] = min(matched_distance / 3, 2.0)
        features[7] = min(shift / 4, 2.0)
        features[8] = math.tanh((robot.path - keyframes.path[i, k]) / 200)
        features[9] = 1.0 if scan[beam] > matched_distance - 0.2 else 0.0
        if (
            ratio >= robot.inlier_ratio - MENDS_BELOW
            and inliers >= MENDS_INLIERS
            and eigenvalue >= MENDS_EIGENVALUE
            and matched_distance < AT_KEYFRAME
        ):
            scratch.matched[c, 0], scratch.matched[c, 1] = matched_x, matched_y
            scratch.matched[c, 2], scratch.matched[c, 3] = heading + pose[2], ratio


@compiled
def mend_track(memory, i, scratch):
    """Mend the track of robot i by its best match, if none rivals it and the last good match called for the same."""
    robot, matched = memory.robots[i], scratch.matched
    best = 0
    for c in range(1, CANDIDATES):
        if matched[c, 3] > matched[best, 3]:
            best = c
    if matched[best, 3] < 0.0:
        return
    x, y = matched[best, 0], matched[best, 1]
    for c in range(CANDIDATES):
        far = math.sqrt((matched[c, 0] - x) ** 2 + (matched[c, 1] - y) ** 2) > RIVAL_DISTANCE
        if far and matched[c, 3] > matched[best, 3] - RIVAL_BELOW:
            return
    dx, dy = x - robot.x, y - robot.y
    confirmed = (
        robot.path - robot.shift_path <= FRESH
        and abs(dx - robot.shift_x) < SAME_SHIFT
        and abs(dy - robot.shift_y) < SAME_SHIFT
    )
    robot.shift_x, robot.shift_y, robot.shift_path = dx, dy, robot.path
    if confirmed:
        mend(robot, memory.keyframes, i, memory.candidate_keyframes[i, best], x, y, matched[best, 2])
        robot.shift_x, robot.shift_y = 0.0, 0.0


@compiled
def describe_headings(memory, i, limits, ahead):
    """Write the features of each heading."""
    clear = memory.clear[i]
    clear_lengths(memory.scans[i], limits.half_width, clear)
    n = clear.shape[0]
    nearest_undriven, nearest_unseen = UNREACHED, UNREACHED
    for h in range(HEADINGS):
        nearest_undriven = min(nearest_undriven, ahead.undriven[h])
        nearest_unseen = min(nearest_unseen, ahead.unseen[h])
    for h in range(HEADINGS):
        features = memory.headings[i, h]
        longest = 0.0
        for b in range(-(n // 90), n // 90 + 1):
            longest = max(longest, clear[(round(h * n / HEADINGS) + b) % n])
        features[0] = longest / limits.range_max
        features[1] = math.exp(-ahead.undriven[h] / 20)
        features[2] = math.exp(-ahead.unseen[h] / 20)
        features[3] = math.log1p(ahead.undriven_mass[h]) / 5
        features[4] = math.log1p(ahead.unseen_mass[h]) / 3
        features[5] = ahead.recent[h]
        # The nearest of all stands out.
        if ahead.undriven[h] < UNREACHED and ahead.undriven[h] == nearest_undriven:
            features[1] += 0.5
        if ahead.unseen[h] < UNREACHED and ahead.unseen[h] == nearest_unseen:
            features[2] += 0.5


@compiled
def describe_robot(memory, i, limits, ahead):
    """Write the features of the robot as a whole."""
    robot, features = memory.robots[i], memory.robot[i]
    undriven, unseen = UNREACHED, UNREACHED
    for h in range(HEADINGS):
        undriven, unseen = min(undriven, ahead.undriven[h]), min(unseen, ahead.unseen[h])
    since_claim, off = robot.path - robot.claim_path, wrap(robot.target - robot.heading)
    features[0] = math.exp(-undriven / 20)
    features[1] = math.exp(-unseen / 20)
    features[2] = 1.0 if undriven < UNREACHED else 0.0
    features[3] = 1.0 if unseen < UNREACHED else 0.0
    features[4] = 1.0 if since_claim >= limits.claim_spacing else 0.0
    features[5] = min(since_claim / 20, 1.0)
    features[6] = robot.advance / limits.advance_max
    features[7] = math.cos(off)
    features[8] = math.sin(off)
    features[9] = robot.inlier_ratio

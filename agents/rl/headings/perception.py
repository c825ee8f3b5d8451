"""What robots make of their observations: tracks, maps, candidates to claim, and the features of these."""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from agents.rl.headings.candidates import find_candidates, match_candidates, mend_track
from agents.rl.headings.features import describe_headings, describe_robot, steer_rows
from agents.rl.headings.grid import clear_map, draw_scan, search
from agents.rl.headings.memory import (
    CANDIDATES,
    HEADINGS,
    Rules,
    Scratch,
    allocate_memory,
    allocate_scratch,
    limits_of,
)
from agents.rl.headings.tracking import (
    KEYFRAME_SPACING,
    REDRAW,
    TRACKER,
    add_keyframe,
    average_ranges,
    dead_reckon,
    enlarged,
    localize,
)
from agents.slam.panorama import panorama_beams
from agents.slam.scan_filters import despeckle, reliable_endpoints
from cyclic_env.jit import compiled, num_cores


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
        self.rules = rules
        self._limits = limits_of(rules)
        self._beams, _ = panorama_beams(rules.laser)
        self.memory = allocate_memory(robots, rules)
        self._scratches: list[Scratch] = []
        self._threads: ThreadPoolExecutor | None = None

    def begin(self, rows: np.ndarray) -> None:
        """Forget everything of the robots `rows`, whose episodes begin."""
        begin_rows(self.memory, rows)

    def sense(self, observation: dict[str, np.ndarray], rows: np.ndarray) -> None:
        """Take the observation of a step, of the robots `rows`."""
        self.memory.laser[np.ix_(rows, self._beams)] = observation["laser"][rows]
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
        memory.endpoints[rows] = reliable_endpoints(memory.scans[rows], memory.laser[rows], self._limits.range_max)
        observe_rows(memory, self._limits, scratch, rows)

    def _in_threads(self, work: Callable[[np.ndarray, Scratch], None], rows: np.ndarray) -> None:
        """Let as many threads as there are cores do the work, each for a share of the rows."""
        count = min(num_cores(), -(-len(rows) // 4))
        while len(self._scratches) < count:
            self._scratches.append(allocate_scratch(self.rules))
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

    def close(self) -> None:
        """End the threads."""
        if self._threads is not None:
            self._threads.shutdown()
            self._threads = None

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_threads": None, "_scratches": []}


@compiled
def begin_rows(memory, rows):
    """Forget everything of the robots `rows`."""
    for i in rows:
        clear_map(memory.grid, i)
        robot = memory.robots[i]
        robot.x, robot.y, robot.heading, robot.compass, robot.distance = 0.0, 0.0, 0.0, 0.0, 0.0
        robot.bias, robot.compass_variance, robot.inlier_ratio = 0.0, 0.0, 1.0
        robot.scale, robot.scale_information = 1.0, TRACKER.scale_std**-2
        robot.path, robot.advance, robot.claim_path, robot.target = 0.0, 0.0, -math.inf, 0.0
        robot.shift_x, robot.shift_y, robot.shift_path, robot.strain = 0.0, 0.0, -math.inf, 0.0
        robot.agreed, robot.fixed = 0.0, 0
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
def observe_rows(memory, limits, scratch, rows):
    """Bring track, map and features of the robots `rows` up to date with their last scans."""
    keyframes, match = memory.keyframes, scratch.match
    for i in rows:
        robot, scan = memory.robots[i], memory.scans[i]
        for b in range(match.scan.shape[0]):
            match.scan[b] = scan[b * limits.stride]
            match.endpoints[b] = memory.endpoints[i, b * limits.stride]
        average_ranges(robot, match)
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
    draw_scan(memory.grid, i, robot.x, robot.y, robot.heading, memory.scans[i], limits.range_max, robot.decisions)
    robot.strain = 0.0

"""What is kept of the robots that do the task headings, and what its features depend on."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from agents.rl.headings.grid import Ahead, Grid, SearchScratch, allocate_grid, allocate_search_scratch
from agents.rl.headings.tracking import ROBOT, Keyframes, MatchScratch, allocate_keyframes, allocate_match_scratch
from cyclic_env import ClosureConfig, ConfigError, LaserConfig, RobotConfig

HEADINGS = 16
"""Headings to choose from, relative to the robot's, counter-clockwise."""
CANDIDATES = 3
"""Most places that can be claimed at a time."""
HOLD = 5
"""Steps of the environment for which a decision holds: a second."""
PER_HEADING, PER_CANDIDATE, PER_ROBOT = 6, 14, 12
"""Features of each heading, of each candidate, and of the robot as a whole."""
BEAMS_MIN, BEAMS_MAX = 60, 120
"""Beams of a scan that are matched: where the laser has more, evenly spaced ones."""
MARGIN = 0.5
"""Metres by which a candidate must have been left for longer, and farther, than the rules of closure ask for."""
CLEARANCE = 0.06
"""Metres beside the robot that a way must be wider than it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Rules:
    """What the features depend on: the laser, the robot, and what counts as being back.

    Raises
    ------
    ConfigError
        If the laser does not see all around.
    """

    laser: LaserConfig = field(default_factory=LaserConfig)
    robot: RobotConfig = field(default_factory=RobotConfig)
    closure: ClosureConfig = field(default_factory=ClosureConfig)

    def __post_init__(self) -> None:
        if not self.laser.sees_all_around:
            raise ConfigError(
                f"the laser's field_of_view is {self.laser.field_of_view:g}; the task headings needs one of 2 pi."
            )

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


def limits_of(rules: Rules) -> Limits:
    """Return the rules as the compiled code takes them."""
    return Limits(
        range_max=rules.laser.range_max,
        half_width=rules.robot.radius + CLEARANCE,
        advance_max=rules.robot.advance_max * HOLD,
        gap=rules.closure.gap + MARGIN,
        leave=rules.closure.leave_radius + MARGIN,
        claim_spacing=rules.closure.claim_spacing,
        stride=rules.stride,
    )


def allocate_memory(robots: int, rules: Rules) -> Memory:
    """Return the empty memory of N robots."""
    beams = rules.laser.num_beams
    return Memory(
        robots=np.zeros(robots, ROBOT),
        keyframes=allocate_keyframes(robots, beams // rules.stride),
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


def allocate_scratch(rules: Rules) -> Scratch:
    """Return the working memory of one thread."""
    beams = rules.laser.num_beams // rules.stride
    return Scratch(
        match=allocate_match_scratch(beams),
        search=allocate_search_scratch(),
        ahead=Ahead(*np.zeros((len(Ahead._fields), HEADINGS))),
        steering=np.zeros(beams),
        steering_clear=np.zeros(beams),
        matched=np.zeros((CANDIDATES, 5)),
    )

"""Scripted agents. They ignore loops, and their scores are the baseline that every other agent has to beat."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import numpy as np

from agents.actions import BACK, MATCH_START, Decision
from agents.base import Agent, BatchPolicy
from agents.slam.panorama import panorama_beams, spread_beams
from cyclic_env.config import ActionType, LaserConfig

LEFT, RIGHT = 1, -1

CLEAR_OF_WALL = 0.45
"""Metres from the robot's centre to the wall that it follows, which leaves 0.2 m of air."""
BEYOND_WALL = 0.2
"""Metres to the wall; less than the robot's radius, so that it leans on the wall all the way."""

LOOKAHEAD = 0.8
"""Metres that must be free along a heading; a full stop takes 0.4."""

STOP_AHEAD = 0.75
"""Metres from the robot's centre to a wall at which it turns back: the radius and half a metre for the stop."""
HALF_WIDTH = 0.35
"""Metres; obstacles nearer than this to the line along which the robot drives are in its way."""

BITS = 0xFFFFFFFFFFFFFFFF
"""Mask of 64-bit whole numbers, in which random numbers are computed."""


class ScriptedAgent(Agent):
    """An agent that follows a fixed rule.

    Parameters
    ----------
    claims : bool
        Whether to claim in every step to be back at the start (with discrete actions, anywhere), or never.
    key : int
        Key of its random numbers, if it draws any.
    laser : LaserConfig, optional
        Laser of the robot, by default one that looks all around. Where it doesn't look, the way is taken to be free.
    """

    def __init__(self, *, claims: bool = False, key: int = 0, laser: LaserConfig | None = None) -> None:
        self.claims = claims
        self.key = key
        self._laser = None if laser is None or laser.first_bearing == 0 else laser

    def decide(self, scan: np.ndarray, distance: float, compass: np.ndarray) -> Decision:
        """Drive by the rule, which depends on the scan alone."""
        if self._laser is not None:
            scan = spread_beams(scan, *panorama_beams(self._laser))
            scan[scan == 0] = self._laser.range_max
        speed, turn = self.drive(scan)
        return Decision(speed, turn, self.claims, MATCH_START)

    @abstractmethod
    def drive(self, scan: np.ndarray) -> tuple[float, float]:
        """Return speed and turning rate, as shares of full speed and of the full turning rate."""


class ScriptedPolicy(BatchPolicy):
    """A policy with a scripted agent for each robot; the agents are the state that `predict` returns.

    Parameters
    ----------
    kind : callable
        Returns a `ScriptedAgent`, given `claims`, `key` and `laser`.
    action_type : {"wheels", "twist", "discrete"}
        The action type of the environment.
    claims : bool
        As for `ScriptedAgent`.
    seed : int
        Seed of agents that draw random numbers.
    laser : LaserConfig, optional
        As for `ScriptedAgent`.
    """

    def __init__(
        self,
        kind: Callable[..., ScriptedAgent],
        *,
        action_type: ActionType = "wheels",
        claims: bool = False,
        seed: int = 0,
        laser: LaserConfig | None = None,
    ) -> None:
        super().__init__(action_type=action_type)
        self.laser = laser
        self.kind = kind
        self.claims = claims
        self.seed = seed

    def new_agent(self, beams: int, row: int, previous: Any = None) -> ScriptedAgent:
        """Return an agent whose random numbers are those of its row, and different in every episode."""
        key = random_key(self.seed, row) if previous is None else mix(previous.key)
        return self.kind(claims=self.claims, key=key, laser=self.laser)

    def reseed(self, state: tuple[ScriptedAgent, ...] | None, seeds: Sequence[int | None]) -> tuple[ScriptedAgent, ...]:
        """Return the state, with the random numbers of some robots reseeded.

        A harness that gives every episode a seed calls this, so that an episode is the same in any row of any batch.

        Parameters
        ----------
        state : tuple of ScriptedAgent or None
        seeds : sequence of N ints or None
            Seeds of the episodes that begin; None leaves a robot's random numbers as they are.
        """
        agents = state or tuple(self.new_agent(0, row) for row in range(len(seeds)))
        for agent, seed in zip(agents, seeds, strict=True):
            if seed is not None:
                agent.key = random_key(self.seed, seed)
        return agents


class StandingStillAgent(ScriptedAgent):
    """Does nothing."""

    def drive(self, scan: np.ndarray) -> tuple[float, float]:
        """Stand still."""
        return 0.0, 0.0


class SpinningAgent(ScriptedAgent):
    """Turns left on the spot."""

    def drive(self, scan: np.ndarray) -> tuple[float, float]:
        """Turn."""
        return 0.0, 1.0


class RandomAgent(ScriptedAgent):
    """Draws its wheel speeds, or twist or drive, uniformly from the action space in every step."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings)
        self.steps = 0

    def drive(self, scan: np.ndarray) -> tuple[float, float]:
        """Draw two numbers from [-1, 1)."""
        first, second = (uniform(self.key, 2 * self.steps + i) for i in range(2))
        self.steps += 1
        return first, second

    def encode(self, decision: Decision, action_type: ActionType) -> tuple[float, ...]:
        """Return the numbers that were drawn as those of the action, whatever they mean there."""
        if action_type == "discrete":
            return min(int((decision.speed + 1) / 2 * (BACK + 1)), BACK), int(decision.claim)
        return decision.speed, decision.turn, 1.0 if decision.claim else -1.0, decision.match


class ToAndFroAgent(ScriptedAgent):
    """Drives straight ahead to a wall, backward to the next one, and so on."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings)
        self.sign = 1.0

    def drive(self, scan: np.ndarray) -> tuple[float, float]:
        """Continue, or turn back at a wall."""
        if way_ahead(without_outliers(scan), self.sign) < STOP_AHEAD:
            self.sign = -self.sign
        return self.sign, 0.0


class WallFollowingAgent(ScriptedAgent):
    """Drives to the wall on one side and along it, taking every turn to that side: around a block or the building.

    Starting at the bearing of the nearest wall on its side, it searches across its front for the first heading along
    which a disc of radius `wall_distance` could move for `LOOKAHEAD`.

    Parameters
    ----------
    side : {LEFT, RIGHT}
    wall_distance : float
        Distance from the robot's centre to the wall, metres; if less than its radius, it leans on the wall.
    claims, key
        As for `ScriptedAgent`.
    """

    def __init__(self, *, side: int, wall_distance: float, **settings: Any) -> None:
        super().__init__(**settings)
        self.side = side
        self.wall_distance = wall_distance

    def drive(self, scan: np.ndarray) -> tuple[float, float]:
        """Drive along the wall."""
        scan = without_outliers(scan)
        if self.side == RIGHT:
            scan = np.roll(scan[::-1], 1)  # seen in a mirror, the wall is on the left
        bearing = first_free_bearing(scan, self.wall_distance)
        # NumPy's cosine and power, whose last bits differ from the math module's.
        ahead = np.maximum(np.cos(np.array([bearing])), 0.0)
        speed = float(np.power(ahead, 3)[0])
        return speed, self.side * max(-1.0, min(1.0, bearing))


def first_free_bearing(scan: np.ndarray, radius: float) -> float:
    """Return the first bearing, clockwise from the nearest wall on the left, in which a disc can move for `LOOKAHEAD`.

    Parameters
    ----------
    scan : (beams,) array
        Ranges in metres, beam 0 straight ahead, counter-clockwise.
    radius : float
        Radius of the disc, metres.

    Returns
    -------
    float
        Radians in (-pi, pi]; if the disc can move nowhere, the bearing straight away from the nearest wall.
    """
    beams = len(scan)
    # A wall blocks the bearings within this angle of its own: there the disc would touch it in passing, or at the end.
    ranges = np.maximum(scan, radius)
    on_side = np.arcsin(radius / ranges)
    at_end = np.arccos(np.clip((ranges**2 + LOOKAHEAD**2 - radius**2) / (2 * ranges * LOOKAHEAD), -1.0, 1.0))
    reach = np.where(ranges**2 <= LOOKAHEAD**2 + radius**2, on_side, at_end)
    blocked = np.any(angles_between(beams) < reach - 1e-9, axis=-1)
    # The wall on the left may be straight ahead, or at a corner that the robot has just passed.
    window = (np.arange(-beams // 18, beams // 2 + beams // 18 + 1)) % beams
    nearest = window[np.argmin(scan[window])]
    order = (nearest - np.arange(beams)) % beams
    free = ~blocked[order]
    index = int(order[np.argmax(free) if free.any() else beams // 2])
    return (index - beams if index > beams // 2 else index) * (2 * np.pi / beams)


@cache
def angles_between(beams: int) -> np.ndarray:
    """Return the angles between any two beams, `(beams, beams)`, radians in [0, pi]."""
    steps = np.arange(beams)
    apart = abs(steps[:, None] - steps)
    return np.minimum(apart, beams - apart) * (2 * np.pi / beams)


def way_ahead(scan: np.ndarray, sign: float) -> float:
    """Return how far the nearest wall in the robot's way is, metres, driving ahead (sign 1) or backward (-1)."""
    bearings = np.arange(len(scan)) * (2 * np.pi / len(scan))
    along = scan * np.cos(bearings) * sign
    in_way = (along > 0) & (abs(scan * np.sin(bearings)) < HALF_WIDTH)
    return float(np.min(along, where=in_way, initial=math.inf))


def without_outliers(scan: np.ndarray) -> np.ndarray:
    """Return the median of every beam and its two neighbours, which removes single wrong ranges."""
    before, after = np.roll(scan, 1), np.roll(scan, -1)
    return np.maximum(np.minimum(before, scan), np.minimum(np.maximum(before, scan), after))


def uniform(key: int, counter: int) -> float:
    """Return the random number in [-1, 1) for a key and a counter."""
    return (mix(key ^ mix(counter)) >> 11) * 2.0**-52 - 1.0


def mix(value: int) -> int:
    """Scramble a 64-bit whole number (splitmix64; Steele, Lea and Flood 2014)."""
    mixed = (value + 0x9E3779B97F4A7C15) & BITS
    mixed = ((mixed ^ (mixed >> 30)) * 0xBF58476D1CE4E5B9) & BITS
    mixed = ((mixed ^ (mixed >> 27)) * 0x94D049BB133111EB) & BITS
    return mixed ^ (mixed >> 31)


def random_key(seed: int, row: int) -> int:
    """Return the key of the random numbers of a row, or of an episode with its own seed."""
    return mix(mix(seed & BITS) ^ (row & BITS))

"""Scripted agents: what can be had without any thought about loops, and a floor under every other score."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import numpy as np

from agents.actions import BACK, MATCH_START, Decision
from agents.base import Agent, BatchPolicy
from cyclic_env.config import ActionType

LEFT, RIGHT = 1, -1

CLEAR_OF_WALL = 0.45
"""Metres from the robot's center to the wall that it follows: 0.2 m of air."""
BEYOND_WALL = 0.2
"""Less than the robot's radius: it leans on the wall all the way."""

LOOKAHEAD = 0.8
"""Metres of free way that a heading must have; a full stop takes 0.4."""

STOP_AHEAD = 0.75
"""Metres from the robot's center to a wall at which it turns back: the radius, and half a metre to stop in."""
HALF_WIDTH = 0.35
"""Metres: what is nearer to the line of driving is in the way."""

BITS = 0xFFFFFFFFFFFFFFFF
"""Of the 64-bit whole numbers that random ones are made of."""


class ScriptedAgent(Agent):
    """An agent that follows a fixed rule.

    Parameters
    ----------
    claims : bool
        Claim in every step to be back at the start (with discrete actions, anywhere); else never.
    key : int
        Of its random numbers, if it draws.
    """

    def __init__(self, *, claims: bool = False, key: int = 0) -> None:
        self.claims = claims
        self.key = key

    def decide(self, scan: np.ndarray, distance: float, compass: np.ndarray) -> Decision:
        """Drive by the rule; only the scan matters."""
        speed, turn = self.drive(scan)
        return Decision(speed, turn, self.claims, MATCH_START)

    @abstractmethod
    def drive(self, scan: np.ndarray) -> tuple[float, float]:
        """Return speed and turning rate, as shares of the full ones."""


class ScriptedPolicy(BatchPolicy):
    """A scripted agent for each robot; these are the state that `predict` returns.

    Parameters
    ----------
    kind : callable
        Makes a `ScriptedAgent`, given `claims` and `key`.
    action_type : {"wheels", "twist", "discrete"}
        That of the environment.
    claims : bool
        As for `ScriptedAgent`.
    seed : int
        Of the random numbers of agents that draw.
    """

    def __init__(
        self,
        kind: Callable[..., ScriptedAgent],
        *,
        action_type: ActionType = "wheels",
        claims: bool = False,
        seed: int = 0,
    ) -> None:
        super().__init__(action_type=action_type)
        self.kind = kind
        self.claims = claims
        self.seed = seed

    def new_agent(self, beams: int, row: int, previous: Any = None) -> ScriptedAgent:
        """Return an agent with random numbers of its own: those of its row, and others in every episode."""
        key = random_key(self.seed, row) if previous is None else mix(previous.key)
        return self.kind(claims=self.claims, key=key)

    def reseed(self, state: tuple[ScriptedAgent, ...] | None, seeds: Sequence[int | None]) -> tuple[ScriptedAgent, ...]:
        """Return the state with the random numbers of some robots begun anew.

        A harness that gives every episode a seed calls this, so that an episode is the same in any row of any batch.

        Parameters
        ----------
        state : tuple of ScriptedAgent or None
        seeds : sequence of N ints or None
            None leaves a robot's numbers as they are.
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
    """Draws its drives uniformly from the action space, in every step."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings)
        self.steps = 0

    def drive(self, scan: np.ndarray) -> tuple[float, float]:
        """Draw two numbers from [-1, 1)."""
        first, second = (uniform(self.key, 2 * self.steps + i) for i in range(2))
        self.steps += 1
        return first, second

    def encode(self, decision: Decision, action_type: ActionType) -> tuple[float, ...]:
        """Take the numbers that were drawn for those of the action, whatever they mean there."""
        if action_type == "discrete":
            return min(int((decision.speed + 1) / 2 * (BACK + 1)), BACK), int(decision.claim)
        return decision.speed, decision.turn, 1.0 if decision.claim else -1.0, decision.match


class ToAndFroAgent(ScriptedAgent):
    """Drives straight ahead to a wall, backward to the next one, and so on."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings)
        self.sign = 1.0

    def drive(self, scan: np.ndarray) -> tuple[float, float]:
        """Go on, or back from a wall."""
        if way_ahead(without_outliers(scan), self.sign) < STOP_AHEAD:
            self.sign = -self.sign
        return self.sign, 0.0


class WallFollowingAgent(ScriptedAgent):
    """Goes to the wall on one side and along it, taking every turn to that side: around a block, or a whole building.

    It looks at the nearest wall on its side, turns its gaze from there across its front, and takes the first heading
    along which a disc of radius `wall_distance` could move for `LOOKAHEAD`.

    Parameters
    ----------
    side : {LEFT, RIGHT}
    wall_distance : float
        From the robot's center to the wall, metres; less than its radius makes it lean on the wall.
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
        Of the disc, metres.

    Returns
    -------
    float
        Radians in (-pi, pi]; where the disc can move nowhere, straight away from the nearest wall.
    """
    beams = len(scan)
    # A wall blocks the bearings within this angle of its own: the disc would touch it with its side, or end on it.
    ranges = np.maximum(scan, radius)
    on_side = np.arcsin(radius / ranges)
    at_end = np.arccos(np.clip((ranges**2 + LOOKAHEAD**2 - radius**2) / (2 * ranges * LOOKAHEAD), -1.0, 1.0))
    reach = np.where(ranges**2 <= LOOKAHEAD**2 + radius**2, on_side, at_end)
    blocked = np.any(angles_between(beams) < reach - 1e-9, axis=-1)
    # The wall on the left may be as far round as a corner just passed is behind, or a wall straight ahead.
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
    """Return the median of every beam and its two neighbors, which drops a single wrong range."""
    before, after = np.roll(scan, 1), np.roll(scan, -1)
    return np.maximum(np.minimum(before, scan), np.minimum(np.maximum(before, scan), after))


def uniform(key: int, counter: int) -> float:
    """Return the number from [-1, 1) that belongs to a key and a counter."""
    return (mix(key ^ mix(counter)) >> 11) * 2.0**-52 - 1.0


def mix(value: int) -> int:
    """Scramble a 64-bit whole number (splitmix64; Steele, Lea and Flood 2014)."""
    mixed = (value + 0x9E3779B97F4A7C15) & BITS
    mixed = ((mixed ^ (mixed >> 30)) * 0xBF58476D1CE4E5B9) & BITS
    mixed = ((mixed ^ (mixed >> 27)) * 0x94D049BB133111EB) & BITS
    return mixed ^ (mixed >> 31)


def random_key(seed: int, row: int) -> int:
    """Return the key of the random numbers of a row, or of an episode's seed."""
    return mix(mix(seed & BITS) ^ (row & BITS))

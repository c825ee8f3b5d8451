"""Scripted policies: what can be had without any thought about loops, and a floor under every other score.

Each has the shape of Stable-Baselines3's ``PolicyPredictor``. What an agent remembers of an episode is in the
state that `predict` returns, a row for each robot, so one agent can drive any number of robots.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any

import numpy as np

from agents.actions import BACK, MATCH_START, drive_actions, with_claims
from cyclic_env.config import ACTION_TYPES, ActionType
from cyclic_env.errors import ConfigError
from cyclic_env.validation import check_choice

MEMORY = np.dtype(
    [
        ("steps", "i8"),  # calls since the episode's start
        ("key", "u8"),  # of the robot's random numbers
        ("backward", "?"),  # to and fro: which of the two
    ]
)
"""What a scripted agent remembers of one robot's episode."""

State = tuple[np.ndarray]
"""A state: one array `(N,)` of `MEMORY`."""

LEFT, RIGHT = 1, -1

CLEAR_OF_WALL = 0.45
"""Metres from the robot's centre to the wall that it follows: 0.2 m of air."""
BEYOND_WALL = 0.2
"""Less than the robot's radius: it leans on the wall for all its way."""

LOOKAHEAD = 0.8
"""Metres of free way that a heading must have; a full stop takes 0.4."""

STOP_AHEAD = 0.75
"""Metres from the robot's centre to a wall at which it turns back: the radius, and half a metre to stop in."""
HALF_WIDTH = 0.35
"""Metres; what is less far off the line of driving is in the way."""


class ScriptedAgent(ABC):
    """A policy that follows a fixed rule.

    Parameters
    ----------
    action_type : {"wheels", "twist", "discrete"}
        That of the environment.
    claims : bool
        Claim in every step to be back at the start (with discrete actions, anywhere); else never.
    seed : int
        For agents that draw.
    """

    def __init__(self, *, action_type: ActionType = "wheels", claims: bool = False, seed: int = 0) -> None:
        self.action_type: ActionType = check_choice("action type", action_type, ACTION_TYPES)
        self.claims = claims
        self.seed = seed

    def predict(
        self,
        observation: np.ndarray | Mapping[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = True,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """Return actions, and what to remember.

        Parameters
        ----------
        observation : dict of arrays
            ``laser`` `(N, beams)`, ``distance`` `(N, 1)`, ``compass`` `(N, 2)`; or of one robot, without the N.
        state : tuple, optional
            As returned by the last call; None at the first.
        episode_start : (N,) bool, optional
            Robots whose episode has just begun.
        deterministic : bool
            Makes no difference: the random agent has nothing else to do than draw.

        Returns
        -------
        actions : (N, 4) float32, or (N, 2) int64 if discrete; without the N for one robot
        state : tuple
        """
        if not isinstance(observation, Mapping):
            raise ConfigError("the observation must be a dict with laser, distance and compass.")
        laser = np.asarray(observation["laser"], np.float64)
        single = laser.ndim == 1
        laser = np.atleast_2d(laser)
        memory = self._memory(len(laser), state, episode_start)
        drive = self._drive(laser, memory)
        memory["steps"] += 1
        actions = self._actions(drive)
        return (actions[0] if single else actions), (memory,)

    def reseed(self, state: tuple[np.ndarray, ...] | None, seeds: Sequence[int | None]) -> State:
        """Return the state with the random numbers of some robots begun anew.

        A harness that gives every episode a seed calls this, so that an episode is the same in any row of any batch.

        Parameters
        ----------
        state : tuple or None
        seeds : sequence of N ints or None
            None leaves a robot's numbers as they are.
        """
        memory = self._memory(len(seeds), state, None)
        for row, seed in enumerate(seeds):
            if seed is not None:
                memory["key"][row] = _key(self.seed, seed)
        return (memory,)

    def _memory(self, count: int, state: tuple[np.ndarray, ...] | None, episode_start: np.ndarray | None) -> np.ndarray:
        """Return a copy of what the state holds, and forget what is of an earlier episode."""
        if state is None:
            memory = np.zeros(count, MEMORY)
            memory["key"] = [_key(self.seed, row) for row in range(count)]
            return memory
        memory = state[0].copy()
        if len(memory) != count:
            raise ConfigError(
                f"the state is of {len(memory)} robots, the observation of {count}; begin with state=None."
            )
        if episode_start is not None:
            begun = np.asarray(episode_start, np.bool_).reshape(count)
            memory["steps"][begun] = 0
            memory["backward"][begun] = False
            memory["key"][begun] = mix(memory["key"][begun])
        return memory

    def _actions(self, drive: np.ndarray) -> np.ndarray:
        """Turn drives `(N, 2)`, speed and turning rate as shares of a full twist, into actions."""
        claims = np.full(len(drive), 1.0 if self.claims else -1.0)
        return drive_actions(drive, self.action_type, claims, np.full(len(drive), MATCH_START))

    @abstractmethod
    def _drive(self, laser: np.ndarray, memory: np.ndarray) -> np.ndarray:
        """Return `(N, 2)`: speed and turning rate, as shares of a full twist; may write to the memory."""


class StandingStillAgent(ScriptedAgent):
    """Does nothing."""

    def _drive(self, laser: np.ndarray, memory: np.ndarray) -> np.ndarray:
        return np.zeros((len(memory), 2))


class SpinningAgent(ScriptedAgent):
    """Turns left on the spot."""

    def _drive(self, laser: np.ndarray, memory: np.ndarray) -> np.ndarray:
        return np.tile([0.0, 1.0], (len(memory), 1))


class RandomAgent(ScriptedAgent):
    """Draws its drives uniformly from the action space, anew in every step."""

    def _drive(self, laser: np.ndarray, memory: np.ndarray) -> np.ndarray:
        step = memory["steps"].astype(np.uint64)
        return np.column_stack([uniform(memory["key"], 2 * step + np.uint64(i)) for i in range(2)])

    def _actions(self, drive: np.ndarray) -> np.ndarray:
        if self.action_type == "discrete":
            drives = np.minimum(((drive[:, 0] + 1) / 2 * (BACK + 1)).astype(np.int64), BACK)
            return np.column_stack([drives, np.full(len(drives), int(self.claims))])
        claims = np.full(len(drive), 1.0 if self.claims else -1.0)
        return with_claims(drive, claims, np.full(len(drive), MATCH_START))


class ToAndFroAgent(ScriptedAgent):
    """Drives straight ahead to a wall, backward to the next one, and so on."""

    def _drive(self, laser: np.ndarray, memory: np.ndarray) -> np.ndarray:
        sign = np.where(memory["backward"], -1.0, 1.0)
        memory["backward"] ^= way_ahead(without_outliers(laser), sign) < STOP_AHEAD
        return np.column_stack([np.where(memory["backward"], -1.0, 1.0), np.zeros(len(memory))])


class WallFollowingAgent(ScriptedAgent):
    """Goes to the wall on one side and along it, taking every turn to that side: around a block, or a whole building.

    It looks at the nearest wall on its side, turns its eyes from there across its front, and takes the first heading
    along which a disc of radius `distance` could move for `LOOKAHEAD`.

    Parameters
    ----------
    side : {LEFT, RIGHT}
    distance : float
        From the robot's centre to the wall, metres; less than its radius makes it lean on the wall.
    action_type, claims, seed
        As for `ScriptedAgent`.
    """

    def __init__(self, *, side: int, distance: float, **settings: Any) -> None:
        super().__init__(**settings)
        self.side = side
        self.distance = distance

    def _drive(self, laser: np.ndarray, memory: np.ndarray) -> np.ndarray:
        laser = without_outliers(laser)
        if self.side == RIGHT:
            laser = np.roll(laser[:, ::-1], 1, axis=1)  # seen in a mirror, the wall is on the left
        bearing = first_free_bearing(laser, self.distance)
        turn = np.clip(bearing, -1.0, 1.0)
        speed = np.maximum(np.cos(bearing), 0.0) ** 3
        return np.column_stack([speed, self.side * turn])


def first_free_bearing(laser: np.ndarray, radius: float) -> np.ndarray:
    """Return the first bearing, clockwise from the nearest wall on the left, in which a disc can move for `LOOKAHEAD`.

    Parameters
    ----------
    laser : (N, beams) array
        Ranges in metres, beam 0 straight ahead, counter-clockwise.
    radius : float
        Of the disc, metres.

    Returns
    -------
    (N,) float64
        Radians in (-pi, pi]; where the disc can move nowhere, straight away from the nearest wall.
    """
    count, beams = laser.shape
    spacing = 2 * np.pi / beams
    # A wall blocks the bearings within this angle of its own: the disc would touch it with its side, or end on it.
    ranges = np.maximum(laser, radius)
    on_side = np.arcsin(radius / ranges)
    at_end = np.arccos(np.clip((ranges**2 + LOOKAHEAD**2 - radius**2) / (2 * ranges * LOOKAHEAD), -1.0, 1.0))
    reach = np.where(ranges**2 <= LOOKAHEAD**2 + radius**2, on_side, at_end)
    blocked = (angles_apart(beams) < reach[:, None, :] - 1e-9).any(-1)
    # The wall on the left may be as far round as a corner just passed is behind, or a wall straight ahead.
    window = (np.arange(-beams // 18, beams // 2 + beams // 18 + 1)) % beams
    nearest = window[np.argmin(laser[:, window], axis=1)]
    order = (nearest[:, None] - np.arange(beams)) % beams
    free = ~np.take_along_axis(blocked, order, axis=1)
    first = np.where(free.any(1), np.argmax(free, axis=1), beams // 2)
    index = order[np.arange(count), first]
    return np.where(index > beams // 2, index - beams, index) * spacing


@cache
def angles_apart(beams: int) -> np.ndarray:
    """Return the angles between any two beams, `(beams, beams)`, radians in [0, pi]."""
    steps = np.arange(beams)
    apart = abs(steps[:, None] - steps)
    return np.minimum(apart, beams - apart) * (2 * np.pi / beams)


def way_ahead(laser: np.ndarray, sign: np.ndarray) -> np.ndarray:
    """Return how far the walls in the robot's way are, `(N,)` metres, driving ahead (sign 1) or backward (-1)."""
    bearings = np.arange(laser.shape[1]) * (2 * np.pi / laser.shape[1])
    along = laser * np.cos(bearings) * sign[:, None]
    in_way = (along > 0) & (abs(laser * np.sin(bearings)) < HALF_WIDTH)
    return np.min(along, axis=1, where=in_way, initial=np.inf)


def without_outliers(laser: np.ndarray) -> np.ndarray:
    """Return the median of every beam and its two neighbours, which drops a single wrong range."""
    before, after = np.roll(laser, 1, axis=1), np.roll(laser, -1, axis=1)
    return np.maximum(np.minimum(before, laser), np.minimum(np.maximum(before, laser), after))


def uniform(key: np.ndarray, counter: np.ndarray) -> np.ndarray:
    """Return one number from [-1, 1) for each key and counter: row i depends on nothing else, so on no batch."""
    bits = mix(key ^ mix(counter))
    return (bits >> np.uint64(11)) * 2.0**-52 - 1.0


def mix(values: np.ndarray) -> np.ndarray:
    """Scramble 64-bit integers (splitmix64; Steele, Lea and Flood 2014)."""
    mixed = values + np.uint64(0x9E3779B97F4A7C15)
    mixed = (mixed ^ (mixed >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    mixed = (mixed ^ (mixed >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return mixed ^ (mixed >> np.uint64(31))


def _key(seed: int, row: int) -> np.uint64:
    low = 0xFFFFFFFFFFFFFFFF
    return mix(mix(np.array([seed & low], np.uint64)) ^ np.array([row & low], np.uint64))[0]

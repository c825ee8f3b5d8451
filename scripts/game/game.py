"""Playing the task by hand: what the keys do, without any window; `scripts.game.view` draws it.

The player drives, and claims to be back at an earlier moment of the robot's own way. Which one: the nearest place of
that way that was left long enough ago, or the one that the player has picked on it.
"""

from __future__ import annotations

import math
from typing import Any, Literal

import gymnasium
import numpy as np

from cyclic_env.envs.cyclic_loop import CyclicLoopEnv
from cyclic_env.errors import ConfigError
from cyclic_env.trajectory.io import dead_reckon
from cyclic_env.validation import check_choice, short_repr

Show = Literal["robot", "truth"]
SHOWS: tuple[Show, ...] = ("robot", "truth")
"""What the player sees: what the robot has sensed, where dead reckoning puts it; or the building and the truth."""

DRIVES = ("forward", "back", "left", "right", "slow")
"""What a key that is held down can do."""

SPOT_SWING = 0.15
"""Wheel speed of a turn on the spot, as a share of full speed: 0.9 rad/s."""
ARC_SPEED, ARC_SWING = 0.85, 0.12
"""Of a turn while driving, likewise: 0.7 rad/s at 1 m/s."""
SLOW = 0.4
"""Share of the speed that is left while the key for slow is held."""

CLOUD_CELL = 0.1
"""Metres within which two ends of beams are drawn as one."""
CELLS = 2**24
"""From west to east and from south to north; two numbers of cells make one of 64 bits."""
CLOUD_SPACING = 0.5
"""Metres of path between two scans that are kept for the drawing."""


class Play:
    """An episode under the player's hands.

    Parameters
    ----------
    env : Env
        A `CyclicLoopEnv` with wheels as actions, or a `Recorder` around one.
    seed : int
        Of every episode.
    show : {"robot", "truth"}

    Attributes
    ----------
    held : set of str
        Which of `DRIVES` are held down.
    paused, ended : bool
    message : str
        What the player should know now.
    info : dict
        The last one.
    total : float
        Of the rewards.
    steps : int
        Taken so far, t.
    """

    def __init__(self, env: gymnasium.Env[Any, Any], *, seed: int = 0, show: Show = "robot") -> None:
        core = env.unwrapped
        if not isinstance(core, CyclicLoopEnv) or core.engine.config.action_type != "wheels":
            raise ConfigError(f"the env is {short_repr(env)}; expected a CyclicLoop environment driven by wheels.")
        self.env = env
        self.core = core
        self.seed = seed
        self.show: Show = check_choice("view", show, SHOWS)
        self.held: set[str] = set()
        self.restart()

    def restart(self) -> None:
        """Begin the episode again."""
        self._observation, self.info = self.env.reset(seed=self.seed)
        self.held.clear()
        self.paused = self.ended = False
        self.total = 0.0
        self.message = ""
        self._picked: int | None = None
        self._claims = False
        self.steps = 0
        self._way = np.zeros((self.core.step_budget + 1, 4))
        self._way[0, :3] = dead_reckon([0.0], [self._observation["compass"]], self.core.trajectory()[0, :2])
        self._cells = np.zeros(0, np.int64)
        self._scanned = -math.inf
        self._keep_scan()

    @property
    def way(self) -> np.ndarray:
        """Of every step: x, y, heading by dead reckoning from the true start, and metres driven, `(t + 1, 4)`."""
        return self._way[: self.steps + 1]

    @property
    def pose(self) -> np.ndarray:
        """Where the player is shown to be, (x, y, heading)."""
        if self.show == "truth":
            return np.array([self.info["x"], self.info["y"], self.info["heading"]])
        return self.way[-1, :3]

    @property
    def positions(self) -> np.ndarray:
        """The way that the player is shown, `(t + 1, 2)`: dead-reckoned, or the truth."""
        return self.core.trajectory()[:, :2] if self.show == "truth" else self.way[:, :2]

    @property
    def cloud(self) -> np.ndarray:
        """Where beams have ended, by dead reckoning, `(n, 2)`."""
        return CLOUD_CELL * (np.stack(np.divmod(self._cells, CELLS), axis=1) - CELLS // 2)

    @property
    def hits(self) -> np.ndarray:
        """Where the beams of the last scan end that met something, by dead reckoning, `(n, 2)`."""
        x, y, heading, _ = self.way[-1]
        laser, ranges = self.core.engine.config.laser, self._observation["laser"]
        bearings = heading + laser.beam_spacing * np.arange(laser.num_beams)
        ends = np.array([x, y]) + ranges[:, None] * np.stack([np.cos(bearings), np.sin(bearings)], axis=1)
        return ends[ranges < laser.range_max]

    def candidate(self) -> int | None:
        """Return the step that a claim would name now: the picked one, or the nearest that was left long enough ago."""
        if self._picked is not None:
            return self._picked
        driven = self.way[:, 3]
        gap = self.core.engine.config.closure.gap
        old = np.flatnonzero(driven[-1] - driven >= gap)
        if not len(old):
            return None
        return int(old[np.argmin(np.hypot(*(self.positions[old] - self.pose[:2]).T))])

    def pick(self, position: Any) -> None:
        """Pick the place of the shown way nearest to a position (x, y) for the next claim."""
        if self.steps:
            self._picked = int(np.argmin(np.hypot(*(self.positions[:-1] - np.asarray(position)).T)))

    def unpick(self) -> None:
        """Let the nearest place be the candidate again."""
        self._picked = None

    def claim(self) -> None:
        """Claim, with the next step, to be back at the candidate."""
        if self.candidate() is None:
            gap = self.core.engine.config.closure.gap
            self.message = f"nothing to claim yet: a place counts when {gap:g} m were driven since, or click on one"
        elif not self.ended:
            self._claims = True

    def pause(self) -> None:
        """Pause, or go on."""
        self.paused = not self.paused

    def action(self) -> np.ndarray:
        """Return the action of the keys held down, and of the claim, `(4,)`."""
        along = ("forward" in self.held) - ("back" in self.held)
        turn = ("left" in self.held) - ("right" in self.held)
        speed = along * (ARC_SPEED if turn else 1.0)
        swing = turn * (ARC_SWING if along else SPOT_SWING)
        share = SLOW if "slow" in self.held else 1.0
        place = self.candidate() if self._claims else None
        if place is None:
            return np.array([share * (speed - swing), share * (speed + swing), -1.0, 0.0])
        return np.array([share * (speed - swing), share * (speed + swing), 1.0, 2 * place / (self.steps + 1) - 1])

    def tick(self) -> None:
        """Take a step, unless paused or at the end."""
        if self.paused or self.ended:
            return
        place = self.candidate() if self._claims else None
        action, self._claims = self.action(), False
        before = self._observation
        self._observation, reward, terminated, truncated, self.info = self.env.step(action)
        self.total += float(reward)
        self._move(before)
        self._keep_scan()
        if place is not None:
            self.unpick()
            self.message = self._said(place)
        if terminated or truncated:
            self.ended = True
            self.message = "success: all seen, all cycles closed" if terminated else "the step budget is spent"

    def _move(self, before: dict[str, np.ndarray]) -> None:
        distance = np.concatenate([before["distance"], self._observation["distance"]])
        compass = [before["compass"], self._observation["compass"]]
        pose = dead_reckon(distance, compass, self.way[-1, :2])[-1]
        driven = self.way[-1, 3] + abs(float(distance[1]) - float(distance[0]))
        self.steps += 1
        self._way[self.steps] = (*pose, driven)

    def _keep_scan(self) -> None:
        driven = self.way[-1, 3]
        if driven - self._scanned >= CLOUD_SPACING:
            self._scanned = driven
            columns, rows = np.round(self.hits / CLOUD_CELL).astype(np.int64).T + CELLS // 2
            self._cells = np.union1d(self._cells, columns * CELLS + rows)

    def _said(self, place: int) -> str:
        ago = self.way[-1, 3] - self.way[place, 3]
        said = f"claimed: here was step {place:,}, {ago:,.0f} m ago"
        if self.show == "robot":
            return said  # the robot is not told either
        if not self.info["claim_judged"]:
            return f"{said}; not judged: too soon after the last claim, or too soon to be back"
        verdict = "right" if self.info["claim_correct"] else "false"
        return f"{said}; {verdict}" + (", and a new cycle closed" if self.info["new_cycle"] else "")

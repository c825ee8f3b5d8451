"""The state of a game, and what the keys do to it, without a window. `scripts.game.view` draws it.

The player drives, and claims that the robot is back where it was at an earlier step: at the nearest position on its
path that it left long enough ago, or at one that the player has picked.
"""

from __future__ import annotations

import math
from typing import Any, Literal

import gymnasium
import numpy as np

from cyclic_env import CyclicLoopEnv
from cyclic_env.errors import ConfigError
from cyclic_env.trajectory.dead_reckoning import dead_reckon
from cyclic_env.validation import check_choice, short_repr

Show = Literal["robot", "truth"]
SHOWS: tuple[Show, ...] = ("robot", "truth")
"""What the player sees: the robot's readings, placed by dead reckoning, or the building and the true path."""

DRIVES = ("forward", "back", "left", "right", "slow")
"""The effects of keys that are held down."""

SPOT_TURN = 0.15
"""Wheel speed of a turn on the spot, as a share of full speed: 0.9 rad/s."""
ARC_SPEED, ARC_TURN = 0.85, 0.12
"""Mean wheel speed, and deviation of each wheel from it, of a turn while driving: 0.7 rad/s at 1 m/s."""
SLOW = 0.4
"""Share of the speed while the key for slow is held."""

CLOUD_CELL = 0.1
"""Side of a cell in metres; the endpoints of beams in a cell are drawn as one."""
CELLS = 2**24
"""Number of cells from west to east and from south to north, so that two cell numbers fit in 64 bits."""
CLOUD_SPACING = 0.5
"""Metres of path between two scans whose endpoints are drawn."""


class Play:
    """An episode under the player's control. Its clock starts when the player first drives.

    Parameters
    ----------
    env : Env
        A `CyclicLoopEnv` whose actions are wheel speeds, or a `Recorder` around one.
    seed : int
        Seed of every episode.
    show : {"robot", "truth"}

    Attributes
    ----------
    held : set of str
        Which of `DRIVES` are held down.
    started, paused, ended : bool
    message : str
        The message to the player.
    info : dict
        The last info.
    episode_return : float
        Sum of the rewards so far.
    steps : int
        Number of steps so far, t.
    """

    def __init__(self, env: gymnasium.Env[Any, Any], *, seed: int = 0, show: Show = "robot") -> None:
        core = env.unwrapped
        if not isinstance(core, CyclicLoopEnv) or core.config.action_type != "wheels":
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
        self.started = self.paused = self.ended = False
        self.episode_return = 0.0
        self.message = "press a key to drive: the clock starts with it"
        self._picked: int | None = None
        self._claims = False
        self.steps = 0
        self._track = np.zeros((self.core.step_budget + 1, 4))
        self._track[0, :3] = dead_reckon([0.0], [self._observation["compass"]], self.core.trajectory()[0, :2])
        self._cells = np.zeros(0, np.int64)
        self._scanned_at = -math.inf
        self._keep_scan()

    @property
    def track(self) -> np.ndarray:
        """Dead-reckoned x, y, heading from the true start, and distance driven, of every step: `(t + 1, 4)`."""
        return self._track[: self.steps + 1]

    @property
    def pose(self) -> np.ndarray:
        """The pose (x, y, heading) at which the robot is shown."""
        if self.show == "truth":
            return np.array([self.info["x"], self.info["y"], self.info["heading"]])
        return self.track[-1, :3]

    @property
    def positions(self) -> np.ndarray:
        """The path that is shown, dead-reckoned or true, `(t + 1, 2)`."""
        return self.core.trajectory()[:, :2] if self.show == "truth" else self.track[:, :2]

    @property
    def cloud(self) -> np.ndarray:
        """Dead-reckoned endpoints of beams so far, `(n, 2)`."""
        return CLOUD_CELL * (np.stack(np.divmod(self._cells, CELLS), axis=1) - CELLS // 2)

    @property
    def hits(self) -> np.ndarray:
        """Dead-reckoned endpoints of the last scan's beams that hit something, `(n, 2)`."""
        x, y, heading, _ = self.track[-1]
        laser, ranges = self.core.config.laser, self._observation["laser"]
        bearings = heading + laser.bearings
        endpoints = np.array([x, y]) + ranges[:, None] * np.stack([np.cos(bearings), np.sin(bearings)], axis=1)
        return endpoints[ranges < laser.range_max]

    def candidate(self) -> int | None:
        """Return the step that a claim would name: the picked one, or the nearest that was left long enough ago."""
        if self._picked is not None:
            return self._picked
        driven = self.track[:, 3]
        old = np.flatnonzero(driven[-1] - driven >= self.core.config.closure.gap)
        if not len(old):
            return None
        return int(old[np.argmin(np.hypot(*(self.positions[old] - self.pose[:2]).T))])

    def pick(self, position: Any) -> None:
        """Pick the step of the shown path nearest to a position (x, y) for the next claim."""
        if self.steps:
            self._picked = int(np.argmin(np.hypot(*(self.positions[:-1] - np.asarray(position)).T)))

    def unpick(self) -> None:
        """Make the nearest step the candidate again."""
        self._picked = None

    def claim(self) -> None:
        """Claim, with the next step, to be back at the candidate."""
        if self.candidate() is None:
            gap = self.core.config.closure.gap
            self.message = f"nothing to claim yet: drive {gap:g} m first, or click on your path"
        elif not self.ended:
            self._claims = True

    def pause(self) -> None:
        """Pause or continue."""
        self.paused = not self.paused

    def action(self) -> np.ndarray:
        """Return the action for the keys held down and the claim, `(4,)`."""
        along = ("forward" in self.held) - ("back" in self.held)
        turn = ("left" in self.held) - ("right" in self.held)
        speed = along * (ARC_SPEED if turn else 1.0)
        difference = turn * (ARC_TURN if along else SPOT_TURN)
        share = SLOW if "slow" in self.held else 1.0
        step = self.candidate() if self._claims else None
        claim = (-1.0, 0.0) if step is None else (1.0, 2 * step / (self.steps + 1) - 1)
        return np.array([share * (speed - difference), share * (speed + difference), *claim])

    def tick(self) -> None:
        """Take a step, unless the game has not started, is paused or has ended."""
        if not self.started and self.held - {"slow"}:
            self.started, self.message = True, ""
        if self.paused or self.ended or not self.started:
            return
        claimed = self.candidate() if self._claims else None
        action, self._claims = self.action(), False
        before = self._observation
        self._observation, reward, terminated, truncated, self.info = self.env.step(action)
        self.episode_return += float(reward)
        self._move(before)
        self._keep_scan()
        if claimed is not None:
            self.unpick()
            self.message = self._verdict(claimed)
        if terminated or truncated:
            self.ended = True
            self.message = "success: everything seen, all cycles closed" if terminated else "the step budget is spent"

    def _move(self, before: dict[str, np.ndarray]) -> None:
        distance = np.concatenate([before["distance"], self._observation["distance"]])
        compass = [before["compass"], self._observation["compass"]]
        pose = dead_reckon(distance, compass, self.track[-1, :2])[-1]
        driven = self.track[-1, 3] + abs(float(distance[1]) - float(distance[0]))
        self.steps += 1
        self._track[self.steps] = (*pose, driven)

    def _keep_scan(self) -> None:
        driven = self.track[-1, 3]
        if driven - self._scanned_at >= CLOUD_SPACING:
            self._scanned_at = driven
            columns, rows = np.round(self.hits / CLOUD_CELL).astype(np.int64).T + CELLS // 2
            self._cells = np.union1d(self._cells, columns * CELLS + rows)

    def _verdict(self, claimed: int) -> str:
        ago = self.track[-1, 3] - self.track[claimed, 3]
        said = f"claimed: I was here at step {claimed:,}, {ago:,.0f} m ago"
        if self.show == "robot":
            return said  # the robot isn't told the verdict either
        if not self.info["claim_judged"]:
            return f"{said}; not judged: too soon after the last claim, or too soon to be back"
        verdict = "correct" if self.info["claim_correct"] else "false"
        return f"{said}; {verdict}" + (", and it closed a new cycle" if self.info["new_cycle"] else "")

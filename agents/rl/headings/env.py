"""The task as Gymnasium knows it: for many robots at once, and for one."""

from __future__ import annotations

import time
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from agents.rl.headings.memory import CANDIDATES, HEADINGS, HOLD, PER_CANDIDATE, PER_HEADING, PER_ROBOT, Rules
from agents.rl.headings.perception import Perception
from cyclic_env import ActionError, ConfigError, CyclicLoopVectorEnv, UsageError
from cyclic_env.validation import as_array, short_repr

FEATURES = ("headings", "candidates", "robot")
FEATURE_MAX = 4.0
CHOICES = (HEADINGS, 1 + CANDIDATES)


def observation_space() -> spaces.Dict:
    """Return the observation space of one robot."""
    shapes = {"headings": (HEADINGS, PER_HEADING), "candidates": (CANDIDATES, PER_CANDIDATE), "robot": (PER_ROBOT,)}
    return spaces.Dict({name: spaces.Box(-FEATURE_MAX, FEATURE_MAX, shapes[name], np.float32) for name in FEATURES})


def action_space() -> spaces.MultiDiscrete:
    """Return the action space of one robot."""
    return spaces.MultiDiscrete(list(CHOICES))


class CyclicLoopHeadingsVectorEnv(VectorEnv[dict[str, np.ndarray], np.ndarray, np.ndarray]):
    """The task of `CyclicLoopHeadingsEnv` for many robots at once; see there.

    Parameters
    ----------
    num_envs : int
    autoreset_mode : AutoresetMode or str
        ``SAME_STEP`` (default) or ``DISABLED``, as for `CyclicLoopVectorEnv`.
    map_name and all others
        As for `CyclicLoopVectorEnv`, but for the action type.

    Attributes
    ----------
    seconds : dict of float
        How long steps have taken since the env was made, by stage: ``"env"``, ``"steering"`` and ``"features"``.
    """

    def __init__(
        self,
        num_envs: int = 1,
        map_name: Any = "killian_court",
        *,
        autoreset_mode: AutoresetMode | str = AutoresetMode.SAME_STEP,
        **settings: Any,
    ) -> None:
        if settings.setdefault("action_type", "twist") != "twist":
            raise ConfigError("the task headings drives by twist actions; leave out action_type.")
        self.autoreset_mode = AutoresetMode[autoreset_mode] if isinstance(autoreset_mode, str) else autoreset_mode
        if self.autoreset_mode == AutoresetMode.NEXT_STEP:
            raise ConfigError("the task headings resets in the SAME_STEP, or not (DISABLED).")
        self.env = CyclicLoopVectorEnv(num_envs, map_name, autoreset_mode=AutoresetMode.DISABLED, **settings)
        config = self.env.config
        self.perception = Perception(num_envs, Rules(laser=config.laser, robot=config.robot, closure=config.closure))
        self.metadata = {**self.env.metadata, "autoreset_mode": self.autoreset_mode}
        self.render_mode = self.env.render_mode
        self.num_envs = num_envs
        self.single_observation_space = observation_space()
        self.single_action_space = action_space()
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.seconds = {"env": 0.0, "steering": 0.0, "features": 0.0}
        self._ended = np.zeros(num_envs, np.bool_)
        self._commands = np.zeros((num_envs, 4), np.float32)

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Begin episodes, as `CyclicLoopVectorEnv.reset` does."""
        observation, infos = self.env.reset(seed=seed, options=options)
        mask = None if options is None else options.get("reset_mask")
        self._begin(np.arange(self.num_envs) if mask is None else np.flatnonzero(mask), observation)
        return self.observation(), infos

    def _begin(self, rows: np.ndarray, observation: dict[str, np.ndarray]) -> None:
        self.perception.begin(rows)
        self.perception.sense(observation, rows)
        self.perception.observe(rows)
        self._ended[rows] = False

    def observation(self) -> dict[str, np.ndarray]:
        """Return the features of all rows, copies."""
        return {name: getattr(self.perception.memory, name).copy() for name in FEATURES}

    def action_masks(self) -> np.ndarray:
        """Return which choices each row has, `(N, HEADINGS + 1 + CANDIDATES)` bool: headings first, then claims."""
        return self.perception.action_masks()

    def step(
        self, actions: Any, *, active: np.ndarray | None = None
    ) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Carry out a decision of each row.

        Parameters
        ----------
        actions : (N, 2) int array
        active : (N,) bool, optional
            As for `CyclicLoopVectorEnv.step`.

        Raises
        ------
        ActionError
            If the actions are none of the action space.
        UsageError
            If the episode of a row has ended and was not reset.
        """
        active = np.ones(self.num_envs, np.bool_) if active is None else active.copy()
        if self._ended[active].any():
            raise UsageError("an episode has ended: call reset() first.")
        decided = np.flatnonzero(active)
        actions = self._checked(actions)[decided]
        self.perception.decide(actions[:, 0], decided)
        self._claim(actions[:, 1], decided)
        rewards, steps = np.zeros(self.num_envs), np.zeros(self.num_envs, np.int64)
        terms: dict[str, np.ndarray] = {}
        terminated, truncated = np.zeros((2, self.num_envs), np.bool_)
        infos: dict[str, Any] = {}
        for _ in range(HOLD):
            rows = np.flatnonzero(active)
            reward, terminates, truncates, infos = self._drive(active, rows)
            rewards[rows] += reward[rows]
            steps[rows] += 1
            for name, values in infos["reward_terms"].items():
                if not name.startswith("_"):
                    terms.setdefault(name, np.zeros(self.num_envs))[rows] += values[rows]
            terminated[rows], truncated[rows] = terminates[rows], truncates[rows]
            active[rows] = ~(terminated | truncated)[rows]
            if not active.any():
                break
        infos["reward_terms"] |= terms
        infos["steps"], infos["_steps"] = steps, np.ones(self.num_envs, np.bool_)
        begin = time.perf_counter()
        self.perception.observe(decided)
        self.seconds["features"] += time.perf_counter() - begin
        self._ended[decided] = (terminated | truncated)[decided]
        if self._ended.any() and self.autoreset_mode == AutoresetMode.SAME_STEP:
            infos = self._reset_ended(infos)
        return self.observation(), rewards, terminated, truncated, infos

    def _claim(self, choices: np.ndarray, rows: np.ndarray) -> None:
        """Write the claims of the robots `rows` into the commands."""
        self._commands[:, 2] = -1.0
        claiming, claimed = self.perception.claim(choices, rows)
        self._commands[claiming, 2] = 1.0
        self._commands[claiming, 3] = 2 * claimed / (self.perception.memory.robots["steps"][claiming] + 1) - 1

    def _drive(self, active: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Step the active robots, `rows`, once; a claim is made in the first step only."""
        begin = time.perf_counter()
        self.perception.steer(rows, self._commands)
        steered = time.perf_counter()
        observation, reward, terminated, truncated, infos = self.env.step(self._commands, active=active)
        self.seconds["steering"] += steered - begin
        self.seconds["env"] += time.perf_counter() - steered
        self._commands[:, 2] = -1.0
        self.perception.sense(observation, rows)
        return reward, terminated, truncated, infos

    def _checked(self, actions: Any) -> np.ndarray:
        actions = as_array(actions, "the action", "one of the action space", ActionError)
        if actions.shape != (self.num_envs, 2) or actions.dtype.kind not in "iu":
            raise ActionError(
                f"the actions are {actions.dtype} of shape {actions.shape}; expected integers ({self.num_envs}, 2)."
            )
        if ((actions < 0) | (actions >= CHOICES)).any():
            raise ActionError(f"an action is beyond {self.single_action_space}; got {short_repr(actions.tolist())}.")
        return actions.astype(np.int64)

    def _reset_ended(self, infos: dict[str, Any]) -> dict[str, Any]:
        """Begin new episodes where they have ended; return the infos, with the last ones under ``final_info``."""
        ended = self._ended
        final = np.full(self.num_envs, None, dtype=object)
        features = self.observation()
        for row in np.flatnonzero(ended):
            final[row] = {name: value[row] for name, value in features.items()}
        observation, first = self.env.reset(options={"reset_mask": ended.copy()})
        merged = _merged(infos, first, ended)
        merged |= {"final_obs": final, "final_info": infos, "_final_obs": ended.copy(), "_final_info": ended.copy()}
        self._begin(np.flatnonzero(ended), observation)
        return merged

    def close_extras(self, **kwargs: Any) -> None:
        """End the threads."""
        self.env.close()
        self.perception.close()


def _merged(infos: dict[str, Any], first: dict[str, Any], ended: np.ndarray) -> dict[str, Any]:
    """Return the infos, those of rows that have ended replaced by the `first` of their next episodes."""
    merged = {}
    for name, values in infos.items():
        if isinstance(values, dict):
            merged[name] = _merged(values, first[name], ended)
        elif name.startswith("_") or name not in first:
            merged[name] = values
        else:
            merged[name] = np.where(ended, first[name], values)
    return merged


class CyclicLoopHeadingsEnv(gymnasium.Env[dict[str, np.ndarray], np.ndarray]):
    """`CyclicLoopEnv` with decisions in place of wheel speeds, and features of a map in place of scans.

    The robot draws a map of half-metre cells from its own observations, holds its track straight by matching scans,
    and looks for old keyframes (a scan for each metre) that it may be back at. What is observed is described here;
    nothing of the truth is used.

    ## Action space

    `MultiDiscrete([16, 4])`, held for five steps of the environment, a second:

    | number | choices | meaning |
    |---|---|---|
    | 0 | 16 | heading to drive to, in sixteenths of a turn counter-clockwise from the robot's, round what is near |
    | 1 | 4 | 0: no claim; c = 1, 2, 3: "I am back at candidate c", which is claimed in the first of the five steps |

    A claim of a candidate that there isn't, or less than `claim_spacing` (2 m) after the last one, is no claim.
    `action_masks()` returns which choices there are, `(16 + 4,)` bool, as sb3-contrib's `MaskablePPO` asks for them.

    ## Observation space

    `Dict` of float32 boxes; all numbers are about 1 or less.

    `headings` `(16, 6)`, of each heading:

    | number | feature |
    |---|---|
    | 0 | how far the way is clear, as a share of the laser's reach |
    | 1 | exp(-d / 20 m), where d is the way that leads off in this heading to the nearest undriven cell, which is in
      sight of no place within 2.5 m where the robot has been; 0.5 more for the nearest of all headings |
    | 2 | the same for the nearest undriven cell at the edge of what was seen |
    | 3, 4 | how much of both lies that way: log(1 + sum of exp(-d / 40 m)) / 5 and / 3 |
    | 5 | how lately it was driven, 2 m from here: exp(-decisions since / 60) |

    `candidates` `(3, 14)`, of each place that the robot may be back at: the two nearest first, and last the one whose
    scan looks most like the robot's.

    | number | feature |
    |---|---|
    | 0 | 1 if there is such a candidate; all others are 0 if not |
    | 1 | distance from the track, / 4 m |
    | 2 | inlier ratio of the match of the two scans |
    | 3 | by how much that exceeds the mean of matches of neighbouring keyframes, x 4 |
    | 4 | share of the beams that are inliers |
    | 5 | share of the beams that speak for the position in the direction that is known least, x 10 |
    | 6 | distance of the two places as matched, / 3 m (a claim is right within 3 m) |
    | 7 | by how much the match would move the track, / 4 m |
    | 8 | tanh(path since then / 200 m) |
    | 9 | 1 if that place is in sight |
    | 10 | by how much the track is expected to err between the two, / 4 m |
    | 11 | by how much the match would move the track, in units of thrice that and half a metre |
    | 12 | by how much the inlier ratio exceeds that of candidates which call for another position, x 4 |
    | 13 | exp(-d / 0.8 m), where d is the distance to the position that the last good match called for; 0 after 3 m |

    `robot` `(12,)`:

    | number | feature |
    |---|---|
    | 0, 1 | exp(-d / 20 m) of the nearest cell of all that is undriven, and at the edge |
    | 2, 3 | 1 if there is one |
    | 4 | 1 if a claim can be judged |
    | 5 | path since the last claim, / 20 m, at most 1 |
    | 6 | metres driven in the last decision, as a share of what is possible |
    | 7, 8 | cosine and sine of the last heading that was chosen, from the robot's |
    | 9 | mean inlier ratio of neighbouring keyframes |
    | 10 | tanh(s / 5 m), where s is the way over which all good matches have called for the same correction |
    | 11 | standard deviation of the compass's turns from metre to metre, x 20 |

    ## Rewards, start, end, infos

    As those of `CyclicLoopEnv`: the rewards of the five steps are added up, and the info is that of the last one, with
    the added `reward_terms` and `steps`. When the episode ends within a decision, the decision ends with it.

    Parameters
    ----------
    map_name and all others
        As for `CyclicLoopEnv`, but for the action type. Plans may be up to 256 m wide.
    """

    def __init__(self, map_name: Any = "killian_court", *, render_mode: str | None = None, **settings: Any) -> None:
        self.rows = CyclicLoopHeadingsVectorEnv(
            1, map_name, autoreset_mode=AutoresetMode.DISABLED, render_mode=render_mode, **settings
        )
        self.render_mode = render_mode
        self.metadata = self.rows.env.metadata
        self.observation_space = observation_space()  # pyright: ignore[reportAttributeAccessIssue]
        self.action_space = action_space()  # pyright: ignore[reportAttributeAccessIssue]

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Begin an episode."""
        super().reset(seed=seed)
        observation, infos = self.rows.reset(seed=seed, options=options)
        return {name: value[0] for name, value in observation.items()}, row_info(infos, 0)

    def step(self, action: Any) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Carry out a decision."""
        observation, rewards, terminated, truncated, infos = self.rows.step(np.asarray(action)[None])
        features = {name: value[0] for name, value in observation.items()}
        return features, float(rewards[0]), bool(terminated[0]), bool(truncated[0]), row_info(infos, 0)

    def action_masks(self) -> np.ndarray:
        """Return which choices there are, as sb3-contrib asks for them."""
        return self.rows.action_masks()[0]

    def render(self) -> Any:
        """Return a picture, or show one."""
        pictures = self.rows.env.render()
        return None if pictures is None else pictures[0]

    def close(self) -> None:
        """Close the window and end the threads."""
        self.rows.close()


def row_info(infos: dict[str, Any], row: int) -> dict[str, Any]:
    """Return the info of one row as a single environment has it."""
    return {
        name: row_info(values, row) if isinstance(values, dict) else values[row].item()
        for name, values in infos.items()
        if not name.startswith("_") and name not in ("final_obs", "final_info")
    }

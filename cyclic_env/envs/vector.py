"""`CyclicLoopVectorEnv`: the environment for many robots at once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from cyclic_env.config import EnvConfig
from cyclic_env.engine.building import INFO
from cyclic_env.engine.engine import Engine
from cyclic_env.engine.stage_timer import StageTimer
from cyclic_env.envs.arguments import (
    RENDER_FPS,
    RENDER_MODES,
    check_render_mode,
    check_seed,
    env_config,
    peek_rng,
    start_option,
)
from cyclic_env.envs.exclusive_access import ExclusiveAccess
from cyclic_env.envs.spaces import action_space, observation_space
from cyclic_env.errors import ConfigError, FloorPlanError, UsageError
from cyclic_env.floor_plans import FloorPlan, MapName
from cyclic_env.task.rewards import REWARD_TERMS
from cyclic_env.validation import as_array, check_choice, is_integer, short_repr

NUM_ENVS_MAX = 1_000_000


class CyclicLoopVectorEnv(VectorEnv[dict[str, np.ndarray], np.ndarray, np.ndarray]):
    """Many robots, each in an episode of its own, stepped together; see `CyclicLoopEnv` for what an episode is.

    It behaves as a ``SyncVectorEnv`` of single environments would, to the bit, and is many times faster. Row i is
    seeded with ``seed + i``, or with ``seed[i]``, and draws from a generator of its own.

    Parameters
    ----------
    num_envs : int
    autoreset_mode : AutoresetMode or str
        ``NEXT_STEP`` (default): the step after an episode's end ignores the action and resets. ``SAME_STEP``: the step
        that ends an episode returns the first observation of the next one, and the last one in ``infos["final_obs"]``
        and ``infos["final_info"]``. ``DISABLED``: reset by ``reset(options={"reset_mask": mask})``.
    max_episode_steps : int, optional
        Truncates episodes before the step budget does. As with Gymnasium's ``TimeLimit``, nothing else changes: a
        revisit event that is still open is not settled.
    num_threads : int, optional
        Greatest number of threads that step the robots, by default one for each core that the process may use. The
        results don't depend on it.
    map_name, config, render_mode, **settings
        As for `CyclicLoopEnv`; ``reset(options={"start": ...})`` takes (3,) or (N, 3).

    Attributes
    ----------
    config : EnvConfig
    floor_plans : sequence of FloorPlan
        The pool from which every reset draws a plan.
    """

    metadata: dict[str, Any] = {"render_modes": list(RENDER_MODES), "render_fps": RENDER_FPS}  # noqa: RUF012 (Gymnasium's own)

    def __init__(
        self,
        num_envs: int = 1,
        map_name: MapName | Sequence[MapName] | None = None,
        *,
        config: EnvConfig | Mapping[str, Any] | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        max_episode_steps: int | None = None,
        num_threads: int | None = None,
        render_mode: str | None = None,
        **settings: Any,
    ) -> None:
        self.num_envs = _check_count("num_envs", num_envs, NUM_ENVS_MAX)
        self.max_episode_steps = (
            _check_count("max_episode_steps", max_episode_steps) if max_episode_steps is not None else None
        )
        num_threads = _check_count("num_threads", num_threads) if num_threads is not None else None
        self.autoreset_mode = _autoreset_mode(autoreset_mode)
        self.metadata = {**self.metadata, "autoreset_mode": self.autoreset_mode}
        self.config, self.floor_plans = env_config(map_name, config, settings)
        self.engine = Engine(self.config, self.floor_plans, self.num_envs, num_threads)
        self.single_action_space = action_space(self.config.action_type)
        self.single_observation_space = observation_space(self.config.laser)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.render_mode = check_render_mode(render_mode)
        self._rngs: list[np.random.Generator] = []
        self._seeds: list[int] = []
        self._ended = np.zeros(self.num_envs, np.bool_)
        self._all = np.ones(self.num_envs, np.bool_)
        self._access = ExclusiveAccess()
        self._renderers: list[Any] = []

    @property
    def np_random(self) -> tuple[np.random.Generator, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """The rows' generators."""
        self._seed([None] * self.num_envs)
        return tuple(self._rngs)

    @property
    def np_random_seed(self) -> tuple[int, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """The seeds of the rows' generators."""
        self._seed([None] * self.num_envs)
        return tuple(self._seeds)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Begin episodes in all rows, or in those of ``options["reset_mask"]``, an `(N,)` array of bools.

        Raises
        ------
        ConfigError, FloorPlanError
            If the seeds, the mask, the starts, or the plans that the reset draws don't fit; the running episodes go on.
        """
        with self._access:
            start = start_option(options, "reset_mask")
            mask = self._mask(None if options is None else options.get("reset_mask"))
            rows = np.flatnonzero(mask)
            starts = self._starts(start)
            seeds = self._row_seeds(seed)
            if starts is not None or not self.engine.is_prepared:  # refuse before anything changes
                rngs = self.np_random
                for row in rows.tolist():
                    self.engine.draw_start(peek_rng(rngs[row], seeds[row]), None if starts is None else starts[row])
            self._seed(seeds, mask)
            self._reset_rows(rows, starts)
            return self.engine.observation(), self._infos(mask)

    def step(
        self, actions: Any, *, active: np.ndarray | None = None
    ) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Step every row, and reset ended rows as the autoreset mode says.

        Parameters
        ----------
        actions : (N, ...) array
        active : (N,) bool, optional
            The rows to step, with ``DISABLED`` only; ended rows must be left out until they are reset. A row that is
            left out draws no random numbers and repeats the results of its last step, with a reward of 0.

        Raises
        ------
        ActionError, UsageError
            If the actions don't fit, or a row has no running episode; nothing has changed.
        FloorPlanError
            If a row that is reset draws a plan that does not suit the robot. The step has been taken; the next one
            resets that row again, with a new draw.
        """
        with self._access:
            ended, skip = self._ended.copy(), self._rows_to_skip(active)
            self.engine.step(actions, self._rngs, skip=skip if skip.any() else None)
            outcome = self.engine.outcome
            rewards, terminated, truncated = (
                outcome["reward"].copy(),
                outcome["terminated"].copy(),
                outcome["truncated"].copy(),
            )
            if self.max_episode_steps is not None:
                truncated |= self.engine.steps >= self.max_episode_steps
            rewards[skip] = 0.0
            if ended.any() and self.autoreset_mode != AutoresetMode.DISABLED:  # NEXT_STEP, or a reset failed before
                self._reset_rows(np.flatnonzero(ended))
                terminated[ended], truncated[ended] = False, False
            ended = self._ended = terminated | truncated
            infos: dict[str, Any] = {}
            if self.autoreset_mode == AutoresetMode.SAME_STEP and ended.any():
                infos = {"final_obs": self._final_observation(ended), "final_info": self._infos(ended)}
                infos.update(_final_obs=ended.copy(), _final_info=ended.copy())
                self._reset_rows(np.flatnonzero(ended))
            return self.engine.observation(), rewards, terminated, truncated, infos | self._infos(self._all)

    def _rows_to_skip(self, active: np.ndarray | None) -> np.ndarray:
        """Return which rows a step leaves out, `(N,)` bool: those not `active`, by default those that have ended."""
        disabled = self.autoreset_mode == AutoresetMode.DISABLED
        if active is not None and not disabled:
            raise UsageError("rows can be left out of a step only with the autoreset mode DISABLED.")
        if disabled and (self._ended if active is None else self._ended & active).any():
            rows = short_repr(np.flatnonzero(self._ended).tolist())
            raise UsageError(
                f"the episodes of rows {rows} have ended: reset them with options={{'reset_mask': mask}} first."
            )
        return self._ended.copy() if active is None else ~active

    def _reset_rows(self, rows: np.ndarray, starts: np.ndarray | None = None) -> None:
        for row in rows:
            self.engine.reset_row(int(row), self._rngs[row], None if starts is None else starts[row])
        self.engine.measure(rows, self._rngs)
        self._ended[rows] = False

    def _infos(self, mask: np.ndarray) -> dict[str, Any]:
        """Return copies of the infos; as in Gymnasium, ``_key`` tells for which rows `key` holds."""
        infos: dict[str, Any] = {}
        given = mask.copy()
        given.flags.writeable = False  # all keys share one mask
        for name in INFO.names or ():
            infos[name] = self._where(mask, self.engine.info[name])
            infos[f"_{name}"] = given
        terms: dict[str, Any] = {}
        for i, name in enumerate(REWARD_TERMS):
            terms[name] = self._where(mask, self.engine.terms[:, i])
            terms[f"_{name}"] = given
        return infos | {"reward_terms": terms, "_reward_terms": given}

    def _where(self, mask: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Return a copy of the values, zero outside the mask."""
        return values.copy() if mask is self._all else np.where(mask, values, np.zeros((), values.dtype))

    def _final_observation(self, ended: np.ndarray) -> np.ndarray:
        """Return the last observations of the episodes that ended, as Gymnasium does: an array of dicts and None."""
        final = np.full(self.num_envs, None, dtype=object)
        observation = self.engine.observation()
        for row in np.flatnonzero(ended):
            final[row] = {name: value[row] for name, value in observation.items()}
        return final

    def _seed(self, seeds: Sequence[int | None], mask: np.ndarray | None = None) -> None:
        """Seed the rows that have a seed, and those that have no generator yet."""
        if not self._rngs:
            fresh = [seeding.np_random() for _ in range(self.num_envs)]
            self._rngs, self._seeds = [rng for rng, _ in fresh], [seed for _, seed in fresh]
        for row, seed in enumerate(seeds):
            if seed is not None and (mask is None or mask[row]):
                self._rngs[row], self._seeds[row] = seeding.np_random(seed)

    def _row_seeds(self, seed: int | Sequence[int | None] | None) -> Sequence[int | None]:
        if isinstance(seed, np.ndarray):
            seed = seed.tolist()
        if isinstance(seed, Sequence) and not isinstance(seed, str | bytes):
            if len(seed) != self.num_envs:
                raise ConfigError(
                    f"{len(seed)} seeds were given for {self.num_envs} rows; give one seed, or one for each row."
                )
            return [check_seed(value) for value in seed]
        first = check_seed(seed)
        return [None if first is None else first + row for row in range(self.num_envs)]

    def _mask(self, mask: Any) -> np.ndarray:
        if mask is None:
            return self._all
        if (
            not isinstance(mask, np.ndarray)
            or mask.dtype != np.bool_
            or mask.shape != (self.num_envs,)
            or not mask.any()
        ):
            raise ConfigError(
                f"options['reset_mask'] must be an array of {self.num_envs} bools, at least one of them True."
            )
        return mask.copy()

    def _starts(self, start: Any) -> np.ndarray | None:
        if start is None:
            return None
        expected = f"(x, y, heading), or {self.num_envs} rows of these"
        starts = as_array(start, "start", expected, FloorPlanError)
        if starts.shape not in ((3,), (self.num_envs, 3)):
            raise FloorPlanError(f"start is {short_repr(start)}; expected {expected}.")
        return np.broadcast_to(starts, (self.num_envs, 3))

    def floor_plan(self, row: int) -> FloorPlan:
        """Return the building of a row's running episode."""
        return self.engine.plan(row)

    def step_budget(self, row: int) -> int:
        """Return after how many steps a row's running episode is truncated."""
        return self.engine.step_budget(row)

    @property
    def info_records(self) -> np.ndarray:
        """The scalars of the current infos: a read-only `(N,)` structured array, cheaper than the infos of `step`."""
        records = self.engine.info.view()
        records.flags.writeable = False
        return records

    def time_stages(self) -> StageTimer:
        """Return a timer that from now on adds up how long the stages of each step take; see `StageTimer`."""
        self.engine.timer = timer = StageTimer()
        return timer

    def trajectory(self, row: int) -> np.ndarray:
        """Return a row's true path since its reset, `(t + 1, 3)`: x, y and path length, metres."""
        return self.engine.trajectory(row)

    def claims(self, row: int) -> np.ndarray:
        """Return a row's judged claims; see `CyclicLoopEnv.claims`."""
        return self.engine.claims(row)

    def seen_cells(self, row: int) -> np.ndarray:
        """Return what a row has seen; see `CyclicLoopEnv.seen_cells`."""
        return self.engine.seen_cells(row)

    def render(self) -> tuple[Any, ...] | None:
        """Return a picture of every row, `(height, width, 3)` uint8 each; with ``"human"``, show row 0 in a window."""
        if self.render_mode is None:
            return None
        for row in range(self.num_envs):
            self.engine.check_placed(row)
        if not self._renderers:
            from cyclic_env.rendering.renderer import Renderer

            count = 1 if self.render_mode == "human" else self.num_envs
            self._renderers = [Renderer(self.render_mode, self.metadata["render_fps"]) for _ in range(count)]
        return tuple(renderer.draw(self, row) for row, renderer in enumerate(self._renderers))

    def close_extras(self, **kwargs: Any) -> None:
        """Close the window and end the threads."""
        with self._access:
            for renderer in self._renderers:
                renderer.close()
            self._renderers = []
            self.engine.close()

    def __getstate__(self) -> dict[str, Any]:
        with self._access:
            return {**self.__dict__, "_renderers": []}


def _check_count(name: str, count: Any, most: int | None = None) -> int:
    if not is_integer(count) or count < 1 or (most is not None and count > most):
        limit = "of at least 1" if most is None else f"from 1 to {most}"
        raise ConfigError(f"{name} is {short_repr(count)}; expected a whole number {limit}.")
    return int(count)


def _autoreset_mode(mode: AutoresetMode | str) -> AutoresetMode:
    if isinstance(mode, AutoresetMode):
        return mode
    by_name = {name: member for member in AutoresetMode for name in (member.name, member.value)}
    return by_name[check_choice("autoreset mode", mode, by_name)]

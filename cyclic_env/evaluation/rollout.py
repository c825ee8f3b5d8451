"""Roll out any policy, one episode for each seed, and score it.

A policy is any object with a `predict` method like Stable-Baselines3's ``PolicyPredictor``. Always report false claims
next to cycles closed: a policy that claims at every step closes cycles too.
"""

from __future__ import annotations

from bisect import insort
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from functools import partial
from itertools import islice
from typing import Any, Protocol

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv

from cyclic_env.envs.vector import CyclicLoopVectorEnv
from cyclic_env.errors import ConfigError
from cyclic_env.evaluation.statistics import Evaluation
from cyclic_env.floor_plans import PlanPool, pool_label
from cyclic_env.validation import is_integer, short_repr

BATCH_SIZE = 16
"""Default maximum number of episodes to run in parallel."""

EPISODES_MAX = 1_000_000
"""Maximum number of episodes per evaluation; anything larger is assumed to be a typo."""


class Policy(Protocol):
    """The interface of a policy.

    A policy may also have:

    - ``reseed(state, seeds) -> state``, called whenever episodes start, with one seed per row (None for rows in which
      none starts), so that the policy's random numbers need not depend on the row or the batch.
    - ``attach(env)``, called once before the first episode, so that a privileged policy can look into the environment.
    - ``action_type``, the kind of actions that it returns, so that `evaluate` can refuse an environment with another.
    """

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[np.ndarray, Any]:
        """Return a batch of actions, and the state to pass to the next call."""
        ...


def evaluate(
    policy: Policy,
    *,
    agent: str = "policy",
    seeds: Iterable[int] = range(10),
    map_name: Any = "killian_court",
    noise: Any = "ideal",
    num_envs: int | None = None,
    every_plan: bool = False,
    deterministic: bool = True,
    on_step: Callable[[Evaluation], None] | None = None,
    **settings: Any,
) -> Evaluation:
    """Roll out a policy on the native vector env, one episode for each seed.

    Parameters
    ----------
    policy : Policy
    agent : str
        Name of the policy in reports.
    seeds : iterable of int
        Must be distinct. They have no effect if the policy is deterministic, the noise ``"ideal"`` and the start the
        plan's own.
    map_name, noise, settings
        As for `CyclicLoopEnv`.
    num_envs : int, optional
        Maximum number of episodes to run in parallel; by default `BATCH_SIZE`.
    every_plan : bool
        Run the episode of seed s on plan s modulo the number of plans; by default an episode draws its plan.
    deterministic : bool
        Passed to the policy.
    on_step : callable, optional
        Called after every step with the evaluation so far.

    Raises
    ------
    ConfigError, FloorPlanError
        If the policy, the seeds or the settings don't fit.
    """
    seeds = checked_seeds(seeds)
    num_envs = BATCH_SIZE if num_envs is None else num_envs
    settings["noise"] = noise
    evaluation, pool = _prepare_evaluation(policy, agent, map_name, seeds, num_envs, settings)
    order = {seed: index for index, seed in enumerate(seeds)}
    notify = None if on_step is None else partial(on_step, evaluation)
    for plans, plan_seeds in _seeds_by_plan(pool, seeds) if every_plan else [(pool, seeds)]:
        with closing(_make_env(plans, plan_seeds, num_envs, settings)) as env:
            for record in rollout(policy, env, plan_seeds, deterministic=deterministic, on_step=notify):
                insort(evaluation.episodes, record, key=lambda episode: order[episode["seed"]])
    return evaluation


def _prepare_evaluation(
    policy: Policy, agent: str, map_name: Any, seeds: Sequence[int], num_envs: int, settings: Mapping[str, Any]
) -> tuple[Evaluation, PlanPool]:
    """Check all plans and settings by making an environment; return an evaluation without episodes, and the plans."""
    env = _make_env(map_name, seeds, num_envs, settings)
    config, pool = env.config, env.floor_plans
    env.close()
    action_type = getattr(policy, "action_type", config.action_type)
    if action_type != config.action_type:
        raise ConfigError(
            f"the policy has action type {short_repr(action_type)}, but the environment has {config.action_type!r}."
        )
    evaluation = Evaluation(
        agent=agent,
        map=pool_label(pool.names),
        noise=config.noise_name,
        action_type=config.action_type,
        random_start=config.random_start,
        seeds=tuple(seeds),
        episodes=[],
    )
    return evaluation, pool


def _make_env(map_name: Any, seeds: Sequence[int], num_envs: int, settings: Mapping[str, Any]) -> CyclicLoopVectorEnv:
    """Return an environment with at most `num_envs` rows, and no more than there are seeds."""
    num_rows = min(num_envs, len(seeds)) if is_integer(num_envs) else num_envs  # the environment refuses anything else
    return CyclicLoopVectorEnv(num_rows, map_name, autoreset_mode="SAME_STEP", **settings)


def _seeds_by_plan(pool: PlanPool, seeds: Sequence[int]) -> Iterator[tuple[PlanPool, list[int]]]:
    """Yield each plan, as a pool of one, with the seeds whose episodes run on it; plans without seeds are left out."""
    for index in range(len(pool)):
        plan_seeds = [seed for seed in seeds if seed % len(pool) == index]
        if plan_seeds:
            yield pool[index : index + 1], plan_seeds


def rollout(
    policy: Policy,
    env: VectorEnv,
    seeds: Iterable[int],
    *,
    deterministic: bool = True,
    on_step: Callable[[], None] | None = None,
) -> Iterator[dict[str, Any]]:
    """Run one episode for each seed, and yield a record of each as it ends.

    A row whose episode has ended takes the next seed, so the records come in the order in which the episodes end. If
    the policy's rows don't depend on each other, the record of a seed is the same in any row of a batch of any size.
    (Deterministic neural networks are such policies, up to rounding.)

    Parameters
    ----------
    policy : Policy
    env : VectorEnv of CyclicLoop environments
        With autoreset mode ``SAME_STEP``: ours, or a ``SyncVectorEnv`` of single ones.
    seeds : iterable of int
    deterministic : bool
        Passed to the policy.
    on_step : callable, optional
        Called after every step.

    Yields
    ------
    dict
        ``seed``, ``map``, ``return``, ``steps``, ``terminated``, ``truncated``, all scalars of the last info, and
        ``reward_terms``, the sums of the return's terms.

    Raises
    ------
    ConfigError
        If the policy, the env or the seeds don't fit. Since this is a generator, it is raised on the first iteration.
    """
    if isinstance(policy, type) or not callable(getattr(policy, "predict", None)):
        raise ConfigError(f"the policy is {short_repr(policy)}; expected an object with predict(observation, ...).")
    if not isinstance(env, VectorEnv) or env.metadata.get("autoreset_mode") != AutoresetMode.SAME_STEP:
        raise ConfigError(f"the env is {short_repr(env)}; expected a vector env with autoreset_mode='SAME_STEP'.")
    batch = _Batch(policy, env, checked_seeds(seeds))
    while batch.is_running:
        yield from batch.step(deterministic)
        if on_step is not None:
            on_step()


class _Batch:
    """The rows of a vector env, each running the episode of a seed.

    A row for which no seed is left is idle: it still steps, as all rows of a vector env do, but nothing is recorded.
    """

    def __init__(self, policy: Policy, env: VectorEnv, seeds: Sequence[int]) -> None:
        num_rows = env.num_envs
        self._policy, self._env = policy, env
        attach = getattr(policy, "attach", None)
        if attach is not None:
            attach(env)
        self._waiting = deque(seeds)
        self._seeds: list[int | None] = [self._next_seed() for _ in range(num_rows)]
        # Rows that are idle from the start get seed 0, so that they too are the same in every run.
        self._observation, _ = env.reset(seed=[0 if seed is None else seed for seed in self._seeds])  # pyright: ignore[reportArgumentType]
        self._state, self._episode_start = None, np.ones(num_rows, np.bool_)
        self._on_episodes_started(self._seeds)
        self._returns, self._steps = np.zeros(num_rows), np.zeros(num_rows, np.int64)
        self._terms: dict[str, np.ndarray] = {}

    def _next_seed(self) -> int | None:
        return self._waiting.popleft() if self._waiting else None

    def _on_episodes_started(self, seeds: Sequence[int | None]) -> None:
        """Tell the policy the seeds of the episodes that have just started, and note the plans of all rows."""
        reseed = getattr(self._policy, "reseed", None)
        if reseed is not None:
            self._state = reseed(self._state, seeds)
        self._maps = _map_names(self._env)

    @property
    def is_running(self) -> bool:
        return any(seed is not None for seed in self._seeds)

    def step(self, deterministic: bool) -> list[dict[str, Any]]:
        """Step all rows, and return the records of the episodes that ended."""
        result = self._policy.predict(
            self._observation, state=self._state, episode_start=self._episode_start, deterministic=deterministic
        )
        if not isinstance(result, tuple) or len(result) != 2:
            raise ConfigError(f"the policy's predict returned {short_repr(result)}; expected a tuple (actions, state).")
        actions, self._state = result
        self._observation, rewards, terminated, truncated, infos = self._env.step(actions)
        ended = terminated | truncated
        self._returns += rewards
        self._steps += 1
        for name, values in _reward_terms(infos, ended).items():
            self._terms[name] = self._terms.get(name, 0.0) + values
        self._episode_start = ended.copy()
        rows = np.flatnonzero(ended).tolist()
        # Where an episode has ended, `infos` already describes the next one; "final_info" has those of its last step.
        outcomes = {"terminated": terminated, "truncated": truncated, **infos.get("final_info", {})}
        records = [self._record(row, outcomes) for row in rows if self._seeds[row] is not None]
        for values in (self._returns, self._steps, *self._terms.values()):
            values[ended] = 0
        self._start_next(rows)
        return records

    def _record(self, row: int, outcomes: Mapping[str, Any]) -> dict[str, Any]:
        return {
            "seed": self._seeds[row],
            "map": self._maps[row],
            "return": float(self._returns[row]),
            "steps": int(self._steps[row]),
            **_scalars(outcomes, row),
            "reward_terms": {name: float(values[row]) for name, values in self._terms.items()},
        }

    def _start_next(self, rows: Sequence[int]) -> None:
        """Start the episodes of the next seeds in rows whose episodes have ended.

        The env has reset these rows by itself (SAME_STEP), but without our seeds: they are reset once more with them.
        """
        new_seeds: list[int | None] = [None] * self._env.num_envs
        for row in rows:
            if self._seeds[row] is not None:
                self._seeds[row] = new_seeds[row] = self._next_seed()
        mask = np.array([seed is not None for seed in new_seeds])
        if mask.any():
            self._observation, _ = self._env.reset(seed=new_seeds, options={"reset_mask": mask})  # pyright: ignore[reportArgumentType]
            self._on_episodes_started(new_seeds)


def checked_seeds(seeds: Iterable[int]) -> list[int]:
    """Return the seeds as a list.

    Raises
    ------
    ConfigError
        If there are no seeds or more than `EPISODES_MAX`, or one is repeated or is not a non-negative integer.
    """
    if not isinstance(seeds, Iterable):
        raise ConfigError(
            f"seeds is {short_repr(seeds)}; expected an iterable of non-negative integers, such as range(10)."
        )
    checked = list(islice(seeds, EPISODES_MAX + 1))
    if not checked:
        raise ConfigError("there are no seeds, so there is nothing to evaluate; give at least one.")
    if len(checked) > EPISODES_MAX:
        raise ConfigError(f"too many seeds: the limit is {EPISODES_MAX:,}.")
    for seed in checked:
        if not is_integer(seed) or seed < 0:
            raise ConfigError(f"a seed is {short_repr(seed)}; expected a non-negative integer.")
    if len(set(checked)) < len(checked):
        raise ConfigError("a seed is given twice, which would count the same episode twice; give each seed once.")
    return [int(seed) for seed in checked]


def _map_names(env: VectorEnv) -> list[str]:
    """Return the name of every row's floor plan."""
    if isinstance(env.unwrapped, CyclicLoopVectorEnv):
        return [env.unwrapped.floor_plan(row).name for row in range(env.num_envs)]
    try:
        return [plan.name for plan in env.unwrapped.get_attr("floor_plan")]  # pyright: ignore[reportAttributeAccessIssue]
    except AttributeError as error:
        raise ConfigError(f"the env is {short_repr(env)}; expected a vector env of CyclicLoop environments.") from error


def _reward_terms(infos: Mapping[str, Any], ended: np.ndarray) -> dict[str, np.ndarray]:
    """Return the terms of this step's reward, `(N,)` each; where an episode ended, those of its last step."""
    # Beside each value, a vector env of Gymnasium's has a mask `_name` that tells which rows have the value.
    terms = {name: values for name, values in infos["reward_terms"].items() if not name.startswith("_")}
    if not ended.any():
        return terms
    final = infos["final_info"]["reward_terms"]
    return {name: np.where(ended, final[name], values) for name, values in terms.items()}


def _scalars(infos: Mapping[str, Any], row: int) -> dict[str, Any]:
    """Return a row's scalars in the infos, as Python's own numbers; the masks `_name` are left out."""
    return {
        name: values[row].item()
        for name, values in infos.items()
        if not name.startswith("_") and isinstance(values, np.ndarray) and values.ndim == 1 and values.dtype != object
    }

"""Roll out any policy, one episode a seed, and score it.

A policy is anything with the `predict` of Stable-Baselines3's ``PolicyPredictor``. Cycles closed and false claims
lead every report: a policy that claims everywhere closes cycles too, and says nothing by it.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any, Protocol

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from scipy.special import stdtrit

from cyclic_env.console import ProgressLine
from cyclic_env.envs.vector import CyclicLoopVectorEnv
from cyclic_env.errors import ConfigError
from cyclic_env.floor_plans import PlanPool, load_floor_plans, pool_label
from cyclic_env.validation import is_integer, short_repr

METRICS = (
    "cycles_closed",
    "cycles_total",
    "false_claims",
    "return",
    "coverage",
    "is_success",
    "precision",
    "recall",
    "claims",
    "revisits",
    "collisions",
    "path_length_m",
    "steps",
)
"""What a summary has the mean of; of precision and recall, which are shares, that of all episodes taken together."""

BOUNDS = {
    "return": (-math.inf, math.inf),
    "coverage": (0.0, 1.0),
    "is_success": (0.0, 1.0),
    "precision": (0.0, 1.0),
    "recall": (0.0, 1.0),
}
"""What the mean of a metric can be, and so its interval; all others are counts or lengths, at least 0."""

BATCH = 16
"""Most episodes rolled out at once, unless told otherwise."""

Z_95 = 1.959963984540054
"""Half-width of the 95 % interval of a normal variable, in standard deviations."""

EPISODES_MAX = 1_000_000
"""Most episodes of one evaluation; more are taken for a slip of the hand."""


class Policy(Protocol):
    """What is asked of a policy.

    It may also have ``reseed(state, seeds) -> state``: then it is told the seeds of the episodes that begin (None for
    other rows), and its random numbers need not depend on the row or the batch.
    """

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[np.ndarray, Any]:
        """Return a batch of actions, and a state that comes back with the next call."""
        ...


Progress = Callable[[int, int], None]
"""Called after every step with the episodes that have ended and the steps of the batch so far."""


def rollout(
    policy: Policy,
    env: VectorEnv,
    seeds: Iterable[int],
    *,
    deterministic: bool = True,
    progress: Progress | None = None,
) -> Iterator[dict[str, Any]]:
    """Run one episode for each seed, and yield a record of each as it ends.

    A row that is done takes the next seed, so the records come in the order in which the episodes end. For a
    policy whose rows do not depend on each other a record is the same from any row of a batch of any size. (Neural
    networks are such policies up to rounding, if they are deterministic.)

    Parameters
    ----------
    policy : Policy
    env : VectorEnv of CyclicLoop environments
        With autoreset mode ``SAME_STEP``: ours, or a ``SyncVectorEnv`` of single ones.
    seeds : iterable of int
    deterministic : bool
        Handed to the policy.
    progress : callable, optional

    Yields
    ------
    dict
        ``seed``, ``map``, ``return``, ``steps``, ``terminated``, ``truncated``, all scalars of the last info, and
        ``reward_terms``, the sums of the return's terms.

    Raises
    ------
    ConfigError
        If the policy, the env or the seeds are none; before any step.
    """
    if isinstance(policy, type) or not callable(getattr(policy, "predict", None)):
        raise ConfigError(f"the policy is {short_repr(policy)}; expected an object with predict(observation, ...).")
    if not isinstance(env, VectorEnv) or env.metadata.get("autoreset_mode") != AutoresetMode.SAME_STEP:
        raise ConfigError(f"the env is {short_repr(env)}; expected a vector env with autoreset_mode='SAME_STEP'.")
    count = env.num_envs
    waiting = deque(checked_seeds(seeds))
    seed_of: list[int | None] = [waiting.popleft() if waiting else None for _ in range(count)]
    # Rows without work run along.
    observation, _ = env.reset(seed=[0 if seed is None else seed for seed in seed_of])  # pyright: ignore[reportArgumentType]
    state, episode_start = _reseeded(policy, None, seed_of), np.ones(count, np.bool_)
    maps = _map_names(env)
    returns, steps, ended_count, step = np.zeros(count), np.zeros(count, np.int64), 0, 0
    terms: dict[str, np.ndarray] = {}
    while any(seed is not None for seed in seed_of):
        answer = policy.predict(observation, state=state, episode_start=episode_start, deterministic=deterministic)
        if not isinstance(answer, tuple) or len(answer) != 2:
            raise ConfigError(
                f"predict of the policy returned {short_repr(answer)}; expected a tuple (actions, state)."
            )
        actions, state = answer
        observation, rewards, terminated, truncated, infos = env.step(actions)
        ended = terminated | truncated
        returns += rewards
        steps += 1
        for name, values in _reward_terms(infos, ended).items():
            terms[name] = terms.get(name, 0.0) + values
        episode_start = ended.copy()
        begun: list[int | None] = [None] * count
        for row in np.flatnonzero(ended).tolist():
            if seed_of[row] is not None:
                yield {
                    "seed": seed_of[row],
                    "map": maps[row],
                    "return": float(returns[row]),
                    "steps": int(steps[row]),
                    "terminated": bool(terminated[row]),
                    "truncated": bool(truncated[row]),
                    **_scalars(infos["final_info"], row),
                    "reward_terms": {name: float(values[row]) for name, values in terms.items()},
                }
                ended_count += 1
                seed_of[row] = begun[row] = waiting.popleft() if waiting else None
            returns[row], steps[row] = 0.0, 0
            for values in terms.values():
                values[row] = 0.0
        step += 1
        if progress is not None:
            progress(ended_count, step)
        fresh = np.array([seed is not None for seed in begun])
        if fresh.any():
            observation, _ = env.reset(seed=begun, options={"reset_mask": fresh})  # pyright: ignore[reportArgumentType]
            state = _reseeded(policy, state, begun)
            maps = _map_names(env)


def _reseeded(policy: Policy, state: Any, seeds: Sequence[int | None]) -> Any:
    reseed = getattr(policy, "reseed", None)
    return state if reseed is None else reseed(state, seeds)


def checked_seeds(seeds: Iterable[int]) -> list[int]:
    """Return the seeds as a list.

    Raises
    ------
    ConfigError
        If they aren't different whole numbers of at least 0, or are none, or more than `EPISODES_MAX`.
    """
    if not isinstance(seeds, Iterable):
        raise ConfigError(f"seeds is {short_repr(seeds)}; expected several whole numbers, such as range(10).")
    checked = list(islice(seeds, EPISODES_MAX + 1))
    if not checked:
        raise ConfigError("there are no seeds, so there is nothing to evaluate; give at least one.")
    if len(checked) > EPISODES_MAX:
        raise ConfigError(f"there are more than {EPISODES_MAX:,} seeds, one an episode; give fewer.")
    for seed in checked:
        if not is_integer(seed) or seed < 0:
            raise ConfigError(f"a seed is {short_repr(seed)}; expected a whole number of at least 0.")
    if len(set(checked)) < len(checked):
        raise ConfigError("a seed is there twice, and would count the same episode twice; give each once.")
    return [int(seed) for seed in checked]


def _map_names(env: VectorEnv) -> list[str]:
    """Return the name of every row's floor plan."""
    if isinstance(env.unwrapped, CyclicLoopVectorEnv):
        return [env.unwrapped.floor_plan(row).name for row in range(env.num_envs)]
    try:
        return [plan.name for plan in env.unwrapped.get_attr("floor_plan")]  # pyright: ignore[reportAttributeAccessIssue]
    except AttributeError as error:
        raise ConfigError(f"the env is {short_repr(env)}; expected one of CyclicLoop environments.") from error


def _reward_terms(infos: Mapping[str, Any], ended: np.ndarray) -> dict[str, np.ndarray]:
    """Return the terms of this step's reward, `(N,)` each; where an episode ended, those of its last step."""
    terms = {name: values for name, values in infos["reward_terms"].items() if not name.startswith("_")}
    if not ended.any():
        return terms
    final = infos["final_info"]["reward_terms"]
    return {name: np.where(ended, final[name], values) for name, values in terms.items()}


def _scalars(infos: Mapping[str, Any], row: int) -> dict[str, Any]:
    return {
        name: values[row].item()
        for name, values in infos.items()
        if not name.startswith("_") and isinstance(values, np.ndarray) and values.ndim == 1 and values.dtype != object
    }


@dataclass(frozen=True, slots=True, kw_only=True)
class Evaluation:
    """The episodes of one policy under the same settings."""

    agent: str
    map: str
    noise: str
    action_type: str
    random_start: bool
    episodes: list[dict[str, Any]]
    """Records as `rollout` yields them, in the order of the seeds."""
    complete: bool = True
    """False if Ctrl-C cut it short."""

    @property
    def alike(self) -> bool:
        """Whether there are several episodes that are one and the same, since the seeds change nothing in them."""
        first, *others = [{**episode, "seed": None} for episode in self.episodes] or [{}]
        return bool(others) and all(other == first for other in others)

    def summary(self) -> dict[str, dict[str, float]]:
        """Return the mean of every metric, and the 95 % interval of the mean, ``low`` to ``high``.

        Precision and recall are those of all episodes taken together, so that an episode in which nothing was judged
        counts neither way; NaN if there was nothing in any. The interval is Wilson's for ``is_success``, and Student's
        for all others. Where there is none, it is NaN: with one episode or episodes that are all `alike`, and
        Student's also where all values are the same, since they say nothing about how far others might be off.
        """
        summary: dict[str, dict[str, float]] = {}
        alike = self.alike
        for metric in METRICS:
            values = self._values(metric)
            interval = wilson_interval if metric == "is_success" else mean_interval
            low, high = (math.nan, math.nan) if alike else interval(values)
            least, most = BOUNDS.get(metric, (0.0, math.inf))
            low, high = max(low, least), min(high, most)  # a NaN stays
            summary[metric] = {"mean": float(values.mean()) if len(values) else math.nan, "low": low, "high": high}
        return summary

    def _values(self, metric: str) -> np.ndarray:
        """Return one number for each episode, of which the metric is the mean."""
        if metric == "precision":
            recognised = self._values("revisits_recognised")
            return pooled(recognised, recognised + self._values("false_claims"))
        if metric == "recall":
            return pooled(self._values("revisits_recognised"), self._values("revisits"))
        return np.array([float(episode[metric]) for episode in self.episodes])

    def to_json(self) -> dict[str, Any]:
        """Return everything as plain numbers, strings, lists and dicts; what isn't there is None."""
        summary = {
            metric: {name: None if math.isnan(value) else value for name, value in entry.items()}
            for metric, entry in self.summary().items()
        }
        return {
            "agent": self.agent,
            "map": self.map,
            "noise": self.noise,
            "action_type": self.action_type,
            "random_start": self.random_start,
            "complete": self.complete,
            "alike": self.alike,
            "summary": summary,
            "episodes": self.episodes,
        }


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
    progress: bool = False,
    **settings: Any,
) -> Evaluation:
    """Roll out a policy on the native vector env, one episode for each seed.

    Ctrl-C ends it early and keeps the episodes that are done.

    Parameters
    ----------
    policy : Policy
    agent : str
        What reports call it.
    seeds : iterable of int
        Different ones. With noise ``"ideal"`` they change nothing for a policy that draws nothing, unless
        ``random_start=True``.
    map_name, noise, settings
        As for `CyclicLoopEnv`.
    num_envs : int, optional
        Most episodes rolled out at once; by default `BATCH`.
    every_plan : bool
        Go through a pool's plans in turn, the episode of seed s on plan s modulo their number; by default an episode
        draws its plan.
    deterministic : bool
        Handed to the policy.
    progress : bool
        Show progress on stderr.

    Raises
    ------
    ConfigError, FloorPlanError
        If the policy, the seeds or the settings don't fit.
    """
    seeds = checked_seeds(seeds)
    num_envs = BATCH if num_envs is None else num_envs
    pool = load_floor_plans(map_name)
    map_label = pool_label(pool.names)

    def vector_env(plans: PlanPool, seeds: Sequence[int]) -> CyclicLoopVectorEnv:
        rows = min(num_envs, len(seeds)) if is_integer(num_envs) else num_envs
        return CyclicLoopVectorEnv(rows, plans, noise=noise, autoreset_mode="SAME_STEP", **settings)

    env = vector_env(pool, seeds)  # of all plans, which are checked here
    config = env.config
    made_for = getattr(policy, "action_type", config.action_type)
    if made_for != config.action_type:
        raise ConfigError(
            f"the policy acts by {short_repr(made_for)}, the environment by {config.action_type!r}; make one fit."
        )
    parts = {0: seeds}
    if every_plan:
        parts = {}
        for seed in seeds:
            parts.setdefault(seed % len(pool), []).append(seed)
    line = ProgressLine() if progress else None
    records: list[dict[str, Any]] = []
    steps = 0

    def show(*_: int) -> None:
        nonlocal steps
        steps += 1
        if line is not None:
            line.show(f"{agent} on {map_label}: {len(records)} of {len(seeds)} episodes, {steps} steps")

    complete = True
    try:
        for place, its_seeds in parts.items():
            if every_plan:
                env.close()
                env = vector_env(pool[place : place + 1], its_seeds)
            for record in rollout(policy, env, its_seeds, deterministic=deterministic, progress=show):
                records.append(record)  # one by one, for a Ctrl-C
    except KeyboardInterrupt:
        complete = False
    finally:
        env.close()
        if line is not None:
            line.clear()
    order = {seed: index for index, seed in enumerate(seeds)}
    records.sort(key=lambda record: order[record["seed"]])
    return Evaluation(
        agent=agent,
        map=map_label,
        noise=config.noise_name,
        action_type=config.action_type,
        random_start=config.random_start,
        episodes=records,
        complete=complete,
    )


def mean_interval(values: np.ndarray) -> tuple[float, float]:
    """Return Student's 95 % interval of the mean of `values` `(n,)`; NaN if they are all the same, or only one."""
    count = len(values)
    if count < 2 or np.allclose(values, values[0], rtol=1e-12, atol=1e-12):
        return math.nan, math.nan
    half = float(stdtrit(count - 1, 0.975) * values.std(ddof=1) / math.sqrt(count))
    return float(values.mean()) - half, float(values.mean()) + half


def wilson_interval(outcomes: np.ndarray) -> tuple[float, float]:
    """Return Wilson's 95 % interval of the rate of ones among `outcomes` `(n,)`; NaN if there are none."""
    count = len(outcomes)
    if count == 0:
        return math.nan, math.nan
    rate, z2 = float(outcomes.mean()), Z_95**2
    centre = (rate + z2 / (2 * count)) / (1 + z2 / count)
    half = Z_95 / (1 + z2 / count) * math.sqrt(rate * (1 - rate) / count + z2 / (4 * count**2))
    return max(0.0, centre - half), min(1.0, centre + half)


def pooled(parts: np.ndarray, wholes: np.ndarray) -> np.ndarray:
    """Return `(n,)` values whose mean is the share of all parts in all wholes; NaN if the wholes are all 0.

    Their spread is the share's own, to first order: it is the usual estimator of a ratio (Cochran 1977, Sampling
    Techniques, 6.4).
    """
    if not wholes.any():
        return np.full(len(wholes), math.nan)
    share = parts.sum() / wholes.sum()
    return share + (parts - share * wholes) / wholes.mean()


def format_table(evaluations: Sequence[Evaluation], *, markdown: bool = False, without: Collection[str] = ()) -> str:
    """Return a table with a line for each evaluation: means, and 95 % intervals where there are any.

    Parameters
    ----------
    evaluations : sequence of Evaluation
    markdown : bool
        With bars between the columns, for a document; else aligned with spaces, for a terminal.
    without : collection of str
        Columns to leave out.
    """
    header = ["agent", "map", "noise", "actions", "start", "episodes", "cycles closed", "false claims", "return"]
    header += ["coverage", "success", "precision", "recall", "collisions", "steps"]
    lines = [header]
    for evaluation in evaluations:
        count = str(len(evaluation.episodes)) + (" alike" if evaluation.alike else "")
        count += "" if evaluation.complete else " (cut short)"
        start = "random" if evaluation.random_start else "fixed"
        line = [evaluation.agent, evaluation.map, evaluation.noise, evaluation.action_type, start, count]
        if evaluation.episodes:
            summary = evaluation.summary()
            line += [
                f"{_cell(summary['cycles_closed'], 1)} of {summary['cycles_total']['mean']:g}",
                _cell(summary["false_claims"], 1),
                _cell(summary["return"], 1),
                _cell(summary["coverage"], 2),
                _cell(summary["is_success"], 2),
                _cell(summary["precision"], 2),
                _cell(summary["recall"], 2),
                _cell(summary["collisions"], 1),
                _cell(summary["steps"], 0),
            ]
        lines.append(line + ["-"] * (len(header) - len(line)))
    kept = [column for column, title in enumerate(header) if title not in without]
    words = [header[column] in ("agent", "map", "noise", "actions", "start") for column in kept]
    lines = [[line[column] for column in kept] for line in lines]
    widths = [max(map(len, cells)) for cells in zip(*lines, strict=True)]
    padded = [
        [
            cell.ljust(width) if word else cell.rjust(width)
            for cell, width, word in zip(line, widths, words, strict=True)
        ]
        for line in lines
    ]
    if not markdown:
        return "\n".join("  ".join(line).rstrip() for line in padded)
    rule = ["-" * width if word else "-" * (width - 1) + ":" for width, word in zip(widths, words, strict=True)]
    return "\n".join("| " + " | ".join(line) + " |" for line in [padded[0], rule, *padded[1:]])


def _cell(entry: Mapping[str, float], digits: int) -> str:
    if math.isnan(entry["mean"]):
        return "-"
    mean = f"{entry['mean']:.{digits}f}"
    return mean if math.isnan(entry["low"]) else f"{mean} [{entry['low']:.{digits}f}, {entry['high']:.{digits}f}]"


def table_notes(evaluations: Sequence[Evaluation]) -> list[str]:
    """Return what a reader of their table must know, one line each."""
    notes = []
    if any(evaluation.alike for evaluation in evaluations):
        notes.append(
            "alike: seeds change nothing here, so the episodes are one and the same, and there is no interval; "
            "random starts, or noise, make them differ."
        )
    if any(evaluation.action_type == "discrete" for evaluation in evaluations):
        notes.append(
            "discrete: the environment itself fills in the match of a claim, so only the detection is judged; "
            "don't compare it with wheels or twist."
        )
    notes.append(
        "[ ]: 95 % interval of the mean (Student's; of success, Wilson's); none where all values are the same. "
        "Precision and recall: of all episodes together; -: nothing to judge."
    )
    return notes


def score_rows(info: Mapping[str, Any]) -> dict[str, str]:
    """Return what an episode's info says of its closures and its exploration, each with its name."""
    return {
        "cycles closed": f"{info['cycles_closed']} of {info['cycles_total']}",
        "false claims": f"{info['false_claims']} of {info['claims']}",
        "revisits recognised": f"{info['revisits_recognised']} of {info['revisits']}",
        "seen": f"{info['coverage']:.1%}",
        "path": f"{info['path_length_m']:,.0f} m",
    }


def format_rows(rows: Mapping[str, str]) -> str:
    """Return what is said of one episode, one thing a line."""
    return "\n".join(f"{name:>20}  {value}" for name, value in rows.items())

"""Roll out any policy, one episode a seed, and score it.

A policy is anything with the `predict` of Stable-Baselines3's ``PolicyPredictor``. Cycles closed and false claims
lead every report: a policy that claims everywhere closes cycles too, and says nothing by it.
"""

from __future__ import annotations

import math
import sys
import time
from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, TextIO

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from scipy.special import stdtrit

from cyclic_env.errors import ConfigError
from cyclic_env.vector_env import CyclicLoopVectorEnv

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
"""What a summary has the mean of."""

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

REDRAW_S = 0.2
"""Seconds between two drawings of the progress line on a terminal."""


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
        If the env resets in another way.
    """
    if env.metadata.get("autoreset_mode") != AutoresetMode.SAME_STEP:
        raise ConfigError("evaluation needs an env with autoreset_mode='SAME_STEP'.")
    count = env.num_envs
    waiting = deque(seeds)
    seed_of: list[int | None] = [waiting.popleft() if waiting else None for _ in range(count)]
    # Rows without work run along.
    observation, _ = env.reset(seed=[0 if seed is None else seed for seed in seed_of])  # pyright: ignore[reportArgumentType]
    state, episode_start = _reseeded(policy, None, seed_of), np.ones(count, np.bool_)
    maps = _map_names(env)
    returns, steps, ended_count, step = np.zeros(count), np.zeros(count, np.int64), 0, 0
    terms: dict[str, np.ndarray] = {}
    while any(seed is not None for seed in seed_of):
        actions, state = policy.predict(
            observation, state=state, episode_start=episode_start, deterministic=deterministic
        )
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


def _map_names(env: VectorEnv) -> list[str]:
    """Return the name of every row's floor plan."""
    if isinstance(env.unwrapped, CyclicLoopVectorEnv):
        return [env.unwrapped.floor_plan(row).name for row in range(env.num_envs)]
    return [plan.name for plan in env.unwrapped.get_attr("floor_plan")]  # pyright: ignore[reportAttributeAccessIssue]


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
    episodes: list[dict[str, Any]]
    """Records as `rollout` yields them, in the order of the seeds."""
    complete: bool = True
    """False if Ctrl-C cut it short."""

    def summary(self) -> dict[str, dict[str, float]]:
        """Return the mean of every metric, and the 95 % interval of the mean, ``low`` to ``high``.

        The interval is Student's, and Wilson's for ``is_success``; one episode alone has the widest, or none (NaN).
        """
        summary: dict[str, dict[str, float]] = {}
        for metric in METRICS:
            values = np.array([float(episode[metric]) for episode in self.episodes])
            mean = float(values.mean()) if len(values) else math.nan
            low, high = wilson_interval(values) if metric == "is_success" else mean_interval(values)
            least, most = BOUNDS.get(metric, (0.0, math.inf))
            low, high = max(low, least), min(high, most)  # a NaN stays
            summary[metric] = {"mean": mean, "low": low, "high": high}
        return summary

    def to_json(self) -> dict[str, Any]:
        """Return everything as plain numbers, strings, lists and dicts; an interval that isn't there is None."""
        summary = {
            metric: {name: None if math.isnan(value) else value for name, value in entry.items()}
            for metric, entry in self.summary().items()
        }
        return {
            "agent": self.agent,
            "map": self.map,
            "noise": self.noise,
            "complete": self.complete,
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
    map_name, noise, settings
        As for `CyclicLoopEnv`.
    num_envs : int, optional
        Episodes rolled out at once; by default up to `BATCH`.
    deterministic : bool
        Handed to the policy.
    progress : bool
        Show progress on stderr.

    Raises
    ------
    ConfigError, FloorPlanError
        If the settings don't fit, or there is no seed.
    """
    seeds = list(seeds)
    if not seeds:
        raise ConfigError("there are no seeds, so there is nothing to evaluate; give at least one.")
    env = CyclicLoopVectorEnv(
        min(len(seeds), BATCH) if num_envs is None else num_envs,
        map_name,
        noise=noise,
        autoreset_mode="SAME_STEP",
        **settings,
    )
    map_label = ",".join(plan.name for plan in env.engine.config.plans)
    noise_label = noise if isinstance(noise, str) else "custom"
    line = ProgressLine() if progress else None

    def show(done: int, steps: int) -> None:
        if line is not None:
            line.show(f"{agent} on {map_label}: {done} of {len(seeds)} episodes, {steps} steps")

    records: list[dict[str, Any]] = []
    complete = True
    try:
        for record in rollout(policy, env, seeds, deterministic=deterministic, progress=show):
            records.append(record)
    except KeyboardInterrupt:
        complete = False
    finally:
        env.close()
        if line is not None:
            line.clear()
    order = {seed: index for index, seed in enumerate(seeds)}
    records.sort(key=lambda record: order[record["seed"]])
    return Evaluation(agent=agent, map=map_label, noise=noise_label, episodes=records, complete=complete)


def mean_interval(values: np.ndarray) -> tuple[float, float]:
    """Return Student's 95 % interval of the mean of `values` `(n,)`; NaN if there is only one."""
    count = len(values)
    if count < 2:
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


def format_table(evaluations: Sequence[Evaluation], *, markdown: bool = False, without: Collection[str] = ()) -> str:
    """Return a table with a line for each evaluation: means, and 95 % intervals where the episodes differ.

    Parameters
    ----------
    evaluations : sequence of Evaluation
    markdown : bool
        With bars between the columns, for a document; else aligned with spaces, for a terminal.
    without : collection of str
        Columns to leave out.
    """
    header = ["agent", "map", "noise", "episodes", "cycles closed", "false claims", "return", "coverage"]
    header += ["success", "precision", "recall", "collisions", "steps"]
    lines = [header]
    for evaluation in evaluations:
        count = str(len(evaluation.episodes)) + ("" if evaluation.complete else " (cut short)")
        line = [evaluation.agent, evaluation.map, evaluation.noise, count]
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
    words = [header[column] in ("agent", "map", "noise") for column in kept]
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
    mean = f"{entry['mean']:.{digits}f}"
    if math.isnan(entry["low"]) or entry["high"] - entry["low"] < 0.5 * 10.0**-digits:
        return mean
    return f"{mean} [{entry['low']:.{digits}f}, {entry['high']:.{digits}f}]"


class ProgressLine:
    """One line on stderr that is drawn over itself; nothing where stderr is no terminal.

    Parameters
    ----------
    stream : text stream, optional
        In place of stderr.
    """

    def __init__(self, stream: TextIO | None = None) -> None:
        self._stream = sys.stderr if stream is None else stream
        self._on = self._stream.isatty()
        self._drawn = -math.inf
        self._width = 0

    def show(self, text: str) -> None:
        """Draw the text, unless one was drawn a moment ago."""
        now = time.monotonic()
        if self._on and now - self._drawn >= REDRAW_S:
            self._stream.write("\r" + text.ljust(self._width))
            self._stream.flush()
            self._drawn, self._width = now, len(text)

    def clear(self) -> None:
        """Wipe the line."""
        if self._on and self._width:
            self._stream.write("\r" + " " * self._width + "\r")
            self._stream.flush()
            self._width = 0

"""Statistics over episodes: means of metrics with 95 % intervals, pooled shares, and paired differences."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from cyclic_env.errors import ConfigError

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
"""The metrics of a summary, averaged over episodes; precision and recall are pooled."""

BOUNDS = {
    "return": (-math.inf, math.inf),
    "coverage": (0.0, 1.0),
    "is_success": (0.0, 1.0),
    "precision": (0.0, 1.0),
    "recall": (0.0, 1.0),
}
"""The least and the greatest possible mean; all other metrics are counts or lengths, at least 0."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Evaluation:
    """The episodes of one policy under the same settings."""

    agent: str
    map: str
    noise: str
    action_type: str
    random_start: bool
    seeds: tuple[int, ...]
    """The seeds of all episodes that were asked for."""
    episodes: list[dict[str, Any]]
    """Records as `cyclic_env.evaluation.rollout.rollout` yields them, in the order of the seeds."""

    @property
    def complete(self) -> bool:
        """Whether all episodes have ended."""
        return len(self.episodes) == len(self.seeds)

    @property
    def identical_episodes(self) -> bool:
        """Whether there are several episodes and all are the same, since the seeds change nothing."""
        first, *others = [{**episode, "seed": None} for episode in self.episodes] or [{}]
        return bool(others) and all(other == first for other in others)

    def summary(self) -> dict[str, dict[str, float]]:
        """Return the ``mean`` of every metric, and its 95 % interval, ``low`` to ``high``.

        Precision and recall are shares of the counts of all episodes together, and NaN if these are 0. The interval is
        Wilson's for ``is_success``, and Student's for all others. It is NaN if there is only one episode or all are
        identical; Student's is also NaN if all values are equal.
        """
        summary: dict[str, dict[str, float]] = {}
        identical = self.identical_episodes
        for metric in METRICS:
            values = self._values(metric)
            interval = wilson_interval if metric == "is_success" else mean_interval
            low, high = (math.nan, math.nan) if identical else interval(values)
            lower, upper = BOUNDS.get(metric, (0.0, math.inf))
            low, high = max(low, lower), min(high, upper)  # keeps a NaN, unlike max(lower, low)
            summary[metric] = {"mean": float(values.mean()) if len(values) else math.nan, "low": low, "high": high}
        return summary

    def _values(self, metric: str) -> np.ndarray:
        """Return `(n,)` values, one for each episode, whose mean is the metric's."""
        if metric == "precision":
            recognised = self._values("revisits_recognised")
            return pooled_share(recognised, recognised + self._values("false_claims"))
        if metric == "recall":
            return pooled_share(self._values("revisits_recognised"), self._values("revisits"))
        return np.array([float(episode[metric]) for episode in self.episodes])

    def to_json(self) -> dict[str, Any]:
        """Return everything as plain numbers, strings, lists and dicts, with None in place of NaN."""
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
            "alike": self.identical_episodes,
            "summary": summary,
            "episodes": self.episodes,
        }


def mean_interval(values: np.ndarray) -> tuple[float, float]:
    """Return Student's 95 % interval of the mean of `values` `(n,)`; NaN if n < 2 or all values are equal."""
    from scipy.stats import t  # slow to import, and not needed to run episodes

    count = len(values)
    if count < 2 or np.allclose(values, values[0], rtol=1e-12, atol=1e-12):
        return math.nan, math.nan
    low, high = t.interval(0.95, count - 1, values.mean(), values.std(ddof=1) / math.sqrt(count))
    return float(low), float(high)


def wilson_interval(outcomes: np.ndarray) -> tuple[float, float]:
    """Return Wilson's 95 % interval of the rate of ones among `outcomes` `(n,)`; NaN if n = 0."""
    from scipy.stats import binomtest

    if len(outcomes) == 0:
        return math.nan, math.nan
    interval = binomtest(int(np.count_nonzero(outcomes)), len(outcomes)).proportion_ci(method="wilson")
    return float(interval.low), float(interval.high)


def pooled_share(parts: np.ndarray, wholes: np.ndarray) -> np.ndarray:
    """Return `(n,)` values whose mean is the share of all parts in all wholes; NaN if the wholes are all 0.

    To first order, their mean varies as the share does, so that their `mean_interval` is the share's interval: this is
    the usual estimator of a ratio (Cochran 1977, Sampling Techniques, 6.4).

    Parameters
    ----------
    parts, wholes : array (n,)
    """
    if not wholes.any():
        return np.full(len(wholes), math.nan)
    share = parts.sum() / wholes.sum()
    return share + (parts - share * wholes) / wholes.mean()


class Difference(NamedTuple):
    """A mean difference, and its 95 % interval."""

    mean: float
    low: float
    high: float


def paired_difference(a: np.ndarray, b: np.ndarray, *, resamples: int = 10_000, seed: int = 0) -> Difference:
    """Return the mean of a - b over pairs, with the 95 % percentile interval of a paired bootstrap.

    The pairs have to be independent: a pair is a floor plan, or a start, with the mean of its episodes, rather than
    one of several episodes on the same plan.

    Parameters
    ----------
    a, b : array (n,)
        Values of the same n units, in the same order.
    resamples : int
    seed : int
        Seed of the resampling; the same seed gives the same interval.

    Returns
    -------
    Difference
        The interval is NaN if n < 2.

    Raises
    ------
    ConfigError
        If `a` and `b` differ in length, or are empty.
    """
    if np.shape(a) != np.shape(b) or np.ndim(a) != 1 or not len(a):
        raise ConfigError(f"a has the shape {np.shape(a)} and b {np.shape(b)}; expected (n,) for both, n at least 1.")
    differences = np.subtract(a, b, dtype=np.float64)
    mean = float(differences.mean())
    if len(differences) < 2:
        return Difference(mean, math.nan, math.nan)
    drawn = np.random.default_rng(seed).integers(len(differences), size=(resamples, len(differences)))
    low, high = np.quantile(differences[drawn].mean(axis=1), [0.025, 0.975])
    return Difference(mean, float(low), float(high))


def interquartile_mean(values: np.ndarray) -> np.ndarray:
    """Return the mean of the middle half of the values along the last axis: a quarter is cut off at either end.

    It is as robust as the median, and uses more of the data (R. Agarwal et al., "Deep reinforcement learning at the
    edge of the statistical precipice", NeurIPS 2021). Of n values, n / 4, rounded down, are cut off at either end.

    Parameters
    ----------
    values : array (..., n)
    """
    cut = values.shape[-1] // 4
    return np.sort(values, axis=-1)[..., cut : values.shape[-1] - cut].mean(axis=-1)


def stratified_interval(
    values: np.ndarray,
    strata: np.ndarray,
    statistic: Callable[[np.ndarray], np.ndarray] = interquartile_mean,
    *,
    resamples: int = 2_000,
    seed: int = 0,
) -> tuple[float, float]:
    """Return the 95 % percentile interval of a statistic by a bootstrap that draws within each stratum.

    Parameters
    ----------
    values : array (n,)
    strata : array (n,)
        The stratum of each value, such as the floor plan of a run: every resample has as many values of each.
    statistic : callable
        Of arrays (resamples, n), along the last axis.
    resamples : int
    seed : int
        Seed of the resampling; the same seed gives the same interval.

    Returns
    -------
    (low, high)
        NaN if no stratum has two values.
    """
    members = [np.flatnonzero(strata == stratum) for stratum in np.unique(strata)]
    if not any(len(rows) > 1 for rows in members):
        return math.nan, math.nan
    rng = np.random.default_rng(seed)
    drawn = [rows[rng.integers(len(rows), size=(resamples, len(rows)))] for rows in members]
    low, high = np.quantile(statistic(values[np.concatenate(drawn, axis=1)]), [0.025, 0.975])
    return float(low), float(high)


def performance_profile(values: np.ndarray, thresholds: np.ndarray) -> np.ndarray:
    """Return the share `(m,)` of the values `(n,)` that reach each threshold `(m,)`.

    The profiles of two agents, drawn over all thresholds, show where one is better, and not only on average (E. D.
    Dolan and J. J. More, Mathematical Programming 91, 2002; Agarwal et al. 2021).
    """
    return (values[None] >= thresholds[:, None]).mean(axis=1)


def probability_of_improvement(a: np.ndarray, b: np.ndarray) -> float:
    """Return the probability that a run of `a` `(n,)` scores higher than one of `b` `(m,)`; ties count half.

    It is Mann and Whitney's U, divided by n m.
    """
    differences = np.sign(a[:, None] - b[None])
    return float((0.5 * (differences + 1)).mean())

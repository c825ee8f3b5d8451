"""Statistics: intervals against published values and SciPy, pooled shares, paired differences, summaries."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
import pytest
from scipy.stats import bootstrap, ecdf, mannwhitneyu, trim_mean

from cyclic_env import ConfigError
from cyclic_env.evaluation.statistics import (
    interquartile_mean,
    mean_interval,
    paired_difference,
    performance_profile,
    pooled_share,
    probability_of_improvement,
    stratified_interval,
    wilson_interval,
)
from tests.helpers import evaluation, record


def test_mean_interval_is_students() -> None:
    low, high = mean_interval(np.array([1.0, 2.0, 3.0]))
    assert (low + high) / 2 == pytest.approx(2.0)
    assert (high - low) / 2 == pytest.approx(4.302653 / math.sqrt(3))  # t table, 2 degrees of freedom


@pytest.mark.parametrize("values", [[], [1.0], [0.1, 0.1, 0.1]])
def test_mean_interval_of_one_value_is_none(values: list[float]) -> None:
    assert all(math.isnan(bound) for bound in mean_interval(np.array(values)))


@pytest.mark.parametrize(
    ("ones", "zeros", "expected"),
    [(81, 182, (0.2553, 0.3662)), (0, 10, (0.0, 0.2775))],  # Newcombe 1998: 81 of 263
)
def test_wilson_interval_of_published_examples(ones: int, zeros: int, expected: tuple[float, float]) -> None:
    assert wilson_interval(np.repeat([1.0, 0.0], [ones, zeros])) == pytest.approx(expected, abs=1e-4)


def test_pooled_share_is_that_of_all_episodes_together() -> None:
    assert pooled_share(np.array([1.0, 0.0, 3.0]), np.array([1.0, 0.0, 7.0])).mean() == pytest.approx(4 / 8)
    parts = np.array([1.0, 2.0, 4.0])
    np.testing.assert_allclose(pooled_share(parts, np.full(3, 4.0)), parts / 4)


def test_interval_of_a_pooled_share_is_that_of_a_ratio() -> None:
    parts, wholes = np.array([1.0, 2.0, 2.0, 5.0]), np.array([2.0, 3.0, 5.0, 6.0])
    low, high = mean_interval(pooled_share(parts, wholes))
    variance = ((parts - 10 / 16 * wholes) ** 2).sum() / 3 / 4 / 4**2  # Cochran 1977, 6.4: s^2 / (n x^2)
    assert (high - low) / 2 == pytest.approx(3.182446 * math.sqrt(variance), rel=1e-6)  # t table, 3 degrees of freedom


def test_paired_difference_is_that_of_a_percentile_bootstrap() -> None:
    rng = np.random.default_rng(0)
    plans = rng.normal(0.0, 10.0, 40)  # plans differ by far more than the agents do
    a, b = plans + rng.normal(1.0, 0.5, 40), plans
    difference = paired_difference(a, b)
    interval = bootstrap((a - b,), np.mean, method="percentile", rng=np.random.default_rng(1)).confidence_interval
    assert difference.mean == pytest.approx((a - b).mean())
    assert (difference.low, difference.high) == pytest.approx(interval, abs=0.02)
    assert difference == paired_difference(a, b)
    assert paired_difference(b, a).mean == -difference.mean


def test_paired_difference_of_one_pair_has_no_interval() -> None:
    assert paired_difference(np.array([3.0]), np.array([1.0])) == pytest.approx((2.0, math.nan, math.nan), nan_ok=True)


@pytest.mark.parametrize(("a", "b"), [([], []), ([1.0, 2.0], [1.0]), ([[1.0]], [[1.0]])])
def test_what_is_no_pair_is_refused(a: list[float], b: list[float]) -> None:
    with pytest.raises(ConfigError, match="shape"):
        paired_difference(np.array(a), np.array(b))


def test_intervals_stay_within_what_a_mean_can_be() -> None:
    entry = evaluation(record(coverage=0.1), record(coverage=1.0)).summary()["coverage"]
    assert entry == {"mean": pytest.approx(0.55), "low": 0.0, "high": 1.0}


def test_episodes_without_a_claim_add_nothing_to_precision_and_recall() -> None:
    silent = {"false_claims": 0, "revisits": 0, "revisits_recognised": 0, "precision": 1.0, "recall": 1.0}
    judged = {"false_claims": 3, "revisits": 2, "revisits_recognised": 1, "precision": 0.25, "recall": 0.5}
    summary = evaluation(record(**silent), record(**silent), record(**judged)).summary()
    assert summary["precision"]["mean"] == pytest.approx(0.25)
    assert summary["recall"]["mean"] == pytest.approx(0.5)


def test_one_episode_is_not_called_identical() -> None:
    assert not evaluation(record()).identical_episodes
    assert not evaluation().identical_episodes
    assert evaluation(record(), record(seed=1)).identical_episodes


def test_json_holds_no_nan() -> None:
    silent = record(false_claims=0, revisits=0, revisits_recognised=0)
    summary = json.loads(json.dumps(evaluation(silent).to_json(), allow_nan=False))["summary"]
    assert summary["return"] == {"mean": 4.0, "low": None, "high": None}
    assert summary["recall"]["mean"] is None


# Over several plans.


@pytest.mark.parametrize("count", [1, 2, 3, 4, 7, 8, 101])
def test_the_interquartile_mean_is_scipys_trimmed_mean(count: int) -> None:
    values = np.random.default_rng(count).normal(size=(3, count))
    np.testing.assert_allclose(interquartile_mean(values), trim_mean(values, 0.25, axis=1), rtol=1e-12)


def test_the_bootstrap_of_one_stratum_is_scipys() -> None:
    values = np.random.default_rng(0).gamma(2.0, size=80)
    options: Any = {"method": "percentile", "n_resamples": 20_000, "rng": 1}
    for statistic in (interquartile_mean, lambda drawn: drawn.mean(axis=-1)):
        low, high = stratified_interval(values, np.zeros(80), statistic, resamples=20_000)
        its = bootstrap((values,), lambda drawn, axis: statistic(drawn), **options).confidence_interval  # noqa: B023
        assert (low, high) == pytest.approx((its.low, its.high), abs=0.02)


def test_strata_keep_their_sizes_so_that_differences_between_them_widen_no_interval() -> None:
    strata = np.repeat([0, 1, 2], 20)
    values = 100.0 * strata + np.random.default_rng(0).normal(size=60)
    mean = lambda drawn: drawn.mean(axis=-1)  # noqa: E731
    low, high = stratified_interval(values, strata, mean)
    assert high - low < 1.0
    loose = stratified_interval(values, np.zeros(60), mean)
    assert loose[1] - loose[0] > 20
    assert stratified_interval(values, strata, mean) == (low, high)
    assert np.isnan(stratified_interval(values, np.arange(60), mean)).all()


def test_a_profile_is_the_share_of_runs_that_reach_each_threshold() -> None:
    values = np.array([1.0, 2.0, 2.0, 5.0])
    assert performance_profile(values, np.array([0.0, 1.0, 1.5, 2.0, 5.0, 5.1])).tolist() == [1, 1, 0.75, 0.75, 0.25, 0]
    grid = np.linspace(0, 6, 50)
    np.testing.assert_allclose(performance_profile(values, grid), ecdf(values).sf.evaluate(grid - 1e-9))


def test_the_probability_of_improvement_is_mann_and_whitneys_u() -> None:
    rng = np.random.default_rng(0)
    a, b = rng.integers(0, 9, 30).astype(float), rng.integers(0, 8, 25).astype(float)
    assert probability_of_improvement(a, b) == pytest.approx(mannwhitneyu(a, b).statistic / (30 * 25))
    assert probability_of_improvement(a, a) == 0.5

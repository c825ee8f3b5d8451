"""Statistics: intervals against published values and SciPy, pooled shares, paired differences, summaries."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from scipy.stats import bootstrap

from cyclic_env import ConfigError
from cyclic_env.evaluation.statistics import mean_interval, paired_difference, pooled_share, wilson_interval
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

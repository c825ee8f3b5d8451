"""Precision and recall on curves that are known on paper."""

from __future__ import annotations

import numpy as np
import pytest

from cyclic_env.evaluation.precision_recall import precision_recall


def test_a_curve_known_on_paper() -> None:
    right = np.array([False, True, True, True])  # the surest are two right ones, then a wrong one with a right one
    curve = precision_recall(right, np.array([0.5, 0.9, 0.8, 0.5]), positives=4)
    assert curve.scores.tolist() == [0.9, 0.8, 0.5]
    assert curve.precision.tolist() == [1, 1, 0.75]
    assert curve.recall.tolist() == [0.25, 0.5, 0.75]
    assert curve[3:] == pytest.approx((0.5, 0.75, 0.75))


def test_a_wrong_claim_that_is_the_surest_leaves_nothing_at_full_precision() -> None:
    curve = precision_recall(np.array([False, True]), np.array([2.0, 1.0]), positives=1)
    assert curve[3:] == pytest.approx((0.0, 2 / 3, 0.0))


def test_claims_without_scores_are_one_point() -> None:
    curve = precision_recall(np.array([True, False]), None, positives=4)
    assert (curve.precision.tolist(), curve.recall.tolist()) == ([0.5], [0.25])


def test_a_silent_and_a_perfect_claimer() -> None:
    assert precision_recall(np.zeros(0, bool), None, positives=3)[3:] == (0.0, 0.0, 0.0)
    assert precision_recall(np.ones(3, bool), None, positives=3)[3:] == (1.0, 1.0, 1.0)

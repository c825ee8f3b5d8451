"""Precision and recall of loop closures over the threshold of their scores, and the usual numbers that sum them up."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class PrecisionRecall(NamedTuple):
    """A curve, from the surest claims to all, and its summary.

    Attributes
    ----------
    scores, precision, recall : (n,) float64
        At each threshold, the highest first. All claims with a score of at least the threshold are counted.
    recall_at_100_precision : float
        The greatest recall without a wrong claim.
    f1_max : float
    extended_precision : float
        The mean of the precision at the least recall and of the recall at 100 % precision (B. Ferrarini et al.,
        "Exploring Performance Bounds of Visual Place Recognition Using Extended Precision", RA-L 2020); the second is
        0 where the first is less than 1.
    """

    scores: np.ndarray
    precision: np.ndarray
    recall: np.ndarray
    recall_at_100_precision: float
    f1_max: float
    extended_precision: float


def precision_recall(right: np.ndarray, scores: np.ndarray | None, positives: int) -> PrecisionRecall:
    """Return the precision and recall of claims.

    Parameters
    ----------
    right : (n,) bool
    scores : (n,), or None
        Without scores, the curve is a single point.
    positives : int
        How many right claims could have been made.
    """
    scores = np.zeros(len(right)) if scores is None else scores
    order = np.argsort(-scores, kind="stable")
    hits = np.cumsum(right[order])
    last = np.flatnonzero(np.diff(scores[order], append=-np.inf) != 0)
    precision, recall = hits[last] / (last + 1), hits[last] / max(positives, 1)
    both = precision + recall
    f1 = np.divide(2 * precision * recall, both, out=np.zeros(len(both)), where=both > 0)
    sure = float(recall[precision == 1].max(initial=0.0))
    at_least = float(precision[0]) if len(precision) else 0.0
    extended = 0.5 * (at_least + (sure if at_least == 1 else 0.0))
    return PrecisionRecall(scores[order][last], precision, recall, sure, float(f1.max(initial=0.0)), extended)

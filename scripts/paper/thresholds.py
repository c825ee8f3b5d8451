"""The threshold of each measure (Step 5's th), calibrated on generated training plans and nothing else."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from agents.knn.similarity import MEASURES
from scripts.paper.recognition import Answers, answers_curve, f1_scores, pooled_answers, scores, vote
from scripts.paper.runs import RunRecord, RunSettings

NOISES = ("ideal", "calibrated")
DIGITS = 9
"""Decimals kept: rounding of a cosine is far below, the steps between places far above."""


def training_runs(plans: int) -> list[RunSettings]:
    """Return the runs to calibrate with: the first plans of the train split, driven by the extended explorer.

    It sees every plan to its end, and by what it finds the way does not depend on a threshold.
    """
    return [
        RunSettings(map=f"generated:train,index={index}", preset="extended", noise=noise, seed=index)
        for index in range(plans)
        for noise in NOISES
    ]


def calibrate(records: Sequence[RunRecord]) -> dict[str, dict[str, float]]:
    """Return for each measure the threshold of the best F1 of place recognition by the paper's rule, and its scores.

    Parameters
    ----------
    records : sequence of RunRecord
    """
    return {name: _best(pooled_answers([vote(record, name) for record in records])) for name in MEASURES}


def _best(answers: Answers) -> dict[str, float]:
    distance, precision, recall = answers_curve(answers)
    f1 = f1_scores(precision, recall)
    best, surest = int(np.argmax(f1)), int(np.argmax(precision))
    # Between the last answer that is taken and the first that is not; "above the threshold" is the rule.
    beyond = distance[best + 1] if best + 1 < len(distance) else distance[best] + 10.0**-DIGITS
    return {
        "threshold": round(1 - float(distance[best] + beyond) / 2, DIGITS),
        "f1": float(f1[best]),
        "precision": float(precision[best]),
        "recall": float(recall[best]),
        "area": scores(precision, recall)["area"],
        "highest_precision": float(precision[surest]),
        "recall_there": float(recall[surest]),
    }


def thresholds_file(records: Sequence[RunRecord], plans: int, command: str) -> dict[str, Any]:
    """Return what the file of thresholds holds, as plain values."""
    return {
        "command": command,
        "plans": f"generated:train, index 0 to {plans - 1}; noise {' and '.join(NOISES)}; preset extended",
        "rule": "best F1 of the vote of 4 among earlier tables of the same direction, over all rows",
        "rows": sum(len(record.step) for record in records),
        "revisits": int(sum(record.revisit.sum() for record in records)),
        "measures": {
            name: {key: round(value, DIGITS) for key, value in entry.items()}
            for name, entry in calibrate(records).items()
        },
    }

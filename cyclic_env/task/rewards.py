"""The reward: a weighted sum of named terms, which the info also holds, so that the two can't disagree."""

from __future__ import annotations

import numpy as np

from cyclic_env.config import RewardConfig
from cyclic_env.jit import compiled

REWARD_TERMS = ("coverage", "new_cycle", "false_claim", "missed_revisit", "collision", "time")


def reward_weights(config: RewardConfig, cycles_total: np.ndarray, step_budget: np.ndarray) -> np.ndarray:
    """Return what a unit of each term is worth, `(P, 6)`, in the order of `REWARD_TERMS`.

    A unit of coverage is all free cells newly seen, one of the collision term is a step in contact, and one of the time
    term is a step. An episode that a collision ends is also charged the steps left of its budget, so that
    crashing doesn't save time.

    Parameters
    ----------
    config : RewardConfig
    cycles_total, step_budget : (P,) int64
        Number of cycles and steps of each plan.
    """
    ones = np.ones(len(cycles_total))
    columns = {
        "coverage": config.coverage * np.where(cycles_total == 0, 2.0, 1.0),
        "new_cycle": config.new_cycle / np.maximum(cycles_total, 1),
        "false_claim": config.false_claim * ones,
        "missed_revisit": config.missed_revisit * ones,
        "collision": config.collision / step_budget,
        "time": config.time / step_budget,
    }
    return np.column_stack([columns[term] for term in REWARD_TERMS])


@compiled
def reward_row(weights, units, terms):
    """Write the terms of a step's reward into `terms` (6,), and return their sum.

    Parameters
    ----------
    weights : (6,) float64
        A row of `reward_weights`.
    units : tuple of 6 numbers
        How many units of each term the step brought, in the order of `REWARD_TERMS`.
    terms : (6,) float64
        Output.
    """
    terms[0] = weights[0] * units[0]
    terms[1] = weights[1] * units[1]
    terms[2] = weights[2] * units[2]
    terms[3] = weights[3] * units[3]
    terms[4] = weights[4] * units[4]
    terms[5] = weights[5] * units[5]
    total = 0.0
    for i in range(terms.shape[0]):
        terms[i] += 0.0  # makes 0.0 of -0.0
        total += terms[i]
    return total

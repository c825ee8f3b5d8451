"""The reward: a weighted sum of named terms, which are also in the info, so that the two can't disagree."""

from __future__ import annotations

import numpy as np

from cyclic_env.config import RewardConfig
from cyclic_env.jit import compiled

REWARD_TERMS = ("coverage", "new_cycle", "false_claim", "missed_revisit", "collision", "time")


def reward_weights(config: RewardConfig, cycles_total: np.ndarray, step_budget: np.ndarray) -> np.ndarray:
    """Return what a unit of each term is worth, `(P, 6)`.

    The units are: all free cells newly seen, a cycle, a false claim, a missed revisit, a step in contact, a step.

    Parameters
    ----------
    config : RewardConfig
    cycles_total, step_budget : (P,) int64
        Of each plan.
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
def reward_row(weights, newly_seen, new_cycle, false_claims, missed, contact, terms):
    """Write the terms of a step's reward into `terms` (6,), in the order of `REWARD_TERMS`, and return their sum."""
    terms[0] = weights[0] * newly_seen
    terms[1] = weights[1] * new_cycle
    terms[2] = weights[2] * false_claims
    terms[3] = weights[3] * missed
    terms[4] = weights[4] * contact
    terms[5] = weights[5]
    total = 0.0
    for i in range(terms.shape[0]):
        terms[i] += 0.0  # makes 0.0 of -0.0
        total += terms[i]
    return total

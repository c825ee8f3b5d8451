"""A rule by hand for the task headings: a baseline on the same features as the learned agents."""

from __future__ import annotations

import numpy as np

from agents.rl.headings.memory import HEADINGS

UNSEEN_WEIGHT = 0.3
"""Of the nearest undriven cell at the edge of what was seen, beside that of the nearest undriven one."""
RATIO_BELOW, INLIERS_MIN, EIGENVALUE_MIN = 0.05, 0.28, 0.02
"""A candidate is claimed if its inlier ratio is less than the mean by at most so much, and from this share of all beams
on, that agree and that speak for each direction."""
DISTANCE_MAX = 2.1
"""Metres from the candidate's place, as matched."""


def nearest_undriven(headings: np.ndarray) -> np.ndarray:
    """Return the heading `(N,)` to the nearest place where each robot has not been, rather straight on.

    Parameters
    ----------
    headings : (N, HEADINGS, PER_HEADING)
    """
    straight_on = 1e-3 * np.cos(np.arange(HEADINGS) * 2 * np.pi / HEADINGS)
    return (headings[..., 1] + UNSEEN_WEIGHT * headings[..., 2] + straight_on).argmax(-1)


def good_candidate(candidates: np.ndarray) -> np.ndarray:
    """Return the claim `(N,)` of the first candidate whose scan matches well and whose place is near, or none.

    Parameters
    ----------
    candidates : (N, CANDIDATES, PER_CANDIDATE)
    """
    good = (candidates[..., 0] > 0) & (candidates[..., 9] > 0) & (3 * candidates[..., 6] < DISTANCE_MAX)
    good &= (candidates[..., 3] / 4 > -RATIO_BELOW) & (candidates[..., 4] > INLIERS_MIN)
    good &= candidates[..., 5] / 10 > EIGENVALUE_MIN
    return np.where(good.any(-1), good.argmax(-1) + 1, 0)


class HandRule:
    """In the place of a model: drives to the nearest undriven place, and claims the first good candidate."""

    def predict(self, features: dict[str, np.ndarray], deterministic: bool = True) -> tuple[np.ndarray, None]:
        """Return the choices `(N, 2)`."""
        headings, claims = nearest_undriven(features["headings"]), good_candidate(features["candidates"])
        return np.stack([headings, claims], axis=-1), None

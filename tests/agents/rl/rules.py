"""A model of the task headings that has learnt nothing: two rules by hand."""

from __future__ import annotations

import numpy as np

from agents.rl.headings.memory import HEADINGS


def nearest_undriven(features: np.ndarray) -> np.ndarray:
    """Head for the nearest place where the robot has not been, rather straight on: (N,) headings."""
    straight_on = 1e-3 * np.cos(np.arange(HEADINGS) * 2 * np.pi / HEADINGS)
    return (features[..., 1] + 0.3 * features[..., 2] + straight_on).argmax(-1)


def good_candidate(candidates: np.ndarray) -> np.ndarray:
    """Claim the first candidate whose scan matches well and which is near: (N,) claims."""
    good = (candidates[..., 3] > -0.2) & (candidates[..., 4] > 0.28) & (candidates[..., 5] > 0.2)
    good &= (candidates[..., 0] > 0) & (candidates[..., 6] < 0.7) & (candidates[..., 9] > 0)
    return np.where(good.any(-1), good.argmax(-1) + 1, 0)


class Rule:
    """A model that follows the two rules above."""

    def predict(self, features: dict[str, np.ndarray], deterministic: bool = True) -> tuple[np.ndarray, None]:
        headings, claims = nearest_undriven(features["headings"]), good_candidate(features["candidates"])
        return np.stack([headings, claims], axis=-1), None

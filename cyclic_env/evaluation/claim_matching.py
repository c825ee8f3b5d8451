"""Claims by the poses of a reference: time stamps matched within a tolerance, and one claim at each pose."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cyclic_env.errors import RecordingError
from cyclic_env.trajectory.metrics import match_times
from cyclic_env.trajectory.poses import relative
from cyclic_env.trajectory.readers import Claims

TOLERANCE = 0.02
"""Seconds between two time stamps of the same moment; evo takes 0.01."""


class MatchedClaims(NamedTuple):
    """Claims by the reference's poses, at most one at each, in order.

    Attributes
    ----------
    pairs : (n, 2) int
        The pose at the claim, and the earlier one.
    scores : (n,) or None
    measured : (n, 3) or None
        The pose at the claim in the frame of the earlier one.
    unmatched, repeated : int
        Claims without a pose at their time, and further ones at the same pose.
    """

    pairs: np.ndarray
    scores: np.ndarray | None
    measured: np.ndarray | None
    unmatched: int
    repeated: int


def match_claims(claims: Claims, times: np.ndarray, tolerance: float = TOLERANCE) -> MatchedClaims:
    """Return the claims by the poses of a reference at `times` `(n,)`; of several at one pose, the surest counts.

    Raises
    ------
    RecordingError
        If none has poses at both its times, or a step is none of the reference's.
    """
    ends = np.column_stack([claims.times, claims.matches])
    if claims.by_step:
        if ends.size and not (ends.min() >= 0 and ends.max() < len(times)):
            raise RecordingError(f"the claims name steps beyond those of the reference, 0 to {len(times) - 1:,}.")
        places = ends.astype(np.int64)
    else:
        places = match_times(ends.ravel(), times, tolerance).reshape(-1, 2)
    known = np.flatnonzero((places >= 0).all(axis=1))
    if len(places):
        check_matched(np.where((places >= 0).all(axis=1), 0, -1), "claims", tolerance)
    later, earlier = places[known].max(axis=1), places[known].min(axis=1)
    sure = np.zeros(len(known)) if claims.scores is None else -claims.scores[known]
    order = np.lexsort([sure, later])
    first = order[np.diff(later[order], prepend=-1) > 0]
    first = first[later[first] > 0]  # before its first step a robot can't be back
    measured = None
    if claims.measured is not None:
        forth, back = claims.measured[known], relative(claims.measured[known], np.zeros((len(known), 3)))
        measured = np.where((places[known, 0] >= places[known, 1])[:, None], forth, back)[first]
    return MatchedClaims(
        pairs=np.column_stack([later, earlier])[first],
        scores=None if claims.scores is None else claims.scores[known][first],
        measured=measured,
        unmatched=len(places) - len(known),
        repeated=len(known) - len(first),
    )


def check_matched(indices: np.ndarray, what: str, tolerance: float) -> np.ndarray:
    """Return indices of matched moments, -1 for none; raise a `RecordingError` if all are."""
    if not (indices >= 0).any():
        raise RecordingError(
            f"none of the times of the {what} is within {tolerance:g} s of one of the reference's; "
            "are both of the same run, and of the same clock?"
        )
    return indices

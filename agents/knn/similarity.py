"""The paper's similarity measures (3.2-3.3), vectorised: one query against many stored rows.

A measure has two parts, so that what depends on a row alone is worked out once, when the row is stored:
`prepare` turns feature vectors into rows, and `compare` takes the distances between prepared rows and a query.

Definitions where the paper is silent or has a slip: Jaccard is MATLAB's, the share of the coordinates that differ
among those of which one is not zero (SciPy's casts to bool, and gives 0.0 on the pair of Table 1); Spearman is one
minus the correlation of ranks (Eq. 13 lacks the "1 -", Eq. 14 is meant for ranks), ties sharing their mean rank;
variation is the sum of the two vectors' sample variances (Eq. 1).

Degenerate vectors: of two vectors without a direction (all zeros for cosine; constant for correlation and
Spearman) the distance is 0, of one without and one with, 1. Two vectors of zeros have the Jaccard distance 0. Vectors
of a single coordinate are constant, and variation, which needs two, refuses them. NaN, infinite and huge values and
vectors of unlike lengths are refused, so no distance is ever NaN.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.spatial.distance import cdist

from cyclic_env.errors import ConfigError
from cyclic_env.validation import as_array, check_choice

LARGEST = 1e100
"""A coordinate's size at most: squares and sums of such have room in a float."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Measure:
    """One way to tell how far two feature vectors are apart."""

    name: str
    bounded: bool
    """Whether it is 0 for equal vectors and at most 1 (or 2) for any: then the similarity is ``1 - distance``."""
    _prepare: Callable[[np.ndarray], np.ndarray]
    _compare: Callable[[np.ndarray, np.ndarray], np.ndarray]

    def prepare(self, features: np.ndarray) -> np.ndarray:
        """Return feature vectors `(n, d)` or `(d,)` as rows that `compare` takes.

        Raises
        ------
        ConfigError
            If these are no numbers, or no coordinates, or too few for this measure, or a value is not finite or beyond
            `LARGEST`.
        """
        features = as_array(features, "the features", "vectors of numbers", ConfigError).astype(np.float64)
        least = 2 if self.name == "variation" else 1
        if features.ndim not in (1, 2) or features.shape[-1] < least:
            raise ConfigError(f"{self.name} needs vectors of at least {least} coordinates, got shape {features.shape}.")
        if not (np.abs(features) <= LARGEST).all():
            raise ConfigError(
                f"{self.name} can't compare vectors with NaN, infinite or huge values; leave such rows out."
            )
        return self._prepare(features)

    def compare(self, rows: np.ndarray, query: np.ndarray) -> np.ndarray:
        """Return the distances `(n,)` between prepared rows `(n, d')` and one prepared query `(d',)`.

        Raises
        ------
        ConfigError
            If they are of unlike lengths.
        """
        if rows.ndim != 2 or query.ndim != 1 or rows.shape[1] != len(query):
            raise ConfigError(
                f"{self.name} got rows of shape {rows.shape} and a query of {query.shape}; expected (n, d) and (d,)."
            )
        return self._compare(rows, query)

    def distance(self, a: np.ndarray, b: np.ndarray) -> float:
        """Return the distance between two feature vectors `(d,)`.

        Raises
        ------
        ConfigError
            If they are of unlike lengths, or `prepare` refuses one.
        """
        if np.shape(a) != np.shape(b):
            raise ConfigError(f"{self.name} got vectors of shapes {np.shape(a)} and {np.shape(b)}; expected one shape.")
        return float(self.compare(self.prepare(a)[None], self.prepare(b))[0])

    def similarity(self, distance: np.ndarray) -> np.ndarray:
        """Return similarities, 1 for equal vectors, from distances (paper-wide: Step 5's mu)."""
        return 1 - distance if self.bounded else 1 / (1 + distance)


def _unit(vectors: np.ndarray) -> np.ndarray:
    """Return the vectors at unit length; those of (nearly) no length become zeros."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.divide(vectors, length, out=np.zeros_like(vectors), where=length > 0)


def _centred(vectors: np.ndarray) -> np.ndarray:
    """Return the vectors less their means, at unit length; constant ones become zeros, whatever the rounding."""
    deviations = vectors - vectors.mean(axis=-1, keepdims=True)
    constant = np.ptp(vectors, axis=-1, keepdims=True) == 0
    return _unit(np.where(constant, 0.0, deviations))


def _angular(rows: np.ndarray, query: np.ndarray) -> np.ndarray:
    """Return one minus the cosine of unit vectors, where zeros are equal to each other and 1 from all else."""
    distances = 1 - np.clip(rows @ query, -1, 1)
    if not query.any():
        distances = np.where(rows.any(axis=-1), 1.0, 0.0)
    return distances


def _jaccard(rows: np.ndarray, query: np.ndarray) -> np.ndarray:
    ones = np.ones(len(query))  # products with it count several times as fast as sums over short rows
    union = ((rows != 0) | (query != 0)) @ ones
    return np.divide((rows != query) @ ones, union, out=np.zeros(len(rows)), where=union > 0)


def _centred_ranks(vectors: np.ndarray) -> np.ndarray:
    from scipy.stats import rankdata  # takes half of a second to import, and most runs don't need it

    return _centred(rankdata(vectors, axis=-1))


def _scipys(metric: Literal["euclidean", "cityblock", "chebyshev"]) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    return lambda rows, query: cdist(rows, query[None], metric)[:, 0]


def _as_it_is(vectors: np.ndarray) -> np.ndarray:
    return vectors


def _measure(
    name: str, bounded: bool, prepare: Callable[..., np.ndarray], compare: Callable[..., np.ndarray]
) -> Measure:
    return Measure(name=name, bounded=bounded, _prepare=prepare, _compare=compare)


MEASURES: dict[str, Measure] = {
    measure.name: measure
    for measure in (
        _measure("jaccard", True, _as_it_is, _jaccard),
        _measure("euclidean", False, _as_it_is, _scipys("euclidean")),
        _measure("cityblock", False, _as_it_is, _scipys("cityblock")),
        _measure("chebyshev", False, _as_it_is, _scipys("chebyshev")),
        _measure("cosine", True, _unit, _angular),
        _measure("spearman", True, _centred_ranks, _angular),
        _measure(
            "variation",
            False,
            lambda vectors: vectors.var(axis=-1, ddof=1, keepdims=True),
            lambda rows, query: (rows + query)[..., 0],
        ),
        _measure("correlation", True, _centred, _angular),
    )
}
"""The seven measures of the paper's tables, in their order, and correlation, which its text names."""


def measure_by_name(name: str) -> Measure:
    """Return the measure of that name.

    Raises
    ------
    ConfigError
        If there is none; the message lists them and the nearest.
    """
    return MEASURES[check_choice("similarity measure", name, MEASURES)]

"""The paper's similarity measures: against SciPy, and for vectors that have no direction."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial import distance
from scipy.stats import spearmanr

from agents.knn.similarity import MEASURES, measure_by_name
from cyclic_env.errors import ConfigError

SCIPY = {
    "euclidean": distance.euclidean,
    "cityblock": distance.cityblock,
    "chebyshev": distance.chebyshev,
    "cosine": distance.cosine,
    "correlation": distance.correlation,
    "spearman": lambda a, b: 1 - spearmanr(a, b).statistic,  # pyright: ignore[reportAttributeAccessIssue]
    "variation": lambda a, b: np.var(a, ddof=1) + np.var(b, ddof=1),
    "jaccard": lambda a, b: ((a != b) & ((a != 0) | (b != 0))).sum() / ((a != 0) | (b != 0)).sum(),
}
features = arrays(np.float64, 7, elements=st.integers(0, 24).map(lambda half_metres: half_metres / 2))


@pytest.mark.parametrize("name", MEASURES)
def test_distances_equal_scipys_on_random_vectors(name: str) -> None:
    rng = np.random.default_rng(0)
    rows, query = rng.integers(0, 12, (200, 7)).astype(float), rng.uniform(0, 12, 7)
    measure = MEASURES[name]
    ours = measure.compare(measure.prepare(rows), measure.prepare(query))
    assert ours == pytest.approx([SCIPY[name](row, query) for row in rows], abs=1e-12)


@pytest.mark.parametrize("name", MEASURES)
@given(a=features, b=features)
def test_any_two_vectors_have_a_finite_distance_that_is_not_negative_and_symmetric(
    name: str, a: np.ndarray, b: np.ndarray
) -> None:
    measure = MEASURES[name]
    assert measure.distance(a, b) >= 0
    assert measure.distance(a, b) == pytest.approx(measure.distance(b, a), abs=1e-12)


@pytest.mark.parametrize("name", [name for name in MEASURES if name != "variation"])
@given(a=features)
def test_equal_vectors_are_at_distance_0_and_similarity_1(name: str, a: np.ndarray) -> None:
    measure = MEASURES[name]
    assert measure.distance(a, a) == pytest.approx(0, abs=1e-12)
    assert measure.similarity(np.array(measure.distance(a, a))) == pytest.approx(1)


@pytest.mark.parametrize("name", ["cosine", "spearman", "correlation"])
def test_a_vector_without_direction_is_1_from_any_other_and_0_from_its_like(name: str) -> None:
    flat, other = np.zeros(5), np.array([1.0, 2, 3, 4, 5])
    assert MEASURES[name].distance(flat, flat) == 0
    assert MEASURES[name].distance(flat, other) == 1
    assert MEASURES[name].distance(other, flat) == 1


@pytest.mark.parametrize("name", ["spearman", "correlation"])
def test_a_constant_vector_is_one_without_direction_whatever_the_rounding(name: str) -> None:
    assert MEASURES[name].distance(np.full(7, 0.1), np.full(7, 12.3)) == 0


BAD = [[1.0, np.nan], [np.inf, 1.0], [], np.zeros((2, 2, 2)), "far", [1e200, 1e200], [1j, 2]]


@pytest.mark.parametrize("name", MEASURES)
@pytest.mark.parametrize("bad", BAD)
def test_what_cannot_be_compared_is_refused(name: str, bad: object) -> None:
    with pytest.raises(ConfigError):
        MEASURES[name].prepare(bad)  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("name", MEASURES)
def test_vectors_of_unlike_lengths_are_refused(name: str) -> None:
    measure = MEASURES[name]
    with pytest.raises(ConfigError, match="expected one shape"):
        measure.distance(np.ones(7), np.ones(5))
    if name != "variation":  # of a vector it keeps but one number
        with pytest.raises(ConfigError, match="expected \\(n, d\\) and"):
            measure.compare(measure.prepare(np.ones((4, 7))), measure.prepare(np.ones(1)))


@pytest.mark.parametrize("name", [name for name in MEASURES if name != "variation"])
def test_vectors_of_one_coordinate_have_the_stated_distances(name: str) -> None:
    expected = {"jaccard": 1.0, "euclidean": 3.0, "cityblock": 3.0, "chebyshev": 3.0}.get(name, 0.0)
    assert MEASURES[name].distance(np.array([1.0]), np.array([4.0])) == expected


def test_an_unknown_measure_is_refused_with_the_nearest() -> None:
    with pytest.raises(ConfigError, match="Did you mean 'euclidean'"):
        measure_by_name("euclidian")

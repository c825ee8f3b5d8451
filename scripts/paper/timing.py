"""How long comparisons take: one pair, many rows at once, and groups against points over the length of a run."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from agents.knn.similarity import MEASURES, Measure, measure_by_name
from cyclic_env.config import ClosureConfig
from scripts.paper.runs import RunRecord

ROWS = 10_000
"""That one query is compared with at once: a run of 10 km."""
FIRST_GROUPS = 4
"""Groups whose rows are looked into, if groups come first: as many as rows that vote."""
NEAR = ClosureConfig().return_radius
"""Metres between two rows of one place, as in the definition of a return."""
SKLEARN = ("euclidean", "cityblock", "chebyshev", "cosine", "correlation")
"""Measures that scikit-learn's brute-force neighbours know by the same definition."""


def seconds_of(work: Callable[[], Any], repeats: int, batch: int) -> np.ndarray:
    """Return the time of one call of `work` in each of `repeats` batches, seconds, `(repeats,)`."""
    work()
    times = np.empty(repeats)
    for k in range(repeats):
        began = time.perf_counter()
        for _ in range(batch):
            work()
        times[k] = (time.perf_counter() - began) / batch
    return times


def quartiles(times: np.ndarray) -> list[float]:
    """Return the lower quartile, the median and the upper quartile."""
    return np.percentile(times, (25, 50, 75)).tolist()


def comparison_times(features: np.ndarray, repeats: int) -> dict[str, dict[str, Any]]:
    """Return for each measure the times of one pair, of one query against `ROWS` rows, and of scikit-learn's, seconds.

    Parameters
    ----------
    features : (n, d)
        Of a run; they are repeated to `ROWS`.
    repeats : int

    Returns
    -------
    dict
        By measure: ``pair`` and ``rows`` as from `quartiles`, ``row`` for one of many at once, ``sklearn`` (or None).
        All rows but the query have been prepared before, as they are when they are stored; scikit-learn's have been
        fitted. Both run on one thread.
    """
    rows = np.resize(features, (ROWS, features.shape[1])).astype(np.float64)
    a, b = rows[0], rows[len(features) // 2]
    neighbours = _sklearn_neighbours(rows)
    times: dict[str, dict[str, Any]] = {}
    for name, measure in MEASURES.items():
        prepared = measure.prepare(rows)
        pair = seconds_of(lambda measure=measure: measure.distance(a, b), repeats, 50)
        many = seconds_of(
            lambda measure=measure, prepared=prepared: measure.compare(prepared, measure.prepare(b)), repeats, 3
        )
        times[name] = {"pair": quartiles(pair), "rows": quartiles(many), "row": quartiles(many / ROWS), "sklearn": None}
        if neighbours is not None and name in SKLEARN:
            times[name]["sklearn"] = quartiles(neighbours(name, b, repeats))
    return times


def _sklearn_neighbours(rows: np.ndarray) -> Callable[[str, np.ndarray, int], np.ndarray] | None:
    """Return what times scikit-learn's brute-force search, or None where it is not installed."""
    try:
        from sklearn.neighbors import NearestNeighbors  # pyright: ignore[reportMissingImports]
        from threadpoolctl import threadpool_limits  # pyright: ignore[reportMissingImports]
    except ImportError:
        return None

    def seconds(name: str, query: np.ndarray, repeats: int) -> np.ndarray:
        nearest = NearestNeighbors(n_neighbors=4, algorithm="brute", metric=name).fit(rows)
        with contextlib.ExitStack() as stack:
            stack.enter_context(threadpool_limits(1))
            return seconds_of(lambda: nearest.kneighbors(query[None]), max(3, repeats // 3), 1)

    return seconds


def search_growth(laps: RunRecord, measure: str, every: int) -> dict[str, list[float]]:
    """Return what finding the nearest row costs as a run grows, three ways: points, one direction, groups first.

    Points: all rows of before, whose directions and groups nobody knows. One direction: its tables, but for the present
    group's. Groups first: the centres of that direction's groups, then the rows of the `FIRST_GROUPS` nearest.
    Everything that can be is prepared when it is stored, and lies in one piece.

    Parameters
    ----------
    laps : RunRecord
        A long run.
    measure : str
    every : int
        Queries are every so manyth row.

    Returns
    -------
    dict
        Lists with an entry a query: ``path`` in metres; ``points``, ``direction`` and ``groups``: rows and centres
        compared; ``points_s`` ...: seconds; ``direction_right``, ``groups_right``: whether the row found is one of the
        query's place, within `NEAR`.
    """
    how = measure_by_name(measure)
    features, position = laps.features[:, 0].astype(np.float64), laps.position
    rows = how.prepare(features)
    tables = [_Tables(rows.shape[1], len(rows)) for _ in range(4)]
    names = ("path", "points", "direction", "groups")
    result: dict[str, list[float]] = {
        name: [] for name in (*names, *(f"{name}_s" for name in names[1:]), "direction_right", "groups_right")
    }
    for i, group in enumerate(laps.group.tolist()):
        table, query = tables[laps.direction[i]], rows[i]
        if table.group != group:
            table.begin(group)
        present = table.first[-1]  # of the rows of the present group
        if i % every == 0 and present:
            began = time.perf_counter()
            how.compare(rows[:i], query).argmin()
            points_end = time.perf_counter()
            of_direction = how.compare(table.rows[:present], query).argmin()
            direction_end = time.perf_counter()
            compared, of_groups = table.groups_first(how, query)
            groups_end = time.perf_counter()
            off = [float(np.hypot(*(position[table.numbers[k]] - position[i]))) for k in (of_direction, of_groups)]
            spent = (points_end - began, direction_end - points_end, groups_end - direction_end)
            entry = (laps.path[i], i, present, compared, *spent, *(away <= NEAR for away in off))
            for name, value in zip(result, entry, strict=True):
                result[name].append(float(value))
        table.add(i, query, features[i], how)
    return result


class _Tables:
    """The tables of one direction: rows in one piece, group after group, and the groups' centres."""

    def __init__(self, width: int, capacity: int) -> None:
        self.rows = np.empty((capacity, width))
        self.numbers = np.empty(capacity, np.int64)
        self.centres = np.empty((capacity, width))
        self.first: list[int] = []
        self.count = 0
        self.group = -1
        self._sum: np.ndarray | float = 0.0

    def begin(self, group: int) -> None:
        self.group, self._sum = group, 0.0
        self.first.append(self.count)

    def add(self, number: int, row: np.ndarray, features: np.ndarray, measure: Measure) -> None:
        self.rows[self.count], self.numbers[self.count] = row, number
        self.count += 1
        self._sum = self._sum + features
        self.centres[len(self.first) - 1] = measure.prepare(self._sum / (self.count - self.first[-1]))

    def groups_first(self, measure: Measure, query: np.ndarray) -> tuple[int, int]:
        """Return how many centres and rows were compared, and the nearest row found, of the groups before the last."""
        apart = measure.compare(self.centres[: len(self.first) - 1], query)
        chosen = np.argsort(apart, kind="stable")[:FIRST_GROUPS].tolist()
        compared, best, nearest = len(apart), np.inf, 0
        for group in chosen:
            first, end = self.first[group], self.first[group + 1]
            within = measure.compare(self.rows[first:end], query)
            k = int(within.argmin())
            compared += end - first
            if within[k] < best:
                best, nearest = float(within[k]), first + k
        return compared, nearest

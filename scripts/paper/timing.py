"""The times of comparisons: of one pair, of many rows at once, and of points and groups as a run grows."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pandas as pd
from sklearn.neighbors import NearestNeighbors
from threadpoolctl import threadpool_limits

from agents.knn.similarity import MEASURES
from scripts.paper.recognition import NEIGHBOURS
from scripts.paper.runs import RunRecord, drive_again

ROWS = 10_000
"""Number of rows that a query is compared with: those of a run of 10 km."""
SKLEARN = ("euclidean", "cityblock", "chebyshev", "cosine", "correlation")
"""Measures that scikit-learn's brute-force neighbours define in the same way."""
EVERY = 5
"""Every fifth row is a query when the growth of the search is measured."""


def median_seconds(work: Callable[[], Any], repeats: int, batch: int) -> float:
    """Return the median time of a call of `work`, seconds, over `repeats` batches of calls."""
    work()
    times = np.empty(repeats)
    for k in range(repeats):
        began = time.perf_counter()
        for _ in range(batch):
            work()
        times[k] = (time.perf_counter() - began) / batch
    return float(np.median(times))


def comparison_times(record: RunRecord, repeats: int) -> pd.DataFrame:
    """Return the seconds that each measure takes for a pair, for a query of `ROWS` rows, and in scikit-learn's search.

    Everything but the query is prepared beforehand, as it is when a row is stored, and scikit-learn's search is fitted.
    All run on one thread.
    """
    features = record.features[:, 0].astype(np.float64)
    rows = np.resize(features, (ROWS, features.shape[1]))
    a, b = rows[0], rows[len(features) // 2]
    entries = []
    for name, measure in MEASURES.items():
        prepared = measure.prepare(rows)
        entry = {
            "measure": name,
            "pair_s": median_seconds(lambda m=measure: m.distance(a, b), repeats, 50),
            "rows_s": median_seconds(lambda m=measure, p=prepared: m.compare(p, m.prepare(b)), repeats, 3),
        }
        if name in SKLEARN:
            nearest = NearestNeighbors(n_neighbors=NEIGHBOURS, algorithm="brute", metric=name).fit(rows)
            with threadpool_limits(1):
                entry["sklearn_s"] = median_seconds(lambda n=nearest: n.kneighbors(b[None]), repeats // 3 + 1, 1)
        entries.append(entry)
    return pd.DataFrame(entries)


def search_growth(record: RunRecord, laps: int) -> pd.DataFrame:
    """Return the cost of a search by cosine as a run grows: the comparisons and the seconds of each query.

    The path is driven `laps` times. ``points`` compares all earlier rows, ``direction`` those of earlier groups of
    the same direction, and ``groups`` the centres of these groups.
    """
    again, measure = drive_again(record, laps), MEASURES["cosine"]
    features = again.features[:, 0].astype(np.float64)
    rows = measure.prepare(features)
    groups = np.unique(again.group)
    centres = measure.prepare(np.array([features[again.group == group].mean(axis=0) for group in groups]))
    first = np.searchsorted(again.group, groups)
    entries = []
    for i in range(EVERY, len(rows), EVERY):
        direction = again.direction[i]
        earlier = np.flatnonzero((again.direction[:i] == direction) & (again.group[:i] != again.group[i]))
        tables = np.flatnonzero((groups < again.group[i]) & (again.direction[first] == direction))
        if not len(tables):
            continue
        # The rows to compare are contiguous in memory, as they are in a table.
        pools = {"points": rows[:i], "direction": rows[earlier], "groups": centres[tables]}
        entry = {"path_m": again.path[i]}
        for name, pool in pools.items():
            began = time.perf_counter()
            measure.compare(pool, rows[i]).argmin()
            entry |= {name: len(pool), f"{name}_s": time.perf_counter() - began}
        entries.append(entry)
    return pd.DataFrame(entries)

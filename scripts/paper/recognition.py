"""Place recognition on a path that is driven twice: what each way of searching finds, compared with the truth.

A *query* is a row of the second lap, and its candidates are the rows of the first lap. An answer is right if a claim of
it would be judged correct (`cyclic_env.task.loop_closure`). Every number is computed for single plans; intervals are
taken over plans.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
from sklearn.metrics import precision_recall_curve

from agents.knn.similarity import MEASURES, Measure
from cyclic_env import load_floor_plan
from cyclic_env.task.loop_closure import RETURNS
from cyclic_env.task.trajectory_truth import true_returns
from scripts.paper.runs import RunRecord, drive_again

SECTORS, BEAMS = "7 sectors", "all beams"
NEIGHBOURS = 4
"""The paper's K."""
NEAR = 2.5
"""A row is near the query if it lies within these metres in X and in Y, as in the preset ``paper``."""
SEARCHES = ("points", "direction", "direction, vote", "direction, vote, position")
"""Ways of searching: all rows, those of the query's direction, the same with a vote, and only those of them nearby."""


class SecondLap:
    """A run's path driven twice, with the truth about every query and candidate.

    Attributes
    ----------
    record : RunRecord
        The record of both laps.
    rows : int
        Number of rows of a lap.
    returns : (rows, rows) bool
        Whether query i returns to candidate j.
    """

    def __init__(self, record: RunRecord) -> None:
        self.record = drive_again(record)
        self.rows = len(record.step)
        plan = load_floor_plan(record.settings.map)
        trajectory = self.record.trajectory.copy()
        trajectory[:, 2] = np.maximum.accumulate(trajectory[:, 2])  # rows close together may have changed places
        truth = true_returns(plan, trajectory, self.record.step) == RETURNS
        self.returns = truth[self.rows :, : self.rows]

    def distances(self, measure: Measure, vectors: str) -> np.ndarray:
        """Return the distances `(rows, rows)` between queries and candidates by a similarity measure."""
        features = self.record.features[:, 0] if vectors == SECTORS else self.record.beams
        prepared = measure.prepare(features.astype(np.float64))
        candidates = prepared[: self.rows]
        return np.array([measure.compare(candidates, query) for query in prepared[self.rows :]])

    def candidates(self, search: str) -> np.ndarray:
        """Return for each query which rows `(rows, rows)` one of the `SEARCHES` compares it with."""
        record, n = self.record, self.rows
        allowed = np.ones((n, n), np.bool_)
        if search != "points":
            allowed &= record.direction[n:, None] == record.direction[:n]
        if search.endswith("position"):
            offsets = np.abs(record.position[n:, None] - record.position[:n])
            allowed &= (offsets < NEAR).all(axis=2)
        return allowed

    def answers(self, distances: np.ndarray, search: str) -> tuple[np.ndarray, np.ndarray]:
        """Return the answer to each query `(rows,)`, -1 if there is no candidate, and its distance."""
        found, least = np.full(self.rows, -1), np.full(self.rows, np.inf)
        for query, allowed in enumerate(self.candidates(search)):
            candidates = np.flatnonzero(allowed)
            if len(candidates):
                order = np.argsort(distances[query, candidates], kind="stable")
                nearest = candidates[order[:NEIGHBOURS]]
                if "vote" in search:
                    groups = self.record.group[nearest].tolist()
                    nearest = nearest[[max(range(len(groups)), key=lambda i: (groups.count(groups[i]), -i))]]
                found[query], least[query] = nearest[0], distances[query, nearest[0]]
        return found, least


def found_shares(lap: SecondLap) -> list[dict[str, Any]]:
    """Return the share of returning queries that find a right row, for each search, kind of vectors and measure."""
    back = lap.returns.any(axis=1)
    entries = []
    for vectors in (SECTORS, BEAMS):
        for name, measure in MEASURES.items():
            distances = lap.distances(measure, vectors)
            for search in SEARCHES:
                found, least = lap.answers(distances, search)
                right = (found >= 0) & lap.returns[np.arange(lap.rows), found]
                entries.append(
                    {"search": search, "vectors": vectors, "measure": name, "found": right[back].mean()}
                    | curve_scores(least, right, int(back.sum()))
                )
    return entries


def curve_scores(distance: np.ndarray, right: np.ndarray, returning: int) -> dict[str, float]:
    """Return average precision, and the recall at 99 % precision, of answers that are trusted up to a distance.

    Parameters
    ----------
    distance, right : (q,)
        Distance of each answer, infinite if there is none, and whether it is right.
    returning : int
        Number of queries that return anywhere, by which the recall is divided.
    """
    answered = np.isfinite(distance)
    if not right[answered].any():
        return {"average_precision": 0.0, "recall_at_99_precision": 0.0}
    precision, recall, _ = precision_recall_curve(right[answered], -distance[answered])
    recall = recall * right.sum() / returning
    return {
        "average_precision": float(-(np.diff(recall) * precision[:-1]).sum()),
        "recall_at_99_precision": float(recall[precision >= 0.99].max(initial=0.0)),
    }


def centres_found(lap: SecondLap, measure: Measure) -> dict[str, float]:
    """Return the share of the groups of the second lap that are nearest to their own group of the first lap.

    A group is compared with the groups of its direction, by the mean of its features (``appearance``) or by the mean of
    its positions (``position``).
    """
    record, n = lap.record, lap.rows
    features = record.features[:, 0].astype(np.float64)
    groups = np.unique(record.group[:n])
    first = [np.flatnonzero(record.group[:n] == group) for group in groups]
    directions = np.array([record.direction[rows[0]] for rows in first])
    right = {"appearance": [], "position": []}
    means = measure.prepare(np.array([features[rows].mean(axis=0) for rows in first]))
    centres = np.array([record.position[rows].mean(axis=0) for rows in first])
    for k, rows in enumerate(first):
        same = np.flatnonzero(directions == directions[k])
        query = measure.prepare(features[rows + n].mean(axis=0))
        right["appearance"].append(same[np.argmin(measure.compare(means[same], query))] == k)
        offsets = centres[same] - record.position[rows + n].mean(axis=0)
        right["position"].append(same[np.argmin(np.hypot(*offsets.T))] == k)
    return {name: float(np.mean(values)) for name, values in right.items()} | {"groups": len(groups)}


def of_plan(record: RunRecord) -> tuple[pd.DataFrame, dict[str, float]]:
    """Return `found_shares` and `centres_found` (by cosine) of one run's path driven twice."""
    lap = SecondLap(record)
    return pd.DataFrame(found_shares(lap)), centres_found(lap, MEASURES["cosine"])

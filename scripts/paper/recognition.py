"""Place recognition by a similarity measure: what it decides over all rows of a run, against the truth.

A **query** is a row of a run; its **candidates** are the rows driven `GAP` before it or more, as the distance meter has
it: all of them (points), or those of another group of the same direction (the paper's indicators). The query's best
candidate is right where a claim of it would be, wrong where such a claim would be false, and neither where it would be
ignored; see `cyclic_env.task.loop_closure`. A query
that returns anywhere at all, in whichever direction, is a revisit, and
the recall is of these.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from agents.knn.config import preset
from agents.knn.loop_detector import Vote
from agents.knn.similarity import measure_by_name
from agents.slam.keyframes import Keyframes
from cyclic_env.config import ClosureConfig
from cyclic_env.task.loop_closure import ELSEWHERE, RETURNS
from scripts.paper.runs import RunRecord

GAP = ClosureConfig().gap
"""Metres driven since, as in the definition of a return."""
VECTORS = ("7 sectors", "all beams")
POINTS, SAME_DIRECTION, VOTE = "points", "same direction", "same direction, vote of 4"
"""What a query is compared with: all rows, tables of its direction, and these by the explorer's own rule."""
CURVE_POINTS = 150
BOOTSTRAPS = 10_000
"""Draws of plans with replacement, for an interval."""


def vectors_of(record: RunRecord, vectors: str) -> np.ndarray:
    """Return the rows' feature vectors `(n, d)` float64: the properties ahead, or all beams in half metres."""
    return (record.features[:, 0] if vectors == VECTORS[0] else record.beams).astype(np.float64)


@dataclass(frozen=True, slots=True)
class Answers:
    """The best candidate of each query of one run or several, by one measure; q queries that have candidates."""

    distance: np.ndarray
    """Of the best candidate, `(q,)`: the smaller, the surer."""
    outcome: np.ndarray
    """Its truth, `(q,)`; see `RunRecord.truth`."""
    error: np.ndarray
    """Metres from the query to it, `(q,)`."""
    revisit: np.ndarray
    """Whether the query returns anywhere, `(q,)`."""
    revisits: int
    """Rows that return anywhere, those without candidates among them."""


@dataclass(frozen=True, slots=True)
class Pairs:
    """All pairs of a query and a candidate, without those that are neither right nor wrong."""

    distance: np.ndarray
    right: np.ndarray
    total: int
    """Right pairs of the run, those that are no candidates among them."""


def ask(record: RunRecord, measure: str, vectors: str, *, same_direction: bool) -> tuple[Answers, Pairs]:
    """Return the answers of a measure to all queries of a run, and all pairs that it has compared.

    Parameters
    ----------
    record : RunRecord
    measure : str
        See `agents.knn.similarity.MEASURES`.
    vectors : str
        One of `VECTORS`.
    same_direction : bool
        Whether the indicators choose the candidates.
    """
    how = measure_by_name(measure)
    rows = how.prepare(vectors_of(record, vectors))
    best, queries, pairs, rights = [], [], [], []
    for i in range(1, len(rows)):
        long_ago = int(np.searchsorted(record.path, record.path[i] - GAP, side="right"))
        candidates = np.arange(min(long_ago, i))
        if same_direction:
            same = (record.direction[candidates] == record.direction[i]) & (record.group[candidates] != record.group[i])
            candidates = candidates[same]
        if not len(candidates):
            continue
        apart = how.compare(rows[candidates], rows[i])
        least = int(np.argmin(apart))  # of equals the oldest, like the explorer's
        queries.append(i)
        best.append((apart[least], candidates[least]))
        judged = record.truth[i, candidates]
        certain = judged >= ELSEWHERE
        pairs.append(apart[certain].astype(np.float32))
        rights.append(judged[certain] == RETURNS)
    distance = np.array([value for value, _ in best])
    found = np.array([row for _, row in best], np.int64)
    answers = _answers(record, np.array(queries, np.int64), found, distance)
    empty = np.zeros(0, np.float32)
    return answers, Pairs(
        np.concatenate([empty, *pairs]),
        np.concatenate([empty.astype(bool), *rights]),
        int((record.truth == RETURNS).sum()),
    )


def votes(record: RunRecord, measure: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the explorer's own answers by the paper's rule: the vote of 4 among earlier tables of one direction.

    Returns
    -------
    queries, rows : (q,) int64
        Rows that had tables to be compared with, and the row that the vote found for each.
    distance : (q,)
        One less the similarity.
    """
    keyframes = Keyframes(1, record.features.shape[2])
    vote_of_k = Vote(preset("paper", measure=measure, sectors=record.features.shape[2]))
    queries, found, distance = [], [], []
    for i in range(len(record.step)):
        direction, group = int(record.direction[i]), int(record.group[i])
        features = record.features[i].astype(np.float64)
        keyframes.add(features=features, direction=direction, group=group, step=record.step[i], path=record.path[i])
        rows, similarities = vote_of_k.nearest(keyframes, np.flatnonzero(keyframes.group != group))
        if len(rows):
            queries.append(i)
            found.append(int(rows[0]))
            distance.append(1 - float(similarities[0]))
    return np.array(queries, np.int64), np.array(found, np.int64), np.array(distance)


def vote(record: RunRecord, measure: str) -> Answers:
    """Return the explorer's own answers by the paper's rule, against the truth."""
    return _answers(record, *votes(record, measure))


def _answers(record: RunRecord, queries: np.ndarray, found: np.ndarray, distance: np.ndarray) -> Answers:
    position, revisit = record.position, record.revisit
    return Answers(
        distance=distance,
        outcome=record.truth[queries, found],
        error=np.hypot(*(position[found] - position[queries]).T),
        revisit=revisit[queries],
        revisits=int(revisit.sum()),
    )


def pooled_answers(several: Sequence[Answers]) -> Answers:
    """Return the answers of several runs as those of one."""
    columns = ("distance", "outcome", "error", "revisit")
    return Answers(
        *(np.concatenate([getattr(one, name) for one in several]) for name in columns),
        revisits=sum(one.revisits for one in several),
    )


def curve(distance: np.ndarray, right: np.ndarray, total: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return thresholds, precision and recall, `(m,)` each: of all answers up to each distance that there is.

    Parameters
    ----------
    distance : (q,)
    right : (q,) bool
    total : int
        Answers that would have been right, of which the recall is.
    """
    order = np.argsort(distance, kind="stable")
    distance, right = distance[order], right[order]
    last = np.flatnonzero(np.append(np.diff(distance) > 0, True)) if len(distance) else np.zeros(0, np.int64)
    rights = np.cumsum(right)[last]
    return distance[last], rights / (last + 1), rights / max(total, 1)


def answers_curve(answers: Answers) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return thresholds, precision and recall of answers; those that are neither right nor wrong count neither way."""
    certain = answers.outcome >= ELSEWHERE
    return curve(answers.distance[certain], answers.outcome[certain] == RETURNS, answers.revisits)


def f1_scores(precision: np.ndarray, recall: np.ndarray) -> np.ndarray:
    """Return the harmonic means of precision and recall, `(m,)`; 0 where both are."""
    both = precision + recall
    return np.divide(2 * precision * recall, both, out=np.zeros_like(both), where=both > 0)


def scores(precision: np.ndarray, recall: np.ndarray) -> dict[str, float]:
    """Return the area under a curve of precision over recall (average precision), its best F1, and recalls.

    Parameters
    ----------
    precision, recall : (m,)
        As `curve` returns them.
    """
    if not len(precision):
        return {"area": 0.0, "f1": 0.0, "recall_100": 0.0, "recall_99": 0.0}
    return {
        "area": float((np.diff(recall, prepend=0.0) * precision).sum()),
        "f1": float(f1_scores(precision, recall).max()),
        "recall_100": float(recall[precision >= 1].max(initial=0.0)),
        "recall_99": float(recall[precision >= 0.99].max(initial=0.0)),
    }


def right_when_revisiting(answers: Answers) -> dict[str, float]:
    """Return how near the best candidates of revisits are: the share that is right, and the median error, metres."""
    back = answers.revisit
    if not back.any():
        return {"share_right": 0.0, "median_error_m": float("nan")}
    return {
        "share_right": float((answers.outcome[back] == RETURNS).sum() / answers.revisits),
        "median_error_m": float(np.median(answers.error[back])),
    }


def bootstrap_means(values: np.ndarray, seed: int = 0) -> np.ndarray:
    """Return means over draws of plans with replacement, the same draws for all measures.

    Parameters
    ----------
    values : (plans, measures)
    seed : int

    Returns
    -------
    (`BOOTSTRAPS`, measures) float64
    """
    plans = len(values)
    chosen = np.random.default_rng(seed).integers(0, plans, (BOOTSTRAPS, plans))
    return values[chosen].mean(axis=1)


def kept_curve(precision: np.ndarray, recall: np.ndarray) -> dict[str, list[float]]:
    """Return a curve of at most `CURVE_POINTS` points, as plain lists."""
    keep = np.unique(np.linspace(0, len(recall) - 1, min(CURVE_POINTS, len(recall))).astype(int))
    return {"precision": precision[keep].tolist(), "recall": recall[keep].tolist()}


def summary(record: RunRecord, measure: str, vectors: str, *, same_direction: bool) -> dict[str, Any]:
    """Return all scores of a measure over a run: of the queries' best candidates, and of all pairs."""
    answers, pairs = ask(record, measure, vectors, same_direction=same_direction)
    _, precision, recall = answers_curve(answers)
    _, pair_precision, pair_recall = curve(pairs.distance, pairs.right, pairs.total)
    return {
        "measure": measure,
        "vectors": vectors,
        "candidates": SAME_DIRECTION if same_direction else POINTS,
        **scores(precision, recall),
        **right_when_revisiting(answers),
        **{f"pairs_{name}": value for name, value in scores(pair_precision, pair_recall).items()},
        "curve": kept_curve(precision, recall),
        "pairs_curve": kept_curve(pair_precision, pair_recall),
    }


def vote_summary(record: RunRecord, measure: str) -> dict[str, Any]:
    """Return the scores of the explorer's own answers over a run, as `summary` does."""
    answers = vote(record, measure)
    _, precision, recall = answers_curve(answers)
    return {
        "measure": measure,
        "vectors": VECTORS[0],
        "candidates": VOTE,
        **scores(precision, recall),
        **right_when_revisiting(answers),
    }

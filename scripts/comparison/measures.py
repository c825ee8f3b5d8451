"""The measures of an episode, each of which is a column of the table."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from cyclic_env.trajectory.metrics import ate
from scripts.comparison.episode import EpisodeLog

CURVE_TOURS = np.round(np.arange(0, 2.01, 0.05), 2)
"""Path lengths, in closed tours, at which the coverage is recorded."""

COPIED = (
    *("return", "is_success", "coverage", "cycles_closed", "cycles_total", "claims", "false_claims", "revisits"),
    *("revisits_recognised", "precision", "recall", "collisions", "path_length_m", "steps"),
)
MEASURES = (
    *COPIED,
    *("f1", "tour_m", "tours", "loop_spl", "coverage_area", "t90_m", "t99_m", "match_error_m"),
    *("collisions_per_km", "ate_m", "coverage_curve"),
)
"""Columns that a rerun of the same job reproduces to the bit."""
TIMES = ("decision_ms", "seconds")
"""Columns that it doesn't reproduce."""


def measures_of(log: EpisodeLog) -> dict[str, Any]:
    """Return the measures of an episode that has ended; NaN where there is nothing to measure.

    ``tours`` is the path length in closed tours of the plan. ``loop_spl`` is the share of the cycles that were closed,
    multiplied by tour / path if the path is longer than the tour: success weighted by path length (P. Anderson et al.,
    "On evaluation of embodied navigation agents", 2018), with loops in place of goals. ``coverage_area`` is the mean
    coverage over a path of two tours, ``t90_m`` and ``t99_m`` the path lengths at which it reached 90 and 99 %.
    """
    final = log.final
    infos = log.all_infos()
    path, coverage = infos["path_length_m"], infos["coverage"]
    curve = coverage_curve(path, coverage, log.tour_m)
    length, tour = final["path_length_m"], log.tour_m
    closed = final["cycles_closed"] / final["cycles_total"] if final["cycles_total"] else 1.0
    found = final["precision"] + final["recall"]
    errors = infos["claim_error_m"][infos["claim_correct"]]
    decisions = np.array(log.decision_s[10:])
    return {
        **{name: final[name] for name in COPIED},
        "f1": 2 * final["precision"] * final["recall"] / found if found else 0.0,
        "tour_m": tour,
        "tours": length / tour,
        "loop_spl": closed * tour / max(tour, length),
        "coverage_area": float(curve.mean()),
        "t90_m": path_to(path, coverage, 0.90),
        "t99_m": path_to(path, coverage, 0.99),
        "match_error_m": float(errors.mean()) if len(errors) else math.nan,
        "collisions_per_km": 1000 * final["collisions"] / length if length else math.nan,
        "ate_m": ate_of(log),
        "coverage_curve": " ".join(f"{1000 * share:.0f}" for share in curve),
        "decision_ms": float(1000 * decisions.mean()) if len(decisions) else math.nan,
    }


def coverage_curve(path: np.ndarray, coverage: np.ndarray, tour_m: float) -> np.ndarray:
    """Return the coverage at the path lengths of `CURVE_TOURS`; beyond the end of the episode, its final coverage."""
    last = np.searchsorted(path, CURVE_TOURS * tour_m, side="right") - 1
    return coverage[np.maximum(last, 0)]


def path_to(path: np.ndarray, coverage: np.ndarray, share: float) -> float:
    """Return the path length at which the coverage first reached a share; NaN if it never did."""
    reached = np.flatnonzero(coverage >= share)
    return float(path[reached[0]]) if len(reached) else math.nan


def ate_of(log: EpisodeLog) -> float:
    """Return the absolute trajectory error of the agent's estimated poses, metres; NaN if it didn't track its pose."""
    if not log.beliefs or any(belief is None for belief in log.beliefs):
        return math.nan
    infos = np.array(log.infos)
    true = np.column_stack([infos["x"] - infos["x"][0], infos["y"] - infos["y"][0]])
    return ate(np.array(log.beliefs)[:, :2], true)

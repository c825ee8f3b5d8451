"""The statistics of a table of runs: the ranking, the differences to the reference, and the report in Markdown."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd

from cyclic_env.evaluation.statistics import (
    interquartile_mean,
    paired_difference,
    probability_of_improvement,
    stratified_interval,
    wilson_interval,
)
from scripts.comparison.suite import REFERENCE, Suite
from scripts.comparison.table import Runs

MEAN_COLUMNS = {
    "false claims": ("false_claims", 2),
    "precision": ("precision", 2),
    "recall": ("recall", 2),
    "F1": ("f1", 2),
    "coverage": ("coverage", 3),
    "coverage area": ("coverage_area", 2),
    "T90 (m)": ("t90_m", 0),
    "T99 (m)": ("t99_m", 0),
    "match error (m)": ("match_error_m", 2),
    "path / tour": ("tours", 2),
    "loop-SPL": ("loop_spl", 2),
    "collisions / km": ("collisions_per_km", 2),
    "ATE (m)": ("ate_m", 2),
    "decision (ms)": ("decision_ms", 2),
}
"""Columns of means, with their decimal places; NaNs, such as for a coverage that was not reached, are left out."""


def rank(frame: Runs, agents: Sequence[str]) -> Runs:
    """Return a row for each agent that has runs, the best first; privileged ones last and without a rank.

    Agents are ranked by success, then by the interquartile mean of the return.

    Parameters
    ----------
    frame : DataFrame
        Runs of one tier, as `RunTable.frame` returns them.
    agents : sequence of str
    """
    rows = [_summary(frame[frame["agent"] == agent]) for agent in agents if (frame["agent"] == agent).any()]
    rows.sort(key=lambda row: (row["privileged"], -row["_success"], -row["_return"]))
    place = 0
    for row in rows:
        place += not row["privileged"]
        row["rank"] = "privileged" if row.pop("privileged") else str(place)
        row["agent"] = row.pop("agent")
    table = pd.DataFrame(rows).drop(columns=["_success", "_return"])
    return table[["rank", "agent", *(name for name in table.columns if name not in ("rank", "agent"))]]


def _summary(runs: Runs) -> dict[str, Any]:
    returns, strata = runs["return"].to_numpy(float), runs["map"].to_numpy()
    share = (runs["cycles_closed"] / runs["cycles_total"].replace(0, 1)).where(runs["cycles_total"] > 0, 1.0)
    success = runs["is_success"].to_numpy(bool)
    means = {
        title: _number(float(np.nanmean(runs[name])) if runs[name].notna().any() else math.nan, digits)
        for title, (name, digits) in MEAN_COLUMNS.items()
    }
    return {
        "agent": str(runs["agent"].iloc[0]),
        "privileged": bool(runs["privileged"].iloc[0]),
        "runs": str(len(runs)),
        "success": _interval(float(success.mean()), wilson_interval(success), 2),
        "return (IQM)": _interval(float(interquartile_mean(returns)), stratified_interval(returns, strata), 1),
        "cycles": _number(float(share.mean()), 2),
        **means,
        "_success": float(success.mean()),
        "_return": float(interquartile_mean(returns)),
    }


def differences(frame: Runs, agents: Sequence[str], reference: str = REFERENCE) -> Runs:
    """Return how each agent compares with the reference, over pairs of runs with the same map, seed and start.

    Differences are averaged over the runs on a map first, since these are not independent; the interval is over maps.
    The probability of improvement is that on each map, averaged.
    """
    base = frame[frame["agent"] == reference]
    rows = []
    for agent in agents:
        other = frame[frame["agent"] == agent]
        pairs = other.merge(base, on=["map", "seed", "start"], suffixes=("", "_base"))
        if agent == reference or not len(pairs):
            continue
        by_map = pairs.groupby("map")[["return", "return_base"]].mean()
        mean, low, high = paired_difference(by_map["return"].to_numpy(), by_map["return_base"].to_numpy())
        better = [
            probability_of_improvement(part["return"].to_numpy(), part["return_base"].to_numpy())
            for _, part in pairs.groupby("map")
        ]
        gain = f"return minus that of {reference}"
        rows.append(
            {
                "agent": agent,
                "pairs": str(len(pairs)),
                gain: _interval(mean, (low, high), 1),
                "probability of improvement": _number(float(np.mean(better)), 2),
            }
        )
    return pd.DataFrame(rows)


def _number(value: float, digits: int) -> str:
    return "-" if math.isnan(value) else f"{value:.{digits}f}"


def _interval(value: float, interval: tuple[float, float], digits: int) -> str:
    low, high = interval
    return f"{value:.{digits}f}" if math.isnan(low) else f"{value:.{digits}f} [{low:.{digits}f}, {high:.{digits}f}]"


def report_text(summary: str, frame: Runs, suite: Suite, figures: Sequence[str]) -> str:
    """Return the report in Markdown.

    Parameters
    ----------
    summary : str
        One sentence about the runs.
    frame : DataFrame
        The runs, as `RunTable.frame` returns them.
    suite : Suite
    figures : sequence of str
        Names of the figures.
    """
    parts = ["# Agents compared", summary]
    for tier in suite.tiers:
        runs = frame[frame["tier"] == tier]
        if runs.empty:
            continue
        parts += [f"## Tier `{tier}`", rank(runs, suite.agents).to_markdown(index=False, disable_numparse=True)]
        against = differences(runs, suite.agents)
        if not against.empty:
            parts += [against.to_markdown(index=False, disable_numparse=True)]
    parts += ["## Figures", *(f"![{name}](figures/{name}.svg)" for name in figures), NOTES]
    return "\n\n".join(parts) + "\n"


NOTES = """## How to read this

- *success*: all cycles closed and 99 % of the building seen; in brackets 95 % intervals, Wilson's.
- *return (IQM)*: interquartile mean; 95 % intervals of a bootstrap that draws runs within each floor plan.
- *cycles*: share of the cycles closed. *loop-SPL*: that share times closed tour over path, where the path is longer.
- *false claims*, *precision*, *recall*, *F1* and all others: means over runs; of T90, T99, match error and ATE over the
  runs that have one.
- *privileged* agents see the truth: they bound what is possible, and are never ranked.
- The decision time depends on the machine, and is no score."""

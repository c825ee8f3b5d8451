"""The tables that commands print: evaluations side by side, and the scores of one episode."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from typing import Any

from agents import agent_label
from cyclic_env.evaluation.statistics import Evaluation

TEXT_COLUMNS = ("agent", "map", "noise", "actions", "start")
"""Columns that are aligned to the left."""

DIGITS = {
    "cycles closed": ("cycles_closed", 1),
    "false claims": ("false_claims", 1),
    "return": ("return", 1),
    "coverage": ("coverage", 2),
    "success": ("is_success", 2),
    "precision": ("precision", 2),
    "recall": ("recall", 2),
    "collisions": ("collisions", 1),
    "steps": ("steps", 0),
}
"""Columns of metrics, with the number of decimals."""


def format_table(evaluations: Sequence[Evaluation], *, markdown: bool = False, without: Collection[str] = ()) -> str:
    """Return a table with a row for each evaluation: means, and 95 % intervals where there are any.

    Parameters
    ----------
    evaluations : sequence of Evaluation
    markdown : bool
        Whether to put bars between the columns, for a document; otherwise spaces align them, for a terminal.
    without : collection of str
        Columns to leave out.
    """
    import pandas as pd  # slow to import, and not needed before there is something to show

    table = pd.DataFrame(_cells(evaluation) for evaluation in evaluations).drop(columns=list(without))
    align = ["left" if column in TEXT_COLUMNS else "right" for column in table.columns]
    layout = "pipe" if markdown else "plain"
    return table.to_markdown(index=False, tablefmt=layout, colalign=align, disable_numparse=True)


def _cells(evaluation: Evaluation) -> dict[str, str]:
    count = str(len(evaluation.episodes)) + (" identical" if evaluation.identical_episodes else "")
    cells = {
        "agent": agent_label(evaluation.agent),
        "map": evaluation.map,
        "noise": evaluation.noise,
        "actions": evaluation.action_type,
        "start": "random" if evaluation.random_start else "fixed",
        "episodes": count if evaluation.complete else f"{count} (cut short)",
    }
    summary = evaluation.summary()
    cells |= {column: _interval(summary[metric], digits) for column, (metric, digits) in DIGITS.items()}
    if evaluation.episodes:
        cells["cycles closed"] += f" of {summary['cycles_total']['mean']:g}"
    return cells


def _interval(entry: Mapping[str, float], digits: int) -> str:
    if math.isnan(entry["mean"]):
        return "-"
    mean = f"{entry['mean']:.{digits}f}"
    return mean if math.isnan(entry["low"]) else f"{mean} [{entry['low']:.{digits}f}, {entry['high']:.{digits}f}]"


def table_notes(evaluations: Sequence[Evaluation]) -> list[str]:
    """Return what a reader of the table must know, as one line each."""
    notes = []
    if any(evaluation.identical_episodes for evaluation in evaluations):
        notes.append(
            "identical: the seeds change nothing here, so all episodes are the same, and there is no interval; random "
            "starts, or noise, make them differ."
        )
    if any(evaluation.action_type == "discrete" for evaluation in evaluations):
        notes.append(
            "discrete: the environment itself fills in the match of a claim, so only the detection is judged; "
            "don't compare it with wheels or twist."
        )
    notes.append(
        "[ ]: 95 % interval of the mean (Student's; of success, Wilson's); none where all values are equal. "
        "Precision and recall: of all episodes together; -: nothing to judge."
    )
    return notes


def score_rows(info: Mapping[str, Any]) -> dict[str, str]:
    """Return the scores of closure and exploration in an episode's info, by name."""
    return {
        "cycles closed": f"{info['cycles_closed']} of {info['cycles_total']}",
        "false claims": f"{info['false_claims']} of {info['claims']}",
        "revisits recognised": f"{info['revisits_recognised']} of {info['revisits']}",
        "seen": f"{info['coverage']:.1%}",
        "path": f"{info['path_length_m']:,.0f} m",
    }


def format_rows(rows: Mapping[str, str]) -> str:
    """Return the scores of an episode as text, one per line."""
    return "\n".join(f"{name:>20}  {value}" for name, value in rows.items())

"""The report of a comparison: a Markdown document with figures, and one self-contained HTML page."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from cyclic_env.atomic_write import write_text_atomically
from scripts.comparison.figures import draw_figures
from scripts.comparison.page import page_text
from scripts.comparison.suite import Job, Suite
from scripts.comparison.summary import report_text
from scripts.comparison.table import FAILED, RunTable


def write_report(
    table: RunTable, jobs: Sequence[Job], suite: Suite, replays: Sequence[Job], folder: Path
) -> list[Path]:
    """Write the report on the runs that have ended and return its files; without such runs, write nothing.

    Parameters
    ----------
    table : RunTable
    jobs : sequence of Job
    suite : Suite
    replays : sequence of Job
        Jobs that the page replays, if their traces exist.
    folder : Path
    """
    frame = table.frame(jobs)
    if frame.empty:
        return []
    missing = sum(job not in table for job in jobs)
    failed = sum(job in table and table.rows[job.key]["status"] == FAILED for job in jobs)
    summary = (
        f"Runs: {len(frame)}, of {frame['agent'].nunique()} agents, on {frame['map'].nunique()} floor plans, with the "
        f"same starts and the same noise for all. Failed: {failed}. Yet to be run: {missing}."
    )
    figures = draw_figures(frame, suite.agents, folder)
    page = page_text(frame, suite, summary, figures, replays, folder)
    return [
        write_text_atomically(folder / "report.md", report_text(summary, frame, suite, figures)),
        write_text_atomically(folder / "report.html", page),
    ]

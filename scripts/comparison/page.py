"""The report as one self-contained HTML page: tables, figures, and replays that run in the browser."""

from __future__ import annotations

import json
from base64 import b64encode
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, FileSystemLoader
from markupsafe import Markup

from agents import privileged_names
from cyclic_env.config import CoverageConfig, RobotConfig
from cyclic_env.evaluation.privileged import Survey
from cyclic_env.floor_plans import FloorPlan, load_floor_plan
from cyclic_env.tiers import TIERS
from scripts.comparison.suite import Job, Suite
from scripts.comparison.summary import NOTES, differences, rank
from scripts.comparison.table import Runs
from scripts.comparison.trace import trace_path

TEMPLATES = Path(__file__).parent / "templates"
TITLES = {
    "profiles": "Share of the runs with a return of at least so much",
    "coverage": "Coverage over the path driven",
    "difficulty": "Success over the aliasing of the building and the noise: where each agent breaks",
}


def page_text(
    frame: Runs, suite: Suite, summary: str, figures: Sequence[str], replays: Sequence[Job], folder: Path
) -> str:
    """Return the HTML of the page.

    Parameters
    ----------
    frame : DataFrame
        The runs, as `RunTable.frame` returns them.
    suite : Suite
    summary : str
        One sentence about them.
    figures : sequence of str
        Names of SVG files in ``figures`` in the folder.
    replays : sequence of Job
        Runs to replay, all on one map; those without a trace in the folder are left out.
    folder : Path
    """
    templates = Environment(loader=FileSystemLoader(TEMPLATES), autoescape=True, trim_blocks=True, lstrip_blocks=True)
    tiers = [
        {
            "name": tier,
            "ranking": _table(rank(frame[frame["tier"] == tier], suite.agents)),
            "differences": _table(differences(frame[frame["tier"] == tier], suite.agents)),
        }
        for tier in suite.tiers
        if (frame["tier"] == tier).any()
    ]
    return templates.get_template("page.html.j2").render(
        style=_raw("style.css"),
        script=_raw("replay.js"),
        summary=summary,
        tiers=tiers,
        figures=[{"title": TITLES[name], "data": _figure(folder, name)} for name in figures],
        notes=[line.removeprefix("- ").replace("*", "") for line in _note_lines()],
        replay=replay_data([job for job in replays if trace_path(folder, job).exists()], folder),
    )


def _raw(name: str) -> Markup:
    return Markup((TEMPLATES / name).read_text(encoding="utf-8"))


def _table(table: Runs) -> Markup:
    return Markup("" if table.empty else table.to_html(index=False, border=0))


def _figure(folder: Path, name: str) -> str:
    return b64encode((folder / "figures" / f"{name}.svg").read_bytes()).decode()


def _note_lines() -> list[str]:
    return list(NOTES.replace("\n  ", " ").split("\n")[2:])


def replay_data(jobs: Sequence[Job], folder: Path) -> Markup:
    """Return what the replay needs as JSON: the plan, and the traces of runs on it; empty if there are no runs."""
    if not jobs:
        return Markup("")
    runs = []
    for job in jobs:
        laser = TIERS[job.tier].laser
        runs.append(
            {
                **json.loads(trace_path(folder, job).read_text(encoding="utf-8")),
                "privileged": job.agent in privileged_names(),
                "laser": {
                    "range": laser.range_max,
                    "first": laser.first_bearing,
                    "spacing": laser.beam_spacing,
                    "count": laser.num_beams,
                },
            }
        )
    plan = plan_data(load_floor_plan(jobs[0].map))
    text = json.dumps({"plan": plan, "dt": RobotConfig().dt, "runs": runs}, separators=(",", ":"))
    return Markup(text.replace("</", "<\\/"))


def plan_data(plan: FloorPlan) -> dict[str, Any]:
    """Return a plan for the replay: rings in centimetres, the blocks of its cycles, and its free cells."""
    survey = Survey(plan, TIERS["ideal"].laser, CoverageConfig())
    west, south, columns, rows = survey.extent
    return {
        "name": plan.name,
        "rings": [_centimetres(ring) for ring in plan.rings],
        "blocks": [_centimetres(np.array(block.exterior.coords)[:-1]) for block in plan.cycles],
        "west": west,
        "south": south,
        "size": CoverageConfig().cell_size,
        "columns": columns,
        "rows": rows,
        "cells": b64encode(survey.cells.astype("<u4").tobytes()).decode(),
    }


def _centimetres(ring: np.ndarray) -> list[int]:
    return np.rint(100 * ring).astype(int).ravel().tolist()

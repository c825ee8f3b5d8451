"""The whole reproduction: run what is missing, work out the sections, write tables, figures and the report."""

from __future__ import annotations

import csv
import math
import platform
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numba
import numpy as np
import scipy

from agents.knn.similarity import MEASURES
from agents.paper import figures
from agents.paper.cache import Cache, code_version, run_all
from agents.paper.report import Results, report_text
from agents.paper.runs import drive_again
from agents.paper.sections import (
    GOLDEN,
    Scope,
    all_runs,
    building_run,
    measures_compared,
    noise_runs,
    outcome,
    preset_runs,
    reach_runs,
    recognition,
    second_lap,
    varied_runs,
)
from agents.paper.timing import comparison_times, search_growth
from cyclic_env import __version__
from cyclic_env.floor_plans import load_floor_plan

IN_DOCS = (
    "figure_2_algorithm",
    "figure_4_similarity_alone",
    "figure_5_indicators_and_vote",
    "figure_6_extended",
    "recognition",
    "growth",
    "noise",
    "measures",
)
"""Figures that the documentation shows."""
EVERY = 5
"""Rows between two queries of the growth of the search."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Reproduction:
    """What to reproduce, and where to.

    Raises
    ------
    CyclicLoopError
        From `run`, if a run fails.
    """

    scope: Scope
    folder: Path
    """For the report, figures, tables, and in ``cache`` what has been worked out."""
    processes: int = 2
    docs: Path | None = None
    """Folder for ``paper.md`` and small pictures, if wanted."""
    tick: Callable[[str], None] = lambda text: None
    """Told how far it is."""

    def run(self) -> list[Path]:
        """Reproduce it, and return the files written. What has been worked out before is taken from the cache."""
        cache = Cache(self.folder / "cache")
        for name, runs in all_runs(self.scope).items():
            for done in run_all(cache, runs, self.processes):
                self.tick(f"{name}: {done} of {len(runs)} runs")
        results = self.results(cache)
        pictures = self._draw(cache, results)
        tables = self._write_tables(results)
        text = report_text(results, {name: f"{name}.png" for name in pictures})
        report = self.folder / "report.md"
        report.write_text(text, encoding="utf-8")
        written = [report, *pictures.values(), *tables]
        if self.docs is not None:
            written += self._write_docs(self.docs, results, pictures)
        return written

    def results(self, cache: Cache) -> Results:
        """Return all numbers of the report, the slow ones from the cache if they are there."""
        scope, tick = self.scope, self.tick
        settings = asdict(scope)
        record = cache.record(building_run(scope, "extended"))

        def grown() -> dict[str, list[float]]:
            laps = drive_again(record, building_run(scope, "extended"), scope.laps, noise="calibrated")
            return search_growth(laps, "cosine", EVERY)

        tick("times")
        timed = cache.result("times", settings, lambda: comparison_times(record.features[:, 0], scope.repeats))
        tick("growth of the search")
        growth = cache.result("growth", settings, grown)
        recognised = cache.result("recognition", settings, lambda: recognition(cache, scope, tick))
        compared = cache.result("measures", settings, lambda: measures_compared(cache, scope, tick))
        lap = second_lap(cache, scope)
        return Results(
            scope=scope,
            versions={
                "cyclic-loop": __version__,
                "code": code_version(),
                "Python": platform.python_version(),
                "NumPy": np.__version__,
                "SciPy": scipy.__version__,
                "numba": numba.__version__,
            },
            golden={name: measure.distance(*GOLDEN) for name, measure in MEASURES.items()},
            recognition=recognised,
            times=timed,
            growth=growth,
            lap_errors={
                "points": {name: lap.error(row) for name, row in lap.points.items()},
                "vote": {name: lap.error(row) for name, row in lap.voted.items()},
            },
            finished={name: cache.record(building_run(scope, name)).metrics for name in ("paper", "extended")},
            presets=[
                {"map": name, "noise": noise, "preset": preset, "runs": len(runs)}
                | outcome([cache.record(run) for run in runs])
                for (name, noise, preset), runs in preset_runs(scope).items()
            ],
            varied=[
                {"reading": name, "value": value, "map": plan} | outcome([cache.record(run)])
                for (name, value, plan), run in varied_runs(scope).items()
            ],
            reaches=[{"reach_m": reach} | outcome([cache.record(run)]) for reach, run in reach_runs(scope).items()],
            noise=[
                {"agent": agent, "noise": noise, "scale": _scale(noise), "runs": len(runs)}
                | outcome([cache.record(run) for run in runs])
                for (agent, noise), runs in noise_runs(scope).items()
            ],
            measures=compared,
        )

    def _draw(self, cache: Cache, results: Results) -> dict[str, Path]:
        """Write all figures; return the files by name."""
        self.tick("figures")
        plan = load_floor_plan(self.scope.building)
        runs = {name: building_run(self.scope, name) for name in ("extended", "paper")}
        records = {name: cache.record(run) for name, run in runs.items()}
        lap = second_lap(cache, self.scope)
        drawn = {
            "figure_1_building": figures.building(plan),
            "figure_2_algorithm": figures.algorithm(),
            "figure_3_start": figures.start(plan, records["extended"], runs["extended"].range_max),
            "figure_4_similarity_alone": figures.similarity_alone(plan, lap),
            "figure_5_indicators_and_vote": figures.indicators_and_vote(plan, lap),
            "figure_6_extended": figures.finished_run(plan, records["extended"], "The finished run, preset extended"),
            "figure_6_paper": figures.finished_run(plan, records["paper"], "The finished run, preset paper"),
            "recognition": figures.recognition_curves(results.recognition["tables"]),
            "growth": figures.growth(results.growth),
            "noise": figures.noise(results.noise),
            "measures": figures.measures(results.measures),
        }
        return {name: figures.save(figure, self.folder, name) for name, figure in drawn.items()}

    def _write_tables(self, results: Results) -> list[Path]:
        recognised = [
            {"rows": test, **{key: value for key, value in entry.items() if not key.endswith("curve")}}
            for test, entries in results.recognition["tables"].items()
            for entry in entries
        ]
        curves = [
            {"rows": test, "measure": entry["measure"], "vectors": entry["vectors"], "candidates": entry["candidates"]}
            | {"of": of, "recall": recall, "precision": precision}
            for test, entries in results.recognition["tables"].items()
            for entry in entries
            for of, key in (("rows", "curve"), ("pairs", "pairs_curve"))
            if key in entry
            for recall, precision in zip(entry[key]["recall"], entry[key]["precision"], strict=True)
        ]
        times = [
            {"measure": name, "what": what, "quartile_1_s": low, "median_s": median, "quartile_3_s": high}
            for name, entry in results.times.items()
            for what, quartiles in entry.items()
            if quartiles is not None
            for low, median, high in [quartiles]
        ]
        growth = [
            dict(zip(results.growth, values, strict=True)) for values in zip(*results.growth.values(), strict=True)
        ]
        tables = {
            "recognition": recognised,
            "curves": curves,
            "times": times,
            "growth": growth,
            "presets": results.presets,
            "ambiguities": results.varied,
            "reach": results.reaches,
            "noise": results.noise,
            "measures": results.measures,
        }
        return [write_csv(self.folder / f"{name}.csv", rows) for name, rows in tables.items()]

    def _write_docs(self, docs: Path, results: Results, pictures: Mapping[str, Path]) -> list[Path]:
        folder = docs / "paper"
        folder.mkdir(parents=True, exist_ok=True)
        shown = {name: folder / f"{name}.png" for name in IN_DOCS}
        for name, path in shown.items():
            figures.write_small(pictures[name], path)
        page = docs / "paper.md"
        text = report_text(results, {name: f"paper/{path.name}" for name, path in shown.items()})
        page.write_text(text, encoding="utf-8")
        return [page, *shown.values()]


def _scale(noise: str) -> float | None:
    """Return the factor in a noise's name; None for a preset."""
    return float(noise.split()[0]) if noise.endswith("x poor") else None


def write_csv(path: Path, rows: Sequence[Mapping[str, Any]]) -> Path:
    """Write rows with the same keys as a table; numbers that are none stay empty."""
    with path.open("w", encoding="utf-8", newline="") as file:
        names = list(dict.fromkeys(key for row in rows for key in row))
        writer = csv.DictWriter(file, names)
        writer.writeheader()
        for row in rows:
            writer.writerow(
                {key: "" if isinstance(value, float) and math.isnan(value) else value for key, value in row.items()}
            )
    return path

"""The whole reproduction: run what is missing, work out the sections, write tables, figures and the report."""

from __future__ import annotations

import csv
import platform
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from agents.knn.similarity import MEASURES
from cyclic_env import __version__
from cyclic_env.atomic_write import atomic_write, write_text_atomically
from cyclic_env.floor_plans import load_floor_plan
from scripts.paper import figures
from scripts.paper.cache import LIBRARIES, Cache, code_version, run_all
from scripts.paper.report import report_text
from scripts.paper.results import Results
from scripts.paper.runs import drive_again
from scripts.paper.sections import (
    GOLDEN,
    Scope,
    SecondLap,
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
from scripts.paper.timing import comparison_times, search_growth

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
        cache, runs = Cache(self.folder / "cache"), all_runs(self.scope)
        for done, count in run_all(cache, runs, self.processes):
            self.tick(f"{done} of {count} runs")
        lap = second_lap(cache, self.scope)
        results = self.results(cache, lap)
        self.tick("figures and tables")
        pictures = self._draw(cache, results, lap)
        report = write_text_atomically(self.folder / "report.md", report_text(results))
        written = [report, *pictures, *self._write_tables(results)]
        if self.docs is not None:
            (self.docs / "paper").mkdir(parents=True, exist_ok=True)
            written.append(write_text_atomically(self.docs / "paper.md", report_text(results, "paper/")))
            written += [figures.write_small(path, self.docs / "paper" / path.name) for path in pictures]
        return written

    def results(self, cache: Cache, lap: SecondLap) -> Results:
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
        return Results(
            scope=scope,
            versions={
                "cyclic-loop": __version__,
                "code": code_version(),
                "Python": platform.python_version(),
                **{name: version(name) for name in LIBRARIES},
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
                {"agent": agent, "noise": noise, "scale": runs[0].noise_scale if runs[0].noise == "poor" else None}
                | {"runs": len(runs)}
                | outcome([cache.record(run) for run in runs])
                for (agent, noise), runs in noise_runs(scope).items()
            ],
            measures=measures_compared(cache, scope, tick),
        )

    def _draw(self, cache: Cache, results: Results, lap: SecondLap) -> list[Path]:
        """Write all figures; return the files."""
        plan = load_floor_plan(self.scope.building)
        runs = {name: building_run(self.scope, name) for name in ("extended", "paper")}
        records = {name: cache.record(run) for name, run in runs.items()}
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
        return [figures.save(figure, self.folder, name) for name, figure in drawn.items()]

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


def write_csv(path: Path, rows: Sequence[Mapping[str, Any]]) -> Path:
    """Write rows with the same keys as a table, NaN as nothing; return the file."""
    with atomic_write(path) as part, part.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, list(dict.fromkeys(key for row in rows for key in row)))
        writer.writeheader()
        for row in rows:
            writer.writerow(
                {key: "" if value != value else value for key, value in row.items()}
            )  # NaN alone is not itself
    return path

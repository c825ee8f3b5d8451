"""The report: its numbers come from the experiments, its sentences from ``templates/paper.md.j2``."""

from __future__ import annotations

import platform
from dataclasses import dataclass
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
import pandas as pd
from scipy.stats import spearmanr

from agents.knn.similarity import MEASURES
from cyclic_env import load_floor_plan
from cyclic_env.atomic_write import write_text_atomically
from cyclic_env.config import noise_from_name
from cyclic_env.evaluation.statistics import paired_difference
from scripts.paper import experiments, figures
from scripts.paper.experiments import Scope
from scripts.paper.recognition import BEAMS, SECTORS, SecondLap
from scripts.paper.runs import RunSettings
from scripts.paper.store import LIBRARIES, Store, code_version
from scripts.paper.timing import comparison_times, search_growth

GOLDEN_FIRST = range(7, 12)
"""The values v for which the vectors (v, ..., v, v + 20) and (v, ..., v, v + 1, v + 1, v + 18) give all of Table 1."""
TABLE_1 = {
    "jaccard": 0.429,
    "euclidean": 2.449,
    "cityblock": 4.0,
    "chebyshev": 2.0,
    "cosine": 0.002,
    "spearman": 0.317,
    "variation": 101.952,
}
TABLE_2 = {
    "jaccard": 0.000414,
    "euclidean": 0.000528,
    "cityblock": 0.000573,
    "chebyshev": 0.000360,
    "cosine": 0.000405,
    "spearman": 0.000661,
    "variation": 0.000376,
}
"""The times in the paper's table, seconds."""


def golden_pair(v: int) -> tuple[np.ndarray, np.ndarray]:
    """Return one of the pairs of feature vectors that give Table 1."""
    return np.array([*[v] * 6, v + 20.0]), np.array([*[v] * 4, v + 1, v + 1, v + 18.0])


def table_1_of(v: int) -> dict[str, float]:
    """Return the distance of a golden pair for each measure."""
    a, b = golden_pair(v)
    return {name: MEASURES[name].distance(a, b) for name in TABLE_1}


def number(value: float, digits: int = 0) -> str:
    """Return a number with so many decimals, or a dash if it is missing."""
    return "-" if value is None or np.isnan(value) else f"{value:,.{digits}f}"


def percent(value: float, digits: int = 0) -> str:
    """Return a share as a percentage."""
    return number(100 * value, digits) + (" %" if not np.isnan(value) else "")


def verdict(text: str, holds: bool) -> str:
    """Return a verdict in bold, or a note that the numbers don't bear it out."""
    return f"**{text}**" if holds else f"**not borne out by these numbers** (the page says: {text})"


@dataclass(frozen=True, kw_only=True)
class Reproduction:
    """A reproduction of the paper: its scope, and the folders that it writes to."""

    scope: Scope
    folder: Path
    """Folder for the report, its figures and tables, and, in ``cache``, stored results."""
    processes: int = 2
    docs: Path | None = None
    """Folder for ``paper.md`` and small pictures, if they are wanted."""

    @cached_property
    def store(self) -> Store:
        """The stored results."""
        return Store(self.folder / "cache", self.processes)

    @cached_property
    def tables(self) -> dict[str, pd.DataFrame]:
        """All tables of the report by name; results that are not stored are computed."""
        scope, store = self.scope, self.store
        by_explorer = ("explorer", "noise")
        tables = {"headline": experiments.table(store, experiments.headline_runs(scope), by_explorer)}
        tables["differences"] = experiments.differences(tables["headline"])
        tables["plans"] = experiments.table(store, {"both": experiments.plan_runs(scope)}, ("explorer",))
        tables["recognition"], tables["centres"] = experiments.recognition(store, scope)
        tables["times"] = store.result(comparison_times, self._building("extended"), scope.repeats)
        tables["growth"] = store.result(search_growth, self._building("extended"), scope.laps)
        if scope.variations:
            tables["variations"] = experiments.table(store, experiments.varied_runs(scope), ("reading", "choice"))
        if scope.noise_scales:
            tables["noise"] = experiments.table(store, experiments.noise_runs(scope), ("explorer", "scale"))
        return tables

    def _building(self, preset: str) -> Any:
        return self.store.record(RunSettings(map=self.scope.building, preset=preset))

    def run(self) -> list[Path]:
        """Reproduce everything and return the files written."""
        self.store.run_all(experiments.all_runs(self.scope))
        tables = self.tables
        pictures = [figures.save(figure, self.folder, name) for name, figure in self._figures().items()]
        written = [write_text_atomically(self.folder / "report.md", self.text()), *pictures]
        for name, frame in tables.items():
            text = frame.to_csv(index=False, float_format="%.6g")
            written.append(write_text_atomically(self.folder / f"{name}.csv", text))
        if self.docs is not None:
            (self.docs / "paper").mkdir(parents=True, exist_ok=True)
            written.append(write_text_atomically(self.docs / "paper.md", self.text("paper/")))
            written += [figures.write_small(path, self.docs / "paper" / path.name) for path in pictures]
        return written

    def _figures(self) -> dict[str, figures.Figure]:
        tables, paper, extended = self.tables, self._building("paper"), self._building("extended")
        lap = SecondLap(extended)
        drawn = {
            "figure_1_building": figures.building(paper),
            "figure_2_algorithm": figures.algorithm(),
            "figure_3_start": figures.start(paper),
            "figure_4_similarity_alone": figures.similarity_alone(lap),
            "figure_5_indicators_and_position": figures.indicators_and_position(lap),
            "figure_6_finished": figures.finished_run(paper),
            "measures": figures.measures(tables["recognition"]),
            "growth": figures.growth(tables["growth"]),
        }
        return drawn | ({"noise": figures.noise(tables["noise"])} if "noise" in tables else {})

    def text(self, pictures: str = "") -> str:
        """Return the report in Markdown; `pictures` is empty, or the folder of the pictures with a slash."""
        loader = jinja2.FileSystemLoader(Path(__file__).with_name("templates"))
        environment = jinja2.Environment(loader=loader, undefined=jinja2.StrictUndefined, keep_trailing_newline=True)
        environment.globals |= {"number": number, "percent": percent, "verdict": verdict}
        return environment.get_template("paper.md.j2").render(pictures=pictures, **self._numbers())

    def _numbers(self) -> dict[str, Any]:
        """Return the variables of the template."""
        tables, scope = self.tables, self.scope
        versions = {"code": code_version(), "Python": platform.python_version()}
        times = tables["times"].set_index("measure")
        return {
            "scope": scope,
            "headline": Cells(tables["headline"], ("explorer", "noise")),
            "differences": tables["differences"].set_index(["against", "metric"]),
            "plans": tables["plans"],
            "building": load_floor_plan(scope.building),
            "finished": self._building("paper").metrics,
            "extended": self._building("extended").metrics,
            "found": Cells(tables["recognition"], ("noise", "search", "vectors", "measure")),
            "centres": Cells(tables["centres"], ("noise",)),
            "over_cosine": over_cosine(tables["recognition"]),
            "golden": all(
                abs(table_1_of(v)[name] - value) < 6e-4 for v in GOLDEN_FIRST for name, value in TABLE_1.items()
            ),
            "SECTORS": SECTORS,
            "BEAMS": BEAMS,
            "times": times,
            "rank": float(spearmanr([times.pair_s[n] for n in TABLE_2], list(TABLE_2.values())).statistic),  # pyright: ignore[reportAttributeAccessIssue]
            "growth": tables["growth"].tail(len(tables["growth"]) // scope.laps).median(),
            "variations": Cells(tables["variations"], ("reading", "choice")) if "variations" in tables else None,
            "choices": experiments.VARIATIONS,
            "calibrated": noise_from_name("calibrated"),
            "noise": Cells(tables["noise"], ("explorer", "scale")) if "noise" in tables else None,
            "versions": versions | {name: version(name) for name in LIBRARIES},
        }


class Cells:
    """Means of a table's metrics, with intervals, over the rows with the same key.

    Parameters
    ----------
    frame : DataFrame
    by : tuple of str
        The columns that form the key.
    """

    def __init__(self, frame: pd.DataFrame, by: tuple[str, ...]) -> None:
        self._frame = frame
        self._by = by

    def rows(self, *key: Any) -> pd.DataFrame:
        """Return the rows with a key."""
        return self._frame.loc[np.logical_and.reduce([self._frame[c] == k for c, k in zip(self._by, key, strict=True)])]

    def mean(self, metric: str, *key: Any) -> float:
        """Return the mean of a metric."""
        return float(self.rows(*key)[metric].to_numpy(float).mean())

    def total(self, metric: str, *key: Any) -> int:
        """Return the sum of a count."""
        return int(self.rows(*key)[metric].to_numpy().sum())

    def count(self, *key: Any) -> int:
        """Return the number of rows."""
        return len(self.rows(*key))

    def cell(self, metric: str, *key: Any, digits: int = 1, scale: float = 1.0) -> str:
        """Return ``mean [low, high]``, or the mean where there is no interval."""
        entry = scale * experiments.intervals(self.rows(*key).assign(all=0), ("all",), metric).iloc[0]
        mean = number(entry["mean"], digits)
        return mean if np.isnan(entry.low) else f"{mean} [{number(entry.low, digits)}, {number(entry.high, digits)}]"

    def share(self, metric: str, *key: Any) -> str:
        """Return the same in percent."""
        return self.cell(metric, *key, digits=0, scale=100.0)


def over_cosine(recognition: pd.DataFrame) -> dict[tuple[str, str], Any]:
    """Return how much each measure's average precision differs from cosine's, paired by plan; by vectors and measure.

    The search compares rows of the same direction, with calibrated sensors.
    """
    rows = recognition[(recognition.search == "direction") & (recognition.noise == "calibrated")]
    wide = rows.pivot_table(index="map", columns=["vectors", "measure"], values="average_precision")
    return {
        (vectors, name): paired_difference(wide[vectors, name].to_numpy(), wide[vectors, "cosine"].to_numpy())
        for vectors in (SECTORS, BEAMS)
        for name in MEASURES
        if name != "cosine"
    }

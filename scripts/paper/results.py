"""All numbers of the report, as plain values, and what several of its parts read off them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import spearmanr

from scripts.paper.recognition import VECTORS
from scripts.paper.sections import TABLE_2, Scope


@dataclass(frozen=True, slots=True, kw_only=True)
class Search:
    """What finding the nearest row costs and brings, by one way of searching."""

    compared: float
    """Rows and centres compared for a query, mean over the last lap."""
    seconds: float
    """For a query, median over the last lap."""
    found: float
    """Share of queries whose place is found, from the second lap on, where every place is a known one."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Results:
    """All numbers of the report."""

    scope: Scope
    versions: dict[str, str]
    golden: dict[str, float]
    """Table 1 from the pair of vectors that gives it."""
    recognition: dict[str, Any]
    times: dict[str, dict[str, Any]]
    growth: dict[str, list[float]]
    lap_errors: dict[str, dict[str, float]]
    """Metres that what a measure finds near the start is off, by points and by vote."""
    finished: dict[str, dict[str, Any]]
    presets: list[dict[str, Any]]
    varied: list[dict[str, Any]]
    reaches: list[dict[str, Any]]
    noise: list[dict[str, Any]]
    measures: list[dict[str, Any]]

    def recognised(self, rows: str, measure: str, candidates: str, vectors: str = VECTORS[0]) -> dict[str, Any]:
        """Return the scores of one measure on the building's run."""
        (entry,) = (
            entry
            for entry in self.recognition["tables"][rows]
            if (entry["measure"], entry["candidates"], entry["vectors"]) == (measure, candidates, vectors)
        )
        return entry

    def noisy(self, agent: str, scale: float) -> dict[str, Any]:
        """Return the scores of an agent at a share of the poor preset's noise."""
        (entry,) = (entry for entry in self.noise if (entry["agent"], entry["scale"]) == (agent, scale))
        return entry

    def order_of_times(self) -> tuple[float, list[str]]:
        """Return the rank correlation of our times of a pair with the paper's, and our order, quickest first."""
        ours = {name: self.times[name]["pair"][1] for name in TABLE_2}
        rank = spearmanr([ours[name] for name in TABLE_2], list(TABLE_2.values())).statistic  # pyright: ignore[reportAttributeAccessIssue]
        return float(rank), sorted(ours, key=ours.__getitem__)

    def search(self, way: str) -> Search:
        """Return what a way of searching, ``"points"``, ``"direction"`` or ``"groups"``, comes to on the long run."""
        path, laps = np.array(self.growth["path"]), self.scope.laps
        known, last = path > path.max() / laps, path > path.max() * (laps - 1) / laps
        right = self.growth.get(f"{way}_right")
        return Search(
            compared=float(np.array(self.growth[way])[last].mean()),
            seconds=float(np.median(np.array(self.growth[f"{way}_s"])[last])),
            found=float("nan") if right is None else float(np.array(right)[known].mean()),
        )

    def areas(self, vectors: str, rows: str) -> dict[str, dict[str, Any]]:
        """Return the scores over all plans by measure, that of the largest area first."""
        mine = [entry for entry in self.measures if (entry["vectors"], entry["rows"]) == (vectors, rows)]
        return {entry["measure"]: entry for entry in sorted(mine, key=lambda entry: -entry["area"])}


def against_cosine(entry: Mapping[str, Any]) -> str:
    """Return whether an area is surely larger (+) or smaller (-) than cosine's, by its interval; else nothing."""
    return "+" if entry["over_cosine_low"] > 0 else "-" if entry["over_cosine_high"] < 0 else ""

"""The sections of the report: which runs each needs, and what it makes of them, as plain values."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from agents.knn.similarity import MEASURES
from cyclic_env import map_names
from cyclic_env.evaluation.statistics import mean_interval
from cyclic_env.task.loop_closure import RETURNS
from scripts.paper.cache import Cache
from scripts.paper.recognition import (
    VECTORS,
    answers_curve,
    ask,
    bootstrap_means,
    scores,
    summary,
    vote_summary,
    votes,
)
from scripts.paper.runs import RunRecord, RunSettings, drive_again

GOLDEN = np.array([7, 7, 7, 7, 7, 7, 27.0]), np.array([8, 8, 7, 7, 7, 7, 25.0])
"""The pair of feature vectors that gives all of the paper's Table 1 at once."""
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
"""Seconds, as the paper has them."""
AGENTS: dict[str, dict[str, Any]] = {
    "paper": {"preset": "paper"},
    "extended": {"preset": "extended"},
    "extended, KNN only": {"preset": "extended", "changes": {"detector": "knn"}},
    "extended, position only": {"preset": "extended", "changes": {"detector": "position"}},
}
EXPLORER, AGAIN = "as explored", "driven again"
"""The rows that measures are tested on: those of an exploration, and those of the same way a second time."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Scope:
    """How much is run."""

    name: str
    building: str = "killian_court"
    """That of the paper's figures."""
    maps: tuple[str, ...]
    """On which measures and presets are compared."""
    seeds: int
    """Noisy runs of each of these."""
    varied_maps: tuple[str, ...]
    neighbours: tuple[int, ...]
    sectors: tuple[int, ...]
    reaches: tuple[float, ...]
    thresholds: tuple[float, ...]
    noise_maps: tuple[str, ...]
    noise_scales: tuple[float, ...]
    noise_seeds: int
    laps: int
    """Of the building, for the growth of the search."""
    repeats: int
    """Batches of timings."""


FULL = Scope(
    name="full",
    maps=tuple(map_names()),
    seeds=3,
    varied_maps=("killian_court", "figure_eight", "twin_rings", "grid"),
    neighbours=(1, 2, 3, 4, 5, 6, 7, 8),
    sectors=(3, 5, 7, 9, 13),
    reaches=(4.0, 6.0, 8.0, 12.0, 16.0, 20.0, 30.0),
    thresholds=(0.9, 0.95, 0.98, 0.99, 0.995, 0.999),
    noise_maps=("figure_eight", "twin_rings", "killian_court"),
    noise_scales=(0.0, 0.125, 0.25, 0.5, 0.75, 1.0),
    noise_seeds=2,
    laps=7,
    repeats=60,
)
QUICK = Scope(
    name="quick",
    maps=tuple(map_names()),
    seeds=1,
    varied_maps=("killian_court", "figure_eight", "twin_rings", "grid"),
    neighbours=(1, 4, 8),
    sectors=(5, 7, 13),
    reaches=(4.0, 8.0, 12.0, 20.0, 30.0),
    thresholds=(0.95, 0.99, 0.999),
    noise_maps=("figure_eight", "twin_rings"),
    noise_scales=(0.0, 0.25, 0.5, 1.0),
    noise_seeds=2,
    laps=7,
    repeats=30,
)


def variations(scope: Scope) -> dict[str, dict[str, dict[str, Any]]]:
    """Return the readings that the paper leaves open: by name and value, the settings of a run that it has changed."""

    def changed(setting: str, values: Sequence[Any]) -> dict[str, dict[str, Any]]:
        return {str(value): {"changes": {setting: value}} for value in values}

    return {
        "order of the list": changed("order", ("first in first out", "last in first out", "nearest")),
        "K": changed("neighbours", scope.neighbours),
        "sectors": changed("sectors", scope.sectors),
        "reach of the laser, m": {f"{reach:g}": {"range_max": reach} for reach in scope.reaches},
        "threshold": {"calibrated": {}, **changed("threshold", scope.thresholds)},
        "tables compared": {
            "same direction": {},
            "opposite too, looking back": {"changes": {"both_directions": True}},
        },
        "told by": {
            "KNN": {"changes": {"detector": "knn"}},
            "KNN, gated by position": {},
            "position": {"changes": {"detector": "position"}},
        },
    }


def explored_runs(scope: Scope) -> list[RunSettings]:
    """Return the runs on which measures are tested: the extended explorer's, which see the buildings to their ends."""
    return [
        RunSettings(map=name, preset="extended", noise="calibrated", seed=seed)
        for name in scope.maps
        for seed in range(scope.seeds)
    ]


def preset_runs(scope: Scope) -> dict[tuple[str, str, str], list[RunSettings]]:
    """Return the runs of both presets on all plans, by plan, noise and preset."""
    return {
        (name, noise, preset): [
            RunSettings(map=name, preset=preset, noise=noise, seed=seed)
            for seed in range(1 if noise == "ideal" else scope.seeds)
        ]
        for name in scope.maps
        for noise in ("ideal", "calibrated")
        for preset in ("paper", "extended")
    }


def varied_runs(scope: Scope) -> dict[tuple[str, str, str], RunSettings]:
    """Return the runs of the variations, by name, value and plan."""
    return {
        (name, value, plan): RunSettings(map=plan, **changes)
        for name, values in variations(scope).items()
        for value, changes in values.items()
        for plan in scope.varied_maps
    }


def reach_runs(scope: Scope) -> dict[float, RunSettings]:
    """Return the runs of the extended explorer with other reaches of the laser."""
    return {reach: RunSettings(map=scope.building, preset="extended", range_max=reach) for reach in scope.reaches}


def noise_runs(scope: Scope) -> dict[tuple[str, str], list[RunSettings]]:
    """Return the runs of the sweep between ideal and poor, and of the presets, by agent and noise."""
    noises: dict[str, dict[str, Any]] = {
        f"{scale:g} x poor": {"noise": "poor", "noise_scale": scale} for scale in scope.noise_scales
    }
    noises |= {name: {"noise": name} for name in ("calibrated", "typical")}
    return {
        (agent, noise): [
            RunSettings(map=plan, seed=seed, **of_agent, **of_noise)
            for plan in scope.noise_maps
            for seed in range(scope.noise_seeds)
        ]
        for agent, of_agent in AGENTS.items()
        for noise, of_noise in noises.items()
    }


def building_run(scope: Scope, preset: str) -> RunSettings:
    """Return the run of the paper's building with ideal sensors."""
    return RunSettings(map=scope.building, preset=preset)


def all_runs(scope: Scope) -> list[RunSettings]:
    """Return all runs of a report; some are in it several times."""
    return [
        *(building_run(scope, preset) for preset in ("extended", "paper")),
        *itertools.chain(*preset_runs(scope).values()),
        *varied_runs(scope).values(),
        *reach_runs(scope).values(),
        *itertools.chain(*noise_runs(scope).values()),
    ]


# 1. Table 1, and what it can't show.


def start_return(record: RunRecord) -> dict[str, Any] | None:
    """Return Table 1 at the run's own return to its start, None if it never came back.

    The query is the row nearest to the start of those that return to one of the first rows, and the other vector that
    row's. ``ahead`` has the distances of the vectors as they are, ``back`` those to what that row saw looking back.
    """
    first = 3
    returns = np.flatnonzero((record.truth[:, :first] == RETURNS).any(axis=1))
    if not len(returns):
        return None
    position = record.position
    off = np.hypot(*(position[returns, None] - position[None, :first]).transpose(2, 0, 1))
    off[record.truth[returns, :first] != RETURNS] = math.inf
    nearest, start = np.unravel_index(int(np.argmin(off)), off.shape)
    query = int(returns[nearest])
    a, ahead, back = record.features[query, 0], record.features[start, 0], record.features[start, 1]
    return {
        "query_path_m": float(record.path[query]),
        "off_m": float(off.min()),
        "query_direction": int(record.direction[query]),
        "start_direction": int(record.direction[start]),
        "query": a.tolist(),
        "start_ahead": ahead.tolist(),
        "start_back": back.tolist(),
        "ahead": {name: measure.distance(a, ahead) for name, measure in MEASURES.items()},
        "back": {name: measure.distance(a, back) for name, measure in MEASURES.items()},
    }


def recognition(cache: Cache, scope: Scope, tick: Callable[[str], None]) -> dict[str, Any]:
    """Return the scores of all measures on the building's run, as explored and driven again."""
    settings = building_run(scope, "extended")
    record = cache.record(settings)
    tests = {EXPLORER: record, AGAIN: drive_again(record, settings, 2, noise="ideal")}
    tables: dict[str, list[dict[str, Any]]] = {}
    for test, rows in tests.items():
        tables[test] = []
        for name in MEASURES:
            tick(f"recognition {test}: {name}")
            for vectors in VECTORS:
                tables[test] += [summary(rows, name, vectors, same_direction=same) for same in (False, True)]
            tables[test].append(vote_summary(rows, name))
    revisit = np.flatnonzero(record.revisit)
    same = [(record.direction[record.truth[i] == RETURNS] == record.direction[i]).any() for i in revisit]
    return {
        "start": start_return(record),
        "tables": tables,
        "rows": {test: len(rows.step) for test, rows in tests.items()},
        "revisits": {test: int(rows.revisit.sum()) for test, rows in tests.items()},
        "same_direction": int(sum(same)),
    }


# 4. Figures 4 and 5.


@dataclass(frozen=True, slots=True, kw_only=True)
class SecondLap:
    """What is found a metre after the start, when the building's way is driven a second time."""

    record: RunRecord
    """Of both laps."""
    query: int
    apart: np.ndarray
    """Of the rows of the first lap from the query, by cosine, `(n,)`."""
    points: dict[str, int]
    """Row at the least distance among all points of the first lap, by measure."""
    voted: dict[str, int]
    """Row that indicators, groups and vote find, by measure; the cosine's first of all."""

    def error(self, row: int) -> float:
        """Return how far a row is from the query, metres."""
        return float(np.hypot(*(self.record.position[row] - self.record.position[self.query])))


def second_lap(cache: Cache, scope: Scope) -> SecondLap:
    """Return what each measure finds near the start, after the building's way has been driven once."""
    settings = building_run(scope, "extended")
    record = cache.record(settings)
    laps = drive_again(record, settings, 2, noise="ideal")
    query = len(record.step) + 1
    features = laps.features[:, 0].astype(np.float64)
    apart = {}
    for name, measure in MEASURES.items():
        rows = measure.prepare(features)
        apart[name] = measure.compare(rows[: len(record.step)], rows[query])
    voted = {}
    for name in MEASURES:
        queries, found, _ = votes(laps, name)
        voted[name] = int(found[np.flatnonzero(queries == query)[0]])
    points = {name: int(np.argmin(values)) for name, values in apart.items()}
    return SecondLap(record=laps, query=query, apart=apart["cosine"], points=points, voted=voted)


# 7. Which measure is best.


def measures_compared(cache: Cache, scope: Scope, tick: Callable[[str], None]) -> list[dict[str, Any]]:
    """Return mean scores of all measures over plans, with intervals of the area and its difference from cosine's.

    The runs of one plan are alike, so a plan counts as one: its scores are the means of its runs'.
    """
    runs, names, cells = explored_runs(scope), list(MEASURES), list(itertools.product((EXPLORER, AGAIN), VECTORS))
    by_plan: dict[str, list[dict[str, dict[str, float]]]] = {}
    for number, run in enumerate(runs):
        tick(f"measures: run {number + 1} of {len(runs)}")
        scored = cache.result("scores", asdict(run), lambda run=run: run_scores(cache, run))
        by_plan.setdefault(run.map, []).append(scored)
    entries = []
    for rows, vectors in cells:
        plans: dict[str, list[dict[str, float]]] = {}
        for name in names:
            key = f"{rows}, {vectors}, {name}"
            of_plans = [[run[key] for run in several if key in run] for several in by_plan.values()]
            plans[name] = [_means(several) for several in of_plans if several]
        areas = np.array([[plan["area"] for plan in plans[name]] for name in names]).T
        drawn = bootstrap_means(areas)
        over = drawn - drawn[:, [names.index("cosine")]]
        for k, name in enumerate(names):
            entry = {"rows": rows, "vectors": vectors, "measure": name, "plans": len(areas), **_means(plans[name])}
            entry["area_low"], entry["area_high"] = np.percentile(drawn[:, k], (2.5, 97.5)).tolist()
            entry["over_cosine_low"], entry["over_cosine_high"] = np.percentile(over[:, k], (2.5, 97.5)).tolist()
            entries.append(entry)
    return entries


def run_scores(cache: Cache, settings: RunSettings) -> dict[str, dict[str, float]]:
    """Return the scores of a run by rows, vectors and measure: as explored and driven again; none if no row returns."""
    record = cache.record(settings)
    tests = {EXPLORER: record, AGAIN: drive_again(record, settings, 2, noise=settings.noise, seed=settings.seed)}
    result = {}
    for (rows, test), vectors, name in itertools.product(tests.items(), VECTORS, MEASURES):
        answers, _ = ask(test, name, vectors, same_direction=True)
        if answers.revisits:
            result[f"{rows}, {vectors}, {name}"] = scores(*answers_curve(answers)[1:])
    return result


def _means(several: Sequence[dict[str, float]]) -> dict[str, float]:
    return {key: float(np.mean([one[key] for one in several])) for key in several[0]}


# Runs in tables.


def outcome(records: Sequence[RunRecord]) -> dict[str, float]:
    """Return means over runs, with Student's 95 % intervals of the two that lead; NaN where there is none."""
    values = {
        "cycles": [r.metrics["cycles_closed"] for r in records],
        "cycles_share": [r.metrics["cycles_closed"] / max(r.metrics["cycles_total"], 1) for r in records],
        "false_claims": [r.metrics["false_claims"] for r in records],
        "return": [r.metrics["return"] for r in records],
        "coverage": [r.metrics["coverage"] for r in records],
        "path_m": [r.metrics["path_length_m"] for r in records],
        "areas": [r.metrics["areas"] for r in records],
        "success": [r.metrics["is_success"] for r in records],
        "dead_reckoning_rms_m": [r.metrics["dead_reckoning_rms_m"] for r in records],
        "track_rms_m": [r.metrics["track_rms_m"] for r in records],
    }
    result = {name: float(np.mean(column)) for name, column in values.items()}
    recognised = sum(r.metrics["revisits_recognised"] for r in records)
    wrong, settled = (sum(r.metrics[name] for r in records) for name in ("false_claims", "revisits"))
    result["precision"] = recognised / (recognised + wrong) if recognised + wrong else math.nan
    result["recall"] = recognised / settled if settled else math.nan
    for name, most in (("cycles_share", 1.0), ("false_claims", math.inf)):
        low, high = mean_interval(np.array(values[name], float))
        result[f"{name}_low"], result[f"{name}_high"] = max(low, 0.0), min(high, most)  # a NaN stays
    result["cycles_total"] = float(np.mean([r.metrics["cycles_total"] for r in records]))
    return result

"""The experiments of the report: which runs each needs, and the tables that come of them."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from cyclic_env import map_names
from cyclic_env.evaluation.statistics import mean_interval, paired_difference
from scripts.paper.recognition import of_plan
from scripts.paper.runs import RunRecord, RunSettings
from scripts.paper.store import Store

BUILDING = "killian_court"
"""The paper's building."""
EXPLORERS: Mapping[str, Mapping[str, Any]] = {
    "position": {"changes": {"detector": "position"}},
    "appearance": {"changes": {"detector": "knn"}},
    "both": {},
    "extended": {"preset": "extended"},
}
"""The settings of a run for each way of recognising a place."""
VARIATIONS: Mapping[str, Mapping[str, Mapping[str, Any]]] = {
    "openings gone to": {
        "all that are listed": {},
        "only those without a wall in range": {"changes": {"unbounded_only": True}},
    },
    "rows that ask": {
        "the first 5 of a group": {"changes": {"asked_rows": 5}},
        "every row": {"changes": {"asked_rows": None}},
    },
    "a visited place": {
        "is joined to the known one": {},
        "is not joined": {"changes": {"join": False}},
    },
    "order of the list": {
        name: {"changes": {"order": name}} for name in ("first in first out", "last in first out", "nearest")
    },
    "range of the laser": {f"{reach:g} m": {"range_max": reach} for reach in (6.0, 12.0, 20.0)},
}
"""Choices that the paper leaves open and that decide how a run goes, as settings of the preset `paper`."""


SHARES = ("success", "coverage", "cycles_share", "found", "average_precision", "recall_at_99_precision")
"""Metrics from 0 to 1."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Scope:
    """How much is run."""

    starts: int = 10
    """Number of random starts, each with its own seed of the noise, of each explorer in the paper's building."""
    maps: tuple[str, ...] = tuple(map_names())
    building: str = BUILDING
    variations: int = 0
    """Number of starts of each variation; 0 leaves the variations out."""
    noise_scales: tuple[float, ...] = ()
    """Factors on the noise of `poor` for the sweep; without any, the sweep is left out."""
    laps: int = 7
    repeats: int = 60
    """Number of batches of each timing."""


PAPER = Scope()
QUICK = Scope(starts=5, maps=("ring", "figure_eight", "twin_rings", "grid"), laps=3, repeats=20)
PAPER_ALL = Scope(variations=5, noise_scales=(0.0, 0.125, 0.25, 0.5, 0.75, 1.0))


def headline_runs(scope: Scope) -> dict[tuple[str, str], list[RunSettings]]:
    """Return the runs of all explorers in the paper's building, by explorer and noise; all have the same starts."""
    return {
        (explorer, noise): [
            RunSettings(map=scope.building, noise=noise, random_start=True, seed=seed, **settings)
            for seed in range(scope.starts)
        ]
        for noise in ("ideal", "calibrated")
        for explorer, settings in EXPLORERS.items()
    }


def plan_runs(scope: Scope) -> list[RunSettings]:
    """Return the runs of the preset `paper` on all plans, from their own starts, with ideal sensors."""
    return [RunSettings(map=name) for name in scope.maps]


def explored_runs(scope: Scope) -> dict[str, list[RunSettings]]:
    """Return the runs of the extended explorer, by noise, whose paths are driven again to test recognition."""
    return {
        noise: [RunSettings(map=name, preset="extended", noise=noise) for name in scope.maps]
        for noise in ("ideal", "calibrated")
    }


def varied_runs(scope: Scope) -> dict[tuple[str, str], list[RunSettings]]:
    """Return the runs of the variations, by reading and choice; each has several starts."""
    return {
        (reading, choice): [
            RunSettings(map=scope.building, random_start=True, seed=seed, **settings)
            for seed in range(scope.variations)
        ]
        for reading, choices in VARIATIONS.items()
        for choice, settings in choices.items()
    }


def noise_runs(scope: Scope) -> dict[tuple[str, float], list[RunSettings]]:
    """Return the runs of the sweep of noise, by explorer and scale; there is one for each plan that has cycles."""
    return {
        (explorer, scale): [
            RunSettings(map=name, noise="poor", noise_scale=scale, **settings)
            for name in scope.maps
            if name != "dead_ends"
        ]
        for explorer, settings in EXPLORERS.items()
        for scale in scope.noise_scales
    }


def all_runs(scope: Scope) -> list[RunSettings]:
    """Return all runs of a report, without repetitions."""
    groups = [*headline_runs(scope).values(), plan_runs(scope), *explored_runs(scope).values()]
    groups += [*varied_runs(scope).values(), *noise_runs(scope).values()]
    return list({repr(run): run for run in itertools.chain(*groups)}.values())


def score(record: RunRecord) -> dict[str, Any]:
    """Return the scores of a run that the tables show."""
    m = record.metrics
    states = m["area_states"]
    return {
        "map": record.settings.map,
        "seed": record.settings.seed,
        "cycles_closed": m["cycles_closed"],
        "cycles_total": m["cycles_total"],
        "cycles_share": m["cycles_closed"] / max(m["cycles_total"], 1),
        "false_claims": m["false_claims"],
        "claims": m["claims"],
        "revisits": m["revisits"],
        "revisits_recognised": m["revisits_recognised"],
        "success": float(m["is_success"]),
        "coverage": m["coverage"],
        "path_m": m["path_length_m"],
        "path_over_tour": m["path_length_m"] / m["tour_m"],
        "areas": len(states),
        "areas_open": states.count("open"),
        "ending": m["ending"],
        "dead_reckoning_ate_m": m["dead_reckoning_ate_m"],
    }


def table(store: Store, runs: Mapping[Any, Sequence[RunSettings]], names: Sequence[str]) -> pd.DataFrame:
    """Return a table with a row for each run: the parts of its key under the given names, and its scores."""
    return pd.DataFrame(
        {**dict(zip(names, key if isinstance(key, tuple) else (key,), strict=True)), **score(store.record(run))}
        for key, several in runs.items()
        for run in several
    )


def differences(headline: pd.DataFrame) -> pd.DataFrame:
    """Return the differences of `both` from `position` and `appearance` with calibrated sensors, paired by start."""
    runs = headline[headline.noise == "calibrated"].set_index(["explorer", "seed"]).sort_index()
    rows = []
    for other, metric in itertools.product(("position", "appearance"), ("cycles_closed", "false_claims", "coverage")):
        both, others = (runs.loc[name, metric].to_numpy(float) for name in ("both", other))
        rows.append({"against": other, "metric": metric, "n": len(both), **paired_difference(both, others)._asdict()})
    return pd.DataFrame(rows)


def recognition(store: Store, scope: Scope) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return the shares of rows and of groups' centres that are found, for each plan and way of searching."""
    shares, centres = [], []
    for noise, runs in explored_runs(scope).items():
        for run in runs:
            found, middle = store.result(of_plan, store.record(run))
            shares.append(found.assign(map=run.map, noise=noise))
            centres.append({"map": run.map, "noise": noise, **middle})
    return pd.concat(shares, ignore_index=True), pd.DataFrame(centres)


def intervals(frame: pd.DataFrame, by: Sequence[str], metric: str) -> pd.DataFrame:
    """Return mean, 95 % interval of the mean, and n of a metric in each group of rows.

    No interval is given of fewer than 5 rows. It ends at 0, below which no count, length or share lies, and that of a
    share at 1, that of the closed cycles at all of them.
    """
    most = frame.cycles_total.max() if metric == "cycles_closed" else 1.0 if metric in SHARES else np.inf

    def entry(values: pd.Series) -> pd.Series:
        numbers = values.to_numpy(float)
        low, high = np.clip(mean_interval(numbers), 0.0, most) if len(numbers) >= 5 else (np.nan, np.nan)
        return pd.Series({"mean": numbers.mean(), "low": low, "high": high, "n": len(numbers)})

    return pd.DataFrame(frame.groupby(list(by), sort=False)[metric].apply(entry).unstack())

"""Settings of the explorer, and its two presets."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from functools import lru_cache
from numbers import Real
from pathlib import Path
from typing import Any, Literal

import numpy as np

from agents.knn.similarity import MEASURES, measure_by_name
from cyclic_env.errors import ConfigError
from cyclic_env.validation import check_choice, is_integer, short_repr

DETECTORS = ("both", "knn", "position")
ORDERS = ("nearest", "first in first out", "last in first out")
MOST = 1000
"""Of whole numbers, and of metres."""
THRESHOLDS = Path(__file__).with_name("thresholds.json")
"""Written by ``scripts/calibrate_thresholds.py``."""


@lru_cache(maxsize=1)
def calibrated_thresholds() -> dict[str, float]:
    """Return for each measure the similarity from which a place counts as visited, as calibrated on training plans.

    Raises
    ------
    ConfigError
        If their file is missing or damaged.
    """
    try:
        measures = json.loads(THRESHOLDS.read_text(encoding="utf-8"))["measures"]
        return {name: float(measures[name]["threshold"]) for name in MEASURES}
    except (OSError, ValueError, LookupError, TypeError) as error:
        hint = "make it anew with scripts/calibrate_thresholds.py"
        raise ConfigError(f"{THRESHOLDS}: no file of thresholds for all measures; {hint}.") from error


@dataclass(frozen=True, slots=True, kw_only=True)
class ExplorerConfig:
    """How the explorer maps, recognises and goes on; `preset` makes them by name.

    Parameters
    ----------
    detector : {"both", "knn", "position"}
        What a visited place is told by: its looks (the KNN vote) among the places near, its looks alone, or its
        position alone.
    measure : str
        Similarity of two places' properties; see `agents.knn.similarity.MEASURES`.
    neighbours : int
        K: rows that vote.
    threshold : float, optional
        Similarity above which a place counts as visited, where no scans are matched; None: as calibrated for the
        measure, see `calibrated_thresholds`.
    sectors : int
        Numbers that a place's properties are, looking ahead.
    rounding : float
        Metres that these are whole multiples of.
    row_spacing : float
        Metres between rows.
    both_directions : bool
        Compare with tables of the opposite direction too, looking back.
    match_scans : bool
        Hold the track straight by matching scans, confirm what the vote finds by matching, and mend the track by it.
    unbounded_only : bool
        List only openings with no wall within the laser's reach.
    go_on : bool
        Go on along the corridor until the place is known or the corridor ends, and only then to the list.
    order : {"nearest", "first in first out", "last in first out"}
        In which open areas are gone to.
    range_max : float
        Reach of the laser, metres: that of the environment.

    Raises
    ------
    ConfigError
        If a value is out of its range or unknown; the message says what is expected.
    """

    detector: Literal["both", "knn", "position"] = "both"
    measure: str = "cosine"
    neighbours: int = 4
    threshold: float | None = None
    sectors: int = 7
    rounding: float = 0.5
    row_spacing: float = 1.0
    both_directions: bool = True
    match_scans: bool = True
    unbounded_only: bool = False
    go_on: bool = False
    order: Literal["nearest", "first in first out", "last in first out"] = "nearest"
    range_max: float = 12.0

    def __post_init__(self) -> None:
        check_choice("detector", self.detector, DETECTORS)
        check_choice("order", self.order, ORDERS)
        measure_by_name(self.measure)
        for name, least in (("neighbours", 1), ("sectors", 2)):
            value = getattr(self, name)
            if not is_integer(value) or not least <= value <= MOST:
                raise ConfigError(f"{name} is {short_repr(value)}; expected a whole number from {least} to {MOST}.")
        for name in ("both_directions", "match_scans", "unbounded_only", "go_on"):
            value = getattr(self, name)
            if not isinstance(value, bool | np.bool_):
                raise ConfigError(f"{name} is {short_repr(value)}; expected True or False.")
        for name in ("rounding", "row_spacing", "range_max"):
            value = getattr(self, name)
            if not isinstance(value, Real) or not 0 < float(value) < MOST:
                raise ConfigError(f"{name} is {short_repr(value)}; expected metres above 0.")
        if self.threshold is not None and not (isinstance(self.threshold, Real) and -1 <= float(self.threshold) <= 1):
            raise ConfigError(f"threshold is {short_repr(self.threshold)}; expected a similarity, at most 1, or None.")

    @property
    def least_similarity(self) -> float:
        """The threshold, or the calibrated one of the measure."""
        return calibrated_thresholds()[self.measure] if self.threshold is None else self.threshold


PRESETS: dict[str, ExplorerConfig] = {
    "paper": ExplorerConfig(
        detector="knn",
        both_directions=False,
        match_scans=False,
        unbounded_only=True,
        go_on=True,
        order="first in first out",
    ),
    "extended": ExplorerConfig(),
}
"""The paper's algorithm as we read it, and with our extensions."""


def preset(name: str, **changes: Any) -> ExplorerConfig:
    """Return the preset of that name, with changes.

    Raises
    ------
    ConfigError
        If there is no such preset or setting; the message lists them and the nearest.
    """
    for change in changes:
        check_choice("setting", change, ExplorerConfig.__dataclass_fields__)
    return replace(PRESETS[check_choice("preset", name, PRESETS)], **changes)

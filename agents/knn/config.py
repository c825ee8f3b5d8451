"""Settings of the explorer, with those of all its components, and its two presets."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

from agents.component_config import ComponentConfig
from agents.exploration.building_map import BuildingMapConfig
from agents.exploration.costmap import CostmapConfig
from agents.exploration.frontiers import FrontierConfig
from agents.exploration.planner import PlannerConfig
from agents.exploration.survey import SurveyConfig
from agents.exploration.visibility import VisibilityConfig
from agents.knn.similarity import MEASURES, measure_by_name
from agents.slam.keyframes import KeyframeConfig
from agents.slam.loop_closer import BY_APPEARANCE, NEVER
from agents.slam.mapper import MapperConfig
from agents.slam.scan_filters import FilterConfig
from cyclic_env.config import LaserConfig, RobotConfig
from cyclic_env.errors import ConfigError
from cyclic_env.validation import check_bool, check_choice, check_integer, check_number

DETECTORS = ("both", "knn", "position")
ORDERS = ("nearest", "first in first out", "last in first out")
MOST = 1000
"""Of whole numbers, metres and seconds."""
THRESHOLDS = Path(__file__).with_name("thresholds.json")
"""Written by ``scripts/calibrate_thresholds.py``."""


@lru_cache
def calibrated_thresholds(detector: str = "both") -> dict[str, float]:
    """Return for each measure the similarity above which a place counts as visited, as calibrated on training plans.

    Parameters
    ----------
    detector : {"both", "knn"}
        Whether only keyframes near by dead reckoning are compared, or all of them.

    Raises
    ------
    ConfigError
        If their file is missing or damaged.
    """
    try:
        measures = json.loads(THRESHOLDS.read_text(encoding="utf-8"))["detectors"][detector]
        return {name: float(measures[name]["threshold"]) for name in MEASURES}
    except (OSError, ValueError, LookupError, TypeError) as error:
        hint = "make it with scripts/calibrate_thresholds.py"
        raise ConfigError(f"{THRESHOLDS}: not a file of thresholds for all measures; {hint}.") from error


@dataclass(frozen=True, slots=True, kw_only=True)
class DetectorConfig(ComponentConfig):
    """When a place counts as visited by dead reckoning; lengths in metres."""

    gap: float = 20.1
    """Metres driven since a keyframe before the robot can be back at it: as a revisit is defined, and a bit more."""
    leave: float = 10.1
    """Metres that it must have been away in between: as a revisit is defined, and a bit more."""
    position_radius: float = 2.0
    """Distance from a keyframe by dead reckoning at which the robot is back there."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ObserverConfig(ComponentConfig):
    """Keeping of scans, and trust in the sensors; lengths in metres, times in seconds."""

    scans_kept: int = 5
    """Scans kept as they were measured: openings are verified by them when their keyframe is the middle one."""
    arrival_spacing: float = 0.1
    """Distance from the last keyframe at which one is added where the robot has arrived at its goal."""
    look_again: float = 3.0
    """Time after which the goal is thought over, if there was no new keyframe."""
    look_speed: float = 0.15
    """Share of the full turning rate with which a laser that doesn't see all around looks there at the beginning."""
    advance_max: float = 2.0
    """What no robot drives in a step: a distance meter that shows more is out of order."""
    compass_min: float = 0.5
    """Least length of the compass's unit vector; a compass that shows less is out of order."""
    distrust: float = 20.0
    """Time for which nothing is claimed after a sensor was out of order."""
    in_sight_rows: int = 3
    """Keyframes back to which an opening counts as being in sight."""
    ahead: float = math.radians(120)
    """Bearing up to which an opening continues the corridor."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ExplorerConfig:
    """How the explorer maps, recognizes places and goes on; `preset` makes these by name.

    Parameters
    ----------
    detector : {"both", "knn", "position"}
        What tells a visited place: its appearance among the places near, its appearance alone, or its position alone.
        Appearance is the KNN vote or, with `match_scans`, that of the map's panoramas.
    measure : str
        Similarity of two keyframes' features in the vote; see `agents.knn.similarity.MEASURES`.
    neighbours : int
        K: the keyframes that vote.
    threshold : float, optional
        Similarity above which a place counts as visited, where no scans are matched; None: as calibrated for the
        measure, see `calibrated_thresholds`.
    sectors : int
        Length of a keyframe's feature vector, looking ahead.
    rounding : float
        Metres that the features are whole multiples of.
    row_spacing : float
        Metres between keyframes, the rows of the paper's tables.
    match_scans : bool
        Make a map of matched scans, which corrects the track, finds the places that are known, and closes loops.
    unbounded_only : bool
        Go only to openings with no wall within the laser's reach.
    go_on : bool
        Go on along the corridor until the place is known or the corridor ends, and only then to the list.
    order : {"nearest", "first in first out", "last in first out"}
        In which open areas are gone to.
    join : bool
        Connect a visited place to the known one.
    look_again : bool
        When no opening is left and the episode goes on, look again where the robot has hardly looked, try what was
        given up, and drive the laps that it has only seen; if not, stop.
    asked_rows : int, optional
        Keyframes of each group, from its beginning, that are compared with earlier tables; None: all.
    range_max : float
        Reach of the laser, metres.
    field_of_view, mounting_angle : float
        Of the laser, radians; see `LaserConfig`.
    dt : float
        Length of a step, seconds.
    filters, keyframes, mapper, loops, visibility, frontiers, costmap, planner, survey, building, observer
        The components' own settings.

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
    match_scans: bool = True
    unbounded_only: bool = False
    go_on: bool = False
    order: Literal["nearest", "first in first out", "last in first out"] = "nearest"
    join: bool = True
    look_again: bool = True
    asked_rows: int | None = None
    range_max: float = 12.0
    field_of_view: float = math.tau
    mounting_angle: float = 0.0
    dt: float = 0.2
    filters: FilterConfig = field(default_factory=FilterConfig)
    keyframes: KeyframeConfig = field(default_factory=KeyframeConfig)
    mapper: MapperConfig = field(default_factory=MapperConfig)
    loops: DetectorConfig = field(default_factory=DetectorConfig)
    visibility: VisibilityConfig = field(default_factory=VisibilityConfig)
    frontiers: FrontierConfig = field(default_factory=FrontierConfig)
    costmap: CostmapConfig = field(default_factory=CostmapConfig)
    planner: PlannerConfig = field(default_factory=PlannerConfig)
    survey: SurveyConfig = field(default_factory=SurveyConfig)
    building: BuildingMapConfig = field(default_factory=BuildingMapConfig)
    observer: ObserverConfig = field(default_factory=ObserverConfig)

    def __post_init__(self) -> None:
        check_choice("detector", self.detector, DETECTORS)
        check_choice("order", self.order, ORDERS)
        measure_by_name(self.measure)
        check_integer(self, "neighbours", 1, MOST)
        check_integer(self, "sectors", 2, MOST)
        for name in ("match_scans", "unbounded_only", "go_on", "join", "look_again"):
            check_bool(self, name)
        for name in ("rounding", "row_spacing", "range_max", "dt"):
            check_number(self, name, 0.0, MOST, open_low=True)
        if self.asked_rows is not None:
            check_integer(self, "asked_rows", 1, MOST)
        if self.threshold is not None:
            check_number(self, "threshold", -1.0, 1.0)

    @property
    def least_similarity(self) -> float:
        """The threshold, or the calibrated one of the measure."""
        if self.threshold is not None:
            return self.threshold
        return calibrated_thresholds("knn" if self.detector == "knn" else "both")[self.measure]

    @property
    def mapper_settings(self) -> MapperConfig:
        """The mapper's settings, with loops closed as the detector says."""
        loops = {"both": self.mapper.loops, "knn": replace(self.mapper.loops, **BY_APPEARANCE)}
        return replace(self.mapper, loops=loops.get(self.detector, replace(self.mapper.loops, **NEVER)))

    def laser(self, beams: int) -> LaserConfig:
        """Return the laser with that number of beams."""
        return LaserConfig(
            num_beams=beams,
            range_max=self.range_max,
            field_of_view=self.field_of_view,
            mounting_angle=self.mounting_angle,
        )

    def fitted(self, laser: LaserConfig, robot: RobotConfig) -> ExplorerConfig:
        """Return these settings for another laser and robot: its reach, radius, speed and step.

        What keeps off walls keeps off by as much more as the robot is larger, and a slow robot is waited for longer.
        """
        usual = RobotConfig()
        larger, slower = robot.radius - usual.radius, max(1.0, usual.wheel_speed_max / robot.wheel_speed_max)
        planner, visibility, costmap = self.planner, self.visibility, self.costmap
        return replace(
            self,
            range_max=laser.range_max,
            field_of_view=laser.field_of_view,
            mounting_angle=laser.mounting_angle,
            dt=robot.dt,
            visibility=replace(visibility, wall_clearance=visibility.wall_clearance + larger),
            costmap=replace(costmap, clearance=costmap.clearance + larger),
            planner=replace(
                planner,
                half_width=planner.half_width + larger,
                stop_at=planner.stop_at + larger,
                patience=slower * planner.patience,
                hesitation=slower * planner.hesitation,
            ),
            observer=replace(self.observer, advance_max=max(self.observer.advance_max, 2 * robot.advance_max)),
        )

    def squeezed(self) -> ExplorerConfig:
        """Return these settings for passages that are hardly wider than the robot: finer, and closer to walls."""
        visibility, costmap, planner = self.visibility, self.costmap, self.planner
        closer = self.survey.squeeze
        return replace(
            self,
            visibility=replace(visibility, wall_clearance=visibility.wall_clearance - closer),
            costmap=replace(
                costmap,
                cell=costmap.cell / 2,
                cells=2 * costmap.cells,
                escape_cells=2 * costmap.escape_cells,
                clearance=costmap.clearance - closer,
            ),
            planner=replace(planner, half_width=planner.half_width - closer),
        )


PRESETS: dict[str, ExplorerConfig] = {
    "paper": ExplorerConfig(
        match_scans=False,
        go_on=True,
        order="first in first out",
        look_again=False,
        asked_rows=5,
        loops=DetectorConfig(position_radius=2.5),
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

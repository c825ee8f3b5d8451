"""The floor plans that come with the package, and floor plans by name or path."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import overload

from cyclic_env.config import ClosureConfig, RobotConfig
from cyclic_env.errors import FloorPlanError
from cyclic_env.floor_plans.floor_plan import FloorPlan
from cyclic_env.floor_plans.generator.names import building_from_name, is_generated, split_names
from cyclic_env.floor_plans.io import read_floor_plan
from cyclic_env.validation import short_repr, unknown_name

MapName = str | os.PathLike[str] | FloorPlan


@dataclass(frozen=True)
class PlanPool(Sequence[FloorPlan]):
    """The floor plans of a pool; the buildings of a split are generated when they are first needed.

    Attributes
    ----------
    entries : tuple of FloorPlan or str
        The plans, and the names of the buildings that are generated when needed.
    robot_radius, leave_radius : float
        Radius of the robot that the plans are for, and the least extent of a lap that makes a cycle, metres.
    """

    entries: tuple[FloorPlan | str, ...]
    robot_radius: float = RobotConfig().radius
    leave_radius: float = ClosureConfig().leave_radius

    @property
    def names(self) -> list[str]:
        """The names of the plans."""
        return [entry if isinstance(entry, str) else entry.name for entry in self.entries]

    @property
    def loaded(self) -> dict[int, FloorPlan]:
        """The plans that need not be generated, by their index in the pool."""
        return {i: entry for i, entry in enumerate(self.entries) if isinstance(entry, FloorPlan)}

    def __len__(self) -> int:
        return len(self.entries)

    @overload
    def __getitem__(self, index: int) -> FloorPlan: ...
    @overload
    def __getitem__(self, index: slice) -> PlanPool: ...
    def __getitem__(self, index: int | slice) -> FloorPlan | PlanPool:
        if isinstance(index, slice):
            return replace(self, entries=self.entries[index])
        return plan_for_robot(load_floor_plan(self.entries[index]), self.robot_radius, self.leave_radius)

    def for_robot(self, robot_radius: float, leave_radius: float) -> PlanPool:
        """Return the pool of the same plans for a robot; see `plan_for_robot`."""
        entries = (e if isinstance(e, str) else plan_for_robot(e, robot_radius, leave_radius) for e in self.entries)
        return PlanPool(tuple(entries), robot_radius, leave_radius)


def maps_folder() -> Path:
    """Return the folder of the shipped plans, which is in the installed package, or next to it in a checkout."""
    package = Path(__file__).resolve().parents[1]
    for folder in (package / "maps", package.parent / "maps"):
        if (folder / "killian_court.yaml").is_file():
            return folder
    raise FloorPlanError(
        f"the shipped maps are missing: neither {package / 'maps'} nor {package.parent / 'maps'} has them."
    )


def map_names() -> list[str]:
    """Return the names of the shipped plans, sorted."""
    return sorted(path.stem for path in maps_folder().glob("*.yaml"))


@lru_cache(maxsize=64)
def _shipped(name: str) -> FloorPlan:
    return read_floor_plan(maps_folder() / f"{name}.yaml")


@lru_cache(maxsize=1024)
def plan_for_robot(plan: FloorPlan, robot_radius: float, leave_radius: float) -> FloorPlan:
    """Return a plan with the cycles that a robot can close; a plan read from a map is traced again for the robot.

    Parameters
    ----------
    plan : FloorPlan
    robot_radius, leave_radius : float
        Radius of the robot, and the least extent of a lap, metres.
    """
    if plan.traced and plan.robot_radius != robot_radius:
        plan = read_floor_plan(plan.file, robot_radius)
    if (plan.robot_radius, plan.leave_radius) == (robot_radius, leave_radius):
        return plan
    return replace(plan, robot_radius=robot_radius, leave_radius=leave_radius)


def load_floor_plan(map_name: MapName, robot_radius: float = RobotConfig().radius) -> FloorPlan:
    """Return the floor plan with a name (shipped or generated) or in a YAML file; a plan is returned as it is.

    Parameters
    ----------
    map_name : str, path or FloorPlan
    robot_radius : float
        Radius of the robot that a map of ``map_server`` is traced for, metres.

    Raises
    ------
    FloorPlanError
        If the name is unknown (the message names the nearest), the file is missing or malformed, or the building is
        impossible.
    """
    if isinstance(map_name, FloorPlan):
        return map_name
    if not isinstance(map_name, str | os.PathLike):
        raise FloorPlanError(f"a map is a name, a path or a FloorPlan; got {type(map_name).__name__}.")
    text = os.fsdecode(map_name)
    if is_generated(text):
        return building_from_name(text)
    names = map_names()
    if text in names:
        return _shipped(text)
    path = os.path.expanduser(text)
    if os.path.isfile(path):
        return read_floor_plan(path, robot_radius)
    if os.path.isdir(path):
        raise FloorPlanError(f"{text!r} is a folder, not a floor plan file; name a YAML file in it.")
    if Path(text).suffix or os.sep in text:
        raise FloorPlanError(
            f"there is no floor plan file {text!r}; give a path that exists or one of: {', '.join(names)}."
        )
    raise FloorPlanError(f"{unknown_name('map', text, names)} Or name a file, or a building such as generated:seed=7.")


def load_floor_plans(
    map_name: MapName | Sequence[MapName],
    robot_radius: float = RobotConfig().radius,
    leave_radius: float = ClosureConfig().leave_radius,
) -> PlanPool:
    """Return the pool of one map or several; the name of a split stands for all of its buildings.

    Parameters
    ----------
    map_name : str, path, FloorPlan, PlanPool, or a sequence of the first three
    robot_radius, leave_radius : float
        Radius of the robot that the plans are for, and the least extent of a lap that makes a cycle, metres.

    Raises
    ------
    FloorPlanError
        If the pool is empty, or a plan can't be loaded.
    """
    if isinstance(map_name, PlanPool):
        return map_name.for_robot(robot_radius, leave_radius)
    if isinstance(map_name, str | os.PathLike | FloorPlan):
        map_name = [map_name]
    if not isinstance(map_name, Sequence) or isinstance(map_name, bytes) or not map_name:
        raise FloorPlanError(
            f"a map is a name, a path, a FloorPlan, or a list of these that is not empty; got {short_repr(map_name)}."
        )
    entries: list[FloorPlan | str] = []
    for name in map_name:
        buildings = split_names(name) if isinstance(name, str) else []
        entries.extend(buildings or [load_floor_plan(name, robot_radius)])
    return PlanPool(tuple(entries)).for_robot(robot_radius, leave_radius)


def separate_names(text: str) -> list[str]:
    """Split a text at the commas between the names of maps, but not at those inside the name of a building."""
    return re.split(r",(?!\w+=)", text)

"""Reading and writing floor plans as YAML; the format is described in ``maps/README.md``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from cyclic_env.atomic_write import write_text_atomically
from cyclic_env.config import RobotConfig
from cyclic_env.errors import FloorPlanError
from cyclic_env.floor_plans.floor_plan import FloorPlan, polygon_from_corridors, polygon_from_rings
from cyclic_env.floor_plans.occupancy.map_server import IMAGE_SUFFIXES, occupancy_grid_from_mapping
from cyclic_env.floor_plans.occupancy.tracing import trace_floor_plan
from cyclic_env.floor_plans.strict_yaml import (
    as_list,
    as_number,
    as_start,
    as_text,
    dump_yaml,
    name_of,
    parse_yaml,
    read_yaml,
)
from cyclic_env.validation import short_repr, unknown_name

KEYS = ("name", "title", "source", "licence", "start", "exterior", "holes", "corridors", "rooms", "centrelines")


def read_floor_plan(path: str | Path, robot_radius: float = RobotConfig().radius) -> FloorPlan:
    """Read a floor plan from a YAML file: a plan, or a map of ROS' ``map_server``, which has a key ``image``.

    Parameters
    ----------
    path : path
    robot_radius : float
        Radius of the robot that a map is traced for, metres; `trace_floor_plan`'s other defaults apply.

    Raises
    ------
    FloorPlanError
        Naming the file and the key, if the file can't be read or does not follow the format.
    """
    path = Path(path)
    if path.suffix.lower() in IMAGE_SUFFIXES:
        raise FloorPlanError(
            f"{path}: a picture does not say how large a pixel is; name a YAML file with the keys image, resolution "
            "and origin, or run scripts/import_map.py on the picture."
        )
    data = read_yaml(path)
    try:
        traced = isinstance(data, Mapping) and "image" in data
        if traced:
            plan = trace_floor_plan(occupancy_grid_from_mapping(data, path), robot_radius=robot_radius).plan
        else:
            if isinstance(data, Mapping) and "resolution" in data:
                raise FloorPlanError("image: is missing; a map has the keys image, resolution and origin.")
            plan = floor_plan_from_mapping(data, default_name=name_of(path))
        return replace(plan, file=str(path), traced=traced, robot_radius=robot_radius)
    except FloorPlanError as error:
        raise FloorPlanError(f"{path}: {error}") from error


def floor_plan_from_text(text: str) -> FloorPlan:
    """Return the floor plan that a text in the YAML format describes.

    Raises
    ------
    FloorPlanError
        Naming the key, if the text does not follow the format.
    """
    return floor_plan_from_mapping(parse_yaml(text))


def write_floor_plan(plan: FloorPlan, path: str | Path) -> None:
    """Write a floor plan as YAML rings, rounded to the micrometre.

    Raises
    ------
    FloorPlanError
        If the file can't be written.
    """
    try:
        write_text_atomically(path, floor_plan_to_text(plan, digits=6))
    except OSError as error:
        raise FloorPlanError(f"{path}: can't be written: {error.strerror or error}.") from error


def floor_plan_to_text(plan: FloorPlan, *, digits: int | None = None) -> str:
    """Return a floor plan as YAML rings, rounded to `digits` decimals, or exact with None."""
    rings = plan.rings if digits is None else [np.round(ring, digits) for ring in plan.rings]
    exterior, *holes = (ring.tolist() for ring in rings)
    texts = {key: str(getattr(plan, key)) for key in ("name", "title", "source", "licence")}
    data = {
        **texts,
        "start": dict(zip(("x", "y", "heading"), plan.start, strict=True)),
        "exterior": exterior,
        "holes": holes,
        "centrelines": [np.asarray(line, dtype=float).tolist() for line in plan.centrelines],
    }
    # PyYAML reads unescaped line separators of Unicode as blanks.
    readable = all(text.isprintable() for text in texts.values())
    return dump_yaml(data, allow_unicode=readable)


def floor_plan_from_mapping(data: Any, default_name: str = "unnamed") -> FloorPlan:
    """Return the floor plan that a mapping of the YAML format describes.

    Raises
    ------
    FloorPlanError
        Naming the key that is missing, unknown or malformed.
    """
    if not isinstance(data, Mapping):
        got = "an empty file" if data is None else type(data).__name__
        raise FloorPlanError(f"a floor plan is a mapping with some of the keys {', '.join(KEYS)}; got {got}.")
    for key in data:
        if key not in KEYS:
            raise FloorPlanError(unknown_name("key", key, KEYS))
    if ("exterior" in data) == ("corridors" in data):
        raise FloorPlanError(
            "give the free space either as `exterior` (with `holes`) or as `corridors` (with `rooms`)."
        )
    if "exterior" in data:
        if "rooms" in data:
            raise FloorPlanError("`rooms` go with `corridors`; a plan of rings has `exterior` and `holes`.")
        holes = [_points(hole, f"holes[{i}]") for i, hole in enumerate(as_list(data.get("holes", []), "holes"))]
        polygon = polygon_from_rings(_points(data["exterior"], "exterior"), holes)
    else:
        if "holes" in data:
            raise FloorPlanError("`holes` go with `exterior`; a plan of corridors has `corridors` and `rooms`.")
        corridors = [
            _corridor(item, f"corridors[{i}]") for i, item in enumerate(as_list(data["corridors"], "corridors"))
        ]
        if not corridors:
            raise FloorPlanError("corridors: the list is empty.")
        rooms = [_points(room, f"rooms[{i}]") for i, room in enumerate(as_list(data.get("rooms", []), "rooms"))]
        polygon = polygon_from_corridors(corridors, rooms)
    lines = data.get("centrelines", [corridor["line"] for corridor in data.get("corridors", [])])
    lines = list(lines.values()) if isinstance(lines, Mapping) else as_list(lines, "centrelines")
    centrelines = [tuple(_points(line, f"centrelines[{i}]")) for i, line in enumerate(lines)]
    for i, line in enumerate(centrelines):
        if len(line) < 2:
            raise FloorPlanError(f"centrelines[{i}]: a line needs at least 2 points, got {len(line)}.")
    return FloorPlan(
        name=as_text(data, "name") or default_name,
        free_space=polygon,
        start=as_start(data.get("start")),
        title=as_text(data, "title"),
        source=as_text(data, "source"),
        licence=as_text(data, "licence"),
        centrelines=tuple(centrelines),
    )


def _points(value: Any, key: str) -> list[tuple[float, float]]:
    points = []
    for i, point in enumerate(as_list(value, key)):
        if not isinstance(point, list | tuple) or len(point) != 2:
            raise FloorPlanError(f"{key}[{i}]: expected a point [x, y], got {short_repr(point)}.")
        points.append((as_number(point[0], f"{key}[{i}].x"), as_number(point[1], f"{key}[{i}].y")))
    return points


def _corridor(value: Any, key: str) -> tuple[float, list[tuple[float, float]]]:
    if not isinstance(value, Mapping) or set(value) != {"width", "line"}:
        raise FloorPlanError(f"{key}: expected a mapping with the keys width and line, got {short_repr(value)}.")
    width = as_number(value["width"], f"{key}.width")
    if width <= 0:
        raise FloorPlanError(f"{key}.width: expected more than 0, got {width:g}.")
    return width, _points(value["line"], f"{key}.line")

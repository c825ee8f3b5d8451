"""Reading and writing floor plans as YAML; the format is described in ``maps/README.md``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from cyclic_env.errors import FloorPlanError, shown, unknown_name
from cyclic_env.floor_plans.floor_plan import COORDINATE_MAX, FloorPlan, polygon_from_corridors, polygon_from_rings

KEYS = ("name", "title", "source", "licence", "start", "exterior", "holes", "corridors", "rooms", "centrelines")


class _Loader(yaml.SafeLoader):
    """The safe loader, but a key given twice is an error and not a silent choice.

    Not its twin in C, which crashes the interpreter on a file that is nested too deeply.
    """

    def construct_mapping(self, node: yaml.Node, deep: bool = False) -> dict[Any, Any]:
        if not isinstance(node, yaml.MappingNode):
            raise yaml.constructor.ConstructorError(None, None, "expected a mapping", node.start_mark)
        keys = [self.construct_object(key, deep=deep) for key, _ in node.value]
        for i, key in enumerate(keys):
            if key in keys[:i]:
                raise yaml.constructor.ConstructorError(None, None, f"key {key!r} stands twice", node.start_mark)
        return super().construct_mapping(node, deep=deep)


def read_floor_plan(path: str | Path) -> FloorPlan:
    """Read a floor plan from a YAML file.

    Raises
    ------
    FloorPlanError
        Naming the file and the key, if the file can't be read or does not follow the format.
    """
    path = Path(path)
    try:
        plan = floor_plan_from_text(path.read_text(encoding="utf-8"), default_name=path.stem)
    except OSError as error:
        raise FloorPlanError(f"{path}: can't be read: {error.strerror or error}.") from error
    except UnicodeDecodeError as error:
        raise FloorPlanError(f"{path}: is not valid YAML: {error}.") from error
    except FloorPlanError as error:
        raise FloorPlanError(f"{path}: {error}") from error
    return replace(plan, file=str(path))


def floor_plan_from_text(text: str, default_name: str = "unnamed") -> FloorPlan:
    """Return the floor plan that a text in YAML describes.

    Raises
    ------
    FloorPlanError
        Naming the key, if the text does not follow the format.
    """
    try:
        data = yaml.load(text, Loader=_Loader)
    except RecursionError as error:
        raise FloorPlanError("is not valid YAML: it is nested too deeply.") from error
    except (yaml.YAMLError, ValueError, AttributeError) as error:
        # PyYAML passes on what Python says of a bad number or date, such as 2024-13-01.
        reason = " ".join(str(error).split()).replace('in "<unicode string>", line', "at line")
        raise FloorPlanError(f"is not valid YAML: {reason}.") from error
    return floor_plan_from_mapping(data, default_name=default_name)


def write_floor_plan(plan: FloorPlan, path: str | Path) -> None:
    """Write a floor plan as YAML rings, to the micrometre.

    Raises
    ------
    FloorPlanError
        If the file can't be written.
    """
    text = floor_plan_to_text(plan, digits=6)
    try:
        Path(path).write_text(text, encoding="utf-8")
    except OSError as error:
        raise FloorPlanError(f"{path}: can't be written: {error.strerror or error}.") from error


def floor_plan_to_text(plan: FloorPlan, *, digits: int | None = None) -> str:
    """Return a floor plan as YAML rings, rounded to so many decimals; None keeps every bit."""
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
    # Unescaped, PyYAML reads back the rarer line separators of Unicode as blanks.
    readable = all(text.isprintable() for text in texts.values())
    return yaml.safe_dump(data, sort_keys=False, default_flow_style=None, width=120, allow_unicode=readable)


def floor_plan_from_mapping(data: Any, default_name: str = "unnamed") -> FloorPlan:
    """Return the floor plan that a mapping of the YAML format describes.

    Raises
    ------
    FloorPlanError
        Naming the key that is missing, unknown or malformed.
    """
    if not isinstance(data, Mapping):
        got = "nothing" if data is None else type(data).__name__
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
        holes = [_points(hole, f"holes[{i}]") for i, hole in enumerate(_list(data.get("holes", []), "holes"))]
        polygon = polygon_from_rings(_points(data["exterior"], "exterior"), holes)
    else:
        if "holes" in data:
            raise FloorPlanError("`holes` go with `exterior`; a plan of corridors has `corridors` and `rooms`.")
        corridors = [_corridor(item, f"corridors[{i}]") for i, item in enumerate(_list(data["corridors"], "corridors"))]
        if not corridors:
            raise FloorPlanError("corridors: the list is empty.")
        rooms = [_points(room, f"rooms[{i}]") for i, room in enumerate(_list(data.get("rooms", []), "rooms"))]
        polygon = polygon_from_corridors(corridors, rooms)
    lines = data.get("centrelines", [corridor["line"] for corridor in data.get("corridors", [])])
    lines = list(lines.values()) if isinstance(lines, Mapping) else _list(lines, "centrelines")
    centrelines = [tuple(_points(line, f"centrelines[{i}]")) for i, line in enumerate(lines)]
    for i, line in enumerate(centrelines):
        if len(line) < 2:
            raise FloorPlanError(f"centrelines[{i}]: a line needs at least 2 points, got {len(line)}.")
    return FloorPlan(
        name=_text(data, "name") or default_name,
        free_space=polygon,
        start=_start(data.get("start")),
        title=_text(data, "title"),
        source=_text(data, "source"),
        licence=_text(data, "licence"),
        centrelines=tuple(centrelines),
    )


def _list(value: Any, key: str) -> Sequence[Any]:
    if not isinstance(value, list | tuple):
        raise FloorPlanError(f"{key}: expected a list, got {type(value).__name__}.")
    return value


def _number(value: Any, key: str) -> float:
    # The comparison also fails for NaN, and, unlike math.isfinite, takes whole numbers of any length.
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= COORDINATE_MAX:
        raise FloorPlanError(
            f"{key}: expected a number from {-COORDINATE_MAX:g} to {COORDINATE_MAX:g}, got {shown(value)}."
        )
    return float(value)


def _points(value: Any, key: str) -> list[tuple[float, float]]:
    points = []
    for i, point in enumerate(_list(value, key)):
        if not isinstance(point, list | tuple) or len(point) != 2:
            raise FloorPlanError(f"{key}[{i}]: expected a point [x, y], got {shown(point)}.")
        points.append((_number(point[0], f"{key}[{i}].x"), _number(point[1], f"{key}[{i}].y")))
    return points


def _corridor(value: Any, key: str) -> tuple[float, list[tuple[float, float]]]:
    if not isinstance(value, Mapping) or set(value) != {"width", "line"}:
        raise FloorPlanError(f"{key}: expected a mapping with the keys width and line, got {shown(value)}.")
    width = _number(value["width"], f"{key}.width")
    if width <= 0:
        raise FloorPlanError(f"{key}.width: expected more than 0, got {width:g}.")
    return width, _points(value["line"], f"{key}.line")


def _text(data: Mapping[str, Any], key: str) -> str:
    value = data.get(key, "")
    if not isinstance(value, str):
        raise FloorPlanError(f"{key}: expected text, got {shown(value)}.")
    return value


def _start(value: Any) -> tuple[float, float, float]:
    if not isinstance(value, Mapping) or not {"x", "y"} <= set(value) <= {"x", "y", "heading"}:
        raise FloorPlanError(f"start: expected a mapping with x, y and, in radians, heading; got {shown(value)}.")
    return (
        _number(value["x"], "start.x"),
        _number(value["y"], "start.y"),
        _number(value.get("heading", 0.0), "start.heading"),
    )

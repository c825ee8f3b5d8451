"""Reading YAML and the values in it, with a one-line message for each mistake."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from cyclic_env.errors import FloorPlanError
from cyclic_env.floor_plans.floor_plan import COORDINATE_MAX, Pose
from cyclic_env.validation import short_repr


class _Loader(yaml.SafeLoader):
    """The safe loader, with an error for a key that is given twice.

    The loader in C would crash the interpreter on a file that is nested too deeply.
    """

    def construct_mapping(self, node: yaml.Node, deep: bool = False) -> dict[Any, Any]:
        if not isinstance(node, yaml.MappingNode):
            raise yaml.constructor.ConstructorError(None, None, "expected a mapping", node.start_mark)
        keys = [self.construct_object(key, deep=deep) for key, _ in node.value]
        for i, key in enumerate(keys):
            if key in keys[:i]:
                raise yaml.constructor.ConstructorError(None, None, f"key {key!r} is given twice", node.start_mark)
        return super().construct_mapping(node, deep=deep)


class _Dumper(yaml.SafeDumper):
    """The safe dumper, with quotes around text that `_Loader` would read as a number."""


for _kind in (_Loader, _Dumper):  # YAML 1.1 reads 5e-2, which has no point, as text
    _kind.add_implicit_resolver(
        "tag:yaml.org,2002:float", re.compile(r"[-+]?[0-9]+[eE][-+]?[0-9]+\Z"), list("-+0123456789")
    )


def read_yaml(path: Path) -> Any:
    """Return the content of a YAML file.

    Raises
    ------
    FloorPlanError
        Naming the file, if it can't be read or is not YAML.
    """
    try:
        if path.exists() and not path.is_file():
            raise FloorPlanError("is a folder or a device; expected a YAML file.")
        return parse_yaml(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise FloorPlanError(f"{path}: can't be read: {error.strerror or error}.") from error
    except UnicodeDecodeError as error:
        raise FloorPlanError(f"{path}: is not valid YAML: {error}.") from error
    except FloorPlanError as error:
        raise FloorPlanError(f"{path}: {error}") from error


def parse_yaml(text: str) -> Any:
    """Return the content of a text in YAML.

    Raises
    ------
    FloorPlanError
        If it is not YAML.
    """
    try:
        return yaml.load(text, Loader=_Loader)
    except RecursionError as error:
        raise FloorPlanError("is not valid YAML: it is nested too deeply.") from error
    except (yaml.YAMLError, ValueError, AttributeError) as error:
        # PyYAML passes on Python's errors for bad numbers and dates, such as 2024-13-01.
        reason = " ".join(str(error).split()).replace('in "<unicode string>", line', "at line")
        raise FloorPlanError(f"is not valid YAML: {reason}.") from error


def dump_yaml(data: Any, *, allow_unicode: bool = False) -> str:
    """Write data as a text in YAML."""
    return yaml.dump(
        data, Dumper=_Dumper, sort_keys=False, default_flow_style=None, width=120, allow_unicode=allow_unicode
    )


def name_of(path: Path) -> str:
    """Return the name of a file without its suffix; bytes that are not valid text are replaced."""
    return os.fsencode(path.stem).decode(errors="replace")


def as_list(value: Any, key: str) -> Sequence[Any]:
    """Return the value of a key that must be a list."""
    if not isinstance(value, list | tuple):
        raise FloorPlanError(f"{key}: expected a list, got {type(value).__name__}.")
    return value


def as_number(value: Any, key: str) -> float:
    """Return the value of a key that must be a finite number."""
    # The comparison is false for NaN and, unlike math.isfinite, accepts integers of any size.
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= COORDINATE_MAX:
        raise FloorPlanError(
            f"{key}: expected a number from {-COORDINATE_MAX:g} to {COORDINATE_MAX:g}, got {short_repr(value)}."
        )
    return float(value)


def as_text(data: Mapping[str, Any], key: str) -> str:
    """Return the text of an optional key."""
    value = data.get(key, "")
    if not isinstance(value, str):
        raise FloorPlanError(f"{key}: expected text, got {short_repr(value)}.")
    return value


def as_start(value: Any) -> Pose:
    """Return the start pose that a mapping describes; its heading is optional."""
    if not isinstance(value, Mapping) or not {"x", "y"} <= set(value) <= {"x", "y", "heading"}:
        raise FloorPlanError(f"start: expected a mapping with x, y and, in radians, heading; got {short_repr(value)}.")
    return (
        as_number(value["x"], "start.x"),
        as_number(value["y"], "start.y"),
        as_number(value.get("heading", 0.0), "start.heading"),
    )

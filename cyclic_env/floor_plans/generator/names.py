"""The names of generated buildings and of their splits."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import fields
from typing import Any

from cyclic_env.errors import FloorPlanError
from cyclic_env.floor_plans.floor_plan import FloorPlan
from cyclic_env.floor_plans.generator.builder import generate
from cyclic_env.floor_plans.generator.spec import HAND_SEED_MAX, PREFIX, SPLITS, BuildingSpec, split_spec
from cyclic_env.validation import short_repr, unknown_name


def is_generated(name: str) -> bool:
    """Tell whether a map's name is that of a generated building or of a split."""
    return name.partition(":")[0] == PREFIX


def split_names(name: str) -> list[str]:
    """Return the names of all buildings of a split, given its name; an empty list for any other name."""
    split = name.removeprefix(f"{PREFIX}:")
    return [f"{PREFIX}:{split},index={i}" for i in range(SPLITS[split].plans)] if split in SPLITS else []


def pool_label(names: Sequence[str]) -> str:
    """Return the names of a pool's plans, separated by commas; a complete split goes by its own name."""
    label = ",".join(names)
    for split in SPLITS:
        label = label.replace(",".join(split_names(f"{PREFIX}:{split}")), f"{PREFIX}:{split}")
    return label


def building_from_name(name: str) -> FloorPlan:
    """Generate the building with a name ``generated:key=value,...`` or ``generated:SPLIT,index=i``.

    Raises
    ------
    FloorPlanError
        If a key is unknown or given twice, a value is not a number in range, or the values contradict each other.
    """
    try:
        first, *others = name.removeprefix(PREFIX).removeprefix(":").split(",")
        if first in SPLITS:
            return _split_building(first, _values(others, ("index",)).get("index"))
        keys = tuple(field.name for field in fields(BuildingSpec))
        if first and "=" not in first:
            raise FloorPlanError(f"{unknown_name('split', first, SPLITS)} Keys, written key=value: {', '.join(keys)}.")
        values = _values([first, *others] if first else others, keys)
        if values.get("seed", 0) > HAND_SEED_MAX:
            raise FloorPlanError(
                f"seed is {values['seed']}; expected at most {HAND_SEED_MAX}: higher ones belong to the splits."
            )
        return generate(BuildingSpec(**values))
    except FloorPlanError as error:
        raise FloorPlanError(f"map {short_repr(name)}: {error}") from error


def _split_building(split: str, index: int | float | None) -> FloorPlan:
    count = SPLITS[split].plans
    if index is None:
        raise FloorPlanError(
            f"is a pool of {count} plans where one is expected; name one, such as {PREFIX}:{split},index=0."
        )
    if not isinstance(index, int) or index >= count:
        raise FloorPlanError(f"index is {index}; {split} has the plans 0 to {count - 1}.")
    return generate(split_spec(split, index), f"{PREFIX}:{split},index={index}")


def _values(items: Sequence[str], keys: Sequence[str]) -> dict[str, Any]:
    """Return the numbers of ``key=value`` items."""
    values: dict[str, Any] = {}
    for item in items:
        key, equals, text = item.partition("=")
        if key not in keys:
            raise FloorPlanError(unknown_name("key", key, keys))
        if key in values:
            raise FloorPlanError(f"key {key!r} is given twice.")
        if not re.fullmatch(r"[0-9]{1,15}(\.[0-9]{1,15})?", text):
            raise FloorPlanError(
                f"{item!r} has no plain number, such as {key}=2." if equals else f"{key} has no value."
            )
        values[key] = float(text) if "." in text else int(text)
    return values


def building_spec(name: str) -> BuildingSpec | None:
    """Return the specification of the building with that name; None if it is not the name of a generated one."""
    if not is_generated(name):
        return None
    first, *others = name.removeprefix(PREFIX).removeprefix(":").split(",")
    if first in SPLITS:
        return split_spec(first, int(_values(others, ("index",))["index"]))
    keys = tuple(field.name for field in fields(BuildingSpec))
    return BuildingSpec(**_values([first, *others] if first else others, keys))

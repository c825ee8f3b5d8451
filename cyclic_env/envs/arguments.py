"""The arguments that both environments take: settings, render modes, seeds and options of a reset."""

from __future__ import annotations

import copy
import os
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from typing import Any

import numpy as np
from gymnasium.utils import seeding

from cyclic_env.config import EnvConfig
from cyclic_env.errors import ConfigError
from cyclic_env.floor_plans import FloorPlan, MapName, PlanPool, load_floor_plans
from cyclic_env.validation import check_choice, from_mapping, is_integer, short_repr

RENDER_MODES = ("human", "rgb_array")
RENDER_FPS = 5
"""Pictures a second: real time, with a control step of 0.2 s."""


def env_config(
    map_name: MapName | Sequence[MapName] | None,
    config: EnvConfig | Mapping[str, Any] | None,
    settings: Mapping[str, Any],
) -> tuple[EnvConfig, PlanPool]:
    """Return the settings of an environment and its pool of floor plans.

    Parameters
    ----------
    map_name : optional
        Used in place of the config's. The returned config refers to a `FloorPlan` by its name.
    config : optional
        By default the default settings.
    settings : mapping
        Single fields, used in place of the config's.

    Raises
    ------
    ConfigError, FloorPlanError
        If a setting is unknown or doesn't fit, or a floor plan can't be loaded.
    """
    for name in settings:
        check_choice("argument", name, [*(field.name for field in fields(EnvConfig)), "config", "render_mode"])
    config = from_mapping(EnvConfig, config)
    config, given = replace(config, **settings), config.map_name if map_name is None else map_name
    plans = load_floor_plans(given, config.robot.radius, config.closure.leave_radius)
    return replace(config, map_name=config.map_name if map_name is None else _plan_names(map_name)), plans


def _plan_names(map_name: Any) -> Any:
    if isinstance(map_name, FloorPlan):
        return map_name.name
    if isinstance(map_name, str | os.PathLike):
        return os.fsdecode(map_name)
    return tuple(map_name.names if isinstance(map_name, PlanPool) else map(_plan_names, map_name))


def check_render_mode(render_mode: str | None) -> str | None:
    """Return the render mode.

    Raises
    ------
    ConfigError
        If it is unknown.
    """
    return None if render_mode is None else check_choice("render mode", render_mode, RENDER_MODES)


def check_seed(seed: Any) -> int | None:
    """Return the seed of a robot.

    Raises
    ------
    ConfigError
        If it is neither None nor a whole number of at least 0.
    """
    if seed is None:
        return None
    if not is_integer(seed) or seed < 0:
        raise ConfigError(f"seed is {short_repr(seed)}; expected a whole number of at least 0, or None.")
    return int(seed)


def start_option(options: dict[str, Any] | None, *known: str) -> Any:
    """Return the start among the options of a reset, or None.

    Raises
    ------
    ConfigError
        If they hold anything but a start and the other `known` options.
    """
    if options is None:
        return None
    if not isinstance(options, Mapping):
        raise ConfigError(f"the options of a reset are a dict, got {type(options).__name__}.")
    for name in options:
        check_choice("reset option", name, ("start", *known))
    return options.get("start")


def peek_rng(rng: np.random.Generator, seed: int | None) -> np.random.Generator:
    """Return a generator that draws the numbers that `rng` will draw next, after seeding it if there is a seed."""
    return copy.deepcopy(rng) if seed is None else seeding.np_random(seed)[0]

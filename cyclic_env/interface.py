"""What both faces of the engine show: spaces, render modes, and the options of a reset."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces

from cyclic_env.config import ActionType, LaserConfig
from cyclic_env.errors import ConfigError, unknown_name
from cyclic_env.sensors import DISTANCE_MAX

NUM_DRIVES = 5

RENDER_MODES = ("human", "rgb_array")
RENDER_FPS = 5
"""Frames a second: real time, with a control step of 0.2 s."""


def action_space(action_type: ActionType) -> spaces.Space[Any]:
    """Return the action space of a robot that takes actions of that type."""
    if action_type == "discrete":
        return spaces.MultiDiscrete([NUM_DRIVES, 2])
    return spaces.Box(-1.0, 1.0, (4,), np.float32)


def observation_space(laser: LaserConfig) -> spaces.Space[Any]:
    """Return the observation space of a robot with that laser."""
    return spaces.Dict(
        laser=spaces.Box(0.0, laser.range_max, (laser.num_beams,), np.float32),
        distance=spaces.Box(-DISTANCE_MAX, DISTANCE_MAX, (1,), np.float32),
        compass=spaces.Box(-1.0, 1.0, (2,), np.float32),
    )


def checked_render_mode(render_mode: str | None) -> str | None:
    """Return the render mode.

    Raises
    ------
    ConfigError
        If it is unknown.
    """
    if render_mode is not None and render_mode not in RENDER_MODES:
        raise ConfigError(unknown_name("render mode", render_mode, RENDER_MODES))
    return render_mode


def start_option(options: dict[str, Any] | None, *known: str) -> Any:
    """Return the start that the options of a reset name, or None.

    Raises
    ------
    ConfigError
        If they hold anything but a start and the other `known` options.
    """
    if options is not None and not isinstance(options, Mapping):
        raise ConfigError(f"the options of a reset are a dict, got {type(options).__name__}.")
    for name in options or {}:
        if name not in ("start", *known):
            raise ConfigError(unknown_name("reset option", name, ("start", *known)))
    return (options or {}).get("start")

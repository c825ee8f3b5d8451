"""What both faces of the engine share: spaces, render modes, the seeds and options of a reset, one thread at a time."""

from __future__ import annotations

import copy
import pickle
import threading
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.utils import seeding

from cyclic_env.config import ActionType, LaserConfig
from cyclic_env.errors import ConfigError, UsageError
from cyclic_env.simulation.sensors import DISTANCE_MAX
from cyclic_env.validation import check_choice, is_integer, short_repr, unknown_name

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
    return None if render_mode is None else check_choice("render mode", render_mode, RENDER_MODES)


def checked_seed(seed: Any) -> int | None:
    """Return the seed of a row.

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


def peek_rng(rng: np.random.Generator, seed: int | None) -> np.random.Generator:
    """Return a generator that draws what `rng` will draw once it is seeded, if there is a seed."""
    return copy.deepcopy(rng) if seed is None else seeding.np_random(seed)[0]


def snapshot(state: dict[str, Any], changing: Sequence[str]) -> dict[str, Any]:
    """Return the state of an environment for a pickle, its `changing` parts as they are now, in bytes.

    What a pickle is given it looks into only afterwards, when another thread may have taken a step.
    """
    parts = {name: state[name] for name in changing if name in state}
    return {**{name: value for name, value in state.items() if name not in parts}, "snapshot": pickle.dumps(parts)}


def restored(state: dict[str, Any]) -> dict[str, Any]:
    """Return the state of which `snapshot` has made this."""
    return {name: value for name, value in state.items() if name != "snapshot"} | pickle.loads(state["snapshot"])


class ExclusiveAccess:
    """Lets one thread at a time into an environment, and refuses others at once; a copy of it is a turn of its own.

    Raises
    ------
    UsageError
        On entering, if another thread is inside.
    """

    def __init__(self) -> None:
        self._lock = threading.RLock()  # reentrant: a Ctrl-C between taking it and the `with` locks out no step to come

    def __enter__(self) -> None:
        if not self._lock.acquire(blocking=False):
            raise UsageError(
                "the environment is already being stepped by another thread; give each thread one of its own."
            )

    def __exit__(self, *_: object) -> None:
        self._lock.release()

    def __reduce__(self) -> tuple[type[ExclusiveAccess], tuple[()]]:
        return ExclusiveAccess, ()

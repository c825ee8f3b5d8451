"""CyclicLoop: a benchmark for loop closure and exploration in buildings whose corridors close on themselves.

Importing the package registers the environment ``CyclicLoop-v0`` with Gymnasium:

>>> import gymnasium, cyclic_env
>>> env = gymnasium.make("CyclicLoop-v0", map_name="killian_court")
>>> env = gymnasium.make_vec("CyclicLoop-v0", num_envs=256, map_name="killian_court")

The names below are the public ones; their modules are loaded when they are first used.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from gymnasium.envs.registration import register, registry

if TYPE_CHECKING:
    from cyclic_env.config import (
        NOISE_PRESETS,
        ClosureConfig,
        CoverageConfig,
        EnvConfig,
        LaserConfig,
        NoiseConfig,
        RewardConfig,
        RobotConfig,
    )
    from cyclic_env.envs.cyclic_loop import CyclicLoopEnv
    from cyclic_env.envs.vector import CyclicLoopVectorEnv
    from cyclic_env.errors import ActionError, ConfigError, CyclicLoopError, FloorPlanError, RecordingError, UsageError
    from cyclic_env.floor_plans import FloorPlan, load_floor_plan, map_names, read_floor_plan, write_floor_plan
    from cyclic_env.recording.format import Recording, read_recording
    from cyclic_env.recording.readers import read_robot_log
    from cyclic_env.recording.recorded_run import RecordedRun
    from cyclic_env.recording.recorder import Recorder
    from cyclic_env.recording.replay import replay
    from cyclic_env.recording.robot_log import RobotLog
    from cyclic_env.tiers import TIERS, Tier

__version__ = "0.1.0"

_MODULES = (
    *("config", "errors", "floor_plans", "envs.cyclic_loop", "envs.vector"),
    *("recording.format", "recording.recorder", "recording.replay"),
    *("tiers", "recording.robot_log", "recording.readers", "recording.recorded_run"),
)
"""Modules with public names, the quickest to load first."""

__all__ = [
    "NOISE_PRESETS",
    "TIERS",
    "ActionError",
    "ClosureConfig",
    "ConfigError",
    "CoverageConfig",
    "CyclicLoopEnv",
    "CyclicLoopError",
    "CyclicLoopVectorEnv",
    "EnvConfig",
    "FloorPlan",
    "FloorPlanError",
    "LaserConfig",
    "NoiseConfig",
    "RecordedRun",
    "Recorder",
    "Recording",
    "RecordingError",
    "RewardConfig",
    "RobotConfig",
    "RobotLog",
    "Tier",
    "UsageError",
    "load_floor_plan",
    "map_names",
    "read_floor_plan",
    "read_recording",
    "read_robot_log",
    "replay",
    "write_floor_plan",
]


def __getattr__(name: str) -> Any:
    if name in __all__:
        for module in _MODULES:
            values = vars(importlib.import_module(f"cyclic_env.{module}"))
            if name in values:
                return values[name]
    raise AttributeError(f"module 'cyclic_env' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


if "CyclicLoop-v0" not in registry:
    register(
        id="CyclicLoop-v0",
        entry_point="cyclic_env.envs.cyclic_loop:CyclicLoopEnv",
        vector_entry_point="cyclic_env.envs.vector:CyclicLoopVectorEnv",
    )

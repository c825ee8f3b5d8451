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

__version__ = "0.1.0"

_HOMES = {
    "cyclic_env.config": (
        "NOISE_PRESETS",
        "ClosureConfig",
        "CoverageConfig",
        "EnvConfig",
        "LaserConfig",
        "NoiseConfig",
        "RewardConfig",
        "RobotConfig",
    ),
    "cyclic_env.envs.cyclic_loop": ("CyclicLoopEnv",),
    "cyclic_env.errors": (
        "ActionError",
        "ConfigError",
        "CyclicLoopError",
        "FloorPlanError",
        "RecordingError",
        "UsageError",
    ),
    "cyclic_env.floor_plans": ("FloorPlan", "load_floor_plan", "map_names", "read_floor_plan", "write_floor_plan"),
    "cyclic_env.recording.format": ("Recording", "read_recording"),
    "cyclic_env.recording.readers": ("read_robot_log",),
    "cyclic_env.recording.recorded_run": ("RecordedRun",),
    "cyclic_env.recording.recorder": ("Recorder",),
    "cyclic_env.recording.replay": ("replay",),
    "cyclic_env.recording.robot_log": ("RobotLog",),
    "cyclic_env.envs.vector": ("CyclicLoopVectorEnv",),
}
_HOME_OF = {name: module for module, names in _HOMES.items() for name in names}

__all__ = [
    "NOISE_PRESETS",
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
    if name not in _HOME_OF:
        raise AttributeError(f"module 'cyclic_env' has no attribute {name!r}")
    return getattr(importlib.import_module(_HOME_OF[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


if "CyclicLoop-v0" not in registry:
    register(
        id="CyclicLoop-v0",
        entry_point="cyclic_env.envs.cyclic_loop:CyclicLoopEnv",
        vector_entry_point="cyclic_env.envs.vector:CyclicLoopVectorEnv",
    )

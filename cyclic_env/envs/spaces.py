"""The spaces of actions and observations."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces

from cyclic_env.config import DISTANCE_MAX, ActionType, LaserConfig
from cyclic_env.engine.actions import DISCRETE_WHEELS


def action_space(action_type: ActionType) -> spaces.Space[Any]:
    """Return the action space of a robot that takes actions of that type."""
    if action_type == "discrete":
        return spaces.MultiDiscrete([len(DISCRETE_WHEELS), 2])
    return spaces.Box(-1.0, 1.0, (4,), np.float32)


def observation_space(laser: LaserConfig) -> spaces.Space[Any]:
    """Return the observation space of a robot with that laser."""
    return spaces.Dict(
        laser=spaces.Box(0.0, laser.range_max, (laser.num_beams,), np.float32),
        distance=spaces.Box(-DISTANCE_MAX, DISTANCE_MAX, (1,), np.float32),
        compass=spaces.Box(-1.0, 1.0, (2,), np.float32),
    )

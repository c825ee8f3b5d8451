"""The task headings as a `VecEnv` of Stable-Baselines3."""

from __future__ import annotations

from typing import Any

import numpy as np
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices

from agents.rl.headings.env import CyclicLoopHeadingsVectorEnv
from agents.rl.headings.memory import HOLD
from agents.rl.vec_env import CyclicLoopVecEnv
from cyclic_env import CyclicLoopVectorEnv


class HeadingsVecEnv(CyclicLoopVecEnv):
    """`CyclicLoopHeadingsVectorEnv` in the shape that Stable-Baselines3 wants; see `CyclicLoopVecEnv`."""

    steps_per_action = HOLD

    def _make_envs(self, num_envs: int, settings: dict[str, Any]) -> tuple[Any, CyclicLoopVectorEnv]:
        env = CyclicLoopHeadingsVectorEnv(num_envs, **settings)
        return env, env.env

    def action_masks(self) -> np.ndarray:
        """Return which choices each row has."""
        return self.env.action_masks()

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call ``action_masks``, or what `CyclicLoopVecEnv` has, of the rows asked for."""
        if method_name == "action_masks":
            return list(self.action_masks()[list(self._get_indices(indices))])
        return super().env_method(method_name, *method_args, indices=indices, **method_kwargs)

"""The task headings in the shape that Stable-Baselines3 wants."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices

from agents.rl.headings.env import CyclicLoopHeadingsVectorEnv, row_info


class HeadingsVecEnv(VecEnv):
    """`CyclicLoopHeadingsVectorEnv` as a `VecEnv`; infos are empty but for those of the last step of an episode.

    Parameters
    ----------
    num_envs : int
    reward_scale : float
        What rewards are multiplied with, so that returns are of a size that networks learn well; the returns under
        ``info["episode"]`` are as they were.
    settings
        As for `CyclicLoopHeadingsVectorEnv`.
    """

    def __init__(self, num_envs: int = 1, *, reward_scale: float = 1.0, **settings: Any) -> None:
        self.env = CyclicLoopHeadingsVectorEnv(num_envs, **settings)
        super().__init__(num_envs, self.env.single_observation_space, self.env.single_action_space)
        self.reward_scale = reward_scale
        self._actions = np.zeros((num_envs, 2), np.int64)
        self._returns = np.zeros(num_envs)
        self._lengths = np.zeros(num_envs, np.int64)
        self._terms: dict[str, np.ndarray] = {}
        self._began = time.time()

    def reset(self) -> dict[str, np.ndarray]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Begin episodes in all rows, with the seeds given since the last reset."""
        observation, infos = self.env.reset(seed=self._seeds)
        self.reset_infos = [row_info(infos, row) for row in range(self.num_envs)]
        self._reset_seeds()
        self._reset_options()
        self._returns[:], self._lengths[:] = 0.0, 0
        self._terms = {}
        return observation

    def step_async(self, actions: np.ndarray) -> None:
        """Take the decisions of the step to come."""
        self._actions = actions

    def step_wait(self) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray, list[dict[str, Any]]]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Carry out the decisions, and begin anew where an episode ends."""
        observation, rewards, terminated, truncated, infos = self.env.step(self._actions)
        ended = terminated | truncated
        last = infos.get("final_info", infos)
        self._returns += rewards
        self._lengths += last["steps"]
        for name, values in last["reward_terms"].items():
            if not name.startswith("_"):
                self._terms[name] = self._terms.get(name, 0.0) + values
        row_infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for row in np.flatnonzero(ended).tolist():
            row_infos[row] = {
                **row_info(last, row),
                "terminal_observation": infos["final_obs"][row],
                "TimeLimit.truncated": bool(truncated[row] and not terminated[row]),
                "episode": {
                    "r": float(self._returns[row]),
                    "l": int(self._lengths[row]),
                    "t": round(time.time() - self._began, 6),
                    "terms": {name: float(values[row]) for name, values in self._terms.items()},
                },
            }
            self.reset_infos[row] = row_info(infos, row)
        self._returns[ended], self._lengths[ended] = 0.0, 0
        for values in self._terms.values():
            values[ended] = 0.0
        return observation, (rewards * self.reward_scale).astype(np.float32), ended, row_infos

    def action_masks(self) -> np.ndarray:
        """Return which choices each row has."""
        return self.env.action_masks()

    def close(self) -> None:
        """End the threads."""
        self.env.close()

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Return an attribute, which all rows share, for every row asked for."""
        value = getattr(self if hasattr(self, attr_name) else self.env, attr_name)
        return [value for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute, which all rows share."""
        setattr(self.env, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call ``action_masks``, or a method of the vector env that takes a row."""
        rows = list(self._get_indices(indices))
        if method_name == "action_masks":
            masks = self.action_masks()
            return [masks[row] for row in rows]
        return [getattr(self.env.env, method_name)(row, *method_args, **method_kwargs) for row in rows]

    def env_is_wrapped(self, wrapper_class: Any, indices: VecEnvIndices = None) -> list[bool]:
        """Tell that no row is wrapped in anything."""
        return [False for _ in self._get_indices(indices)]

"""The native vector env as a `VecEnv` of Stable-Baselines3."""

from __future__ import annotations

import time
from collections.abc import Sequence
from functools import partial
from typing import Any

import gymnasium
import numpy as np
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices

from cyclic_env import CyclicLoopVectorEnv
from cyclic_env.errors import UsageError

ROW_METHODS = ("trajectory", "claims", "seen_cells")
"""Methods of the vector env that take a row; here each row has them, as a single environment does."""
ROW_SPACES = ("action_space", "observation_space")
ROW_SEQUENCES = ("np_random", "np_random_seed")
"""Attributes of the vector env with an item for each row."""


class CyclicLoopVecEnv(VecEnv):
    """`CyclicLoopVectorEnv` with the interface of Stable-Baselines3.

    It resets a row in the step that ends its episode, as every SB3 `VecEnv` does. The info of that step has all of the
    last info, and ``terminal_observation``, ``TimeLimit.truncated`` and, as from a `Monitor`, ``episode``. The infos
    of all other steps are empty: full ones for 256 rows would take five times as long as the step itself (measured),
    and nothing in SB3 reads them. The scalars of the current infos are in ``venv.env.info_records``, an array with a
    record for each row.

    Parameters
    ----------
    num_envs : int
    reward_scale : float
        Factor of the rewards, which brings returns to a magnitude that networks learn well; the returns under
        ``info["episode"]`` are not scaled.
    settings
        As for `CyclicLoopVectorEnv`, except for the autoreset mode.
    """

    env: Any
    """The vector env that is stepped."""
    core: CyclicLoopVectorEnv
    """The vector env that has the rows' buildings, paths and claims."""
    steps_per_action = 1
    """Number of the environment's steps that an action lasts."""

    def __init__(self, num_envs: int = 1, *, reward_scale: float = 1.0, **settings: Any) -> None:
        self.env, self.core = self._make_envs(num_envs, settings)
        super().__init__(num_envs, self.env.single_observation_space, self.env.single_action_space)
        self.metadata = self.core.metadata  # videos take their frames per second from it
        self.reward_scale = reward_scale
        self._actions: np.ndarray | None = None
        self._returns = np.zeros(num_envs)
        self._lengths = np.zeros(num_envs, np.int64)
        self._terms: dict[str, np.ndarray] = {}
        self._began = time.time()

    def _make_envs(self, num_envs: int, settings: dict[str, Any]) -> tuple[Any, CyclicLoopVectorEnv]:
        env = CyclicLoopVectorEnv(num_envs, autoreset_mode="SAME_STEP", **settings)
        return env, env

    def reset(self) -> dict[str, np.ndarray]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Begin episodes in all rows, with the seeds and options given since the last reset."""
        with_options = np.array([bool(options) for options in self._options])
        rows = np.arange(self.num_envs)
        observation: dict[str, np.ndarray] = {}
        if with_options.any():  # each row may have its own options, but the vector env takes one set for all it resets
            for row in rows[with_options].tolist():
                observation = self._reset_rows(rows == row, self._options[row])
            rows = rows[~with_options]
        if len(rows):
            observation = self._reset_rows(~with_options, {})
        self._reset_seeds()
        self._reset_options()
        self._returns[:], self._lengths[:], self._terms = 0.0, 0, {}
        return observation  # of all rows, whichever were the last to be reset

    def _reset_rows(self, mask: np.ndarray, options: dict[str, Any]) -> dict[str, np.ndarray]:
        observation, infos = self.env.reset(seed=self._seeds, options={**options, "reset_mask": mask})
        for row in np.flatnonzero(mask).tolist():
            self.reset_infos[row] = _row_info(infos, row)
        return observation

    def step_async(self, actions: np.ndarray) -> None:
        """Store the actions of the coming step."""
        self._actions = actions

    def step_wait(self) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray, list[dict[str, Any]]]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Step all rows, and begin anew those whose episode ends."""
        observation, rewards, terminated, truncated, infos = self.env.step(self._actions)
        ended = terminated | truncated
        self._returns += rewards
        last = infos.get("final_info", infos)
        self._lengths += np.where(ended, last["steps"], infos["steps"]) if "steps" in infos else 1
        for name, values in infos["reward_terms"].items():
            if not name.startswith("_"):
                self._terms[name] = self._terms.get(name, 0.0) + np.where(ended, last["reward_terms"][name], values)
        row_infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for row in np.flatnonzero(ended).tolist():
            row_infos[row] = {
                **_row_info(infos["final_info"], row),
                "terminal_observation": infos["final_obs"][row],
                "TimeLimit.truncated": bool(truncated[row] and not terminated[row]),
                "episode": {
                    "r": float(self._returns[row]),
                    "l": int(self._lengths[row]),
                    "t": round(time.time() - self._began, 6),
                    "terms": {name: float(values[row]) for name, values in self._terms.items()},
                },
            }
            self.reset_infos[row] = _row_info(infos, row)
        for values in (self._returns, self._lengths, *self._terms.values()):
            values[ended] = 0
        return observation, (rewards * self.reward_scale).astype(np.float32), ended, row_infos

    def close(self) -> None:
        """Close the window and end the threads."""
        self.env.close()

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Return an attribute of every row asked for, as a single environment has it."""
        rows = self._get_indices(indices)
        if attr_name == "floor_plan":
            return [self.core.floor_plan(row) for row in rows]
        if attr_name == "step_budget":
            return [self.core.step_budget(row) for row in rows]
        if attr_name in ROW_METHODS:
            return [partial(getattr(self.core, attr_name), row) for row in rows]
        if attr_name in ROW_SPACES:
            return [getattr(self, attr_name) for _ in rows]
        if attr_name in ROW_SEQUENCES:
            return [getattr(self.core, attr_name)[row] for row in rows]
        return [getattr(self.env if hasattr(self.env, attr_name) else self.core, attr_name) for _ in rows]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute of the vector env, which all rows share.

        Raises
        ------
        UsageError
            If only some of the rows are named.
        """
        if set(self._get_indices(indices)) != set(range(self.num_envs)):
            raise UsageError(f"the rows share {attr_name!r}: set it for all of them, with indices=None.")
        setattr(self.env, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call ``trajectory``, ``claims``, ``seen_cells`` or ``render`` of the rows asked for.

        Raises
        ------
        AttributeError
            If the rows have no such method.
        """
        rows = list(self._get_indices(indices))
        if method_name == "render":
            pictures = self.core.render()
            return [pictures[row] if pictures is not None and row < len(pictures) else None for row in rows]
        if method_name not in ROW_METHODS:
            raise AttributeError(f"a row has no method {method_name!r}; it has {', '.join(ROW_METHODS)} and render.")
        return [getattr(self.core, method_name)(row, *method_args, **method_kwargs) for row in rows]

    def env_is_wrapped(self, wrapper_class: type[gymnasium.Wrapper], indices: VecEnvIndices = None) -> list[bool]:
        """Tell that each row is wrapped in a `Monitor`, whose entries its infos have, and in nothing else."""
        return [wrapper_class is Monitor for _ in self._get_indices(indices)]

    def get_images(self) -> Sequence[np.ndarray | None]:
        """Return a picture of every row."""
        return self.env_method("render")


def _row_info(infos: dict[str, Any], row: int) -> dict[str, Any]:
    """Return the info of one row as a single environment has it."""
    return {
        name: _row_info(values, row) if isinstance(values, dict) else values[row].item()
        for name, values in infos.items()
        if not name.startswith("_") and name not in ("final_obs", "final_info")
    }

"""What a model is trained with."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from stable_baselines3 import A2C, PPO, SAC, TD3
from stable_baselines3.common.base_class import BaseAlgorithm

from agents.rl.vec_env import CyclicLoopVecEnv
from cyclic_env.config import ACTION_TYPES, ActionType, noise_from_name
from cyclic_env.errors import ConfigError
from cyclic_env.floor_plans import load_floor_plans, separate_names
from cyclic_env.validation import check_choice

ALGORITHMS: Mapping[str, type[BaseAlgorithm]] = {"a2c": A2C, "ppo": PPO, "sac": SAC, "td3": TD3}
CONTINUOUS_ONLY = ("sac", "td3")


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingSettings:
    """Algorithm, environment and seed of a training run."""

    algo: str = "ppo"
    map_name: tuple[str, ...] = ("ring",)
    noise: str = "ideal"
    action_type: ActionType = "wheels"
    step_budget: int | None = None
    num_envs: int = 16
    seed: int = 0

    def __post_init__(self) -> None:
        check_choice("algorithm", self.algo, ALGORITHMS)
        check_choice("action type", self.action_type, ACTION_TYPES)
        if self.action_type == "discrete" and self.algo in CONTINUOUS_ONLY:
            raise ConfigError(f"{self.algo} takes no discrete actions; use ppo or a2c, or another action type.")
        noise_from_name(self.noise)
        load_floor_plans(self.map_name)
        for name in ("num_envs", "step_budget"):
            value = getattr(self, name)
            if (name, value) != ("step_budget", None) and (not isinstance(value, int) or value < 1):
                raise ConfigError(f"{name} is {value!r}; expected a whole number of at least 1.")
        if not isinstance(self.seed, int) or not 0 <= self.seed < 2**32:
            raise ConfigError(f"seed is {self.seed!r}; expected a whole number from 0 to {2**32 - 1}.")

    def make_env(self) -> CyclicLoopVecEnv:
        """Return the environment to train on."""
        return CyclicLoopVecEnv(
            self.num_envs,
            map_name=list(self.map_name),
            noise=self.noise,
            action_type=self.action_type,
            step_budget=self.step_budget,
        )


def training_settings(given: Mapping[str, Any]) -> TrainingSettings:
    """Return settings with the given fields and defaults for the others; ``map_name`` is a text with commas."""
    given = dict(given)
    if "map_name" in given:
        given["map_name"] = tuple(separate_names(given["map_name"]))
    return TrainingSettings(**given)

"""What a model is trained with."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

from stable_baselines3 import A2C, PPO, SAC, TD3
from stable_baselines3.common.base_class import BaseAlgorithm

from agents.rl.vec_env import CyclicLoopVecEnv
from cyclic_env.config import EnvConfig
from cyclic_env.errors import ConfigError
from cyclic_env.floor_plans import load_floor_plans, separate_names
from cyclic_env.validation import check_choice, check_integer

ALGORITHMS: Mapping[str, type[BaseAlgorithm]] = {"a2c": A2C, "ppo": PPO, "sac": SAC, "td3": TD3}
CONTINUOUS_ONLY = ("sac", "td3")
NUM_ENVS_MAX = 10_000


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingSettings(EnvConfig):
    """Environment, algorithm and seed of a training run.

    Raises
    ------
    ConfigError
        If a setting is unknown, of the wrong type or out of range.
    """

    map_name: str | tuple[str, ...] = ("ring",)
    algo: str = "ppo"
    num_envs: int = 16
    seed: int = 0

    def __post_init__(self) -> None:
        EnvConfig.__post_init__(self)
        check_choice("algorithm", self.algo, ALGORITHMS)
        if self.action_type == "discrete" and self.algo in CONTINUOUS_ONLY:
            raise ConfigError(f"{self.algo} takes no discrete actions; use ppo or a2c, or another action type.")
        load_floor_plans(self.map_name)
        check_integer(self, "num_envs", 1, NUM_ENVS_MAX)
        check_integer(self, "seed", 0, 2**32 - 1)

    def make_env(self) -> CyclicLoopVecEnv:
        """Return the environment to train on."""
        return CyclicLoopVecEnv(self.num_envs, **{field.name: getattr(self, field.name) for field in fields(EnvConfig)})


def training_settings(given: Mapping[str, Any]) -> TrainingSettings:
    """Return settings with the given fields and defaults for the others; ``map_name`` is a text with commas."""
    given = dict(given)
    if "map_name" in given:
        given["map_name"] = tuple(separate_names(given["map_name"]))
    return TrainingSettings(**given)

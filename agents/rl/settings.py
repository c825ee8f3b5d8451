"""The settings of a training run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from gymnasium.vector import AutoresetMode, VectorEnv

from agents.rl.headings.env import CyclicLoopHeadingsVectorEnv
from agents.rl.headings.vec_env import HeadingsVecEnv
from agents.rl.models import ALGORITHMS, TASKS, hyperparameter_file, read_hyperparameters
from agents.rl.vec_env import CyclicLoopVecEnv
from cyclic_env import CyclicLoopVectorEnv
from cyclic_env.config import (
    ActionType,
    ClosureConfig,
    CoverageConfig,
    EnvConfig,
    LaserConfig,
    RewardConfig,
    RobotConfig,
)
from cyclic_env.errors import ConfigError
from cyclic_env.floor_plans import load_floor_plans, separate_names
from cyclic_env.validation import check_choice, check_integer

NUM_ENVS_MAX = 10_000
CONTINUOUS_ONLY = ("sac", "td3")
DEFAULTS: Mapping[str, Mapping[str, Any]] = {
    "headings": {"algo": "maskable_ppo", "map_name": "generated:train", "noise": "calibrated,typical,poor"}
}
"""Settings of a training run of a task that a command line need not give."""
PARTS = ("step_budget", "random_start", "terminate_on_collision", "robot", "laser", "closure", "coverage", "reward")
"""Settings with the names and meanings of `cyclic_env.EnvConfig`."""
LISTS = ("map_name", "noise", "validation_map")
"""Settings that hold several names, which commas separate on a command line."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingSettings:
    """Task, algorithm, environment and seed of a training run."""

    task: str = "cyclic_loop"
    algo: str = "ppo"
    map_name: tuple[str, ...] = ("ring",)
    noise: tuple[str, ...] = ("ideal",)
    """Noise presets; every reset draws one of them."""
    action_type: ActionType = "wheels"
    """Always twist for the task headings."""
    step_budget: int | None = None
    random_start: bool = False
    terminate_on_collision: bool = False
    robot: RobotConfig = field(default_factory=RobotConfig)
    laser: LaserConfig = field(default_factory=LaserConfig)
    closure: ClosureConfig = field(default_factory=ClosureConfig)
    coverage: CoverageConfig = field(default_factory=CoverageConfig)
    reward: RewardConfig = field(default_factory=RewardConfig)
    num_envs: int | None = None
    """Number of robots; None means the number in the hyperparameters."""
    seed: int = 0
    validation_map: tuple[str, ...] = ()
    """Plans on which checkpoints are scored, so that the best one is kept; without plans there are no scores."""
    validation_envs: int = 32
    hyperparameters: Mapping[str, Any] = field(default_factory=dict)
    """As read from a YAML file; empty means those of the file that is shipped for the task and the algorithm."""

    def __post_init__(self) -> None:
        check_choice("task", self.task, TASKS)
        check_choice("algorithm", self.algo, ALGORITHMS)
        if self.action_type == "discrete" and self.algo in CONTINUOUS_ONLY:
            raise ConfigError(f"{self.algo} takes no discrete actions; use ppo or a2c, or another action type.")
        if not self.hyperparameters:
            shipped = read_hyperparameters(hyperparameter_file(self.task, self.algo), self.algo)
            object.__setattr__(self, "hyperparameters", shipped)
        if self.task == "headings":
            object.__setattr__(self, "action_type", "twist")
        for name in LISTS:
            value = getattr(self, name)
            object.__setattr__(self, name, (value,) if isinstance(value, str) else tuple(value))
        checked = EnvConfig(**self._env_settings())
        for name in PARTS:
            object.__setattr__(self, name, getattr(checked, name))
        for names in (self.map_name, self.validation_map):
            if names:
                load_floor_plans(names, self.robot.radius)
        if self.num_envs is None:
            object.__setattr__(self, "num_envs", self.hyperparameters["num_envs"])
        for name in ("num_envs", "validation_envs"):
            check_integer(self, name, 1, NUM_ENVS_MAX)
        check_integer(self, "seed", 0, 2**32 - 1)

    def make_env(self) -> CyclicLoopVecEnv:
        """Return the environment to train on."""
        kind = HeadingsVecEnv if self.task == "headings" else CyclicLoopVecEnv
        assert self.num_envs is not None  # since `__post_init__`
        scale = self.hyperparameters["reward_scale"]
        return kind(self.num_envs, reward_scale=scale, map_name=list(self.map_name), **self._env_settings())

    def make_validation_env(self) -> VectorEnv:
        """Return the environment to score checkpoints in."""
        kind = CyclicLoopHeadingsVectorEnv if self.task == "headings" else CyclicLoopVectorEnv
        plans = list(self.validation_map)
        return kind(self.validation_envs, plans, autoreset_mode=AutoresetMode.DISABLED, **self._env_settings())

    def _env_settings(self) -> dict[str, Any]:
        noise = self.noise[0] if len(self.noise) == 1 else self.noise
        return {"noise": noise, "action_type": self.action_type} | {name: getattr(self, name) for name in PARTS}


def training_settings(given: Mapping[str, Any]) -> TrainingSettings:
    """Return the settings with the given fields; the others have the task's `DEFAULTS` or those of `TrainingSettings`.

    Models that are trained on generated:train are scored on generated:validation. Each of `LISTS` is given as one text
    with commas, and `hyperparameters` as the path of a YAML file.
    """
    given = {**DEFAULTS.get(given.get("task", ""), {}), **given}
    if given.get("map_name") == "generated:train":
        given = {"validation_map": "generated:validation", **given}
    for name in LISTS:
        if name in given:
            given[name] = tuple(separate_names(given[name]))
    if "hyperparameters" in given:
        algo = check_choice("algorithm", given.get("algo", TrainingSettings().algo), ALGORITHMS)
        given["hyperparameters"] = read_hyperparameters(Path(given["hyperparameters"]), algo)
    return TrainingSettings(**given)


def settings_from_stored(stored: Mapping[str, Any]) -> TrainingSettings:
    """Return settings that were stored as plain data.

    Raises
    ------
    KeyError, TypeError
        If a setting is missing or unknown.
    """
    older = {name: stored[name] for name in PARTS if name in stored}  # models of older versions have a step budget only
    names = [one.name for one in fields(TrainingSettings) if one.name not in PARTS]
    return TrainingSettings(**{name: stored[name] for name in names}, **older)

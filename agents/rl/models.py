"""Models of Stable-Baselines3 and sb3-contrib, made from hyperparameters: a YAML file for each task and algorithm."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from sb3_contrib import MaskablePPO
from stable_baselines3 import A2C, PPO, SAC, TD3
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import VecEnv

from agents.rl.features import ScanFeatures
from agents.rl.headings.policy import FlatFeatures, SharedPolicy
from cyclic_env.errors import ConfigError
from cyclic_env.validation import unknown_name

ALGORITHMS: Mapping[str, type[BaseAlgorithm]] = {
    "ppo": PPO,
    "maskable_ppo": MaskablePPO,
    "a2c": A2C,
    "sac": SAC,
    "td3": TD3,
}
TASKS = ("cyclic_loop", "headings")
FOLDER = Path(__file__).with_name("hyperparameters")
POLICIES: Mapping[str, tuple[Any, dict[str, Any]]] = {
    "scan": ("MultiInputPolicy", {"features_extractor_class": ScanFeatures}),
    "flat": ("MultiInputPolicy", {"features_extractor_class": FlatFeatures}),
    "shared": (SharedPolicy, {}),
}
"""Policies by their names in the files, with the arguments that they are made with."""
REQUIRED = ("policy", "num_envs", "reward_scale", "gamma")
OURS = ("num_envs", "reward_scale", "minibatches")
"""Hyperparameters that are not arguments of the algorithms."""


def hyperparameter_file(task: str, algo: str) -> Path:
    """Return the shipped file for a task and an algorithm.

    Raises
    ------
    ConfigError
        If there is none.
    """
    path = FOLDER / f"{task}_{algo}.yaml"
    if not path.is_file():
        known = [name.stem.removeprefix(f"{task}_") for name in sorted(FOLDER.glob(f"{task}_*.yaml"))]
        raise ConfigError(f"{algo} does not learn the task {task}; there is {', '.join(known)}.")
    return path


def read_hyperparameters(path: Path, algo: str) -> dict[str, Any]:
    """Return the hyperparameters of a YAML file.

    Raises
    ------
    ConfigError
        If the file can't be read, lacks a required hyperparameter, or has one that the algorithm does not take.
    """
    try:
        hyperparameters = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise ConfigError(f"{path} can't be read as YAML: {' '.join(str(error).split())}.") from error
    if not isinstance(hyperparameters, dict):
        raise ConfigError(f"{path} holds no hyperparameters; expected lines such as 'gamma: 0.99'.")
    for name in REQUIRED:
        if name not in hyperparameters:
            raise ConfigError(f"{path} lacks {name}.")
    known = [*inspect.signature(ALGORITHMS[algo]).parameters, *OURS]
    for name in hyperparameters:
        if name not in known:
            raise ConfigError(f"{path}: {unknown_name(f'hyperparameter of {algo}', name, known)}")
    if hyperparameters["policy"] not in POLICIES:
        raise ConfigError(f"{path}: {unknown_name('policy', hyperparameters['policy'], POLICIES)}")
    if hyperparameters["policy"] == "shared" and algo != "maskable_ppo":
        raise ConfigError(f"{path}: the policy shared needs maskable_ppo, for {algo} masks no choices.")
    return hyperparameters


def new_model(
    algo: str, hyperparameters: Mapping[str, Any], env: VecEnv, seed: int, *, discrete: bool
) -> BaseAlgorithm:
    """Return an untrained model.

    Parameters
    ----------
    algo : str
        One of `ALGORITHMS`.
    hyperparameters : mapping
        As returned by `read_hyperparameters`; missing ones have the defaults of the algorithm's library.
    env : VecEnv
    seed : int
    discrete : bool
        Whether actions are discrete; hyperparameters for continuous actions (gSDE) are then left out.

    Raises
    ------
    ConfigError
        If the algorithm does not take these hyperparameters.
    """
    settings = {name: value for name, value in hyperparameters.items() if name not in OURS}
    policy, needed = POLICIES[settings.pop("policy")]
    policy_kwargs = {**needed, **settings.pop("policy_kwargs", {})}
    if discrete:
        for name in ("use_sde", "sde_sample_freq"):
            settings.pop(name, None)
        policy_kwargs.pop("log_std_init", None)
    if "minibatches" in hyperparameters:
        settings["batch_size"] = max(1, settings["n_steps"] * env.num_envs // hyperparameters["minibatches"])
    if "action_noise" in settings:
        shape = env.action_space.shape
        assert shape is not None
        settings["action_noise"] = NormalActionNoise(np.zeros(shape), np.full(shape, settings["action_noise"]))
    try:
        return ALGORITHMS[algo](policy, env, seed=seed, device="cpu", policy_kwargs=policy_kwargs, **settings)
    except (TypeError, ValueError, AssertionError) as error:
        raise ConfigError(f"{algo} does not take its hyperparameters: {' '.join(str(error).split())}.") from error

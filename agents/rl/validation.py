"""Scores of a model on buildings that it is not trained on: one episode in each row, so that all count alike."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium.vector import VectorEnv
from stable_baselines3.common.base_class import BaseAlgorithm

from agents.rl.headings.agent import takes_masks


def first_episodes(model: BaseAlgorithm, env: VectorEnv, seed: int) -> list[dict[str, Any]]:
    """Run one episode in each row with the model's most likely actions.

    Parameters
    ----------
    model : BaseAlgorithm
    env : VectorEnv
        A native vector env, with autoreset mode ``DISABLED``.
    seed : int

    Returns
    -------
    list of dict
        For each row the scalars of its last info, and its ``return``.
    """
    masked = takes_masks(model)
    observation, _ = env.reset(seed=seed)
    active = np.ones(env.num_envs, np.bool_)
    returns = np.zeros(env.num_envs)
    records: list[dict[str, Any]] = [{} for _ in range(env.num_envs)]
    while active.any():
        rows = np.flatnonzero(active)
        masks = {"action_masks": env.action_masks()[rows]} if masked else {}  # pyright: ignore[reportAttributeAccessIssue]
        features = {name: value[rows] for name, value in observation.items()}
        choices, _ = model.predict(features, deterministic=True, **masks)
        actions = np.zeros(env.action_space.shape, env.action_space.dtype)  # pyright: ignore[reportCallIssue, reportArgumentType]
        actions[rows] = choices
        observation, rewards, terminated, truncated, infos = env.step(actions, active=active)  # pyright: ignore[reportCallIssue]
        returns += rewards
        for row in np.flatnonzero(active & (terminated | truncated)):
            scalars = {
                name: infos[name][row].item() for name in infos if f"_{name}" in infos and name != "reward_terms"
            }
            records[row] = {**scalars, "return": float(returns[row])}
            active[row] = False
    return records

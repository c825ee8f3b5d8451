"""Agents that need no training, by name: the baselines, which know nothing, and the explorer."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from agents.knn.config import preset
from agents.knn.explorer import KnnExplorer
from agents.scripted import (
    BEYOND_WALL,
    CLEAR_OF_WALL,
    LEFT,
    RIGHT,
    RandomAgent,
    ScriptedAgent,
    SpinningAgent,
    StandingStillAgent,
    ToAndFroAgent,
    WallFollowingAgent,
)
from cyclic_env.config import ActionType
from cyclic_env.evaluation.rollout import Policy
from cyclic_env.validation import check_choice

CLAIMS = "+claims"
"""Ending of the names of agents that claim in every step to be back at the start."""

_DRIVES: dict[str, Callable[..., ScriptedAgent]] = {
    "circling": partial(WallFollowingAgent, side=LEFT, distance=CLEAR_OF_WALL),
    "random": RandomAgent,
    "spinning": SpinningAgent,
    "standing_still": StandingStillAgent,
    "to_and_fro": ToAndFroAgent,
    "wall_hugging": partial(WallFollowingAgent, side=RIGHT, distance=BEYOND_WALL),
}
_BASELINES: dict[str, Callable[..., ScriptedAgent]] = {
    name: agent
    for drive, factory in _DRIVES.items()
    for name, agent in ((drive, factory), (drive + CLAIMS, partial(factory, claims=True)))
}
_EXPLORERS = {
    "knn": preset("extended"),
    "knn_looks_only": preset("extended", detector="knn"),
    "knn_position_only": preset("extended", detector="position"),
    "knn_paper": preset("paper"),
}


def baseline_names() -> tuple[str, ...]:
    """Return the names of the agents that know nothing."""
    return tuple(_BASELINES)


def agent_names() -> tuple[str, ...]:
    """Return the names that `make_agent` knows."""
    return (*_EXPLORERS, *_BASELINES)


def make_agent(name: str, *, action_type: ActionType = "wheels", seed: int = 0) -> Policy:
    """Return the agent of that name.

    Parameters
    ----------
    name : str
        One of `agent_names`.
    action_type : {"wheels", "twist", "discrete"}
        That of the environment.
    seed : int
        For agents that draw.

    Raises
    ------
    ConfigError
        If there is no such agent; the message lists them and the nearest.
    """
    if name in _EXPLORERS:
        return KnnExplorer(_EXPLORERS[name], action_type=action_type)
    return _BASELINES[check_choice("agent", name, agent_names())](action_type=action_type, seed=seed)

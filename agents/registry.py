"""Agents that need no training, by name."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

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
from cyclic_env.config import ActionType, checked_name

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
_AGENTS: dict[str, Callable[..., ScriptedAgent]] = {
    name: agent
    for drive, factory in _DRIVES.items()
    for name, agent in ((drive, factory), (drive + CLAIMS, partial(factory, claims=True)))
}


def agent_names() -> tuple[str, ...]:
    """Return the names that `make_agent` knows."""
    return tuple(_AGENTS)


def make_agent(name: str, *, action_type: ActionType = "wheels", seed: int = 0) -> ScriptedAgent:
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
    return _AGENTS[checked_name("agent", name, _AGENTS)](action_type=action_type, seed=seed)

"""Agents by name: the explorer, its rivals, the watcher, those of the task headings, and baselines of fixed rules."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from agents.knn.config import preset
from agents.knn.policy import KnnPolicy
from agents.rivals.frontier import FrontierAgentConfig, FrontierPolicy
from agents.rivals.privileged import OraclePolicy, PerfectDetectorPolicy
from agents.rl import require_learning
from agents.rl.headings.agent import HeadingsAgent, RandomHeadingsAgent
from agents.rl.headings.memory import Rules
from agents.rl.headings.rules import HandRule
from agents.scripted import (
    BEYOND_WALL,
    CLEAR_OF_WALL,
    LEFT,
    RIGHT,
    RandomAgent,
    ScriptedAgent,
    ScriptedPolicy,
    SpinningAgent,
    StandingStillAgent,
    ToAndFroAgent,
    WallFollowingAgent,
)
from agents.watcher import WatcherPolicy
from cyclic_env.config import ActionType, EnvConfig
from cyclic_env.evaluation.rollout import Policy
from cyclic_env.validation import check_choice

WATCHER = "watcher"
"""Name of the agent that only watches, for robots that something else drives."""

CLAIMS = "+claims"
"""Suffix of the names of agents that claim in every step to be back at the start."""

_DRIVES: dict[str, Callable[..., ScriptedAgent]] = {
    "circling": partial(WallFollowingAgent, side=LEFT, wall_distance=CLEAR_OF_WALL),
    "random": RandomAgent,
    "spinning": SpinningAgent,
    "standing_still": StandingStillAgent,
    "to_and_fro": ToAndFroAgent,
    "wall_hugging": partial(WallFollowingAgent, side=RIGHT, wall_distance=BEYOND_WALL),
}
_BASELINES = {
    drive + ending: partial(ScriptedPolicy, kind, claims=bool(ending))
    for drive, kind in _DRIVES.items()
    for ending in ("", CLAIMS)
}
_EXPLORERS = {
    "knn": preset("extended"),
    "knn_looks_only": preset("extended", detector="knn"),
    "knn_position_only": preset("extended", detector="position"),
    "knn_paper": preset("paper"),
    "knn_paper_appearance": preset("paper", detector="knn"),
    "knn_paper_position": preset("paper", detector="position"),
}
PRETRAINED = Path(__file__).with_name("pretrained")
"""Folder of the shipped models, each the folder of a training run."""
_LEARNED = ("ppo_headings", "ppo_headings_1", "ppo_headings_2")
_HEADINGS = (*_LEARNED, "headings_rule", "headings_random")
_FRONTIERS = {
    "frontier": FrontierAgentConfig(),
    "frontier_lite": FrontierAgentConfig(order="explore_lite"),
    "frontier_loops": FrontierAgentConfig(closes_loops=True),
}
_CIRCLING_RIGHT = partial(WallFollowingAgent, side=RIGHT, wall_distance=CLEAR_OF_WALL)
_PRIVILEGED = ("oracle", "perfect_detector")


def privileged_names() -> tuple[str, ...]:
    """Return the names of the agents that see the truth about their environment: bounds, never to be ranked."""
    return _PRIVILEGED


def agent_label(name: str) -> str:
    """Return the name of an agent for tables and figures, which says so if it is privileged."""
    return f"{name} (privileged)" if name in _PRIVILEGED else name


def baseline_names() -> tuple[str, ...]:
    """Return the names of the agents that follow fixed rules."""
    return tuple(_BASELINES)


def agent_names() -> tuple[str, ...]:
    """Return the names that `make_agent` knows."""
    return (*_EXPLORERS, *_FRONTIERS, *_HEADINGS, "circling_right", WATCHER, *_PRIVILEGED, *_BASELINES)


def usual_action_type(name: str) -> ActionType:
    """Return the action type by which an agent is usually run: by twist if its task is headings, else by wheels."""
    return "twist" if name in _HEADINGS else "wheels"


def make_agent(name: str, env: Any = None, *, action_type: ActionType | None = None, seed: int = 0) -> Policy:
    """Return the agent of that name.

    Parameters
    ----------
    name : str
        One of `agent_names`.
    env : CyclicLoopEnv or CyclicLoopVectorEnv, optional
        The environment to drive in, perhaps wrapped; the agent takes its laser, robot and action type from there.
        A privileged agent needs it, and drives in no other.
    action_type : {"wheels", "twist", "discrete"}, optional
        By default the environment's, or ``"wheels"`` without one.
    seed : int
        Seed of agents that draw random numbers.

    Raises
    ------
    ConfigError
        If there is no such agent (the message lists all names and suggests the nearest), or a privileged one has no
        environment.
    """
    check_choice("agent", name, agent_names())
    settings = EnvConfig() if env is None else env.unwrapped.config
    actions = action_type or settings.action_type
    if name in _BASELINES:
        return _BASELINES[name](action_type=actions, seed=seed, laser=settings.laser)
    if name == "circling_right":
        return ScriptedPolicy(_CIRCLING_RIGHT, action_type=actions, laser=settings.laser)
    if name == WATCHER:
        return WatcherPolicy(settings.laser, action_type=actions)
    if name in _FRONTIERS:
        return FrontierPolicy(_FRONTIERS[name], settings.laser, settings.robot, action_type=actions)
    if name == "oracle":
        return OraclePolicy(env, action_type=actions)
    if name == "perfect_detector":
        return PerfectDetectorPolicy(
            preset("extended").fitted(settings.laser, settings.robot), env, action_type=actions
        )
    if name in _HEADINGS:
        rules = Rules(laser=settings.laser, robot=settings.robot, closure=settings.closure)
        if name == "headings_random":
            return RandomHeadingsAgent(rules, action_type=actions, seed=seed)
        model = HandRule() if name == "headings_rule" else _shipped_model(name)
        return HeadingsAgent(model, rules, action_type=actions)
    return KnnPolicy(_EXPLORERS[name].fitted(settings.laser, settings.robot), action_type=actions)


def _shipped_model(name: str) -> Any:
    require_learning()
    from agents.rl.storage import load_trained

    return load_trained(PRETRAINED / name).model

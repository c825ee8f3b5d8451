"""Evaluate agents side by side: named ones (the explorer, scripted agents), and trained ones by the file of a model."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from agents.registry import agent_names, make_agent, usual_action_type
from agents.rl import require_learning
from cyclic_env import CyclicLoopVectorEnv, RobotConfig
from cyclic_env.errors import ConfigError
from cyclic_env.evaluation.rollout import Policy, checked_seeds, evaluate
from cyclic_env.evaluation.statistics import Evaluation
from cyclic_env.floor_plans import load_floor_plans
from cyclic_env.validation import from_mapping, unknown_name

DEFAULT_MAP = "killian_court"


@dataclass(frozen=True, slots=True, kw_only=True)
class Contestant:
    """An agent in a comparison."""

    name: str
    policy: Policy
    action_type: str
    map_name: tuple[str, ...]
    """The maps that it was trained on; empty for an agent without training."""


def load_contestant(name: str, action_type: str | None = None, **settings: Any) -> Contestant:
    """Return the agent with that name, the model in that file or folder, or one that a function of yours makes.

    Parameters
    ----------
    name : str
        Name of an agent, path of a file or folder, or ``module:function`` for a function that takes the environment and
        returns the policy.
    action_type : str, optional
        By default the one that the model was trained with, or the `usual_action_type` of the agent.
    settings
        Settings of the environment, as for `CyclicLoopEnv`; the agent is made for its laser and its robot.

    Raises
    ------
    ConfigError
        If there is no such agent or file, the file is not a model, or the model has other actions or sensors.
    """
    path, named = Path(name), name in agent_names()
    if named or (":" in name and not path.exists()):
        settings["action_type"] = action_type or (usual_action_type(name) if named else "wheels")
        with closing(CyclicLoopVectorEnv(1, **settings)) as env:
            policy = make_agent(name, env) if named else import_maker(name)(env)
            return Contestant(name=name, policy=policy, action_type=env.config.action_type, map_name=())
    if not path.exists():
        if path.suffix == ".zip" or len(path.parts) > 1:
            raise ConfigError(f"there is no model file {name}.")
        raise ConfigError(unknown_name("agent", name, agent_names()) + " Or give the file of a model.")
    require_learning()
    from agents.rl.headings.agent import HeadingsAgent
    from agents.rl.headings.env import CyclicLoopHeadingsVectorEnv, action_space
    from agents.rl.storage import check_fits, load_trained

    trained = load_trained(path)
    its_type = trained.settings.action_type if trained.settings else None
    if action_type and its_type and action_type != its_type:
        raise ConfigError(f"{name} was trained with action type {its_type!r}, not {action_type!r}.")
    headings = trained.model.action_space == action_space()
    settings["action_type"] = action_type or its_type or ("twist" if headings else "wheels")
    with closing((CyclicLoopHeadingsVectorEnv if headings else CyclicLoopVectorEnv)(1, **settings)) as env:
        check_fits(path, trained.model, env.single_observation_space, env.single_action_space)
    policy: Policy = trained.model
    if isinstance(env, CyclicLoopHeadingsVectorEnv):
        policy = HeadingsAgent(trained.model, env.perception.rules)
    map_name = trained.settings.map_name if trained.settings else ()
    return Contestant(name=name, policy=policy, action_type=settings["action_type"], map_name=map_name)


def import_maker(name: str) -> Callable[[CyclicLoopVectorEnv], Policy]:
    """Return the function with the name ``module:function``.

    Raises
    ------
    ConfigError
        If there is none.
    """
    module, _, function = name.partition(":")
    try:
        return getattr(importlib.import_module(module), function)
    except (ImportError, ValueError, AttributeError) as error:
        raise ConfigError(f"there is no agent {name!r}: {error}; expected module:function.") from error


def compare(
    names: Sequence[str],
    *,
    maps: Sequence[str] = (),
    action_type: str | None = None,
    seeds: Iterable[int] = range(10),
    settings: Mapping[str, Any] | None = None,
    **options: Any,
) -> Iterator[Evaluation]:
    """Evaluate several agents on the same maps with the same seeds, and yield each evaluation as it ends.

    Parameters
    ----------
    names : sequence of str
        As `load_contestant` takes them.
    maps : sequence of str
        By default the maps that the models among the agents were trained on; without models, Killian Court.
    action_type : str, optional
        As for `load_contestant`.
    seeds, options
        As for `cyclic_env.evaluation.rollout.evaluate`.
    settings : mapping, optional
        All other settings of the environment, as for `CyclicLoopEnv`.

    Raises
    ------
    ConfigError, FloorPlanError
        If an argument doesn't fit; raised before the first episode.
    """
    seeds, settings = checked_seeds(seeds), dict(settings or {})
    contestants = [load_contestant(name, action_type, **settings, map_name=DEFAULT_MAP) for name in names]
    trained_on = {entry.map_name for entry in contestants if entry.map_name}
    if len(trained_on) > 1 and not maps:
        raise ConfigError("the models were trained on different maps; say with --map on which to compare them.")
    robot = from_mapping(RobotConfig, settings.get("robot"))
    for pool in [load_floor_plans(name, robot.radius) for name in maps or next(iter(trained_on), (DEFAULT_MAP,))]:
        for entry in contestants:
            settings["action_type"] = entry.action_type
            yield evaluate(entry.policy, agent=entry.name, seeds=seeds, map_name=pool, **settings, **options)

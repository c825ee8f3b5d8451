"""Evaluate agents side by side: scripted ones by name, trained ones by the file of their model."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from agents.registry import agent_names, make_agent
from cyclic_env.config import ActionType, noise_from_name
from cyclic_env.errors import ConfigError, unknown_name
from cyclic_env.evaluation import Evaluation, Policy, evaluate
from cyclic_env.floor_plans import load_floor_plan
from cyclic_env.vector_env import CyclicLoopVectorEnv

DEFAULT_MAP = "killian_court"
LEARNING = ("stable_baselines3", "torch")
"""Packages of the extra ``train``."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Contestant:
    """An agent that takes part in a comparison."""

    name: str
    policy: Policy
    action_type: ActionType
    map_name: tuple[str, ...]
    """What it was trained on; empty for an agent that was not."""


def contestant(name: str, action_type: ActionType | None = None) -> Contestant:
    """Return the scripted agent of that name, or the model in that file or folder.

    Parameters
    ----------
    name : str
    action_type : str, optional
        By default that which the model was trained with, or ``"wheels"``.

    Raises
    ------
    ConfigError
        If there is no such agent or file, the file is no model, or the model was trained with other actions.
    """
    if name in agent_names():
        action_type = action_type or "wheels"
        return Contestant(
            name=name, policy=make_agent(name, action_type=action_type), action_type=action_type, map_name=()
        )
    path = Path(name)
    if not path.exists():
        if path.suffix == ".zip" or len(path.parts) > 1:
            raise ConfigError(f"there is no model file {name}.")
        raise ConfigError(unknown_name("agent", name, agent_names()) + " Or give the file of a model.")
    require_learning()
    from agents.training import check_fits, load_trained

    trained = load_trained(path)
    its_type = trained.settings.action_type if trained.settings else None
    if action_type and its_type and action_type != its_type:
        raise ConfigError(f"{name} was trained with action type {its_type!r}, not {action_type!r}.")
    action_type = action_type or its_type or "wheels"
    trial = CyclicLoopVectorEnv(1, "ring", action_type=action_type)
    check_fits(path, trained.model, trial)
    trial.close()
    map_name = trained.settings.map_name if trained.settings else ()
    return Contestant(name=name, policy=trained.model, action_type=action_type, map_name=map_name)


def compare(
    names: Sequence[str],
    *,
    maps: Sequence[str] = (),
    noise: str = "ideal",
    seeds: Iterable[int] = range(10),
    action_type: ActionType | None = None,
    step_budget: int | None = None,
    num_envs: int | None = None,
    deterministic: bool = True,
    progress: bool = False,
) -> list[Evaluation]:
    """Evaluate several agents on the same maps with the same seeds; Ctrl-C ends it early and keeps what is done.

    Parameters
    ----------
    names : sequence of str
        As `contestant` takes them.
    maps : sequence of str
        By default what the models among the agents were trained on; without models, Killian Court.
    noise, seeds, step_budget, num_envs, deterministic, progress
        As for `cyclic_env.evaluation.evaluate`.
    action_type : str, optional
        As for `contestant`.

    Raises
    ------
    ConfigError, FloorPlanError
        Before anything is run, if any of the arguments doesn't fit.
    """
    noise_from_name(noise)
    contestants = [contestant(name, action_type) for name in names]
    trained_on = {entry.map_name for entry in contestants if entry.map_name}
    if not maps:
        if len(trained_on) > 1:
            raise ConfigError("the models were trained on different maps; say with --map on which to compare them.")
        maps = next(iter(trained_on), (DEFAULT_MAP,))
    for map_name in maps:
        load_floor_plan(map_name)
    seeds = list(seeds)
    evaluations: list[Evaluation] = []
    for map_name in maps:
        for entry in contestants:
            evaluation = evaluate(
                entry.policy,
                agent=entry.name,
                seeds=seeds,
                map_name=map_name,
                noise=noise,
                num_envs=num_envs,
                deterministic=deterministic,
                progress=progress,
                action_type=entry.action_type,
                step_budget=step_budget,
            )
            evaluations.append(evaluation)
            if not evaluation.complete:
                return evaluations
    return evaluations


def require_learning() -> None:
    """Check that the packages for learned agents are installed.

    Raises
    ------
    ConfigError
        If they aren't; the message says how to install them.
    """
    try:
        for package in LEARNING:
            __import__(package)
    except ModuleNotFoundError as error:
        if error.name in LEARNING:
            raise ConfigError(
                f'{error.name} is missing, and learned agents need it: pip install -e ".[train]" in the checkout.'
            ) from error
        raise

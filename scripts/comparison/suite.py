"""Suites, which say what is compared: runs of agents on maps, in tiers, with seeds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from itertools import product

from agents import agent_names, privileged_names
from cyclic_env.errors import ConfigError
from cyclic_env.floor_plans import load_floor_plans
from cyclic_env.tiers import TIERS
from cyclic_env.validation import check_choice

REFERENCE = "knn"
"""The agent that the others are compared with."""


@dataclass(frozen=True, slots=True, kw_only=True, order=True)
class Job:
    """One run: an agent on a map, in a tier, with a seed. Every agent gets the same maps, tiers and seeds."""

    tier: str
    map: str
    seed: int
    start: str
    """``plan`` (the plan's own) or ``random`` (drawn by the seed)."""
    agent: str

    @property
    def key(self) -> tuple[str, ...]:
        """The values that identify the run, as text."""
        return tuple(str(getattr(self, name)) for name in KEY)

    @property
    def privileged(self) -> bool:
        """Whether the agent sees the truth, so that it is never ranked."""
        return self.agent in privileged_names()


KEY = tuple(entry.name for entry in fields(Job))
"""The columns of the table that identify the run of a row."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Suite:
    """A named set of runs."""

    agents: tuple[str, ...]
    maps: tuple[str, ...]
    tiers: tuple[str, ...]
    seeds: int


def _first(split: str, count: int) -> tuple[str, ...]:
    return tuple(f"generated:{split},index={index}" for index in range(count))


ALL_PLANS = ("chamfered", "dead_ends", "figure_eight", "grid", "killian_court", "mirror_halls", "office", "ring")
SUITES = {
    "default": Suite(
        agents=("knn", "knn_paper", "frontier", "frontier_loops", "circling", "oracle"),
        maps=("figure_eight", "twin_rings", "office", "killian_court", *_first("validation", 12)),
        tiers=("calibrated", "typical", "hard"),
        seeds=2,
    ),
    "report": Suite(
        agents=tuple(name for name in agent_names() if not name.endswith("+claims") and name != "watcher"),
        maps=(*ALL_PLANS, "twin_rings", *_first("test", 32), *_first("hard_test", 32)),
        tiers=("calibrated", "typical", "hard"),
        seeds=3,
    ),
}
"""``default`` takes about an hour on two cores; ``report`` takes days, and may be interrupted and resumed."""


def jobs_of(suite: Suite, *, start: str = "random") -> list[Job]:
    """Return the runs of a suite, in an order in which all agents soon have some.

    Raises
    ------
    ConfigError, FloorPlanError
        If a tier or a map is unknown, or there are none.
    """
    if not suite.agents or not suite.maps or not suite.tiers or suite.seeds < 1:
        raise ConfigError("there is nothing to compare: give at least one agent, one map, one tier and one seed.")
    for tier in suite.tiers:
        check_choice("tier", tier, TIERS)
    maps = _names_of(suite.maps)
    return [
        Job(tier=tier, map=map_name, seed=seed, start=start, agent=agent)
        for seed, map_name, tier, agent in product(range(suite.seeds), maps, suite.tiers, dict.fromkeys(suite.agents))
    ]


def _names_of(maps: Sequence[str]) -> list[str]:
    """Return the names of single maps; a split stands for all of its buildings."""
    return list(dict.fromkeys(name for given in maps for name in _plans_of(given)))


def _plans_of(name: str) -> list[str]:
    pool = load_floor_plans(name)
    return pool.names if len(pool) > 1 else [name]

"""The kernels' arguments: the buildings that all robots share, and the state of each robot's episode."""

from __future__ import annotations

import math
from pathlib import Path
from typing import NamedTuple

import gymnasium
import numpy as np

from cyclic_env.config import STEP_BUDGET_MAX, EnvConfig
from cyclic_env.errors import ConfigError
from cyclic_env.floor_plans import FloorPlan
from cyclic_env.floor_plans.library import maps_folder
from cyclic_env.simulation.lidar import Beams, laser_beams
from cyclic_env.simulation.physics import Simulation
from cyclic_env.simulation.sensors import Sensors
from cyclic_env.simulation.wall_index import WallIndex, build_wall_index, join_wall_indices
from cyclic_env.task.coverage import CoverageGrid, build_coverage_grid, joined_coverage_grid, visible_share
from cyclic_env.task.loop_closure import ClosureRules, closure_rules
from cyclic_env.task.path_history import ClosureMemory, allocate_memory, joined_memory
from cyclic_env.task.rewards import REWARD_TERMS, reward_weights

BUDGET_LAPS = 3.0
CORRIDOR_WIDTH = 2.0
"""The step budget is enough to drive this many times through corridors of this width (metres) with the plan's area."""

INFO = np.dtype(
    [
        ("is_success", "?"),
        ("coverage", "f8"),
        ("cycles_closed", "i8"),
        ("cycles_total", "i8"),
        ("revisit", "?"),
        ("claim_judged", "?"),
        ("claim_correct", "?"),
        ("claim_error_m", "f8"),
        ("claims", "i8"),
        ("false_claims", "i8"),
        ("revisits", "i8"),
        ("revisits_recognised", "i8"),
        ("precision", "f8"),
        ("recall", "f8"),
        ("new_cycle", "?"),
        ("collisions", "i8"),
        ("path_length_m", "f8"),
        ("x", "f8"),
        ("y", "f8"),
        ("heading", "f8"),
    ]
)
"""The scalars of an info, one record per robot; its `reward_terms` are stored separately."""

OUTCOME = np.dtype(
    [
        ("reward", "f8"),
        ("terminated", "?"),
        ("truncated", "?"),
        ("contact", "?"),
        ("cells_seen", "i8"),
        ("cells_paid", "i8"),  # seen cells that the reward has already paid for
        ("episode_return", "f8"),  # sum of the rewards since the reset
    ]
)
"""The result of a robot's last step."""


def step_budget(plan: FloorPlan, config: EnvConfig) -> int:
    """Return after how many steps an episode in the plan is truncated.

    Raises
    ------
    ConfigError
        If the default exceeds `STEP_BUDGET_MAX`.
    """
    if config.step_budget is not None:
        return config.step_budget
    steps = BUDGET_LAPS * plan.free_area / CORRIDOR_WIDTH / config.robot.advance_max
    if steps > STEP_BUDGET_MAX:
        raise ConfigError(
            f"floor plan {plan.name!r} is so large that its step budget exceeds {STEP_BUDGET_MAX}; set step_budget."
        )
    return math.ceil(steps)


class Buildings(NamedTuple):
    """The settings of the task and the P plans in use, which all robots share."""

    walls: WallIndex
    beams: Beams
    scan_spacing: float
    coverage_complete: float
    rules: ClosureRules
    weights: np.ndarray
    step_budget: np.ndarray
    terminate_on_collision: bool


class Episodes(NamedTuple):
    """The state of the episodes of N robots."""

    plan_of: np.ndarray
    drive: np.ndarray
    true_ranges: np.ndarray
    scratch: np.ndarray
    grid: CoverageGrid
    memory: ClosureMemory
    info: np.ndarray
    terms: np.ndarray
    outcome: np.ndarray


def make_buildings(plan: FloorPlan, config: EnvConfig) -> Buildings:
    """Return the buildings when one plan is in use."""
    warn_of_hidden_cells(plan, config)
    budget = np.array([step_budget(plan, config)], np.int64)
    return Buildings(
        walls=build_wall_index(plan, config.laser.range_max),
        beams=laser_beams(config.laser),
        scan_spacing=config.coverage.scan_spacing,
        coverage_complete=config.coverage.complete,
        rules=closure_rules(config.closure),
        weights=reward_weights(config.reward, np.array([plan.cycles_total]), budget),
        step_budget=budget,
        terminate_on_collision=config.terminate_on_collision,
    )


def warn_of_hidden_cells(plan: FloorPlan, config: EnvConfig) -> None:
    """Warn if too much of a plan from a file can't be seen; shipped and generated plans are made to be seen."""
    complete = config.coverage.complete
    if not plan.file or Path(plan.file).parent == maps_folder():
        return
    share = visible_share(plan, config.robot.radius, config.laser.range_max, config.coverage)
    if share < complete:
        gymnasium.logger.warn(
            "%s",  # Gymnasium formats its first argument
            f"{plan.file}: {1 - share:.1%} of the free cells can't be seen from any position that the robot can reach, "
            f"but {complete:.0%} must be seen for success. Close these parts off, or lower the setting `complete`.",
        )


def make_episodes(plan: FloorPlan, config: EnvConfig, simulation: Simulation, sensors: Sensors) -> Episodes:
    """Allocate the episodes of all robots of the simulation in one plan."""
    num_robots = len(simulation.drive)
    return Episodes(
        plan_of=simulation.plan_of,
        drive=simulation.drive,
        true_ranges=sensors.true_ranges,
        scratch=np.empty((num_robots, 2 * config.laser.num_beams)),
        grid=build_coverage_grid(plan, num_robots, config.coverage),
        memory=allocate_memory(plan, num_robots, step_budget(plan, config), config.closure),
        info=np.zeros(num_robots, INFO),
        terms=np.zeros((num_robots, len(REWARD_TERMS))),
        outcome=np.zeros(num_robots, OUTCOME),
    )


def add_plan(
    buildings: Buildings, episodes: Episodes, plan: FloorPlan, config: EnvConfig
) -> tuple[Buildings, Episodes]:
    """Return the buildings with one more plan in use, and the running episodes with arrays that have room for it."""
    other, num_robots = make_buildings(plan, config), len(episodes.info)
    cells = build_coverage_grid(plan, num_robots, config.coverage)
    memory = allocate_memory(plan, num_robots, int(other.step_budget[0]), config.closure)
    buildings = buildings._replace(
        walls=join_wall_indices(buildings.walls, other.walls),
        weights=np.concatenate([buildings.weights, other.weights]),
        step_budget=np.concatenate([buildings.step_budget, other.step_budget]),
    )
    episodes = episodes._replace(
        grid=joined_coverage_grid(episodes.grid, cells), memory=joined_memory(episodes.memory, memory)
    )
    return buildings, episodes

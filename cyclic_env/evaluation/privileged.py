"""What no honest agent may see: the plan, where the robots truly are, and whether they are back somewhere.

It is for upper bounds in comparisons, which are marked as privileged and never ranked.
"""

from __future__ import annotations

import math
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import VectorEnv

from cyclic_env.config import CoverageConfig, EnvConfig, LaserConfig
from cyclic_env.envs.cyclic_loop import CyclicLoopEnv
from cyclic_env.envs.vector import CyclicLoopVectorEnv
from cyclic_env.errors import ConfigError
from cyclic_env.floor_plans import FloorPlan
from cyclic_env.jit import compiled
from cyclic_env.simulation.lidar import laser_beams, scan_row
from cyclic_env.simulation.wall_index import build_wall_index
from cyclic_env.task.coverage import build_coverage_grid, mark_scan
from cyclic_env.task.loop_closure import find_return
from cyclic_env.task.path_history import building_view, robot_view
from cyclic_env.validation import short_repr


class PrivilegedView:
    """The truth about the running episodes of an environment.

    Parameters
    ----------
    env : CyclicLoopEnv or CyclicLoopVectorEnv
        Perhaps wrapped.

    Raises
    ------
    ConfigError
        If it is no environment of ours.
    """

    def __init__(self, env: gymnasium.Env[Any, Any] | VectorEnv[Any, Any, Any] | None) -> None:
        inner = getattr(env, "unwrapped", None)
        if not isinstance(inner, CyclicLoopEnv | CyclicLoopVectorEnv):
            raise ConfigError(f"the env is {short_repr(env)}; a privileged agent needs the environment to drive in.")
        self._engine = inner.engine

    @property
    def config(self) -> EnvConfig:
        """The settings of the environment."""
        return self._engine.config

    def floor_plan(self, row: int = 0) -> FloorPlan:
        """Return the building that a robot is in."""
        return self._engine.plan(row)

    def pose(self, row: int = 0) -> np.ndarray:
        """Return where a robot is: x, y, heading `(3,)`, metres and radians."""
        info = self._engine.info[row]
        return np.array([info["x"], info["y"], info["heading"]])

    def steps(self, row: int = 0) -> int:
        """Return how many steps a robot has taken since its reset."""
        return int(self._engine.steps[row])

    def returned_step(self, row: int = 0, within: float = math.inf) -> int | None:
        """Return the nearest step that a robot returns to now, by the definition of a return, if it is near enough.

        Parameters
        ----------
        row : int
        within : float
            Metres; a return is never farther than its radius.
        """
        engine = self._engine
        step = int(nearest_return(engine.episodes, engine.buildings.rules, row))
        if step < 0:
            return None
        x, y, _ = self.pose(row)
        there = engine.episodes.memory.track[row, step]
        return step if math.hypot(there[0] - x, there[1] - y) <= within else None

    def survey(self, row: int = 0) -> Survey:
        """Return a survey of the building that a robot is in, with nothing seen yet."""
        return Survey(self.floor_plan(row), self.config.laser, self.config.coverage)


@compiled
def nearest_return(episodes, rules, row):
    """Return the nearest step that the last step of a row returns to; -1 for none."""
    memory = episodes.memory
    robot, building = robot_view(memory, row), building_view(memory, episodes.plan_of[row])
    return find_return(robot, building, rules, True)


class Survey:
    """What scans from poses of one's choice would see of a building, counted as coverage is.

    Parameters
    ----------
    plan : FloorPlan
    laser : LaserConfig
    coverage : CoverageConfig
    """

    def __init__(self, plan: FloorPlan, laser: LaserConfig, coverage: CoverageConfig) -> None:
        self._grid = build_coverage_grid(plan, 1, coverage)
        self._walls = build_wall_index(plan, laser.range_max)
        self._beams = laser_beams(laser)
        self._scratch, self._ranges = np.empty(2 * laser.num_beams), np.empty(laser.num_beams)

    def look(self, poses: np.ndarray) -> int:
        """Mark the cells that scans from the poses `(n, 3)` see, and return how many are new."""
        return look_from(self._walls, self._grid, poses, self._beams, self._scratch, self._ranges)

    @property
    def num_cells(self) -> int:
        """Number of the free cells."""
        return self._grid.seen.shape[1]

    @property
    def seen(self) -> np.ndarray:
        """Which free cells have been seen, `(num_cells,)` bool, row by row from the south-west."""
        return self._grid.seen[0]

    @property
    def share(self) -> float:
        """Share of the free cells that have been seen."""
        return float(self._grid.seen[0].mean())

    @property
    def cells(self) -> np.ndarray:
        """Where the free cells are, `(num_cells,)` flat indices into rows, south first, of `extent`."""
        return np.flatnonzero(self._grid.number >= 0)

    @property
    def extent(self) -> tuple[float, float, int, int]:
        """West and south of the cells, metres, and how many columns and rows there are."""
        grid = self._grid.grids[0]
        return float(grid["west"]), float(grid["south"]), int(grid["columns"]), int(grid["rows"])

    def unseen(self) -> np.ndarray:
        """Return the centres `(n, 2)` of the cells that have not been seen, metres."""
        grid, size = self._grid.grids[0], self._grid.cell_size
        numbers = self._grid.number
        cells = np.flatnonzero((numbers >= 0) & ~self._grid.seen[0][numbers])
        centres = np.column_stack([cells % grid["columns"], cells // grid["columns"]]) + 0.5
        return centres * size + np.array([grid["west"], grid["south"]])


@compiled
def look_from(walls, grid, poses, beams, scratch, ranges):
    """Mark the cells that scans from `poses` (n, 3) see; return how many are new."""
    new = 0
    for i in range(poses.shape[0]):
        pose = (poses[i, 0], poses[i, 1], poses[i, 2])
        scan_row(walls, 0, pose, beams, scratch, ranges)
        new += mark_scan(grid, 0, 0, pose, beams, ranges)
    return new

"""One step of N robots: decode, drive, measure, judge.

This is the only implementation of the environment: `CyclicLoopEnv` shows it to Gymnasium for one robot, and
`CyclicLoopVectorEnv` for many. A row of it is bit-equal to a single robot: robots pass through each other, each draws
from a generator of its own, and no arithmetic goes across rows.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import Any, ClassVar

import numpy as np
import shapely

from cyclic_env.config import DISTANCE_MAX, EnvConfig
from cyclic_env.engine.actions import check_actions, decode_actions
from cyclic_env.engine.building import add_plan, make_buildings, make_episodes, step_budget
from cyclic_env.engine.kernels import begin_episode, wrap_angle
from cyclic_env.engine.packed import Packed, judge_packed_rows, pack
from cyclic_env.engine.stage_timer import NoTimer
from cyclic_env.errors import ConfigError, FloorPlanError, UsageError
from cyclic_env.floor_plans import FloorPlan, PlanPool
from cyclic_env.floor_plans.floor_plan import Pose
from cyclic_env.jit import compile_notice, num_cores
from cyclic_env.simulation.physics import Simulation, World
from cyclic_env.simulation.sensors import Sensors
from cyclic_env.task.coverage import seen_cells
from cyclic_env.task.loop_closure import NO_CLAIM
from cyclic_env.validation import as_array, is_integer, short_repr

Share = tuple[list[World], np.ndarray]
"""The part of the work that one thread does: some of the Spaces, and the rows of the robots in them."""


class Engine:
    """N robots in the buildings of a pool, stepped together.

    The pool's first plan is prepared at once, and every other one when a robot first draws it. Prepared plans are
    numbered in this order.

    Parameters
    ----------
    config : EnvConfig
    plans : PlanPool
    num_robots : int
    num_threads : int, optional
        By default one for each core that the process may use.

    Raises
    ------
    ConfigError
        If there is not enough memory for so many robots and steps.
    FloorPlanError
        If a loaded plan does not suit the robot, or the pool's first plan does not suit the cells. Everything else is
        checked by the reset that draws the plan.

    Attributes
    ----------
    info : (N,) array of `INFO`
    terms : (N, 6) float64
        Terms of the last step's reward, in the order of `REWARD_TERMS`.
    outcome : (N,) array of `OUTCOME`
    """

    _warm: ClassVar[bool] = False
    """Whether this process has stepped an engine, so that its kernels are compiled."""

    def __init__(self, config: EnvConfig, plans: PlanPool, num_robots: int, num_threads: int | None = None) -> None:
        self.config = config
        self.plans = plans
        self.num_robots = num_robots
        self.timer = NoTimer()
        self._num_threads = num_threads or num_cores()
        self._reachable: dict[int, shapely.Polygon] = {}  # by the plans' indices in the pool
        for index, plan in plans.loaded.items():
            step_budget(plan, config)
            self._reachable_area(index)
        self._reachable_area(0)
        self._numbers = {0: 0}  # numbers of the prepared plans, by their indices in the pool
        first = plans[0]
        self.buildings = make_buildings(first, config)
        with self._enough_memory(first):
            self.simulation = Simulation(config.robot, (first,), num_robots)
            self.sensors = Sensors(config.sensor_noise, config.laser, num_robots)
            self.episodes = make_episodes(first, config, self.simulation, self.sensors)
            self._commands = np.zeros((num_robots, 2))
            self._claimed = np.full(num_robots, NO_CLAIM, np.int64)
        self.info, self.terms, self.outcome = self.episodes.info, self.episodes.terms, self.episodes.outcome
        self._packed: Packed | None = None
        self._not_placed = set(range(num_robots))
        self._shares: list[Share] = []
        self._threads: ThreadPoolExecutor | None = None
        self._threads_of = 0

    def _reachable_area(self, index: int) -> shapely.Polygon:
        """Return the area that the robot can reach in a plan of the pool, and raise if the plan does not suit it."""
        if index not in self._reachable:
            area = self.plans[index].reachable(self.config.robot.radius)
            shapely.prepare(area)
            self._reachable[index] = area
        return self._reachable[index]

    @contextmanager
    def _enough_memory(self, plan: FloorPlan) -> Iterator[None]:
        try:
            yield
        except (MemoryError, OSError) as error:
            raise ConfigError(
                f"there is not enough memory for num_envs {self.num_robots} and paths of "
                f"{step_budget(plan, self.config)} steps; lower num_envs or step_budget."
            ) from error

    @property
    def is_prepared(self) -> bool:
        """Whether all plans of the pool are prepared, so that no reset can meet an unsuitable one."""
        return len(self._numbers) == len(self.plans)

    def _prepare(self, index: int) -> int:
        """Return the number of a plan of the pool, and prepare the plan if it is new."""
        if index not in self._numbers:
            plan = self.plans[index]
            self._reachable_area(index)
            with self._enough_memory(plan):
                self.buildings, self.episodes = add_plan(self.buildings, self.episodes, plan, self.config)
            self._packed = None
            self.simulation.plans = (*self.simulation.plans, plan)
            self._numbers[index] = len(self._numbers)
        return self._numbers[index]

    def reset_row(self, row: int, rng: np.random.Generator, start: Any = None) -> None:
        """Begin an episode of one robot, whose plan, start and sensor errors are drawn from `rng`.

        Parameters
        ----------
        row : int
        rng : Generator
        start : (x, y, heading), optional
            Metres and radians; by default the plan's own, or a random one with `random_start`.

        Raises
        ------
        FloorPlanError
            If the robot can't stand at `start`, or the plan does not suit it; the running episode goes on.
        """
        plan, pose = self.draw_start(rng, start)
        self.simulation.place(row, plan, pose)
        self._shares = []
        self.sensors.reset_row(row, rng)
        with self._compiling():
            begin_episode(self.buildings, self.episodes, row, pose)
        self._not_placed.discard(row)

    def draw_start(self, rng: np.random.Generator, start: Any = None) -> tuple[int, Pose]:
        """Draw a plan and a start in it, and return the plan's number and the pose; see `reset_row`."""
        index = int(rng.integers(len(self.plans))) if len(self.plans) > 1 else 0
        number = self._prepare(index)
        if start is not None:
            x, y, heading = self._check_start(index, start)
        elif self.config.random_start:
            x, y, heading = self._random_start(index, rng)
        else:
            x, y, heading = self.plans[index].start
        return number, (x, y, wrap_angle(math.remainder(heading, 2 * math.pi)))  # exact even for huge headings

    def _check_start(self, index: int, start: Any) -> Pose:
        expected = "(x, y, heading) in metres and radians, all finite"
        pose = as_array(start, "start", expected, FloorPlanError).astype(np.float64)
        if pose.shape != (3,) or not np.isfinite(pose).all():
            raise FloorPlanError(f"start is {short_repr(start)}; expected {expected}.")
        x, y, heading = pose.tolist()
        if not shapely.intersects_xy(self._reachable[index], x, y):
            self.plans[index].reachable(self.config.robot.radius, (x, y))  # raises, with the reason
        return x, y, heading

    def _random_start(self, index: int, rng: np.random.Generator) -> Pose:
        area = self._reachable[index]
        west, south, east, north = area.bounds
        for _ in range(10_000):
            points = rng.uniform((west, south), (east, north), (64, 2))
            inside = np.flatnonzero(shapely.contains_xy(area, points[:, 0], points[:, 1]))
            if len(inside):
                x, y = points[inside[0]]
                return float(x), float(y), float(rng.uniform(-math.pi, math.pi))
        raise FloorPlanError(f"floor plan {self.plans[index].name!r}: found no random start; give a start.")

    def step(self, actions: Any, rngs: Sequence[np.random.Generator], skip: np.ndarray | None = None) -> None:
        """Step all robots; afterwards `info`, `terms`, `outcome` and the readings are up to date.

        Parameters
        ----------
        actions : (N, ...) array
            From the action space of the configured type.
        rngs : sequence of N Generators
        skip : (N,) bool, optional
            Robots that are about to be reset: they draw no random numbers, and only their poses may change.

        Raises
        ------
        ActionError
            If the actions have the wrong shape or type, or those of robots that are not skipped hold a NaN.
        UsageError
            If a robot has not begun an episode.
        """
        if self._not_placed:
            raise UsageError("there is no episode yet: call reset() first.")
        self.timer.start()
        self._decode(actions, skip)
        self.timer.lap("actions")
        shares = self._divide_work(skip)
        with self._compiling():
            if self._packed is None:
                self._packed = pack(self.buildings, self.episodes)
            self._run(shares, rngs)
        Engine._warm = True

    def _decode(self, actions: Any, skip: np.ndarray | None) -> None:
        """Turn actions into wheel speeds and claimed steps; skipped robots stand still."""
        config = self.config
        checked = check_actions(actions, config.action_type, self.num_robots)
        if skip is not None:
            checked[skip] = 0
        status = self.episodes.memory.status
        decode_actions(checked, config.action_type, config.robot, status, self._commands, self._claimed)

    def _divide_work(self, skip: np.ndarray | None) -> list[Share]:
        """Divide the Spaces, and the robots in them that are not skipped, among the threads."""
        if not self._shares:
            worlds = self.simulation.worlds
            count = min(len(worlds), self._num_threads)
            parts = [worlds[i::count] for i in range(count)]
            self._shares = [(part, np.sort(np.concatenate([world.bodies.rows for world in part]))) for part in parts]
        if skip is None:
            return self._shares
        return [(worlds, rows[~skip[rows]]) for worlds, rows in self._shares]

    def _run(self, shares: list[Share], rngs: Sequence[np.random.Generator]) -> None:
        """Do the first share of a step in this thread, and each of the others in one of the pool."""
        first, *others = shares
        if others and (self._threads is None or self._threads_of != os.getpid()):  # a forked process has no threads
            self._threads = ThreadPoolExecutor(len(others), thread_name_prefix="cyclic_env")
            self._threads_of = os.getpid()
        pending = [self._threads.submit(self._step_share, *share, rngs) for share in others] if self._threads else []
        self._step_share(*first, rngs)
        for future in pending:
            future.result()

    def _step_share(self, worlds: list[World], rows: np.ndarray, rngs: Sequence[np.random.Generator]) -> None:
        for world in worlds:
            self.simulation.drive_world(world, self._commands)
        self.timer.lap("drive")
        judge_packed_rows(self._packed, rows, self._claimed)
        self.timer.lap("judge")
        self.measure(rows, rngs)
        self.timer.lap("sensors")

    def measure(self, rows: np.ndarray, rngs: Sequence[np.random.Generator]) -> None:
        """Take the sensors' readings of the robots `rows`."""
        self.sensors.measure_rows(rows, self.simulation.drive, rngs)

    def observation(self) -> dict[str, np.ndarray]:
        """Return the last readings, new float32 arrays: laser `(N, num_beams)`, distance `(N, 1)`, compass `(N, 2)`."""
        self.timer.start()
        observation = {
            "laser": self.sensors.ranges.astype(np.float32),
            "distance": np.clip(self.sensors.distance[:, None], -DISTANCE_MAX, DISTANCE_MAX).astype(np.float32),
            "compass": self.sensors.compass.astype(np.float32),
        }
        self.timer.lap("observation")
        return observation

    def _compiling(self) -> AbstractContextManager[None]:
        return nullcontext() if Engine._warm else compile_notice()

    def plan(self, row: int) -> FloorPlan:
        """Return the floor plan in which a robot is.

        Raises
        ------
        UsageError
            If there is no such robot, or it has yet to draw its plan from a pool.
        """
        self._check_row(row)
        if len(self.plans) == 1:
            return self.plans[0]
        self.check_placed(row)
        return self.simulation.plans[self.simulation.plan_of[row]]

    def step_budget(self, row: int) -> int:
        """Return after how many steps a robot's episode is truncated."""
        return step_budget(self.plan(row), self.config)

    @property
    def steps(self) -> np.ndarray:
        """Steps of each robot since its reset, `(N,)` int64."""
        return self.episodes.memory.status["steps"]

    def trajectory(self, row: int) -> np.ndarray:
        """Return the true path of a robot since its reset, `(t + 1, 3)`: x, y and path length, metres."""
        self.check_placed(row)
        return self.episodes.memory.track[row, : self.steps[row] + 1].copy()

    def claims(self, row: int) -> np.ndarray:
        """Return the judged claims of a robot since its reset, in order: an `(n,)` array of `CLAIM`.

        They were made at ``trajectory(row)[claims["step"]]``, and named ``trajectory(row)[claims["match"]]`` unless
        the match is -1.
        """
        self.check_placed(row)
        memory = self.episodes.memory
        return memory.claims[row, : memory.status["claims"][row]].copy()

    def seen_cells(self, row: int) -> np.ndarray:
        """Return what a robot has seen of its plan; see `cyclic_env.task.coverage.seen_cells`."""
        self.check_placed(row)
        return seen_cells(self.episodes.grid, row, int(self.simulation.plan_of[row]))

    def check_placed(self, row: int) -> None:
        """Raise a `UsageError` unless there is a robot of that number, and it has begun an episode."""
        self._check_row(row)
        if row in self._not_placed:
            raise UsageError("there is no episode yet: call reset() first.")

    def _check_row(self, row: int) -> None:
        if not is_integer(row) or not 0 <= row < self.num_robots:
            raise UsageError(f"row is {short_repr(row)}; expected a whole number from 0 to {self.num_robots - 1}.")

    def close(self) -> None:
        """End the threads."""
        if self._threads is not None:
            self._threads.shutdown()
            self._threads = None

    def __getstate__(self) -> dict[str, Any]:
        # Spaces, threads and packed arguments belong to a process and are made again when needed.
        return {**self.__dict__, "_shares": [], "_threads": None, "_packed": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        # A copied simulation has new arrays, which the episodes must share.
        self.episodes = self.episodes._replace(plan_of=self.simulation.plan_of, drive=self.simulation.drive)

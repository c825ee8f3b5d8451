"""One step of N robots: drive, measure, mark, judge, reward.

This is the only implementation of the environment; `CyclicLoopEnv` is its face for one robot and
`CyclicLoopVectorEnv` the one for many. A row of it is bit-equal to a single robot: robots pass through each
other, each draws from a generator of its own, and no arithmetic goes across rows.
"""

from __future__ import annotations

import inspect
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, TypedDict

import numpy as np
import shapely

from cyclic_env.config import (
    ACTION_TYPES,
    ActionType,
    ClosureConfig,
    CoverageConfig,
    LaserConfig,
    NoiseConfig,
    RewardConfig,
    RobotConfig,
    from_mapping,
    noise_from_name,
)
from cyclic_env.errors import ActionError, ConfigError, FloorPlanError, UsageError
from cyclic_env.floor_plans import FloorPlan, MapName, PlanPool, load_floor_plans
from cyclic_env.floor_plans.floor_plan import Pose
from cyclic_env.jit import compile_notice, compiled
from cyclic_env.simulation.lidar import beam_directions, scan_row
from cyclic_env.simulation.physics import Simulation, World, num_cores
from cyclic_env.simulation.sensors import DISTANCE_MAX, Sensors
from cyclic_env.simulation.wall_index import WallIndex, build_wall_index, join_wall_indices
from cyclic_env.task.coverage import CoverageGrid, build_coverage_grid, joined_coverage_grid, mark_scan, seen_cells
from cyclic_env.task.loop_closure import (
    NEAREST,
    NO_CLAIM,
    ClosureMemory,
    ClosureRules,
    advance,
    allocate_memory,
    begin,
    building_view,
    closure_rules,
    joined_memory,
    judge_claim,
    robot_view,
    settle_event,
)
from cyclic_env.task.rewards import REWARD_TERMS, reward_row, reward_weights
from cyclic_env.validation import as_array, check_choice, is_integer, short_repr, unknown_name

TWIST_OMEGA_MAX = 3.0
"""Turning rate of a full twist action, rad/s."""

SPOT_TURN = 0.15
"""Wheel speed of a discrete turn, as a share of full speed: 0.9 rad/s, 10 degrees a step."""

DISCRETE_WHEELS = np.array([[0.0, 0.0], [1.0, 1.0], [-SPOT_TURN, SPOT_TURN], [SPOT_TURN, -SPOT_TURN], [-1.0, -1.0]])
"""Wheel speeds, as shares of full speed, of the discrete drives: stop, forward, left, right, back."""

BUDGET_LAPS = 3.0
CORRIDOR_WIDTH = 2.0
"""The step budget is enough to drive this many times through corridors of this width (metres) with the plan's area."""

STEP_BUDGET_MAX = 10_000_000
NUM_ROBOTS_MAX = 1_000_000

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
"""The flat part of an info, one record a robot; `reward_terms` comes beside it."""

OUTCOME = np.dtype(
    [
        ("reward", "f8"),
        ("terminated", "?"),
        ("truncated", "?"),
        ("contact", "?"),
        ("cells_seen", "i8"),
        ("cells_paid", "i8"),  # those of them that the reward has paid for
        ("episode_return", "f8"),  # sum of the rewards since the reset
    ]
)
"""What a step brought."""


@dataclass(frozen=True, kw_only=True)
class EngineConfig:
    """All settings of an environment, checked; made by `engine_config` from an environment's arguments."""

    plans: PlanPool
    action_type: ActionType
    random_start: bool
    terminate_on_collision: bool
    step_budget: int | None
    robot: RobotConfig
    laser: LaserConfig
    noise: NoiseConfig
    closure: ClosureConfig
    coverage: CoverageConfig
    reward: RewardConfig

    def step_budget_of(self, plan: FloorPlan) -> int:
        """Return after how many steps an episode in `plan` is truncated.

        Raises
        ------
        ConfigError
            If there would be too many.
        """
        if self.step_budget is not None:
            return self.step_budget
        steps = BUDGET_LAPS * plan.free_area / CORRIDOR_WIDTH / self.robot.advance_max
        if steps > STEP_BUDGET_MAX:
            raise ConfigError(
                f"floor plan {plan.name!r} is so large that its step budget exceeds {STEP_BUDGET_MAX}; give one."
            )
        return math.ceil(steps)


class Settings(TypedDict, total=False):
    """What an environment can be told beside its map; see `CyclicLoopEnv`."""

    noise: str | NoiseConfig | Mapping[str, Any]
    action_type: ActionType
    random_start: bool
    terminate_on_collision: bool
    step_budget: int | None
    robot: RobotConfig | Mapping[str, Any] | None
    laser: LaserConfig | Mapping[str, Any] | None
    closure: ClosureConfig | Mapping[str, Any] | None
    coverage: CoverageConfig | Mapping[str, Any] | None
    reward: RewardConfig | Mapping[str, Any] | None


def engine_config(
    *,
    map_name: MapName | Sequence[MapName] = "killian_court",
    noise: str | NoiseConfig | Mapping[str, Any] = "ideal",
    action_type: ActionType = "wheels",
    random_start: bool = False,
    terminate_on_collision: bool = False,
    step_budget: int | None = None,
    robot: RobotConfig | Mapping[str, Any] | None = None,
    laser: LaserConfig | Mapping[str, Any] | None = None,
    closure: ClosureConfig | Mapping[str, Any] | None = None,
    coverage: CoverageConfig | Mapping[str, Any] | None = None,
    reward: RewardConfig | Mapping[str, Any] | None = None,
    **unknown: Any,
) -> EngineConfig:
    """Check the arguments that both environments take, and load their floor plans, but those of splits.

    Raises
    ------
    ConfigError, FloorPlanError
        One line that says what is wrong and what to do.
    """
    for name in unknown:
        known = [name for name in inspect.signature(engine_config).parameters if name != "unknown"]
        raise ConfigError(unknown_name("argument", name, [*known, "render_mode"]))
    for name, value in (("random_start", random_start), ("terminate_on_collision", terminate_on_collision)):
        if not isinstance(value, bool | np.bool_):
            raise ConfigError(f"{name} is {short_repr(value)}; expected True or False.")
    if step_budget is not None and (not is_integer(step_budget) or not 1 <= step_budget <= STEP_BUDGET_MAX):
        raise ConfigError(
            f"step_budget is {short_repr(step_budget)}; expected a whole number from 1 to {STEP_BUDGET_MAX}, or None."
        )
    config = EngineConfig(
        plans=load_floor_plans(map_name),
        action_type=check_choice("action type", action_type, ACTION_TYPES),
        random_start=bool(random_start),
        terminate_on_collision=bool(terminate_on_collision),
        step_budget=None if step_budget is None else int(step_budget),
        robot=from_mapping(RobotConfig, robot),
        laser=from_mapping(LaserConfig, laser),
        noise=tuple(noise_from_name(one) for one in (noise if isinstance(noise, list | tuple) else (noise,))),  # pyright: ignore[reportArgumentType]
        closure=from_mapping(ClosureConfig, closure),
        coverage=from_mapping(CoverageConfig, coverage),
        reward=from_mapping(RewardConfig, reward),
    )
    for plan in config.plans.loaded.values():
        config.step_budget_of(plan)
    return config


class Buildings(NamedTuple):
    """What all robots share, as the compiled code takes it: of P plans in use."""

    tiles: WallIndex
    directions: np.ndarray
    range_max: float
    scan_spacing: float
    coverage_complete: float
    rules: ClosureRules
    weights: np.ndarray
    step_budget: np.ndarray
    terminate_on_collision: bool


class Episodes(NamedTuple):
    """What each of N robots has of its own, as the compiled code takes it."""

    plan_of: np.ndarray
    drive: np.ndarray
    true_ranges: np.ndarray
    scratch: np.ndarray
    grid: CoverageGrid
    memory: ClosureMemory
    info: np.ndarray
    terms: np.ndarray
    outcome: np.ndarray


class Engine:
    """N robots in the buildings of a pool, stepped together.

    A plan is made ready for use when the first robot draws it, and the pool's first one at once. Plans in use have
    numbers of their own, in the order in which they were drawn.

    Parameters
    ----------
    config : EngineConfig
    num_robots : int

    Raises
    ------
    ConfigError
        If there is not enough memory for so many robots and steps.
    FloorPlanError
        If a plan does not suit the robot, or the pool's first one the cells. Those that are yet to be drawn, and the
        cells of the others, are checked by the reset that draws them.

    Attributes
    ----------
    info : (N,) array of `INFO`
    terms : (N, 6) float64
        Terms of the last step's reward, in the order of `REWARD_TERMS`.
    outcome : (N,) array of `OUTCOME`
    """

    _warm: ClassVar[bool] = False
    """Whether this process has stepped an engine, so that its kernels are compiled."""

    def __init__(self, config: EngineConfig, num_robots: int) -> None:
        self.config = config
        self.num_robots = num_robots
        self._reachable: dict[int, shapely.Polygon] = {}  # by the place of the plan in the pool
        for place in config.plans.loaded:
            self._reach(place)
        first = config.plans[0]
        self._reach(0)
        self._numbers = {0: 0}  # of the plans in use, by their places in the pool
        self.buildings = Buildings(
            tiles=build_wall_index(first, config.laser.range_max),
            directions=beam_directions(config.laser),
            range_max=float(config.laser.range_max),
            scan_spacing=float(config.coverage.scan_spacing),
            coverage_complete=float(config.coverage.complete),
            rules=closure_rules(config.closure),
            weights=self._weights(first),
            step_budget=np.array([config.step_budget_of(first)], np.int64),
            terminate_on_collision=config.terminate_on_collision,
        )
        with self._enough_memory(first):
            self.simulation = Simulation(config.robot, (first,), num_robots)
            self.sensors = Sensors(config.noise, config.laser, num_robots)
            self.info = np.zeros(num_robots, INFO)
            self.terms = np.zeros((num_robots, len(REWARD_TERMS)))
            self.outcome = np.zeros(num_robots, OUTCOME)
            self.episodes = Episodes(
                plan_of=self.simulation.plan_of,
                drive=self.simulation.drive,
                true_ranges=self.sensors.true_ranges,
                scratch=np.empty((num_robots, 2 * config.laser.num_beams)),
                grid=build_coverage_grid(first, num_robots, config.coverage),
                memory=self._memory(first),
                info=self.info,
                terms=self.terms,
                outcome=self.outcome,
            )
            self._commands = np.zeros((num_robots, 2))
            self._claimed = np.full(num_robots, NO_CLAIM, np.int64)
        self._shares: list[tuple[list[World], np.ndarray]] = []
        self._threads: ThreadPoolExecutor | None = None
        self._threads_of = 0
        self._ready = bytearray(num_robots)  # 0 before a robot's first reset, and after an interrupted step or reset

    def _reach(self, place: int) -> shapely.Polygon:
        """Return where the robot can get to in the plan at that place in the pool; the plan is checked for it."""
        if place not in self._reachable:
            area = self.config.plans[place].reachable(self.config.robot.radius)
            shapely.prepare(area)
            self._reachable[place] = area
        return self._reachable[place]

    def _weights(self, plan: FloorPlan) -> np.ndarray:
        return reward_weights(
            self.config.reward, np.array([plan.cycles_total]), np.array([self.config.step_budget_of(plan)])
        )

    def _memory(self, plan: FloorPlan) -> ClosureMemory:
        return allocate_memory(plan, self.num_robots, self.config.step_budget_of(plan), self.config.closure)

    @contextmanager
    def _enough_memory(self, plan: FloorPlan) -> Iterator[None]:
        try:
            yield
        except (MemoryError, OSError) as error:
            raise ConfigError(
                f"there is not enough memory for num_envs {self.num_robots} and paths of "
                f"{self.config.step_budget_of(plan)} steps; lower num_envs or step_budget."
            ) from error

    @property
    def is_prepared(self) -> bool:
        """Whether all plans of the pool are ready, so that a reset can't come upon one that does not suit."""
        return len(self._numbers) == len(self.config.plans)

    def _prepare(self, place: int) -> int:
        """Return the number of the plan at that place in the pool; make it ready for use first, if it is new."""
        if place in self._numbers:
            return self._numbers[place]
        config, plan = self.config, self.config.plans[place]
        self._reach(place)
        buildings, episodes = self.buildings, self.episodes
        with self._enough_memory(plan):
            buildings = buildings._replace(
                tiles=join_wall_indices(buildings.tiles, build_wall_index(plan, config.laser.range_max)),
                weights=np.concatenate([buildings.weights, self._weights(plan)]),
                step_budget=np.append(buildings.step_budget, config.step_budget_of(plan)),
            )
            cells = build_coverage_grid(plan, self.num_robots, config.coverage)
            episodes = episodes._replace(
                grid=joined_coverage_grid(episodes.grid, cells),
                memory=joined_memory(episodes.memory, self._memory(plan)),
            )
        plans, numbers = (*self.simulation.plans, plan), {**self._numbers, place: len(self._numbers)}
        # At once, since a Ctrl-C may come between statements, and half of a plan would shift all later ones.
        self.buildings, self.episodes, self.simulation.plans, self._numbers = buildings, episodes, plans, numbers
        return numbers[place]

    def reset_row(self, row: int, rng: np.random.Generator, start: Any = None) -> None:
        """Begin an episode of one robot; draws from `rng` the plan, the start, and the sensors' errors.

        Parameters
        ----------
        row : int
        rng : Generator
        start : (x, y, heading), optional
            Metres and radians; by default the plan's own, or a random one with `random_start`.

        Raises
        ------
        FloorPlanError
            If the robot can't stand at `start`, or the plan does not suit it; its episode goes on.
        """
        plan, (x, y, heading) = self.draw_place(rng, start)
        self._ready[row] = False
        self.simulation.place(row, plan, (x, y, heading))
        self._shares = []
        self.sensors.reset_row(row, rng)
        with self._compiling():
            begin_episode(self.buildings, self.episodes, row, x, y, heading)
        self._ready[row] = True

    def draw_place(self, rng: np.random.Generator, start: Any) -> tuple[int, Pose]:
        """Return a plan's number and the pose with which an episode begins there, as `reset_row` does; see there."""
        plans = self.config.plans
        place = int(rng.integers(len(plans))) if len(plans) > 1 else 0
        plan = self._prepare(place)
        if start is not None:
            x, y, heading = self._checked_start(place, start)
        elif self.config.random_start:
            x, y, heading = self._random_start(place, rng)
        else:
            x, y, heading = plans[place].start
        return plan, (x, y, wrap_angle(math.remainder(heading, 2 * math.pi)))  # exact for the largest headings, too

    def measure(self, rows: np.ndarray, rngs: Sequence[np.random.Generator]) -> None:
        """Take the sensors' readings of the robots `rows`."""
        self.sensors.measure_rows(rows, self.simulation.drive, rngs)

    def step(self, actions: Any, rngs: Sequence[np.random.Generator], skip: np.ndarray | None = None) -> None:
        """Step all robots; afterwards `info`, `terms`, `outcome` and the readings are up to date.

        Parameters
        ----------
        actions : (N, ...) array
            As the action space of the configured type has them.
        rngs : sequence of N Generators
        skip : (N,) bool, optional
            Robots that are about to be reset: they draw nothing, and nothing of theirs changes but where they stand.

        Raises
        ------
        ActionError
            If the actions have the wrong shape or type, or those of robots that are not to be reset hold a NaN.
        UsageError
            If a robot has begun no episode, or its last step or reset was interrupted.
        """
        if 0 in self._ready:
            raise UsageError("there is no episode yet, or its last step was interrupted half-way: call reset() first.")
        self._take_actions(actions, skip)
        if not self._shares:
            self._shares = self._divide()
        shares = self._shares
        if skip is not None:
            shares = [(worlds, rows[~skip[rows]]) for worlds, rows in shares]
        self._ready = bytearray(self.num_robots)
        with self._compiling():
            self._step_shares(shares, rngs)
        self._ready = bytearray(b"\1" * self.num_robots)
        Engine._warm = True

    def _compiling(self) -> AbstractContextManager[None]:
        return nullcontext() if Engine._warm else compile_notice()

    def _step_shares(self, shares: list[tuple[list[World], np.ndarray]], rngs: Sequence[np.random.Generator]) -> None:
        first, *others = shares
        if others and (self._threads is None or self._threads_of != os.getpid()):  # a fork has no threads
            self._threads = ThreadPoolExecutor(len(others), thread_name_prefix="cyclic_env")
            self._threads_of = os.getpid()
        pending = [self._threads.submit(self._step_share, *share, rngs) for share in others] if self._threads else []
        self._step_share(*first, rngs)
        for future in pending:
            future.result()

    def _step_share(self, worlds: list[World], rows: np.ndarray, rngs: Sequence[np.random.Generator]) -> None:
        for world in worlds:
            self.simulation.drive_world(world, self._commands)
        step_rows(self.buildings, self.episodes, rows, self._claimed)
        self.measure(rows, rngs)

    def _divide(self) -> list[tuple[list[World], np.ndarray]]:
        """Divide the Spaces, and the robots in them, among as many threads as there are cores."""
        worlds = self.simulation.worlds
        count = min(len(worlds), num_cores())
        parts = [worlds[i::count] for i in range(count)]
        return [(part, np.sort(np.concatenate([world.rows for world in part]))) for part in parts]

    def _take_actions(self, actions: Any, skip: np.ndarray | None = None) -> None:
        """Turn actions into wheel speeds and claimed steps; those of the robots to skip, into standing still."""
        discrete = self.config.action_type == "discrete"
        shape = (self.num_robots, 2 if discrete else 4)
        array = as_array(actions, "the action", "one of the action space", ActionError)
        if array.shape != shape:
            if array.shape[:1] != shape[:1]:
                raise ActionError(f"the actions have shape {array.shape}; expected {shape}, a row for each robot.")
            raise ActionError(f"the action has shape {array.shape[1:]}; expected {shape[1:]}.")
        if discrete and array.dtype.kind not in "iu":
            raise ActionError(f"a discrete action holds whole numbers, got an array of type {array.dtype}.")
        array = array.astype(np.int64 if discrete else np.float64)
        if skip is not None:
            array[skip] = 0
        status, robot = self.episodes.memory.status, self.config.robot
        if discrete:
            bad = decode_discrete(array, robot.wheel_speed_max, DISCRETE_WHEELS, self._commands, self._claimed)
            expected = f"a drive from 0 to {len(DISCRETE_WHEELS) - 1}, and 0 or 1 for the claim"
        else:
            twist = self.config.action_type == "twist"
            bad = decode_continuous(
                array, status, twist, robot.wheel_speed_max, robot.axle_track, self._commands, self._claimed
            )
            expected = "no NaN"
        if bad >= 0:
            raise ActionError(f"the action of robot {bad} is {array[bad].tolist()}; expected {expected}.")

    def _checked_start(self, place: int, start: Any) -> Pose:
        """Return a start at which the robot can stand in the plan at that place in the pool."""
        expected = "(x, y, heading) in metres and radians, all finite"
        pose = as_array(start, "start", expected, FloorPlanError).astype(np.float64)
        if pose.shape != (3,) or not np.isfinite(pose).all():
            raise FloorPlanError(f"start is {short_repr(start)}; expected {expected}.")
        x, y, heading = pose.tolist()
        if not shapely.intersects_xy(self._reachable[place], x, y):
            self.config.plans[place].reachable(self.config.robot.radius, (x, y))  # raises, with the reason
        return x, y, heading

    def _random_start(self, place: int, rng: np.random.Generator) -> Pose:
        area = self._reachable[place]
        west, south, east, north = area.bounds
        for _ in range(10_000):
            points = rng.uniform((west, south), (east, north), (64, 2))
            inside = np.flatnonzero(shapely.contains_xy(area, points[:, 0], points[:, 1]))
            if len(inside):
                x, y = points[inside[0]]
                return float(x), float(y), float(rng.uniform(-math.pi, math.pi))
        raise FloorPlanError(f"floor plan {self.config.plans[place].name!r}: found no random start; give one.")

    def observation(self) -> dict[str, np.ndarray]:
        """Return the last readings, new float32 arrays: laser `(N, num_beams)`, distance `(N, 1)`, compass `(N, 2)`."""
        return {
            "laser": self.sensors.ranges.astype(np.float32),
            "distance": np.clip(self.sensors.distance[:, None], -DISTANCE_MAX, DISTANCE_MAX).astype(np.float32),
            "compass": self.sensors.compass.astype(np.float32),
        }

    def trajectory(self, row: int) -> np.ndarray:
        """Return the true way of a robot since its reset, `(t + 1, 3)`: x, y and path length, metres."""
        self.check_placed(row)
        memory = self.episodes.memory
        return memory.track[row, : memory.status["steps"][row] + 1].copy()

    def claims(self, row: int) -> np.ndarray:
        """Return the judged claims of a robot since its reset, in order: an `(n,)` array of `CLAIM`.

        Their places are ``trajectory(row)[claims["step"]]`` and, but for a match of -1, ``[claims["match"]]``.
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
        if self.simulation.plan_of[row] < 0:
            raise UsageError("there is no episode yet: call reset() first.")

    def _check_row(self, row: int) -> None:
        if not is_integer(row) or not 0 <= row < self.num_robots:
            raise UsageError(f"row is {short_repr(row)}; expected a whole number from 0 to {self.num_robots - 1}.")

    def plan(self, row: int) -> FloorPlan:
        """Return the floor plan in which a robot is.

        Raises
        ------
        UsageError
            If there is no such robot; or it has begun no episode, and there is a pool to draw from.
        """
        self._check_row(row)
        if len(self.config.plans) == 1:
            return self.config.plans[0]
        self.check_placed(row)
        return self.simulation.plans[self.simulation.plan_of[row]]

    def close(self) -> None:
        """End the threads."""
        if self._threads is not None:
            self._threads.shutdown()
            self._threads = None

    def __getstate__(self) -> dict[str, Any]:
        # The spaces hold the robots' rows and the threads are a process's own: both are made anew when needed.
        return {**self.__dict__, "_shares": [], "_threads": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        # Arrays that several owners share come back as copies of their own from some kinds of copying.
        simulation, sensors = self.simulation, self.sensors
        self.episodes = self.episodes._replace(
            plan_of=simulation.plan_of,
            drive=simulation.drive,
            true_ranges=sensors.true_ranges,
            info=self.info,
            terms=self.terms,
            outcome=self.outcome,
        )


@compiled
def wrap_angle(angle):
    """Return the angle in (-pi, pi] that differs from `angle` by whole turns."""
    wrapped = angle - 2 * math.pi * math.ceil((angle - math.pi) / (2 * math.pi))
    return min(max(wrapped, -math.pi), math.pi)


@compiled
def decode_continuous(actions, status, twist, wheel_speed_max, axle_track, commands, claimed):
    """Turn actions `(N, 4)` into wheel speeds `(N, 2)` and claimed steps `(N,)`; return a row with a NaN, or -1."""
    for row in range(actions.shape[0]):
        action = actions[row]
        for value in action:
            if math.isnan(value):
                return row
        first, second = min(max(action[0], -1.0), 1.0), min(max(action[1], -1.0), 1.0)
        if twist:
            speed, swing = first * wheel_speed_max, 0.5 * axle_track * second * TWIST_OMEGA_MAX
            excess = max(1.0, max(abs(speed - swing), abs(speed + swing)) / wheel_speed_max)
            commands[row, 0], commands[row, 1] = (speed - swing) / excess, (speed + swing) / excess
        else:
            commands[row, 0], commands[row, 1] = first * wheel_speed_max, second * wheel_speed_max
        claimed[row] = NO_CLAIM
        if action[2] > 0:
            match = min(max(action[3], -1.0), 1.0)
            claimed[row] = int(np.rint((match + 1) / 2 * (status[row].steps + 1)))
    return -1


@compiled
def decode_discrete(actions, wheel_speed_max, wheels, commands, claimed):
    """Turn actions `(N, 2)` int64 into wheel speeds `(N, 2)` and claims `(N,)`; return a row out of range, or -1."""
    for row in range(actions.shape[0]):
        drive, claim = actions[row, 0], actions[row, 1]
        if not (0 <= drive < wheels.shape[0] and 0 <= claim <= 1):
            return row
        commands[row, 0], commands[row, 1] = wheels[drive, 0] * wheel_speed_max, wheels[drive, 1] * wheel_speed_max
        claimed[row] = NEAREST if claim else NO_CLAIM
    return -1


@compiled
def begin_episode(buildings, episodes, row, x, y, heading):
    """Forget the robot's last episode; take, and mark, the scan of the start."""
    plan, ranges, grid = episodes.plan_of[row], episodes.true_ranges[row], episodes.grid
    path = robot_view(episodes.memory, row)
    begin(path, building_view(episodes.memory, plan), x, y)
    scan_row(
        buildings.tiles, plan, x, y, heading, buildings.directions, buildings.range_max, episodes.scratch[row], ranges
    )
    grid.seen[row] = False
    outcome = episodes.outcome[row]
    outcome.reward, outcome.terminated, outcome.truncated, outcome.contact = 0.0, False, False, False
    outcome.cells_paid, outcome.episode_return = 0, 0.0
    outcome.cells_seen = mark_scan(
        grid.grids[plan], grid.cell_size, grid.number, grid.seen[row], x, y, heading, buildings.directions, ranges
    )
    episodes.terms[row] = 0.0
    info = episodes.info[row]
    info.collisions = 0
    info.cycles_total = episodes.memory.cycles_total[plan]
    report(info, path.status, outcome.cells_seen / grid.cells_total[plan], buildings.coverage_complete, x, y, heading)


@compiled
def step_rows(buildings, episodes, rows, claimed):
    """Scan, mark, judge and reward the step that the robots `rows` have just driven."""
    grid, rules, directions = episodes.grid, buildings.rules, buildings.directions
    scratch = episodes.scratch[rows[0] if len(rows) else 0]  # one for all: no other call has the same first row
    for row in rows:
        plan, robot, ranges = episodes.plan_of[row], episodes.drive[row], episodes.true_ranges[row]
        if episodes.memory.status[row].steps >= buildings.step_budget[plan]:
            continue  # there is no room for another
        outcome, info = episodes.outcome[row], episodes.info[row]
        path, ground = robot_view(episodes.memory, row), building_view(episodes.memory, plan)
        status = path.status
        x, y, heading = robot.x, robot.y, wrap_angle(robot.angle)
        scan_row(buildings.tiles, plan, x, y, heading, directions, buildings.range_max, scratch, ranges)

        path_before, false_before = status.path, status.false_claims
        advance(path, ground, rules, x, y)
        if passed_mark(path_before, status.path, buildings.scan_spacing):
            outcome.cells_seen += mark_scan(
                grid.grids[plan], grid.cell_size, grid.number, grid.seen[row], x, y, heading, directions, ranges
            )
        judge_claim(path, ground, rules, claimed[row])
        if robot.contact and not outcome.contact:
            info.collisions += 1
        outcome.contact = robot.contact

        cells_total = grid.cells_total[plan]
        report(info, status, outcome.cells_seen / cells_total, buildings.coverage_complete, x, y, heading)
        outcome.terminated = info.is_success or (buildings.terminate_on_collision and robot.contact)
        outcome.truncated = status.steps >= buildings.step_budget[plan] and not outcome.terminated
        if outcome.terminated or outcome.truncated:
            settle_event(status, rules)
            report(info, status, outcome.cells_seen / cells_total, buildings.coverage_complete, x, y, heading)
        outcome.reward = reward_row(
            buildings.weights[plan],
            (outcome.cells_seen - outcome.cells_paid) / cells_total,
            status.new_cycle,
            status.false_claims - false_before,
            status.missed_now,
            robot.contact,
            episodes.terms[row],
        )
        outcome.cells_paid = outcome.cells_seen
        outcome.episode_return += outcome.reward


@compiled
def passed_mark(before, after, spacing):
    """Tell whether a path that grew from `before` to `after` passed a multiple of `spacing`; always, if that is 0."""
    return spacing == 0 or math.floor(after / spacing) > math.floor(before / spacing)


@compiled
def report(info, status, share_seen, share_complete, x, y, heading):
    """Fill the robot's info but for what never changes in an episode and the count of its collisions."""
    info.is_success = share_seen >= share_complete and status.cycles_closed == info.cycles_total
    info.coverage = share_seen
    info.cycles_closed = status.cycles_closed
    info.revisit = status.revisit
    info.claim_judged = status.claim_judged
    info.claim_correct = status.claim_correct
    info.claim_error_m = status.claim_error
    info.claims = status.claims
    info.false_claims = status.false_claims
    info.revisits = status.revisits
    info.revisits_recognised = status.recognised
    judged = status.recognised + status.false_claims
    info.precision = status.recognised / judged if judged > 0 else 1.0
    info.recall = status.recognised / status.revisits if status.revisits > 0 else 1.0
    info.new_cycle = status.new_cycle
    info.path_length_m = status.path
    info.x, info.y, info.heading = x, y, heading

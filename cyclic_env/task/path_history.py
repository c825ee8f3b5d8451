"""The memory of the paths of N robots, which finds an earlier position nearby among thousands.

A path is divided into **visits**: runs of at most `VISIT_STEPS` steps within one cell of the size of the return
radius. Every cell lists its visits, oldest first, and every visit has the box around its positions. Ground that a
counted revisit event covered is marked step by step, and every cell also lists the visits with such steps.

The arrays have room for the longest episodes, but take memory only as the paths grow.
"""

from __future__ import annotations

import math
import mmap
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from cyclic_env.config import ClosureConfig
from cyclic_env.floor_plans import FloorPlan
from cyclic_env.jit import compiled, inlined
from cyclic_env.simulation.wall_index import GRID, WallIndex, build_wall_index, cell_index, join_wall_indices
from cyclic_env.task.homology import CHECKPOINT_STEPS, count_crossings

VISIT_STEPS = 64

STATUS = np.dtype(
    [
        ("steps", "i8"),  # t
        ("path_length", "f8"),  # s_t
        ("visits", "i8"),  # how many visits the path has been divided into
        ("cell", "i8"),  # cell of the running visit
        ("gap_step", "i8"),  # last k with s_t - s_k >= gap; -1 for none
        ("revisit", "?"),
        ("fresh", "?"),
        ("event_open", "?"),
        ("event_recognised", "?"),
        ("event_first", "i8"),  # first and last fresh step of the open event
        ("event_last", "i8"),
        ("revisits", "i8"),  # settled events
        ("recognised", "i8"),  # settled events that were recognised
        ("missed_now", "i8"),  # events that settled missed in this step
        ("judged_path", "f8"),  # path length at the last judged claim, and at the last correct one
        ("correct_path", "f8"),
        ("claims", "i8"),  # judged ones
        ("false_claims", "i8"),
        ("claim_judged", "?"),
        ("claim_correct", "?"),
        ("claim_error", "f8"),
        ("new_cycle", "?"),
        ("cycles_closed", "i8"),
    ]
)
"""The state of loop closure of one robot; fields about a single step are about the last one."""

NONE, UNLISTED = -1, -2

VISIT = np.dtype(
    [
        ("first", "i4"),  # its first step
        ("next", "i4"),  # next visit of the same cell, or NONE
        ("next_counted", "i4"),  # next one of them with counted steps, or NONE; UNLISTED if it has no such step itself
        ("west", "f8"),  # box around its positions
        ("south", "f8"),
        ("east", "f8"),
        ("north", "f8"),
    ],
)

CLAIM = np.dtype([("step", "i4"), ("match", "i4"), ("correct", "?"), ("new_cycle", "?")])
"""A judged claim: the step of the claim, the step that it named (-1: there was none to name), and the judgement."""


class ClosureMemory(NamedTuple):
    """The paths of N robots, of at most T steps each, in a pool of P plans with at most C cycles each.

    A pickle holds only the steps that were taken, without room for more.

    Attributes
    ----------
    status : (N,) STATUS
    track : (N, T + 1, 3) float64
        x, y and path length of every step, the reset being step 0.
    counted : (N, T + 1) bool
        Steps of settled revisit events that count.
    visits : (N, T + 1) VISIT
    cells : (N, cells, 3) int32
        First and last visit of each cell, and the latest one with counted steps; or `NONE`.
    crossing_checkpoints : (N, T // CHECKPOINT_STEPS + 2, C) int64
        Signed crossings of each hole's cut, from the reset to step ``CHECKPOINT_STEPS * i``; the last one is running.
    basis : (N, C, C) int64
        Winding vectors of the closed cycles, reduced.
    claims : (N, T) CLAIM
        The judged claims, in order.
    grids : (P,) GRID
        Cells of each plan.
    cell_size : float
    anchors : (P, C, 2) float64
        A point inside the hole of each cycle; NaN where a plan has fewer.
    cycles_total : (P,) int64
    walls : WallIndex
        Walls within the return radius.
    """

    status: np.ndarray
    track: np.ndarray
    counted: np.ndarray
    visits: np.ndarray
    cells: np.ndarray
    crossing_checkpoints: np.ndarray
    basis: np.ndarray
    claims: np.ndarray
    grids: np.ndarray
    cell_size: float
    anchors: np.ndarray
    cycles_total: np.ndarray
    walls: WallIndex

    def used(self) -> ClosureMemory:
        """Return the part of the memory that the paths use."""
        steps, visits, claims = (int(self.status[name].max()) for name in ("steps", "visits", "claims"))
        counts = {"track": steps + 1, "counted": steps + 1, "visits": visits, "claims": claims}
        counts["crossing_checkpoints"] = steps // CHECKPOINT_STEPS + 2
        return self._replace(**{name: getattr(self, name)[:, :count] for name, count in counts.items()})

    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Return the shapes of the arrays that are larger for larger plans and longer episodes."""
        names = ("track", "counted", "visits", "cells", "crossing_checkpoints", "basis", "claims")
        return {name: getattr(self, name).shape for name in names}

    def __reduce__(self) -> tuple[Any, ...]:
        return _reallocate, (tuple(self.used()), self.shapes())


class RobotView(NamedTuple):
    """One robot's share of the memory."""

    status: np.void
    track: np.ndarray
    counted: np.ndarray
    visits: np.ndarray
    cells: np.ndarray
    crossing_checkpoints: np.ndarray
    basis: np.ndarray
    claims: np.ndarray


class BuildingView(NamedTuple):
    """One plan's share of the memory."""

    grid: np.void
    cell_size: float
    anchors: np.ndarray
    walls: WallIndex
    plan: int


def allocate_memory(plan: FloorPlan, num_robots: int, max_steps: int, config: ClosureConfig) -> ClosureMemory:
    """Return a memory for the paths of `num_robots` robots, of at most `max_steps` steps, in a plan."""
    tolerance = config.wall_tolerance
    seen = replace(plan, free_space=plan.free_space.buffer(tolerance)) if tolerance else plan
    walls = build_wall_index(seen, config.return_radius)
    return allocate(plan.bounds, plan.cycle_anchors, walls, num_robots, max_steps, float(config.return_radius))


def allocate(
    bounds: tuple[float, float, float, float],
    anchors: np.ndarray,
    walls: WallIndex,
    num_robots: int,
    max_steps: int,
    cell_size: float,
) -> ClosureMemory:
    """Return a memory for paths within `bounds` (west, south, east, north), with cycles about `anchors` `(C, 2)`.

    Positions out of bounds are allowed: they belong to the nearest cell.
    """
    west, south, east, north = bounds
    columns, rows = int((east - west) / cell_size) + 1, int((north - south) / cell_size) + 1
    cycles = len(anchors)
    return ClosureMemory(
        status=np.zeros(num_robots, STATUS),
        track=_lazy_array((num_robots, max_steps + 1, 3), np.dtype(np.float64)),
        counted=_lazy_array((num_robots, max_steps + 1), np.dtype(np.bool_)),
        visits=_lazy_array((num_robots, max_steps + 1), VISIT),
        cells=np.empty((num_robots, columns * rows, 3), np.int32),
        crossing_checkpoints=_lazy_array((num_robots, max_steps // CHECKPOINT_STEPS + 2, cycles), np.dtype(np.int64)),
        basis=np.empty((num_robots, cycles, cycles), np.int64),
        claims=_lazy_array((num_robots, max_steps), CLAIM),
        grids=np.array([(west, south, columns, rows, 0)], GRID),
        cell_size=cell_size,
        anchors=anchors[None].copy(),
        cycles_total=np.array([cycles], np.int64),
        walls=walls,
    )


def joined_memory(memory: ClosureMemory, others: ClosureMemory) -> ClosureMemory:
    """Return the paths of `memory`, with room for those in both pools of plans, the plans of `others` last."""
    most = max(memory.anchors.shape[1], others.anchors.shape[1])
    anchors = np.full((len(memory.anchors) + len(others.anchors), most, 2), np.nan)
    anchors[: len(memory.anchors), : memory.anchors.shape[1]] = memory.anchors
    anchors[len(memory.anchors) :, : others.anchors.shape[1]] = others.anchors
    shapes = {name: tuple(map(max, shape, others.shapes()[name])) for name, shape in memory.shapes().items()}
    larger = memory if shapes == memory.shapes() else _reallocate(memory.used(), shapes)
    return larger._replace(
        grids=np.concatenate([memory.grids, others.grids]),
        anchors=anchors,
        cycles_total=np.concatenate([memory.cycles_total, others.cycles_total]),
        walls=join_wall_indices(memory.walls, others.walls),
    )


def _reallocate(used: tuple[Any, ...], shapes: dict[str, tuple[int, ...]]) -> ClosureMemory:
    """Return the used part of a memory in arrays of these shapes."""
    memory = ClosureMemory(*used)
    arrays = {name: _lazy_array(shape, getattr(memory, name).dtype) for name, shape in shapes.items()}
    for name, array in arrays.items():
        part = getattr(memory, name)
        array[tuple(slice(size) for size in part.shape)] = part
    return memory._replace(**arrays)


def _lazy_array(shape: tuple[int, ...], dtype: np.dtype) -> np.ndarray:
    """Return a zeroed array that takes memory page by page, as its rows fill.

    NumPy asks for huge pages for large arrays, so that the first step of every row would take all of the memory.
    """
    size = math.prod(shape) * dtype.itemsize
    if size == 0 or not hasattr(mmap, "MADV_NOHUGEPAGE"):
        return np.zeros(shape, dtype)
    pages = mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    pages.madvise(mmap.MADV_NOHUGEPAGE)
    return np.frombuffer(pages, dtype).reshape(shape)


@inlined
def robot_view(memory, row):
    """Return one robot's share of the memory."""
    return RobotView(
        memory.status[row],
        memory.track[row],
        memory.counted[row],
        memory.visits[row],
        memory.cells[row],
        memory.crossing_checkpoints[row],
        memory.basis[row],
        memory.claims[row],
    )


@inlined
def building_view(memory, plan):
    """Return one plan's share of the memory."""
    anchors = memory.anchors[plan, : memory.cycles_total[plan]]
    return BuildingView(memory.grids[plan], memory.cell_size, anchors, memory.walls, plan)


@compiled
def begin_path(robot, building, x, y):
    """Clear the robot's path, and begin a new one at (x, y) with step 0."""
    status = robot.status
    status.steps, status.path_length = 0, 0.0
    status.visits, status.cell, status.gap_step = 0, NONE, NONE
    robot.cells[:] = NONE
    robot.crossing_checkpoints[:2] = 0
    robot.counted[0] = False
    robot.track[0, 0], robot.track[0, 1], robot.track[0, 2] = x, y, 0.0
    _record_visit(robot, building, x, y)


@inlined
def extend_path(robot, building, gap, x, y, path_length):
    """Add a step to (x, y) to the robot's path, which is then `path_length` long."""
    status, track = robot.status, robot.track
    status.steps += 1
    status.path_length = path_length
    track[status.steps, 0], track[status.steps, 1], track[status.steps, 2] = x, y, path_length
    robot.counted[status.steps] = False
    count_crossings(building.anchors, track, status.steps, robot.crossing_checkpoints)
    while path_length - track[status.gap_step + 1, 2] >= gap:
        status.gap_step += 1
    _record_visit(robot, building, x, y)


@compiled
def _record_visit(robot, building, x, y):
    """Add the last step, at (x, y), to the running visit, or begin a new one."""
    status = robot.status
    cell = cell_index(building.grid, building.cell_size, x, y)
    if cell == status.cell and status.steps - robot.visits[status.visits - 1].first < VISIT_STEPS:
        visit = robot.visits[status.visits - 1]
        visit.west, visit.east = min(visit.west, x), max(visit.east, x)
        visit.south, visit.north = min(visit.south, y), max(visit.north, y)
        return
    visit = robot.visits[status.visits]
    visit.first, visit.next, visit.next_counted = status.steps, NONE, UNLISTED
    visit.west, visit.south, visit.east, visit.north = x, y, x, y
    if robot.cells[cell, 0] == NONE:
        robot.cells[cell, 0] = status.visits
    else:
        robot.visits[robot.cells[cell, 1]].next = status.visits
    robot.cells[cell, 1] = status.visits
    status.cell = cell
    status.visits += 1


@compiled
def visit_end(robot, visit):
    """Return the step after the last one of a visit."""
    return robot.visits[visit + 1].first if visit + 1 < robot.status.visits else robot.status.steps + 1


@compiled
def box_square(visit, x, y):
    """Return the squared distance from (x, y) to the box around a visit, a lower bound for its positions."""
    dx, dy = max(visit.west - x, x - visit.east, 0.0), max(visit.south - y, y - visit.north, 0.0)
    return dx * dx + dy * dy


@compiled
def last_step_away(robot, radius):
    """Return the last step at which the robot was at least `radius` from where it is; -1 for none."""
    status, track = robot.status, robot.track
    x, y = track[status.steps, 0], track[status.steps, 1]
    square = radius * radius
    for i in range(status.visits - 1, -1, -1):
        visit = robot.visits[i]
        dx, dy = max(x - visit.west, visit.east - x), max(y - visit.south, visit.north - y)
        if dx * dx + dy * dy < square:
            continue
        for k in range(visit_end(robot, i) - 1, visit.first - 1, -1):
            dx, dy = track[k, 0] - x, track[k, 1] - y
            if dx * dx + dy * dy >= square:
                return k
    return -1


@compiled
def mark_counted(robot, building, first, last):
    """Mark the steps from `first` to `last` as counted, and list their visits by cell."""
    robot.counted[first : last + 1] = True
    i = robot.status.visits - 1
    while i >= 0 and visit_end(robot, i) > first:
        visit = robot.visits[i]
        if visit.first <= last and visit.next_counted == UNLISTED:
            x, y = robot.track[visit.first, 0], robot.track[visit.first, 1]
            cell = cell_index(building.grid, building.cell_size, x, y)
            visit.next_counted = robot.cells[cell, 2]
            robot.cells[cell, 2] = i
        i -= 1

"""The truth about loop closure: when a robot is back, which claims of it are right, which cycles they close.

With true positions p, path length s and the settings of `ClosureConfig`:

- Step t **returns to** step k when ``|p_t - p_k| <= return_radius``, the straight line between them stays in
  free space (touching a wall does not), ``s_t - s_k >= gap``, and at some step in between the robot was at
  least `leave_radius` from p_t. It is a **revisit** when such a k exists.
- A **revisit event** is a maximal run of revisit steps; runs less than `event_gap` of path apart are one event,
  and events shorter than `event_length_min` count neither way. It is **recognised** by a correct claim within
  it, and settles when it ends or the episode does: recognised or **missed**.
- A **claim** at t names a step k. It is judged if `claim_spacing` of path passed since the last judged one: it is
  **correct** when t returns to k, ignored when it fails by gap or leave alone, and **false** otherwise.
- A discrete claim names no step: it means the nearest one that t returns to, and is false where there is none.
- The loop of a correct claim is the path from k to t, closed by the straight line. Its winding numbers about the
  cycles' holes are an integer vector; it **closes a new cycle** when that vector is linearly independent
  of those before. They are counted as signed crossings of one cut a hole, from its anchor due north.

To find k among thousands of steps, the path is divided into **visits**: runs of at most `VISIT_STEPS` steps
within one cell of the size of the return radius. Every cell has the list of its visits, oldest first, and
every visit the box around its positions.
"""

from __future__ import annotations

import math
import mmap
from typing import Any, NamedTuple

import numpy as np

from cyclic_env.config import ClosureConfig
from cyclic_env.floor_plans import FloorPlan
from cyclic_env.jit import compiled, inlined
from cyclic_env.simulation.wall_index import (
    GRID,
    TILE_SIZE,
    WallIndex,
    build_wall_index,
    cell_index,
    join_wall_indices,
)

VISIT_STEPS = 64
PRIME = 2147483647
"""Ranks are taken modulo this prime: exact in 64 bits, never too large, and too small only if it divides a minor."""

STATUS = np.dtype(
    [
        ("steps", "i8"),  # t
        ("visits", "i8"),  # how many visits the path has been divided into
        ("cell", "i8"),  # cell of the running visit
        ("gap_step", "i8"),  # last k with s_t - s_k >= gap; -1 for none
        ("path", "f8"),  # s_t
        ("revisit", "?"),
        ("event_open", "?"),
        ("event_recognised", "?"),  # by a correct claim within the open event
        ("event_first", "f8"),  # path length at the first and the last revisit step of the open event
        ("event_last", "f8"),
        ("revisits", "i8"),  # settled events
        ("recognised", "i8"),  # those of them that were recognised
        ("missed_now", "i8"),  # events that settled missed in this step
        ("judged_path", "f8"),  # path length at the last judged claim
        ("claims", "i8"),  # judged ones
        ("false_claims", "i8"),
        ("claim_judged", "?"),
        ("claim_correct", "?"),
        ("claim_error", "f8"),
        ("new_cycle", "?"),
        ("cycles_closed", "i8"),
    ]
)
"""Loop closure of one robot; what concerns a single step is of the last one."""

VISIT = np.dtype(
    [("first", "i4"), ("next", "i4"), ("west", "f8"), ("south", "f8"), ("east", "f8"), ("north", "f8")],
)
"""A visit: its first step, the next visit of the same cell (-1: none), and the box around its positions."""

CLAIM = np.dtype([("step", "i4"), ("match", "i4"), ("correct", "?"), ("new_cycle", "?")])
"""A judged claim: the step of the claim, the step that it named (-1: there was none to name), and the judgement."""

NO_CLAIM, NEAREST = -2, -1
"""In place of a claimed step: no claim is made; let the truth choose the nearest step that t returns to."""


class ClosureMemory(NamedTuple):
    """The paths of N robots, of at most T steps each, in a pool of P plans with at most C cycles each.

    A pickle holds the steps that were taken, and not the room for more.

    Attributes
    ----------
    status : (N,) STATUS
    track : (N, T + 1, 3) float64
        x, y and path length of every step, the reset being step 0.
    visits : (N, T + 1) VISIT
    cells : (N, cells, 2) int32
        First and last visit of each cell (-1: none).
    marks : (N, T // VISIT_STEPS + 2, C) int64
        Signed crossings of each hole's cut, from the reset to step ``VISIT_STEPS * i``; the last one runs on.
    basis : (N, C, C) int64
        Winding vectors of the closed cycles, reduced, modulo `PRIME`.
    claims : (N, T) CLAIM
        The judged claims, in order.
    grids : (P,) GRID
        Cells of each plan.
    cell_size : float
    anchors : (P, C, 2) float64
        A point inside the hole of each cycle; NaN where a plan has fewer.
    cycles_total : (P,) int64
    sight : WallIndex
        Walls within the return radius.
    """

    status: np.ndarray
    track: np.ndarray
    visits: np.ndarray
    cells: np.ndarray
    marks: np.ndarray
    basis: np.ndarray
    claims: np.ndarray
    grids: np.ndarray
    cell_size: float
    anchors: np.ndarray
    cycles_total: np.ndarray
    sight: WallIndex

    def begun(self) -> ClosureMemory:
        """Return the part of it that the paths have come to."""
        steps, visits, claims = (int(self.status[name].max()) for name in ("steps", "visits", "claims"))
        used = {"track": steps + 1, "visits": visits, "marks": steps // VISIT_STEPS + 2, "claims": claims}
        return self._replace(**{name: getattr(self, name)[:, :count] for name, count in used.items()})

    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Return the shapes of the arrays that are larger for larger plans and longer episodes."""
        return {name: getattr(self, name).shape for name in ("track", "visits", "cells", "marks", "basis", "claims")}

    def __reduce__(self) -> tuple[Any, ...]:
        return _with_room, (tuple(self.begun()), self.shapes())


def _with_room(begun: tuple[Any, ...], shapes: dict[str, tuple[int, ...]]) -> ClosureMemory:
    """Return the memory of paths that have begun, in arrays of these shapes."""
    memory = ClosureMemory(*begun)
    room = {name: _lazy_array(shape, getattr(memory, name).dtype) for name, shape in shapes.items()}
    for name, array in room.items():
        part = getattr(memory, name)
        array[tuple(slice(size) for size in part.shape)] = part
    return memory._replace(**room)


class RobotView(NamedTuple):
    """One robot's share of the memory."""

    status: np.void
    track: np.ndarray
    visits: np.ndarray
    cells: np.ndarray
    marks: np.ndarray
    basis: np.ndarray
    claims: np.ndarray


class BuildingView(NamedTuple):
    """One plan's share of the memory."""

    grid: np.void
    cell_size: float
    anchors: np.ndarray
    sight: WallIndex
    plan: int


class ClosureRules(NamedTuple):
    """The numbers of `ClosureConfig`, as the compiled code takes them."""

    return_radius: float
    gap: float
    leave_radius: float
    event_gap: float
    event_length_min: float
    claim_spacing: float


def closure_rules(config: ClosureConfig) -> ClosureRules:
    """Return the settings as a tuple of floats."""
    return ClosureRules(*(float(getattr(config, name)) for name in ClosureRules._fields))


def allocate_memory(plan: FloorPlan, num_robots: int, max_steps: int, config: ClosureConfig) -> ClosureMemory:
    """Make room for the paths of `num_robots` robots of at most `max_steps` steps in a plan.

    Room for long episodes costs nothing in short ones: see `_lazy_array`.
    """
    size = float(config.return_radius)
    west, south, east, north = plan.bounds
    columns, rows = int((east - west) / size) + 1, int((north - south) / size) + 1
    cycles = plan.cycles_total
    return ClosureMemory(
        status=np.zeros(num_robots, STATUS),
        track=_lazy_array((num_robots, max_steps + 1, 3), np.dtype(np.float64)),
        visits=_lazy_array((num_robots, max_steps + 1), VISIT),
        cells=np.empty((num_robots, columns * rows, 2), np.int32),
        marks=_lazy_array((num_robots, max_steps // VISIT_STEPS + 2, cycles), np.dtype(np.int64)),
        basis=np.empty((num_robots, cycles, cycles), np.int64),
        claims=_lazy_array((num_robots, max_steps), CLAIM),
        grids=np.array([(west, south, columns, rows, 0)], GRID),
        cell_size=size,
        anchors=plan.cycle_anchors[None].copy(),
        cycles_total=np.array([cycles], np.int64),
        sight=build_wall_index(plan, config.return_radius),
    )


def joined_memory(memory: ClosureMemory, others: ClosureMemory) -> ClosureMemory:
    """Return the paths of the first, with room for those in both pools of plans, the plans of `others` last."""
    most = max(memory.anchors.shape[1], others.anchors.shape[1])
    anchors = np.full((len(memory.anchors) + len(others.anchors), most, 2), np.nan)
    anchors[: len(memory.anchors), : memory.anchors.shape[1]] = memory.anchors
    anchors[len(memory.anchors) :, : others.anchors.shape[1]] = others.anchors
    shapes = {name: tuple(map(max, shape, others.shapes()[name])) for name, shape in memory.shapes().items()}
    roomy = memory if shapes == memory.shapes() else _with_room(memory.begun(), shapes)
    return roomy._replace(
        grids=np.concatenate([memory.grids, others.grids]),
        anchors=anchors,
        cycles_total=np.concatenate([memory.cycles_total, others.cycles_total]),
        sight=join_wall_indices(memory.sight, others.sight),
    )


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
    """Return the share of the memory that is the robot's."""
    return RobotView(
        memory.status[row],
        memory.track[row],
        memory.visits[row],
        memory.cells[row],
        memory.marks[row],
        memory.basis[row],
        memory.claims[row],
    )


@inlined
def building_view(memory, plan):
    """Return the share of the memory that is the plan's."""
    anchors = memory.anchors[plan, : memory.cycles_total[plan]]
    return BuildingView(memory.grids[plan], memory.cell_size, anchors, memory.sight, plan)


@compiled
def begin(path, ground, x, y):
    """Begin the robot's path at (x, y): step 0."""
    status = path.status
    status.steps = 0
    status.visits = 0
    status.cell = -1
    status.gap_step = -1
    status.path = 0.0
    status.event_open = False
    status.revisits = 0
    status.recognised = 0
    status.judged_path = -math.inf
    status.claims = 0
    status.false_claims = 0
    status.cycles_closed = 0
    _forget_last_step(status)
    path.cells[:] = -1
    path.marks[:2] = 0
    path.track[0, 0], path.track[0, 1], path.track[0, 2] = x, y, 0.0
    _record_visit(path, ground, x, y)


@compiled
def _forget_last_step(status):
    status.revisit = False
    status.missed_now = 0
    status.claim_judged = False
    status.claim_correct = False
    status.claim_error = 0.0
    status.new_cycle = False


@compiled
def advance(path, ground, rules, x, y):
    """Take the robot's next step, to (x, y), and see whether it is a revisit and whether an event begins or settles."""
    status, track = path.status, path.track
    run_before = status.revisit
    _forget_last_step(status)
    x_before, y_before = track[status.steps, 0], track[status.steps, 1]
    status.steps += 1
    status.path += math.sqrt((x - x_before) * (x - x_before) + (y - y_before) * (y - y_before))
    track[status.steps, 0], track[status.steps, 1], track[status.steps, 2] = x, y, status.path
    _count_crossings(path, ground, x_before, y_before, x, y)
    while status.path - track[status.gap_step + 1, 2] >= rules.gap:
        status.gap_step += 1
    _record_visit(path, ground, x, y)
    status.revisit = find_return(path, ground, rules, False) >= 0

    run_goes_on = run_before and status.revisit  # however small the event gap, or long the step
    if status.event_open and not run_goes_on and status.path - status.event_last >= rules.event_gap:
        settle_event(status, rules)
    if status.revisit:
        if not status.event_open:
            status.event_open, status.event_recognised = True, False
            status.event_first = status.path
        status.event_last = status.path


@compiled
def settle_event(status, rules):
    """End the open revisit event, if there is one: recognised, missed, or too short to count."""
    if status.event_open and status.event_last - status.event_first >= rules.event_length_min:
        status.revisits += 1
        if status.event_recognised:
            status.recognised += 1
        else:
            status.missed_now += 1
    status.event_open = False


@compiled
def judge_claim(path, ground, rules, claimed):
    """Judge the claim that the robot is back where it was at step `claimed`; that may be `NO_CLAIM` or `NEAREST`."""
    status, track = path.status, path.track
    if claimed == NO_CLAIM or status.path - status.judged_path < rules.claim_spacing:
        return
    if claimed == NEAREST:
        claimed = find_return(path, ground, rules, True)
    correct = False
    if claimed >= 0:
        x, y = track[status.steps, 0], track[status.steps, 1]
        dx, dy = track[claimed, 0] - x, track[claimed, 1] - y
        near = dx * dx + dy * dy <= rules.return_radius * rules.return_radius
        if near and line_of_sight(ground.sight, ground.plan, x, y, track[claimed, 0], track[claimed, 1]):
            correct = claimed <= status.gap_step and claimed < _last_away(path, rules)
            if not correct:
                return
        status.claim_error = math.sqrt(dx * dx + dy * dy)
    claim = path.claims[status.claims]
    claim.step, claim.match = status.steps, claimed
    status.claim_judged = True
    status.claims += 1
    status.judged_path = status.path
    if correct:
        status.claim_correct = True
        status.event_recognised = True
        _close_cycle(path, ground, claimed)
    else:
        status.false_claims += 1
    claim.correct, claim.new_cycle = correct, status.new_cycle


@compiled
def _close_cycle(path, ground, k):
    """See whether the loop from step k closes a new cycle."""
    status, cycles = path.status, ground.anchors.shape[0]
    if status.cycles_closed < cycles:
        vector = path.basis[status.cycles_closed, :cycles]
        loop_windings(path, ground, k, vector)
        if _reduce(path.basis, status.cycles_closed, vector):
            status.cycles_closed += 1
            status.new_cycle = True


@compiled
def _record_visit(path, ground, x, y):
    """Add the last step, at (x, y), to the running visit, or begin a new one."""
    status = path.status
    cell = cell_index(ground.grid, ground.cell_size, x, y)
    if cell == status.cell and status.steps - path.visits[status.visits - 1].first < VISIT_STEPS:
        visit = path.visits[status.visits - 1]
        visit.west, visit.east = min(visit.west, x), max(visit.east, x)
        visit.south, visit.north = min(visit.south, y), max(visit.north, y)
        return
    visit = path.visits[status.visits]
    visit.first, visit.next = status.steps, -1
    visit.west, visit.south, visit.east, visit.north = x, y, x, y
    if path.cells[cell, 0] < 0:
        path.cells[cell, 0] = status.visits
    else:
        path.visits[path.cells[cell, 1]].next = status.visits
    path.cells[cell, 1] = status.visits
    status.cell = cell
    status.visits += 1


@compiled
def _visit_end(path, visit):
    """Return the step after the last one of a visit."""
    return path.visits[visit + 1].first if visit + 1 < path.status.visits else path.status.steps + 1


@compiled
def find_return(path, ground, rules, nearest):
    """Return a step that the last step t returns to: the nearest one (ties to the earliest) or any; -1 for none."""
    status, track = path.status, path.track
    if status.gap_step < 0:
        return -1
    x, y = track[status.steps, 0], track[status.steps, 1]
    columns, rows = ground.grid.columns, ground.grid.rows
    column, line = status.cell % columns, status.cell // columns
    best, best_square = -1, rules.return_radius * rules.return_radius
    last = status.gap_step  # the last step long enough ago
    last_known = False  # whether it is also before the robot was away, which is found out when first needed
    for cell_line in range(max(line - 1, 0), min(line + 2, rows)):
        for cell_column in range(max(column - 1, 0), min(column + 2, columns)):
            visit = path.cells[cell_line * columns + cell_column, 0]
            while visit >= 0 and path.visits[visit].first <= last:
                if not last_known:
                    last, last_known = min(last, _last_away(path, rules) - 1), True
                box = path.visits[visit]
                dx, dy = max(box.west - x, x - box.east, 0.0), max(box.south - y, y - box.north, 0.0)
                end = min(_visit_end(path, visit), last + 1) if dx * dx + dy * dy <= best_square else 0
                for k in range(box.first, end):
                    dx, dy = track[k, 0] - x, track[k, 1] - y
                    square = dx * dx + dy * dy
                    better = square < best_square or (square == best_square and (best < 0 or k < best))
                    if better and line_of_sight(ground.sight, ground.plan, x, y, track[k, 0], track[k, 1]):
                        if not nearest:
                            return k
                        best, best_square = k, square
                visit = path.visits[visit].next
    return best


@compiled
def _last_away(path, rules):
    """Return the last step at which the robot was at least the leave radius from where it is; -1 for none."""
    status, track = path.status, path.track
    x, y = track[status.steps, 0], track[status.steps, 1]
    square = rules.leave_radius * rules.leave_radius
    for i in range(status.visits - 1, -1, -1):
        visit = path.visits[i]
        dx, dy = max(x - visit.west, visit.east - x), max(y - visit.south, visit.north - y)
        if dx * dx + dy * dy < square:
            continue
        for k in range(_visit_end(path, i) - 1, visit.first - 1, -1):
            dx, dy = track[k, 0] - x, track[k, 1] - y
            if dx * dx + dy * dy >= square:
                return k
    return -1


@compiled
def line_of_sight(tiles, plan, ax, ay, bx, by):
    """Tell whether the straight line from a to b, no longer than the tiles' reach, meets no wall."""
    tile = cell_index(tiles.grids[plan], TILE_SIZE, ax, ay)
    dx, dy = bx - ax, by - ay
    west, east, south, north = min(ax, bx), max(ax, bx), min(ay, by), max(ay, by)
    for i in range(tiles.offsets[tile], tiles.offsets[tile + 1]):
        wall = tiles.walls[tiles.indices[i]]
        x1, y1, x2, y2 = wall[0], wall[1], wall[2], wall[3]
        if max(x1, x2) < west or min(x1, x2) > east or max(y1, y2) < south or min(y1, y2) > north:
            continue
        side_1 = dx * (y1 - ay) - dy * (x1 - ax)
        side_2 = dx * (y2 - ay) - dy * (x2 - ax)
        if (side_1 > 0 and side_2 > 0) or (side_1 < 0 and side_2 < 0):
            continue
        side_a = (x2 - x1) * (ay - y1) - (y2 - y1) * (ax - x1)
        side_b = (x2 - x1) * (by - y1) - (y2 - y1) * (bx - x1)
        if (side_a > 0 and side_b > 0) or (side_a < 0 and side_b < 0):
            continue
        return False
    return True


@compiled
def _crossing(anchor, ax, ay, bx, by):
    """Return +1 if the line from a to b crosses the cut due north of the anchor to the west, -1 to the east, else 0."""
    if (ax < anchor[0]) == (bx < anchor[0]):
        return 0
    y = ay + (anchor[0] - ax) * (by - ay) / (bx - ax)
    if y <= anchor[1]:
        return 0
    return 1 if bx < ax else -1


@compiled
def _count_crossings(path, ground, ax, ay, bx, by):
    """Add the crossings of the last step, from a to b, to the running mark; begin the next mark when it is due."""
    step = path.status.steps
    running = path.marks[(step - 1) // VISIT_STEPS + 1]
    for cycle in range(ground.anchors.shape[0]):
        running[cycle] += _crossing(ground.anchors[cycle], ax, ay, bx, by)
        if step % VISIT_STEPS == 0:
            path.marks[step // VISIT_STEPS + 1, cycle] = running[cycle]


@compiled
def loop_windings(path, ground, k, windings):
    """Write how often the path from step k on, closed by a straight line, winds around each of the cycles `(C,)`."""
    track, t = path.track, path.status.steps
    total, mark = path.marks[t // VISIT_STEPS + 1], path.marks[k // VISIT_STEPS]
    for cycle in range(ground.anchors.shape[0]):
        anchor = ground.anchors[cycle]
        count = total[cycle] - mark[cycle]
        for j in range(k - k % VISIT_STEPS, k):
            count -= _crossing(anchor, track[j, 0], track[j, 1], track[j + 1, 0], track[j + 1, 1])
        windings[cycle] = count + _crossing(anchor, track[t, 0], track[t, 1], track[k, 0], track[k, 1])


@compiled
def _reduce(basis, rank, vector):
    """Reduce `vector` by the first `rank` rows of `basis`, modulo `PRIME`, and tell whether anything is left of it."""
    size = vector.shape[0]
    for j in range(size):
        vector[j] %= PRIME
    for i in range(rank):
        pivot = 0
        while basis[i, pivot] == 0:
            pivot += 1
        factor = vector[pivot]
        for j in range(size):
            vector[j] = (vector[j] - factor * basis[i, j]) % PRIME
    for pivot in range(size):
        if vector[pivot] != 0:
            inverse = _inverse(vector[pivot])
            for j in range(size):
                vector[j] = vector[j] * inverse % PRIME
            return True
    return False


@compiled
def _inverse(number):
    """Return the inverse of a number modulo `PRIME`: its power to ``PRIME - 2``, by Fermat's little theorem."""
    result, power, exponent = 1, number, PRIME - 2
    while exponent > 0:
        if exponent & 1:
            result = result * power % PRIME
        power = power * power % PRIME
        exponent >>= 1
    return result

"""The truth about loop closure: when a robot is back, which claims of it are right, which cycles they close.

With true positions p, path length s and the settings of `ClosureConfig`:

- Step t **returns to** step k when ``|p_t - p_k| <= return_radius``, the straight line between them stays in
  free space (touching a wall does not), ``s_t - s_k >= gap``, and at some step in between the robot was at
  least `leave_radius` from p_t. It is a **revisit** when such a k exists.
- Ground counts once: a revisit step is **fresh** when no step of an event that has settled and counts lies within the
  return radius and in sight of it.
- A **revisit event** is a maximal run of fresh steps; runs less than `event_gap` of path apart are one event, which
  lasts from its first fresh step to its last. It settles as soon as no further step can belong to it, or when the
  episode ends, and counts if it is at least `event_length_min` of path long. It is **recognised** by a correct claim
  within it, or less than `claim_spacing` of path before it (since a claim so soon after another is ignored), and
  **missed** otherwise.
- A **claim** at t names a step k. It is judged if `claim_spacing` of path passed since the last judged one: it is
  **correct** when t returns to k, ignored when it fails by gap or leave alone, and **false** otherwise.
- A discrete claim names no step: it means the nearest one that t returns to, and is false where there is none.
- The loop of a correct claim is the path from k to t, closed by the straight line. Its winding numbers about the
  cycles' holes are an integer vector; it **closes a new cycle** when that vector is linearly independent
  of those before (see `cyclic_env.task.homology`).

Nothing else decides what counts as a return: the environments judge step by step with `advance` and `judge_claim`,
`judge_trajectory` judges a whole trajectory in the same way, and `compare_steps` and `true_returns` tell how a claim
would be judged.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from cyclic_env.config import ClosureConfig
from cyclic_env.errors import UsageError
from cyclic_env.floor_plans import FloorPlan
from cyclic_env.jit import compiled
from cyclic_env.simulation.wall_index import line_of_sight, no_walls
from cyclic_env.task.homology import is_independent, loop_windings
from cyclic_env.task.path_history import (
    CLAIM,
    STATUS,
    ClosureMemory,
    allocate,
    allocate_memory,
    begin_path,
    box_square,
    building_view,
    extend_path,
    last_step_away,
    mark_counted,
    robot_view,
    visit_end,
)

RULES_VERSION = 2
"""Version of the definitions above. A recording that stores another one, or none, was judged by other rules.

1. Every revisit step could begin or extend a revisit event, and only a correct claim within an event recognised it.
2. Ground counts once: events are runs of fresh steps, and a correct claim just before an event recognises it, too.
"""

NO_CLAIM, NEAREST = -2, -1
"""In place of a claimed step: no claim is made; let the truth choose the nearest step that t returns to."""

RETURNS, ELSEWHERE, TOO_SOON = 1, 0, -1
"""Of a step and an earlier one: a claim of it would be correct, false, or ignored for want of gap or leave alone."""

OPEN_CELLS_MAX = 1_000
"""Cells to a side under a trajectory without a plan; positions beyond belong to the outermost ones."""


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


@compiled
def begin(robot, building, x, y):
    """Begin the robot's path at (x, y): step 0."""
    status = robot.status
    status.fresh, status.event_open = False, False
    status.revisits, status.recognised = 0, 0
    status.judged_path, status.correct_path = -math.inf, -math.inf
    status.claims, status.false_claims, status.cycles_closed = 0, 0, 0
    _forget_last_step(status)
    begin_path(robot, building, x, y)


@compiled
def _forget_last_step(status):
    status.revisit = False
    status.missed_now = 0
    status.claim_judged = False
    status.claim_correct = False
    status.claim_error = 0.0
    status.new_cycle = False


@compiled
def advance(robot, building, rules, x, y):
    """Take the robot's next step, to (x, y), and see whether it is a revisit and whether an event begins or settles."""
    status = robot.status
    dx, dy = x - robot.track[status.steps, 0], y - robot.track[status.steps, 1]
    advance_along(robot, building, rules, x, y, status.path_length + math.sqrt(dx * dx + dy * dy))


@compiled
def advance_along(robot, building, rules, x, y, path_length):
    """Take the robot's next step as `advance` does; the path to it is `path_length` long."""
    status, track = robot.status, robot.track
    _forget_last_step(status)
    extend_path(robot, building, rules.gap, x, y, path_length)
    status.revisit = find_return(robot, building, rules, False) >= 0

    fresh = status.revisit and not _on_counted_ground(robot, building, rules)
    run_goes_on = fresh and status.fresh  # however small the event gap, or long the step
    if status.event_open and not run_goes_on and path_length - track[status.event_last, 2] >= rules.event_gap:
        settle_event(robot, building, rules)
        fresh = fresh and not _on_counted_ground(robot, building, rules)
    if fresh:
        if not status.event_open:
            status.event_open, status.event_recognised = True, False
            status.event_first = status.steps
        status.event_last = status.steps
        if track[status.event_first, 2] - status.correct_path < rules.claim_spacing:
            status.event_recognised = True
    status.fresh = fresh


@compiled
def settle_event(robot, building, rules):
    """End the open revisit event, if there is one: recognised, missed, or too short to count."""
    status, track = robot.status, robot.track
    if status.event_open and track[status.event_last, 2] - track[status.event_first, 2] >= rules.event_length_min:
        mark_counted(robot, building, status.event_first, status.event_last)
        status.revisits += 1
        if status.event_recognised:
            status.recognised += 1
        else:
            status.missed_now += 1
    status.event_open = False


@compiled
def judge_claim(robot, building, rules, claimed):
    """Judge the claim that the robot is back where it was at step `claimed`; that may be `NO_CLAIM` or `NEAREST`."""
    status = robot.status
    if claimed == NO_CLAIM or status.path_length - status.judged_path < rules.claim_spacing:
        return
    if claimed == NEAREST:
        claimed = find_return(robot, building, rules, True)
    correct = False
    if claimed >= 0:
        relation = compare_steps(robot, building, rules, claimed)
        if relation == TOO_SOON:
            return
        correct = relation == RETURNS
        status.claim_error = math.sqrt(_square_distance(robot.track, status.steps, claimed))
    claim = robot.claims[status.claims]
    claim.step, claim.match = status.steps, claimed
    status.claim_judged = True
    status.claims += 1
    status.judged_path = status.path_length
    if correct:
        status.claim_correct = True
        status.correct_path = status.path_length
        status.event_recognised = status.event_recognised or status.fresh
        _close_cycle(robot, building, claimed)
    else:
        status.false_claims += 1
    claim.correct, claim.new_cycle = correct, status.new_cycle


@compiled
def _close_cycle(robot, building, k):
    """See whether the loop from step k closes a new cycle."""
    status, cycles = robot.status, building.anchors.shape[0]
    if status.cycles_closed < cycles:
        vector = robot.basis[status.cycles_closed, :cycles]
        loop_windings(building.anchors, robot.track, robot.crossing_checkpoints, k, status.steps, vector)
        if is_independent(robot.basis, status.cycles_closed, vector):
            status.cycles_closed += 1
            status.new_cycle = True


@compiled
def compare_steps(robot, building, rules, k):
    """Return how the last step relates to step k: `RETURNS`, `ELSEWHERE` or `TOO_SOON`."""
    status, track = robot.status, robot.track
    if _square_distance(track, status.steps, k) > rules.return_radius * rules.return_radius:
        return ELSEWHERE
    if not _sees(robot, building, k):
        return ELSEWHERE
    if k <= status.gap_step and k < last_step_away(robot, rules.leave_radius):
        return RETURNS
    return TOO_SOON


@compiled
def _square_distance(track, t, k):
    dx, dy = track[k, 0] - track[t, 0], track[k, 1] - track[t, 1]
    return dx * dx + dy * dy


@compiled
def _sees(robot, building, k):
    """Tell whether the position of step k is in sight of the robot."""
    track, t = robot.track, robot.status.steps
    return line_of_sight(building.walls, building.plan, track[t, 0], track[t, 1], track[k, 0], track[k, 1])


@compiled
def find_return(robot, building, rules, nearest):
    """Return a step that the last step t returns to: the nearest one (ties to the earliest) or any; -1 for none."""
    status, track = robot.status, robot.track
    if status.gap_step < 0:
        return -1
    x, y = track[status.steps, 0], track[status.steps, 1]
    columns, rows = building.grid.columns, building.grid.rows
    column, line = status.cell % columns, status.cell // columns
    best, best_square = -1, rules.return_radius * rules.return_radius
    last = status.gap_step  # the last step long enough ago
    last_known = False  # whether it is also before the robot was away, which is found out when first needed
    for cell_line in range(max(line - 1, 0), min(line + 2, rows)):
        for cell_column in range(max(column - 1, 0), min(column + 2, columns)):
            visit = robot.cells[cell_line * columns + cell_column, 0]
            while visit >= 0 and robot.visits[visit].first <= last:
                if not last_known:
                    last, last_known = min(last, last_step_away(robot, rules.leave_radius) - 1), True
                box = robot.visits[visit]
                end = min(visit_end(robot, visit), last + 1) if box_square(box, x, y) <= best_square else 0
                for k in range(box.first, end):
                    square = _square_distance(track, status.steps, k)
                    better = square < best_square or (square == best_square and (best < 0 or k < best))
                    if better and _sees(robot, building, k):
                        if not nearest:
                            return k
                        best, best_square = k, square
                visit = robot.visits[visit].next
    return best


@compiled
def _on_counted_ground(robot, building, rules):
    """Tell whether a step of a counted event lies within the return radius, and in sight, of the last step."""
    status, track = robot.status, robot.track
    x, y = track[status.steps, 0], track[status.steps, 1]
    columns, rows = building.grid.columns, building.grid.rows
    column, line = status.cell % columns, status.cell // columns
    radius_square = rules.return_radius * rules.return_radius
    for cell_line in range(max(line - 1, 0), min(line + 2, rows)):
        for cell_column in range(max(column - 1, 0), min(column + 2, columns)):
            visit = robot.cells[cell_line * columns + cell_column, 2]
            while visit >= 0:
                box = robot.visits[visit]
                end = visit_end(robot, visit) if box_square(box, x, y) <= radius_square else 0
                for k in range(box.first, end):
                    near = robot.counted[k] and _square_distance(track, status.steps, k) <= radius_square
                    if near and _sees(robot, building, k):
                        return True
                visit = box.next_counted
    return False


@compiled
def precision_of(status):
    """Return the share of what was claimed that is right: recognised events among them and false claims, 1 for none."""
    judged = status.recognised + status.false_claims
    return status.recognised / judged if judged > 0 else 1.0


@compiled
def recall_of(status):
    """Return the share of the settled events that was recognised, 1 for none."""
    return status.recognised / status.revisits if status.revisits > 0 else 1.0


# Whole trajectories ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TrajectoryJudgement:
    """What is true of a trajectory and the claims made on it.

    Attributes
    ----------
    revisit : (T + 1,) bool
        Whether each step is a revisit; the first never is.
    fresh : (T + 1,) bool
        Whether it is one on ground that no counted event has covered before.
    claims : (c,) CLAIM
        The judged claims, in order; others were ignored. A `match` of -1 is a claim with no step to name.
    claim_errors_m : (c,) float64
        Distance between the two positions of each judged claim; 0.0 where it names no step.
    false_claims, revisits, revisits_recognised, cycles_closed, cycles_total : int
    precision, recall : float
        1.0 where nothing could be wrong.
    """

    revisit: np.ndarray
    fresh: np.ndarray
    claims: np.ndarray
    claim_errors_m: np.ndarray
    false_claims: int
    revisits: int
    revisits_recognised: int
    cycles_closed: int
    cycles_total: int
    precision: float
    recall: float


def judge_trajectory(
    plan: FloorPlan | None, trajectory: Any, claims: Any = (), config: ClosureConfig | None = None
) -> TrajectoryJudgement:
    """Judge a whole trajectory, and the claims made on it, as an environment judges an episode that ends with it.

    Parameters
    ----------
    plan : FloorPlan or None
        The building; None for open ground, where nothing blocks the sight and there are no cycles.
    trajectory : (T + 1, 2) or (T + 1, 3) array
        x and y of every step, metres, and optionally the path length, which is otherwise the sum of the steps.
    claims : (n, 2) array of int, optional
        The step of each claim, ascending, and the step that it names: `NEAREST` (-1) for the nearest that it returns
        to. ``np.column_stack([claims["step"], claims["match"]])`` of ``env.claims()`` fits.
    config : ClosureConfig, optional

    Raises
    ------
    UsageError
        If the shapes are others, a position isn't finite, the path gets shorter, or a claim names a step to come.
    """
    config = config or ClosureConfig()
    track = _checked_trajectory(trajectory)
    claimed = _checked_claims(claims, len(track))
    memory = _memory_for(plan, track, config)
    record = np.zeros(len(track), STATUS)
    _judge_steps(memory, closure_rules(config), track, claimed, record)
    status, judged = record[-1], record["claim_judged"]
    return TrajectoryJudgement(
        revisit=record["revisit"].copy(),
        fresh=record["fresh"].copy(),
        claims=memory.claims[0, : status["claims"]].copy(),
        claim_errors_m=record["claim_error"][judged],
        false_claims=int(status["false_claims"]),
        revisits=int(status["revisits"]),
        revisits_recognised=int(status["recognised"]),
        cycles_closed=int(status["cycles_closed"]),
        cycles_total=int(memory.cycles_total[0]),
        precision=float(precision_of(status)),
        recall=float(recall_of(status)),
    )


def true_returns(
    plan: FloorPlan | None, trajectory: Any, steps: Any = None, config: ClosureConfig | None = None
) -> np.ndarray:
    """Return how a claim at each of some steps that it is back at an earlier one of them would be judged.

    Parameters
    ----------
    plan, trajectory, config
        As `judge_trajectory` takes them.
    steps : (n,) array of int, optional
        Ascending; every step by default.

    Returns
    -------
    (n, n) int8
        `RETURNS`, `ELSEWHERE` or `TOO_SOON` of step i and an earlier step j; `ELSEWHERE` on and above the diagonal.

    Raises
    ------
    UsageError
        As `judge_trajectory`, and if the steps aren't ascending numbers of steps.
    """
    config = config or ClosureConfig()
    track = _checked_trajectory(trajectory)
    chosen = np.arange(len(track)) if steps is None else np.asarray(steps)
    inside = chosen.ndim == 1 and chosen.dtype.kind in "iu" and (chosen >= 0).all() and (chosen < len(track)).all()
    if not inside or (np.diff(chosen.astype(np.int64)) <= 0).any():
        raise UsageError(f"the steps must be ascending whole numbers from 0 to {len(track) - 1}.")
    relations = np.full((len(chosen), len(chosen)), ELSEWHERE, np.int8)
    _compare_all(_memory_for(plan, track, config), closure_rules(config), track, chosen.astype(np.int64), relations)
    return relations


def _checked_trajectory(trajectory: Any) -> np.ndarray:
    """Return x, y and path length of every step, `(T + 1, 3)`."""
    track = np.asarray(trajectory, np.float64)
    if track.ndim != 2 or track.shape[1] not in (2, 3) or not len(track) or not np.isfinite(track).all():
        raise UsageError(
            f"the trajectory has shape {track.shape}; expected (T + 1, 2) or (T + 1, 3) finite numbers: x, y and path."
        )
    if track.shape[1] == 2:
        dx, dy = np.diff(track, axis=0).T
        track = np.column_stack([track, np.cumsum([0.0, *np.sqrt(dx * dx + dy * dy)])])
    if (np.diff(track[:, 2]) < 0).any():
        raise UsageError("the path lengths of the trajectory must not get shorter.")
    return track


def _checked_claims(claims: Any, count: int) -> np.ndarray:
    """Return the step that is claimed at each of `count` steps, or `NO_CLAIM`."""
    pairs = np.asarray(claims)
    pairs = pairs.reshape(-1, 2) if not pairs.size else pairs
    if pairs.ndim != 2 or pairs.shape[1] != 2 or (pairs.size and pairs.dtype.kind not in "iu"):
        raise UsageError(f"the claims have shape {pairs.shape}; expected (n, 2) whole numbers: step and claimed step.")
    steps, matches = pairs.astype(np.int64).T
    wrong = (steps < 1) | (steps >= count) | (matches < NEAREST) | (matches > steps)
    if wrong.any() or (np.diff(steps) <= 0).any():
        raise UsageError(
            f"the claims must be at ascending steps from 1 to {count - 1}, and each name {NEAREST} or a step up to its own."
        )
    claimed = np.full(count, NO_CLAIM, np.int64)
    claimed[steps] = matches
    return claimed


def _memory_for(plan: FloorPlan | None, track: np.ndarray, config: ClosureConfig) -> ClosureMemory:
    """Return a memory for the path of one robot in a plan, or on open ground."""
    if plan is not None:
        return allocate_memory(plan, 1, len(track) - 1, config)
    (west, south), (east, north) = track[:, :2].min(axis=0), track[:, :2].max(axis=0)
    size = float(config.return_radius)
    bounds = west, south, min(east, west + OPEN_CELLS_MAX * size), min(north, south + OPEN_CELLS_MAX * size)
    return allocate(bounds, np.empty((0, 2)), no_walls(), 1, len(track) - 1, size)


@compiled
def _judge_steps(memory, rules, track, claimed, record):
    """Judge a trajectory step by step, and write the status after each step."""
    robot, building = robot_view(memory, 0), building_view(memory, 0)
    begin(robot, building, track[0, 0], track[0, 1])
    record[0] = memory.status[0]
    for t in range(1, track.shape[0]):
        advance_along(robot, building, rules, track[t, 0], track[t, 1], track[t, 2])
        judge_claim(robot, building, rules, claimed[t])
        if t == track.shape[0] - 1:
            settle_event(robot, building, rules)
        record[t] = memory.status[0]


@compiled
def _compare_all(memory, rules, track, steps, relations):
    """Write how each of `steps` relates to the earlier ones."""
    robot, building = robot_view(memory, 0), building_view(memory, 0)
    begin_path(robot, building, track[0, 0], track[0, 1])
    i = 0
    for t in range(track.shape[0]):
        if t > 0:
            extend_path(robot, building, rules.gap, track[t, 0], track[t, 1], track[t, 2])
        if i < steps.shape[0] and steps[i] == t:
            for j in range(i):
                relations[i, j] = compare_steps(robot, building, rules, steps[j])
            i += 1

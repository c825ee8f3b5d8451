"""The truth about loop closure: when a robot returns, which claims are right, and which cycles they close.

With true positions p, path length s and the settings of `ClosureConfig`:

- Step t **returns to** step k when ``|p_t - p_k| <= return_radius``, p_k is in sight, ``s_t - s_k >= gap``, and at
  some step in between the robot was at least `leave_radius` from p_t. It is a **revisit** when such a k exists.
  A position is in sight when the straight line to it stays in free space (touching a wall does not), or is shorter
  than `sight_given`. Where `wall_tolerance` is set, the free space is taken to reach that far into the walls.
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

Nothing else decides what counts as a return. The environments judge step by step with `advance` and `judge_claim`;
`cyclic_env.task.trajectory_truth` judges whole trajectories with the same functions.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from cyclic_env.config import ClosureConfig
from cyclic_env.jit import compiled, inlined
from cyclic_env.simulation.wall_index import line_of_sight
from cyclic_env.task.homology import is_independent, loop_windings
from cyclic_env.task.path_history import (
    begin_path,
    box_square,
    extend_path,
    last_step_away,
    mark_counted,
    visit_end,
)

RULES_VERSION = 2
"""Version of the definitions above. A recording with another version, or none, was judged by other rules.

1. Every revisit step could begin or extend a revisit event, and only a correct claim within an event recognised it.
2. Ground counts once: events are runs of fresh steps, and a correct claim just before an event recognises it, too.
   A cycle is a hole with a lap of at least 40 m (`cyclic_env.floor_plans.cycles`); it was one with a ring of 40 m.
"""

NO_CLAIM, NEAREST = -2, -1
"""Values in place of a claimed step: no claim is made, and the claim is of the nearest step that t returns to."""

RETURNS, ELSEWHERE, TOO_SOON = 1, 0, -1
"""How a step relates to an earlier one: a claim is correct, false, or ignored as failing by gap or leave alone."""


class ClosureRules(NamedTuple):
    """The numbers of `ClosureConfig`, as the compiled code takes them."""

    return_radius: float
    gap: float
    leave_radius: float
    event_gap: float
    event_length_min: float
    claim_spacing: float
    sight_given: float


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
    """Take the robot's next step, to (x, y), find whether it is a revisit, and begin or settle revisit events."""
    status = robot.status
    dx, dy = x - robot.track[status.steps, 0], y - robot.track[status.steps, 1]
    advance_along(robot, building, rules, x, y, status.path_length + math.sqrt(dx * dx + dy * dy))


@inlined
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
    """Count a closed cycle if the loop from step k closes a new one."""
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
    if not _sees(robot, building, rules, k):
        return ELSEWHERE
    if k <= status.gap_step and k < last_step_away(robot, rules.leave_radius):
        return RETURNS
    return TOO_SOON


@compiled
def _square_distance(track, t, k):
    dx, dy = track[k, 0] - track[t, 0], track[k, 1] - track[t, 1]
    return dx * dx + dy * dy


@compiled
def _sees(robot, building, rules, k):
    """Tell whether the position of step k is in sight of the robot."""
    track, t = robot.track, robot.status.steps
    if _square_distance(track, t, k) < rules.sight_given * rules.sight_given:
        return True
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
    last_known = False  # whether `last` is also before the robot was away, which is found when first needed
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
                    if better and _sees(robot, building, rules, k):
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
                    if near and _sees(robot, building, rules, k):
                        return True
                visit = box.next_counted
    return False


@compiled
def precision_of(status):
    """Return the share of recognised events among recognised events and false claims; 1 if there are none."""
    judged = status.recognised + status.false_claims
    return status.recognised / judged if judged > 0 else 1.0


@compiled
def recall_of(status):
    """Return the share of settled events that were recognised; 1 if there are none."""
    return status.recognised / status.revisits if status.revisits > 0 else 1.0

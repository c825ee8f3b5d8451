"""Whole trajectories and the claims made on them, judged as `cyclic_env.task.loop_closure` judges each step."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely

from cyclic_env.config import ClosureConfig
from cyclic_env.errors import UsageError
from cyclic_env.floor_plans import FloorPlan
from cyclic_env.jit import compiled
from cyclic_env.simulation.wall_index import no_walls
from cyclic_env.task.loop_closure import (
    ELSEWHERE,
    NEAREST,
    NO_CLAIM,
    advance_along,
    begin,
    closure_rules,
    compare_steps,
    judge_claim,
    precision_of,
    recall_of,
    settle_event,
)
from cyclic_env.task.path_history import (
    STATUS,
    ClosureMemory,
    allocate,
    allocate_memory,
    begin_path,
    building_view,
    extend_path,
    robot_view,
)

SIGHT_GIVEN = 1.0
"""Metres within which the positions of a trajectory that doesn't fit its plan are in sight of each other."""

WALL_TOLERANCE_MAX = 1.5
"""Metres. A position that lies farther outside the free space is off the plan, however badly a trajectory fits."""

OPEN_CELLS_MAX = 1_000
"""Cells along each side of a trajectory without a plan, at most; positions beyond belong to the outermost cells."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TrajectoryJudgement:
    """The truth about a trajectory and the claims made on it.

    Attributes
    ----------
    revisit : (T + 1,) bool
        Whether each step is a revisit; the first never is.
    fresh : (T + 1,) bool
        Whether it is a revisit of ground that no counted event has covered before.
    claims : (c,) CLAIM
        The judged claims, in order; others were ignored. A `match` of -1 is a claim with no step to name.
    claim_errors_m : (c,) float64
        Distance between the two positions of each judged claim; 0.0 where it names no step.
    false_claims, revisits, revisits_recognised, cycles_closed, cycles_total : int
    precision, recall : float
        1.0 while there is nothing to count.
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
        If a shape is wrong, a position isn't finite, the path gets shorter, or a claim names a later step.
    """
    config = config or ClosureConfig()
    track = _checked_trajectory(trajectory)
    claimed = _checked_claims(claims, len(track))
    memory = memory_for(plan, track, config)
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
    """Return how a claim at each of `steps` to be back at an earlier one of them would be judged.

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
        As `judge_trajectory` does, and if `steps` are not ascending numbers of steps.
    """
    config = config or ClosureConfig()
    track = _checked_trajectory(trajectory)
    chosen = np.arange(len(track)) if steps is None else np.asarray(steps)
    inside = chosen.ndim == 1 and chosen.dtype.kind in "iu" and (chosen >= 0).all() and (chosen < len(track)).all()
    if not inside or (np.diff(chosen.astype(np.int64)) <= 0).any():
        raise UsageError(f"the steps must be ascending whole numbers from 0 to {len(track) - 1}.")
    relations = np.full((len(chosen), len(chosen)), ELSEWHERE, np.int8)
    _compare_all(memory_for(plan, track, config), closure_rules(config), track, chosen.astype(np.int64), relations)
    return relations


def closure_config_for(plan: FloorPlan | None, positions: np.ndarray) -> ClosureConfig:
    """Return the settings with which a trajectory is judged that need not fit the floor plan exactly.

    One that stays in free space, or has no plan, is judged as in the simulator. Otherwise positions nearer than
    `SIGHT_GIVEN` to each other are in sight, and the walls let sight through as deep as the trajectory runs into them:
    up to the greatest distance of a position `(n, 2)` from the free space, rounded up to a decimetre, without the
    positions beyond `WALL_TOLERANCE_MAX`.

    Raises
    ------
    UsageError
        If more than half of the positions are beyond.
    """
    if plan is None:
        return ClosureConfig()
    outside_m = np.asarray(shapely.distance(plan.free_space, shapely.points(positions[:, :2])))
    near = outside_m <= WALL_TOLERANCE_MAX
    if 2 * np.count_nonzero(near) < len(near):
        raise UsageError(
            f"{np.count_nonzero(~near):,} of {len(near):,} positions lie more than {WALL_TOLERANCE_MAX} m outside "
            f"the floor plan {plan.name!r}; they have to be in its frame."
        )
    tolerance = math.ceil(10 * outside_m[near].max()) / 10
    return ClosureConfig(sight_given=SIGHT_GIVEN, wall_tolerance=tolerance) if tolerance else ClosureConfig()


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
            f"the claims must be at ascending steps from 1 to {count - 1}, each of {NEAREST} or a step up to its own."
        )
    claimed = np.full(count, NO_CLAIM, np.int64)
    claimed[steps] = matches
    return claimed


def memory_for(plan: FloorPlan | None, track: np.ndarray, config: ClosureConfig) -> ClosureMemory:
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

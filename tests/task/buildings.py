"""Buildings drawn by hand, ways through them, and what the compiled truth about loop closures says of them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numba import njit
from shapely.geometry import Polygon, box

from cyclic_env.config import ClosureConfig
from cyclic_env.floor_plans import FloorPlan
from cyclic_env.task.loop_closure import NEAREST, NO_CLAIM, advance, begin, closure_rules, judge_claim, settle_event
from cyclic_env.task.path_history import STATUS, allocate_memory, building_view, robot_view
from tests.task.closure_twin import Claim, Position

Sides = tuple[float, float, float, float]


def with_holes(outline: Sides, *holes: Sides) -> Polygon:
    """Return a rectangle with rectangular holes, each given by its west, south, east and north side."""
    return Polygon(box(*outline).exterior, [box(*hole).exterior for hole in holes])


HALL = FloorPlan("hall", box(0, 0, 60, 60), (5.0, 5.0, 0.0))
THIN_WALL = FloorPlan(
    "thin_wall",
    Polygon([(0, 0), (30, 0), (30, 16), (30.25, 16), (30.25, 0), (60, 0), (60, 20), (0, 20)]),
    (5.0, 5.0, 0.0),
)
"""A hall of 60 m x 20 m, nearly cut in two by a wall 0.25 m thick that ends at y = 16 m."""
RING = FloorPlan("ring", with_holes((0, 0, 24, 24), (4, 4, 20, 20)), (12.0, 2.0, 0.0))
"""A corridor 4 m wide, whose middle is a square of 20 m."""
EIGHT = FloorPlan("eight", with_holes((0, 0, 44, 24), (4, 4, 20, 20), (24, 4, 40, 20)), (22.0, 12.0, 0.0))
"""Two such rings, with the corridor between them in common."""
PILLAR = FloorPlan("pillar", with_holes((0, 0, 80, 40), (17, 17, 23, 23), (50, 10, 70, 30)), (10.0, 10.0, 0.0))
"""A hall with a pillar, whose ring of 24 m is too short for a cycle, and a block that is one."""

TWIN_FIELDS = {
    name: name
    for name in ("revisit", "fresh", "claim_judged", "claim_correct", "claims", "false_claims", "revisits", "new_cycle")
} | {"cycles_closed": "cycles_closed", "revisits_recognised": "recognised", "missed": "missed_now"}
"""The compiled code's name for each field of the twin's truth."""

STEP = 0.25
"""Metres between two steps of the ways below: a power of two, so that sums and distances along the axes are exact."""

RING_LAP = [(12, 2), (22, 2), (22, 22), (2, 22), (2, 2), (12, 2)]
WEST_LAP = [(22, 12), (22, 2), (2, 2), (2, 22), (22, 22), (22, 12)]
EAST_LAP = [(22, 12), (22, 2), (42, 2), (42, 22), (22, 22), (22, 12)]


@njit  # not cached: numba's cache does not notice when the functions that are called here change
def run_compiled(memory, rules, positions, claimed, ends, record):
    robot, building = robot_view(memory, 0), building_view(memory, 0)
    begin(robot, building, positions[0, 0], positions[0, 1])
    record[0] = memory.status[0]
    for t in range(1, positions.shape[0]):
        advance(robot, building, rules, positions[t, 0], positions[t, 1])
        judge_claim(robot, building, rules, claimed[t - 1])
        if ends and t == positions.shape[0] - 1:
            settle_event(robot, building, rules)
        record[t] = memory.status[0]


def compiled_run(
    plan: FloorPlan,
    positions: Sequence[Position],
    claims: Sequence[Claim] | Mapping[int, Claim],
    config: ClosureConfig | None = None,
    *,
    ends: bool = True,
) -> tuple[np.ndarray, list[tuple[Any, ...]]]:
    """Return the record after every step, a `(T + 1,)` array of `STATUS`, and the judged claims as tuples of `CLAIM`.

    Claims are a sequence from step 1 on, or given by step.
    """
    config, steps = config or ClosureConfig(), len(positions) - 1
    if isinstance(claims, Mapping):
        claims = [claims.get(t) for t in range(1, steps + 1)]
    names = {None: NO_CLAIM, "nearest": NEAREST}
    claimed = np.array([names.get(claim, claim) for claim in claims], np.int64)
    record = np.zeros(steps + 1, STATUS)
    memory = allocate_memory(plan, 1, steps, config)
    run_compiled(memory, closure_rules(config), np.array(positions, np.float64), claimed, ends, record)
    return record, memory.claims[0, : record["claims"][-1]].tolist()


def compiled_truth(*args: Any, **settings: Any) -> np.ndarray:
    """Return the record of `compiled_run` alone."""
    return compiled_run(*args, **settings)[0]


def way(*corners: Position, step: float = STEP) -> list[Position]:
    """Return the positions, a `step` apart, along a polyline."""
    positions = [corners[0]]
    for (ax, ay), (bx, by) in pairwise(corners):
        n = max(1, math.ceil(math.hypot(bx - ax, by - ay) / step))
        positions += [(ax + (bx - ax) * i / n, ay + (by - ay) * i / n) for i in range(1, n + 1)]
    return positions

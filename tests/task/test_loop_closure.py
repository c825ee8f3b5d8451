"""The truth about loop closures: a truth table on plans drawn by hand, and the compiled code against its plain twin."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from numba import njit
from shapely.geometry import Polygon, box

from cyclic_env.config import ACTION_TYPES, ActionType, ClosureConfig, RobotConfig
from cyclic_env.envs.cyclic_loop import CyclicLoopEnv
from cyclic_env.floor_plans import FloorPlan, load_floor_plan, map_names
from cyclic_env.task.judgement import judge_trajectory
from cyclic_env.task.loop_closure import (
    NEAREST,
    NO_CLAIM,
    advance,
    begin,
    closure_rules,
    judge_claim,
    settle_event,
)
from cyclic_env.task.path_history import STATUS, allocate_memory, building_view, robot_view
from tests.task.closure_twin import Claim, ClosureTwin, Position, Truth, line_of_sight, rank

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

STEP = 0.25
"""Metres between two steps of the ways below: a power of two, so that sums and distances along the axes are exact."""

RING_LAP = [(12, 2), (22, 2), (22, 22), (2, 22), (2, 2), (12, 2)]
WEST_LAP = [(22, 12), (22, 2), (2, 2), (2, 22), (22, 22), (22, 12)]
EAST_LAP = [(22, 12), (22, 2), (42, 2), (42, 22), (22, 22), (22, 12)]
LAP_STEPS = 320
"""Steps of each of these laps, 80 m long."""


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


# There and back: 20 m along a straight line, from x = 5 m to x = 25 m at y = 5 m. ------------------------------------

THERE_AND_BACK = way((5, 5), (25, 5), (5, 5))


def there(x: float) -> int:
    return round((x - 5) / STEP)


def back(x: float) -> int:
    return round((25 - 5 + 25 - x) / STEP)


def test_claim_of_the_place_where_one_is_again_is_correct():
    last = compiled_truth(HALL, THERE_AND_BACK, {back(5): there(5)})[-1]
    assert (last["claim_judged"], last["claim_correct"], last["claims"], last["false_claims"]) == (1, 1, 1, 0)


def test_claim_of_another_place_is_false_and_its_error_is_the_distance():
    last = compiled_truth(HALL, THERE_AND_BACK, {back(5): there(20)})[-1]
    assert (last["claim_judged"], last["claim_correct"], last["false_claims"], last["claim_error"]) == (1, 0, 1, 15.0)


def test_claim_of_a_place_three_metres_off_is_correct():
    last = compiled_truth(HALL, THERE_AND_BACK, {back(5): there(8)})[-1]
    assert (last["claim_correct"], last["claim_error"]) == (1, 3.0)


def test_claim_of_a_place_more_than_three_metres_off_is_false():
    last = compiled_truth(HALL, THERE_AND_BACK, {back(5): there(8.25)})[-1]
    assert (last["false_claims"], last["claim_error"]) == (1, 3.25)


def test_claim_after_twenty_metres_of_path_and_ten_metres_away_is_correct():
    at_15 = compiled_truth(HALL, THERE_AND_BACK, {back(15): there(15)})[back(15)]
    assert at_15["claim_correct"]


def test_claim_before_twenty_metres_of_path_is_ignored():
    at_15 = compiled_truth(HALL, THERE_AND_BACK, {back(15): there(15.25)})[back(15)]
    assert (at_15["claim_judged"], at_15["claims"], at_15["claim_error"]) == (0, 0, 0.0)


def test_claim_before_the_robot_was_ten_metres_away_is_ignored():
    at_15 = compiled_truth(HALL, THERE_AND_BACK, {back(15.25): there(14)})[back(15.25)]
    assert (at_15["claim_judged"], at_15["claims"], at_15["claim_error"]) == (0, 0, 0.0)


def test_being_away_before_the_claimed_step_does_not_count():
    # From (25, 5) to (8, 5), then 24 m to and fro within 6 m: the robot was 17 m away, but before the claimed step.
    positions = way((25, 5), (8, 5), (14, 5), (8, 5), (14, 5), (8, 5))
    last = compiled_truth(HALL, positions, {len(positions) - 1: round(17 / STEP)})[-1]
    assert (last["claim_judged"], last["revisit"]) == (0, 0)


def test_revisit_begins_where_gap_and_leave_radius_are_reached():
    record = compiled_truth(HALL, THERE_AND_BACK, {})
    assert np.flatnonzero(record["revisit"])[0] == back(15)


def test_claim_of_the_step_itself_is_ignored():
    record = compiled_truth(HALL, THERE_AND_BACK, {t: t for t in range(1, len(THERE_AND_BACK))})
    assert not record["claim_judged"].any()


def test_false_claim_of_the_start_is_false():
    last = compiled_truth(HALL, THERE_AND_BACK, {back(25): 0})[-1]
    assert (last["claims"], last["false_claims"]) == (1, 1)


def test_nearest_claim_where_there_is_none_is_false_without_an_error():
    at_20 = compiled_truth(HALL, THERE_AND_BACK, {there(20): "nearest"})[there(20)]
    assert (at_20["claim_judged"], at_20["claim_correct"], at_20["claim_error"]) == (1, 0, 0.0)


def test_nearest_claim_takes_the_nearest_step():
    positions = way((5, 5), (30, 5), (30, 6.5), (5, 6.5))
    last = compiled_truth(HALL, positions, {len(positions) - 1: "nearest"})[-1]
    assert (last["claim_correct"], last["claim_error"]) == (1, 1.5)


def test_nearest_claim_takes_the_earliest_of_equally_near_steps():
    positions = way(*WEST_LAP, *EAST_LAP[1:])  # the middle of the eight, at the beginning, between, and at the end
    _, judged = compiled_run(EIGHT, positions, {2 * LAP_STEPS: "nearest"})
    assert judged == [(2 * LAP_STEPS, 0, True, True)]


def test_nearest_claim_takes_the_earliest_of_steps_equally_near_on_either_side():
    # East 2 m off first, then west 2 m off, and between the two at the end.
    positions = way((34, 5), (34, 30), (30, 30), (30, 5), (30, 30), (32, 30), (32, 5))
    _, judged = compiled_run(HALL, positions, {len(positions) - 1: "nearest"})
    assert judged == [(len(positions) - 1, 0, True, False)]


# Claims that come soon after another --------------------------------------------------------------------------------


def test_second_claim_within_two_metres_is_ignored():
    at_10 = compiled_truth(HALL, THERE_AND_BACK, {back(11.75): there(11.75), back(10): there(10)})[back(10)]
    assert (at_10["claim_judged"], at_10["claims"]) == (0, 1)


def test_second_claim_after_two_metres_is_judged():
    at_10 = compiled_truth(HALL, THERE_AND_BACK, {back(12): there(12), back(10): there(10)})[back(10)]
    assert (at_10["claim_judged"], at_10["claims"]) == (1, 2)


def test_second_false_claim_within_two_metres_is_ignored():
    last = compiled_truth(HALL, THERE_AND_BACK, {back(11.75): there(25), back(10): there(25)})[-1]
    assert last["false_claims"] == 1


def test_claim_ignored_for_coming_soon_puts_off_no_later_one():
    claims = {back(12): there(12), back(10.5): there(10.5), back(10): there(10)}
    assert compiled_truth(HALL, THERE_AND_BACK, claims)[back(10)]["claim_judged"]


def test_claim_ignored_for_coming_too_early_puts_off_no_later_one():
    claims = {back(15.25): there(14), back(15): there(15)}
    assert compiled_truth(HALL, THERE_AND_BACK, claims)[back(15)]["claim_correct"]


def test_first_claim_is_judged_however_short_the_path():
    config = ClosureConfig(return_radius=0.5)
    last = compiled_truth(HALL, way((5, 5), (6, 5)), {4: 0}, config)[-1]
    assert (last["claim_judged"], last["claim_error"]) == (1, 1.0)


# Events ---------------------------------------------------------------------------------------------------------------


def with_a_bump(y: float) -> list[Position]:
    """Return a way along y = 5 m and back along y = 7 m, but for a bump at x = 30 m: no revisit above y = 8 m."""
    return way((5, 5), (55, 5), (55, 7), (30, 7), (30, y), (30, 7), (10, 7))


def dipping_to(y: float, end: float = 12.0) -> list[Position]:
    """Return a way along y = 5 m, and a detour from where it dips down to y at x = 25 m: a revisit up to y = 8 m."""
    return way((5, 5), (45, 5), (45, 25), (25, 25), (25, y), (25, end))


DIP_BEGINS = round((40 + 20 + 20 + 17) / STEP)
"""Step at which the dip comes down to y = 8 m."""


def test_runs_of_revisits_less_than_two_metres_apart_are_one_event():
    assert compiled_truth(HALL, with_a_bump(8.75), {})[-1]["revisits"] == 1


def test_runs_of_revisits_two_metres_apart_are_two_events():
    assert compiled_truth(HALL, with_a_bump(9.0), {})[-1]["revisits"] == 2


def test_runs_of_revisits_are_one_event_even_without_an_event_gap():
    record = compiled_truth(HALL, THERE_AND_BACK, {}, ClosureConfig(event_gap=0.0))
    assert record[-1]["revisits"] == 1


def test_correct_claim_recognises_its_own_event_only():
    positions = with_a_bump(9.0)
    first_event = round((50 + 2 + 20) / STEP)
    last = compiled_truth(HALL, positions, {first_event: "nearest"})[-1]
    assert (last["revisits"], last["recognised"]) == (2, 1)


def test_false_claim_recognises_no_event():
    last = compiled_truth(HALL, THERE_AND_BACK, {back(10): there(25)})[-1]
    assert (last["revisits"], last["recognised"]) == (1, 0)


def test_further_correct_claims_in_an_event_pad_nothing():
    last = compiled_truth(HALL, THERE_AND_BACK, {back(15): there(15), back(13): there(13), back(11): there(11)})[-1]
    assert (last["claims"], last["revisits"], last["recognised"]) == (3, 1, 1)


def test_recognised_event_counts_only_when_it_settles():
    record = compiled_truth(HALL, THERE_AND_BACK, {back(15): there(15)}, ends=False)
    assert (record["recognised"] == 0).all()


def test_event_of_one_metre_counts():
    assert compiled_truth(HALL, dipping_to(7.5), {})[-1]["revisits"] == 1


def test_event_under_one_metre_is_not_missed():
    last = compiled_truth(HALL, dipping_to(7.75), {})
    assert (last["revisits"][-1], last["missed_now"].sum()) == (0, 0)


def test_event_under_one_metre_is_not_recognised_though_its_claim_is_correct():
    last = compiled_truth(HALL, dipping_to(7.75), {DIP_BEGINS + 1: "nearest"})[-1]
    assert (last["claims"], last["false_claims"], last["revisits"], last["recognised"]) == (1, 0, 0, 0)


def test_missed_event_settles_two_metres_after_its_last_revisit():
    record = compiled_truth(HALL, dipping_to(7.5), {})
    last_revisit = DIP_BEGINS + round(1 / STEP)
    assert np.flatnonzero(record["missed_now"]).tolist() == [last_revisit + round(2 / STEP)]


def test_missed_event_settles_at_the_end_of_the_episode():
    record = compiled_truth(HALL, dipping_to(7.5, end=8.0), {})
    assert np.flatnonzero(record["missed_now"]).tolist() == [len(record) - 1]


def test_open_event_does_not_settle_while_the_episode_runs():
    assert not compiled_truth(HALL, dipping_to(7.5, end=8.0), {}, ends=False)["missed_now"].any()


# Ground counts once ---------------------------------------------------------------------------------------------------

DETOUR_AT_5 = way((5, 5), (25, 5), (5, 5), (5, 12), (5, 5), (25, 5))
"""There and back, a little way north until the event has settled that ends there, and there again."""


def there_again(x: float) -> int:
    return round((20 + 20 + 7 + 7 + x - 5) / STEP)


@pytest.mark.parametrize("swings", [3, 4, 40])
def test_driving_to_and_fro_in_a_corridor_makes_no_more_than_two_events(swings: int):
    positions = way(*[(5, 5), (17, 5)] * swings)
    record = compiled_truth(HALL, positions, dict.fromkeys(range(1, len(positions)), "nearest"))
    assert record["revisits"][-1] <= 2
    assert record["revisit"][-12 * 4 :].any()


def test_third_lap_is_a_revisit_but_no_event():
    record = compiled_truth(RING, way(*RING_LAP, *RING_LAP[1:], *RING_LAP[1:]), {3 * LAP_STEPS: "nearest"})
    assert record["revisit"][-1]
    assert record["revisits"][-1] == 1


def test_event_begins_beyond_the_return_radius_of_the_counted_ground():
    record = compiled_truth(HALL, DETOUR_AT_5, {})
    assert not record["fresh"][there_again(5) : there_again(18) + 1].any()
    assert record["fresh"][there_again(18.25) :].all()
    assert record["revisits"][-1] == 2


def test_ground_of_a_missed_event_counts_no_second_time():
    last = compiled_truth(HALL, DETOUR_AT_5, {there_again(10): there(10)})[-1]
    assert (last["claims"], last["false_claims"], last["recognised"]) == (1, 0, 0)


def test_ground_of_an_event_too_short_to_count_stays_fresh():
    positions = [*dipping_to(7.75), *way((25, 12), (25, 30), (25, 7), (25, 12))]
    record = compiled_truth(HALL, positions, {})
    second_dip = [t for t, (_, y) in enumerate(positions) if y <= 8 and t > DIP_BEGINS + 10]
    assert not record["revisits"][DIP_BEGINS + 20]
    assert record["fresh"][second_dip].all()


@pytest.mark.parametrize(("plan", "fresh"), [(THIN_WALL, True), (HALL, False)])
def test_counted_ground_behind_a_wall_is_other_ground(plan: FloorPlan, fresh: bool):
    west = way((29, 14), (29, 2), (5, 2), (29, 2), (29, 14))
    around_and_east = way((29, 14), (29, 18), (31.25, 18), (31.25, 2), (55, 2), (31.25, 2), (31.25, 12))
    last = compiled_truth(plan, [*west, *around_and_east[1:]], {})[-1]
    assert (last["revisit"], last["fresh"]) == (True, fresh)


@pytest.mark.parametrize(("x", "recognised"), [(16.25, 0), (16.5, 1)])
def test_correct_claim_less_than_two_metres_before_an_event_recognises_it(x: float, recognised: int):
    record = compiled_truth(HALL, DETOUR_AT_5, {there_again(x): "nearest"})
    assert record["claim_correct"][there_again(x)]
    assert record["recognised"][-1] == recognised


def test_false_claim_just_before_an_event_keeps_a_correct_one_in_it_from_being_judged():
    claims = {DIP_BEGINS - 1: 0, **dict.fromkeys(range(DIP_BEGINS, DIP_BEGINS + 7), "nearest")}
    last = compiled_truth(HALL, dipping_to(7.5), claims)[-1]
    assert (last["claims"], last["revisits"], last["recognised"]) == (1, 1, 0)


def test_event_settles_before_the_step_two_metres_later_is_judged():
    positions = with_a_bump(9.0)
    record = compiled_truth(HALL, positions, {})
    back_down = [t for t, position in enumerate(positions) if position == (30, 8)][1]
    assert (record["revisit"][back_down], record["fresh"][back_down], record["revisits"][back_down]) == (1, 0, 1)


# Walls ----------------------------------------------------------------------------------------------------------------

AROUND_THE_WALL = way((29, 2), (29, 18), (31.25, 18), (31.25, 2))


def test_claim_through_a_wall_is_false():
    last = compiled_truth(THIN_WALL, AROUND_THE_WALL, {len(AROUND_THE_WALL) - 1: 0})[-1]
    assert (last["false_claims"], last["claim_error"], last["revisit"]) == (1, 2.25, 0)


def test_the_same_claim_is_correct_without_the_wall():
    last = compiled_truth(HALL, AROUND_THE_WALL, {len(AROUND_THE_WALL) - 1: 0})[-1]
    assert (last["claim_correct"], last["claim_error"]) == (1, 2.25)


@pytest.mark.parametrize(("y", "sees"), [(16.0, False), (16.25, True)])
def test_line_of_sight_that_touches_a_wall_is_blocked(y: float, sees: bool):
    positions = way((29, y), (29, 2), (29, 18), (31.25, 18), (31.25, y))
    assert compiled_truth(THIN_WALL, positions, {len(positions) - 1: 0})[-1]["claim_correct"] == sees


# Cycles ---------------------------------------------------------------------------------------------------------------


def test_lap_closes_a_new_cycle():
    last = compiled_truth(RING, way(*RING_LAP), {LAP_STEPS: 0})[-1]
    assert (last["new_cycle"], last["cycles_closed"]) == (1, 1)


def test_lap_closed_by_a_straight_line_counts():
    # 2 m short of the whole lap
    assert compiled_truth(RING, way(*RING_LAP), {LAP_STEPS - round(2 / STEP): 0})[-1]["cycles_closed"] == 1


def test_lap_without_a_claim_closes_nothing():
    assert compiled_truth(RING, way(*RING_LAP), {})[-1]["cycles_closed"] == 0


def test_false_claim_closes_nothing():
    last = compiled_truth(RING, way(*RING_LAP), {LAP_STEPS: LAP_STEPS // 2})[-1]
    assert (last["false_claims"], last["cycles_closed"]) == (1, 0)


@pytest.mark.parametrize("claimed", [0, LAP_STEPS])
def test_second_lap_around_the_same_block_earns_nothing(claimed: int):
    record = compiled_truth(RING, way(*RING_LAP, *RING_LAP[1:]), {LAP_STEPS: 0, 2 * LAP_STEPS: claimed})
    assert (record["claim_correct"].sum(), record["cycles_closed"][-1]) == (2, 1)


def test_lap_the_other_way_round_earns_nothing():
    record = compiled_truth(RING, way(*RING_LAP, *RING_LAP[-2::-1]), {LAP_STEPS: 0, 2 * LAP_STEPS: LAP_STEPS})
    assert (record["claim_correct"].sum(), record["cycles_closed"][-1]) == (2, 1)


def test_lap_unwound_the_other_way_round_closes_nothing():
    last = compiled_truth(RING, way(*RING_LAP, *RING_LAP[-2::-1]), {2 * LAP_STEPS: 0})[-1]
    assert (last["claim_correct"], last["cycles_closed"]) == (1, 0)


def test_figure_of_eight_closes_two_cycles():
    record = compiled_truth(EIGHT, way(*WEST_LAP, *EAST_LAP[1:]), {LAP_STEPS: 0, 2 * LAP_STEPS: LAP_STEPS})
    assert np.flatnonzero(record["new_cycle"]).tolist() == [LAP_STEPS, 2 * LAP_STEPS]


OUTER_LAP = [(22, 2), (42, 2), (42, 22), (2, 22), (2, 2), (22, 2)]
OUTER_STEPS = 480
INNER_WEST = [(22, 22), (2, 22), (2, 2), (22, 2)]
INNER_EAST = [(42, 2), (42, 22), (22, 22), (22, 2)]


def test_outer_loop_of_two_is_one_cycle():
    assert compiled_truth(EIGHT, way(*OUTER_LAP), {OUTER_STEPS: 0})[-1]["cycles_closed"] == 1


def test_one_block_after_the_loop_around_both_is_a_second_cycle():
    claims = {OUTER_STEPS: 0, OUTER_STEPS + LAP_STEPS: OUTER_STEPS}
    assert compiled_truth(EIGHT, way(*OUTER_LAP, *INNER_WEST), claims)[-1]["cycles_closed"] == 2


def test_two_blocks_and_the_loop_around_both_are_no_three_cycles():
    ends = [OUTER_STEPS, OUTER_STEPS + LAP_STEPS, OUTER_STEPS + 2 * LAP_STEPS]
    record = compiled_truth(EIGHT, way(*OUTER_LAP, *INNER_WEST, *INNER_EAST), dict(zip(ends, [0, *ends], strict=False)))
    assert (record["claim_correct"].sum(), record["cycles_closed"][-1]) == (3, 2)


def test_lap_around_a_pillar_earns_nothing():
    positions = way((10, 10), (30, 10), (30, 30), (10, 30), (10, 10))
    last = compiled_truth(PILLAR, positions, {len(positions) - 1: 0})[-1]
    assert (last["claim_correct"], last["cycles_closed"]) == (1, 0)


def test_spinning_on_the_spot_is_never_judged():
    # It drives 15 m, stands there, and claims at every step to be where it has just arrived.
    arrived = round(15 / STEP)
    positions = way((5, 5), (20, 5)) + [(20.0, 5.0)] * 300
    record = compiled_truth(HALL, positions, dict.fromkeys(range(arrived + 1, len(positions)), arrived))
    assert not (record["claim_judged"] | record["revisit"]).any()


def test_driving_in_small_circles_is_never_judged():
    positions = way(*[(5, 5), (8, 5), (8, 8), (5, 8)] * 10)
    record = compiled_truth(HALL, positions, dict.fromkeys(range(1, len(positions)), 0))
    assert not (record["claim_correct"] | record["revisit"]).any()


TO_AND_FRO = way((2, 2), (22, 2), (2, 2), (22, 2), (2, 2))


def test_driving_to_and_fro_is_a_revisit_that_can_be_recognised():
    last = compiled_truth(RING, TO_AND_FRO, {round(35 / STEP): "nearest"})[-1]
    assert (last["revisits"], last["recognised"]) == (1, 1)


def test_driving_to_and_fro_closes_no_cycle():
    claims = dict.fromkeys(range(1, len(TO_AND_FRO)), "nearest")
    record = compiled_truth(RING, TO_AND_FRO, claims)
    assert (record["claim_correct"].sum() > 10, record["cycles_closed"][-1]) == (True, 0)


def test_memory_of_an_earlier_episode_is_forgotten():
    lap, hall = way(*RING_LAP), way((12, 2), (22, 2), (12, 2))
    memory = allocate_memory(RING, 1, len(lap), ClosureConfig())
    rules = closure_rules(ClosureConfig())
    for positions in (lap, hall):
        claimed = np.full(len(positions) - 1, NO_CLAIM)
        claimed[-1] = 0
        record = np.zeros(len(positions), STATUS)
        run_compiled(memory, rules, np.array(positions, np.float64), claimed, True, record)
    fresh = compiled_truth(RING, hall, {len(hall) - 1: 0})
    for column in TWIN_FIELDS.values():
        assert record[column].tolist() == fresh[column].tolist()


# The compiled truth and its plain twin --------------------------------------------------------------------------------

TWIN_FIELDS = {
    "revisit": "revisit",
    "fresh": "fresh",
    "claim_judged": "claim_judged",
    "claim_correct": "claim_correct",
    "claims": "claims",
    "false_claims": "false_claims",
    "revisits": "revisits",
    "revisits_recognised": "recognised",
    "missed": "missed_now",
    "new_cycle": "new_cycle",
    "cycles_closed": "cycles_closed",
}
"""What the twin says, by what the compiled code calls it."""

SMALL = ClosureConfig(
    return_radius=1.0, gap=5.0, leave_radius=2.5, event_gap=0.5, event_length_min=0.25, claim_spacing=0.5
)
"""So that much happens in a short walk."""
RAW = ClosureConfig(
    return_radius=2.0, gap=8.0, leave_radius=3.0, event_gap=0.0, event_length_min=0.0, claim_spacing=0.0
)
THROUGH_WALLS = replace(SMALL, sight_given=0.75)


def assert_twin_agrees(
    plan: FloorPlan, positions: Sequence[Position], claims: Sequence[Claim], config: ClosureConfig, *, ends: bool
) -> None:
    record, judged = compiled_run(plan, positions, claims, config, ends=ends)
    twin = list(ClosureTwin(plan, positions, config).truths(claims, ends=ends))
    for name, column in TWIN_FIELDS.items():
        expected = np.array([getattr(truth, name) for truth in twin])
        differ = np.flatnonzero(record[column][1:] != expected)
        assert not len(differ), f"{name} differs first at step {differ[0] + 1}"
    np.testing.assert_allclose(record["claim_error"][1:], [truth.claim_error_m for truth in twin], rtol=0, atol=1e-9)
    assert judged == judged_claims(twin)


def judged_claims(twin: Sequence[Truth]) -> list[tuple[Any, ...]]:
    """Return step, claimed step, whether it is correct, and whether it closes a new cycle, of each judged claim."""
    return [
        (t, truth.claimed, truth.claim_correct, bool(truth.new_cycle))
        for t, truth in enumerate(twin, 1)
        if truth.claim_judged
    ]


CLAIM_KINDS = ["none", "none", "none", "none", "nearest", "true", "true", "random", "start", "here"]


def claims_of_kinds(twin: ClosureTwin, kinds: Sequence[str]) -> list[Claim]:
    """Return a claim for each step of the twin's path, true ones and others, by kind; the kinds are repeated."""
    claims: list[Claim] = []
    for t in range(1, len(twin.positions)):
        kind = kinds[t % len(kinds)]
        by_kind = {"none": None, "nearest": "nearest", "start": 0, "here": t, "random": t * 7919 % (t + 1)}
        claims.append(twin.nearest(t) if kind == "true" else by_kind[kind])
    return claims


def free_walk(plan: FloorPlan, start: Position, legs: Sequence[tuple[float, int]]) -> list[Position]:
    """Return a walk of legs (heading in eighths of a turn, number of steps of 0.5 m), each cut short at a wall."""
    walls = ClosureTwin(plan, [start]).walls
    positions = [start]
    for eighths, count in legs:
        if eighths == int(eighths):  # exactly on a lattice, diagonals included
            dx, dy = (0.5 * round(math.cos(eighths * math.pi / 4)), 0.5 * round(math.sin(eighths * math.pi / 4)))
        else:
            dx, dy = 0.5 * math.cos(eighths * math.pi / 4), 0.5 * math.sin(eighths * math.pi / 4)
        for _ in range(count):
            x, y = positions[-1]
            if not line_of_sight(walls, (x, y), (x + dx, y + dy)):
                break
            positions.append((x + dx, y + dy))
    return positions


headings = st.integers(0, 7).map(float) | st.floats(0, 8, allow_nan=False)
legs = st.lists(st.tuples(headings, st.integers(1, 40)), min_size=4, max_size=20)
kinds = st.lists(st.sampled_from(CLAIM_KINDS), min_size=1, max_size=7)


@settings(max_examples=100, deadline=None)
@given(
    plan_start=st.sampled_from(
        [(HALL, (30.0, 30.0)), (THIN_WALL, (29.0, 2.0)), (RING, (2.0, 2.0)), (PILLAR, (15.0, 15.0))]
    ),
    legs=legs,
    kinds=kinds,
    config=st.sampled_from([ClosureConfig(), SMALL, RAW, THROUGH_WALLS]),
    ends=st.booleans(),
)
def test_compiled_truth_equals_its_twin_on_random_walks(plan_start, legs, kinds, config, ends):
    plan, start = plan_start
    positions = free_walk(plan, start, legs)
    claims = claims_of_kinds(ClosureTwin(plan, positions, config), kinds)
    assert_twin_agrees(plan, positions, claims, config, ends=ends)


CROSSINGS = {"A": (2, 2), "B": (22, 2), "C": (42, 2), "D": (42, 22), "E": (22, 22), "F": (2, 22)}
NEXT_TO = {"A": "BF", "B": "ACE", "C": "BD", "D": "CE", "E": "DFB", "F": "EA"}
aside = st.integers(-6, 6).map(lambda n: n / 4)


@settings(max_examples=40, deadline=None)
@given(
    turns=st.lists(st.tuples(st.integers(0, 2), aside, aside), min_size=5, max_size=14),
    kinds=kinds,
    config=st.sampled_from([ClosureConfig(), SMALL]),
)
def test_compiled_truth_equals_its_twin_on_tours_of_an_eight(turns, kinds, config):
    here, corners = "A", [CROSSINGS["A"]]
    for turn, dx, dy in turns:
        here = NEXT_TO[here][turn % len(NEXT_TO[here])]
        corners.append((CROSSINGS[here][0] + dx, CROSSINGS[here][1] + dy))
    positions = way(*corners, step=0.5)
    claims = claims_of_kinds(ClosureTwin(EIGHT, positions, config), kinds)
    assert_twin_agrees(EIGHT, positions, claims, config, ends=True)


# Real drives ----------------------------------------------------------------------------------------------------------

FAST_STEPS = RobotConfig(dt=0.4, substeps=10)
"""Control steps twice as long, so that tours of large buildings take fewer."""


@dataclass
class Drive:
    """What was driven and said, and what the environment answered."""

    plan: FloorPlan
    positions: list[Position] = field(default_factory=list)
    claims: list[Claim] = field(default_factory=list)
    infos: list[dict[str, Any]] = field(default_factory=list)
    rewards: list[float] = field(default_factory=list)
    ended: bool = False


class Hold:
    """Draws wheel speeds and keeps each for 15 steps: fast, slow, in circles, and into walls."""

    def __init__(self, plan: FloorPlan, rng: np.random.Generator) -> None:
        self.start = plan.start
        self.rng = rng
        self.steps = 0
        self.wheels = (0.0, 0.0)

    def __call__(self, x: float, y: float, heading: float) -> tuple[float, float]:
        if self.steps % 15 == 0:
            self.wheels = (float(self.rng.choice([0.4, 1.0, 1.0, -1.0])), float(self.rng.choice([0.4, 1.0, 1.0, -1.0])))
        self.steps += 1
        return self.wheels


class ToAndFro(Hold):
    """Drives forward and back again, 80 steps each."""

    def __call__(self, x: float, y: float, heading: float) -> tuple[float, float]:
        self.steps += 1
        return (1.0, 1.0) if self.steps % 160 < 80 else (-1.0, -1.0)


class Tour(Hold):
    """Follows the middles of the corridors by the true pose; at crossings mostly left, around the block."""

    def __init__(self, plan: FloorPlan, rng: np.random.Generator) -> None:
        super().__init__(plan, rng)
        self.next_to: dict[Position, set[Position]] = {}
        for part in shapely.get_parts(shapely.unary_union([shapely.LineString(line) for line in plan.centrelines])):
            for a, b in pairwise(part.coords):
                self.next_to.setdefault(a, set()).add(b)
                self.next_to.setdefault(b, set()).add(a)
        smallest_block = tuple(plan.cycle_anchors[-1]) if plan.cycles_total else plan.start[:2]
        self.last = min(self.next_to, key=lambda crossing: math.dist(crossing, smallest_block))
        self.goal = min(self.next_to[self.last], key=lambda crossing: math.dist(crossing, smallest_block))
        self.start = (*self.last, direction(self.last, self.goal))

    def __call__(self, x: float, y: float, heading: float) -> tuple[float, float]:
        if math.dist((x, y), self.goal) < 0.5:
            came = direction(self.last, self.goal)
            onward = sorted(
                self.next_to[self.goal] - {self.last} or {self.last},
                key=lambda crossing: math.remainder(direction(self.goal, crossing) - came, math.tau),
            )
            choice = -1 if self.rng.random() < 0.7 else self.rng.integers(len(onward))
            self.last, self.goal = self.goal, onward[choice]
        bearing = math.remainder(direction((x, y), self.goal) - heading, math.tau)
        if abs(bearing) > 0.4:
            swing = math.copysign(0.25, bearing)
            return -swing, swing
        return 0.8 - 0.3 * bearing, 0.8 + 0.3 * bearing


def direction(a: Position, b: Position) -> float:
    return math.atan2(b[1] - a[1], b[0] - a[0])


DRIVERS = {"hold": Hold, "to_and_fro": ToAndFro, "tour": Tour}
STEPS = {"hold": 350, "to_and_fro": 500, "tour": 1100}


def claim_match(env: CyclicLoopEnv, rng: np.random.Generator) -> float | None:
    """Return the match of a claim: often of the nearest earlier place, at times a random one; None for no claim."""
    kind = rng.random()
    if kind > 0.3:
        return None
    if kind < 0.02:
        return float(rng.choice([-1.0, 1.0]))
    if kind < 0.04:
        return float(rng.uniform(-1, 1))
    track = env.trajectory()
    distance = np.hypot(*(track[:, :2] - track[-1, :2]).T)
    distance[track[:, 2] > track[-1, 2] - 20] = np.inf
    k = int(distance.argmin())
    return 2 * k / len(track) - 1 if distance[k] < 3.2 else None


def wheels_action(action_type: str, left: float, right: float, match: float | None) -> np.ndarray:
    """Return the action of that type with those wheel speeds, as near as it can."""
    if action_type == "discrete":
        forward, swing = (left + right) / 2, right - left
        drive = (2 if swing > 0 else 3) if abs(swing) > 0.2 else 1 if forward > 0 else 4
        return np.array([drive, match is not None])
    if action_type == "twist":
        left, right = (left + right) / 2, (right - left) * 1.2 / 0.4 / 3.0
    return np.array([left, right, -1.0 if match is None else 1.0, match or 0.0], np.float32)


def claim_said(action_type: str, action: np.ndarray, t: int) -> Claim:
    """Return what the action says at step t, by the contract of the action spaces."""
    if action_type == "discrete":
        return "nearest" if action[1] else None
    return int(np.rint((float(action[3]) + 1) / 2 * t)) if action[2] > 0 else None


@cache
def drive(
    name: str, driver: str, action_type: ActionType, always_claim: bool = False, step_budget: int | None = None
) -> Drive:
    """Drive on a shipped plan until the budget is spent, or, always claiming at every step, until success."""
    plan, rng = load_floor_plan(name), np.random.default_rng(len(name))
    policy = DRIVERS[driver](plan, rng)
    env = CyclicLoopEnv(
        name,
        action_type=action_type,
        robot=FAST_STEPS if driver == "tour" else RobotConfig(),
        step_budget=step_budget or STEPS[driver],
        laser={"num_beams": 90, "range_max": 12.0 if always_claim else 0.3},  # too short to see all
    )
    _, info = env.reset(seed=0, options={"start": policy.start})
    result = Drive(plan, [(info["x"], info["y"])])
    while not result.ended:
        left, right = policy(info["x"], info["y"], info["heading"])
        match = 0.0 if always_claim else claim_match(env, rng)
        action = wheels_action(action_type, left, right, match)
        _, reward, terminated, truncated, info = env.step(action)
        result.positions.append((info["x"], info["y"]))
        result.claims.append(claim_said(action_type, action, len(result.positions) - 1))
        result.infos.append(info)
        result.rewards.append(float(reward))
        result.ended = terminated or truncated
    env.close()
    return result


DRIVES = [
    *(
        (name, driver, ACTION_TYPES[(i + j) % 3], False)
        for i, name in enumerate(map_names())
        for j, driver in enumerate(DRIVERS)
    ),
    *((name, "tour", "discrete", True) for name in map_names()),
]
every_drive = pytest.mark.parametrize(("name", "driver", "action_type", "always_claim"), DRIVES)


@every_drive
def test_truth_of_a_real_drive_equals_the_twin(name: str, driver: str, action_type: str, always_claim: bool):
    done = drive(name, driver, action_type, always_claim)
    twin = ClosureTwin(done.plan, done.positions)
    missed = 0
    for t, (truth, info) in enumerate(zip(twin.truths(done.claims), done.infos, strict=True), 1):
        for key in TWIN_FIELDS:
            if key not in ("missed", "fresh"):
                assert info[key] == getattr(truth, key), f"{key} differs first at step {t}"
        assert info["claim_error_m"] == pytest.approx(truth.claim_error_m, rel=0, abs=1e-9)
        missed += truth.missed
        assert info["revisits"] - info["revisits_recognised"] == missed


@every_drive
def test_reward_terms_pay_for_what_happened(name: str, driver: str, action_type: str, always_claim: bool):
    done = drive(name, driver, action_type, always_claim)
    before = dict.fromkeys(done.infos[0], 0)
    for info in done.infos:
        new = {key: info[key] - before[key] for key in ("revisits", "revisits_recognised", "false_claims")}
        closed = info["cycles_closed"] - before["cycles_closed"]
        terms = info["reward_terms"]
        assert terms["missed_revisit"] == -1.0 * (new["revisits"] - new["revisits_recognised"])
        assert terms["false_claim"] == -5.0 * new["false_claims"]
        assert terms["new_cycle"] == pytest.approx(50.0 * closed / max(info["cycles_total"], 1))
        before = info


@every_drive
def test_reward_is_the_sum_of_its_terms(name: str, driver: str, action_type: str, always_claim: bool):
    done = drive(name, driver, action_type, always_claim)
    assert done.rewards == pytest.approx([sum(info["reward_terms"].values()) for info in done.infos], abs=1e-12)


@every_drive
def test_precision_and_recall_follow_from_the_counts(name: str, driver: str, action_type: str, always_claim: bool):
    for info in drive(name, driver, action_type, always_claim).infos:
        recognised, settled = info["revisits_recognised"], info["revisits"]
        judged = recognised + info["false_claims"]
        assert info["precision"] == (recognised / judged if judged else 1.0)
        assert info["recall"] == (recognised / settled if settled else 1.0)


@every_drive
def test_path_length_is_the_sum_of_the_steps(name: str, driver: str, action_type: str, always_claim: bool):
    done = drive(name, driver, action_type, always_claim)
    assert done.infos[-1]["path_length_m"] == pytest.approx(sum(math.dist(a, b) for a, b in pairwise(done.positions)))


def test_open_event_settles_when_the_budget_is_spent():
    infos = drive("ring", "to_and_fro", "wheels").infos
    in_event = next(t for t, info in enumerate(infos, 1) if info["revisit"]) + 8
    last, before = drive("ring", "to_and_fro", "wheels", step_budget=in_event).infos[:-3:-1]
    assert (last["revisit"], last["revisits"] - before["revisits"]) == (True, 1)


@every_drive
def test_claiming_rightly_at_every_chance_recognises_every_event(
    name: str, driver: str, action_type: str, always_claim: bool
):
    done = drive(name, driver, action_type, always_claim)
    revisits = np.flatnonzero(judge_trajectory(done.plan, done.positions).revisit)
    judged = judge_trajectory(done.plan, done.positions, np.column_stack([revisits, np.full(len(revisits), NEAREST)]))
    assert (judged.recall, judged.precision, judged.false_claims) == (1.0, 1.0, 0)
    assert judged.revisits > 0 or driver != "tour" or always_claim  # then a lap of the ring is the end


# Nothing but going round counts ---------------------------------------------------------------------------------------


def loops_driven(plan: FloorPlan, positions: Sequence[Position], config: ClosureConfig) -> set[tuple[int, ...]]:
    """Return the winding numbers of every loop in the path that a line of sight within the radius closes."""
    points, anchors = np.array(positions), plan.cycle_anchors
    walls = ClosureTwin(plan, positions).walls
    angles = np.arctan2(points[:, None, 1] - anchors[:, 1], points[:, None, 0] - anchors[:, 0])
    turned = np.unwrap(angles, axis=0)  # no step turns by half a turn about an anchor, for these lie in the walls
    found: set[tuple[int, ...]] = set()
    for t, point in enumerate(points):
        near = np.flatnonzero(np.hypot(*(points[:t] - point).T) <= config.return_radius)
        for k, loop in zip(near, np.rint((turned[t] - turned[near]) / math.tau).astype(int).tolist(), strict=True):
            if tuple(loop) not in found and line_of_sight(walls, positions[t], positions[int(k)]):
                found.add(tuple(loop))
    return found


@pytest.mark.parametrize("name", map_names())
def test_claiming_all_the_time_closes_no_more_cycles_than_were_driven_round(name: str):
    done = drive(name, "tour", "discrete", always_claim=True)
    loops = loops_driven(done.plan, done.positions, ClosureConfig())
    assert done.infos[-1]["cycles_closed"] <= rank([list(loop) for loop in sorted(loops)])


@pytest.mark.parametrize("name", [name for name in map_names() if load_floor_plan(name).cycles_total])
def test_claiming_all_the_time_closes_a_cycle_where_there_is_one(name: str):
    assert drive(name, "tour", "discrete", always_claim=True).infos[-1]["cycles_closed"] > 0


@pytest.mark.parametrize("name", map_names())
def test_driving_to_and_fro_and_claiming_all_the_time_closes_no_cycle(name: str):
    assert drive(name, "to_and_fro", "discrete", always_claim=True).infos[-1]["cycles_closed"] == 0

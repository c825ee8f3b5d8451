"""When a robot is back, which claims are right, and which events count: a truth table on plans drawn by hand."""

from __future__ import annotations

import numpy as np
import pytest

from cyclic_env.config import ClosureConfig
from cyclic_env.floor_plans import FloorPlan
from cyclic_env.task.loop_closure import (
    NO_CLAIM,
    closure_rules,
)
from cyclic_env.task.path_history import STATUS, allocate_memory
from tests.task.closure_runs import (
    EAST_LAP,
    EIGHT,
    HALL,
    LAP_STEPS,
    RING,
    RING_LAP,
    STEP,
    THIN_WALL,
    TWIN_FIELDS,
    WEST_LAP,
    compiled_run,
    compiled_truth,
    run_compiled,
    way,
)
from tests.task.closure_twin import Claim, Position

# There and back: 20 m along a straight line, from x = 5 m to x = 25 m at y = 5 m. ------------------------------------

THERE_AND_BACK = way((5, 5), (25, 5), (5, 5))


def there(x: float) -> int:
    return round((x - 5) / STEP)


def back(x: float) -> int:
    return round((25 - 5 + 25 - x) / STEP)


CORRECT, FALSE, IGNORED = (True, True), (True, False), (False, False)


@pytest.mark.parametrize(
    ("at", "claimed", "judgement", "error_m"),
    [
        pytest.param(back(5), there(5), CORRECT, 0.0, id="back at the very place"),
        pytest.param(back(5), there(8), CORRECT, 3.0, id="three metres off"),
        pytest.param(back(5), there(8.25), FALSE, 3.25, id="more than three metres off"),
        pytest.param(back(5), there(20), FALSE, 15.0, id="at another place"),
        pytest.param(back(25), 0, FALSE, 20.0, id="of the start at the other end"),
        pytest.param(back(15), there(15), CORRECT, 0.0, id="after twenty metres of path, ten metres away"),
        pytest.param(back(15), there(15.25), IGNORED, 0.0, id="before twenty metres of path"),
        pytest.param(back(15.25), there(14), IGNORED, 0.0, id="before the robot was ten metres away"),
        pytest.param(back(15), back(15), IGNORED, 0.0, id="of the step itself"),
        pytest.param(there(20), "nearest", FALSE, 0.0, id="of the nearest step where there is none"),
    ],
)
def test_claim_is_judged_by_distance_path_and_leave_radius(
    at: int, claimed: Claim, judgement: tuple[bool, bool], error_m: float
):
    now = compiled_truth(HALL, THERE_AND_BACK, {at: claimed})[at]
    assert (now["claim_judged"], now["claim_correct"], now["claim_error"]) == (*judgement, error_m)
    assert (now["claims"], now["false_claims"]) == (judgement[0], judgement == FALSE)


def test_being_away_before_the_claimed_step_does_not_count():
    # From (25, 5) to (8, 5), then 24 m to and fro within 6 m: the robot was 17 m away, but before the claimed step.
    positions = way((25, 5), (8, 5), (14, 5), (8, 5), (14, 5), (8, 5))
    last = compiled_truth(HALL, positions, {len(positions) - 1: round(17 / STEP)})[-1]
    assert (last["claim_judged"], last["revisit"]) == (0, 0)


def test_revisit_begins_where_gap_and_leave_radius_are_reached():
    record = compiled_truth(HALL, THERE_AND_BACK, {})
    assert np.flatnonzero(record["revisit"])[0] == back(15)


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


@pytest.mark.parametrize(
    ("claims", "judged"),
    [
        pytest.param([(11.75, 11.75), (10, 10)], [11.75], id="within two metres"),
        pytest.param([(12, 12), (10, 10)], [12, 10], id="after two metres"),
        pytest.param([(11.75, 25), (10, 25)], [11.75], id="two false ones within two metres"),
        pytest.param([(12, 12), (10.5, 10.5), (10, 10)], [12, 10], id="an ignored one puts off no later one"),
        pytest.param([(15.25, 14), (15, 15)], [15], id="nor does one that comes too early in the path"),
    ],
)
def test_claim_is_judged_two_metres_after_the_last_judged_one(claims: list[Position], judged: list[float]):
    record = compiled_truth(HALL, THERE_AND_BACK, {back(at): there(claimed) for at, claimed in claims})
    assert np.flatnonzero(record["claim_judged"]).tolist() == [back(at) for at in judged]


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

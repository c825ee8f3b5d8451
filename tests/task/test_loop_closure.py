"""The truth about loop closures as a table, on plans drawn by hand."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from cyclic_env.config import ClosureConfig
from cyclic_env.floor_plans import FloorPlan
from cyclic_env.task.loop_closure import NO_CLAIM, closure_rules
from cyclic_env.task.path_history import STATUS, allocate_memory
from tests.task.buildings import (
    EAST_LAP,
    EIGHT,
    HALL,
    PILLAR,
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
from tests.task.closure_twin import Position

THERE_AND_BACK = way((5, 5), (25, 5), (5, 5))
"""20 m along a straight line, from x = 5 m to x = 25 m at y = 5 m, and back."""
DETOUR_AT_5 = way((5, 5), (25, 5), (5, 5), (5, 12), (5, 5), (25, 5))
"""There and back, a little way north until the event has settled that ends there, and there again."""
ARRIVED = round(15 / STEP)
STANDING = way((5, 5), (20, 5)) + [(20.0, 5.0)] * 300
"""15 m along a straight line, and then no further."""
SMALL_CIRCLES = way(*[(5, 5), (8, 5), (8, 8), (5, 8)] * 10)
TO_AND_FRO = way((2, 2), (22, 2), (2, 2), (22, 2), (2, 2))
OUTER_LAP = [(22, 2), (42, 2), (42, 22), (2, 22), (2, 2), (22, 2)]
INNER_WEST = [(22, 22), (2, 22), (2, 2), (22, 2)]
INNER_EAST = [(42, 2), (42, 22), (22, 22), (22, 2)]
DIP_BEGINS = round((40 + 20 + 20 + 17) / STEP)
"""Step at which the way of `dipping_to` comes down to y = 8 m."""


def there(x: float) -> int:
    return round((x - 5) / STEP)


def back(x: float) -> int:
    return round((25 - 5 + 25 - x) / STEP)


def there_again(x: float) -> int:
    return round((20 + 20 + 7 + 7 + x - 5) / STEP)


def with_a_bump(y: float) -> list[Position]:
    """Return a way along y = 5 m and back along y = 7 m, but for a bump at x = 30 m: no revisit above y = 8 m."""
    return way((5, 5), (55, 5), (55, 7), (30, 7), (30, y), (30, 7), (10, 7))


def dipping_to(y: float, end: float = 12.0) -> list[Position]:
    """Return a way along y = 5 m, and a detour from where it dips down to y at x = 25 m: a revisit up to y = 8 m."""
    return way((5, 5), (45, 5), (45, 25), (25, 25), (25, y), (25, end))


def around_the_wall(y: float) -> tuple[list[Position], dict[int, int]]:
    """Return a way around the wall's end, from y on its west side to y on its east side, and a claim of its start."""
    positions = way((29, y), (29, 2), (29, 18), (31.25, 18), (31.25, y))
    return positions, {len(positions) - 1: 0}


def every_step(positions: list[Position], claim: Any, begin: int = 1) -> dict[int, Any]:
    """Return the same claim for every step of a way."""
    return dict.fromkeys(range(begin, len(positions)), claim)


def case(sentence: str, plan: FloorPlan, positions: list[Position], claims: dict[int, Any], /, **expected: Any) -> Any:
    """Return a row of the table: what is expected `at` a step (the last one, unless told), by `config`."""
    config, at = expected.pop("config", ClosureConfig()), expected.pop("at", len(positions) - 1)
    return pytest.param(plan, positions, claims, config, at, expected, id=sentence)


def claim(sentence: str, x: int, claimed: int | str, /, **expected: Any) -> Any:
    """Return a row about a claim made at a step there and back."""
    return case(f"claim {sentence}", HALL, THERE_AND_BACK, {x: claimed}, at=x, **expected)


IGNORED = {"claim_judged": 0, "claims": 0, "claim_error": 0.0}
RIGHT = {"claim_judged": 1, "claim_correct": 1, "claims": 1, "false_claims": 0}
FALSE = {"claim_judged": 1, "claim_correct": 0, "claims": 1, "false_claims": 1}
HARMLESS = {"claims": 1, "false_claims": 0, "recognised": 0}
TWO_RIGHT = {"claims": 2, "false_claims": 0}
THREE_RIGHT = {"claims": 3, "false_claims": 0}
LAP, TWO_LAPS, LAP_AND_BACK = way(*RING_LAP), way(*RING_LAP, *RING_LAP[1:]), way(*RING_LAP, *RING_LAP[-2::-1])
THREE_LAPS = way(*RING_LAP, *RING_LAP[1:], *RING_LAP[1:])
BOTH_LAPS = way(*WEST_LAP, *EAST_LAP[1:])
AND_WEST, AND_EAST = way(*OUTER_LAP, *INNER_WEST), way(*OUTER_LAP, *INNER_WEST, *INNER_EAST)
OUTER_CLAIMS = {480: 0, 800: 480, 1120: 800}
AROUND_PILLAR = way((10, 10), (30, 10), (30, 30), (10, 30), (10, 10))
WITHIN_6_M = way((25, 5), (8, 5), (14, 5), (8, 5), (14, 5), (8, 5))
NARROW = way((5, 5), (30, 5), (30, 6.5), (5, 6.5))
ANYWHERE: Any = "nearest"
THREE_CLAIMS = {back(x): there(x) for x in (15, 13, 11)}
SHORT_EVENT = dipping_to(7.75), {DIP_BEGINS + 1: ANYWHERE}
SPOILT_EVENT = dipping_to(7.5), {DIP_BEGINS - 1: 0} | {DIP_BEGINS + t: ANYWHERE for t in range(7)}
SHORT, NO_GAP = ClosureConfig(return_radius=0.5), ClosureConfig(event_gap=0.0)

CLAIMS = [
    claim("of the place where one is again is right", back(5), there(5), **RIGHT, claim_error=0.0),
    claim("of another place is false, its error the distance", back(5), there(20), **FALSE, claim_error=15.0),
    claim("of a place 3 m off is right", back(5), there(8), **RIGHT, claim_error=3.0),
    claim("of a place more than 3 m off is false", back(5), there(8.25), **FALSE, claim_error=3.25),
    claim("after 20 m of path and 10 m away is right", back(15), there(15), **RIGHT),
    claim("before 20 m of path is ignored", back(15), there(15.25), **IGNORED),
    claim("before the robot was 10 m away is ignored", back(15.25), there(14), **IGNORED),
    claim("of the start, far away, is false", back(25), 0, **FALSE),
    claim("of the nearest place, of which there is none, is false", there(20), ANYWHERE, **FALSE, claim_error=0),
    case("claim of the step itself is ignored", HALL, THERE_AND_BACK, {t: t for t in range(1, 161)}, **IGNORED),
    # The robot was 17 m away, then drove 24 m within 6 m of the claimed step.
    case("being away before the claimed step does not count", HALL, WITHIN_6_M, {164: 68}, **IGNORED, revisit=0),
    case("first claim is judged", HALL, way((5, 5), (6, 5)), {4: 0}, config=SHORT, claim_judged=1, claim_error=1.0),
    case("nearest claim takes the nearest", HALL, NARROW, {206: ANYWHERE}, claim_correct=1, claim_error=1.5),
]


def soon(sentence: str, claims: dict[float, float], /, **expected: int) -> Any:
    """Return a row about the last of several claims, each given by where it is made and which place it names."""
    by_step = {back(x): there(place) for x, place in claims.items()}
    return case(f"claim {sentence}", HALL, THERE_AND_BACK, by_step, at=max(by_step), **expected)


SOON_AFTER = [
    soon("within 2 m of a right one is ignored", {11.75: 11.75, 10: 10}, claim_judged=0, claims=1),
    soon("2 m after a right one is judged", {12: 12, 10: 10}, claim_judged=1, claims=2),
    soon("within 2 m of a false one is ignored", {11.75: 25, 10: 25}, claim_judged=0, false_claims=1),
    soon("after one ignored for coming soon is judged", {12: 12, 10.5: 10.5, 10: 10}, claim_judged=1, claims=2),
    soon("after one ignored for coming too early is judged", {15.25: 14, 15: 15}, claim_correct=1, claims=1),
]
EVENTS = [
    case("runs of revisits less than 2 m apart are one event", HALL, with_a_bump(8.75), {}, revisits=1),
    case("runs of revisits 2 m apart are two events", HALL, with_a_bump(9.0), {}, revisits=2),
    case("one run is one event even without an event gap", HALL, THERE_AND_BACK, {}, config=NO_GAP, revisits=1),
    case("claim recognises its own event only", HALL, with_a_bump(9.0), {288: ANYWHERE}, revisits=2, recognised=1),
    case("false claim recognises no event", HALL, THERE_AND_BACK, {back(10): there(25)}, revisits=1, recognised=0),
    case("further right claims pad nothing", HALL, THERE_AND_BACK, THREE_CLAIMS, claims=3, revisits=1, recognised=1),
    case("event of one metre counts", HALL, dipping_to(7.5), {}, revisits=1),
    case("right claim in an event under 1 m recognises nothing", HALL, *SHORT_EVENT, **HARMLESS, revisits=0),
    case("ground of a missed event counts once", HALL, DETOUR_AT_5, {there_again(10): there(10)}, **HARMLESS),
    case("false claim just before an event spoils it", HALL, *SPOILT_EVENT, claims=1, revisits=1, recognised=0),
    case("third lap is a revisit but no event", RING, THREE_LAPS, {960: ANYWHERE}, revisit=1, revisits=1),
    case("to and fro can be recognised", RING, TO_AND_FRO, {round(35 / STEP): ANYWHERE}, revisits=1, recognised=1),
]
WALLS = [
    case("claim through a wall is false", THIN_WALL, *around_the_wall(2.0), **FALSE, claim_error=2.25, revisit=0),
    case("the same claim is right without the wall", HALL, *around_the_wall(2.0), **RIGHT, claim_error=2.25),
    case("line of sight that touches a wall is blocked", THIN_WALL, *around_the_wall(16.0), **FALSE),
    case("line of sight that passes a wall is not blocked", THIN_WALL, *around_the_wall(16.25), **RIGHT),
]
CYCLES = [
    case("lap closes a new cycle", RING, LAP, {320: 0}, new_cycle=1, cycles_closed=1),
    case("lap closed by a straight line of 2 m counts", RING, LAP, {320 - 8: 0}, cycles_closed=1),
    case("lap without a claim closes nothing", RING, LAP, {}, cycles_closed=0),
    case("false claim closes nothing", RING, LAP, {320: 160}, false_claims=1, cycles_closed=0),
    case("second lap earns nothing", RING, TWO_LAPS, {320: 0, 640: 320}, **TWO_RIGHT, cycles_closed=1),
    case("second lap back to the start earns nothing", RING, TWO_LAPS, {320: 0, 640: 0}, **TWO_RIGHT, cycles_closed=1),
    case("lap the other way round earns nothing", RING, LAP_AND_BACK, {320: 0, 640: 320}, **TWO_RIGHT, cycles_closed=1),
    case("lap unwound again closes nothing", RING, LAP_AND_BACK, {640: 0}, claim_correct=1, cycles_closed=0),
    case("first lap of an eight is new", EIGHT, BOTH_LAPS, {320: 0, 640: 320}, at=320, new_cycle=1, cycles_closed=1),
    case("second lap of an eight is too", EIGHT, BOTH_LAPS, {320: 0, 640: 320}, new_cycle=1, cycles_closed=2),
    case("outer loop of two is one cycle", EIGHT, way(*OUTER_LAP), {480: 0}, cycles_closed=1),
    case("one block after the loop around both is a second", EIGHT, AND_WEST, {480: 0, 800: 480}, cycles_closed=2),
    case("outer loop and both blocks are two", EIGHT, AND_EAST, OUTER_CLAIMS, **THREE_RIGHT, cycles_closed=2),
    case("lap around a pillar earns nothing", PILLAR, AROUND_PILLAR, {320: 0}, claim_correct=1, cycles_closed=0),
]


@pytest.mark.parametrize(
    ("plan", "positions", "claims", "config", "at", "expected"), [*CLAIMS, *SOON_AFTER, *EVENTS, *WALLS, *CYCLES]
)
def test_truth_after_a_step(plan, positions, claims, config, at, expected):
    truth = compiled_truth(plan, positions, claims, config)[at]
    assert {key: truth[key] for key in expected} == expected


@pytest.mark.parametrize(
    ("plan", "positions", "match"),
    [
        # the middle of the eight, at the beginning, between, and at the end
        (EIGHT, BOTH_LAPS, (0, True, True)),
        # east 2 m off first, then west 2 m off, and between the two at the end
        (HALL, way((34, 5), (34, 30), (30, 30), (30, 5), (30, 30), (32, 30), (32, 5)), (0, True, False)),
    ],
    ids=["at one place", "on either side"],
)
def test_nearest_claim_takes_the_earliest_of_equally_near_steps(plan, positions, match):
    last = len(positions) - 1
    assert compiled_run(plan, positions, {last: "nearest"})[1] == [(last, *match)]


def test_revisit_begins_where_gap_and_leave_radius_are_reached():
    record = compiled_truth(HALL, THERE_AND_BACK, {})
    assert np.flatnonzero(record["revisit"])[0] == back(15)


def test_spinning_on_the_spot_is_never_judged():
    # The robot claims at every step to be where it has just arrived.
    record = compiled_truth(HALL, STANDING, every_step(STANDING, ARRIVED, ARRIVED + 1))
    assert not (record["claim_judged"] | record["revisit"]).any()


def test_driving_in_small_circles_is_never_judged_correct():
    record = compiled_truth(HALL, SMALL_CIRCLES, every_step(SMALL_CIRCLES, 0))
    assert not (record["claim_correct"] | record["revisit"]).any()


def test_driving_to_and_fro_and_claiming_at_every_step_closes_no_cycle():
    record = compiled_truth(RING, TO_AND_FRO, every_step(TO_AND_FRO, "nearest"))
    assert (record["claim_correct"].sum() > 10, record["cycles_closed"][-1]) == (True, 0)


# When events settle ---------------------------------------------------------------------------------------------------


def test_recognised_event_counts_only_when_it_settles():
    record = compiled_truth(HALL, THERE_AND_BACK, {back(15): there(15)}, ends=False)
    assert (record["recognised"] == 0).all()


@pytest.mark.parametrize(
    ("y", "end", "ends", "missed"),
    [
        (7.5, 12.0, True, [DIP_BEGINS + round((1 + 2) / STEP)]),
        (7.5, 8.0, True, [len(dipping_to(7.5, 8.0)) - 1]),
        (7.5, 8.0, False, []),
        (7.75, 12.0, True, []),
    ],
    ids=["2 m after the last revisit", "when the episode ends", "not while it runs", "never if under 1 m"],
)
def test_missed_event_settles(y: float, end: float, ends: bool, missed: list[int]):
    record = compiled_truth(HALL, dipping_to(y, end), {}, ends=ends)
    assert np.flatnonzero(record["missed_now"]).tolist() == missed


def test_event_settles_before_the_step_two_metres_later_is_judged():
    positions = with_a_bump(9.0)
    record = compiled_truth(HALL, positions, {})
    back_down = [t for t, position in enumerate(positions) if position == (30, 8)][1]
    assert (record["revisit"][back_down], record["fresh"][back_down], record["revisits"][back_down]) == (1, 0, 1)


# Ground counts once ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("swings", [3, 4, 40])
def test_driving_to_and_fro_in_a_corridor_makes_no_more_than_two_events(swings: int):
    positions = way(*[(5, 5), (17, 5)] * swings)
    record = compiled_truth(HALL, positions, every_step(positions, "nearest"))
    assert record["revisits"][-1] <= 2
    assert record["revisit"][-12 * 4 :].any()


def test_event_begins_beyond_the_return_radius_of_the_counted_ground():
    record = compiled_truth(HALL, DETOUR_AT_5, {})
    assert not record["fresh"][there_again(5) : there_again(18) + 1].any()
    assert record["fresh"][there_again(18.25) :].all()
    assert record["revisits"][-1] == 2


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


def test_memory_of_an_earlier_episode_is_forgotten():
    lap, hall = way(*RING_LAP), way((12, 2), (22, 2), (12, 2))
    memory = allocate_memory(RING, 1, len(lap), ClosureConfig())
    for positions in (lap, hall):
        claimed = np.full(len(positions) - 1, NO_CLAIM)
        claimed[-1] = 0
        record = np.zeros(len(positions), STATUS)
        run_compiled(memory, closure_rules(ClosureConfig()), np.array(positions, np.float64), claimed, True, record)
    fresh = compiled_truth(RING, hall, {len(hall) - 1: 0})
    for column in TWIN_FIELDS.values():
        assert record[column].tolist() == fresh[column].tolist()

"""Which loops close a new cycle, on plans drawn by hand."""

from __future__ import annotations

import numpy as np
import pytest

from tests.task.closure_runs import (
    EAST_LAP,
    EIGHT,
    HALL,
    LAP_STEPS,
    PILLAR,
    RING,
    RING_LAP,
    STEP,
    WEST_LAP,
    compiled_truth,
    way,
)


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

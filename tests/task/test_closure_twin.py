"""The compiled truth about loop closures equals its plain twin on random walks."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from cyclic_env.config import ClosureConfig
from cyclic_env.floor_plans import FloorPlan
from tests.task.buildings import EIGHT, HALL, PILLAR, RING, THIN_WALL, TWIN_FIELDS, compiled_run, way
from tests.task.closure_twin import Claim, ClosureTwin, Position, Truth, line_of_sight

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

"""Closed tours of all corridors: shapes known on paper, a brute-force twin, and the shipped plans."""

from __future__ import annotations

import itertools
import math

import networkx as nx
import numpy as np
import pytest
import shapely
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from shapely.geometry import LineString, Polygon

from cyclic_env.floor_plans import FloorPlan, floor_plan_from_mapping, load_floor_plan
from cyclic_env.floor_plans.tour import closed_tour, closed_tour_path, repeated_length

BLOCK = [(0, 0), (20, 0), (20, 10), (0, 10), (0, 0)]
GRID = [[(10 * k, 0), (10 * k, 30)] for k in range(4)] + [[(0, 10 * k), (30, 10 * k)] for k in range(4)]
SHAPES = {
    "corridor": ([[(0, 0), (9, 0)]], 2 * 9),
    "corridor with a bend": ([[(0, 0), (9, 0), (9, 4)]], 2 * 13),
    "corridor given twice, in part": ([[(0, 0), (9, 0)], [(3, 0), (7, 0)]], 2 * 9),
    "corridors that meet at a corner": ([[(0, 0), (9, 0)], [(9, 0), (9, 4)]], 2 * 13),
    "ring": ([BLOCK], 60),
    "ring of two corridors": ([BLOCK[:3], BLOCK[2:]], 60),
    "ring with a dead end": ([BLOCK, [(20, 4), (27, 4)]], 60 + 2 * 7),
    "ring with a point that is no corridor": ([BLOCK, [(5, 5), (5, 5)]], 60),
    "rings that touch in a point": ([BLOCK, [(20, 10), (40, 10), (40, 20), (20, 20), (20, 10)]], 120),
    "rings with a corridor between": (
        [BLOCK, [(50, 0), (70, 0), (70, 10), (50, 10), (50, 0)], [(20, 5), (50, 5)]],
        180,
    ),
    "eight that shares a corridor": ([BLOCK, [(8, 0), (8, 10)]], 70 + 10),
    "eight that crosses itself": ([[(0, 0), (8, 6), (8, 0), (0, 6), (0, 0)]], 2 * 10 + 2 * 6),
    "T": ([[(0, 0), (10, 0)], [(4, 0), (4, 7)]], 2 * 17),
    "cross": ([[(0, 0), (10, 0)], [(4, -3), (4, 7)]], 2 * 20),
    "nine blocks": (GRID, 240 + 4 * 10),  # 8 odd nodes around; the middles of the sides pair up
}
LATTICE = [((x, y), (x + 1, y)) for x in range(2) for y in range(3)] + [
    ((x, y), (x, y + 1)) for x in range(3) for y in range(2)
]
SUBSETS = {n: np.array(list(itertools.product([0, 1], repeat=n))) for n in range(1, len(LATTICE) + 1)}


def tour_of(lines: list) -> float:
    return closed_tour([LineString(line) for line in lines])


@pytest.mark.parametrize("shape", SHAPES)
def test_the_path_of_a_tour_is_as_long_as_the_tour_drives_all_and_comes_back(shape: str) -> None:
    lines, length = [LineString(line) for line in SHAPES[shape][0]], SHAPES[shape][1]
    path = LineString(closed_tour_path(lines))
    assert path.length == pytest.approx(length)
    assert path.is_closed
    assert path.buffer(1e-6).covers(shapely.union_all(lines))


def test_lines_that_are_not_connected_have_no_path() -> None:
    assert closed_tour_path([LineString([(0, 0), (1, 0)]), LineString([(0, 5), (1, 5)])]).shape == (0, 2)


def plan_tour(*corridors: tuple[float, list]) -> float:
    """Return the closed tour of a plan of corridors, each a width and a line."""
    items = [{"width": width, "line": line} for width, line in corridors]
    (x, y), *_ = corridors[0][1]
    return floor_plan_from_mapping({"corridors": items, "start": {"x": x, "y": y}}).closed_tour()


# Shapes known on paper


@pytest.mark.parametrize(("lines", "length"), SHAPES.values(), ids=SHAPES)
def test_the_tour_of_a_shape_known_on_paper_straight_and_turned(lines: list, length: float) -> None:
    assert tour_of(lines) == pytest.approx(length, abs=1e-6)
    turned = [shapely.affinity.rotate(LineString(line), 33.0, origin=(1, 2)) for line in lines]
    assert closed_tour(turned) == pytest.approx(length, abs=1e-4)


@pytest.mark.parametrize("lines", [[], [[(3, 3), (3, 3)]], [[(0, 0), (9, 0)], [(0, 1), (9, 1)]]])
def test_no_corridors_and_separate_corridors_have_no_tour(lines: list) -> None:
    assert math.isnan(tour_of(lines))


def test_many_dead_ends_are_each_driven_twice() -> None:
    stubs = [[(3 * k, 0), (3 * k, 1 + k % 7)] for k in range(1, 60)]
    lines = [[(0, 0), (180, 0)], *stubs]
    assert tour_of(lines) == pytest.approx(2 * sum(LineString(line).length for line in lines))


@settings(max_examples=100, deadline=None)
@given(
    st.sets(st.sampled_from(range(len(LATTICE))), min_size=1),
    st.lists(st.floats(0.1, 100), min_size=len(LATTICE), max_size=len(LATTICE)),
)
def test_what_is_driven_twice_is_as_short_as_the_best_of_all_choices(chosen: set[int], lengths: list[float]) -> None:
    used = sorted(chosen)
    _, ends = np.unique(np.array([LATTICE[k] for k in used]).reshape(-1, 2), axis=0, return_inverse=True)
    ends, weights = ends.reshape(-1, 2), np.array(lengths)[used]
    graph = nx.MultiGraph()
    graph.add_weighted_edges_from((a, b, weight) for (a, b), weight in zip(ends, weights, strict=True))
    assume(nx.is_connected(graph))
    meets = np.array([np.bincount(pair, minlength=ends.max() + 1) for pair in ends])
    choices = SUBSETS[len(used)]
    tours = choices[(((1 + choices) @ meets) % 2 == 0).all(axis=1)]
    assert repeated_length(graph) == pytest.approx((tours @ weights).min(), abs=1e-5)


# Floor plans


def test_the_tour_of_killian_court_is_that_of_the_survey() -> None:
    assert load_floor_plan("killian_court").closed_tour() == pytest.approx(1436, abs=0.5)


@pytest.mark.parametrize("centrelines", [(), (((1.0, 1.0),),)])
def test_a_plan_without_centrelines_has_no_tour(centrelines: tuple) -> None:
    plan = FloorPlan("p", Polygon([(0, 0), (9, 0), (9, 9)]), (6, 2, 0), centrelines=centrelines)
    assert math.isnan(plan.closed_tour())


@pytest.mark.parametrize(
    ("corridors", "length"),
    [
        *([[(2.4, BLOCK), (2.0, [(20 + gap, 4), (27, 4)])], 60 + 2 * 7] for gap in (0.0, 0.5, 1.0)),
        ([(6.0, [(0, 0), (40, 0)]), (1.5, [(20, 2.9), (20, 15)])], 2 * 55),
        ([(2.4, [*BLOCK[:4], (0, 0.5)])], 60),
        ([(1.0, [(0, 0), (20, 0), (20, 1.2)]), (1.0, [(20, 1.2), (1, 1.2)])], 2 * (20 + 1.2 + 19)),
    ],
    ids=["end at a line", "0.5 m short", "1 m short", "end at a wide one", "loop nearly closed", "wall between"],
)
def test_corridors_are_joined_where_no_wall_is_between(corridors: list, length: float) -> None:
    assert plan_tour(*corridors) == pytest.approx(length)

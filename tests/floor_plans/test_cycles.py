"""Cycles: holes with a lap that is long and wide enough, compared with a brute-force search."""

from __future__ import annotations

import heapq
import itertools
import math

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely import Polygon, box

from cyclic_env import CyclicLoopEnv
from cyclic_env.floor_plans import FloorPlan, load_floor_plan, map_names
from cyclic_env.floor_plans.cycles import find_cycles, shortest_lap
from cyclic_env.floor_plans.floor_plan import MIN_CYCLE_LENGTH
from cyclic_env.floor_plans.generator.names import split_names

RADIUS = 0.25


def hall(*holes: shapely.Geometry, size: float = 60.0) -> FloorPlan:
    free = box(0, 0, size, size).difference(shapely.union_all(holes))
    assert isinstance(free, Polygon)
    return FloorPlan("hall", free, (1.0, 1.0, 0.0))


def length_of(lap: np.ndarray | None) -> float:
    return math.inf if lap is None else shapely.LinearRing(lap).length


def slow_lap_length(space: Polygon, obstacle: Polygon, others: list[Polygon], limit: float) -> float:
    """Return the length of a lap by trying all ways between all corners, and summing up the angles about each hole."""
    corners = [corner for ring in (space.exterior, *space.interiors) for corner in ring.coords[:-1]]
    area = space.buffer(1e-6)
    shapely.prepare(area)
    anchors = [polygon.representative_point().coords[0] for polygon in (obstacle, *others)]
    ways: dict[int, list] = {i: [] for i in range(len(corners))}
    for i, j in itertools.permutations(range(len(corners)), 2):
        if area.covers(shapely.LineString([corners[i], corners[j]])):
            turns = []
            for ax, ay in anchors:
                (x1, y1), (x2, y2) = ((x - ax, y - ay) for x, y in (corners[i], corners[j]))
                turns.append(math.atan2(x1 * y2 - x2 * y1, x1 * x2 + y1 * y2))
            ways[i].append((j, math.dist(corners[i], corners[j]), turns))
    best = limit
    for start in range(len(corners)):
        if 2 * shapely.Point(corners[start]).hausdorff_distance(obstacle) > best:
            continue
        done, queue = set(), [(0.0, start, (0.0,) * len(anchors))]
        while queue:
            length, i, turned = heapq.heappop(queue)
            key = i, tuple(round(turn, 3) for turn in turned)
            if key in done or length >= best:
                continue
            done.add(key)
            if i == start and key[1] == (6.283, *(0.0,) * len(others)):
                best = length
                break
            for j, more, turns in ways[i]:
                sums = tuple(a + b for a, b in zip(turned, turns, strict=True))
                if length + more < best and all(abs(turn) < 9 for turn in sums):
                    heapq.heappush(queue, (length + more, j, sums))
    return best if best < limit else math.inf


# Drawn by hand


def pillar_with_rooms(width: float) -> list[shapely.Geometry]:
    """Return a pillar with a long outline: the robot can enter the rooms that are cut into it."""
    rooms = [box(x, 22, x + 0.8, 29) for x in (21, 23, 25, 27)]
    return [box(20, 20, 20 + width, 29).difference(shapely.union_all(rooms))]


TRUTH = {
    "rooms cut into a pillar with a lap of 37.6 m": (pillar_with_rooms(9.0), 0),
    "rooms cut into a pillar with a lap of 39.4 m": (pillar_with_rooms(9.9), 0),
    "rooms cut into a pillar with a lap of 40.6 m": (pillar_with_rooms(10.5), 1),
    # 4 sides and a circle of the robot's radius
    "a lap just under 40 m": ([box(20, 20, 29.55, 29.55)], 0),
    "a lap just over 40 m": ([box(20, 20, 29.65, 29.65)], 1),
    "holes that can only be driven around together": ([box(10, 10, 22, 30), box(22.4, 10, 40, 30)], 0),
    "holes with a passage between": ([box(10, 10, 22, 30), box(22.6, 10, 40, 30)], 2),
    "a pillar at a hole": ([box(10, 10, 22, 30), box(22, 15, 23, 16)], 1),
    "a pillar too near to a hole to pass": ([box(10, 10, 22, 30), box(22.4, 15, 23.4, 16)], 1),
    "a pillar beside a hole": ([box(10, 10, 22, 30), box(22.6, 15, 23.6, 16)], 1),
    "a passage too narrow to the outer wall": ([box(0.4, 20, 20, 40)], 0),
    "a passage wide enough along the outer wall": ([box(0.6, 20, 20, 40)], 1),
    "a fence of posts": ([box(20 + 1.3 * i, 20, 21 + 1.3 * i, 21) for i in range(18)], 1),
}


@pytest.mark.parametrize(("holes", "cycles"), TRUTH.values(), ids=TRUTH)
def test_cycles_are_holes_with_laps_of_their_own(holes: list[shapely.Geometry], cycles: int) -> None:
    plan = hall(*holes)
    assert plan.cycles_total == cycles
    assert plan.reachable(RADIUS)


@pytest.mark.parametrize(("side", "cycles"), [(6.0, 0), (7.0, 1)])
def test_a_lap_must_leave_by_ten_metres(side: float, cycles: int) -> None:
    plan = hall(box(20, 20, 20 + side, 20 + side))  # from corner to corner 1.41 sides and 0.5 m
    assert len(find_cycles(plan.free_space, plan.start, RADIUS, 20.0, 10.0)) == cycles


@pytest.mark.parametrize(("length", "cycles"), [(4.0, 0), (7.0, 1)])
def test_a_lap_that_goes_around_a_bar_as_well_is_wide_enough(length: float, cycles: int) -> None:
    c = box(20, 20, 26.5, 26.5).difference(box(21, 21, 26.5, 25.5))
    bar = box(22.5, 22.5, 22.5 + length, 24)  # from inside the C; the way around its tip is shorter than inside the C
    plan = hall(c, bar)
    assert len(find_cycles(plan.free_space, plan.start, RADIUS, 20.0, 10.5)) == cycles


def test_a_hole_that_a_c_shaped_one_surrounds_is_driven_around_alone() -> None:
    c = box(10, 10, 40, 40).difference(box(13, 13, 40, 37))
    assert [hole.bounds for hole in hall(c, box(16, 16, 34, 34)).cycles] == [(10, 10, 40, 40), (16, 16, 34, 34)]


def test_a_robot_that_fits_nowhere_has_no_cycles() -> None:
    plan = hall(box(10, 10, 50, 50))
    assert find_cycles(plan.free_space, plan.start, 30.0, 40.0, 10.0) == []


# Compared with brute force


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_a_lap_is_as_short_as_the_best_of_all_ways(seed: int) -> None:
    rng = np.random.default_rng(seed)
    corners = rng.uniform(1, 14, (rng.integers(3, 7), 2))
    sizes = rng.choice([0.3, 1.0, 4.0, 6.0], corners.shape)
    boxes = [box(x, y, min(x + w, 19), min(y + h, 19)) for (x, y), (w, h) in zip(corners, sizes, strict=True)]
    free = box(0, 0, 20, 20).difference(shapely.union_all(boxes))
    space = max(shapely.get_parts(free.buffer(-RADIUS, quad_segs=1)), key=lambda part: part.area)
    space = shapely.geometry.polygon.orient(space, 1.0)
    outlines = [Polygon(ring) for ring in space.interiors]
    for outline in outlines[:2]:
        others = [other for other in outlines if other is not outline and other.length > 12]
        limit = 1.001 * outline.length
        lap = shortest_lap(space, outline, others, limit)
        assert outline.convex_hull.length - 1e-9 <= length_of(lap) <= outline.length + 1e-9
        assert length_of(lap) == pytest.approx(slow_lap_length(space, outline, others, limit), abs=1e-6)
        assert shortest_lap(space, outline, others, length_of(lap) - 1e-3) is None


# Plans that come with the package


@pytest.mark.parametrize("name", [*map_names(), *split_names("generated:validation")[::8]])
def test_shipped_and_generated_cycles_are_the_holes_with_long_rings(name: str) -> None:
    plan = load_floor_plan(name)
    rings = sorted((ring.length for ring in plan.free_space.interiors if ring.length >= MIN_CYCLE_LENGTH), reverse=True)
    assert [hole.exterior.length for hole in plan.cycles] == rings


def test_the_cycles_of_an_environment_are_those_that_its_robot_can_drive_around() -> None:
    plan = hall(box(0.6, 20, 20, 40), box(30, 10, 40, 20))
    for radius, leave_radius, cycles in ((0.25, 10.0, 2), (0.35, 10.0, 1), (0.25, 20.0, 1), (0.35, 20.0, 0)):
        env = CyclicLoopEnv(plan, robot={"radius": radius}, closure={"leave_radius": leave_radius})
        assert env.reset(seed=0)[1]["cycles_total"] == cycles

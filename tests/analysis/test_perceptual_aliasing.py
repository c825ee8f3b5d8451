"""Look-alikes: which places of a building have one, and how the generator's dial turns their share."""

from __future__ import annotations

import re

import numpy as np
import pytest
import shapely
from numpy.testing import assert_array_equal

from cyclic_env.analysis.perceptual_aliasing import (
    CANDIDATE_SPACING,
    LASER,
    MIN_DISTANCE,
    TOLERANCE,
    find_candidates,
    perceptual_aliasing,
)
from cyclic_env.floor_plans import (
    BuildingSpec,
    FloorPlan,
    generate,
    load_floor_plan,
    map_names,
    polygon_from_corridors,
)
from cyclic_env.floor_plans.library import maps_folder
from cyclic_env.simulation.lidar import scan


def twin_rooms(shift: tuple[float, float], end: float = 0.0) -> FloorPlan:
    """Return two equal rooms with a niche, as far apart as `shift`, and a corridor from one's niche to the other's.

    The corridor bends, so that one does not see from one room into the other. The second is deeper by `end`.
    """
    parts = []
    for (x, y), deeper in (((0.0, 0.0), 0.0), (shift, end)):
        parts += [shapely.box(x, y - deeper, x + 5, y + 4), shapely.box(x + 1, y + 4, x + 2.2, y + 20)]
    (x, y) = shift
    parts.append(shapely.box(1, 19, x + 2.2, y + 21))
    return FloorPlan("twin_rooms", shapely.union_all(parts), (2.0, 2.0, 0.0))  # pyright: ignore[reportArgumentType]


def aliasing(plan: FloorPlan) -> float:
    return perceptual_aliasing(plan).share


def share_in_rooms(plan: FloorPlan) -> float:
    result = perceptual_aliasing(plan)
    return float(result.aliased[result.positions[:, 1] < 4].mean())


def corridor(length: float) -> FloorPlan:
    return FloorPlan("corridor", polygon_from_corridors([(2.4, [(0, 0), (length - 2.4, 0)])]), (1.0, 0.0, 0.0))


@pytest.mark.parametrize("shift", [(32.0, 0.0), (31.37, 0.0), (33.19, 0.41)])
def test_twins_are_found_wherever_they_lie_on_the_lattice(shift: tuple[float, float]) -> None:
    assert share_in_rooms(twin_rooms(shift)) == 1.0


def test_rooms_of_different_depth_are_no_twins() -> None:
    assert share_in_rooms(twin_rooms((32.0, 0.0), end=3.0)) < 0.2


def test_twins_less_than_20_m_away_do_not_count() -> None:
    assert share_in_rooms(twin_rooms((15.0, 0.0))) == 0.0


@pytest.mark.parametrize(("length", "low", "high"), [(30.0, 0.0, 0.0), (80.0, 0.5, 1.0)])
def test_the_middle_of_a_long_plain_corridor_looks_the_same_all_along(length: float, low: float, high: float) -> None:
    assert low <= aliasing(corridor(length)) <= high


def test_a_building_that_a_place_sees_whole_has_no_look_alikes(square_room: FloorPlan) -> None:
    result = perceptual_aliasing(square_room)
    assert len(result.positions) > 80
    assert result.share == 0.0


def test_what_has_a_look_alike_on_the_lattice_is_found() -> None:
    plan = load_floor_plan("twin_rings")
    result = perceptual_aliasing(plan)
    scans = np.array([scan(plan.walls, np.array([*place, 0.0]), LASER) for place in result.positions])
    differences = np.abs(scans[:, None] - scans).mean(axis=2)
    apart = np.linalg.norm(result.positions[:, None] - result.positions, axis=2)
    twins = ((differences < TOLERANCE - 1e-6) & (apart > MIN_DISTANCE)).any(axis=1)
    assert twins.sum() > 100
    assert result.aliased[twins].all()


def test_candidates_are_the_nearest_looks_one_from_each_place() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(0, 60, (400, 2))
    scans = rng.uniform(1, 1.6, (400, 40)).astype(np.float32)
    queries = np.arange(0, 400, 7)
    chosen = np.empty((len(queries), 3), np.int64)
    find_candidates(points, scans, queries, np.empty(3), chosen)
    for query, found in zip(queries, chosen, strict=True):
        differences = np.abs(scans - scans[query]).mean(axis=1)
        differences[np.linalg.norm(points - points[query], axis=1) <= MIN_DISTANCE] = np.inf
        expected = []
        for i in np.argsort(differences):
            if all(np.linalg.norm(points[i] - points[j]) >= CANDIDATE_SPACING for j in expected):
                expected.append(i)
        assert found[0] == expected[0]
        assert_array_equal(np.diff(differences[found]) >= 0, True)


def test_two_rings_exactly_alike_are_and_one_ring_is_not() -> None:
    share = {name: aliasing(load_floor_plan(name)) for name in ("twin_rings", "office", "chamfered", "ring")}
    assert share["twin_rings"] > 0.8
    assert share["office"] < 0.3
    assert share["chamfered"] < 0.1
    assert share["ring"] < 0.1


@pytest.mark.parametrize("name", sorted({*map_names()} - {"killian_court"}))  # which takes too long
def test_the_readme_table_has_the_aliasing_of_a_plan(name: str) -> None:
    text = (maps_folder() / "README.md").read_text(encoding="utf-8")
    (share,) = re.findall(rf"^\| `{name}` \|.*\| ([\d.]+) \|$", text, re.MULTILINE)
    assert f"{aliasing(load_floor_plan(name)):.2f}" == share


def test_measuring_twice_gives_the_same() -> None:
    plan = load_floor_plan("generated:cycles=2,seed=1,aliasing=0.7")
    assert_array_equal(perceptual_aliasing(plan).aliased, perceptual_aliasing(plan).aliased)


def test_the_dial_turns_what_is_measured() -> None:
    means = [
        np.mean([aliasing(generate(BuildingSpec(cycles=3, seed=seed, aliasing=dial))) for seed in range(3)])
        for dial in (0.0, 0.5, 1.0)
    ]
    assert means[0] < 0.15
    assert means[0] + 0.1 < means[1] < means[2] - 0.1
    assert means[2] > 0.5

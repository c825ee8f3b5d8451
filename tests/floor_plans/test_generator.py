"""Generated buildings: what was asked for, drivable, the same everywhere; their names, and the splits."""

from __future__ import annotations

import hashlib
import os
import re
import subprocess
import sys
from typing import Any

import numpy as np
import pytest
import shapely
from hypothesis import assume, given, reject, settings
from hypothesis import strategies as st

from cyclic_env import CyclicLoopEnv, CyclicLoopVectorEnv, FloorPlan, FloorPlanError, load_floor_plan
from cyclic_env.floor_plans import BuildingSpec, generate, load_floor_plans, pool_label, separate_names
from cyclic_env.floor_plans.floor_plan import MIN_CYCLE_LENGTH
from cyclic_env.floor_plans.generator.layout import grow_edges
from cyclic_env.floor_plans.generator.names import split_names
from cyclic_env.floor_plans.generator.spec import HAND_SEED_MAX, RANGES, SPLITS, Draw, split_spec
from tests.helpers import ROOT, refused

GOLDEN = {
    "generated:cycles=4,seed=7": "7b1ae6b22fff6498",
    "generated:cycles=0,seed=1,rooms=0.5,dead_ends=5": "c68a4a8d99fd19a7",
    "generated:cycles=8,seed=3,size=20,width=1.8,diagonal=0.5,aliasing=0.5": "2938cec0b81ab3b8",
    "generated:cycles=12,seed=99,rooms=1,diagonal=1,aliasing=1": "bbc285b196eff0d0",
    "generated:train,index=0": "49a7728f7303ed25",
}
"""Digests of buildings, which never change."""


def digest(plan: FloorPlan) -> str:
    """Return a digest of the plan's rings, to the millimetre, whatever their first points and directions."""
    rings = []
    for ring in plan.rings:
        points = [tuple(point) for point in np.rint(1000 * ring).astype(int).tolist()]
        first = points.index(min(points))
        points = points[first:] + points[:first]
        rings.append(min(points, points[:1] + points[:0:-1]))
    return hashlib.sha256(repr(sorted(rings)).encode()).hexdigest()[:16]


@st.composite
def specs(draw: st.DrawFn) -> BuildingSpec:
    """Draw any specification within the ranges."""
    values: dict[str, Any] = {}
    for key, (least, most) in RANGES.items():
        kind = st.integers if isinstance(most, int) else st.floats
        values[key] = draw(kind(least, most))  # pyright: ignore[reportArgumentType]
    values["size"] = max(values["size"], 12.0 + 1.6 * values["width"])
    values["dead_ends"] = max(values["dead_ends"], 0 if values["cycles"] else 2)
    return BuildingSpec(**values)


def built(spec: BuildingSpec) -> FloorPlan:
    try:
        return generate(spec)
    except FloorPlanError as error:
        if "dead ends have space" not in str(error):
            raise
        reject()


# What was asked for


@given(specs())
@settings(max_examples=40, deadline=None)
def test_a_building_has_its_cycles_and_a_robot_passes_everywhere(spec: BuildingSpec) -> None:
    plan = built(spec)
    assert plan.cycles_total == spec.cycles
    assert plan.free_space.contains(plan.reachable(0.35))
    assert plan.free_space.boundary.distance(shapely.Point(plan.start[:2])) >= 0.75


@given(specs())
@settings(max_examples=20, deadline=None)
def test_holes_are_blocks_or_pillars_and_nothing_between(spec: BuildingSpec) -> None:
    lengths = [ring.length for ring in built(spec).free_space.interiors]
    assert all(length == pytest.approx(2.0) or length > MIN_CYCLE_LENGTH + 0.5 for length in lengths)


@given(specs())
@settings(max_examples=20, deadline=None)
def test_every_centreline_is_on_the_tour_and_in_free_space(spec: BuildingSpec) -> None:
    plan = built(spec)
    lines = shapely.MultiLineString(plan.centrelines)
    assert plan.free_space.covers(lines)
    if len(plan.centrelines) < 20:  # the tour of a building with many crossings takes long
        assert lines.length - 1e-3 <= plan.closed_tour() <= 2 * lines.length + 1e-3  # its grid is 1e-6 m


def free_ends(plan: FloorPlan) -> int:
    """Count the ends of centrelines that lie on no other one."""
    lines = [shapely.LineString(line) for line in plan.centrelines]
    ends = [(i, shapely.Point(line.coords[k])) for i, line in enumerate(lines) for k in (0, -1)]
    return sum(all(other.distance(end) > 0.005 for j, other in enumerate(lines) if j != i) for i, end in ends)


@pytest.mark.parametrize(("cycles", "dead_ends"), [(0, 2), (0, 6), (1, 0), (1, 3), (5, 8)])
@pytest.mark.parametrize("diagonal", [0.0, 1.0])
def test_a_building_has_as_many_dead_ends_as_asked(cycles: int, dead_ends: int, diagonal: float) -> None:
    for seed in range(4):
        spec = BuildingSpec(cycles=cycles, dead_ends=dead_ends, diagonal=diagonal, seed=seed)
        assert free_ends(generate(spec)) == dead_ends


@pytest.mark.parametrize("joined", range(5))
def test_joined_blocks_keep_the_number_of_cycles(joined: int) -> None:
    for seed in range(20):
        edges = grow_edges(Draw(seed, 0), 5, joined)
        nodes = [node for edge in edges for node in edge]
        assert len(edges) - len(set(nodes)) + 1 == 5
        assert all(nodes.count(node) > 1 for node in nodes)


def test_with_all_alike_blocks_are_equal_and_with_none_they_differ() -> None:
    alike, different = (generate(BuildingSpec(cycles=6, aliasing=a, dead_ends=0, rooms=0.0)) for a in (1.0, 0.0))
    assert len({round(hole.area) for hole in different.cycles}) == 6
    assert len({hole.bounds[2] - hole.bounds[0] for hole in alike.cycles}) < 6
    lengths = {round(shapely.length(shapely.LineString(line)), 2) for line in alike.centrelines}
    assert lengths == {22.0}


def test_a_diagonal_share_of_1_cuts_all_corners_and_of_0_none() -> None:
    def slanted(plan: FloorPlan) -> int:
        along = np.diff(np.array([line for line in plan.centrelines if len(line) == 2]), axis=1)[:, 0]
        return int((np.abs(along) > 0.01).all(axis=1).sum())

    assert slanted(generate(BuildingSpec(cycles=1, diagonal=1.0))) >= 4
    assert slanted(generate(BuildingSpec(cycles=1, diagonal=0.0))) == 0


def test_rooms_are_behind_doors_and_there_are_none_without() -> None:
    with_rooms, without = (generate(BuildingSpec(rooms=share, seed=3)) for share in (1.0, 0.0))
    assert with_rooms.free_area > without.free_area + 100
    rooms = shapely.get_parts(with_rooms.free_space.buffer(-0.8, join_style="mitre"))  # closes the doors
    assert len(rooms) > 4


# The same everywhere


@pytest.mark.parametrize("name", GOLDEN)
def test_a_generated_building_never_changes(name: str) -> None:
    assert digest(load_floor_plan(name)) == GOLDEN[name]


def test_the_hard_splits_have_many_cycles_and_places_that_look_alike() -> None:
    for split in ("hard_train", "hard_validation", "hard_test"):
        specs = [split_spec(split, index) for index in range(SPLITS[split].plans)]
        assert {spec.cycles for spec in specs} == set(range(6, 13))
        assert min(spec.aliasing for spec in specs) >= 0.7
        assert load_floor_plan(f"generated:{split},index=1").cycles_total == specs[1].cycles


def test_another_process_draws_the_same_buildings() -> None:
    code = (
        "from tests.floor_plans.test_generator import GOLDEN, digest\n"
        "from cyclic_env import load_floor_plan\n"
        "print(*(digest(load_floor_plan(name)) for name in reversed(GOLDEN)))"
    )
    environment = os.environ | {"PYTHONHASHSEED": "7", "PYTHONPATH": str(ROOT)}
    said = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, env=environment, capture_output=True, text=True, check=True
    )
    assert said.stdout.split() == [digest(load_floor_plan(name)) for name in reversed(GOLDEN)]


def test_seeds_draw_different_buildings() -> None:
    assert len({digest(generate(BuildingSpec(seed=seed))) for seed in range(8)}) == 8


# Names


@given(specs())
@settings(max_examples=50, deadline=None)
def test_a_name_leads_back_to_its_building(spec: BuildingSpec) -> None:
    assume(spec.seed <= HAND_SEED_MAX)
    assert "e" not in re.sub("[a-z_]+=", "", spec.name.removeprefix("generated:"))
    plan = built(spec)
    items = (item.split("=") for item in spec.name.removeprefix("generated:").split(","))
    values: dict[str, Any] = {key: float(text) if "." in text else int(text) for key, text in items}
    assert BuildingSpec(**values) == spec
    assert plan.name == spec.name


def test_a_name_says_cycles_seed_and_what_is_not_the_default() -> None:
    plan = load_floor_plan("generated:aliasing=0.50,seed=7,size=22")
    assert plan.name == "generated:cycles=4,seed=7,aliasing=0.5"
    assert load_floor_plan(plan.name) is plan
    assert load_floor_plan("generated:").name == "generated:cycles=4,seed=0"


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("generated:cycle=3", "unknown key 'cycle'. Did you mean 'cycles'?"),
        ("generated:cycles=3,seed=1,cycles=3", "key 'cycles' is given twice"),
        ("generated:cycles=13", "cycles is 13; expected a whole number from 0 to 12"),
        ("generated:aliasing=1.01", "aliasing is 1.01; expected a number from 0 to 1"),
        ("generated:seed=1000000", "at most 999999"),
        ("generated:size=16,width=3", "expected at least 16.8"),
        ("generated:cycles=1,seed=1,size=18,width=3.6,dead_ends=12,diagonal=1", "only 7 of 12 dead ends have space"),
        ("generated:tset", "unknown split 'tset'. Did you mean 'test'?"),
        ("generated:test", "is a pool of 200 plans"),
        ("generated:test,index=200", "test has the plans 0 to 199"),
    ],
)
def test_a_bad_name_gets_one_line(name: str, message: str) -> None:
    with refused(f"(?=.*{re.escape(name)}).*{re.escape(message)}", FloorPlanError):
        load_floor_plan(name)


@pytest.mark.parametrize("value", [True, "3", None, np.nan, 1e9, -1])
def test_a_bad_value_is_refused(value: object) -> None:
    for key in ("cycles", "size", "aliasing"):
        with pytest.raises(FloorPlanError, match=key):
            BuildingSpec(**{key: value})  # pyright: ignore[reportArgumentType]


def test_commas_separate_maps_but_not_the_keys_of_one() -> None:
    text = "ring,generated:cycles=4,seed=7,grid,generated:train,generated:test,index=3,my.yaml"
    names = ["ring", "generated:cycles=4,seed=7", "grid", "generated:train", "generated:test,index=3", "my.yaml"]
    assert separate_names(text) == names


# Splits


def test_splits_share_no_seed_with_each_other_or_with_those_given_by_hand() -> None:
    seeds = [split_spec(split, i).seed for split in SPLITS for i in range(SPLITS[split].plans)]
    assert len(set(seeds)) == len(seeds) == 2 * (256 + 64 + 200)
    assert min(seeds) > HAND_SEED_MAX


def test_a_split_covers_the_dials() -> None:
    members = [split_spec("train", i) for i in range(256)]
    assert {spec.cycles for spec in members} == set(range(1, 9))
    shares = np.sort([spec.aliasing for spec in members])
    assert np.abs(shares - np.linspace(0, 1, 256)).max() < 0.1
    assert len({digest(load_floor_plan(name)) for name in split_names("generated:train")[:8]}) == 8


@pytest.mark.parametrize("split", SPLITS)
def test_members_of_a_split_are_what_they_are_meant_to_be(split: str) -> None:
    for i in range(0, SPLITS[split].plans, 40):
        plan = load_floor_plan(f"generated:{split},index={i}")
        assert plan.name == f"generated:{split},index={i}"
        assert plan.cycles_total == split_spec(split, i).cycles
        plan.reachable(0.35)


def test_a_split_is_a_pool_of_all_its_members() -> None:
    plans = load_floor_plans(["ring", "generated:validation"])
    assert len(plans) == 65
    assert plans[3] is load_floor_plan("generated:validation,index=2")
    assert pool_label(plans.names) == "ring,generated:validation"
    assert pool_label(plans[1:3].names) == "generated:validation,index=0,generated:validation,index=1"


def test_each_reset_draws_a_building_of_the_split() -> None:
    env = CyclicLoopVectorEnv(16, "generated:validation")
    env.reset(seed=0)
    names = [env.floor_plan(row).name for row in range(16)]
    assert len(set(names)) > 8
    env.reset()
    assert [env.floor_plan(row).name for row in range(16)] != names


def test_a_generated_building_drives_like_any_other() -> None:
    env = CyclicLoopEnv("generated:cycles=2,seed=1")
    env.reset(seed=0)
    *_, info = [env.step(np.array([1, 1, -1, 0], np.float32)) for _ in range(10)][-1]
    assert info["cycles_total"] == 2
    assert info["path_length_m"] > 1

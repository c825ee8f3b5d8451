"""Floor plans from names and YAML files, and messages for mistakes."""

from __future__ import annotations

import contextlib
import re
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cyclic_env.errors import FloorPlanError
from cyclic_env.floor_plans import (
    FloorPlan,
    floor_plan_from_mapping,
    load_floor_plan,
    load_floor_plans,
    polygon_from_rings,
)
from cyclic_env.floor_plans.library import maps_folder
from tests.helpers import refused

SQUARE = [(0.0, 0.0), (60.0, 0.0), (60.0, 60.0), (0.0, 60.0)]


def square_plan() -> FloorPlan:
    return FloorPlan("square", polygon_from_rings(SQUARE), (1.0, 1.0, 0.0))


# What the loader takes


def test_a_pool_mixes_names_paths_and_plans() -> None:
    plan = square_plan()
    assert load_floor_plan(plan) is plan
    assert [plan.name for plan in load_floor_plans("ring")] == ["ring"]
    pool = load_floor_plans(["grid", maps_folder() / "ring.yaml", plan])
    assert [plan.name for plan in pool] == ["grid", "ring", "square"]


def test_centrelines_may_be_named_and_a_heading_left_out_is_east() -> None:
    data = {"start": {"x": 1, "y": 1}, "exterior": SQUARE, "centrelines": {"main": [[0, 5], [9, 5]]}}
    plan = floor_plan_from_mapping(data)
    assert (plan.centrelines, plan.start) == ((((0.0, 5.0), (9.0, 5.0)),), (1.0, 1.0, 0.0))


# Mistakes in a file: each is one line that names the file, the key, and what to do

START = "start: {x: 1, y: 1}\n"
OUTER = "exterior: [[0, 0], [60, 0], [60, 60], [0, 60]]\n"
CORRIDOR = "corridors: [{width: 2, line: [[0, 1], [30, 1]]}]\n"

MISTAKES: dict[str, tuple[str | bytes, str]] = {
    "empty file": ("", "mapping with some of the keys.*got an empty file"),
    "binary file": (bytes(range(256)), "is not valid YAML"),
    "Python object": ("title: !!python/object:os.system {}", "not valid YAML.*constructor"),
    "nested too deeply": ("title: " + "[" * 50_000, "not valid YAML.*too deeply"),
    "map without an image": ("resolution: 0.05\norigin: [0, 0, 0]", "image: is missing; a map has"),
    "unknown key": (START + OUTER + "hole: []", "unknown key 'hole'.*Did you mean 'holes'"),
    "key given twice": (START + OUTER + START, "key 'start' is given twice at line 1"),
    "no free space": (START, "either as `exterior`.* or as `corridors`"),
    "exterior and corridors": (START + OUTER + CORRIDOR, "either as `exterior`.* or as `corridors`"),
    "missing start": (OUTER, "start: expected a mapping with x, y"),
    "start in a hole": (
        "start: {x: 15, y: 15}\n" + OUTER + "holes: [[[10, 10], [20, 10], [20, 20], [10, 20]]]",
        r"start \(15, 15\) is inside a wall.*choose a point in free space, for example \(",
    ),
    "NaN": ("start: {x: .nan, y: 1}\n" + OUTER, r"start\.x: expected a number from .* got nan"),
    "point of three": (START + "exterior: [[0, 0, 0], [9, 0], [9, 9]]", r"exterior\[0\]: expected a point \[x, y\]"),
    "crossing ring": (
        START + "exterior: [[0, 0], [9, 9], [9, 0], [0, 9]]",
        r"exterior: the ring crosses or touches itself.*4\.5 4\.5.*list its corners in order",
    ),
    "hole across the wall": (START + OUTER + "holes: [[[50, 5], [90, 5], [90, 9]]]", r"holes\[0\]: reaches out"),
    "hole along the wall": (START + OUTER + "holes: [[[0, 20], [0, 40], [20, 30]]]", r"holes\[0\]: .* lies along it"),
    "hole in a hole": (
        START + OUTER + "holes: [[[10, 10], [30, 10], [20, 30]], [[19, 15], [21, 15], [20, 17]]]",
        r"holes\[1\]: overlaps holes\[0\].*merge them",
    ),
    "no corridors": (START + "corridors: []", "corridors: the list is empty"),
    "negative width": (
        START + "corridors: [{width: -2, line: [[0, 0], [9, 0]]}]",
        r"corridors\[0\]\.width: expected more than 0, got -2",
    ),
    "room apart": (START + CORRIDOR + "rooms: [[[3, 5], [6, 5], [6, 8], [3, 8]]]", "not connected.*join them"),
}


@pytest.mark.parametrize(("text", "message"), MISTAKES.values(), ids=MISTAKES)
def test_a_mistake_in_a_file_is_told_in_one_line(text: str | bytes, message: str, tmp_path: Path) -> None:
    path = tmp_path / "plan.yaml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with refused(f"^{re.escape(str(path))}: .*{message}", FloorPlanError):
        load_floor_plan(path).reachable(0.25)


def test_a_missing_file_is_told_with_the_known_names(tmp_path: Path) -> None:
    with pytest.raises(FloorPlanError, match=r"no floor plan file .*gone\.yaml.*one of: chamfered"):
        load_floor_plan(tmp_path / "gone.yaml")


@pytest.mark.parametrize("name", ["kilian_court", "Killian Court", "killian-court"])
def test_an_unknown_map_is_told_with_the_nearest(name: str) -> None:
    with pytest.raises(FloorPlanError, match=r"unknown map .* Did you mean 'killian_court'"):
        load_floor_plan(name)


@pytest.mark.parametrize("name", ["", "a\0b", "a" * 5000, "a/" * 5000, "~nobody-here/plan.yaml"])
def test_an_odd_name_is_an_error_of_ours(name: str) -> None:
    with pytest.raises(FloorPlanError, match=r"unknown map|no floor plan file"):
        load_floor_plan(name)


@pytest.mark.parametrize("pool", [[], None, 3, {"ring"}, ["ring", 3]])
def test_a_pool_is_a_list_of_maps_that_is_not_empty(pool: object) -> None:
    with pytest.raises(FloorPlanError, match="a map is a name, a path"):
        load_floor_plans(pool)  # pyright: ignore[reportArgumentType]


JUNK = st.sampled_from(
    [None, True, 0, -1, 20, 1e300, float("nan"), 10**5000, "x", "", b"x", [], {}, [[]], [[1, 2]], {"x": 1}, {1}, 1j]
)
PLANS = [
    {
        "start": {"x": 1, "y": 0, "heading": 0},
        "corridors": [{"width": 2, "line": [[0, 0], [20, 0], [20, 20], [0, 20], [0, 0]]}],
        "rooms": [[[5, -3], [8, -3], [8, 0]]],
    },
    {
        "name": "a",
        "start": {"x": 1, "y": 1},
        "exterior": [[0, 0], [30, 0], [30, 30], [0, 30]],
        "holes": [[[5, 5], [20, 5], [20, 20]], [[5, 25], [8, 25], [8, 28]]],
        "centrelines": {"main": [[1, 1], [2, 2]]},
    },
]


@st.composite
def spoilt_plans(draw: st.DrawFn, value: object = PLANS) -> object:
    """Draw one of `PLANS` with junk put in some place of it."""
    if value is PLANS:
        value = draw(st.sampled_from(PLANS))
    elif draw(st.integers(0, 3)) == 0 or not isinstance(value, list | dict):
        return draw(JUNK)
    copy = dict(value) if isinstance(value, dict) else list(value)  # pyright: ignore[reportArgumentType]
    place = draw(st.sampled_from(list(copy) if isinstance(copy, dict) else range(len(copy))))
    copy[place] = draw(spoilt_plans(copy[place]))  # pyright: ignore[reportArgumentType, reportCallIssue]
    return copy


@settings(max_examples=300, deadline=None)
@given(spoilt_plans())
def test_a_spoilt_plan_is_taken_or_refused_by_a_floor_plan_error(data: object) -> None:
    with contextlib.suppress(FloorPlanError):
        floor_plan_from_mapping(data).reachable(0.25)


def test_the_buildings_of_a_split_are_drawn_when_they_are_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[str] = []
    monkeypatch.setattr(
        "cyclic_env.floor_plans.library.building_from_name", lambda name: drawn.append(name) or square_plan()
    )
    pool = load_floor_plans(["ring", "generated:train"])
    assert (len(pool), list(pool.loaded), drawn) == (257, [0], [])
    assert pool.names[:2] == ["ring", "generated:train,index=0"]
    pool[5]
    assert drawn == ["generated:train,index=4"]

"""Floor plans: the shipped ones, their geometry, and whether a robot can drive them."""

from __future__ import annotations

import re
import tempfile
from pathlib import Path

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely.affinity import scale, translate
from shapely.geometry import MultiPolygon, Polygon, box

from cyclic_env.errors import FloorPlanError
from cyclic_env.floor_plans import (
    FloorPlan,
    load_floor_plan,
    map_names,
    polygon_from_corridors,
    polygon_from_rings,
    read_floor_plan,
    write_floor_plan,
)
from cyclic_env.floor_plans.library import maps_folder

CYCLES = {
    "chamfered": 2,
    "dead_ends": 0,
    "figure_eight": 2,
    "grid": 9,
    "killian_court": 6,
    "mirror_halls": 2,
    "office": 1,
    "ring": 1,
    "twin_rings": 2,
}
SQUARE = [(0.0, 0.0), (60.0, 0.0), (60.0, 60.0), (0.0, 60.0)]
BLOCK_SPACING = 16.0
"""Between crossings of the random plans, metres: with corridors of up to 3 m every block is a cycle (52 m)."""
LATTICE = [((x, y), (x + 1, y)) for x in range(3) for y in range(4)] + [
    ((x, y), (x, y + 1)) for x in range(4) for y in range(3)
]

shipped = pytest.mark.parametrize("name", sorted(CYCLES))


def assert_free_left_of_walls(plan: FloorPlan) -> None:
    start, end = plan.walls[:, :2], plan.walls[:, 2:]
    along = (end - start) / np.linalg.norm(end - start, axis=1, keepdims=True)
    left = np.stack([-along[:, 1], along[:, 0]], axis=1)
    beside = shapely.points((start + end) / 2 + 1e-4 * left)
    assert shapely.contains(plan.free_space, beside).all()


def square_plan(holes: list | None = None, start: tuple[float, float, float] = (1.0, 1.0, 0.0)) -> FloorPlan:
    return FloorPlan("square", polygon_from_rings(SQUARE, holes or []), start)


@st.composite
def block_plans(draw: st.DrawFn) -> tuple[FloorPlan, int]:
    """Draw a connected plan of streets on a lattice, and its number of blocks."""
    nodes, edges = {(0, 0)}, []
    for edge in draw(st.permutations(LATTICE))[: draw(st.integers(14, len(LATTICE)))]:
        if nodes & set(edge) or not edges:
            edges.append(edge)
            nodes = set().union(*edges)
    corridors = []
    for edge in edges:
        width = draw(st.integers(10, 30)) / 10
        corridors.append((width, [(BLOCK_SPACING * x, BLOCK_SPACING * y) for x, y in edge]))
    lines = tuple(tuple(line) for _, line in corridors)
    plan = FloorPlan("blocks", polygon_from_corridors(corridors), (*lines[0][0], 0.0), centrelines=lines)
    return plan, len(edges) - len(nodes) + 1


# The shipped plans


def test_the_library_lists_exactly_the_shipped_plans() -> None:
    assert map_names() == sorted(CYCLES)


@shipped
def test_a_shipped_plan_says_what_it_is_and_has_its_cycles(name: str) -> None:
    plan = load_floor_plan(name)
    assert (plan.name, plan.cycles_total) == (name, CYCLES[name])
    assert all(text.strip() for text in (plan.title, plan.source, plan.licence))


@shipped
def test_a_robot_passes_everywhere_in_a_shipped_plan(name: str) -> None:
    plan = load_floor_plan(name)
    assert plan.free_space.boundary.distance(shapely.Point(plan.start[:2])) >= 0.5
    for radius in (0.25, 0.35):
        assert plan.free_space.contains(plan.reachable(radius))


@shipped
def test_free_space_lies_left_of_all_shipped_walls(name: str) -> None:
    assert_free_left_of_walls(load_floor_plan(name))


@shipped
def test_no_shipped_hole_is_nearly_a_cycle(name: str) -> None:
    lengths = [ring.length for ring in load_floor_plan(name).free_space.interiors]
    assert not [length for length in lengths if 20.0 < length < 50.0]


@shipped
def test_every_free_cell_of_a_shipped_plan_is_in_sight_of_the_way(name: str) -> None:
    plan = load_floor_plan(name)
    west, south, east, north = plan.bounds
    x, y = np.meshgrid(np.arange(west + 0.25, east, 0.5), np.arange(south + 0.25, north, 0.5))
    cells = np.asarray(shapely.points(x.ravel(), y.ravel()))
    shapely.prepare(plan.free_space)
    cells = cells[shapely.contains(plan.free_space, cells)]
    home = plan.reachable(0.35)
    shapely.prepare(home)
    away = cells[~shapely.covers(home, cells)]
    assert shapely.covers(plan.free_space, shapely.shortest_line(away, home)).all()


@shipped
def test_shipped_centrelines_stay_in_free_space(name: str) -> None:
    plan = load_floor_plan(name)
    lines = shapely.union_all([shapely.LineString(line) for line in plan.centrelines])
    assert lines.difference(plan.free_space).length <= 0.03 * lines.length  # Killian Court's are read off by eye


def test_twin_rings_differ_by_a_shift_and_hide_the_way_between_them_from_a_laser_in_a_ring() -> None:
    free = load_floor_plan("twin_rings").free_space
    west, east = free.intersection(box(-5, -12.5, 27, 20)), free.intersection(box(29, -12.5, 61, 20))
    assert translate(west, 34.0).symmetric_difference(east).area < 1e-6
    corner = free.intersection(box(11.2, -20, 42.8, -10))  # all that lies around the corner
    assert free.intersection(box(-5, -1.2, 27, 20)).distance(corner) > 12.0


def test_mirror_halls_are_mirrored_and_not_alike_by_a_turn() -> None:
    plan = load_floor_plan("mirror_halls")
    mirrored, turned = (scale(plan.free_space, -1.0, y, origin=(0, 0)) for y in (1.0, -1.0))
    assert mirrored.symmetric_difference(plan.free_space).area < 1e-6
    assert turned.symmetric_difference(plan.free_space).area > 10.0
    assert (len(plan.free_space.interiors), plan.cycles_total) == (4, 2)  # a pillar is no cycle


@shipped
def test_the_readme_table_agrees_with_the_plan(name: str) -> None:
    plan = load_floor_plan(name)
    text = (maps_folder() / "README.md").read_text(encoding="utf-8")
    (row,) = re.findall(rf"^\| `{name}` \|.*?\| (\d+) \| (\d+) \| (\d+) \| (\d+) \| [\d.]+ \|$", text, re.MULTILINE)
    expected = plan.cycles_total, round(plan.free_area), round(plan.closed_tour()), len(plan.walls)
    assert tuple(map(int, row)) == expected


def test_the_readme_example_is_a_plan_that_can_be_driven(tmp_path: Path) -> None:
    text = (maps_folder() / "README.md").read_text(encoding="utf-8")
    (example,) = re.findall(r"```yaml\n(.*?)```", text, re.DOTALL)
    path = tmp_path / "my_plan.yaml"
    path.write_text(example, encoding="utf-8")
    plan = load_floor_plan(path)
    plan.reachable(0.35)
    assert (plan.name, plan.cycles_total, plan.free_area > 150) == ("my_plan", 1, True)


# Geometry


@settings(max_examples=60, deadline=None)
@given(block_plans())
def test_every_block_between_streets_is_a_cycle_and_all_can_be_driven(drawn: tuple[FloorPlan, int]) -> None:
    plan, blocks = drawn
    assert plan.cycles_total == len(plan.reachable(0.35).interiors) == blocks
    assert_free_left_of_walls(plan)


def written(plan: FloorPlan) -> FloorPlan:
    """Return a plan as it is read back from a file."""
    with tempfile.TemporaryDirectory() as folder:
        write_floor_plan(plan, Path(folder) / "plan.yaml")
        return read_floor_plan(Path(folder) / "plan.yaml")


AWKWARD = ["Z\u00fcrich", "next\x85line", "a\u2028b\u2029c", "two\nlines", "\ufeff", "yes", "3", "1e3", ": #"]


@settings(max_examples=60, deadline=None)
@given(st.sampled_from(AWKWARD) | st.text(max_size=20), st.floats(-4, 4))
def test_text_and_heading_of_a_written_plan_read_back_the_same(title: str, heading: float) -> None:
    plan = FloorPlan("square", Polygon(SQUARE), (1, 1, heading), title, "source", "licence")
    back = written(plan)
    assert (back.title, back.start) == (title, plan.start)


@settings(max_examples=25, deadline=None)
@given(block_plans())
def test_a_written_plan_reads_back_the_same(drawn: tuple[FloorPlan, int]) -> None:
    plan, back = drawn[0], written(drawn[0])
    assert [ring.tolist() for ring in back.rings] == [ring.tolist() for ring in plan.rings]
    fields = ("name", "start", "source", "licence", "centrelines")
    assert [getattr(back, field) for field in fields] == [getattr(plan, field) for field in fields]


@shipped
def test_a_shipped_plan_reads_back_the_same(name: str) -> None:
    plan = load_floor_plan(name)
    np.testing.assert_allclose(written(plan).walls, plan.walls, rtol=0, atol=1e-6)


@pytest.mark.parametrize("turn", [1, -1])
def test_the_order_of_a_ring_does_not_matter(turn: int) -> None:
    hole = [(20, 20), (40, 20), (40, 40), (20, 40)]
    assert_free_left_of_walls(FloorPlan("square", polygon_from_rings(SQUARE[::turn], [hole[::turn]]), (1, 1, 0)))


def test_points_given_twice_and_heights_make_no_walls() -> None:
    twice = polygon_from_rings([SQUARE[0], *SQUARE, (0.0, 60.0 - 1e-9), SQUARE[0]])
    for polygon in (twice, Polygon([(x, y, 3.0) for x, y in SQUARE])):
        assert FloorPlan("square", polygon, (1, 1, 0)).walls.shape == (4, 4)


def test_a_corridor_ends_half_a_width_beyond_its_line_and_a_closed_line_is_a_loop() -> None:
    assert polygon_from_corridors([(2.0, [(0, 0), (10, 0)])]).bounds == (-1.0, -1.0, 11.0, 1.0)
    loop = polygon_from_corridors([(2.0, [(0, 0), (20, 0), (20, 20), (0, 20), (0, 0)])])
    assert (loop.bounds, loop.area) == ((-1.0, -1.0, 21.0, 21.0), 22.0**2 - 18.0**2)


def test_an_anchor_lies_in_the_hole_of_its_cycle() -> None:
    plan = load_floor_plan("office")
    assert plan.cycles[0].contains(shapely.Point(plan.cycle_anchors[0]))
    assert square_plan().cycle_anchors.shape == (0, 2)


# Plans made in code


@pytest.mark.parametrize("polygon", [None, Polygon(), MultiPolygon([Polygon(SQUARE)])])
def test_free_space_is_one_polygon(polygon: Polygon) -> None:
    with pytest.raises(FloorPlanError, match="floor plan 'p': the free space must be one polygon"):
        FloorPlan("p", polygon, (1, 1, 0))


@pytest.mark.parametrize("start", [None, (1, 1), (1, 1, float("nan")), ("x", 1, 0)])
def test_a_start_is_three_finite_numbers(start: tuple[float, float, float]) -> None:
    with pytest.raises(FloorPlanError, match="start must be finite"):
        square_plan(start=start)


# What a robot can't drive: names the file or the plan, and a place


def test_a_start_too_near_a_wall_is_told_with_the_file_and_a_better_one(tmp_path: Path) -> None:
    write_floor_plan(square_plan(start=(0.1, 30.0, 0.0)), tmp_path / "plan.yaml")
    message = r"/plan\.yaml: start \(0\.1, 30\) is 0\.10 m from a wall, .* for example to \(0\.[23], 30\.0\)"
    with pytest.raises(FloorPlanError, match=message):
        read_floor_plan(tmp_path / "plan.yaml").reachable(0.25)


SLIT = [(4.0, [(0, 0), (4, 0)]), (0.3, [(4, 0), (20, 0)]), (4.0, [(20, 0), (40, 0)])]
DEAD_END = [(2.0, [(0, 0), (20, 0)]), (0.4, [(20, 0), (40, 0)])]


@pytest.mark.parametrize(
    ("corridors", "x", "message"),
    [
        (SLIT, 0, r"lies in a pocket of .* for example at \(\d"),
        (SLIT, 30, "too narrow .* can't reach .* widen the way there, .* smaller robot"),
        (DEAD_END, 5, "too narrow .* can't reach"),
    ],
    ids=["a start in a pocket", "a room behind a slit", "a dead end too narrow"],
)
def test_what_a_robot_cannot_enter_is_refused(corridors: list, x: float, message: str) -> None:
    with pytest.raises(FloorPlanError, match=message):
        FloorPlan("p", polygon_from_corridors(corridors), (x, 0, 0)).reachable(0.25)


def test_a_position_outside_and_a_robot_that_fits_nowhere_are_refused() -> None:
    with pytest.raises(FloorPlanError, match=r"start \(99, 99\) is inside a wall or outside"):
        square_plan().reachable(0.25, (99, 99, 0))
    with pytest.raises(FloorPlanError, match="fits nowhere"):
        square_plan().reachable(40.0)


def test_a_small_nook_is_no_reason_to_refuse() -> None:
    polygon = polygon_from_corridors([(2.0, [(0, 0), (30, 0)])], [[(5, 0), (5.4, 0), (5.4, 3), (5, 3)]])
    assert FloorPlan("p", polygon, (9, 0, 0)).reachable(0.25).area > 0

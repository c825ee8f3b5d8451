"""The laser against its plain twin, against pymunk, and on rooms known on paper."""

from __future__ import annotations

import math

import numpy as np
import pymunk
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from cyclic_env.config import LaserConfig
from cyclic_env.floor_plans import FloorPlan
from cyclic_env.simulation.lidar import laser_beams, scan, scan_row
from cyclic_env.simulation.wall_index import TILE_SIZE, build_wall_index

LASER = LaserConfig()


class Scanner:
    """The compiled laser in one plan."""

    def __init__(self, plan: FloorPlan, laser: LaserConfig = LASER) -> None:
        self.walls, self.beams = build_wall_index(plan, laser.range_max), laser_beams(laser)
        self.laser = laser

    def __call__(self, x: float, y: float, heading: float) -> np.ndarray:
        ranges, scratch = np.empty(self.laser.num_beams), np.empty(2 * self.laser.num_beams)
        scan_row(self.walls, 0, (x, y, heading), self.beams, scratch, ranges)
        return ranges


def random_poses(plan: FloorPlan, count: int, seed: int) -> np.ndarray:
    """Return poses in free space; many on round coordinates and compass headings, so that beams meet corners."""
    rng = np.random.default_rng(seed)
    inside = plan.free_space.buffer(-0.15)
    points = np.empty((0, 2))
    while len(points) < count:
        draw = rng.uniform(plan.bounds[:2], plan.bounds[2:], (20 * count, 2))
        draw[::3] = np.round(draw[::3], 1)
        draw[1::6] = np.round(draw[1::6])
        points = np.concatenate([points, draw[shapely.contains_xy(inside, *draw.T)]])
    headings = rng.uniform(-math.pi, math.pi, count)
    headings[::2] = rng.choice([0, math.pi / 4, math.pi / 2, math.pi, -math.pi / 2], len(headings[::2]))
    return np.column_stack([points[:count], headings])


def test_it_equals_its_twin_on_every_plan(plan: FloorPlan) -> None:
    scanner = Scanner(plan)
    for pose in random_poses(plan, 300, seed=1):
        np.testing.assert_allclose(scanner(*pose), scan(plan.walls, pose, LASER), rtol=0, atol=1e-9)


def test_it_equals_its_twin_in_line_with_corners_and_walls(plan: FloorPlan) -> None:
    """Poses from which a beam runs exactly at a corner, or along the line of a wall."""
    scanner = Scanner(plan)
    rng = np.random.default_rng(2)
    inside = plan.free_space.buffer(-0.15)
    checked = 0
    for wall in plan.walls[rng.permutation(len(plan.walls))[:150]]:
        corner, along = wall[:2], (wall[2:] - wall[:2]) / np.linalg.norm(wall[2:] - wall[:2])
        away = [*along * -rng.uniform(0.2, 8), *rng.uniform(-4, 4, 2)]
        for offset in (away[:2], away[2:]):
            x, y = corner + offset
            if not shapely.contains_xy(inside, x, y):
                continue
            heading = math.atan2(corner[1] - y, corner[0] - x)
            pose = np.array([x, y, heading])
            np.testing.assert_allclose(scanner(*pose), scan(plan.walls, pose, LASER), rtol=0, atol=1e-9)
            checked += 1
    assert checked > 10


@pytest.mark.parametrize("reach", [0.3, 3.0, 12.0])
def test_each_tile_lists_the_walls_within_reach_that_face_it(plan: FloorPlan, reach: float) -> None:
    index = build_wall_index(plan, reach)
    west, south, columns, rows, _ = index.grids[0]
    walls = shapely.linestrings(plan.walls.reshape(-1, 2, 2))
    x1, y1, x2, y2 = plan.walls.T
    rng = np.random.default_rng(0)
    for tile in rng.permutation(columns * rows)[:60]:
        x, y = west + TILE_SIZE * (tile % columns), south + TILE_SIZE * (tile // columns)
        box = shapely.box(x, y, x + TILE_SIZE, y + TILE_SIZE)
        corners = np.array(box.exterior.coords)
        left = (x2 - x1)[:, None] * (corners[:, 1] - y1[:, None]) - (y2 - y1)[:, None] * (corners[:, 0] - x1[:, None])
        expected = np.flatnonzero((left > -1e-6).any(axis=1) & (shapely.distance(walls, box) <= reach + 1e-6))
        if not plan.free_space.intersects(box):
            expected = expected[:0]
        assert index.indices[index.offsets[tile] : index.offsets[tile + 1]].tolist() == expected.tolist()


def test_no_beam_leaks_out_of_any_plan(plan: FloorPlan) -> None:
    """Every beam's end is on a wall, or at full range in free space."""
    scanner = Scanner(plan)
    boundary, grown = plan.free_space.boundary, plan.free_space.buffer(1e-6)
    for prepared in (boundary, grown):
        shapely.prepare(prepared)
    for pose in random_poses(plan, 60, seed=3):
        ranges = scanner(*pose)
        angles = pose[2] + LASER.beam_spacing * np.arange(LASER.num_beams)
        ends = pose[:2] + ranges[:, None] * np.column_stack([np.cos(angles), np.sin(angles)])
        short = ranges < LASER.range_max
        assert shapely.distance(shapely.points(ends[short]), boundary).max(initial=0) < 1e-8
        beams = shapely.linestrings(np.stack([np.broadcast_to(pose[:2], ends.shape), ends], axis=1))
        assert shapely.covers(grown, beams).all()


def test_it_agrees_with_pymunks_segment_queries() -> None:
    plan = FloorPlan("bend", shapely.union(shapely.box(0, 0, 10, 2), shapely.box(8, 0, 10, 9)), (1, 1, 0))  # pyright: ignore[reportArgumentType]
    space = pymunk.Space()
    for x1, y1, x2, y2 in plan.walls.tolist():
        space.add(pymunk.Segment(space.static_body, (x1, y1), (x2, y2), 0))
    scanner = Scanner(plan)
    for x, y, heading in random_poses(plan, 50, seed=4)[1::2]:
        for beam, reading in enumerate(scanner(x, y, heading)):
            angle = heading + beam * LASER.beam_spacing
            end = (x + LASER.range_max * math.cos(angle), y + LASER.range_max * math.sin(angle))
            hit = space.segment_query_first((x, y), end, 0, pymunk.ShapeFilter())
            assert reading == pytest.approx(hit.alpha * LASER.range_max if hit else LASER.range_max, abs=1e-6)


def test_ranges_in_a_square_room_are_those_on_paper(square_room: FloorPlan) -> None:
    ranges = Scanner(square_room)(5.0, 5.0, 0.0)
    assert ranges[[0, 45, 90, 135]] == pytest.approx([5, 5, 5, 5])  # ahead, left, behind, right
    assert ranges[15] == pytest.approx(5 / math.cos(math.radians(30)))  # 30 degrees to the left


def test_beam_zero_points_ahead_and_beams_go_counter_clockwise(square_room: FloorPlan) -> None:
    ranges = Scanner(square_room)(2.0, 5.0, math.pi / 2)  # looks north; the west wall, 2 m off, is on the left
    assert ranges[[0, 45, 90, 135]] == pytest.approx([5, 2, 5, 8])


@pytest.mark.parametrize(("degrees", "mounting"), [(180, 0), (270, 0), (180, 90), (360, 180)])
def test_beams_are_spread_over_the_field_of_view_around_the_mounting_angle(
    degrees: int, mounting: int, plan: FloorPlan
) -> None:
    beams = degrees + (degrees < 360)  # one degree apart
    laser = LaserConfig(num_beams=beams, field_of_view=math.radians(degrees), mounting_angle=math.radians(mounting))
    first = mounting - (degrees // 2 if degrees < 360 else 0)
    assert np.degrees(laser.bearings) == pytest.approx(first + np.arange(beams))
    all_around, scanner = Scanner(plan, LaserConfig(num_beams=360)), Scanner(plan, laser)
    for pose in random_poses(plan, 50, seed=3):
        expected = all_around(*pose)[(first + np.arange(beams)) % 360]
        np.testing.assert_allclose(scanner(*pose), expected, rtol=0, atol=1e-6)


def test_a_beam_that_grazes_a_corner_stops_at_it() -> None:
    # A pillar's corner at (5, 5); the beam from (2, 2) at 45 degrees touches it and could go on to (8, 8).
    pillar = shapely.Polygon([(5, 5), (4, 7), (3, 6)])
    plan = FloorPlan("pillar", shapely.box(0, 0, 10, 10).difference(pillar), (1, 1, 0))  # pyright: ignore[reportArgumentType]
    assert Scanner(plan)(2.0, 2.0, math.pi / 4)[0] == pytest.approx(math.hypot(3, 3), abs=1e-8)


def test_a_ray_parallel_to_a_wall_misses_it() -> None:
    corridor = FloorPlan("corridor", shapely.box(0, 0, 40, 2), (1, 1, 0))
    ranges = Scanner(corridor)(5.0, 1.0, 0.0)
    assert ranges[0] == LASER.range_max
    assert ranges[90] == pytest.approx(5)


def test_a_reach_shorter_than_the_room_reads_the_reach_everywhere(square_room: FloorPlan) -> None:
    laser = LaserConfig(num_beams=4, range_max=3.0)
    assert Scanner(square_room, laser)(5.0, 5.0, 0.3).tolist() == [3.0] * 4


@settings(max_examples=60, deadline=None)
@given(
    st.integers(3, 12),
    st.integers(0, 10_000),
    st.sampled_from([4, 7, 180, 720]),
    st.sampled_from([1, 90, 180, 270, 359, 360]),
    st.sampled_from([0, 0, 90, -180, 37]),
)
def test_it_equals_its_twin_in_random_star_shaped_rooms(
    corners: int, seed: int, num_beams: int, field_of_view: float, mounting: float
) -> None:
    rng = np.random.default_rng(seed)
    angles = np.sort(rng.uniform(0, 2 * math.pi, corners)) + 1e-3 * np.arange(corners)
    if np.diff([*angles, angles[0] + 2 * math.pi]).max() > 3.0:  # the robot would not see all of it
        angles = 2 * math.pi * np.arange(corners) / corners
    radii = rng.uniform(0.5, 15, corners)
    room = shapely.Polygon(np.column_stack([radii * np.cos(angles), radii * np.sin(angles)]))
    plan = FloorPlan("star", room, (0, 0, 0))
    laser = LaserConfig(
        num_beams=num_beams,
        range_max=10.0,
        field_of_view=math.radians(field_of_view),
        mounting_angle=math.radians(mounting),
    )
    pose = np.array([0, 0, rng.uniform(-math.pi, math.pi)])
    np.testing.assert_allclose(Scanner(plan, laser)(*pose), scan(plan.walls, pose, laser), rtol=0, atol=1e-9)

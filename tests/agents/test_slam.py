"""The explorer's mapping and driving: scans, their matching, the track, the open areas' list, the ways."""

from __future__ import annotations

import math

import numpy as np
import pytest
import shapely
from scipy.optimize import least_squares
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from agents.exploration.costmap import CELL, CELLS, Costmap
from agents.exploration.frontiers import Frontiers
from agents.exploration.planner import steer
from agents.exploration.visibility import (
    DOUBTFUL,
    UNCONFIRMED,
    clear_beam,
    clear_lengths,
    inside,
    is_explored,
    open_points,
    to_track,
)
from agents.slam.keyframes import CAPACITY, Keyframes, route
from agents.slam.pose_graph import optimize
from agents.slam.scan_filters import confirm, despeckle, fill, reliable_endpoints
from agents.slam.scan_matching import fit_wall_lines, match
from agents.slam.se2 import compose, euclidean_distances, relative, wrap, wrap_all
from agents.slam.tracker import PoseTracker
from cyclic_env.config import LaserConfig
from cyclic_env.floor_plans import FloorPlan, load_floor_plan
from cyclic_env.simulation.lidar import scan

BEAMS, REACH = 180, 12.0
SPACING = math.tau / BEAMS


def plan_of(*boxes: tuple[float, float, float, float]) -> FloorPlan:
    space = shapely.union_all([shapely.box(*box) for box in boxes])
    x, y, *_ = boxes[0]
    return FloorPlan("drawn", space, (x + 1.0, y + 1.0, 0.0))  # pyright: ignore[reportArgumentType]


ROOM = plan_of((0, 0, 10, 6))
CROSSING = plan_of((0, 0, 30, 2.4), (14, -12, 16.4, 12))
"""A corridor from west to east and one from south to north, that cross at (15.2, 1.2)."""


def seen(plan: FloorPlan, *pose: float) -> np.ndarray:
    return scan(plan.walls, np.array(pose), LaserConfig())


NO_LEGS = np.zeros((0, 2, 2))


def places_at(plan: FloorPlan, poses: list[tuple[float, float, float]]) -> Keyframes:
    """Return places with true scans and poses, as if driven through in that order."""
    keyframes, path = Keyframes(BEAMS, 7), 0.0
    for step, pose in enumerate(poses):
        if step:
            path += math.hypot(pose[0] - poses[step - 1][0], pose[1] - poses[step - 1][1])
        ranges, lines = seen(plan, *pose), np.empty((BEAMS, 3))
        fit_wall_lines(ranges, REACH, lines)
        keyframes.add(pose=pose, odometry=pose[:2], scan=ranges, endpoints=ranges, lines=lines, step=step, path=path)
    return keyframes


# Poses.


def test_relative_and_compose_undo_each_other() -> None:
    rng = np.random.default_rng(0)
    a, b = rng.uniform(-4, 4, (2, 50, 3))
    np.testing.assert_allclose(relative(a, compose(a, b))[:, :2], b[:, :2], atol=1e-12)
    np.testing.assert_allclose(wrap_all(relative(a, compose(a, b))[:, 2] - b[:, 2]), 0, atol=1e-12)


@pytest.mark.parametrize(
    ("angle", "wrapped"), [(0.0, 0.0), (math.pi, -math.pi), (-7.0, math.tau - 7.0), (7.0, 7.0 - math.tau)]
)
def test_wrap_stays_within_half_a_turn(angle: float, wrapped: float) -> None:
    assert wrap(angle) == pytest.approx(wrapped)


# Scans.


def test_despeckle_is_the_median_of_five_medians_of_three() -> None:
    ranges, out = np.random.default_rng(0).random(BEAMS), np.empty(BEAMS)
    despeckle(ranges, out)
    threes = np.median([np.roll(ranges, shift) for shift in range(-1, 2)], axis=0)
    np.testing.assert_array_equal(out, np.median([np.roll(threes, shift) for shift in range(-2, 3)], axis=0))


def test_a_wrong_range_on_a_wall_seen_at_a_slant_opens_no_way_through_it() -> None:
    ranges, out = seen(CROSSING, 8.0, 1.2, 0.0), np.empty(BEAMS)
    for beam in range(BEAMS):
        wrong = ranges.copy()
        wrong[beam] = REACH
        despeckle(wrong, out)
        assert (
            out <= np.maximum(ranges, np.maximum(np.roll(ranges, 1), np.roll(ranges, -1))) + 1e-9
        ).sum() >= BEAMS - 1


def test_clear_lengths_are_those_of_a_rectangle_pushed_ahead() -> None:
    ranges, clear = seen(CROSSING, 13.0, 1.0, 0.3), np.empty(BEAMS)
    clear_lengths(ranges, 0.3, clear)
    angles = np.arange(BEAMS) * SPACING
    for beam in range(BEAMS):
        off = wrap_all(angles - angles[beam])
        in_way = (np.abs(off) < math.pi / 2) & (ranges * np.abs(np.sin(off)) < 0.3 - 1e-9)
        expected = min(ranges[beam], (ranges * np.cos(off))[in_way].min())
        # An end on the border of the rectangle may count as in its way or not.
        assert clear[beam] == pytest.approx(expected, abs=0.02)


def test_a_scan_sees_what_lies_before_its_ends() -> None:
    ranges, out = seen(ROOM, 5.0, 3.0, 1.0), np.empty(3, np.bool_)
    inside(ranges, 5.0, 3.0, 1.0, np.array([[9.0, 5.0], [9.95, 3.0], [10.5, 3.0]]), 0.1, out)
    assert out.tolist() == [True, False, False]


def test_a_closed_room_has_no_opening() -> None:
    out = np.empty((400, 3))
    assert open_points(seen(ROOM, 5.0, 3.0, 0.0), REACH, out) == 0


def test_openings_are_seen_at_the_ends_and_corners_of_a_crossing() -> None:
    pose, out = (13.0, 1.2, 0.0), np.empty((400, 3))
    count = open_points(seen(CROSSING, *pose), REACH, out)
    points = to_track(out[:count], np.tile(pose, (count, 1)), SPACING)
    firm = points[out[:count, 2] != DOUBTFUL]
    assert (firm[:, 0] > 24).any()  # the corridor's far end
    assert (firm[:, 0] < 2).any()
    assert ((firm[:, 1] > 2.4) & (np.abs(firm[:, 0] - 15.2) < 1.2)).any()  # the side corridors
    assert ((firm[:, 1] < 0.0) & (np.abs(firm[:, 0] - 15.2) < 1.2)).any()
    assert shapely.contains_xy(CROSSING.free_space.buffer(0.05), *firm.T).all()


def test_a_scan_settles_what_it_sees_beyond_and_what_is_at_a_wall() -> None:
    pose = (5.0, 3.0, 0.0)
    out = np.empty(3, np.bool_)
    is_explored(seen(ROOM, *pose)[None], np.array([pose]), REACH, np.array([[8.0, 4.0], [10.3, 3.0], [11.0, 3.0]]), out)
    assert out.tolist() == [True, True, False]


def test_a_beam_through_a_wall_is_not_confirmed_and_is_filled_in() -> None:
    earlier, now = seen(ROOM, 5.0, 3.0, 0.0), seen(ROOM, 5.2, 3.0, 0.0)
    now[40:42] = 11.9
    confirmed, out = np.zeros(BEAMS, np.bool_), np.empty(BEAMS)
    confirm(now, np.array([5.2, 3.0, 0.0]), earlier, np.array([5.0, 3.0, 0.0]), confirmed)
    assert not confirmed[40:42].any()
    assert confirmed.sum() == BEAMS - 2
    fill(now, confirmed, out)
    assert out[40:42].max() < 4.0


def test_clear_beam_is_the_nearest_that_is_clear() -> None:
    clear = np.full(BEAMS, 0.1)
    assert math.isnan(clear_beam(clear, 0.0, 1.0))
    clear[[20, 170]] = 3.0
    assert clear_beam(clear, 0.0, 1.0) == pytest.approx(-10 * SPACING)
    assert clear_beam(clear, 0.6, 1.0) == pytest.approx(20 * SPACING)


# Matching.


@pytest.mark.parametrize("name", ["office", "killian_court", "chamfered", "grid"])
def test_matching_finds_the_pose_from_which_a_scan_was_taken(name: str) -> None:
    plan = load_floor_plan(name)
    rng = np.random.default_rng(0)
    x, y, heading = plan.start
    keyframes = places_at(plan, [(x, y, heading)])
    for _ in range(20):
        true = np.array([x, y, heading]) + rng.uniform(-1, 1, 3) * (0.3, 0.3, 0.15)
        expected = true + rng.uniform(-1, 1, 3) * (0.3, 0.3, 0.1)
        ranges = seen(plan, *true)
        found = match(keyframes, 0, ranges, ranges, expected, np.array([0.5, 0.5, 0.2]), REACH)
        assert found.inlier_ratio > 0.9
        if found.min_eigenvalue > 10:
            np.testing.assert_allclose(found.pose[:2], true[:2], atol=0.1)
        assert abs(wrap(found.pose[2] - true[2])) < 0.02


def test_along_a_plain_corridor_a_match_keeps_to_what_was_expected_and_says_so() -> None:
    corridor = plan_of((0, 0, 60, 2.4))
    keyframes = places_at(corridor, [(30.0, 1.2, 0.0)])
    ranges = seen(corridor, 30.0, 1.5, 0.05)
    found = match(keyframes, 0, ranges, ranges, np.array([30.7, 1.2, 0.0]), np.array([0.5, 0.5, 0.2]), REACH)
    np.testing.assert_allclose(found.pose, [30.7, 1.5, 0.05], atol=0.03)
    assert found.min_eigenvalue < 1.0


def test_scans_of_different_rooms_do_not_agree() -> None:
    keyframes = places_at(ROOM, [(5.0, 3.0, 0.0)])
    ranges = seen(CROSSING, 15.0, 1.2, 0.0)
    found = match(keyframes, 0, ranges, ranges, np.array([5.0, 3.0, 0.0]), np.array([1.0, 1.0, 0.2]), REACH)
    assert found.inlier_ratio < 0.6


def test_along_a_plain_corridor_a_match_stays_where_it_was_expected() -> None:
    """There the ends tell the way across and the heading, and with noise nothing must be made of the way along."""
    corridor, rng = plan_of((0, 0, 60, 2.4)), np.random.default_rng(0)
    keyframes = places_at(corridor, [(30.0, 1.2, 0.0)])
    for _ in range(20):
        ranges = np.minimum(seen(corridor, 30.4, 1.0, 0.1) + rng.normal(0, 0.03, BEAMS), REACH)
        found = match(keyframes, 0, ranges, ranges, np.array([30.0, 1.2, 0.05]), np.array([0.3, 0.3, 0.1]), REACH)
        assert found.min_eigenvalue == 0.0
        assert found.pose[0] == pytest.approx(30.0, abs=0.02)
        assert found.pose[1] == pytest.approx(1.0, abs=0.02)
        assert found.pose[2] == pytest.approx(0.1, abs=0.01)


# The graph of places.


def test_ways_are_the_shortest_of_the_graph() -> None:
    rng = np.random.default_rng(1)
    keyframes = Keyframes(BEAMS, 7)
    count = CAPACITY + 50  # it grows on the way
    for _ in range(count):
        keyframes.add(pose=rng.uniform(0, 50, 3))
    endpoints = rng.integers(0, count, (200, 2))
    for i, j in endpoints:
        keyframes.connect(int(i), int(j))
    i, j = np.vstack(
        [endpoints[endpoints[:, 0] != endpoints[:, 1]], np.column_stack([np.arange(count - 1), np.arange(1, count)])]
    ).T
    geodesic_m = np.hypot(*(keyframes.pose[i, :2] - keyframes.pose[j, :2]).T)
    matrix = np.full((count, count), np.inf)
    matrix[i, j] = matrix[j, i] = geodesic_m
    expected = dijkstra(coo_array(np.where(np.isfinite(matrix), matrix, 0)).tocsr(), indices=[7])[0]
    found, before = keyframes.geodesic_distances(7)
    np.testing.assert_allclose(found, expected, atol=1e-2)
    way = route(before, count - 1)
    assert way[0] == 7
    assert way[-1] == count - 1


# The track.


def test_dead_reckoning_is_exact_on_straight_ways_and_arcs() -> None:
    track = PoseTracker(REACH, match_scans=False)
    for step in range(101):  # a quarter of a circle of 5 m
        angle = math.pi / 2 * step / 100
        track.advance(5 * angle, np.array([-math.sin(angle), math.cos(angle)]))
    np.testing.assert_allclose(track.pose, [-5, 5, -math.pi], atol=1e-3)
    track.advance(5 * math.pi / 2 + 3, np.array([-1.0, 0.0]))
    np.testing.assert_allclose(track.odometry, [-8, 5], atol=1e-3)


def test_a_pose_graph_without_contradiction_stays_as_it_is() -> None:
    rng = np.random.default_rng(2)
    poses = rng.uniform(-3, 3, (8, 3))
    endpoints = np.array([(i, i + 1) for i in range(7)] + [(0, 7), (2, 5)])
    measured = relative(poses[endpoints[:, 0]], poses[endpoints[:, 1]])
    found = optimize(poses, endpoints, measured, np.tile(np.eye(3), (9, 1, 1)), poses[:, 2], np.ones(8))
    np.testing.assert_allclose(found, poses, atol=1e-9)


def test_a_pose_graph_is_solved_as_least_squares_are() -> None:
    rng = np.random.default_rng(3)
    true = np.array([(0, 0, 0), (5, 0, 1.5), (5, 5, 3.0), (0, 5, -1.6), (0.2, 0.1, 0.1)], float)
    endpoints = np.array([(0, 1), (1, 2), (2, 3), (3, 4), (0, 4)])
    measured = relative(true[endpoints[:, 0]], true[endpoints[:, 1]]) + rng.normal(0, 0.05, (5, 3))
    information = np.array([np.diag(rng.uniform(1, 100, 3)) for _ in endpoints])
    compass, weights = true[:, 2] + rng.normal(0, 0.1, 5), rng.uniform(0.1, 2, 5)

    def errors(free: np.ndarray) -> np.ndarray:
        poses = np.vstack([true[0], free.reshape(4, 3)])
        off = relative(poses[endpoints[:, 0]], poses[endpoints[:, 1]]) - measured
        off[:, 2] = wrap_all(off[:, 2])
        of_edges = off * np.sqrt(np.diagonal(information, axis1=1, axis2=2))
        return np.concatenate([of_edges.ravel(), np.sqrt(weights) * wrap_all(poses[:, 2] - compass)])

    start = true + rng.normal(0, 0.1, true.shape) * (np.arange(5) > 0)[:, None]
    expected = least_squares(errors, start[1:].ravel(), xtol=1e-12, ftol=1e-12).x.reshape(4, 3)
    found = optimize(start, endpoints, measured, information, compass, weights)
    np.testing.assert_allclose(found[1:, :2], expected[:, :2], atol=2e-3)
    np.testing.assert_allclose(wrap_all(found[1:, 2] - expected[:, 2]), 0, atol=2e-3)


def test_closing_a_loop_straightens_a_bent_track() -> None:
    """Around a block with a distance meter that runs fast at first and slow then, whose errors do not cancel."""
    ring = load_floor_plan("ring")
    line = shapely.LineString(ring.centrelines[0])  # pyright: ignore[reportArgumentType]
    stops = np.array([line.interpolate(s).coords[0] for s in np.arange(0, line.length, 1.0)])
    steps = np.diff(np.vstack([stops, stops[:1]]), axis=0)
    headings = np.unwrap(np.arctan2(steps[:, 1], steps[:, 0]))
    track, keyframes, driven = PoseTracker(REACH, match_scans=True), Keyframes(BEAMS, 7), 0.0
    geodesic_m = np.zeros(0)
    for index, (stop, heading) in enumerate(zip(stops, headings, strict=True)):
        driven += 0.0 if index == 0 else 1.1 if index < 26 else 0.95
        track.advance(driven, np.array([math.cos(heading), math.sin(heading)]))
        ranges, lines = seen(ring, *stop, heading), np.empty((BEAMS, 3))
        fit_wall_lines(ranges, REACH, lines)
        track.localize(keyframes, ranges, ranges, geodesic_m)
        row = keyframes.add(pose=track.pose, scan=ranges, endpoints=ranges, lines=lines, compass=track.compass)
        geodesic_m, _ = keyframes.geodesic_distances(row)
    true = relative(np.array([*stops[0], headings[0]]), np.array([*stops[-1], headings[-1]]))
    before = math.hypot(*(relative(keyframes.pose[0], keyframes.pose[-1]) - true)[:2])
    expected = np.array([*keyframes.pose[0, :2], keyframes.pose[-1, 2]])
    found = match(keyframes, 0, keyframes.scan[-1], keyframes.endpoints[-1], expected, np.array([1.5, 1.5, 0.3]), REACH)
    track.add_loop_closure(keyframes, found)
    after = math.hypot(*(relative(keyframes.pose[0], keyframes.pose[-1]) - true)[:2])
    assert after < 0.3 * before


def test_the_distance_meters_scale_is_learned_from_the_walls() -> None:
    """It shows 4 % too much, along a corridor with niches and side corridors enough to tell the way driven."""
    grid, rng = load_floor_plan("grid"), np.random.default_rng(0)
    start, end = (
        np.array(point) for point in max(grid.centrelines, key=lambda line: shapely.LineString(line).length)[:2]
    )
    along = (end - start) / math.hypot(*(end - start))
    heading = math.atan2(along[1], along[0])
    track, keyframes, geodesic_m = PoseTracker(REACH, match_scans=True), Keyframes(BEAMS, 7), np.zeros(0)
    for metres in range(25):
        track.advance(1.04 * metres, np.array([math.cos(heading), math.sin(heading)]))
        ranges, lines = seen(grid, *(start + (1.0 + metres) * along), heading), np.empty((BEAMS, 3))
        ranges = np.clip(ranges + rng.normal(0, 0.02, BEAMS), 0.0, REACH)
        fit_wall_lines(ranges, REACH, lines)
        track.localize(keyframes, ranges, ranges, geodesic_m)
        row = keyframes.add(pose=track.pose, scan=ranges, endpoints=ranges, lines=lines, compass=track.compass)
        geodesic_m, _ = keyframes.geodesic_distances(row)
    assert track.scale == pytest.approx(1 / 1.04, abs=0.005)


# The open areas' list.


def test_a_side_corridor_is_listed_when_it_is_left_behind_and_struck_off_when_seen_into() -> None:
    there = [(float(x), 1.2, 0.0) for x in range(8, 29)]
    back = [(float(x), 1.2, math.pi) for x in range(27, 15, -1)]
    into = [(15.2, float(y), math.pi / 2) for y in range(2, 10)]
    keyframes, frontiers = Keyframes(BEAMS, 7), Frontiers(BEAMS, REACH)
    everything = places_at(CROSSING, there + back + into)
    states: list[dict[int, str]] = []
    for row in range(everything.count):
        keyframe = {name: getattr(everything, name)[row] for name in ("pose", "scan", "lines", "step", "path")}
        keyframes.add(**keyframe)
        for other in np.flatnonzero(euclidean_distances(keyframes.pose, keyframes.pose[row]) < 1.5).tolist():
            keyframes.connect(other, row)
        frontiers.update(keyframes, keyframes.geodesic_distances(row)[0])
        states.append({area.number: area.state for area in frontiers.listed})
    assert "open" in states[len(there) - 1].values()  # the side corridors' ends were beyond the laser's reach
    north = [area for area in frontiers.listed if (keyframes.pose[area.keyframe, :2] + area.offset)[1] > 2.4]
    assert north
    assert {area.state for area in north} <= {"visited", "struck off"}


def test_an_opening_that_one_scan_alone_sees_comes_last() -> None:
    """A range that is wrong, beyond a wall, is not repeated by the scans before and after; a corridor's end is."""
    poses = np.array([(12.6 + 0.2 * i, 1.2, 0.0) for i in range(5)])
    measured = np.array([seen(CROSSING, *pose) for pose in poses])
    keyframes = places_at(CROSSING, [(13.0, 1.2, 0.0)])
    wrong = measured[2].copy()
    wrong[128:132] = 9.0  # through the wall to the south-west
    keyframes.scan[0] = wrong
    frontiers = Frontiers(BEAMS, REACH)
    frontiers.update(keyframes, np.zeros(1))
    inside_walls = ~shapely.contains_xy(CROSSING.free_space.buffer(0.1), *frontiers.points(keyframes).T)
    assert inside_walls.any()
    measured[2] = wrong
    frontiers.verify(keyframes, measured, poses)
    points = frontiers.points(keyframes)[frontiers.polar[:, 2] != UNCONFIRMED]
    assert shapely.contains_xy(CROSSING.free_space.buffer(0.1), *points.T).all()
    assert (points[:, 0] > 24).any()
    assert (points[:, 0] < 2).any()


def test_a_banned_point_is_never_open_again() -> None:
    keyframes, frontiers = places_at(CROSSING, [(13.0, 1.2, 0.0)]), Frontiers(BEAMS, REACH)
    frontiers.update(keyframes, np.zeros(1))
    point = frontiers.points(keyframes)[0]
    frontiers.blacklist(keyframes, point)
    again = places_at(CROSSING, [(13.0, 1.2, 0.0)])
    frontiers.update(again, np.zeros(1))
    assert np.hypot(*(frontiers.points(again) - point).T).min() >= 1.0


# Ways and driving.


def test_a_way_leads_around_a_corner_and_keeps_off_walls() -> None:
    pose = np.array([10.0, 1.2, 0.0])
    grid = Costmap()
    scans = np.array([seen(CROSSING, *pose), seen(CROSSING, 15.0, 1.2, 0.0)])
    grid.draw(pose, scans, np.array([pose, (15.0, 1.2, 0.0)]), NO_LEGS, REACH)
    costs, endpoints = grid.costs_to(np.array([[15.2, 9.0], [20.0, 8.0]]))
    assert 11.0 < costs[0] < 20.0
    assert math.isinf(costs[1])  # behind a wall
    way = grid.path_to(int(endpoints[0]))
    assert math.hypot(*(way[0] - pose[:2])) < CELL
    assert math.hypot(*(way[-1] - (15.2, 9.0))) < 0.8
    walls = shapely.boundary(CROSSING.free_space)
    assert shapely.distance(walls, shapely.points(way)).min() > 0.2


def test_the_way_that_was_driven_is_always_known() -> None:
    """A wall that a scan, taken where the track is off, puts across a doorway does not lock the robot in."""
    pose, grid = np.array([10.0, 1.2, 0.0]), Costmap()
    scans = np.array([seen(CROSSING, *pose), np.full(BEAMS, 1.0)])  # the second draws a wall all around the first
    poses, there = np.vstack([pose, pose]), np.array([[15.0, 1.2]])
    grid.draw(pose, scans, poses, NO_LEGS, REACH)
    assert np.isinf(grid.costs_to(there)[0]).all()
    grid.draw(pose, scans, poses, np.array([[(15.0, 1.2), pose[:2]]]), REACH)
    costs, endpoints = grid.costs_to(there)
    assert 5.0 < costs[0] < 15.0
    assert np.abs(grid.path_to(int(endpoints[0]))[:, 1] - 1.2).max() < 0.3


def test_ends_that_despeckling_moved_are_no_walls_to_match() -> None:
    rng, plan = np.random.default_rng(0), load_floor_plan("office")
    measured = seen(plan, *plan.start)
    noisy = np.clip(measured + rng.normal(0, 0.03, BEAMS), 0.0, REACH)
    for ranges in (measured, noisy):
        scan = np.empty(BEAMS)
        despeckle(ranges, scan)
        endpoints = reliable_endpoints(scan, ranges, REACH)
        moved = np.abs(scan - ranges)
        assert (endpoints[moved > 0.3] == REACH).all()
        assert (endpoints[moved < 0.02] == scan[moved < 0.02]).all()
        assert 0.0 < (endpoints != scan).mean() < 0.15


def test_a_wall_is_not_matched_with_its_other_face() -> None:
    """Two rooms share a wall of 0.2 m: what one sees of it tells nothing of where the other's face is."""
    rooms = plan_of((0, 0, 6, 4), (0, 4.2, 6, 8.2), (2.5, 3.9, 3.5, 4.3))
    keyframes = places_at(rooms, [(4.6, 3.0, 0.0)])
    true = np.array([1.2, 5.3, 0.0])
    ranges = seen(rooms, *true)
    found = match(keyframes, 0, ranges, ranges, np.array([1.3, 5.35, 0.0]), np.array([0.3, 0.3, 0.1]), REACH)
    np.testing.assert_allclose(found.pose, true, atol=0.1)  # with the other face it is 0.2 m off


def test_steering_turns_aside_no_further_than_it_may() -> None:
    clear = np.zeros(BEAMS)
    clear[BEAMS // 2] = 2.0  # only the way back is clear
    assert steer(clear, 0.0, 1.0)[1] != 0
    assert steer(clear, 0.0, 1.0, math.radians(60))[1] == 0


def test_an_opening_reached_from_the_other_side_leads_on_until_the_loop_is_closed() -> None:
    """Seen from one end of a corridor and reached from its other end, which by the graph of rows is far away."""
    corridor = plan_of((0, 0, 40, 2.4))
    first, last = (4.0, 1.2, 0.0), (17.0, 1.2, math.pi)
    keyframes, frontiers = places_at(corridor, [first]), Frontiers(BEAMS, REACH)
    frontiers.update(keyframes, np.zeros(1))
    ahead = frontiers.points(keyframes)[:, 0].max()
    assert 15.0 < ahead < 16.5
    keyframes = places_at(corridor, [first, last])
    for x in (17.0, 15.5, 13.5):
        keyframes.pose[1], keyframes.scan[1] = (x, 1.2, math.pi), seen(corridor, x, 1.2, math.pi)
        frontiers.update(keyframes, np.array([70.0, 0.0]))
        mine = frontiers.points(keyframes)[(frontiers.keyframe == 0) & frontiers.unbounded]
        assert len(mine)
        assert mine[:, 0].max() < x - 1.0  # ahead of the robot, towards where it was seen from
    frontiers.update(keyframes, np.array([9.5, 0.0]))  # the loop is closed
    assert not (frontiers.keyframe == 0).any()


def test_points_off_the_map_have_no_way() -> None:
    grid = Costmap()
    pose = np.array([5.0, 3.0, 0.0])
    grid.draw(pose, seen(ROOM, *pose)[None], pose[None], NO_LEGS, REACH)
    costs, _ = grid.costs_to(np.array([[5.0 + CELLS * CELL, 3.0], [-1e9, 1e9]]))
    assert np.isinf(costs).all()


def test_steering_turns_on_the_spot_to_what_is_behind_and_slows_for_a_wall() -> None:
    clear = np.full(BEAMS, 5.0)
    assert steer(clear, 0.0, 4.0) == pytest.approx((1.0, 0.0))
    speed, turn = steer(clear, 3.0, 4.0)
    assert speed == 0
    assert turn > 0.5
    clear[0] = 0.5
    assert steer(clear, 0.0, 0.4)[0] < 0.5

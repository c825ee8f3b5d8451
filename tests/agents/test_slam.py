"""Localization and mapping: poses, filters of scans, their matching, keyframes, the pose graph and the tracker."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from agents.slam.keyframes import CAPACITY, Keyframes
from agents.slam.pose_graph import optimize
from agents.slam.registration import Registration
from agents.slam.scan_filters import LaserReader, confirm, despeckle, fill, reliable_endpoints
from agents.slam.se2 import compose, relative, wrap_angle
from agents.slam.tracker import DeadReckoningTracker
from cyclic_env.config import LaserConfig
from cyclic_env.floor_plans import FloorPlan, load_floor_plan
from cyclic_env.simulation.lidar import scan
from tests.agents.buildings import BEAMS, CROSSING, MATCHER, REACH, ROOM, plan_of, seen


def test_relative_and_compose_undo_each_other() -> None:
    rng = np.random.default_rng(0)
    a, b = rng.uniform(-4, 4, (2, 50, 3))
    np.testing.assert_allclose(relative(a, compose(a, b))[:, :2], b[:, :2], atol=1e-12)
    np.testing.assert_allclose(wrap_angle(relative(a, compose(a, b))[:, 2] - b[:, 2]), 0, atol=1e-12)


@pytest.mark.parametrize(
    ("angle", "wrapped"), [(0.0, 0.0), (math.pi, -math.pi), (-7.0, math.tau - 7.0), (7.0, 7.0 - math.tau)]
)
def test_wrap_stays_within_half_a_turn(angle: float, wrapped: float) -> None:
    assert wrap_angle(angle) == pytest.approx(wrapped)


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


def test_a_beam_through_a_wall_is_not_confirmed_and_is_filled_in() -> None:
    earlier, now = seen(ROOM, 5.0, 3.0, 0.0), seen(ROOM, 5.2, 3.0, 0.0)
    now[40:42] = 11.9
    confirmed, out = np.zeros(BEAMS, np.bool_), np.empty(BEAMS)
    confirm(now, np.array([5.2, 3.0, 0.0]), earlier, np.array([5.0, 3.0, 0.0]), confirmed, 0.4, 2)
    assert not confirmed[40:42].any()
    assert confirmed.sum() == BEAMS - 2
    fill(now, confirmed, out)
    assert out[40:42].max() < 4.0


def match_at(
    plan: FloorPlan, place: tuple[float, ...], ranges: np.ndarray, expected: np.ndarray, std: tuple[float, ...]
) -> Registration:
    """Match ranges with the true scan at a place; poses are in the frame of the plan."""
    at = np.array(place)
    found = MATCHER.match(MATCHER.reference(seen(plan, *place)), ranges, relative(at, expected)[None], np.array(std))
    return found._replace(pose=compose(at, found.pose))


@pytest.mark.parametrize("name", ["office", "killian_court", "chamfered", "grid"])
def test_matching_finds_the_pose_from_which_a_scan_was_taken(name: str) -> None:
    plan = load_floor_plan(name)
    rng = np.random.default_rng(0)
    x, y, heading = plan.start
    for _ in range(20):
        true = np.array([x, y, heading]) + rng.uniform(-1, 1, 3) * (0.3, 0.3, 0.15)
        expected = true + rng.uniform(-1, 1, 3) * (0.3, 0.3, 0.1)
        ranges = seen(plan, *true)
        found = match_at(plan, plan.start, ranges, expected, (0.5, 0.5, 0.2))
        assert found.wide > 0.9
        if found.min_eigenvalue > 10:
            np.testing.assert_allclose(found.pose[:2], true[:2], atol=0.1)
        assert abs(wrap_angle(found.pose[2] - true[2])) < 0.02


def test_along_a_plain_corridor_a_match_keeps_to_what_was_expected_and_says_so() -> None:
    corridor = plan_of((0, 0, 60, 2.4))
    ranges = seen(corridor, 30.0, 1.5, 0.05)
    found = match_at(corridor, (30.0, 1.2, 0.0), ranges, np.array([30.7, 1.2, 0.0]), (0.5, 0.5, 0.2))
    np.testing.assert_allclose(found.pose, [30.7, 1.5, 0.05], atol=0.03)
    assert found.min_eigenvalue < 1.0


def test_scans_of_different_rooms_do_not_agree() -> None:
    ranges = seen(CROSSING, 15.0, 1.2, 0.0)
    found = match_at(ROOM, (5.0, 3.0, 0.0), ranges, np.array([5.0, 3.0, 0.0]), (1.0, 1.0, 0.2))
    assert found.wide < 0.6


def test_along_a_plain_corridor_a_match_stays_where_it_was_expected() -> None:
    """There the ends tell the way across and the heading, and with noise nothing must be made of the way along."""
    corridor, rng = plan_of((0, 0, 60, 2.4)), np.random.default_rng(0)
    for _ in range(20):
        ranges = np.minimum(seen(corridor, 30.4, 1.0, 0.1) + rng.normal(0, 0.03, BEAMS), REACH)
        found = match_at(corridor, (30.0, 1.2, 0.0), ranges, np.array([30.0, 1.2, 0.05]), (0.3, 0.3, 0.1))
        assert found.min_eigenvalue == 0.0
        assert found.pose[0] == pytest.approx(30.0, abs=0.02)
        assert found.pose[1] == pytest.approx(1.0, abs=0.02)
        assert found.pose[2] == pytest.approx(0.1, abs=0.01)


def test_ways_are_the_shortest_of_the_graph() -> None:
    rng = np.random.default_rng(1)
    keyframes = Keyframes(BEAMS, 7)
    count = CAPACITY + 50  # it grows on the way
    for _ in range(count):
        keyframes.add(pose=rng.uniform(0, 50, 3))
    pairs = rng.integers(0, count, (200, 2))
    for i, j in pairs:
        keyframes.connect(int(i), int(j))
    chain = np.column_stack([np.arange(count - 1), np.arange(1, count)])
    i, j = np.vstack([pairs[pairs[:, 0] != pairs[:, 1]], chain]).T
    geodesic_m = np.hypot(*(keyframes.pose[i, :2] - keyframes.pose[j, :2]).T)
    matrix = np.full((count, count), np.inf)
    matrix[i, j] = matrix[j, i] = geodesic_m
    expected = dijkstra(coo_array(np.where(np.isfinite(matrix), matrix, 0)).tocsr(), indices=[7])[0]
    paths = keyframes.geodesic_distances(7)
    np.testing.assert_allclose(paths.distances, expected, atol=1e-2)
    way = paths.route(count - 1)
    assert way[0] == 7
    assert way[-1] == count - 1


def test_dead_reckoning_is_exact_on_straight_ways_and_arcs() -> None:
    track = DeadReckoningTracker()
    for step in range(101):  # a quarter of a circle of 5 m
        angle = math.pi / 2 * step / 100
        track.advance(5 * angle, np.array([-math.sin(angle), math.cos(angle)]))
    np.testing.assert_allclose(track.pose, [-5, 5, -math.pi], atol=1e-3)
    track.advance(5 * math.pi / 2 + 3, np.array([-1.0, 0.0]))
    np.testing.assert_allclose(track.odometry, [-8, 5], atol=1e-3)


def test_a_pose_graph_without_contradiction_stays_as_it_is() -> None:
    rng = np.random.default_rng(2)
    poses = rng.uniform(-3, 3, (8, 3))
    edges = np.array([(i, i + 1) for i in range(7)] + [(0, 7), (2, 5)])
    measured = relative(poses[edges[:, 0]], poses[edges[:, 1]])
    found = optimize(poses, edges, measured, np.tile(np.eye(3), (9, 1, 1)), poses[:, 2], np.ones(8))
    np.testing.assert_allclose(found, poses, atol=1e-9)


def test_a_pose_graph_is_solved_as_least_squares_are() -> None:
    rng = np.random.default_rng(3)
    true = np.array([(0, 0, 0), (5, 0, 1.5), (5, 5, 3.0), (0, 5, -1.6), (0.2, 0.1, 0.1)], float)
    edges = np.array([(0, 1), (1, 2), (2, 3), (3, 4), (0, 4)])
    measured = relative(true[edges[:, 0]], true[edges[:, 1]]) + rng.normal(0, 0.05, (5, 3))
    information = np.array([np.diag(rng.uniform(1, 100, 3)) for _ in edges])
    compass, weights = true[:, 2] + rng.normal(0, 0.1, 5), rng.uniform(0.1, 2, 5)

    def errors(free: np.ndarray) -> np.ndarray:
        poses = np.vstack([true[0], free.reshape(4, 3)])
        off = relative(poses[edges[:, 0]], poses[edges[:, 1]]) - measured
        off[:, 2] = wrap_angle(off[:, 2])
        of_edges = off * np.sqrt(np.diagonal(information, axis1=1, axis2=2))
        return np.concatenate([of_edges.ravel(), np.sqrt(weights) * wrap_angle(poses[:, 2] - compass)])

    start = true + rng.normal(0, 0.1, true.shape) * (np.arange(5) > 0)[:, None]
    expected = least_squares(errors, start[1:].ravel(), xtol=1e-12, ftol=1e-12).x.reshape(4, 3)
    found = optimize(start, edges, measured, information, compass, weights)
    np.testing.assert_allclose(found[1:, :2], expected[:, :2], atol=2e-3)
    np.testing.assert_allclose(wrap_angle(found[1:, 2] - expected[:, 2]), 0, atol=2e-3)


def test_a_laser_of_many_beams_is_read_as_one_of_few() -> None:
    plan = load_floor_plan("office")
    fine = LaserConfig(num_beams=1080)
    reader = LaserReader(fine)
    ranges = scan(plan.walls, np.array(plan.start), fine)
    wrong = ranges.copy()
    wrong[::7] = 0.5
    few = reader.read(wrong)
    assert few.shape == (BEAMS,)
    assert (np.abs(few - seen(plan, *plan.start)) < 0.3).mean() > 0.95
    half = LaserReader(LaserConfig(num_beams=721, field_of_view=math.pi))
    assert half.read(np.arange(721.0) / 100)[[0, -1]] == pytest.approx([0.0, 7.2], abs=0.03)
    few = LaserReader(LaserConfig(num_beams=60))
    np.testing.assert_array_equal(few.read(np.linspace(-1, 20, 60)), np.clip(np.linspace(-1, 20, 60), 0, REACH))


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
    true = np.array([1.2, 5.3, 0.0])
    ranges = seen(rooms, *true)
    found = match_at(rooms, (4.6, 3.0, 0.0), ranges, np.array([1.3, 5.35, 0.0]), (0.3, 0.3, 0.1))
    np.testing.assert_allclose(found.pose, true, atol=0.1)  # with the other face it is 0.2 m off

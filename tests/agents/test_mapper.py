"""Loops of a laser that does not see all around: panoramas, sets of matches, the robust graph, the watcher."""

from __future__ import annotations

import math

import numpy as np
import pytest

from agents.slam.consistency import find_consistent, grow_set
from agents.slam.local_graph import optimize_window
from agents.slam.mapper import Mapper
from agents.slam.odometry import OdometryConfig, OdometryModel
from agents.slam.panorama import (
    merge_scans,
    panorama_beams,
    panorama_offset,
    signature,
    signature_distances,
    spread_beams,
)
from agents.slam.pose_graph import optimize
from agents.slam.registration import PanoramaMatcher
from agents.slam.robust_graph import optimize_robustly
from agents.slam.se2 import compose, relative, wrap_angle
from agents.watcher import WatcherPolicy
from cyclic_env.config import LaserConfig
from cyclic_env.floor_plans import load_floor_plan
from cyclic_env.recording.readers import read_robot_log
from cyclic_env.recording.recorded_run import RecordedRun
from cyclic_env.simulation.lidar import scan
from tests.agents.buildings import BEAMS, CROSSING, MATCHER, REACH, ROOM, seen

HALF = LaserConfig(num_beams=180, range_max=30.0, field_of_view=math.radians(179), mounting_angle=math.radians(-0.5))
ANY_STD = np.array([1.0, 1.0, 0.2])
Lap = tuple[np.ndarray, Mapper, list[tuple[int, int]]]


def half_of(panorama: np.ndarray) -> np.ndarray:
    """Return a panorama of which only the front was looked at."""
    half = panorama.copy()
    half[BEAMS // 4 : -BEAMS // 4] = 0.0
    return half


def test_the_beams_of_a_half_turn_are_put_on_their_bearings() -> None:
    beams, count = panorama_beams(HALF)
    assert (count, panorama_offset(HALF)) == (360, 0.0)
    np.testing.assert_array_equal(beams, np.arange(-90, 90) % 360)
    assert (spread_beams(np.ones(180), beams, count) > 0).sum() == 180
    between = LaserConfig(num_beams=180, field_of_view=math.pi)
    assert len(set(panorama_beams(between)[0].tolist())) == 180
    assert panorama_offset(between) == pytest.approx(-0.5 * between.beam_spacing)


def test_what_was_not_looked_at_is_neither_for_a_match_nor_against_it() -> None:
    matcher = PanoramaMatcher(REACH)
    whole, other = seen(CROSSING, 8.0, 1.2, 0.0), seen(CROSSING, 8.4, 1.1, 0.1)
    true = np.array([[0.4, -0.1, 0.1]])
    for panorama in (other, half_of(other)):
        found = matcher.match(matcher.reference(whole), panorama, true, ANY_STD)
        assert found.wide > 0.97
        np.testing.assert_allclose(found.pose, true[0], atol=0.02)
    behind = np.where(half_of(other) > 0, 0.0, other)
    apart = matcher.match(matcher.reference(half_of(whole)), behind, true, ANY_STD)
    assert apart.seen < found.seen / 2


def test_a_panorama_is_what_scans_ahead_and_back_have_seen() -> None:
    poses = np.array([[8.0, 1.2, 0.0], [8.1, 1.2, math.pi]] * 2)
    scans = np.array([half_of(seen(CROSSING, *pose)) for pose in poses])
    out = np.empty(BEAMS)
    merge_scans(scans, poses, 0, 3, poses[0], REACH, np.empty((3, BEAMS)), out)
    whole = seen(CROSSING, *poses[0])
    looked = (out > 0) & (whole < REACH - 0.1)
    assert looked.sum() > 0.8 * (whole < REACH - 0.1).sum()
    assert np.quantile(np.abs(out - whole)[looked], 0.9) < 0.15


def test_a_signature_knows_its_place_in_another_direction() -> None:
    signatures = np.zeros((3, 36))
    for row, (x, heading) in enumerate([(8.0, 0.0), (3.0, 0.0), (8.0, 2.0)]):
        signature(seen(CROSSING, x, 1.2, heading), signatures[row])
    distances = np.empty(2)
    signature_distances(signatures, np.zeros(3), np.array([0, 1]), signatures[2], 2.0, 1, distances)
    assert distances[0] < 0.3 * distances[1]


def test_the_largest_set_of_matches_that_agree_is_found_among_rivals() -> None:
    now = np.array([[0.0, 0.0, 0.0]] * 5 + [[3.0, 0.0, 0.0]] * 3 + [[0.1, 0.0, 0.0]])
    rows = np.array([0, 1, 2, 3, 4, 0, 1, 2, 4])
    agrees, members = np.zeros((9, 9), np.bool_), np.zeros(9, np.int64)
    find_consistent(now, rows, rows.astype(float), np.array([0.5, 0.1, 0.03, 0.01]), agrees)
    assert grow_set(agrees, 0, members, np.zeros(9, np.bool_)) == 5
    assert len(set(rows[members[:5]])) == 5  # one match of each row
    assert grow_set(agrees, 5, members, np.zeros(9, np.bool_)) == 3


def square(laps: int) -> np.ndarray:
    """Return poses a metre apart around a square of 10 m."""
    steps = np.tile([[1.0, 0.0, 0.0]] * 9 + [[1.0, 0.0, math.pi / 2]], (4 * laps, 1))
    poses = [np.zeros(3)]
    for step in steps:
        poses.append(compose(poses[-1], step))
    return np.array(poses)


def test_one_wrong_closure_bends_nothing() -> None:
    true = square(2)
    chain = np.column_stack([np.arange(80), np.arange(1, 81)])
    right, wrong = np.array([[0, 40], [5, 45], [20, 60]]), np.array([[10, 35]])
    edges = np.concatenate([chain, right, wrong])
    measured = relative(true[edges[:, 0]], true[edges[:, 1]])
    measured[:80] += np.random.default_rng(0).normal(0, [0.02, 0.02, 0.01], (80, 3))
    measured[-1] = 0.0
    information = np.repeat(np.diag([2500.0, 2500.0, 10000.0])[None], len(edges), axis=0)
    start = [np.zeros(3)]
    for step in measured[:80]:
        start.append(compose(start[-1], step))
    doubtful = np.r_[np.full(80, -1), 0, 1, 2, 3]
    none = np.zeros(81)
    poses, weights = optimize_robustly(np.array(start), edges, measured, information, doubtful, none, none, 20.0)
    np.testing.assert_array_equal(weights[-4:].round(), [1, 1, 1, 0])
    assert np.hypot(*(poses - true)[:, :2].T).max() < 0.6
    plain = optimize(np.array(start), edges, measured, information, none, none)
    assert np.hypot(*(plain - true)[:, :2].T).max() > 2.0


def test_a_window_of_all_poses_is_the_whole_graph() -> None:
    true = square(1)[:12]
    rng = np.random.default_rng(1)
    sources = np.full((12, 2), -1)
    sources[1:, 0], sources[2:, 1] = np.arange(11), np.arange(10)
    measured, information = np.zeros((12, 2, 3)), np.zeros((12, 2, 3, 3))
    rows, slots = np.nonzero(sources >= 0)
    measured[rows, slots] = relative(true[sources[rows, slots]], true[rows]) + rng.normal(0, 0.003, (len(rows), 3))
    information[rows, slots] = np.diag([400.0, 900.0, 2500.0])
    poses, none = true.copy(), np.zeros(12)
    optimize_window(poses, 1, (sources, measured, information), np.zeros((36, 36)), np.zeros(36))
    edges = np.column_stack([sources[rows, slots], rows])
    whole = optimize(true, edges, measured[rows, slots], information[rows, slots], none, none)
    np.testing.assert_allclose(poses, whole, atol=2e-3)  # but for the weights of the largest errors


def drive(laps: float) -> np.ndarray:
    """Return poses 0.2 m apart around the ring, corners cut."""
    corners = np.array(load_floor_plan("ring").centrelines[0])
    closed = np.concatenate([corners[:-1]] * (int(laps) + 1))
    length = np.append(0.0, np.cumsum(np.hypot(*np.diff(closed, axis=0).T)))
    s = np.arange(0.0, laps * np.hypot(*np.diff(corners, axis=0).T).sum(), 0.2)
    x, y = (np.interp(s, length, closed[:, k]) for k in range(2))
    kernel = np.ones(7) / 7
    x, y = (np.convolve(v, kernel, "valid") for v in (x, y))
    return np.column_stack([x[:-1], y[:-1], np.arctan2(np.diff(y), np.diff(x))])


@pytest.fixture(scope="module")
def lap() -> Lap:
    """A lap and a half with a laser of half a turn, and wheels that turn 0.2 degrees a metre too far."""
    plan, poses = load_floor_plan("ring"), drive(1.4)
    rng = np.random.default_rng(0)
    driven = np.append(0.0, np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T)))
    headings = np.unwrap(poses[:, 2]) * 1.02 + math.radians(0.2) * driven
    mapper, claims = Mapper(HALF), []
    for step, pose in enumerate(poses):
        ranges = scan(plan.walls, pose, HALF) + 0.02 * rng.standard_normal(180)
        match = mapper.observe(ranges, 1.01 * driven[step], float(wrap_angle(headings[step])))
        if match is not None:
            claims.append((step, match))
    return poses, mapper, claims


def test_a_lap_with_a_half_turn_laser_and_a_drifting_heading_is_closed(lap: Lap) -> None:
    poses, mapper, claims = lap
    assert mapper.loops.closed
    errors = [math.hypot(*(poses[step] - poses[match])[:2]) for step, match in claims]
    assert len(claims) > 50
    assert max(errors) < 3.0
    run = mapper.run
    moved = relative(poses[run.step[0]], poses[run.step])
    assert np.hypot(*(run.pose - moved)[:, :2].T).max() < 1.5  # the wheels alone are 20 m wrong


def test_nothing_is_claimed_before_the_robot_is_back(lap: Lap) -> None:
    poses, _, claims = lap
    length = np.hypot(*np.diff(poses[:, :2], axis=0).T).cumsum()
    assert length[claims[0][0]] > length[-1] / 1.4 - 3.0


def test_the_distance_meters_scale_is_learned_from_the_walls() -> None:
    """It shows 4 % too much, along a corridor with niches and side corridors enough to tell the way driven."""
    grid, rng, mapper = load_floor_plan("grid"), np.random.default_rng(0), Mapper(LaserConfig())
    line = max((np.array(points) for points in grid.centrelines), key=lambda points: np.hypot(*(points[1] - points[0])))
    heading = math.atan2(*(line[1] - line[0])[::-1])
    for metres in range(25):
        x, y = line[0] + (1.0 + metres) * np.array([math.cos(heading), math.sin(heading)])
        ranges = np.clip(seen(grid, x, y, heading) + rng.normal(0, 0.02, BEAMS), 0.0, REACH)
        mapper.observe(ranges, 1.04 * metres, heading)
    assert mapper.odometry.scale == pytest.approx(1 / 1.04, abs=0.005)


def test_a_compass_is_taken_as_absolute_only_where_loops_show_that_it_is() -> None:
    found = MATCHER.match(MATCHER.reference(seen(ROOM, 5, 3, 0)), seen(ROOM, 5.2, 3, 0), np.zeros((1, 3)), ANY_STD)
    steady, drifting = OdometryModel(OdometryConfig()), OdometryModel(OdometryConfig())
    for model, turn in ((steady, math.radians(1)), (drifting, math.radians(30))):
        assert model.heading_information == 0
        for _ in range(40):
            model.learn(np.array([0.2, 0.0, math.radians(0.5)]), found)
        for _ in range(4):
            model.learn_loop(0.0, turn, found)
    assert math.degrees(steady.turn_variance**0.5) < 2
    assert steady.heading_information > 10
    assert drifting.heading_information == 0


def test_the_first_loop_of_the_real_run_is_closed() -> None:
    run = RecordedRun(read_robot_log("killian_run")[:620])
    policy, state = WatcherPolicy(run.config.laser), None
    observation, info = run.reset()
    ended = False
    while not ended:
        action, state = policy.predict(observation, state)
        observation, _, _, ended, info = run.step(action)
    assert info["claims"] > 5
    assert info["false_claims"] == 0
    assert info["revisits_recognised"] >= 1

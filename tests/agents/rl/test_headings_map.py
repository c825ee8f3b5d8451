"""The track and the map of the task headings: matching keyframes, mending, and searching."""

from __future__ import annotations

import math

import numpy as np
import pytest

from agents.rl.headings.env import CyclicLoopHeadingsVectorEnv
from agents.rl.headings.grid import CELL, SIDE, Ahead, allocate_grid, allocate_search_scratch, draw_scan, search
from agents.rl.headings.memory import HOLD, Rules
from agents.rl.headings.perception import Perception
from agents.rl.headings.rules import nearest_undriven
from agents.rl.headings.tracking import (
    ROBOT,
    STEP_SPREAD,
    allocate_keyframes,
    allocate_match_scratch,
    dead_reckon,
    enlarged,
    learn_scale,
    mend,
)
from cyclic_env import LaserConfig


def ahead_of(grid, robot) -> Ahead:
    ahead = Ahead(*np.zeros((len(Ahead._fields), 16)))
    search(grid, 0, robot, allocate_search_scratch(), ahead)
    return ahead


def test_search_tells_the_way_to_what_is_undriven_by_the_heading_that_leads_there() -> None:
    """A corridor east, 10 m long, of which the robot has driven the first 4 m."""
    grid, robot = allocate_grid(1), np.zeros(1, ROBOT)[0]
    middle = 0
    grid.free[0, middle - 2 : middle, :20] = 9
    grid.free[0, [SIDE - 2, SIDE - 1], :20] = 9
    grid.driven[0, [SIDE - 2, SIDE - 1], :8] = 3
    robot["y"], robot["decisions"] = -0.1, 10
    ahead = ahead_of(grid, robot)
    assert ahead.undriven[0] == pytest.approx(8 * CELL)
    assert np.argmin(ahead.undriven) == 0
    assert (ahead.undriven[3:14] > 1e8).all()
    assert ahead.recent[0] == pytest.approx(math.exp(-7 / 60))
    robot["heading"] = math.pi / 2  # then the corridor is a quarter turn to the right
    assert np.argmin(ahead_of(grid, robot).undriven) == 12


def test_the_grid_has_no_edges() -> None:
    scan = np.full(180, 3.0)
    drawn = []
    for x in (0.1, SIDE * CELL + 0.1):
        grid = allocate_grid(1)
        draw_scan(grid, 0, x, -7.3, 0.4, scan, 12.0, 0)
        drawn.append(grid)
    np.testing.assert_array_equal(drawn[0].free, drawn[1].free)
    np.testing.assert_array_equal(drawn[0].driven, drawn[1].driven)


def test_mending_spreads_the_error_over_the_way_since_a_keyframe_and_leaves_what_came_before() -> None:
    robot, keyframes = np.zeros(1, ROBOT)[0], allocate_keyframes(1, 4)
    keyframes.path[0, :5] = np.arange(5) * 10.0
    robot["path"], robot["keyframes"] = 40.0, 5
    mend(robot, keyframes, 0, 1, 3.0, 0.0, 0.3)
    np.testing.assert_allclose(keyframes.pose[0, :5, 0], [0, 0, 1, 2, 3])
    assert (robot["x"], robot["heading"]) == (3.0, pytest.approx(0.3))
    assert robot["anchor"] == 4


@pytest.mark.parametrize("true_scale", [0.95, 1.05])
def test_matches_tell_the_scale_of_the_distance_meter(true_scale: float) -> None:
    robot, scratch = np.zeros(1, ROBOT)[0], allocate_match_scratch(60)
    robot["scale"], robot["scale_information"] = 1.0, 0.03**-2
    scratch.hessian[:] = np.diag([20.0, 20.0, 100.0])
    scratch.spread[:] = STEP_SPREAD
    for _ in range(100):
        scratch.prior[0] = robot["scale"]  # a metre by the meter
        scratch.pose[0] = true_scale
        learn_scale(robot, scratch)
    assert robot["scale"] == pytest.approx(true_scale, abs=0.005)
    scratch.hessian[0, 0], scratch.pose[0] = 0.01, 2.0  # along a corridor without doors they tell nothing
    learn_scale(robot, scratch)
    assert robot["scale"] == pytest.approx(true_scale, abs=0.005)


def test_dead_reckoning_follows_a_circle() -> None:
    robot = np.zeros(1, ROBOT)[0]
    robot["scale"] = 1.0
    for step in range(101):
        angle = 2 * math.pi * step / 100
        dead_reckon(robot, 0.1 * step, math.cos(angle), math.sin(angle))
    assert math.hypot(robot["x"], robot["y"]) < 1e-9
    assert robot["path"] == pytest.approx(10.0)


def test_keyframes_are_kept_when_room_is_made_for_more() -> None:
    keyframes = allocate_keyframes(2, 4)
    keyframes.pose[1, 3] = 5.0
    more = enlarged(keyframes)
    assert more.pose.shape[1] == 2 * keyframes.pose.shape[1]
    assert (more.pose[1, 3] == 5.0).all()


def test_scan_matching_holds_the_track_where_the_compass_errs() -> None:
    """Track and dead reckoning, which is the track of a laser that reaches nothing, over the same 100 m."""
    rows, every = 4, np.arange(4)
    env = CyclicLoopHeadingsVectorEnv(rows, "figure_eight", noise="poor")
    blind = Perception(rows, Rules(laser=LaserConfig(range_max=0.1)))
    features, _ = env.reset(seed=2)
    blind.begin(every)
    for _ in range(90):
        features, *_ = env.step(np.column_stack([nearest_undriven(features["headings"]), np.zeros(rows, np.int64)]))
        robots = env.perception.memory.robots
        compass = np.column_stack([np.cos(robots["compass"]), np.sin(robots["compass"])])
        laser = np.full((rows, 180), 0.1)
        blind.sense({"laser": laser, "distance": robots["distance"][:, None], "compass": compass}, every)
        blind.observe(every)
    errors = [[rms_error(one, env, row) for row in range(rows)] for one in (env.perception, blind)]
    assert np.mean(errors[0]) < 0.5 * np.mean(errors[1])
    env.close()
    blind.close()


def rms_error(perception: Perception, env: CyclicLoopHeadingsVectorEnv, row: int) -> float:
    """Return by how much the keyframes' positions err, after the best rotation and shift."""
    keyframes, count = perception.memory.keyframes, perception.memory.robots["keyframes"][row]
    steps = keyframes.step[row, :count] * (HOLD if perception is not env.perception else 1)
    estimated = keyframes.pose[row, :count, 0] + 1j * keyframes.pose[row, :count, 1]
    true = env.env.trajectory(row)[np.minimum(steps, len(env.env.trajectory(row)) - 1), :2] @ [1, 1j]
    estimated, true = estimated - estimated.mean(), true - true.mean()
    rotation = (estimated.conj() * true).sum()
    return float(np.sqrt((np.abs(estimated * rotation / abs(rotation) - true) ** 2).mean()))

"""Frontier explorers: the grid and its frontiers on buildings drawn by hand, whole runs, and what they claim."""

from __future__ import annotations

import math

import numpy as np
import pytest

from agents import make_agent
from agents.rivals.occupancy import OccupancyGrid
from agents.rivals.returns import Places
from agents.slam.panorama import panorama_beams
from cyclic_env import TIERS, CyclicLoopEnv, CyclicLoopVectorEnv
from cyclic_env.config import LaserConfig
from cyclic_env.evaluation.rollout import rollout
from cyclic_env.simulation.lidar import scan
from tests.agents.buildings import CROSSING, ROOM

FRONTIERS = ("frontier", "frontier_lite", "frontier_loops")
LASERS = {"all around": LaserConfig(), "hard": TIERS["hard"].laser}


def grid_at(plan, laser: LaserConfig, *poses: tuple[float, float, float]) -> OccupancyGrid:
    """Return the grid of true scans at poses, and the ways from the last."""
    grid = OccupancyGrid(laser)
    for pose in poses:
        grid.add(scan(plan.walls, np.array(pose), laser), np.array(pose))
    grid.find_ways(np.array(poses[-1]))
    return grid


def test_a_room_that_is_seen_all_around_has_frontiers_at_its_walls_at_most_and_these_are_on_the_grid() -> None:
    grid = grid_at(ROOM, LaserConfig(), *((x / 2, 3, 0.3 * x) for x in range(4, 17)))
    goals = [grid.way_to(frontier.goal)[-1] for frontier in grid.frontiers(3)]
    assert all(min(x, 10 - x, y, 6 - y) < 0.7 for x, y in goals)
    free = np.argwhere(grid.log_odds < 0) * 0.2 + grid.corner[::-1] + 0.1
    assert len(free) * 0.04 == pytest.approx(60, rel=0.1)
    assert (free[:, 0] < 6.1).all()
    walls = (np.argwhere(grid.log_odds > 0) + 0.5) * 0.2 + grid.corner[::-1]
    y, x = walls.T
    to_wall = np.minimum(np.minimum(abs(x), abs(x - 10)), np.minimum(abs(y), abs(y - 6)))
    assert (to_wall < 0.25).all()


@pytest.mark.parametrize("laser", LASERS.values(), ids=LASERS)
def test_the_frontiers_of_a_crossing_are_at_the_ends_of_what_is_seen(laser: LaserConfig) -> None:
    turns = [(15.2, 1.2, 0.1 * turn) for turn in range(63)]
    grid = grid_at(CROSSING, laser, *turns)
    goals = np.array([grid.way_to(frontier.goal)[-1] for frontier in grid.frontiers(3)]) - [15.2, 1.2]
    reach = laser.range_max
    for x, y in ((reach, 0), (-reach, 0)):
        assert np.hypot(*(goals - [x, y]).T).min() < 1.0
    assert not len(goals) or np.hypot(*goals.T).max() < reach + 0.2
    ways = grid.costs_to(np.array([[15.2 + 5, 1.2], [15.2, 1.2 - 5], [8.0, 8.0]]))
    assert ways[:2] == pytest.approx([5, 5], abs=1.0)
    assert np.isinf(ways[2])


def test_beams_that_a_laser_does_not_have_leave_the_cells_behind_the_robot_unknown() -> None:
    grid = grid_at(ROOM, LASERS["hard"], (5, 3, 0))
    assert np.isfinite(grid.costs_to(np.array([[7.0, 3.0]])))
    behind = ((np.array([3.0, 3.0]) - grid.corner) / 0.2).astype(int)
    assert grid.log_odds[behind[1], behind[0]] == 0


def test_every_beam_of_a_laser_has_a_beam_of_the_panorama() -> None:
    for laser in (*LASERS.values(), LaserConfig(num_beams=181, field_of_view=math.pi)):
        beams, count = panorama_beams(laser)
        assert len(set(beams.tolist())) == laser.num_beams
        bearings = beams * math.tau / count - laser.bearings
        assert np.abs((bearings + math.pi) % math.tau - math.pi).max() < laser.beam_spacing


def test_a_place_is_returned_to_after_a_loop_and_not_on_the_way_or_through_a_wall() -> None:
    grid, places = grid_at(ROOM, LaserConfig(), (3, 3, 0)), Places()
    square = [(x, 0.0) for x in range(1, 6)] + [(5.0, y) for y in range(1, 6)]
    square += [(x, 5.0) for x in range(4, -1, -1)] + [(0.0, y) for y in range(4, 0, -1)]
    lap = [(3.0 * x, 3.0 * y) for x, y in [*square, *square[:2]]]
    found = []
    for step, (x, y) in enumerate(lap):
        places.visit(np.array([x, y, 0.0]), 3.0 * step, step, _open_ground())
        found.append(places.returned_step(_open_ground()))
    assert set(found[:18]) == {None}
    assert found[-2:] == [0, 1]
    assert places.geodesic_distances(places.count - 1).distances[1] < 2.0
    assert grid.sees(np.array([2.0, 3.0]), np.array([8.0, 3.0]))
    assert not grid.sees(np.array([3.0, 3.0]), np.array([3.0, 7.0]))


def _open_ground() -> OccupancyGrid:
    """Return a grid without a wall, of 60 m."""
    grid = OccupancyGrid(LaserConfig(range_max=30.0))
    grid.add(np.full(180, 30.0), np.array([7.5, 7.5, 0.0]))
    return grid


@pytest.mark.parametrize("name", FRONTIERS)
def test_frontier_explorers_see_all_and_claim_nothing_false_with_ideal_sensors(name: str) -> None:
    env = CyclicLoopVectorEnv(1, "ring", autoreset_mode="SAME_STEP", step_budget=450)
    (record,) = rollout(make_agent(name, env), env, [0])
    assert record["coverage"] >= 0.99
    assert record["false_claims"] == 0


def test_closing_loops_closes_all_of_them_with_ideal_sensors() -> None:
    env = CyclicLoopVectorEnv(1, "twin_rings", autoreset_mode="SAME_STEP")
    (record,) = rollout(make_agent("frontier_loops", env), env, [0])
    assert record["is_success"]
    assert record["path_length_m"] < 1.2 * env.floor_plan(0).closed_tour()


def test_a_frontier_explorer_drives_with_the_hard_tier_and_believes_what_it_reckons() -> None:
    env = CyclicLoopEnv("figure_eight", **TIERS["hard"].settings())
    policy, state = make_agent("frontier", env), None
    believed = np.zeros(3)
    observation, info = env.reset(seed=1)
    for _ in range(400):
        action, state = policy.predict(observation, state)
        believed = state[0].belief
        observation, *_, info = env.step(action)
    assert info["coverage"] > 0.4
    start, end = env.trajectory()[[0, -1], :2]
    assert 0.1 < math.hypot(*(believed[:2] - (end - start))) < 20
    env.close()


@pytest.mark.slow
@pytest.mark.parametrize("name", FRONTIERS)
def test_frontier_explorers_see_killian_court_by_a_short_way(name: str) -> None:
    env = CyclicLoopVectorEnv(1, "killian_court", autoreset_mode="SAME_STEP")
    (record,) = rollout(make_agent(name, env), env, [0])
    assert record["coverage"] >= 0.99
    assert record["path_length_m"] < 1.6 * env.floor_plan(0).closed_tour()

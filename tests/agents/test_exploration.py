"""Exploration: what scans see, the frontiers and the list of open areas, paths over the costmap, and steering."""

from __future__ import annotations

import math

import numpy as np
import pytest
import shapely

from agents.component_config import pack
from agents.exploration.costmap import Costmap, CostmapConfig
from agents.exploration.frontiers import Frontiers
from agents.exploration.planner import PlannerConfig, steer_to
from agents.exploration.visibility import (
    DOUBTFUL,
    UNCONFIRMED,
    VisibilityConfig,
    VisibilityValues,
    clear_beam,
    clear_lengths,
    inside,
    is_explored,
    open_points,
    to_track,
)
from agents.slam.keyframes import Keyframes
from agents.slam.se2 import euclidean_distances, wrap_angle
from tests.agents.buildings import BEAMS, CROSSING, REACH, ROOM, SPACING, keyframes_at, plan_of, seen

VALUES = pack(VisibilityValues, VisibilityConfig())
GRID, PLANNER = CostmapConfig(), PlannerConfig()
NO_LEGS = np.zeros((0, 2, 2))


def test_clear_lengths_are_those_of_a_rectangle_pushed_ahead() -> None:
    ranges, clear = seen(CROSSING, 13.0, 1.0, 0.3), np.empty(BEAMS)
    clear_lengths(ranges, 0.3, clear)
    angles = np.arange(BEAMS) * SPACING
    for beam in range(BEAMS):
        off = wrap_angle(angles - angles[beam])
        in_way = (np.abs(off) < math.pi / 2) & (ranges * np.abs(np.sin(off)) < 0.3 - 1e-9)
        expected = min(ranges[beam], (ranges * np.cos(off))[in_way].min())
        # An end on the border of the rectangle may count as in its way or not.
        assert clear[beam] == pytest.approx(expected, abs=0.02)


def test_a_scan_sees_what_lies_before_its_ends() -> None:
    ranges, out = seen(ROOM, 5.0, 3.0, 1.0), np.empty(3, np.bool_)
    inside(ranges, np.array([5.0, 3.0, 1.0]), np.array([[9.0, 5.0], [9.95, 3.0], [10.5, 3.0]]), 0.1, out)
    assert out.tolist() == [True, False, False]


def test_a_closed_room_has_no_opening() -> None:
    out = np.empty((400, 3))
    assert open_points(seen(ROOM, 5.0, 3.0, 0.0), REACH, out, VALUES) == 0


def test_where_the_laser_does_not_look_there_is_neither_a_wall_nor_an_opening() -> None:
    whole, out, clear = seen(CROSSING, 13.0, 1.2, 0.0), np.empty((400, 3)), np.empty(BEAMS)
    half = whole.copy()
    half[BEAMS // 4 : -BEAMS // 4] = 0.0
    count = open_points(half, REACH, out, VALUES)
    bearings = np.abs(wrap_angle(out[:count, 1] * SPACING))
    assert count > 0
    assert bearings.max() < 1.3  # not at the edge, 90 degrees aside
    clear_lengths(half, 0.3, clear)
    assert clear[0] > 5.0
    assert (clear[BEAMS // 4 : -BEAMS // 4] == 0).all()
    grid = Costmap(REACH)
    pose = np.array([13.0, 1.2, 0.0])
    grid.draw(pose, half[None], pose[None], NO_LEGS)
    costs, _ = grid.costs_to(np.array([[18.0, 1.2], [8.0, 1.2]]))
    assert np.isfinite(costs[0])
    assert np.isinf(costs[1])


def test_openings_are_seen_at_the_ends_and_corners_of_a_crossing() -> None:
    pose, out = (13.0, 1.2, 0.0), np.empty((400, 3))
    count = open_points(seen(CROSSING, *pose), REACH, out, VALUES)
    points = to_track(out[:count], np.tile(pose, (count, 1)), SPACING)
    firm = points[out[:count, 2] != DOUBTFUL]
    assert (firm[:, 0] > 24).any()  # the corridor's far end
    assert (firm[:, 0] < 2).any()
    assert ((firm[:, 1] > 2.4) & (np.abs(firm[:, 0] - 15.2) < 1.2)).any()  # the side corridors
    assert ((firm[:, 1] < 0.0) & (np.abs(firm[:, 0] - 15.2) < 1.2)).any()
    assert shapely.contains_xy(CROSSING.free_space.buffer(0.05), *firm.T).all()


def test_a_scan_explores_what_it_sees_beyond_and_what_is_at_a_wall() -> None:
    pose = (5.0, 3.0, 0.0)
    out = np.empty(3, np.bool_)
    is_explored(
        seen(ROOM, *pose)[None], np.array([pose]), REACH, np.array([[8.0, 4.0], [10.3, 3.0], [11.0, 3.0]]), out, VALUES
    )
    assert out.tolist() == [True, True, False]


def test_clear_beam_is_the_nearest_that_is_clear() -> None:
    clear = np.full(BEAMS, 0.1)
    assert math.isnan(clear_beam(clear, 0.0, 1.0))
    clear[[20, 170]] = 3.0
    assert clear_beam(clear, 0.0, 1.0) == pytest.approx(-10 * SPACING)
    assert clear_beam(clear, 0.6, 1.0) == pytest.approx(20 * SPACING)


def test_a_side_corridor_is_listed_when_it_is_left_behind_and_resolved_when_seen_into() -> None:
    there = [(float(x), 1.2, 0.0) for x in range(8, 29)]
    back = [(float(x), 1.2, math.pi) for x in range(27, 15, -1)]
    into = [(15.2, float(y), math.pi / 2) for y in range(2, 10)]
    keyframes, frontiers = Keyframes(BEAMS, 7), Frontiers(BEAMS, REACH)
    everything = keyframes_at(CROSSING, there + back + into)
    states: list[dict[int, str]] = []
    for row in range(everything.count):
        keyframe = {name: getattr(everything, name)[row] for name in ("pose", "scan", "step", "path")}
        keyframes.add(**keyframe)
        for other in np.flatnonzero(euclidean_distances(keyframes.pose, keyframes.pose[row]) < 1.5).tolist():
            keyframes.connect(other, row)
        frontiers.update(keyframes, keyframes.geodesic_distances(row).distances)
        states.append({area.number: area.state for area in frontiers.listed})
    assert "open" in states[len(there) - 1].values()  # the side corridors' ends were beyond the laser's reach
    north = [area for area in frontiers.listed if (keyframes.pose[area.keyframe, :2] + area.offset)[1] > 2.4]
    assert north
    assert {area.state for area in north} <= {"visited", "reached another way"}


def test_an_opening_that_one_scan_alone_sees_comes_last() -> None:
    """A range that is wrong, beyond a wall, is not repeated by the scans before and after; a corridor's end is."""
    poses = np.array([(12.6 + 0.2 * i, 1.2, 0.0) for i in range(5)])
    measured = np.array([seen(CROSSING, *pose) for pose in poses])
    keyframes = keyframes_at(CROSSING, [(13.0, 1.2, 0.0)])
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


def test_a_blacklisted_point_is_never_open_again() -> None:
    keyframes, frontiers = keyframes_at(CROSSING, [(13.0, 1.2, 0.0)]), Frontiers(BEAMS, REACH)
    frontiers.update(keyframes, np.zeros(1))
    point = frontiers.points(keyframes)[0]
    frontiers.blacklist(keyframes, point)
    again = keyframes_at(CROSSING, [(13.0, 1.2, 0.0)])
    frontiers.update(again, np.zeros(1))
    assert np.hypot(*(frontiers.points(again) - point).T).min() >= 1.0


def test_an_opening_reached_from_the_other_side_leads_on_until_the_loop_is_closed() -> None:
    """Seen from one end of a corridor and reached from its other end, which by the graph of rows is far away."""
    corridor = plan_of((0, 0, 40, 2.4))
    first, last = (4.0, 1.2, 0.0), (17.0, 1.2, math.pi)
    keyframes, frontiers = keyframes_at(corridor, [first]), Frontiers(BEAMS, REACH)
    frontiers.update(keyframes, np.zeros(1))
    ahead = frontiers.points(keyframes)[:, 0].max()
    assert 15.0 < ahead < 16.5
    keyframes = keyframes_at(corridor, [first, last])
    for x in (17.0, 15.5, 13.5):
        keyframes.pose[1], keyframes.scan[1] = (x, 1.2, math.pi), seen(corridor, x, 1.2, math.pi)
        frontiers.update(keyframes, np.array([70.0, 0.0]))
        mine = frontiers.points(keyframes)[(frontiers.keyframe == 0) & frontiers.unbounded]
        assert len(mine)
        assert mine[:, 0].max() < x - 1.0  # ahead of the robot, towards where it was seen from
    frontiers.update(keyframes, np.array([9.5, 0.0]))  # the loop is closed
    assert not (frontiers.keyframe == 0).any()


def test_a_path_leads_around_a_corner_and_keeps_off_walls() -> None:
    pose = np.array([10.0, 1.2, 0.0])
    grid = Costmap(REACH)
    scans = np.array([seen(CROSSING, *pose), seen(CROSSING, 15.0, 1.2, 0.0)])
    grid.draw(pose, scans, np.array([pose, (15.0, 1.2, 0.0)]), NO_LEGS)
    costs, cells = grid.costs_to(np.array([[15.2, 9.0], [20.0, 8.0]]))
    assert 11.0 < costs[0] < 20.0
    assert math.isinf(costs[1])  # behind a wall
    path = grid.path_to(int(cells[0]))
    assert math.hypot(*(path[0] - pose[:2])) < GRID.cell
    assert math.hypot(*(path[-1] - (15.2, 9.0))) < 0.8
    walls = shapely.boundary(CROSSING.free_space)
    assert shapely.distance(walls, shapely.points(path)).min() > 0.2


def test_the_way_that_was_driven_is_always_known() -> None:
    """A wall that a scan, taken where the track is off, puts across a doorway does not lock the robot in."""
    pose, grid = np.array([10.0, 1.2, 0.0]), Costmap(REACH)
    scans = np.array([seen(CROSSING, *pose), np.full(BEAMS, 1.0)])  # the second draws a wall all around the first
    poses, there = np.vstack([pose, pose]), np.array([[15.0, 1.2]])
    grid.draw(pose, scans, poses, NO_LEGS)
    assert np.isinf(grid.costs_to(there)[0]).all()
    grid.draw(pose, scans, poses, np.array([[(15.0, 1.2), pose[:2]]]))
    costs, cells = grid.costs_to(there)
    assert 5.0 < costs[0] < 15.0
    assert np.abs(grid.path_to(int(cells[0]))[:, 1] - 1.2).max() < 0.3


def test_points_off_the_map_have_no_path() -> None:
    grid = Costmap(REACH)
    pose = np.array([5.0, 3.0, 0.0])
    grid.draw(pose, seen(ROOM, *pose)[None], pose[None], NO_LEGS)
    costs, _ = grid.costs_to(np.array([[5.0 + GRID.cells * GRID.cell, 3.0], [-1e9, 1e9]]))
    assert np.isinf(costs).all()


def test_steering_turns_aside_no_further_than_it_may() -> None:
    clear = np.zeros(BEAMS)
    clear[BEAMS // 2] = 2.0  # only the way back is clear
    assert steer_to(clear, 0.0, 1.0, math.pi, PLANNER)[1] != 0
    assert steer_to(clear, 0.0, 1.0, math.radians(60), PLANNER)[1] == 0


def test_steering_turns_on_the_spot_to_what_is_behind_and_slows_for_a_wall() -> None:
    clear = np.full(BEAMS, 5.0)
    assert steer_to(clear, 0.0, 4.0, math.pi, PLANNER) == pytest.approx((1.0, 0.0))
    speed, turn = steer_to(clear, 3.0, 4.0, math.pi, PLANNER)
    assert speed == 0
    assert turn > 0.5
    clear[0] = 0.5
    assert steer_to(clear, 0.0, 0.4, math.pi, PLANNER)[0] < 0.5

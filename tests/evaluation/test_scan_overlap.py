"""Overlaps of scans: of one with itself, from two ends of a corridor, and of half a turn to the front and back."""

from __future__ import annotations

import math

import numpy as np
import pytest

from cyclic_env import LaserConfig, load_floor_plan
from cyclic_env.evaluation.scan_overlap import Scans, greatest_overlaps, overlaps_of
from cyclic_env.simulation.lidar import scan

POSES = np.array([[10.0, 0.0, 0.0], [10.5, 0.2, 0.3], [20.0, 14.0, 0.0], [10.0, 0.0, math.pi]])
PAIRS = np.array([[0, 0], [1, 0], [2, 0], [3, 0]])


def taken(laser: LaserConfig) -> Scans:
    plan = load_floor_plan("ring")
    ranges = np.array([scan(plan.walls, pose, laser) for pose in POSES], np.float32)
    return Scans(times=np.arange(4.0), ranges=ranges, laser=laser)


def test_scans_all_around_overlap_where_they_are_near_however_they_are_turned() -> None:
    same, near, far, back = overlaps_of(taken(LaserConfig()), POSES, PAIRS)
    assert same == pytest.approx(1.0)
    assert near > 0.85
    assert far < 0.3
    assert back > 0.95


def test_a_laser_of_half_a_turn_sees_nothing_of_what_is_behind_it() -> None:
    same, near, _, back = overlaps_of(taken(LaserConfig(field_of_view=math.pi, num_beams=91)), POSES, PAIRS)
    assert same == pytest.approx(1.0)
    assert near > 0.7
    assert back < 0.1


def test_the_laser_may_be_off_the_middle_of_the_robot() -> None:
    laser, plan = LaserConfig(), load_floor_plan("ring")
    ranges = np.array(
        [scan(plan.walls, pose, laser) for pose in np.array([[10.3, 0, 0], [9.7, 0, math.pi]])], np.float32
    )
    scans = Scans(times=np.arange(2.0), ranges=ranges, laser=laser, laser_position=(0.3, 0.0))
    poses = np.array([[10.0, 0.0, 0.0], [10.0, 0.0, math.pi]])
    assert overlaps_of(scans, poses, np.array([[1, 0]]))[0] > 0.9


def test_only_scans_long_ago_and_near_count_for_a_return() -> None:
    scans = taken(LaserConfig())
    found = greatest_overlaps(scans, POSES, np.array([0.0, 1.0, 30.0, 60.0]), gap=20.0, enough=1.0)
    pairs = overlaps_of(scans, POSES, np.array([[2, 0], [2, 1], [3, 0], [3, 1], [3, 2]]))
    np.testing.assert_allclose(found, [0, 0, pairs[:2].max(), pairs[2:].max()])
    far = POSES + np.array([[0, 0, 0], [0, 0, 0], [0, 0, 0], [500, 0, 0]])
    assert greatest_overlaps(scans, far, np.array([0.0, 1.0, 30.0, 60.0]), gap=20.0, enough=1.0)[3] == 0.0

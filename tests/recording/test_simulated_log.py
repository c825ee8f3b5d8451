"""Simulated logs: where the robot drives, what its laser sees and by how much its wheels err."""

from __future__ import annotations

import math

import numpy as np
import shapely

from cyclic_env.config import LaserConfig
from cyclic_env.floor_plans import load_floor_plan
from cyclic_env.recording.simulated_log import TURN, WheelErrors, simulate_log
from cyclic_env.simulation.lidar import scan
from cyclic_env.trajectory.poses import wrap_angle

LASER = LaserConfig(num_beams=90, range_max=30.0, field_of_view=math.pi)
PERFECT = WheelErrors(turn_drift_deg=0, turn_scale=0, distance_scale=0, turn_noise_deg=0, distance_noise=0)


def test_the_robot_stays_clear_of_the_walls_and_drives_on_in_small_steps() -> None:
    plan = load_floor_plan("office")
    poses = simulate_log(plan, 300.0, LASER, seed=1).reference
    assert poses is not None
    assert shapely.contains_xy(plan.free_space.buffer(-0.29), poses[:, 0], poses[:, 1]).all()
    steps = np.hypot(*np.diff(poses[:, :2], axis=0).T)
    assert 200 < steps.sum() < 400
    assert np.quantile(steps, 0.99) < 0.2
    assert np.abs(np.diff(poses[:, 2])).max() <= TURN + 1e-9


def test_the_laser_sees_the_walls() -> None:
    plan = load_floor_plan("ring")
    log = simulate_log(plan, 60.0, LASER, range_std=0.0)
    assert log.reference is not None
    for i in (0, 100, 300):
        expected = scan(plan.walls, log.reference[i], LASER)
        np.testing.assert_allclose(np.minimum(log.ranges[i], LASER.range_max), expected, atol=1e-4)


def test_perfect_wheels_tell_the_way_and_worn_ones_drift() -> None:
    plan = load_floor_plan("ring")
    perfect, worn = (simulate_log(plan, 200.0, LASER, seed=2, wheels=wheels) for wheels in (PERFECT, None))
    for log, low, high in ((perfect, 0.0, 1e-9), (worn, 0.02, math.pi)):
        assert log.reference is not None
        drift = wrap_angle(log.odometry[:, 2] - log.reference[:, 2] + log.reference[0, 2])
        assert low <= np.abs(drift).max() <= high
    np.testing.assert_array_equal(worn.ranges, simulate_log(plan, 200.0, LASER, seed=2).ranges)

"""What loop closures do to a map: right ones mend it, a false one bends it, and the robust graph leaves that out."""

from __future__ import annotations

import math

import numpy as np
import pytest

from agents.slam.closure_price import price_run
from agents.slam.pose_graph import PoseGraphConfig, optimize
from cyclic_env import RecordingError
from cyclic_env.evaluation.judge import judge_run
from cyclic_env.trajectory.poses import compose, relative
from cyclic_env.trajectory.readers import Claims, Trajectory
from tests.helpers import refused

SIDE, LAPS = 20, 2
STEPS = np.tile([[1.0, 0.0, 0.0]] * (SIDE - 1) + [[1.0, 0.0, math.pi / 2]], (4 * LAPS, 1))


def chained(steps: np.ndarray) -> np.ndarray:
    poses = [np.zeros(3)]
    for step in steps:
        poses.append(compose(poses[-1], step))
    return np.array(poses)


TRUE = Trajectory(times=np.arange(len(STEPS) + 1.0), poses=chained(STEPS))
ODOMETRY = Trajectory(times=TRUE.times, poses=chained(STEPS + np.array([0.0, 0.0, math.radians(0.3)])))
RIGHT = [(i, i - 4 * SIDE) for i in range(4 * SIDE, len(STEPS), 5)]


def claims(*pairs: tuple[int, int]) -> Claims:
    later, earlier = np.array(sorted(pairs), float).T
    return Claims(times=later, matches=earlier, by_step=True)


def test_a_false_claim_bends_the_plain_map_and_not_the_robust_one() -> None:
    judged = judge_run(TRUE, claims(*RIGHT, (118, 20))).judged
    assert (~judged["correct"]).sum() == 1
    steps = []
    price = price_run(TRUE, ODOMETRY, judged, on_step=lambda: steps.append(1))
    assert price.odometry_m > 2
    assert price.right_m == pytest.approx(price.right_robust_m, abs=0.01)
    assert price.right_m < 0.5 * price.odometry_m
    assert price.all_m > 2 * price.right_m
    assert price.all_robust_m == pytest.approx(price.right_robust_m, abs=0.05)
    assert (price.false, price.rejected_false, price.rejected_right) == (1, 1, 0)
    assert price.each == ((118, price.all_m, price.all_robust_m),)
    assert len(steps) == 7


def test_measured_claims_mend_more_than_those_that_only_say_the_same_place() -> None:
    judged = judge_run(TRUE, claims(*RIGHT)).judged
    measured = relative(TRUE.poses[judged["match"]], TRUE.poses[judged["step"]])
    assert price_run(TRUE, ODOMETRY, judged, measured).right_m < 0.7 * price_run(TRUE, ODOMETRY, judged).right_m


def test_a_run_without_claims_has_the_map_of_its_odometry() -> None:
    price = price_run(TRUE, ODOMETRY, judge_run(TRUE, claims((1, 0))).judged)
    assert price.all_m == price.right_robust_m == price.odometry_m
    assert price.each == ()


def test_odometry_of_another_time_gets_one_line() -> None:
    judged = judge_run(TRUE, claims(*RIGHT)).judged
    with refused("odometry has no pose at the moments of the claims", RecordingError):
        price_run(TRUE, Trajectory(times=TRUE.times + 1e6, poses=TRUE.poses), judged)


def test_gtsam_finds_the_same_poses() -> None:
    gtsam = pytest.importorskip("gtsam")
    edges = np.array([*((i, i + 1) for i in range(len(STEPS))), *((j, i) for i, j in RIGHT)])
    rng = np.random.default_rng(0)
    measured = relative(TRUE.poses[edges[:, 0]], TRUE.poses[edges[:, 1]]) + rng.normal(0, 0.02, (len(edges), 3))
    information = np.repeat(np.diag([400.0, 400.0, 2500.0])[None], len(edges), axis=0)
    none = np.zeros(len(TRUE.poses))
    ours = optimize(TRUE.poses, edges, measured, information, none, none, PoseGraphConfig(iterations=30))
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    noise = gtsam.noiseModel.Diagonal.Sigmas(np.array([0.05, 0.05, 0.02]))
    graph.add(gtsam.PriorFactorPose2(0, gtsam.Pose2(*TRUE.poses[0]), gtsam.noiseModel.Isotropic.Sigma(3, 1e-6)))
    for (i, j), pose in zip(edges.tolist(), measured, strict=True):
        graph.add(gtsam.BetweenFactorPose2(i, j, gtsam.Pose2(*pose), noise))
    for i, pose in enumerate(TRUE.poses):
        values.insert(i, gtsam.Pose2(*pose))
    found = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    theirs = np.array([[found.atPose2(i).x(), found.atPose2(i).y()] for i in range(len(TRUE.poses))])
    assert np.hypot(*(ours[:, :2] - theirs).T).max() < 0.05

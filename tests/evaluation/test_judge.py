"""The judge: it agrees with the infos of the simulator and of the player, with evo, and with what is known on paper."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from cyclic_env import ClosureConfig, CyclicLoopEnv, RecordedRun, RecordingError, load_floor_plan, read_robot_log
from cyclic_env.evaluation.claim_matching import match_claims
from cyclic_env.evaluation.judge import JudgeReport, judge_run
from cyclic_env.evaluation.scan_overlap import Scans
from cyclic_env.task.trajectory_truth import judge_trajectory
from cyclic_env.trajectory.poses import compose
from cyclic_env.trajectory.readers import Claims, Relations, Trajectory
from tests.helpers import bumping_actions, refused

COUNTS = ("claims", "false_claims", "revisits", "revisits_recognised", "precision", "recall", "cycles_closed")

OUT = np.linspace(0, 40, 81)
THERE_AND_BACK = np.column_stack([np.append(OUT, OUT[-2::-1]), np.zeros(161), np.zeros(161)])
"""Poses half a metre apart, 40 m along the x axis and back; a pose a second."""
LINE = Trajectory(times=np.arange(161.0), poses=THERE_AND_BACK)


def by_step(*pairs: tuple[int, int], scores: list[float] | None = None) -> Claims:
    later, earlier = np.array(pairs, float).reshape(-1, 2).T
    return Claims(times=later, matches=earlier, by_step=True, scores=None if scores is None else np.array(scores))


def counts(report: JudgeReport) -> list[float | None]:
    return [getattr(report, name) for name in COUNTS]


@pytest.mark.parametrize("action_type", ["wheels", "twist"])
def test_a_run_of_the_simulator_is_judged_as_its_info_says(action_type: str) -> None:
    env = CyclicLoopEnv("ring", action_type=action_type, step_budget=3000)  # pyright: ignore[reportArgumentType]
    _, info = env.reset(seed=1)
    actions, claims, ended, step, poses = bumping_actions(3000, 1, seed=4)[:, 0], [], False, 0, []
    poses.append([info["x"], info["y"], info["heading"]])
    while not ended:
        action = actions[step]
        step += 1
        if action[2] > 0:
            claims.append((step, round((float(action[3]) + 1) / 2 * step)))
        _, _, terminated, ended, info = env.step(action)
        ended = ended or terminated
        poses.append([info["x"], info["y"], info["heading"]])
    reference = Trajectory(times=0.2 * np.arange(len(poses)), poses=np.array(poses))
    report = judge_run(reference, by_step(*claims), plan=env.floor_plan)
    assert report.closure == ClosureConfig()
    assert report.false_claims > 20
    assert counts(report) == [info[name] for name in COUNTS]


def test_a_recorded_run_is_judged_as_the_player_judges_it() -> None:
    log = read_robot_log("killian_run")[:1500]
    run = RecordedRun(log)
    rng = np.random.default_rng(0)
    run.reset()
    claims, info = [], {}
    for step in range(1, 1500):
        match = int(rng.integers(0, step + 1))
        if step % 3 == 0:
            claims.append((step, match))
        *_, info = run.step([0.0, 0.0, 1.0 if step % 3 == 0 else -1.0, 2 * match / step - 1])
    reference = Trajectory(times=log.times, poses=run.poses)
    scans = Scans(times=log.times, ranges=log.ranges, laser=log.laser)
    report = judge_run(reference, by_step(*claims), plan=run.floor_plan, scans=scans)
    assert report.false_claims > 100
    assert counts(report) == [info[name] for name in COUNTS]
    names = [verdict.definition for verdict in report.verdicts]
    assert names[1:] == [
        "within 3 m, whatever lies between",
        "within 5 m, whatever lies between",
        "scans overlap by 30%",
        "scans overlap by 50%",
    ]
    ours, three, five, some, half = (verdict.rows for verdict in report.verdicts)
    assert 0 < ours <= three <= five
    assert 0 < half <= some


def test_a_perfect_claimer_and_a_silent_one() -> None:
    run = RecordedRun("killian_run")
    reference, plan = Trajectory(times=run.log.times, poses=run.poses), run.floor_plan
    silent = judge_run(reference, by_step(), plan=plan)
    assert (silent.precision, silent.recall, silent.cycles_closed, silent.cycles_total) == (1.0, 0.0, 0, 6)
    assert silent.verdicts[0].row_recall == 0.0
    nearest = Trajectory(times=reference.times, poses=reference.poses)
    relations = judge_run(reference, by_step(), plan=plan, estimate=nearest)
    assert relations.relations is not None
    assert relations.relations[:3] == (silent.verdicts[0].rows, pytest.approx(0.0), pytest.approx(0.0))
    asked = np.column_stack([np.arange(1, len(run.log)), np.full(len(run.log) - 1, -1)])
    config = dataclasses.replace(silent.closure, claim_spacing=0.0)
    found = judge_trajectory(plan, run.poses[:, :2], asked, config).claims
    right = found[found["correct"]]
    perfect = judge_run(reference, by_step(*zip(right["step"], right["match"], strict=True)), plan=plan)
    assert (perfect.precision, perfect.recall, perfect.false_claims, perfect.cycles_closed) == (1.0, 1.0, 0, 6)
    assert perfect.verdicts[0].row_recall == 1.0


def test_rows_and_scores_without_a_map() -> None:
    claims = by_step((160, 0), (150, 10), (140, 60), (120, 119), scores=[0.9, 0.8, 0.7, 1.0])
    report = judge_run(LINE, claims)
    assert (report.cycles_closed, report.cycles_total) == (None, None)
    assert (report.claims, report.false_claims) == (3, 1)  # the one of a step ago comes too soon
    ours = report.verdicts[0]
    assert ours.rows == np.count_nonzero(OUT <= 30)  # the turning point is at least 10 m away
    assert (ours.right, ours.wrong) == (2, 1)
    assert ours.curve.recall_at_100_precision == pytest.approx(2 / ours.rows)
    thinned = Trajectory(times=LINE.times[::2] + 0.01, poses=LINE.poses[::2])
    half = judge_run(LINE, claims, estimate=thinned)
    assert half.rows == 81
    assert half.verdicts[0].rows == pytest.approx(ours.rows / 2, abs=1)
    assert half.ate_m == pytest.approx(0.0)


def test_the_error_of_the_trajectory_is_evos(tmp_path) -> None:
    metrics = pytest.importorskip("evo.core.metrics")
    trajectory, sync = pytest.importorskip("evo.core.trajectory"), pytest.importorskip("evo.core.sync")
    rng = np.random.default_rng(0)
    poses = np.column_stack([np.cumsum(rng.normal(0, 0.3, (400, 2)), axis=0), rng.uniform(-3, 3, 400)])
    reference = Trajectory(times=1e9 + 0.2 * np.arange(400), poses=poses)
    kept = np.arange(3, 400, 7)
    estimated = compose((4.0, -1.0, 0.3), poses[kept] + rng.normal(0, 0.2, (len(kept), 3)))
    estimate = Trajectory(times=reference.times[kept] + rng.uniform(-0.009, 0.009, len(kept)), poses=estimated)
    report = judge_run(reference, by_step(), estimate=estimate)

    def evos(of: Trajectory):
        space = np.column_stack([of.poses[:, :2], np.zeros(len(of.poses))])
        half = of.poses[:, 2] / 2
        quaternions = np.column_stack([np.cos(half), np.zeros((len(half), 2)), np.sin(half)])
        return trajectory.PoseTrajectory3D(space, quaternions, of.times)

    theirs, ours = sync.associate_trajectories(evos(reference), evos(estimate))
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data((theirs, ours))
    assert report.ate_m == pytest.approx(ape.get_statistic(metrics.StatisticsType.rmse))
    ours.align(theirs)
    ape.process_data((theirs, ours))
    assert report.ate_aligned_m == pytest.approx(ape.get_statistic(metrics.StatisticsType.rmse))


def test_claims_by_time_are_matched_and_the_surest_at_a_pose_counts() -> None:
    claims = Claims(
        times=np.array([10.004, 10.0, 50.0, 3.0, 0.0]),
        matches=np.array([2.0, 3.0, 77.7, 20.0, 0.0]),
        scores=np.array([0.5, 0.9, 1.0, 0.1, 0.2]),
        measured=np.array([[1.0, 0, 0]] * 3 + [[0.0, 2.0, np.pi / 2]] * 2),
    )
    matched = match_claims(claims, LINE.times)
    assert matched.pairs.tolist() == [[10, 3], [20, 3]]  # the later pose first
    assert (matched.unmatched, matched.repeated) == (1, 2)
    assert matched.scores is not None
    assert matched.scores.tolist() == [0.9, 0.1]
    assert matched.measured is not None
    np.testing.assert_allclose(matched.measured, [[1, 0, 0], [-2, 0, -np.pi / 2]], atol=1e-12)


def test_given_relations_are_compared() -> None:
    relations = Relations(np.array([[0.0, 10.0], [5.0, 999.0]]), np.array([[4.0, 0.0, 0.0], [0.0, 0.0, 0.0]]))
    report = judge_run(LINE, by_step(), estimate=LINE, relations=relations)
    assert report.relations == pytest.approx((1, 1.0, 0.0, 0.0, 0.0))
    assert report.to_json()["relations"]["translation_m"] == pytest.approx(1.0)


def test_what_has_no_moment_in_common_gets_one_line() -> None:
    late = dataclasses.replace(LINE, times=LINE.times + 1e9)
    with refused(r"none of the times of the trajectory is within 0\.02 s", RecordingError):
        judge_run(LINE, by_step(), estimate=late)
    with refused("none of the times of the claims", RecordingError):
        judge_run(LINE, Claims(times=np.array([1e9]), matches=np.array([0.0])))
    with refused("steps beyond those of the reference, 0 to 160", RecordingError):
        judge_run(LINE, by_step((161, 0)))
    with refused("positions lie more than"):
        judge_run(dataclasses.replace(LINE, poses=THERE_AND_BACK + 1e4), by_step(), plan=load_floor_plan("ring"))

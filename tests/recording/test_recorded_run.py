"""The player of logs: the log's observations, and claims judged as in the simulator."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from cyclic_env import CyclicLoopEnv, RecordingError, UsageError
from cyclic_env.recording.readers import read_robot_log
from cyclic_env.recording.recorded_run import RecordedRun
from cyclic_env.recording.robot_log import RobotLog
from cyclic_env.task.trajectory_truth import judge_trajectory
from cyclic_env.trajectory.dead_reckoning import dead_reckon
from tests.helpers import bumping_actions

SILENT = np.array([1.0, 1.0, -1.0, 0.0])


@pytest.fixture(scope="module")
def killian() -> RobotLog:
    return read_robot_log("killian_run")


def play(run: RecordedRun, actions: Any = None) -> tuple[list[dict[str, np.ndarray]], list[float], dict[str, Any]]:
    """Play a run; return its observations and rewards, and the last info."""
    observation, info = run.reset()
    observations, rewards, step, ended = [observation], [], 0, False
    while not ended:
        observation, reward, _, ended, info = run.step(SILENT if actions is None else actions[step])
        observations.append(observation)
        rewards.append(reward)
        step += 1
    return observations, rewards, info


def returns(run: RecordedRun) -> np.ndarray:
    """Return which steps are revisits, `(steps,)`."""
    run.reset()
    return np.array([run.step(run.action_space.sample() * 0)[-1]["revisit"] for _ in range(run.step_budget)])


def test_the_observations_are_those_of_the_log(killian: RobotLog) -> None:
    log = killian[:400]
    run = RecordedRun(log)
    observations, _, info = play(run)
    laser, distance, compass = (np.array([o[name] for o in observations]) for name in ("laser", "distance", "compass"))
    assert (laser == np.minimum(log.ranges, 50.0)).all()
    assert (laser == 50.0).any()
    reckoned = dead_reckon(distance, compass, log.odometry[0, :2])
    assert np.hypot(*(reckoned - log.odometry)[:, :2].T).max() < 1.5  # the odometry's sideways motion is lost
    assert all(run.observation_space.contains(observation) for observation in observations)
    assert run.config.laser == log.laser
    assert np.abs(np.diff(distance[:, 0])).max() <= run.config.robot.advance_max + 1e-5
    assert (info["x"], info["y"]) == tuple(run.trajectory()[-1, :2])


def test_a_silent_agent_recognises_nothing(killian: RobotLog) -> None:
    _, rewards, info = play(RecordedRun(killian))
    assert (info["claims"], info["revisits_recognised"], info["cycles_closed"]) == (0, 0, 0)
    assert (info["revisits"], info["recall"], info["precision"], info["cycles_total"]) == (10, 0.0, 1.0, 6)
    assert sum(rewards) == pytest.approx(-10 - 10)


def test_a_perfect_claimer_closes_all_cycles(killian: RobotLog) -> None:
    run = RecordedRun(killian, action_type="discrete")
    revisits = returns(run)
    _, rewards, info = play(run, np.column_stack([np.ones(len(revisits), int), revisits.astype(int)]))
    assert (info["precision"], info["recall"], info["false_claims"]) == (1.0, 1.0, 0)
    assert (info["cycles_closed"], info["cycles_total"], info["is_success"]) == (6, 6, True)
    assert sum(rewards) == pytest.approx(50 - 10)


def test_claims_that_name_their_step_are_judged_as_a_whole_trajectory_is(killian: RobotLog) -> None:
    run = RecordedRun(killian[:1500])
    rng = np.random.default_rng(0)
    actions = np.tile(SILENT, (run.step_budget, 1))
    actions[::3, 2] = 1.0
    actions[:, 3] = rng.uniform(-1, 1, len(actions))
    _, _, info = play(run, actions)
    claims = run.claims()
    assert (~claims["correct"]).sum() == info["false_claims"] > 100
    pairs = np.column_stack([claims["step"], claims["match"]])
    judged = judge_trajectory(run.floor_plan, run.trajectory(), pairs, run.config.closure)
    assert (judged.claims == claims).all()
    for name in ("false_claims", "revisits", "revisits_recognised", "cycles_closed", "precision", "recall"):
        assert getattr(judged, name) == info[name]


def test_two_plays_are_equal_to_the_bit(killian: RobotLog) -> None:
    actions = bumping_actions(799, 1)[:, 0]
    run = RecordedRun(killian[:800])
    plays = [play(run, actions), play(run, actions), play(RecordedRun(killian[:800]), actions)]
    for observations, rewards, info in plays[1:]:
        assert (rewards, info) == plays[0][1:]
        for observation, first in zip(observations, plays[0][0], strict=True):
            assert all(value.tobytes() == first[name].tobytes() for name, value in observation.items())


def test_infos_and_spaces_are_those_of_the_simulator(killian: RobotLog) -> None:
    run, env = RecordedRun(killian[:50]), CyclicLoopEnv("ring")
    infos = [(env.reset(seed=0)[1], run.reset()[1]), (env.step(SILENT)[-1], run.step(SILENT)[-1])]
    for theirs, ours in infos:
        assert [(name, type(value)) for name, value in theirs.items()] == [(n, type(v)) for n, v in ours.items()]
        assert list(theirs["reward_terms"]) == list(ours["reward_terms"])
    check_env(run, skip_render_check=True)


def test_a_log_without_a_plan_is_judged_on_open_ground(killian: RobotLog) -> None:
    bare = dataclasses.replace(killian[:1500], map_name=None, map_transform=None)
    run = RecordedRun(bare, action_type="discrete", closure={"return_radius": 5.0})
    assert run.floor_plan is None
    revisits = returns(run)
    _, _, info = play(run, np.column_stack([np.ones(len(revisits), int), revisits.astype(int)]))
    assert info["revisits_recognised"] == info["revisits"] > 0
    assert (info["cycles_total"], info["is_success"]) == (0, False)


def test_a_log_that_can_not_be_judged_is_refused(killian: RobotLog) -> None:
    with pytest.raises(RecordingError, match="has no reference poses"):
        RecordedRun(dataclasses.replace(killian, reference=None))
    with pytest.raises(RecordingError, match="has no map_transform"):
        RecordedRun(dataclasses.replace(killian, map_transform=None))
    run = RecordedRun(killian[:3])
    with pytest.raises(UsageError, match="reset"):
        run.step(SILENT)
    play(run)
    with pytest.raises(UsageError, match="reset"):
        run.step(SILENT)

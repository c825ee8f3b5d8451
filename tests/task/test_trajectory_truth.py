"""Whole trajectories: judged as the environment judges them, with a plan or on open ground, and pairs of steps."""

from __future__ import annotations

import numpy as np
import pytest

from cyclic_env.config import ClosureConfig
from cyclic_env.envs.cyclic_loop import CyclicLoopEnv
from cyclic_env.errors import UsageError
from cyclic_env.floor_plans import load_floor_plan
from cyclic_env.task.loop_closure import ELSEWHERE, NEAREST, RETURNS, TOO_SOON
from cyclic_env.task.trajectory_truth import closure_config_for, judge_trajectory, true_returns

THERE_AND_BACK = np.array([(0.25 * min(t, 160 - t), 0.0) for t in range(161)])
"""40 m along the x axis, and back."""


def test_trajectory_of_an_episode_is_judged_as_the_environment_judged_it():
    env = CyclicLoopEnv("ring", action_type="discrete", step_budget=900)
    env.reset(seed=0)
    done, info, revisit = False, {}, [False]
    while not done:
        drive = 1 if len(revisit) % 300 < 150 else 4
        _, _, terminated, truncated, info = env.step(np.array([drive, len(revisit) % 40 == 0]))
        revisit.append(info["revisit"])
        done = terminated or truncated
    claims = env.claims()
    for trajectory in (env.trajectory(), env.trajectory()[:, :2]):
        judged = judge_trajectory(env.floor_plan, trajectory, np.column_stack([claims["step"], claims["match"]]))
        np.testing.assert_array_equal(judged.revisit, revisit)
        np.testing.assert_array_equal(judged.claims, claims)
        for name in ("false_claims", "revisits", "revisits_recognised", "cycles_closed", "precision", "recall"):
            assert getattr(judged, name) == info[name]
        assert judged.claim_errors_m[-1] == info["claim_error_m"] or not info["claim_judged"]
    assert info["revisits"] > 0
    env.close()


def test_open_ground_has_no_walls_and_no_cycles():
    judged = judge_trajectory(None, THERE_AND_BACK, [(160, NEAREST)])
    assert judged.claims.tolist() == [(160, 0, True, False)]
    assert (judged.revisits, judged.recall, judged.cycles_total) == (1, 1.0, 0)


def test_scale_of_open_ground_does_not_matter():
    far = np.concatenate([[(-1e7, -1e7)], THERE_AND_BACK, [(1e7, 1e7)]])
    np.testing.assert_array_equal(
        judge_trajectory(None, far).revisit[82:-1], judge_trajectory(None, THERE_AND_BACK).revisit[81:]
    )


def test_true_returns_tells_returns_from_steps_too_early_and_behind_walls():
    plan = load_floor_plan("ring")
    x, y, _ = plan.start
    out = np.linspace(0, 13, 131)
    along, driven = np.concatenate([out, out[::-1]]), np.concatenate([out, 13 + out])  # there and back
    trajectory = np.column_stack([x + along, np.full_like(along, y), driven])
    trajectory[30, 1] += 2.5  # on the other side of the wall
    truth = true_returns(plan, trajectory, np.array([0, 20, 30, 240, 261]), ClosureConfig())
    assert truth[1, 0] == TOO_SOON
    assert truth[3].tolist() == [RETURNS, RETURNS, ELSEWHERE, ELSEWHERE, ELSEWHERE]
    assert truth[4].tolist() == [RETURNS, RETURNS, ELSEWHERE, TOO_SOON, ELSEWHERE]
    assert (truth[0] == ELSEWHERE).all()


def test_walls_that_a_trajectory_runs_into_block_no_sight():
    plan = load_floor_plan("ring")
    x, y, _ = plan.start
    out = np.linspace(0, 12, 121)
    way = np.column_stack([x + np.concatenate([out, out[::-1]]), np.full(242, y)])
    assert closure_config_for(plan, way) == ClosureConfig()
    way[121:, 1] = -2.05  # 0.85 m deep in the southern wall, which is at -1.2
    assert closure_config_for(plan, way) == ClosureConfig(sight_given=1.0, wall_tolerance=0.9)
    for tolerance, false_claims in ((0.0, 1), (0.9, 0)):
        judged = judge_trajectory(plan, way, [(241, 0)], ClosureConfig(wall_tolerance=tolerance))
        assert (judged.false_claims, judged.revisit[-1]) == (false_claims, not false_claims)
    way[:150, 1] -= 500.0
    with pytest.raises(UsageError, match="150 of 242 positions"):
        closure_config_for(plan, way)


def test_revisits_are_the_steps_with_a_true_return():
    returns = (true_returns(None, THERE_AND_BACK) == RETURNS).any(axis=1)
    np.testing.assert_array_equal(returns, judge_trajectory(None, THERE_AND_BACK).revisit)


@pytest.mark.parametrize(
    ("trajectory", "claims"),
    [
        ([1.0, 2.0], []),
        ([(0.0, np.nan)], []),
        ([(0, 0, 1), (1, 0, 0)], []),
        (THERE_AND_BACK, [(5, 6)]),
        (THERE_AND_BACK, [(5, 0), (5, 0)]),
        (THERE_AND_BACK, [(161, 0)]),
        (THERE_AND_BACK, [5, 0]),
        (THERE_AND_BACK, [(5.0, 0.0)]),
    ],
)
def test_trajectory_or_claims_of_another_form_are_refused(trajectory, claims):
    with pytest.raises(UsageError):
        judge_trajectory(None, trajectory, claims)

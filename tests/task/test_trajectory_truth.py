"""Whole trajectories: judged as the environment judges them, with a plan or on open ground, and pairs of steps."""

from __future__ import annotations

import numpy as np
import pytest

from cyclic_env.config import ClosureConfig
from cyclic_env.envs.cyclic_loop import CyclicLoopEnv
from cyclic_env.errors import UsageError
from cyclic_env.floor_plans import load_floor_plan
from cyclic_env.task.loop_closure import ELSEWHERE, NEAREST, RETURNS, TOO_SOON
from cyclic_env.task.trajectory_truth import judge_trajectory, true_returns

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

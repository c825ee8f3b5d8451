"""Privileged agents: their view of the truth, the oracle's route, and runs without a fault."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import shapely

from agents import make_agent, privileged_names
from agents.comparison import load_contestant
from agents.rivals.route import plan_route, resample, turning_points
from cyclic_env import TIERS, CyclicLoopEnv, CyclicLoopVectorEnv
from cyclic_env.evaluation.privileged import PrivilegedView
from cyclic_env.evaluation.rollout import rollout
from cyclic_env.floor_plans import FloorPlan
from tests.helpers import refused

PLANS = ("ring", "figure_eight", "twin_rings", "mirror_halls", "dead_ends", "office", "chamfered")


def run(name: str, map_name: Any, seeds: range = range(1), **settings: Any) -> list[dict[str, Any]]:
    env = CyclicLoopVectorEnv(1, map_name, autoreset_mode="SAME_STEP", **settings)
    records = list(rollout(make_agent(name, env), env, seeds))
    env.close()
    return records


@pytest.mark.parametrize("map_name", [*PLANS, "generated:hard_validation,index=3"])
def test_the_oracle_succeeds_by_about_the_closed_tour(map_name: str, tours: dict[str, float]) -> None:
    (record,) = run("oracle", map_name)
    assert record["is_success"]
    assert record["false_claims"] == 0
    assert record["recall"] == 1.0
    assert record["path_length_m"] < 1.15 * tours[map_name]


@pytest.fixture(scope="module")
def tours() -> dict[str, float]:
    """The closed tours of the plans, metres."""
    from cyclic_env import load_floor_plan

    return {name: load_floor_plan(name).closed_tour() for name in (*PLANS, "generated:hard_validation,index=3")}


@pytest.mark.slow
def test_the_oracle_drives_killian_court_by_the_closed_tour() -> None:
    (record,) = run("oracle", "killian_court")
    assert record["is_success"]
    assert record["path_length_m"] < 1.05 * 1436


def test_the_oracle_succeeds_from_anywhere_whatever_the_sensors_say() -> None:
    for record in run("oracle", "office", range(4), random_start=True, **TIERS["hard"].settings()):
        assert record["is_success"]
        assert record["false_claims"] == 0


def test_a_perfect_detector_makes_no_false_claim_and_misses_no_revisit() -> None:
    for record in run("perfect_detector", "figure_eight", range(1, 3), noise="typical"):
        assert record["is_success"]
        assert record["false_claims"] == 0
        assert record["recall"] == 1.0


def test_the_view_tells_a_robots_pose_and_the_step_that_it_returns_to() -> None:
    env = CyclicLoopEnv("ring")
    view, policy, state = PrivilegedView(env), make_agent("circling", env), None
    observation, info = env.reset(seed=0)
    returned = []
    for _ in range(500):
        action, state = policy.predict(observation, state)
        observation, *_, info = env.step(action)
        step = view.returned_step()
        assert (step is not None) == info["revisit"]
        assert view.pose() == pytest.approx([info["x"], info["y"], info["heading"]])
        if step is not None:
            track = env.trajectory()
            returned.append(np.hypot(*(track[-1, :2] - track[step, :2])))
            assert view.returned_step(within=0.9 * returned[-1]) is None
    assert returned
    assert max(returned) < 3.0
    assert view.steps() == 500


def test_a_survey_sees_what_an_episode_sees_and_changes_nothing_in_it() -> None:
    env = CyclicLoopEnv("figure_eight")
    _, info = env.reset(seed=0)
    view = PrivilegedView(env)
    survey = view.survey()
    assert survey.share == 0.0
    new = survey.look(view.pose()[None])
    assert survey.share == pytest.approx(info["coverage"])
    unseen = survey.unseen()
    assert new + len(unseen) == np.count_nonzero(env.seen_cells() >= 0)
    assert shapely.contains_xy(env.floor_plan.free_space, *unseen.T).all()
    assert env.seen_cells().max() == 1


def test_the_route_stays_where_the_robot_fits_and_ends_where_the_tour_began() -> None:
    env = CyclicLoopEnv("office")
    env.reset(seed=0)
    route = plan_route(PrivilegedView(env), 0)
    area = env.floor_plan.reachable(0.25)
    assert shapely.contains_xy(area.buffer(0.01), *route.T).all()
    assert np.hypot(*np.diff(route, axis=0).T).max() < 1.0
    assert np.hypot(*(route[-1] - route[0])) < 1.0


def test_a_way_turns_back_at_its_tips() -> None:
    way = resample(np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 1.0], [2.0, 0.0], [0.0, 0.0]]), 0.5)
    assert way[turning_points(way)].tolist() == [[2.0, 1.0]]


def test_privileged_agents_are_named_need_their_environment_and_a_plan_with_corridors() -> None:
    assert set(privileged_names()) == {"oracle", "perfect_detector"}
    for name in privileged_names():
        with refused("needs the environment to drive in"):
            make_agent(name)
        assert load_contestant(name, map_name="ring").policy.privileged  # pyright: ignore[reportAttributeAccessIssue]
    hall = FloorPlan("hall", shapely.box(0, 0, 30, 20), (2.0, 5.0, 0.0))
    with refused("no connected centrelines"):
        run("oracle", hall)

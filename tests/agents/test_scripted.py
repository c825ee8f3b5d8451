"""Agents by name: the shape of their calls; where the scripted ones drive, and what their claims are worth."""

from __future__ import annotations

import math
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial import cKDTree
from stable_baselines3.common.evaluation import evaluate_policy

from agents import agent_names, baseline_names, make_agent
from agents.rl.vec_env import CyclicLoopVecEnv
from agents.scripted import first_free_bearing, uniform, without_outliers
from cyclic_env import ConfigError, CyclicLoopEnv, CyclicLoopVectorEnv, FloorPlan, load_floor_plan
from cyclic_env.config import ACTION_TYPES, ActionType, ClosureConfig
from cyclic_env.evaluation.rollout import rollout

STEPS = 500
"""Of a short episode: a lap and a half of a block."""

DRIVES = tuple(name for name in baseline_names() if "+" not in name)
PLANS = ("ring", "grid", "dead_ends", "killian_court")


def drive(
    agent: str, map_name: str, steps: int, action_type: ActionType = "wheels", noise: str = "ideal"
) -> tuple[np.ndarray, dict]:
    """Return the true way `(t + 1, 3)` of an agent, and its last info."""
    env = CyclicLoopEnv(map_name, action_type=action_type, step_budget=steps, noise=noise)
    policy, state, ended = make_agent(agent, action_type=action_type), None, False
    observation, info = env.reset(seed=0)
    while not ended:
        action, state = policy.predict(observation, state)
        observation, _, terminated, truncated, info = env.step(action)
        ended = terminated or truncated
    way = env.trajectory()
    env.close()
    return way, info


def turns_around(way: np.ndarray, hole: np.ndarray) -> np.ndarray:
    """Return how often a way has gone round a point since its start, `(t + 1,)`, in turns."""
    return np.unwrap(np.arctan2(way[:, 1] - hole[1], way[:, 0] - hole[0])) / (2 * math.pi)


def cycles_gone_round(way: np.ndarray, plan: FloorPlan) -> int:
    """Return how many independent cycles a way goes round; any two of its steps that are near count as a return."""
    if not plan.cycles_total:
        return 0
    near = ClosureConfig().return_radius
    pairs = cKDTree(way[:, :2]).query_pairs(near, output_type="ndarray")
    pairs = np.sort(pairs, axis=1)
    pairs = pairs[way[pairs[:, 1], 2] - way[pairs[:, 0], 2] >= ClosureConfig().gap]
    windings = []
    for hole in plan.cycle_anchors:
        turns = turns_around(way, hole)
        angle = np.arctan2(way[:, 1] - hole[1], way[:, 0] - hole[0]) / (2 * math.pi)
        closing = angle[pairs[:, 0]] - angle[pairs[:, 1]]
        closing -= np.rint(closing)
        windings.append(np.rint(turns[pairs[:, 1]] - turns[pairs[:, 0]] + closing))
    vectors = np.unique(np.column_stack(windings), axis=0)
    return int(np.linalg.matrix_rank(vectors)) if len(vectors) else 0


@pytest.mark.parametrize("action_type", ACTION_TYPES)
@pytest.mark.parametrize("name", agent_names())
def test_actions_are_in_the_space_for_one_robot_and_for_many(name: str, action_type: ActionType) -> None:
    env = CyclicLoopVectorEnv(3, "ring", action_type=action_type, autoreset_mode="SAME_STEP")
    observation, _ = env.reset(seed=0)
    agent = make_agent(name, env, action_type=action_type)
    actions, state = agent.predict(observation, None, np.ones(3, bool))
    actions, state = agent.predict(observation, state, np.zeros(3, bool))
    assert env.action_space.contains(actions)
    single, single_state = agent.predict({key: value[0] for key, value in observation.items()})
    single, _ = agent.predict({key: value[0] for key, value in observation.items()}, single_state)
    assert env.single_action_space.contains(single)
    np.testing.assert_array_equal(single, actions[0])
    env.close()


@pytest.mark.parametrize("action_type", ACTION_TYPES)
def test_always_claiming_changes_nothing_but_the_claim(action_type: ActionType) -> None:
    env = CyclicLoopEnv("ring", action_type=action_type)
    observation, _ = env.reset(seed=0)
    for name in DRIVES:
        silent, _ = make_agent(name, action_type=action_type).predict(observation)
        claiming, _ = make_agent(f"{name}+claims", action_type=action_type).predict(observation)
        claim = 1 if action_type == "discrete" else 2
        assert silent[claim] <= 0 < claiming[claim]
        np.testing.assert_array_equal(np.delete(silent, claim), np.delete(claiming, claim))


def test_unknown_agents_and_action_types_are_told_the_nearest_name() -> None:
    with pytest.raises(ConfigError, match=r"unknown agent 'circlin'.*'circling'.*wall_hugging"):
        make_agent("circlin")
    with pytest.raises(ConfigError, match="wheels"):
        make_agent("random", action_type="wheel")  # pyright: ignore[reportArgumentType]


def test_agents_see_nothing_of_stable_baselines() -> None:
    code = "import sys, agents, agents.comparison; assert not {'torch', 'stable_baselines3'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True, cwd=Path(__file__).parents[2])


def test_random_numbers_are_uniform_and_alike_for_no_two_rows() -> None:
    numbers = np.array([[uniform(key, step) for key in range(2000)] for step in range(20)])
    assert numbers.min() >= -1
    assert numbers.max() < 1
    assert abs(numbers.mean()) < 0.01
    assert abs(numbers.var() - 1 / 3) < 0.01
    assert abs(np.corrcoef(numbers[0], numbers[1])[0, 1]) < 0.1


def test_a_single_wrong_range_is_dropped() -> None:
    laser = np.full(12, 5.0)
    laser[[0, 6]] = 0.1, 12.0
    np.testing.assert_array_equal(without_outliers(laser), np.full(12, 5.0))


@pytest.mark.parametrize(("wall", "gap", "low", "high"), [(np.sin, 0.45, -2, 2), (np.cos, 0.5, -100, -60)])
def test_beside_a_wall_the_first_free_bearing_is_ahead_and_before_one_to_the_right(
    wall: Any, gap: float, low: float, high: float
) -> None:
    towards = wall(np.arange(180) * math.radians(2))
    with np.errstate(divide="ignore"):
        laser = np.where(towards > 0, np.minimum(gap / towards, 12.0), 12.0)
    assert low <= math.degrees(first_free_bearing(laser, 0.45)) <= high


def test_hemmed_in_on_all_sides_it_turns_away_from_the_nearest_wall() -> None:
    laser = np.full(180, 0.4)
    laser[45] = 0.3
    assert first_free_bearing(laser, 0.45) == pytest.approx(-math.pi / 2)


@pytest.mark.parametrize(
    ("agent", "settings", "least", "most"),
    [
        *(("circling", {"action_type": action_type}, 0, 0) for action_type in ACTION_TYPES),
        *(("circling", {"noise": noise}, 0, 5) for noise in ("calibrated", "typical", "poor")),
        ("wall_hugging", {}, 11, 10**9),
    ],
)
def test_it_goes_round_the_block_and_wall_hugging_alone_leans_on_the_wall(
    agent: str, settings: dict[str, Any], least: int, most: int
) -> None:
    way, info = drive(agent, "ring", 700, **settings)
    (hole,) = load_floor_plan("ring").cycle_anchors
    assert abs(turns_around(way, hole)[-1]) > 1
    assert least <= info["collisions"] <= most


def test_circling_takes_one_block_of_many() -> None:
    way, info = drive("circling", "grid", 700)
    rounds = [abs(turns_around(way, hole)[-1]) > 1 for hole in load_floor_plan("grid").cycle_anchors]
    assert (sum(rounds), info["collisions"]) == (1, 0)


def test_to_and_fro_turns_back_at_both_walls_without_touching_them() -> None:
    way, info = drive("to_and_fro", "ring", STEPS)
    changes = np.count_nonzero(np.diff(np.sign(np.diff(way[:, 0]))))
    assert changes >= 4
    assert np.ptp(way[:, 0]) > 15
    assert info["collisions"] == 0


def test_spinning_and_standing_still_stay_where_they_are() -> None:
    for name in ("spinning", "standing_still"):
        way, _ = drive(name, "ring", 100)
        assert way[-1, 2] < 0.01


@pytest.mark.parametrize(
    ("map_name", "action_type"),
    [*((name, "wheels") for name in ("ring", "figure_eight", "grid", "twin_rings", "dead_ends")), ("ring", "discrete")],
)
def test_no_agent_closes_more_cycles_than_it_went_round(map_name: str, action_type: ActionType) -> None:
    plan = load_floor_plan(map_name)
    closed = {}
    for name in DRIVES:
        way, info = drive(f"{name}+claims", map_name, 800, action_type)
        closed[name] = info["cycles_closed"]
        assert closed[name] <= cycles_gone_round(way, plan), name
    assert closed["standing_still"] == closed["spinning"] == closed["to_and_fro"] == 0
    if map_name in ("ring", "figure_eight", "grid"):
        assert closed["circling"] == 1  # so that there is something to see


@pytest.fixture(scope="module")
def scores() -> dict[tuple[str, str], list[float]]:
    """Return the returns of every baseline on the `PLANS` in short episodes; the random ones have two."""
    returns = {}
    for map_name in PLANS:
        for name in baseline_names():
            count = 2 if name.startswith("random") else 1
            env = CyclicLoopVectorEnv(count, map_name, step_budget=STEPS, autoreset_mode="SAME_STEP")
            returns[map_name, name] = [record["return"] for record in rollout(make_agent(name), env, range(count))]
            env.close()
    return returns


@pytest.mark.parametrize("map_name", [name for name in PLANS if name != "dead_ends"])
def test_standing_still_is_nowhere_the_best_where_there_is_a_cycle(
    map_name: str, scores: dict[tuple[str, str], list[float]]
) -> None:
    best = max(np.mean(scores[map_name, name]) for name in baseline_names() if name != "standing_still")
    assert best > scores[map_name, "standing_still"][0]


@pytest.mark.parametrize("name", DRIVES)
@pytest.mark.parametrize("map_name", PLANS)
def test_always_claiming_never_pays(map_name: str, name: str, scores: dict[tuple[str, str], list[float]]) -> None:
    assert np.mean(scores[map_name, f"{name}+claims"]) <= np.mean(scores[map_name, name])


def test_evaluate_policy_of_stable_baselines_takes_scripted_agents() -> None:
    venv = CyclicLoopVecEnv(2, map_name="ring", step_budget=60)
    venv.seed(0)
    rewards, lengths = evaluate_policy(make_agent("circling"), venv, 4, return_episode_rewards=True, warn=False)
    assert len(rewards) == len(lengths) == 4  # pyright: ignore[reportArgumentType]
    assert np.ptp(rewards) == 0
    assert set(lengths) == {60}  # pyright: ignore[reportArgumentType]
    mean, _ = evaluate_policy(make_agent("spinning"), CyclicLoopEnv("ring", step_budget=30), 2, warn=False)  # pyright: ignore[reportArgumentType]
    assert np.isfinite(mean)

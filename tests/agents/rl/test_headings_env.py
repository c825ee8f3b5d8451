"""The task headings: spaces, masks, seeds, and that a row of a batch is a single environment."""

from __future__ import annotations

import copy
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

from agents.rl.headings.agent import HeadingsAgent, RandomHeadingsAgent
from agents.rl.headings.env import CyclicLoopHeadingsEnv, CyclicLoopHeadingsVectorEnv
from agents.rl.headings.memory import CANDIDATES, HEADINGS, HOLD, Rules
from agents.rl.headings.rules import HandRule
from cyclic_env import ActionError, ConfigError, CyclicLoopVectorEnv, UsageError
from cyclic_env.evaluation.rollout import evaluate

BUDGET = 33
"""Steps of an episode, which ends within a decision."""
MAKE = "agents.rl:CyclicLoopHeadings-v0"


def wandering(rows: int, decisions: int) -> np.ndarray:
    rng = np.random.default_rng(3)
    return np.stack([rng.integers(0, 3, (decisions, rows)), rng.integers(0, 4, (decisions, rows))], axis=-1)


def same(first: dict[str, np.ndarray], second: dict[str, np.ndarray]) -> bool:
    return all((first[name] == second[name]).all() for name in first)


def test_it_is_a_gymnasium_environment() -> None:
    env = gymnasium.make(MAKE, map_name="ring", noise="typical")
    check_env(env.unwrapped, skip_render_check=True)
    assert env.observation_space["headings"].shape == (16, 6)  # pyright: ignore[reportIndexIssue]
    assert env.unwrapped.action_masks().sum() == HEADINGS + 1  # pyright: ignore[reportAttributeAccessIssue]
    env.close()


def test_a_row_is_a_single_environment_and_its_last_features_are_the_true_ones() -> None:
    settings: dict[str, Any] = {"map_name": ["ring", "office"], "noise": "typical", "step_budget": BUDGET}
    rows = gymnasium.make_vec(MAKE, num_envs=3, **settings)
    singles = [CyclicLoopHeadingsEnv(**settings) for _ in range(3)]
    features, infos = rows.reset(seed=7)
    for row, env in enumerate(singles):
        single, info = env.reset(seed=7 + row)
        assert same(single, {name: value[row] for name, value in features.items()})
        assert info["x"] == infos["x"][row]
    ends = 0
    for actions in wandering(3, 3 * (BUDGET // HOLD + 1)):
        features, rewards, terminated, truncated, infos = rows.step(actions)
        for row, env in enumerate(singles):
            single, reward, ended, cut, info = env.step(actions[row])
            assert (reward, ended, cut) == (rewards[row], terminated[row], truncated[row])
            if cut:
                ends += 1
                assert info["steps"] == BUDGET % HOLD
                assert same(single, infos["final_obs"][row])
                assert info["path_length_m"] == infos["final_info"]["path_length_m"][row]
                assert info["reward_terms"]["time"] == infos["final_info"]["reward_terms"]["time"][row]
                single, info = env.reset()
            assert same(single, {name: value[row] for name, value in features.items()})
            assert info["x"] == infos["x"][row]
    assert ends == 9
    rows.close()


def test_seeds_repeat_an_episode_to_the_bit_and_a_copy_goes_on_as_the_original() -> None:
    env = CyclicLoopHeadingsVectorEnv(2, "office", noise="poor")
    runs = []
    for _ in range(2):
        env.reset(seed=4)
        runs.append([env.step(actions)[0] for actions in wandering(2, 12)])
    assert all(same(first, second) for first, second in zip(*runs, strict=True))
    other = copy.deepcopy(env)
    for actions in wandering(2, 10):
        assert same(env.step(actions)[0], other.step(actions)[0])
    env.close()
    other.close()


def test_rewards_and_terms_of_a_decision_are_those_of_its_steps() -> None:
    env = CyclicLoopHeadingsEnv("ring")
    env.reset(seed=0)
    total = 0.0
    for _ in range(20):
        _, reward, _, _, info = env.step([0, 0])
        assert reward == pytest.approx(sum(info["reward_terms"].values()))
        total += reward
    assert total == pytest.approx(env.rows.env.engine.outcome["episode_return"][0])
    env.close()


def test_what_is_masked_is_no_claim() -> None:
    env = CyclicLoopHeadingsEnv("ring")
    env.reset(seed=0)
    assert not env.action_masks()[HEADINGS + 1 :].any()
    claims = [env.step([0, CANDIDATES])[-1]["claims"] for _ in range(5)]
    assert claims == [0] * 5
    env.close()


def test_the_hand_rule_goes_round_a_ring_and_closes_it() -> None:
    env = CyclicLoopHeadingsEnv("ring", noise="typical")
    features, info = env.reset(seed=1)
    for _ in range(150):
        choices, _ = HandRule().predict(features)
        features, _, terminated, truncated, info = env.step(choices)
        if terminated or truncated:
            break
    assert info["cycles_closed"] == 1
    assert info["false_claims"] == 0
    env.close()


def test_random_choices_are_the_same_in_any_row_and_other_ones_in_the_next_episode() -> None:
    agent = RandomHeadingsAgent()
    settings: dict[str, Any] = {"map_name": "ring", "noise": "poor", "step_budget": 40}
    records = [
        evaluate(agent, seeds=range(5), action_type="twist", num_envs=count, **settings).episodes for count in (1, 3)
    ]
    assert records[0] == records[1]
    assert len({record["path_length_m"] for record in records[0]}) == 5


@pytest.mark.parametrize(
    "settings",
    [
        {"laser": {"num_beams": 36, "range_max": 5.0}},
        {"laser": {"num_beams": 361}},
        {"laser": {"mounting_angle": 1.5}},
        {"robot": {"radius": 0.4, "wheel_speed_max": 0.6}},
    ],
)
def test_any_laser_and_robot_will_do(settings: dict[str, Any]) -> None:
    env = CyclicLoopHeadingsVectorEnv(2, "ring", noise="typical", **settings)
    features, infos = env.reset(seed=0)
    for _ in range(30):
        features, *_, infos = env.step(HandRule().predict(features)[0])
        assert env.observation_space.contains(features)
    assert (infos["path_length_m"] > 0.5 * 30 * HOLD * env.env.config.robot.advance_max).all()
    env.close()


def test_rows_that_are_left_out_stay_as_they_are() -> None:
    env = CyclicLoopHeadingsVectorEnv(2, "ring", autoreset_mode="DISABLED")
    env.reset(seed=0)
    first, *_ = env.step([[0, 0], [0, 0]])
    second, rewards, *_ = env.step([[0, 0], [0, 0]], active=np.array([True, False]))
    assert rewards[1] == 0
    assert (first["robot"][1] == second["robot"][1]).all()
    assert (first["robot"][0] != second["robot"][0]).any()
    env.close()


@pytest.mark.parametrize("action", [[16, 0], [0, 4], [-1, 0], [0.5, 0.0], [0]])
def test_an_action_beyond_the_space_is_an_error(action: list[float]) -> None:
    env = CyclicLoopHeadingsEnv("ring")
    env.reset(seed=0)
    with pytest.raises(ActionError):
        env.step(action)
    env.close()


def test_misuse_is_an_error() -> None:
    with pytest.raises(ConfigError, match="action_type"):
        CyclicLoopHeadingsEnv("ring", action_type="wheels")
    with pytest.raises(ConfigError, match="field_of_view"):
        CyclicLoopHeadingsEnv("ring", laser={"field_of_view": 4.7})
    with pytest.raises(ConfigError, match="SAME_STEP"):
        CyclicLoopHeadingsVectorEnv(1, "ring", autoreset_mode=AutoresetMode.NEXT_STEP)
    env = CyclicLoopHeadingsEnv("ring", step_budget=3)
    env.reset(seed=0)
    env.step([0, 0])
    with pytest.raises(UsageError, match="ended"):
        env.step([0, 0])
    env.close()


def test_an_agent_refuses_observations_and_states_that_are_none() -> None:
    agent = HeadingsAgent(HandRule())
    observation = {"laser": np.full((2, 180), 3.0), "distance": np.zeros((2, 1)), "compass": np.ones((2, 2))}
    _, state = agent.predict(observation)
    for others in ({name: value[:1] for name, value in observation.items()}, observation):
        with pytest.raises(ConfigError, match="expected what the last predict returned"):
            agent.predict(others, state, np.zeros(3, np.bool_))
    with pytest.raises(ConfigError, match="no compass"):
        agent.predict({name: observation[name] for name in ("laser", "distance")})


def test_an_agent_of_it_drives_any_environment_as_the_task_does() -> None:
    settings: dict[str, Any] = {"map_name": "office", "noise": "calibrated", "step_budget": 73}
    task = CyclicLoopHeadingsVectorEnv(2, **settings)
    env = CyclicLoopVectorEnv(2, action_type="twist", autoreset_mode="SAME_STEP", **settings)
    features, _ = task.reset(seed=5)
    paths = []
    for _ in range(2 * (73 // HOLD + 1)):
        features, *_, infos = task.step(HandRule().predict(features)[0])
        if "final_info" in infos:
            paths.append(infos["final_info"]["path_length_m"])
    agent, state, begun, of_agent = HeadingsAgent(HandRule(), Rules()), None, np.ones(2, np.bool_), []
    observation, _ = env.reset(seed=5)
    for _ in range(2 * 73):
        actions, state = agent.predict(observation, state, begun)
        observation, _, terminated, truncated, infos = env.step(actions)
        begun = terminated | truncated
        if begun.any():
            of_agent.append(infos["final_info"]["path_length_m"])
    assert len(paths) == 2
    np.testing.assert_array_equal(paths, of_agent)
    task.close()
    env.close()

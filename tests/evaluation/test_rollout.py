"""Rollouts: one episode for each seed, the same in any batch."""

from __future__ import annotations

import json
import types
from typing import Any

import gymnasium
import numpy as np
import pytest

from agents import make_agent
from cyclic_env import ConfigError, CyclicLoopEnv, CyclicLoopVectorEnv
from cyclic_env.evaluation.rollout import evaluate, rollout
from cyclic_env.evaluation.statistics import Evaluation
from tests.helpers import refused

BUDGET = 120


@pytest.mark.parametrize("noise", ["ideal", "typical"])
@pytest.mark.parametrize("name", ["random", "circling+claims"])
def test_records_do_not_depend_on_the_batch(name: str, noise: str) -> None:
    settings: dict[str, Any] = {"seeds": range(3, 9), "map_name": "ring", "noise": noise, "step_budget": BUDGET}
    one = evaluate(make_agent(name), num_envs=1, **settings)
    four = evaluate(make_agent(name), num_envs=4, **settings)
    ten = evaluate(make_agent(name), num_envs=10, **settings)
    assert one == four == ten
    assert [episode["seed"] for episode in one.episodes] == list(range(3, 9))


def test_episodes_of_different_length_and_plan_do_not_depend_on_the_batch() -> None:
    settings: dict[str, Any] = {"map_name": ["ring", "grid"], "terminate_on_collision": True, "step_budget": 300}
    one = evaluate(make_agent("random"), seeds=range(7), num_envs=1, **settings)
    three = evaluate(make_agent("random"), seeds=range(7), num_envs=3, **settings)
    assert one == three
    assert len({episode["steps"] for episode in one.episodes}) > 1
    assert {episode["map"] for episode in one.episodes} == {"ring", "grid"}


def test_every_plan_of_a_pool_is_gone_through_in_turn() -> None:
    pool, settings = ["ring", "grid", "office"], {"noise": "typical", "step_budget": BUDGET}
    result = evaluate(make_agent("random"), seeds=[7, 0, 4, 3], map_name=pool, every_plan=True, **settings)
    assert [episode["map"] for episode in result.episodes] == ["grid", "ring", "grid", "ring"]
    assert result.map == "ring,grid,office"
    alone = evaluate(make_agent("random"), seeds=[7, 4], map_name="grid", **settings)
    assert [result.episodes[0], result.episodes[2]] == alone.episodes


def test_a_record_is_what_a_single_env_says() -> None:
    env = CyclicLoopEnv("ring", noise="calibrated", step_budget=BUDGET)
    agent = make_agent("to_and_fro+claims")
    observation, info = env.reset(seed=5)
    state, total, steps, ended = None, 0.0, 0, False
    terms = dict.fromkeys(info["reward_terms"], 0.0)
    while not ended:
        action, state = agent.predict(observation, state)
        observation, reward, terminated, truncated, info = env.step(action)
        total, steps, ended = total + reward, steps + 1, terminated or truncated
        terms = {name: value + info["reward_terms"][name] for name, value in terms.items()}
    (episode,) = evaluate(agent, seeds=[5], map_name="ring", noise="calibrated", step_budget=BUDGET).episodes
    del info["reward_terms"]
    wanted = {"seed": 5, "map": "ring", "return": total, "steps": steps, "terminated": False, "truncated": True}
    assert episode == wanted | info | {"reward_terms": terms}


def test_vector_env_of_single_envs_gives_the_same_records() -> None:
    def make() -> gymnasium.Env:
        return CyclicLoopEnv("ring", step_budget=BUDGET)

    single = gymnasium.vector.SyncVectorEnv([make, make], autoreset_mode=gymnasium.vector.AutoresetMode.SAME_STEP)
    native = CyclicLoopVectorEnv(2, "ring", step_budget=BUDGET, autoreset_mode="SAME_STEP")
    records = [list(rollout(make_agent("random+claims"), env, range(3))) for env in (single, native)]
    assert records[0] == records[1]
    single.close()
    native.close()


def test_policy_is_told_which_episodes_begin() -> None:
    class Listener:
        def __init__(self) -> None:
            self.starts: list[list[bool]] = []

        def predict(
            self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
        ) -> tuple[np.ndarray, Any]:
            self.starts.append(episode_start.tolist())
            assert state == (None if len(self.starts) == 1 else len(self.starts) - 1)
            return np.zeros((2, 4), np.float32), len(self.starts)

    listener = Listener()
    evaluate(listener, seeds=range(4), map_name="ring", num_envs=2, step_budget=3)
    assert listener.starts == [[True] * 2, [False] * 2, [False] * 2] * 2


@pytest.mark.parametrize(
    ("seeds", "message"),
    [
        ([], "at least one"),
        (5, r"seeds is 5; .*range\(10\)"),
        ([-1], "a seed is -1"),
        ([0, 1, 0], "twice"),
        (range(10**11), "limit is 1,000,000"),
    ],
)
def test_odd_seeds_are_refused_in_one_line(seeds: Any, message: str) -> None:
    with refused(message, ConfigError):
        evaluate(make_agent("random"), seeds=seeds, map_name="ring")


@pytest.mark.parametrize("answer", [None, np.zeros((2, 4)), (np.zeros((2, 4)),)])
def test_a_policy_that_returns_anything_but_actions_and_a_state_is_refused(answer: Any) -> None:
    policy: Any = types.SimpleNamespace(predict=lambda *_, **__: answer)
    with refused(r"expected a tuple \(actions, state\)", ConfigError):
        evaluate(policy, seeds=range(2), map_name="ring")


@pytest.mark.parametrize("policy", [None, object(), type(make_agent("random"))])
def test_what_is_no_policy_is_refused(policy: Any) -> None:
    with refused("expected an object with predict", ConfigError):
        evaluate(policy, seeds=[0], map_name="ring")


def test_what_is_no_vector_env_of_ours_is_refused() -> None:
    mode = gymnasium.vector.AutoresetMode.SAME_STEP
    cart_pole = gymnasium.vector.SyncVectorEnv([lambda: gymnasium.make("CartPole-v1")], autoreset_mode=mode)
    wrong_mode = CyclicLoopVectorEnv(1, "ring")
    for env in (None, CyclicLoopEnv("ring"), cart_pole, wrong_mode):
        with pytest.raises(ConfigError, match=r"expected a vector env"):
            next(rollout(make_agent("random"), env, [0]))  # pyright: ignore[reportArgumentType]
    cart_pole.close()
    wrong_mode.close()


def test_an_error_or_interrupt_leaves_the_episodes_that_have_ended() -> None:
    class Failing:
        calls = 0

        def predict(
            self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
        ) -> tuple[np.ndarray, Any]:
            self.calls += 1
            if self.calls > 25:
                raise KeyboardInterrupt
            return np.zeros((1, 4), np.float32), None

    seen: list[Evaluation] = []
    with pytest.raises(KeyboardInterrupt):
        evaluate(Failing(), seeds=range(5), map_name="ring", num_envs=1, step_budget=10, on_step=seen.append)
    assert len(seen) == 25
    assert not seen[-1].complete
    assert [episode["seed"] for episode in seen[-1].episodes] == [0, 1]


def test_random_starts_make_a_deterministic_agent_differ() -> None:
    settings: dict[str, Any] = {"seeds": range(3), "map_name": "ring", "step_budget": 60, "random_start": True}
    result = evaluate(make_agent("circling"), **settings)
    assert not result.identical_episodes
    entry = result.summary()["return"]
    assert entry["low"] < entry["mean"] < entry["high"]
    assert json.loads(json.dumps(result.to_json(), allow_nan=False))["episodes"] == result.episodes


def test_a_policy_that_acts_by_other_actions_than_the_environment_is_refused() -> None:
    with pytest.raises(ConfigError, match="'twist', but the environment has 'wheels'"):
        evaluate(make_agent("circling", action_type="twist"), map_name="ring", seeds=[0])

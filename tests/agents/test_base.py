"""From one robot's agent to a policy for a batch: shapes, memories, and what is refused."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest

import cyclic_env  # noqa: F401 (registers the ids)
from agents import make_agent
from agents.actions import FORWARD, STOP, TURN_LEFT, TURN_RIGHT, Decision, encode_action, match_of
from agents.base import Agent, BatchPolicy
from agents.knn.policy import KnnPolicy
from cyclic_env.errors import ConfigError

BEAMS = 180


class Counter(Agent):
    """Counts its steps by its speed."""

    def __init__(self) -> None:
        self.steps = 0

    def decide(self, scan: np.ndarray, distance: float, compass: np.ndarray) -> Decision:
        self.steps += 1
        return Decision(0.01 * self.steps, 0.0, claim=distance > 0.5, match=match_of(1, 4))


class CounterPolicy(BatchPolicy):
    """A counter for each robot."""

    def new_agent(self, beams: int, row: int, previous: Any = None) -> Counter:
        return Counter()


def of_two_robots() -> dict[str, np.ndarray]:
    """Return an observation of two robots that stand three metres from all walls and face east."""
    return {"laser": np.full((2, BEAMS), 3.0), "distance": np.zeros((2, 1)), "compass": np.array([[1.0, 0.0]] * 2)}


def test_each_robot_has_an_agent_that_decides_for_it() -> None:
    policy, observation = CounterPolicy(action_type="twist"), of_two_robots()
    observation["distance"][1] = 1.0
    _, state = policy.predict(observation)
    actions, state = policy.predict(observation, state, np.array([False, True]))
    np.testing.assert_allclose(actions, [[0.02, 0, -1, -0.5], [0.01, 0, 1, -0.5]])
    assert actions.dtype == np.float32
    single, _ = policy.predict({name: values[0] for name, values in observation.items()})
    np.testing.assert_allclose(single, [0.01, 0, -1, -0.5])


@pytest.mark.parametrize(
    ("decision", "action_type", "action"),
    [
        (Decision(1.0, 0.0), "wheels", (1, 1, -1, -1)),
        (Decision(0.0, 1.0, claim=True, match=0.5), "wheels", (-0.5, 0.5, 1, 0.5)),
        (Decision(1.0, 1.0), "wheels", (1 / 3, 1, -1, -1)),
        (Decision(0.5, -0.1, claim=True), "twist", (0.5, -0.1, 1, -1)),
        (Decision(0.5, 0.1), "discrete", (FORWARD, 0)),
        (Decision(0.5, 0.2, claim=True), "discrete", (TURN_LEFT, 1)),
        (Decision(0.0, -0.2), "discrete", (TURN_RIGHT, 0)),
        (Decision(0.0, 0.0), "discrete", (STOP, 0)),
    ],
)
def test_decisions_are_written_as_actions(decision: Decision, action_type: Any, action: tuple[float, ...]) -> None:
    assert encode_action(decision, action_type) == pytest.approx(action)


def test_an_episode_that_begins_is_begun_with_an_empty_memory() -> None:
    explorer = KnnPolicy()
    observation = of_two_robots()
    _, state = explorer.predict(observation)
    _, state = explorer.predict(observation, state, np.array([False, True]))
    assert [memory.steps for memory in state] == [2, 1]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"compass": None}, "no compass"),
        ({"laser": "far"}, "laser is not an array of numbers"),
        ({"laser": np.zeros((2, 3, 180))}, r"shapes \(2, 3, 180\)"),
        ({"distance": np.zeros((3, 1))}, r"\(3, 1\)"),
        ({"compass": np.full((2, 2), np.nan)}, "isn't finite"),
        ({"laser": np.ones((2, 11))}, "7 sectors need 12"),
        ({"distance": np.full((2, 1), 1e20)}, r"at most 100000 m"),
    ],
)
def test_an_observation_that_is_none_is_refused_with_what_is_expected(changes: dict[str, Any], message: str) -> None:
    observation = {name: value for name, value in {**of_two_robots(), **changes}.items() if value is not None}
    with pytest.raises(ConfigError, match=message):
        KnnPolicy().predict(observation)
    with pytest.raises(ConfigError, match="a dict with"):
        KnnPolicy().predict(np.zeros(180))


@pytest.mark.parametrize("name", ["knn", "random"])
def test_states_and_starts_that_do_not_fit_are_refused(name: str) -> None:
    policy, observation = make_agent(name), of_two_robots()
    _, state = policy.predict(observation)
    with pytest.raises(ConfigError, match="holds 2 agents, but the observation has 1 robots"):
        policy.predict({name: value[:1] for name, value in observation.items()}, state)
    with pytest.raises(ConfigError, match="3 entries"):
        policy.predict(observation, state, np.zeros(3, np.bool_))
    for bad in (5, "x", (1, 2)):
        with pytest.raises(ConfigError, match="expected what the last predict returned"):
            policy.predict(observation, bad)


def test_a_state_of_another_laser_is_refused() -> None:
    policy, observation = KnnPolicy(), of_two_robots()
    _, state = policy.predict(observation)
    with pytest.raises(ConfigError, match="180 beams, but the observation has 90"):
        policy.predict({**observation, "laser": observation["laser"][:, ::2]}, state)


@pytest.mark.parametrize("vector", [False, True])
def test_an_agent_made_for_an_environment_has_its_laser_robot_and_actions(vector: bool) -> None:
    settings: dict[str, Any] = {"laser": {"range_max": 8.0, "num_beams": 90}, "robot": {"radius": 0.3, "dt": 0.1}}
    make = gymnasium.make_vec if vector else gymnasium.make
    env = make("CyclicLoop-v0", map_name="ring", action_type="twist", **settings)
    agent = make_agent("knn", env)
    assert isinstance(agent, KnnPolicy)
    assert (agent.action_type, agent.config.range_max, agent.config.dt) == ("twist", 8.0, 0.1)
    assert agent.config.planner.half_width == pytest.approx(0.36)
    observation, _ = env.reset(seed=0)
    assert env.action_space.contains(agent.predict(observation)[0])
    env.close()

"""Evaluation: one episode a seed, the same in any batch, and honest intervals."""

from __future__ import annotations

import io
import json
import math
import subprocess
import sys
from typing import Any

import gymnasium
import numpy as np
import pytest

from agents import make_agent
from cyclic_env import ConfigError, CyclicLoopEnv, CyclicLoopVectorEnv
from cyclic_env.evaluation import (
    Evaluation,
    ProgressLine,
    evaluate,
    format_table,
    mean_interval,
    rollout,
    wilson_interval,
)

BUDGET = 120


def record(**changes: Any) -> dict[str, Any]:
    base = {"seed": 0, "cycles_closed": 1, "cycles_total": 2, "false_claims": 3, "return": 4.0, "coverage": 0.5}
    base |= {"is_success": False, "precision": 0.25, "recall": 1.0, "claims": 4, "revisits": 1}
    return base | {"collisions": 0, "path_length_m": 10.0, "steps": 50} | changes


def evaluation(*records: dict[str, Any], **changes: Any) -> Evaluation:
    settings: dict[str, Any] = {"agent": "someone", "map": "ring", "noise": "ideal", "episodes": list(records)}
    return Evaluation(**settings | changes)


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


def test_reward_terms_of_a_record_add_up_to_its_return() -> None:
    result = evaluate(make_agent("circling+claims"), seeds=range(2), map_name="ring")
    for episode in result.episodes:
        assert episode["is_success"]
        assert sum(episode["reward_terms"].values()) == pytest.approx(episode["return"])


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


def test_other_autoreset_modes_are_refused() -> None:
    env = CyclicLoopVectorEnv(1, "ring")
    with pytest.raises(ConfigError, match="SAME_STEP"):
        next(rollout(make_agent("random"), env, [0]))
    env.close()


def test_no_seeds_are_refused() -> None:
    with pytest.raises(ConfigError, match="at least one"):
        evaluate(make_agent("random"), seeds=[], map_name="ring")


def test_ctrl_c_keeps_the_episodes_that_are_done() -> None:
    class Interrupted:
        calls = 0

        def predict(
            self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
        ) -> tuple[np.ndarray, Any]:
            self.calls += 1
            if self.calls > 25:
                raise KeyboardInterrupt
            return np.zeros((1, 4), np.float32), None

    result = evaluate(Interrupted(), seeds=range(5), map_name="ring", num_envs=1, step_budget=10)
    assert not result.complete
    assert [episode["seed"] for episode in result.episodes] == [0, 1]
    assert "2 (cut short)" in format_table([result])


def test_mean_interval_is_students() -> None:
    low, high = mean_interval(np.array([1.0, 2.0, 3.0]))
    assert (low + high) / 2 == pytest.approx(2.0)
    assert (high - low) / 2 == pytest.approx(4.302653 / math.sqrt(3))  # t table, 2 degrees of freedom


def test_mean_interval_of_one_is_none() -> None:
    assert all(math.isnan(bound) for bound in mean_interval(np.array([1.0])))


def test_wilson_interval_of_a_published_example() -> None:
    low, high = wilson_interval(np.repeat([1.0, 0.0], [81, 182]))  # Newcombe 1998: 81 of 263
    assert low == pytest.approx(0.2553, abs=1e-4)
    assert high == pytest.approx(0.3662, abs=1e-4)


def test_wilson_interval_of_no_success_begins_at_nought() -> None:
    low, high = wilson_interval(np.zeros(10))
    assert low == 0.0
    assert high == pytest.approx(0.2775, abs=1e-4)


def test_intervals_stay_within_what_a_mean_can_be() -> None:
    entry = evaluation(record(coverage=0.1), record(coverage=1.0)).summary()["coverage"]
    assert entry == {"mean": pytest.approx(0.55), "low": 0.0, "high": 1.0}


def test_table_leads_with_cycles_closed_and_false_claims() -> None:
    table = format_table([evaluation(record(), record(**{"return": 8.0}))], markdown=True)
    header, rule, line = table.splitlines()
    columns = [cell.strip() for cell in header.strip("|").split("|")]
    assert columns[4:7] == ["cycles closed", "false claims", "return"]
    assert set(rule) <= set("|-: ")
    cells = [cell.strip() for cell in line.strip("|").split("|")]
    assert cells[3:7] == ["2", "1.0 of 2", "3.0", "6.0 [-19.4, 31.4]"]
    assert len({len(row) for row in table.splitlines()}) == 1


def test_columns_can_be_left_out() -> None:
    header, line = format_table([evaluation(record())], without=("map", "noise")).splitlines()
    assert "map" not in header
    assert line.split()[:2] == ["someone", "1"]


def test_json_holds_no_nan() -> None:
    text = json.dumps(evaluation(record()).to_json(), allow_nan=False)
    assert json.loads(text)["summary"]["return"] == {"mean": 4.0, "low": None, "high": None}


def test_real_records_can_be_written_as_json() -> None:
    result = evaluate(make_agent("random"), seeds=range(2), map_name="ring", step_budget=20)
    assert json.loads(json.dumps(result.to_json(), allow_nan=False))["episodes"] == result.episodes


def test_progress_is_drawn_on_a_terminal_only() -> None:
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    terminal, file = Terminal(), io.StringIO()
    for stream in (terminal, file):
        line = ProgressLine(stream)
        line.show("half done")
        line.show("a moment later")
        line.clear()
    assert "half done" in terminal.getvalue()
    assert "a moment later" not in terminal.getvalue()
    assert file.getvalue() == ""


def test_evaluation_needs_no_learning_library() -> None:
    code = "import sys, cyclic_env.evaluation; assert not {'torch', 'stable_baselines3', 'agents'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)

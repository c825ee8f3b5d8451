"""Evaluation: one episode a seed, the same in any batch, and honest intervals."""

from __future__ import annotations

import io
import itertools
import json
import math
import subprocess
import sys
import types
from typing import Any

import gymnasium
import numpy as np
import pytest
from cyclic_env.console import ProgressLine

from agents import make_agent
from cyclic_env import ConfigError, CyclicLoopEnv, CyclicLoopError, CyclicLoopVectorEnv
from cyclic_env.evaluation.rollout import (
    Evaluation,
    evaluate,
    format_table,
    mean_interval,
    pooled,
    rollout,
    table_notes,
    wilson_interval,
)

BUDGET = 120


def record(**changes: Any) -> dict[str, Any]:
    base = {"seed": 0, "cycles_closed": 1, "cycles_total": 2, "false_claims": 3, "return": 4.0, "coverage": 0.5}
    base |= {"is_success": False, "claims": 4, "revisits": 1, "revisits_recognised": 1}
    return base | {"collisions": 0, "path_length_m": 10.0, "steps": 50} | changes


def evaluation(*records: dict[str, Any], **changes: Any) -> Evaluation:
    settings: dict[str, Any] = {"agent": "someone", "map": "ring", "noise": "ideal", "action_type": "wheels"}
    return Evaluation(**settings | {"random_start": False, "episodes": list(records)} | changes)


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


@pytest.mark.parametrize(
    ("seeds", "message"),
    [
        ([], "at least one"),
        (5, r"seeds is 5; .*range\(10\)"),
        (None, "seeds is None"),
        ([None], "a seed is None"),
        ([-1], "a seed is -1"),
        ("12", "a seed is '1'"),
        ([0, 1, 0], "twice"),
        (range(10**11), "more than 1,000,000 seeds"),
        (itertools.count(), "more than 1,000,000 seeds"),
    ],
)
def test_odd_seeds_are_refused_in_one_line(seeds: Any, message: str) -> None:
    with pytest.raises(ConfigError, match=message) as raised:
        evaluate(make_agent("random"), seeds=seeds, map_name="ring")
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("answer", [None, np.zeros((2, 4)), (np.zeros((2, 4)),)])
def test_a_policy_that_returns_anything_but_actions_and_a_state_is_refused(answer: Any) -> None:
    policy: Any = types.SimpleNamespace(predict=lambda *_, **__: answer)
    with pytest.raises(ConfigError, match=r"expected a tuple \(actions, state\)") as raised:
        evaluate(policy, seeds=range(2), map_name="ring")
    assert "\n" not in str(raised.value)


def test_a_policy_that_returns_no_actions_is_refused() -> None:
    policy: Any = types.SimpleNamespace(predict=lambda *_, **__: (None, None))
    with pytest.raises(CyclicLoopError, match="action"):
        evaluate(policy, seeds=range(2), map_name="ring")


@pytest.mark.parametrize("policy", [None, object(), type(make_agent("random"))])
def test_what_is_no_policy_is_refused(policy: Any) -> None:
    with pytest.raises(ConfigError, match="expected an object with predict"):
        evaluate(policy, seeds=[0], map_name="ring")


def test_what_is_no_vector_env_is_refused() -> None:
    for env in (None, CyclicLoopEnv("ring")):
        with pytest.raises(ConfigError, match="expected a vector env"):
            next(rollout(make_agent("random"), env, [0]))  # pyright: ignore[reportArgumentType]


def test_an_env_of_another_kind_is_refused() -> None:
    mode = gymnasium.vector.AutoresetMode.SAME_STEP
    env = gymnasium.vector.SyncVectorEnv([lambda: gymnasium.make("CartPole-v1")], autoreset_mode=mode)
    with pytest.raises(ConfigError, match="expected one of CyclicLoop environments"):
        next(rollout(make_agent("random"), env, [0]))
    env.close()


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
    assert "2 alike (cut short)" in format_table([result])


def test_mean_interval_is_students() -> None:
    low, high = mean_interval(np.array([1.0, 2.0, 3.0]))
    assert (low + high) / 2 == pytest.approx(2.0)
    assert (high - low) / 2 == pytest.approx(4.302653 / math.sqrt(3))  # t table, 2 degrees of freedom


@pytest.mark.parametrize("values", [[], [1.0], [0.1, 0.1, 0.1]])
def test_mean_interval_of_one_value_is_none(values: list[float]) -> None:
    assert all(math.isnan(bound) for bound in mean_interval(np.array(values)))


def test_pooled_share_is_that_of_all_episodes_together() -> None:
    parts, wholes = np.array([1.0, 0.0, 3.0]), np.array([1.0, 0.0, 7.0])
    assert pooled(parts, wholes).mean() == pytest.approx(4 / 8)


def test_interval_of_a_pooled_share_is_that_of_a_ratio() -> None:
    parts, wholes = np.array([1.0, 2.0, 2.0, 5.0]), np.array([2.0, 3.0, 5.0, 6.0])
    low, high = mean_interval(pooled(parts, wholes))
    variance = ((parts - 10 / 16 * wholes) ** 2).sum() / 3 / 4 / 4**2  # Cochran 1977, 6.4: s^2 / (n x^2)
    assert (high - low) / 2 == pytest.approx(3.182446 * math.sqrt(variance), rel=1e-6)  # t table, 3 degrees of freedom


def test_equal_wholes_make_a_pooled_share_the_mean_of_shares() -> None:
    parts = np.array([1.0, 2.0, 4.0])
    np.testing.assert_allclose(pooled(parts, np.full(3, 4.0)), parts / 4)


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


def test_episodes_without_a_claim_add_nothing_to_precision_and_recall() -> None:
    silent = {"false_claims": 0, "revisits": 0, "revisits_recognised": 0, "precision": 1.0, "recall": 1.0}
    judged = {"false_claims": 3, "revisits": 2, "revisits_recognised": 1, "precision": 0.25, "recall": 0.5}
    summary = evaluation(record(**silent), record(**silent), record(**judged)).summary()
    assert summary["precision"]["mean"] == pytest.approx(0.25)
    assert summary["recall"]["mean"] == pytest.approx(0.5)


def test_table_has_a_dash_where_nothing_was_judged() -> None:
    silent = evaluation(record(false_claims=0, revisits=0, revisits_recognised=0))
    header, line = format_table([silent], markdown=True).splitlines()[::2]
    cells = dict(zip(header.replace(" ", "").split("|"), line.replace(" ", "").split("|"), strict=True))
    assert cells["precision"] == cells["recall"] == "-"
    assert json.loads(json.dumps(silent.to_json(), allow_nan=False))["summary"]["recall"]["mean"] is None


def test_episodes_that_are_alike_have_no_interval_and_the_table_says_so() -> None:
    result = evaluate(make_agent("circling"), seeds=range(3), map_name="ring", step_budget=60)
    assert result.alike
    assert all(math.isnan(entry["low"]) for entry in result.summary().values())
    assert "3 alike" in format_table([result])
    assert "[" not in format_table([result])
    assert table_notes([result])[0].startswith("alike: ")


def test_random_starts_make_a_deterministic_agent_differ() -> None:
    settings: dict[str, Any] = {"seeds": range(3), "map_name": "ring", "step_budget": 60, "random_start": True}
    result = evaluate(make_agent("circling"), **settings)
    assert not result.alike
    entry = result.summary()["return"]
    assert entry["low"] < entry["mean"] < entry["high"]
    assert " random " in format_table([result])


def test_one_episode_is_not_called_alike() -> None:
    assert not evaluation(record()).alike
    assert not evaluation().alike


def test_table_names_the_action_type_and_warns_of_discrete() -> None:
    table = format_table([evaluation(record()), evaluation(record(), action_type="discrete")])
    assert [line.split()[3] for line in table.splitlines()] == ["actions", "wheels", "discrete"]
    assert not any("discrete" in note for note in table_notes([evaluation(record())]))
    assert any("discrete" in note for note in table_notes([evaluation(record(), action_type="discrete")]))


def test_table_leads_with_cycles_closed_and_false_claims() -> None:
    table = format_table([evaluation(record(), record(**{"return": 8.0}))], markdown=True)
    header, rule, line = table.splitlines()
    columns = [cell.strip() for cell in header.strip("|").split("|")]
    assert columns[6:9] == ["cycles closed", "false claims", "return"]
    assert set(rule) <= set("|-: ")
    cells = [cell.strip() for cell in line.strip("|").split("|")]
    assert cells[5:9] == ["2", "1.0 of 2", "3.0", "6.0 [-19.4, 31.4]"]
    assert len({len(row) for row in table.splitlines()}) == 1


def test_columns_can_be_left_out() -> None:
    header, line = format_table([evaluation(record())], without=("map", "noise", "start")).splitlines()
    assert "map" not in header
    assert line.split()[:3] == ["someone", "wheels", "1"]


def test_json_holds_no_nan() -> None:
    text = json.dumps(evaluation(record()).to_json(), allow_nan=False)
    assert json.loads(text)["summary"]["return"] == {"mean": 4.0, "low": None, "high": None}


def test_real_records_can_be_written_as_json() -> None:
    result = evaluate(make_agent("random"), seeds=range(2), map_name="ring", step_budget=20)
    assert json.loads(json.dumps(result.to_json(), allow_nan=False))["episodes"] == result.episodes


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_progress_on_a_terminal_is_one_line_that_fits_and_goes_away(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "20")
    terminal = Terminal()
    line = ProgressLine(terminal)
    line.show("half of it is done by now")
    line.show("a moment later")
    line.clear()
    assert terminal.getvalue() == "\rhalf of it is done \r" + " " * 19 + "\r"


def test_progress_in_a_file_is_a_line_now_and_then(monkeypatch: pytest.MonkeyPatch) -> None:
    file, now = io.StringIO(), 0.0
    monkeypatch.setattr("time.monotonic", lambda: now)
    line = ProgressLine(file)
    for now in range(70):
        line.show(f"second {now}")
    line.clear()
    assert file.getvalue() == "second 30\nsecond 60\n"


def test_evaluation_needs_no_learning_library() -> None:
    code = "import sys, cyclic_env.evaluation; assert not {'torch', 'stable_baselines3', 'agents'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_a_policy_that_acts_by_other_actions_than_the_environment_is_refused() -> None:
    with pytest.raises(ConfigError, match="acts by 'twist', the environment by 'wheels'"):
        evaluate(make_agent("circling", action_type="twist"), map_name="ring", seeds=[0])

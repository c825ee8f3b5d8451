"""Many environments as Stable-Baselines3's `VecEnv`, and the features of scans."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from stable_baselines3.common.vec_env import SubprocVecEnv, VecMonitor

from agents import make_agent
from agents.rl.features import ScanFeatures
from agents.rl.vec_env import CyclicLoopVecEnv
from cyclic_env import CyclicLoopEnv, UsageError

BUDGET = 40


def wandering(count: int, steps: int) -> np.ndarray:
    return np.random.default_rng(1).uniform(-0.3, 1, (steps, count, 4)).astype(np.float32)


def test_rows_are_single_envs_and_the_terminal_observation_is_their_last() -> None:
    settings: dict[str, Any] = {"map_name": "ring", "noise": "typical", "step_budget": BUDGET}
    venv: Any = CyclicLoopVecEnv(3, **settings)
    singles = [CyclicLoopEnv(**settings) for _ in range(3)]
    venv.seed(7)
    observation = venv.reset()
    for row, env in enumerate(singles):
        first, info = env.reset(seed=7 + row)
        assert venv.reset_infos[row] == info
        assert all((observation[key][row] == first[key]).all() for key in first)
    returns = np.zeros(3)
    for step, actions in enumerate(wandering(3, 2 * BUDGET + 5), start=1):
        observation, rewards, dones, infos = venv.step(actions)
        assert rewards.dtype == np.float32
        for row, env in enumerate(singles):
            single, reward, terminated, truncated, info = env.step(actions[row])
            returns[row] += reward
            assert rewards[row] == np.float32(reward)
            assert dones[row] == (terminated or truncated) == (step % BUDGET == 0)
            if dones[row]:
                ended = infos[row]
                last = ended.pop("terminal_observation")
                assert all((last[key] == single[key]).all() for key in single)
                assert ended.pop("TimeLimit.truncated") is True
                episode = ended.pop("episode")
                assert (episode["r"], episode["l"]) == (pytest.approx(returns[row]), BUDGET)
                assert ended == info
                returns[row] = 0.0
                single, info = env.reset()
                assert venv.reset_infos[row] == info
            else:
                assert infos[row] == {}
            assert all((observation[key][row] == single[key]).all() for key in single)
    venv.close()


def test_success_is_no_time_limit() -> None:
    venv: Any = CyclicLoopVecEnv(1, map_name="ring", coverage={"complete": 0.2}, action_type="discrete")
    agent, state = make_agent("circling+claims", action_type="discrete"), None
    observation, done, infos, steps = venv.reset(), False, [{}], 0
    budget = venv.get_attr("step_budget")[0]
    while not done:
        actions, state = agent.predict(observation, state)
        observation, _, (done,), infos = venv.step(actions)
        steps += 1
    assert (infos[0]["is_success"], infos[0]["TimeLimit.truncated"]) == (True, False)
    assert steps < budget


def test_success_in_the_last_step_of_the_budget_is_no_time_limit() -> None:
    """A plan without cycles, nearly all of it seen after the first scans."""
    venv = CyclicLoopVecEnv(1, map_name="dead_ends", coverage={"complete": 0.01}, step_budget=1)
    venv.reset()
    _, _, dones, infos = venv.step(np.zeros((1, 4), np.float32))
    assert (dones[0], infos[0]["TimeLimit.truncated"]) == (True, False)


def test_seeds_repeat_an_episode_and_hold_for_one_reset() -> None:
    venv = CyclicLoopVecEnv(2, map_name="ring", noise="typical", random_start=True)
    seen = []
    for seed in (3, 3, None, 4):
        if seed is not None:
            venv.seed(seed)
        seen.append(venv.reset()["laser"])
    np.testing.assert_array_equal(seen[0], seen[1])
    assert (seen[1] != seen[2]).any()
    np.testing.assert_array_equal(seen[0][1], seen[3][0])  # row 1 of seed 3 is row 0 of seed 4
    venv.close()


def test_options_are_those_of_a_row_and_hold_for_one_reset() -> None:
    venv = CyclicLoopVecEnv(3, map_name="ring")
    venv.set_options([{}, {"start": (12.0, 14.0, 1.0)}, {}])
    venv.reset()
    assert [info["y"] for info in venv.reset_infos] == [0.0, 14.0, 0.0]
    venv.set_options({"start": (0.0, 7.0, 0.0)})
    venv.reset()
    assert [info["y"] for info in venv.reset_infos] == [7.0] * 3
    venv.reset()
    assert [info["y"] for info in venv.reset_infos] == [0.0] * 3
    venv.close()


def test_attributes_and_methods_are_those_of_the_rows() -> None:
    venv = CyclicLoopVecEnv(2, map_name="ring")
    venv.reset()
    venv.step(np.ones((2, 4), np.float32))
    single = CyclicLoopEnv("ring")
    single.reset()
    for name in ("action_space", "observation_space", "step_budget"):
        assert venv.get_attr(name) == [getattr(single, name)] * 2
    assert [plan.name for plan in venv.get_attr("floor_plan")] == ["ring", "ring"]
    assert [way.shape for way in venv.env_method("trajectory")] == [(2, 3)] * 2
    assert len(venv.env_method("seen_cells", indices=[0])) == 1
    assert venv.has_attr("seen_cells")
    assert not venv.has_attr("action_masks")
    assert venv.env_is_wrapped(gymnasium.Wrapper) == [False, False]
    first, second = venv.get_attr("np_random")
    assert first is not second
    venv.set_attr("note", "hello")
    assert venv.get_attr("note") == ["hello", "hello"]
    with pytest.raises(UsageError, match="rows share"):
        venv.set_attr("note", "you", indices=0)
    with pytest.raises(AttributeError, match="trajectory"):
        venv.env_method("fly")


def test_pictures_come_from_every_row() -> None:
    pytest.importorskip("pygame")
    venv: Any = CyclicLoopVecEnv(2, map_name="ring", render_mode="rgb_array")
    venv.reset()
    (height, width, _), second = (np.shape(image) for image in venv.get_images())
    assert (height, width, 3) == second
    tiled = np.shape(venv.render())
    assert tiled[1] >= 2 * width or tiled[0] >= 2 * height
    venv.close()


@pytest.mark.filterwarnings("ignore:The environment is already wrapped")
def test_vec_monitor_counts_the_same_episodes(tmp_path: Path) -> None:
    env = CyclicLoopVecEnv(2, map_name="ring", step_budget=BUDGET)
    venv = VecMonitor(env, str(tmp_path / "log"), info_keywords=("cycles_closed", "false_claims"))
    venv.seed(0)
    venv.reset()
    steps = [venv.step(actions) for actions in wandering(2, BUDGET)]
    total = np.sum([rewards for _, rewards, _, _ in steps], axis=0)
    for row, info in enumerate(steps[-1][3]):
        episode = info["episode"]
        assert (episode["r"], episode["l"]) == (pytest.approx(total[row], rel=1e-5), BUDGET)
        assert episode["cycles_closed"] == 0
    venv.close()
    assert len((tmp_path / "log.monitor.csv").read_text().splitlines()) == 4


def test_single_envs_run_in_processes_of_stable_baselines() -> None:
    make = partial(gymnasium.make, "cyclic_env:CyclicLoop-v0", map_name="ring", step_budget=5)
    theirs: Any = SubprocVecEnv([make, make], start_method="spawn")
    envs: list[Any] = [theirs, CyclicLoopVecEnv(2, map_name="ring", step_budget=5)]
    for env in envs:
        env.seed(0)
        env.reset()
    for actions in wandering(2, 6):
        results: list[Any] = [env.step(actions) for env in envs]
        (theirs, *numbers, infos), (ours, *our_numbers, our_infos) = results
        assert all((theirs[key] == ours[key]).all() for key in theirs)
        np.testing.assert_array_equal(np.array(numbers, np.float32), np.array(our_numbers, np.float32))
        truncated, ours_too = ([info.get("TimeLimit.truncated", False) for info in each] for each in (infos, our_infos))
        assert truncated == ours_too
    envs[0].close()


def test_features_are_all_about_as_large_as_one() -> None:
    env = CyclicLoopEnv("ring")
    features = ScanFeatures(env.observation_space)  # pyright: ignore[reportArgumentType]
    extremes = {key: torch.tensor(space.high)[None] for key, space in env.observation_space.items()}  # pyright: ignore
    values = features(extremes)
    assert values.shape == (1, features.features_dim) == (1, 183)
    assert values.max() <= 1
    assert features({key: -value for key, value in extremes.items()}).min() >= -1

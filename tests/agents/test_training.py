"""Learned agents: the contract of Stable-Baselines3's `VecEnv`, training, saving, and both command lines."""

from __future__ import annotations

import io
import json
import shutil
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import SubprocVecEnv, VecMonitor
from tqdm import tqdm

from agents import make_agent
from agents.rl.features import ScanFeatures
from agents.rl.settings import TrainingSettings
from agents.rl.storage import MODEL, PROGRESS, SETTINGS, load_trained
from agents.rl.training import train
from agents.rl.vec_env import CyclicLoopVecEnv
from cyclic_env import ConfigError, CyclicLoopEnv, UsageError
from cyclic_env.evaluation.rollout import evaluate

ROOT = Path(__file__).parents[2]
BUDGET = 40


def wandering(count: int, steps: int) -> np.ndarray:
    return np.random.default_rng(1).uniform(-0.3, 1, (steps, count, 4)).astype(np.float32)


# The VecEnv


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
    env = CyclicLoopEnv("ring", coverage={"complete": 0.2}, action_type="discrete")
    agent, state = make_agent("circling+claims", action_type="discrete"), None
    observation, done, infos, steps = venv.reset(), False, [{}], 0
    while not done:
        actions, state = agent.predict(observation, state)
        observation, _, dones, infos = venv.step(actions)
        done, steps = dones[0], steps + 1
    assert infos[0]["is_success"] is True
    assert infos[0]["TimeLimit.truncated"] is False
    env.reset()
    assert steps < env.step_budget
    venv.close()


def test_success_in_the_last_step_of_the_budget_is_no_time_limit() -> None:
    """A plan without cycles, nearly all of it seen after the first scans."""
    venv = CyclicLoopVecEnv(1, map_name="dead_ends", coverage={"complete": 0.01}, step_budget=1)
    venv.reset()
    _, _, dones, infos = venv.step(np.zeros((1, 4), np.float32))
    assert dones[0]
    assert infos[0]["TimeLimit.truncated"] is False
    venv.close()


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
    assert [plan.name for plan in venv.get_attr("floor_plan")] == ["ring", "ring"]
    assert venv.get_attr("step_budget", indices=1) == [1335]
    assert [way.shape for way in venv.env_method("trajectory")] == [(2, 3)] * 2
    assert len(venv.env_method("seen_cells", indices=[0])) == 1
    assert venv.has_attr("seen_cells")
    assert not venv.has_attr("action_masks")
    assert venv.env_is_wrapped(gymnasium.Wrapper) == [False, False]
    single = CyclicLoopEnv("ring")
    single.reset()
    assert venv.get_attr("action_space") == [single.action_space] * 2
    assert venv.get_attr("observation_space") == [single.observation_space] * 2
    first, second = venv.get_attr("np_random")
    assert isinstance(first, np.random.Generator)
    assert first is not second
    assert [claims.shape for claims in venv.env_method("claims")] == [claims.shape for claims in [single.claims()] * 2]
    venv.set_attr("note", "hello")
    assert venv.get_attr("note") == ["hello", "hello"]
    with pytest.raises(UsageError, match="rows share"):
        venv.set_attr("note", "you", indices=0)
    with pytest.raises(AttributeError, match="trajectory"):
        venv.env_method("fly")
    venv.close()


def test_pictures_come_from_every_row() -> None:
    pytest.importorskip("pygame")
    venv = CyclicLoopVecEnv(2, map_name="ring", render_mode="rgb_array")
    venv.reset()
    first, second = venv.get_images()
    assert first is not None
    assert second is not None
    assert first.shape == second.shape
    assert first.shape[2] == 3
    tiled = venv.render()
    assert tiled is not None
    assert tiled.shape[1] >= 2 * first.shape[1] or tiled.shape[0] >= 2 * first.shape[0]
    venv.close()


@pytest.mark.filterwarnings("ignore:The environment is already wrapped")
def test_vec_monitor_counts_the_same_episodes(tmp_path: Path) -> None:
    keys = ("cycles_closed", "false_claims")
    venv = VecMonitor(
        CyclicLoopVecEnv(2, map_name="ring", step_budget=BUDGET), str(tmp_path / "log"), info_keywords=keys
    )
    venv.seed(0)
    venv.reset()
    total = np.zeros(2)
    for actions in wandering(2, BUDGET):
        _, rewards, dones, infos = venv.step(actions)
        total += rewards
    assert dones.all()  # pyright: ignore[reportPossiblyUnboundVariable]
    for row in range(2):
        episode = infos[row]["episode"]  # pyright: ignore[reportPossiblyUnboundVariable]
        assert episode["r"] == pytest.approx(total[row], rel=1e-5)
        assert episode["l"] == BUDGET
        assert episode["cycles_closed"] == 0
    venv.close()
    assert len((tmp_path / "log.monitor.csv").read_text().splitlines()) == 4


@pytest.mark.parametrize("start_method", ["spawn", "forkserver"])
def test_single_envs_run_in_processes_of_stable_baselines(start_method: str) -> None:
    make = partial(gymnasium.make, "cyclic_env:CyclicLoop-v0", map_name="ring", step_budget=5)
    venv = SubprocVecEnv([make, make], start_method=start_method)
    ours = CyclicLoopVecEnv(2, map_name="ring", step_budget=5)
    for env in (venv, ours):
        env.seed(0)
        env.reset()
    for actions in wandering(2, 6):
        observation, rewards, dones, infos = venv.step(actions)
        ours_observation, ours_rewards, ours_dones, ours_infos = ours.step(actions)
        assert isinstance(observation, dict)
        assert isinstance(ours_observation, dict)
        assert all((observation[key] == ours_observation[key]).all() for key in observation)
        np.testing.assert_array_equal(np.float32(rewards), ours_rewards)
        np.testing.assert_array_equal(dones, ours_dones)
        assert [info.get("TimeLimit.truncated", False) for info in infos] == [
            info.get("TimeLimit.truncated", False) for info in ours_infos
        ]
    venv.close()
    ours.close()


def test_single_envs_run_in_processes_of_gymnasium() -> None:
    env = gymnasium.make_vec(
        "cyclic_env:CyclicLoop-v0", num_envs=2, vectorization_mode="async", map_name="ring", step_budget=5
    )
    env.reset(seed=0)
    *_, truncated, _ = [env.step(actions) for actions in wandering(2, 5)][-1]
    assert truncated.all()
    env.close()


def test_features_are_all_about_as_large_as_one() -> None:
    env = CyclicLoopEnv("ring")
    features = ScanFeatures(env.observation_space)  # pyright: ignore[reportArgumentType]
    extremes = {key: torch.tensor(space.high)[None] for key, space in env.observation_space.items()}  # pyright: ignore
    values = features(extremes)
    assert values.shape == (1, features.features_dim) == (1, 183)
    assert values.max() <= 1
    assert features({key: -value for key, value in extremes.items()}).min() >= -1


# Training


def test_training_writes_a_model_its_settings_and_its_episodes(run: Path) -> None:
    assert {MODEL, PROGRESS, SETTINGS} <= {path.name for path in run.iterdir()}
    settings = json.loads((run / SETTINGS).read_text())
    assert settings["algo"] == "ppo"
    assert settings["map_name"] == ["ring"]
    assert settings["steps"] >= 5000
    assert {"torch", "stable-baselines3", "gymnasium", "cyclic-loop"} <= set(settings["versions"])
    lines = (run / PROGRESS).read_text().splitlines()
    assert lines[0].startswith("steps,cycles_closed,false_claims,return,length")
    assert len(lines) == 1 + settings["steps"] // 16 // 200 * 16


@pytest.mark.parametrize(
    ("algo", "action_type"),
    [("ppo", "wheels"), ("ppo", "discrete"), ("a2c", "twist"), ("sac", "wheels"), ("td3", "twist")],
)
def test_training_changes_the_parameters_by_a_finite_loss(algo: str, action_type: Any, tmp_path: Path) -> None:
    settings = TrainingSettings(algo=algo, action_type=action_type, num_envs=4)
    train(settings, steps=1, out=tmp_path)
    before = {name: value.clone() for name, value in load_trained(tmp_path).model.policy.state_dict().items()}
    model = train(settings, steps=600 if algo == "ppo" else 200, out=tmp_path, resume=True)
    losses = {name: value for name, value in model.logger.name_to_value.items() if "loss" in name}
    assert losses
    assert all(np.isfinite(value) for value in losses.values())
    after = model.policy.state_dict()
    assert any((after[name] != before[name]).any() for name in after)
    assert all(torch.isfinite(value).all() for value in after.values())


def test_loaded_model_predicts_what_the_saved_one_did(tmp_path: Path) -> None:
    model = train(TrainingSettings(), steps=100, out=tmp_path)
    loaded = load_trained(tmp_path)
    venv = CyclicLoopVecEnv(4, map_name="ring", noise="typical")
    observation = venv.reset()
    np.testing.assert_array_equal(
        model.predict(observation, deterministic=True)[0], loaded.model.predict(observation, deterministic=True)[0]
    )
    assert loaded.settings == TrainingSettings()
    venv.close()


def test_same_seed_trains_the_same_model(tmp_path: Path) -> None:
    models = [
        train(TrainingSettings(seed=seed, num_envs=4), steps=600, out=tmp_path / name)
        for name, seed in (("first", 1), ("second", 1), ("third", 2))
    ]
    first, second, third = [torch.nn.utils.parameters_to_vector(model.policy.parameters()) for model in models]
    assert (first == second).all()
    assert (first != third).any()


def test_evaluate_policy_and_our_harness_agree_on_a_model(run: Path) -> None:
    model = load_trained(run).model
    venv = CyclicLoopVecEnv(1, map_name="ring", step_budget=100)
    venv.seed(0)
    mean, _ = evaluate_policy(model, venv, 2)
    ours = evaluate(model, seeds=[0], map_name="ring", step_budget=100)
    assert ours.episodes[0]["return"] == pytest.approx(mean, rel=1e-4)
    venv.close()


def test_checkpoints_are_written_on_the_way(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    saved = []
    real = PPO.save
    monkeypatch.setattr(
        PPO, "save", lambda self, *args, **kw: (saved.append(self.num_timesteps), real(self, *args, **kw))
    )
    train(TrainingSettings(num_envs=4), steps=1500, out=tmp_path, save_every=600)
    assert saved == [0, 1024, 1536]  # the first update after each multiple, and the end


@pytest.mark.parametrize(("algo", "end"), [("ppo", 512), ("a2c", 128), ("sac", 104)])
def test_training_shows_where_it_will_end_and_how_far_it_is(
    algo: str, end: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with tqdm(file=io.StringIO()) as progress:
        model = train(
            TrainingSettings(algo=algo, num_envs=4, step_budget=25), steps=101, out=tmp_path, progress=progress
        )
    assert model.num_timesteps == progress.n == progress.total == end
    assert "0.00 cycles, " in str(progress)
    said = capsys.readouterr().err
    assert f"until step {end}" in said
    assert "the first by step 100" in said


def test_a_pool_whose_plans_are_yet_to_be_drawn_can_be_trained_on(tmp_path: Path) -> None:
    settings = TrainingSettings(map_name=("generated:train",), num_envs=2, algo="a2c")
    with tqdm(file=io.StringIO()) as progress:
        train(settings, steps=1, out=tmp_path, progress=progress)


def test_a_resumed_training_forgets_the_episodes_behind_its_checkpoint(tmp_path: Path) -> None:
    settings = TrainingSettings(num_envs=4, step_budget=30, algo="a2c")
    train(settings, steps=256, out=tmp_path)
    before = (tmp_path / PROGRESS).read_text()
    with (tmp_path / PROGRESS).open("a") as file:
        file.write("300,0,0,1.5,30,0.2,0,False\n3")  # of steps that were lost, the last of them cut off
    train(settings, steps=512, out=tmp_path, resume=True)
    lines = (tmp_path / PROGRESS).read_text().splitlines()
    assert lines[: before.count("\n")] == before.splitlines()
    steps = [int(line.split(",")[0]) for line in lines[1:]]
    assert steps == sorted(steps)
    assert "300,0,0,1.5,30,0.2,0,False" not in lines


def test_episodes_are_in_the_file_as_soon_as_they_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen, learn = [], PPO.train

    def counting(self: PPO) -> None:
        seen.append(len((tmp_path / PROGRESS).read_text().splitlines()))
        learn(self)

    monkeypatch.setattr(PPO, "train", counting)
    train(TrainingSettings(num_envs=4, step_budget=100), steps=1024, out=tmp_path)
    assert seen == [1 + 4, 1 + 8]


@pytest.mark.parametrize("text", ["{}", "[]", "5", "hello", ""])
def test_malformed_settings_name_their_file(text: str, run: Path, tmp_path: Path) -> None:
    shutil.copytree(run, tmp_path, dirs_exist_ok=True)
    (tmp_path / SETTINGS).write_text(text)
    with pytest.raises(ConfigError, match=SETTINGS):
        load_trained(tmp_path)


def test_a_model_knows_its_settings_wherever_it_is(run: Path, tmp_path: Path) -> None:
    shutil.copy(run / MODEL, tmp_path / "mine.zip")
    assert load_trained(tmp_path / "mine.zip").settings == TrainingSettings(step_budget=200)

"""Training: what it learns, writes and resumes from."""

from __future__ import annotations

import io
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.evaluation import evaluate_policy
from tqdm import tqdm

from agents.rl.settings import TrainingSettings
from agents.rl.storage import MODEL, PROGRESS, SETTINGS, load_trained
from agents.rl.training import train
from agents.rl.vec_env import CyclicLoopVecEnv
from cyclic_env import ConfigError
from cyclic_env.evaluation.rollout import evaluate


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

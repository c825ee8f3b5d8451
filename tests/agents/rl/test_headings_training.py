"""Learned agents of the task headings: networks, hyperparameters, training, resuming, and scores."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from sb3_contrib import MaskablePPO

from agents.comparison import compare
from agents.rl.headings.memory import CANDIDATES, HEADINGS
from agents.rl.headings.vec_env import HeadingsVecEnv
from agents.rl.models import FOLDER, hyperparameter_file, new_model, read_hyperparameters
from agents.rl.settings import TrainingSettings, training_settings
from agents.rl.storage import BEST, MODEL, PROGRESS, VALIDATION, load_trained
from agents.rl.training import train
from agents.rl.validation import first_episodes
from cyclic_env import ConfigError

SMALL: dict[str, Any] = {"task": "headings", "algo": "maskable_ppo", "num_envs": 4, "step_budget": 120}
UPDATE = 4 * 48
"""Decisions of an update."""


@pytest.fixture(scope="module")
def model() -> MaskablePPO:
    env = HeadingsVecEnv(2, map_name="ring")
    hyperparameters = read_hyperparameters(hyperparameter_file("headings", "maskable_ppo"), "maskable_ppo")
    made = new_model("maskable_ppo", hyperparameters, env, 0, discrete=True)
    env.close()
    assert isinstance(made, MaskablePPO)
    return made


def logits(model: MaskablePPO, features: dict[str, torch.Tensor]) -> torch.Tensor:
    policy: Any = model.policy
    return policy.mlp_extractor.forward_actor(policy.extract_features(features))


def test_candidates_share_a_network(model: MaskablePPO) -> None:
    torch.manual_seed(0)
    features = {name: torch.rand(3, *space.shape) for name, space in model.observation_space.items()}  # pyright: ignore
    order = [2, 0, 1]
    swapped = {**features, "candidates": features["candidates"][:, order]}
    first, second = logits(model, features), logits(model, swapped)
    assert first.shape == (3, HEADINGS + 1 + CANDIDATES)
    torch.testing.assert_close(second[:, HEADINGS + 1 :], first[:, HEADINGS + 1 :][:, order])
    torch.testing.assert_close(second[:, : HEADINGS + 1], first[:, : HEADINGS + 1])


def test_an_untrained_model_drives_straight_on_and_claims_nothing_that_is_masked(model: MaskablePPO) -> None:
    features = {name: np.zeros((5, *space.shape), np.float32) for name, space in model.observation_space.items()}  # pyright: ignore
    masks = np.ones((5, HEADINGS + 1 + CANDIDATES), np.bool_)
    masks[:, HEADINGS + 1 :] = False
    choices, _ = model.predict(features, deterministic=True, action_masks=masks)
    assert (choices == 0).all()
    drawn = [model.predict(features, action_masks=masks)[0] for _ in range(20)]
    assert (np.array(drawn)[..., 1] == 0).all()


def test_rewards_are_scaled_and_returns_are_not() -> None:
    envs = [HeadingsVecEnv(1, map_name="ring", reward_scale=scale, step_budget=12) for scale in (1.0, 0.1)]
    results = []
    for env in envs:
        env.seed(1)
        env.reset()
        results.append([env.step(np.zeros((1, 2), np.int64)) for _ in range(3)])
        env.close()
    for (_, plain, done, infos), (_, scaled, _, others) in zip(*results, strict=True):
        assert scaled[0] == pytest.approx(0.1 * plain[0])
        if done[0]:
            assert infos[0]["episode"]["r"] == others[0]["episode"]["r"]
            assert infos[0]["episode"]["l"] == 12
            assert sum(infos[0]["episode"]["terms"].values()) == pytest.approx(infos[0]["episode"]["r"])
            assert infos[0]["TimeLimit.truncated"]


def curve(out: Path, name: str = PROGRESS) -> str:
    return (out / name).read_text()


def weights(out: Path) -> list[torch.Tensor]:
    return list(load_trained(out / MODEL).model.policy.parameters())


def test_two_runs_of_one_seed_are_equal_and_so_is_one_that_was_stopped_and_resumed(tmp_path: Path) -> None:
    settings = TrainingSettings(**SMALL, noise=("typical", "poor"), validation_map=("ring",), validation_envs=2)
    whole, again, parts = tmp_path / "whole", tmp_path / "again", tmp_path / "parts"
    for out in (whole, again):
        train(settings, steps=4 * UPDATE, out=out, save_every=2 * UPDATE)
    train(settings, steps=2 * UPDATE, out=parts, save_every=2 * UPDATE)
    train(settings, steps=4 * UPDATE, out=parts, save_every=2 * UPDATE, resume=True)
    assert len(curve(whole).splitlines()) > 4
    for out in (again, parts):
        assert curve(out) == curve(whole)
        assert curve(out, VALIDATION) == curve(whole, VALIDATION)
        assert all(torch.equal(a, b) for a, b in zip(weights(out), weights(whole), strict=True))
    assert len(curve(whole, VALIDATION).splitlines()) == 3


def test_the_folder_of_a_run_stands_for_the_model_that_scored_best(tmp_path: Path) -> None:
    settings = TrainingSettings(**SMALL, validation_map=("ring",), validation_envs=2)
    train(settings, steps=UPDATE, out=tmp_path)
    trained = load_trained(tmp_path)
    assert (tmp_path / BEST).stat().st_size < 500_000
    assert trained.settings == settings
    assert isinstance(trained.model, MaskablePPO)
    (evaluation,) = compare([str(tmp_path)], seeds=[3], step_budget=60, noise="typical")
    assert evaluation.action_type == "twist"
    assert evaluation.map == "ring"
    assert evaluation.episodes[0]["steps"] == 60
    first, second = (first_episodes(trained.model, settings.make_validation_env(), 3) for _ in range(2))
    assert first == second
    assert [record["steps"] > 0 for record in first] == [True, True]


def test_a_flat_network_learns_too(tmp_path: Path) -> None:
    settings = TrainingSettings(**{**SMALL, "algo": "ppo"}, validation_map=("ring",), validation_envs=2)
    model = train(settings, steps=UPDATE, out=tmp_path)
    assert model.num_timesteps == UPDATE


def test_shipped_hyperparameters_are_sound_and_stored_with_the_model(tmp_path: Path) -> None:
    for path in FOLDER.glob("*.yaml"):
        algo = path.stem.removeprefix("headings_").removeprefix("cyclic_loop_")
        assert 0.9 < read_hyperparameters(path, algo)["gamma"] < 1
    mine = tmp_path / "mine.yaml"
    shipped = hyperparameter_file("headings", "maskable_ppo").read_text()
    mine.write_text(shipped.replace("gamma: 0.99 ", "gamma: 0.98 "))
    settings = training_settings({"task": "headings", "hyperparameters": str(mine)})
    assert settings.hyperparameters["gamma"] == 0.98
    assert settings.noise == ("calibrated", "typical", "poor")
    assert settings.validation_map == ("generated:validation",)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("policy: shared\nnum_envs: 4\nreward_scale: 1.0\n", "lacks gamma"),
        ("policy: shared\nnum_envs: 4\nreward_scale: 1.0\ngama: 0.9\ngamma: 0.9\n", "'gamma'"),
        ("policy: sharde\nnum_envs: 4\nreward_scale: 1.0\ngamma: 0.9\n", "'shared'"),
        ("- 1\n", "holds no hyperparameters"),
        ("{", "YAML"),
    ],
)
def test_bad_hyperparameters_are_one_clear_line(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "bad.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=message) as caught:
        read_hyperparameters(path, "maskable_ppo")
    assert "\n" not in str(caught.value)


def test_an_algorithm_that_does_not_learn_the_task_or_does_not_mask_is_refused() -> None:
    with pytest.raises(ConfigError, match="ppo masks no choices"):
        read_hyperparameters(hyperparameter_file("headings", "maskable_ppo"), "ppo")
    with pytest.raises(ConfigError, match="maskable_ppo"):
        TrainingSettings(task="headings", algo="sac")


def test_scores_of_raw_models_are_of_one_episode_a_row_too(tmp_path: Path) -> None:
    settings = TrainingSettings(num_envs=2, step_budget=30, validation_map=("ring",), validation_envs=2)
    train(settings, steps=256, out=tmp_path)
    assert curve(tmp_path, VALIDATION).splitlines()[1].startswith("256,2,")


@pytest.mark.slow
def test_half_a_million_decisions_close_most_cycles_of_unseen_buildings(tmp_path: Path) -> None:
    """Takes ten minutes on two cores."""
    settings = training_settings({"task": "headings", "noise": "calibrated"})
    train(settings, steps=500_000, out=tmp_path)
    records = first_episodes(load_trained(tmp_path).model, settings.make_validation_env(), 1)
    closed, total, false = (
        sum(record[name] for record in records) for name in ("cycles_closed", "cycles_total", "false_claims")
    )
    assert closed > 0.8 * total
    assert false < 0.5 * len(records)

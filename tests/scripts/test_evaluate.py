"""The command that evaluates: what it prints and writes, one line for bad input, and nothing lost by Ctrl-C."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from stable_baselines3 import PPO

from agents.rl.settings import TrainingSettings
from agents.rl.storage import MODEL
from agents.rl.training import train
from agents.rl.vec_env import CyclicLoopVecEnv
from tests.helpers import load_script
from tests.scripts.conftest import Refused

evaluate_main = load_script("evaluate").main


def test_evaluate_scores_a_model_and_an_agent_by_name(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "new" / "scores.json"
    arguments = [str(run), str(run / MODEL), "circling", "--seeds", "2:4", "--step-budget", "50", "--json", str(file)]
    assert evaluate_main(arguments) == 0
    table = capsys.readouterr().out.split("\n\n")[0].splitlines()
    assert len(table) == 4
    assert all("ring" in line for line in table[1:])  # the model's own map
    folder, model, circling = json.loads(file.read_text())["evaluations"]
    assert folder["episodes"] == model["episodes"]
    assert [episode["seed"] for episode in circling["episodes"]] == [2, 3]


def test_evaluate_takes_a_model_that_came_without_settings(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    venv = CyclicLoopVecEnv(2, map_name="ring")
    PPO("MultiInputPolicy", venv, n_steps=8, batch_size=16).save(tmp_path / "own.zip")
    assert evaluate_main([str(tmp_path / "own.zip"), "--map", "ring", "--episodes", "1", "--step-budget", "5"]) == 0
    assert "own.zip" in capsys.readouterr().out


def test_evaluate_marks_privileged_agents(capsys: pytest.CaptureFixture[str]) -> None:
    assert evaluate_main(["oracle", "circling", "--map", "ring", "--episodes", "2", "--random-start"]) == 0
    _, oracle, circling, *_ = capsys.readouterr().out.splitlines()
    assert oracle.startswith("oracle (privileged)")
    assert " 1.0 of 1 " in oracle
    assert circling.startswith("circling ")


def test_evaluate_draws_random_starts(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "scores.json"
    arguments = ["standing_still", "--map", "ring", "--episodes", "3", "--step-budget", "5", "--json", str(file)]
    assert evaluate_main(arguments) == 0
    assert "3 identical" in capsys.readouterr().out
    assert evaluate_main([*arguments, "--random-start"]) == 0
    assert "identical" not in capsys.readouterr().out
    (entry,) = json.loads(file.read_text())["evaluations"]
    assert entry["random_start"]
    assert len({episode["x"] for episode in entry["episodes"]}) == 3


def test_ctrl_c_in_evaluate_keeps_the_agents_that_are_done(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(self: Any, scan: np.ndarray) -> tuple[float, float]:
        raise KeyboardInterrupt

    monkeypatch.setattr("agents.scripted.SpinningAgent.drive", interrupted)
    file = tmp_path / "scores.json"
    rest = ["--map", "ring", "--episodes", "2", "--step-budget", "5", "--json", str(file)]
    assert evaluate_main(["spinning", *rest]) == 130
    said = capsys.readouterr()
    assert said.err.count("\n") == 1
    assert not file.exists()
    assert evaluate_main(["standing_still", "spinning", "random", *rest]) == 130
    said = capsys.readouterr()
    assert said.err == f"evaluate.py: stopped; the 2 episodes that had ended are above and in {file}.\n"
    assert "standing_still" in said.out
    assert [entry["agent"] for entry in json.loads(file.read_text())["evaluations"]] == ["standing_still"]


def test_evaluate_prints_a_table_for_each_plan_of_a_document(capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--all-baselines", "--map", "ring,grid", "--episodes", "1", "--step-budget", "2", "--markdown"]
    assert evaluate_main(arguments) == 0
    text = capsys.readouterr().out
    assert text.count("### ") == 2
    assert text.count("| circling+claims") == 2


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "name at least one agent"),
        (["cirling"], "Did you mean 'circling'?"),
        (["nowhere.zip"], "there is no model file"),
        (["random", "--map", "grit"], "Did you mean 'grid'?"),
        (["random", "--map", ""], "map"),
        (["random", "--noise", "loud"], "unknown noise preset"),
        (["random", "--seeds", "5"], "expected A:B"),
        (["random", "--episodes", "99999999999"], "limit is 1,000,000"),
        (["random", "--json", "tests"], "can't write to tests"),
        (["random", "--seeds", "0:2", "--episodes", "2"], "not both"),
    ],
)
def test_evaluate_says_in_one_line_what_is_wrong(arguments: list[str], message: str, refused: Refused) -> None:
    assert message in refused(evaluate_main, arguments)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        (".", "no model file"),
        ("text.zip", "no model of Stable-Baselines3"),
        ("corrupt.zip", "no model of Stable-Baselines3"),
        ("{}", "unknown algorithm"),
        ('{"clip_range": 1}', "can't be loaded"),
    ],
)
def test_evaluate_refuses_files_that_are_no_models(
    name: str, message: str, run: Path, tmp_path: Path, refused: Refused
) -> None:
    model = (run / MODEL).read_bytes()
    (tmp_path / "text.zip").write_text("hello")
    (tmp_path / "truncated.zip").write_bytes(model[: len(model) // 2])
    (tmp_path / "corrupt.zip").write_bytes(model[:200] + bytes(200) + model[400:])
    path = tmp_path / name
    if not path.exists():
        path = tmp_path / "data.zip"
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("data", name)
    assert message in refused(evaluate_main, [path])


def test_evaluate_refuses_a_model_that_does_not_fit(run: Path, tmp_path: Path, refused: Refused) -> None:
    PPO("MlpPolicy", gymnasium.make("CartPole-v1")).save(tmp_path / "cart.zip")
    blind = CyclicLoopVecEnv(1, map_name="ring", laser={"num_beams": 36})
    PPO("MultiInputPolicy", blind, n_steps=8, batch_size=8).save(tmp_path / "blind.zip")
    assert "does not fit the environment" in refused(evaluate_main, [tmp_path / "cart.zip"])
    assert "observations" in refused(evaluate_main, [tmp_path / "blind.zip"])
    assert "trained with action type 'wheels'" in refused(evaluate_main, [run, "--action-type", "twist"])


def test_models_of_different_maps_need_a_map(run: Path, tmp_path: Path, refused: Refused) -> None:
    train(TrainingSettings(map_name=("grid",), num_envs=2), steps=1, out=tmp_path)
    assert "say with --map" in refused(evaluate_main, [run, tmp_path])

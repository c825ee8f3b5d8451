"""The command lines: what they print and write, one line for bad input, and nothing lost by Ctrl-C."""

from __future__ import annotations

import json
import math
import shutil
import sys
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from stable_baselines3 import PPO

from agents.rl.settings import TrainingSettings
from agents.rl.storage import MODEL, PROGRESS, SETTINGS, load_trained
from agents.rl.training import train
from agents.rl.vec_env import CyclicLoopVecEnv
from cyclic_env import ConfigError
from tests.helpers import load_script

benchmark = load_script("benchmark")
evaluate_main = load_script("evaluate").main
train_main = load_script("train").main


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


def test_evaluate_shows_that_a_model_has_discrete_actions(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    train(TrainingSettings(action_type="discrete", num_envs=2), steps=1, out=tmp_path)
    assert evaluate_main([str(tmp_path), "random", "--episodes", "1", "--step-budget", "5"]) == 0
    table, notes = capsys.readouterr().out.split("\n\n")
    assert [line.split()[3] for line in table.splitlines()] == ["actions", "discrete", "wheels"]
    assert "discrete: the environment itself fills in the match" in notes


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


def test_ctrl_c_saves_and_resuming_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["--num-envs", "4", "--out", str(tmp_path), "--steps", "1500"]
    calls = 0
    step_wait = CyclicLoopVecEnv.step_wait

    def interrupted(self: CyclicLoopVecEnv) -> Any:
        nonlocal calls
        calls += 1
        if calls == 200:
            raise KeyboardInterrupt
        return step_wait(self)

    with monkeypatch.context() as patch:
        patch.setattr(CyclicLoopVecEnv, "step_wait", interrupted)
        assert train_main(arguments) == 130
    (said,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("train.py")]
    assert f"--out {tmp_path} --resume --steps 1500" in said
    assert json.loads((tmp_path / SETTINGS).read_text())["steps"] == 796
    assert train_main([*said.split("scripts/train.py ")[1].split()]) == 0
    assert json.loads((tmp_path / SETTINGS).read_text())["steps"] >= 1500
    assert load_trained(tmp_path).model.num_timesteps >= 1500


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
        (["--algo", "pppo"], "Did you mean 'ppo'?"),
        (["--map", "rin"], "Did you mean 'ring'?"),
        (["--noise", "tipical"], "Did you mean 'typical'?"),
        (["--action-type", "wheel"], "Did you mean 'wheels'?"),
        (["--steps", "0"], "steps is 0"),
        (["--steps", "-5"], "steps is -5"),
        (["--num-envs", "0"], "num_envs is 0"),
        (["--seed", "-1"], "seed is -1"),
        (["--step-budget", "0"], "step_budget is 0"),
        (["--algo", "sac", "--action-type", "discrete"], "takes no discrete actions"),
        (["--resume"], "to resume from"),
    ],
)
def test_train_says_in_one_line_what_is_wrong(
    arguments: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert train_main([*arguments, "--out", str(tmp_path)]) == 2
    said = capsys.readouterr().err
    assert message in said
    assert said.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_train_refuses_an_output_that_is_no_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").write_text("")
    assert train_main(["--out", str(tmp_path / "file" / "model")]) == 2
    assert "can't write to" in capsys.readouterr().err


def test_train_keeps_a_model_that_is_there(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = (run / MODEL).read_bytes()
    assert train_main(["--out", str(run), "--step-budget", "200"]) == 2
    assert "--overwrite" in capsys.readouterr().err
    assert train_main(["--out", str(run), "--resume", "--steps", "10"]) == 2
    assert "trained for" in capsys.readouterr().err
    assert train_main(["--out", str(run), "--resume", "--noise", "poor"]) == 2
    assert "begun with noise 'ideal'" in capsys.readouterr().err
    assert (run / MODEL).read_bytes() == before


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "name at least one agent"),
        (["circling", "--all-baselines"], "name at least one agent"),
        (["cirling"], "Did you mean 'circling'?"),
        (["nowhere.zip"], "there is no model file"),
        (["x" * 300], "File name too long"),
        (["random", "--map", "grit"], "Did you mean 'grid'?"),
        (["random", "--map", ""], "map"),
        (["random", "--noise", "loud"], "unknown noise preset"),
        (["random", "--action-type", "legs"], "unknown action type"),
        (["random", "--seeds", "5"], "expected A:B"),
        (["random", "--seeds", "5:5"], "give at least one"),
        (["random", "--seeds", "0:" + 5000 * "9"], "expected A:B"),
        (["random", "--seeds=-1:3"], "expected A:B"),
        (["random", "--episodes", "0"], "give at least one"),
        (["random", "--episodes", "99999999999"], "more than 1,000,000 seeds"),
        (["random", "--json", "tests"], "can't write to tests"),
        (["random", "--seeds", "0:2", "--episodes", "2"], "not both"),
        (["random", "--map", "ring", "--step-budget", "0"], "step_budget is 0"),
        (["random", "--map", "ring", "--num-envs", "0"], "num_envs is 0"),
    ],
)
def test_evaluate_says_in_one_line_what_is_wrong(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert evaluate_main(arguments) == 2
    said = capsys.readouterr().err
    assert message in said
    assert said.count("\n") == 1


def test_evaluate_refuses_files_that_are_no_models(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "text.zip").write_text("hello")
    with zipfile.ZipFile(tmp_path / "other.zip", "w") as archive:
        archive.writestr("data", "{}")
    with zipfile.ZipFile(tmp_path / "broken.zip", "w") as archive:
        archive.writestr("data", '{"clip_range": 1}')
    with zipfile.ZipFile(tmp_path / "number.zip", "w") as archive:
        archive.writestr("data", "5")
    with zipfile.ZipFile(tmp_path / "without_data.zip", "w") as archive:
        archive.writestr("something", "else")
    model = (run / MODEL).read_bytes()
    (tmp_path / "truncated.zip").write_bytes(model[: len(model) // 2])
    (tmp_path / "corrupt.zip").write_bytes(model[:200] + bytes(200) + model[400:])
    for path, message in (
        (tmp_path, "no model file"),
        (tmp_path / "text.zip", "no model of Stable-Baselines3"),
        (tmp_path / "number.zip", "no model of Stable-Baselines3"),
        (tmp_path / "without_data.zip", "no model of Stable-Baselines3"),
        (tmp_path / "truncated.zip", "no model of Stable-Baselines3"),
        (tmp_path / "corrupt.zip", "no model of Stable-Baselines3"),
        (tmp_path / "other.zip", "unknown algorithm"),
        (tmp_path / "broken.zip", "can't be loaded"),
    ):
        assert evaluate_main([str(path)]) == 2
        said = capsys.readouterr().err
        assert message in said
        assert said.count("\n") == 1


def test_evaluate_refuses_a_model_that_does_not_fit(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    PPO("MlpPolicy", gymnasium.make("CartPole-v1")).save(tmp_path / "cart.zip")
    assert evaluate_main([str(tmp_path / "cart.zip")]) == 2
    assert "does not fit the environment" in capsys.readouterr().err
    assert evaluate_main([str(run), "--action-type", "twist"]) == 2
    assert "trained with action type 'wheels'" in capsys.readouterr().err
    blind = CyclicLoopVecEnv(1, map_name="ring", laser={"num_beams": 36})
    PPO("MultiInputPolicy", blind, n_steps=8, batch_size=8).save(tmp_path / "blind.zip")
    assert evaluate_main([str(tmp_path / "blind.zip")]) == 2
    assert "observations" in capsys.readouterr().err


def test_models_of_different_maps_need_a_map(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    train(TrainingSettings(map_name=("grid",), num_envs=2), steps=1, out=tmp_path)
    assert evaluate_main([str(run), str(tmp_path)]) == 2
    assert "say with --map" in capsys.readouterr().err


def test_changed_settings_are_noticed(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.copytree(run, tmp_path, dirs_exist_ok=True)
    settings = tmp_path / SETTINGS
    settings.write_text(settings.read_text().replace("wheels", "twist"))
    for main, arguments in ((evaluate_main, [str(tmp_path)]), (train_main, ["--out", str(tmp_path), "--resume"])):
        assert main(arguments) == 2
        said = capsys.readouterr().err
        assert f"{settings} says action_type 'twist', but the model was trained with 'wheels'" in said
        assert said.count("\n") == 1


@pytest.mark.parametrize("name", [MODEL, SETTINGS, PROGRESS])
def test_train_refuses_folders_where_its_files_go(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / name).mkdir()
    assert train_main(["--out", str(tmp_path), "--overwrite"]) == 2
    said = capsys.readouterr().err
    assert f"can't write to {tmp_path / name}" in said
    assert said.count("\n") == 1


def test_evaluate_refuses_settings_that_are_a_folder(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copy(run / MODEL, tmp_path)
    (tmp_path / SETTINGS).mkdir()
    assert evaluate_main([str(tmp_path)]) == 2
    assert f"{tmp_path / SETTINGS} is not as scripts/train.py wrote it" in capsys.readouterr().err


@pytest.mark.parametrize("package", ["torch", "stable_baselines3"])
def test_missing_packages_are_named_with_the_way_to_get_them(
    package: str, run: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    class Missing:
        def find_spec(self, name: str, path: Any = None, target: Any = None) -> None:
            if name == package:
                raise ModuleNotFoundError(f"No module named {name!r}", name=name)

    monkeypatch.delitem(sys.modules, package)
    monkeypatch.setattr(sys, "meta_path", [Missing(), *sys.meta_path])
    for main, arguments in ((train_main, []), (evaluate_main, [str(run)])):
        assert main(arguments) == 2
        said = capsys.readouterr().err
        assert f"{package} is missing" in said
        assert 'pip install -e ".[train]"' in said
    assert evaluate_main(["standing_still", "--map", "ring", "--episodes", "1", "--step-budget", "5"]) == 0


# The benchmark


def some_rows() -> Iterator[Any]:
    yield benchmark.Row("speed", "good", 2000.0, "x", least=1000)
    yield benchmark.Row("speed", "bad", 3.0, "s", most=1)
    yield benchmark.Row("speed", "neither", 0.5, "s")


@pytest.fixture
def stubbed(monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    """Put nothing in place of all measurements, and three rows in place of the first."""
    for name in vars(benchmark):
        if name.startswith("measure_"):
            monkeypatch.setattr(benchmark, name, lambda *_: iter(()))
    monkeypatch.setattr(benchmark, "measure_machine", some_rows)
    return monkeypatch


def test_benchmark_says_of_every_target_whether_it_was_met(
    stubbed: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "speed.json"
    assert benchmark.main(["--json", str(file)]) == 0
    assert capsys.readouterr().out.splitlines()[-3:] == [
        "| speed | good | 2,000 | x | at least 1,000 | ok |",
        "| speed | bad | 3 | s | at most 1 | MISSED |",
        "| speed | neither | 0.5 | s |  |  |",
    ]
    assert [row["verdict"] for row in json.loads(file.read_text())["results"]] == ["ok", "MISSED", ""]


def test_ctrl_c_in_benchmark_keeps_the_rows(
    stubbed: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted() -> Iterator[Any]:
        raise KeyboardInterrupt
        yield

    stubbed.setattr(benchmark, "measure_laser", interrupted)
    file = tmp_path / "speed.json"
    assert benchmark.main(["--json", str(file)]) == 130
    said = capsys.readouterr()
    assert said.err == f"benchmark.py: stopped; the 3 rows measured so far are above and in {file}.\n"
    assert len(json.loads(file.read_text())["results"]) == 3


def test_benchmark_says_that_it_can_not_measure_learning(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing() -> None:
        raise ConfigError("torch is missing")

    monkeypatch.setattr(benchmark, "require_learning", missing)
    (row,) = benchmark.measure_stable_baselines()
    assert (row.name, row.formatted, row.verdict) == ("not measured: torch is missing", "-", "")


def test_benchmark_leaves_no_cache_behind(monkeypatch: pytest.MonkeyPatch) -> None:
    caches = []

    def run_python(code: str, NUMBA_CACHE_DIR: str = "") -> float:
        caches.extend([Path(NUMBA_CACHE_DIR)] if NUMBA_CACHE_DIR else [])
        assert all(cache.is_dir() for cache in caches)
        return 0.0

    monkeypatch.setattr(benchmark, "run_python", run_python)
    list(benchmark.measure_start_up())
    assert len(caches) == 2
    assert not any(cache.exists() for cache in caches)


def test_phases_of_a_step_add_up_to_the_step() -> None:
    *phases, together = benchmark.measure_phases()
    assert {row.name.split(": ")[1] for row in phases} > {"drive (pymunk)", "laser", "rest"}
    assert all(row.value > 0 for row in phases)
    assert sum(row.value for row in phases) == pytest.approx(together.value)


@pytest.mark.parametrize("spoilt", [False, True])
def test_a_training_that_fails_keeps_what_was_learnt(
    spoilt: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["--num-envs", "4", "--out", str(tmp_path), "--steps", "1500"]
    step_wait, train_step, calls = CyclicLoopVecEnv.step_wait, PPO.train, 0

    def failing(self: CyclicLoopVecEnv) -> Any:
        nonlocal calls
        calls += 1
        if calls == 200:
            raise RuntimeError("no such\nluck")
        return step_wait(self)

    def spoiling(self: PPO) -> None:
        train_step(self)
        next(iter(self.policy.parameters())).data[:] = math.nan

    with monkeypatch.context() as patch:
        patch.setattr(CyclicLoopVecEnv, "step_wait", failing)
        if spoilt:
            patch.setattr(PPO, "train", spoiling)
        assert train_main(arguments) == 2
    (said,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("train.py")]
    assert "the training failed after" in said
    assert ("weights are not finite" if spoilt else "has what was learnt") in said
    assert (json.loads((tmp_path / SETTINGS).read_text())["steps"] > 0) != spoilt
    assert all(torch.isfinite(weights).all() for weights in load_trained(tmp_path).model.policy.parameters())


def test_benchmark_refuses_a_file_that_it_cannot_write(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "taken").write_text("")
    assert benchmark.main(["--json", str(tmp_path / "taken" / "rates.json")]) == 2
    assert "can't write to" in capsys.readouterr().err

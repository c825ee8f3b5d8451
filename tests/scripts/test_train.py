"""The command that trains: what it writes, one line for bad input, and nothing lost by Ctrl-C or a failure."""

from __future__ import annotations

import json
import math
import shutil
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from stable_baselines3 import PPO

from agents.rl.storage import MODEL, SETTINGS, load_trained
from agents.rl.vec_env import CyclicLoopVecEnv
from tests.helpers import load_script
from tests.scripts.conftest import Refused

evaluate_main = load_script("evaluate").main
train_main = load_script("train").main


def fail_at_step_200(patch: pytest.MonkeyPatch, error: BaseException) -> None:
    """Let the environments of a training raise an error after 199 steps."""
    steps, step_wait = iter(range(199)), CyclicLoopVecEnv.step_wait

    def failing(self: CyclicLoopVecEnv) -> Any:
        if next(steps, None) is None:
            raise error
        return step_wait(self)

    patch.setattr(CyclicLoopVecEnv, "step_wait", failing)


def test_ctrl_c_saves_and_resuming_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with monkeypatch.context() as patch:
        fail_at_step_200(patch, KeyboardInterrupt())
        assert train_main(["--num-envs", "4", "--out", str(tmp_path), "--steps", "1500"]) == 130
    (said,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("train.py")]
    assert f"--out {tmp_path} --resume --steps 1500" in said
    assert json.loads((tmp_path / SETTINGS).read_text())["steps"] == 796
    assert train_main([*said.split("scripts/train.py ")[1].split()]) == 0
    assert json.loads((tmp_path / SETTINGS).read_text())["steps"] >= 1500
    assert load_trained(tmp_path).model.num_timesteps >= 1500


@pytest.mark.parametrize("spoilt", [False, True])
def test_a_training_that_fails_keeps_what_was_learnt(
    spoilt: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    train_step = PPO.train

    def spoiling(self: PPO) -> None:
        train_step(self)
        next(iter(self.policy.parameters())).data[:] = math.nan

    with monkeypatch.context() as patch:
        fail_at_step_200(patch, RuntimeError("no such\nluck"))
        if spoilt:
            patch.setattr(PPO, "train", spoiling)
        assert train_main(["--num-envs", "4", "--out", str(tmp_path), "--steps", "1500"]) == 2
    (said,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("train.py")]
    assert ("weights are not finite" if spoilt else "has what was learnt") in said
    assert (json.loads((tmp_path / SETTINGS).read_text())["steps"] > 0) != spoilt
    assert all(torch.isfinite(weights).all() for weights in load_trained(tmp_path).model.policy.parameters())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--algo", "pppo"], "Did you mean 'ppo'?"),
        (["--map", "rin"], "Did you mean 'ring'?"),
        (["--steps", "0"], "steps is 0"),
        (["--algo", "sac", "--action-type", "discrete"], "takes no discrete actions"),
        (["--resume"], "to resume from"),
    ],
)
def test_train_says_in_one_line_what_is_wrong(
    arguments: list[str], message: str, tmp_path: Path, refused: Refused
) -> None:
    assert message in refused(train_main, [*arguments, "--out", tmp_path])
    assert not list(tmp_path.iterdir())


def test_train_keeps_a_model_that_is_there(run: Path, refused: Refused) -> None:
    before = (run / MODEL).read_bytes()
    assert "--overwrite" in refused(train_main, ["--out", run, "--step-budget", "200"])
    assert "trained for" in refused(train_main, ["--out", run, "--resume", "--steps", "10"])
    assert "begun with noise 'ideal'" in refused(train_main, ["--out", run, "--resume", "--noise", "poor"])
    assert (run / MODEL).read_bytes() == before


def test_changed_settings_are_noticed(run: Path, tmp_path: Path, refused: Refused) -> None:
    shutil.copytree(run, tmp_path, dirs_exist_ok=True)
    settings = tmp_path / SETTINGS
    settings.write_text(settings.read_text().replace("wheels", "twist"))
    for main, arguments in ((evaluate_main, [tmp_path]), (train_main, ["--out", tmp_path, "--resume"])):
        message = f"{settings} says action_type 'twist', but the model was trained with 'wheels'"
        assert message in refused(main, arguments)


def test_train_refuses_an_output_that_is_no_folder(tmp_path: Path, refused: Refused) -> None:
    (tmp_path / "file").write_text("")
    assert "can't write to" in refused(train_main, ["--out", tmp_path / "file" / "model"])


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

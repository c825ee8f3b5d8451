"""Train agents of Stable-Baselines3."""

from __future__ import annotations

import csv
import math
import sys
from collections import deque
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

import numpy as np
import torch
from stable_baselines3 import A2C, PPO, SAC, TD3
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from agents.rl.features import ScanFeatures
from agents.rl.settings import TrainingSettings
from agents.rl.storage import MODEL, PROGRESS, check_fits, check_output_folder, load_model, save
from agents.rl.vec_env import CyclicLoopVecEnv
from cyclic_env.atomic_write import write_text_atomically
from cyclic_env.errors import ConfigError, CyclicLoopError

if TYPE_CHECKING:
    from tqdm import tqdm

PROGRESS_COLUMNS = ("cycles_closed", "false_claims", "return", "length", "coverage", "collisions", "is_success")

ROLLOUT_STEPS = 128
"""Steps of each row between two updates of PPO."""

REPLAY_SIZE = 100_000
"""Transitions that SAC and TD3 keep: 150 MB."""

SAVE_EVERY = 50_000
"""Steps between two checkpoints."""


class TrainingError(CyclicLoopError, RuntimeError):
    """The training of a model failed."""


def train(
    settings: TrainingSettings,
    *,
    steps: int,
    out: Path,
    resume: bool = False,
    overwrite: bool = False,
    progress: tqdm | None = None,
    save_every: int = SAVE_EVERY,
) -> BaseAlgorithm:
    """Train a model; save it now and then, at the end, and when the training is interrupted or fails.

    Parameters
    ----------
    settings : TrainingSettings
    steps : int
        Steps of all robots together, those before a resumption included; rounded up to whole updates.
    out : path
        Folder for the model; made if need be, and tried before anything else.
    resume : bool
        Go on with the model in `out`. Its replay buffer, if it has one, begins empty.
    overwrite : bool
        Replace the model in `out`; without it, a model that is there is an error.
    progress : tqdm, optional
        Bar that shows steps and scores.
    save_every : int
        Steps between two checkpoints.

    Raises
    ------
    ConfigError
        If the folder can't be written, holds a model already, or holds none to resume from; or steps aren't positive.
    TrainingError
        If the training failed; it says what has been saved.
    """
    if steps < 1:
        raise ConfigError(f"steps is {steps}; expected at least 1.")
    if (out / MODEL).exists() and not (resume or overwrite):
        raise ConfigError(
            f"{out} holds a model already; go on with --resume, replace it with --overwrite, or use another --out."
        )
    check_output_folder(out)
    torch.set_num_threads(1)  # these networks are small: more threads wait for each other, and for the environment's
    with closing(settings.make_env()) as venv:
        model = _resumed_model(settings, venv, steps, out) if resume else _new_model(settings, venv)
        if not resume:
            save(model, settings, out)  # from now on no model of an earlier run stands beside the new settings
        callback = _Bookkeeper(settings, out, steps, save_every, progress)
        try:
            model.learn(steps - model.num_timesteps, callback=callback, reset_num_timesteps=not resume)
        except Exception as error:  # SB3 and torch can raise anything
            raise _training_error(error, model, settings, out) from error
        except BaseException:  # an interruption
            save(model, settings, out)
            raise
        finally:
            callback.close()
        save(model, settings, out)
    return model


def _training_error(error: Exception, model: BaseAlgorithm, settings: TrainingSettings, out: Path) -> TrainingError:
    """Save a model whose training failed, unless its weights are spoilt, and return the error that says so."""
    if all(torch.isfinite(weights).all() for weights in model.policy.parameters()):
        try:
            save(model, settings, out)
            kept = f"{out / MODEL} has what was learnt until then; go on with --resume."
        except OSError as problem:
            kept = f"it can't be saved ({problem}), so {out / MODEL} is left as the last checkpoint has it."
    else:
        kept = f"its weights are not finite, so {out / MODEL} is left as the last checkpoint has it."
    reason = " ".join(f"{type(error).__name__}: {error}".split())
    return TrainingError(f"the training failed after {model.num_timesteps:,} steps ({reason}); {kept}")


def _resumed_model(settings: TrainingSettings, venv: CyclicLoopVecEnv, steps: int, out: Path) -> BaseAlgorithm:
    """Return the model in a folder, set to go on, after checking that there is something left to do."""
    model = load_model(out / MODEL)
    check_fits(out / MODEL, model, venv.observation_space, venv.action_space)
    if model.num_timesteps >= steps:
        raise ConfigError(
            f"{out / MODEL} has been trained for {model.num_timesteps} steps already; give more than these as --steps."
        )
    venv.seed(settings.seed + model.num_timesteps)
    model.set_env(venv)
    return model


def _new_model(settings: TrainingSettings, venv: CyclicLoopVecEnv) -> BaseAlgorithm:
    """Return a model with parameters for this environment; all others are those of Stable-Baselines3.

    Noise that is drawn anew in every step makes a robot tremble on the spot, so that it learns to stand still. Noise
    that lasts (gSDE; Raffin, Kober and Stulp 2021) makes it drive: on the ring, after 200,000 steps of PPO, the return
    was 37 with it and 5 without.
    """
    policy_kwargs: dict[str, Any] = {"features_extractor_class": ScanFeatures}
    common: dict[str, Any] = {"gamma": 0.995, "seed": settings.seed, "device": "cpu", "policy_kwargs": policy_kwargs}
    if settings.action_type != "discrete" and settings.algo != "td3":  # which adds noise of its own
        common |= {"use_sde": True, "sde_sample_freq": 16}
        policy_kwargs["log_std_init"] = -1.0
    match settings.algo:
        case "ppo":
            batch = ROLLOUT_STEPS * settings.num_envs // 8
            return PPO("MultiInputPolicy", venv, n_steps=ROLLOUT_STEPS, batch_size=batch, **common)
        case "a2c":
            return A2C("MultiInputPolicy", venv, n_steps=32, **common)
        case "sac":
            return SAC("MultiInputPolicy", venv, buffer_size=REPLAY_SIZE, **common)
        case _:
            shape = venv.action_space.shape
            assert shape is not None
            noise = NormalActionNoise(np.zeros(shape), np.full(shape, 0.2))
            return TD3("MultiInputPolicy", venv, buffer_size=REPLAY_SIZE, action_noise=noise, **common)


class _Bookkeeper(BaseCallback):
    """Writes a line for each episode, shows progress, and saves the model now and then."""

    def __init__(
        self, settings: TrainingSettings, out: Path, steps: int, save_every: int, progress: tqdm | None
    ) -> None:
        super().__init__()
        self._settings, self._out, self._steps, self._save_every = settings, out, steps, save_every
        self._progress = progress
        self._episodes: deque[list[float]] = deque(maxlen=100)
        self._saved = 0
        self._file: TextIO | None = None

    def _on_training_start(self) -> None:
        self._saved = self.num_timesteps
        self._file = _open_episodes(self._out / PROGRESS, self.num_timesteps)
        if self._progress is not None:
            self._announce(self._progress)

    def _announce(self, progress: tqdm) -> None:
        update = self.model.n_envs * (self.model.n_steps if isinstance(self.model, OnPolicyAlgorithm) else 1)
        end = self.num_timesteps + math.ceil((self._steps - self.num_timesteps) / update) * update
        first_end = self.num_timesteps + min(self.training_env.get_attr("step_budget")) * self.model.n_envs
        progress.clear()
        print(
            f"training {self._settings.algo} on {','.join(self._settings.map_name)} until step {end:,}"
            + (f" ({self._steps:,} rounded up to whole updates)" if end > self._steps else "")
            + f"; each episode, the first by step {first_end:,}, will be a line of {self._out / PROGRESS}",
            file=sys.stderr,
        )
        progress.reset(total=end)
        progress.initial = progress.n = self.num_timesteps

    def _on_step(self) -> bool:
        ended = [info for info in self.locals["infos"] if "episode" in info]
        for info in ended:
            values = {**info, "return": info["episode"]["r"], "length": info["episode"]["l"]}
            self._episodes.append([values[column] for column in PROGRESS_COLUMNS])
            self._write_line([self.num_timesteps, *self._episodes[-1]])
        if self._progress is not None:
            if ended:
                cycles, false_claims, episode_return, *_ = np.mean(self._episodes, axis=0)
                scores = f"{cycles:.2f} cycles, {false_claims:.1f} false claims, return {episode_return:.1f}"
                self._progress.set_postfix_str(f"{scores} (last {len(self._episodes)})", refresh=False)
            self._progress.update(self.num_timesteps - self._progress.n)
        if self.num_timesteps - self._saved >= self._save_every:
            self._saved = self.num_timesteps
            save(self.model, self._settings, self._out)
        return True

    def _write_line(self, values: Sequence[Any]) -> None:
        assert self._file is not None
        try:
            csv.writer(self._file, lineterminator="\n").writerow(values)
        except OSError as error:  # a full disk, say, of which the file doesn't know its name
            raise OSError(error.errno, error.strerror, str(self._out / PROGRESS)) from error

    def close(self) -> None:
        if self._file is not None:
            self._file.close()


def _open_episodes(path: Path, steps: int) -> TextIO:
    """Open the file of episodes to append to it, cut back to the episodes that had ended by step `steps`."""
    kept: list[str] = []
    if steps and path.exists():
        for line in path.read_text(encoding="utf-8").splitlines(keepends=True)[1:]:
            step = line.split(",")[0]
            if step.isdecimal() and int(step) <= steps and line.endswith("\n"):  # the last line may be cut off
                kept.append(line)
    write_text_atomically(path, ",".join(["steps", *PROGRESS_COLUMNS]) + "\n" + "".join(kept))
    return path.open("a", newline="", encoding="utf-8", buffering=1)  # whole lines at once

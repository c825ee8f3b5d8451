"""Train agents of Stable-Baselines3."""

from __future__ import annotations

import csv
import math
import sys
from collections import deque
from collections.abc import Sequence
from contextlib import closing
from dataclasses import fields
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import configure
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from agents.rl.callbacks import RECENT_EPISODES, Checkpoints, Curves, Validation, begin_anew
from agents.rl.models import new_model
from agents.rl.settings import TrainingSettings
from agents.rl.storage import (
    BEST,
    MODEL,
    PROGRESS,
    VALIDATION,
    check_fits,
    check_output_folder,
    load_model,
    save,
    save_best,
)
from agents.rl.vec_env import CyclicLoopVecEnv
from cyclic_env import RewardConfig
from cyclic_env.atomic_write import write_text_atomically
from cyclic_env.errors import ConfigError, CyclicLoopError

if TYPE_CHECKING:
    from tqdm import tqdm

REWARD_TERMS = tuple(field.name for field in fields(RewardConfig))
PROGRESS_COLUMNS = ("cycles_closed", "false_claims", "return", "length", "coverage", "collisions", "is_success")
MORE_COLUMNS = ("cycles_total", "claims", "precision", "recall", *(f"reward_{term}" for term in REWARD_TERMS))

SAVE_EVERY = 50_000
"""Least number of steps between two checkpoints."""
CHECKPOINT_EPISODES = 2
"""Least number of full episodes in every row between two checkpoints, since all begin anew at each of them."""


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
    save_every: int | None = None,
) -> BaseAlgorithm:
    """Train a model; save it now and then, at the end, and when the training is interrupted or fails.

    Two runs of one seed are equal on one machine, and so is a run that was stopped at a checkpoint and resumed. (Not of
    SAC and TD3: their replay buffers are not saved.)

    Parameters
    ----------
    settings : TrainingSettings
    steps : int
        Number of steps of all robots together, including those before a resumption; rounded up to whole updates.
    out : path
        Folder for the model; it is made if necessary, and checked before anything else.
    resume : bool
        Whether to continue with the model in `out`. Its replay buffer, if it has one, begins empty.
    overwrite : bool
        Whether to replace a model in `out`; otherwise an existing model is an error.
    progress : tqdm, optional
        Bar that shows steps and scores.
    save_every : int, optional
        Steps between two checkpoints, at which all episodes begin anew; see `Checkpoints`. The default is the length of
        `CHECKPOINT_EPISODES` episodes. The model is scored on the validation plans at each checkpoint.

    Raises
    ------
    ConfigError
        If the folder can't be written, holds a model already, or holds none to resume from; or steps aren't positive.
    TrainingError
        If the training failed; the message says what has been saved.
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
        save_every = save_every or _checkpoint_spacing(settings, venv)
        model = _resumed_model(venv, steps, out) if resume else _untrained_model(settings, venv)
        _log_to_tensorboard(model, out)
        if not resume:
            save(model, settings, out)  # from now on no model of an earlier run stands beside the new settings
            (out / BEST).unlink(missing_ok=True)
        begin_anew(model, settings.seed)
        callback = _Bookkeeper(settings, out, steps, progress)
        callbacks = [callback, Curves(), *_checkpoints(settings, out, save_every)]
        try:
            model.learn(steps - model.num_timesteps, callback=callbacks, reset_num_timesteps=False)
        except Exception as error:  # SB3 and torch can raise anything
            raise _training_error(error, model, settings, out) from error
        except BaseException:  # an interruption
            save(model, settings, out)
            raise
        finally:
            callback.close()
            model.logger.close()
        save(model, settings, out)
    return model


def _checkpoints(settings: TrainingSettings, out: Path, every: int) -> list[BaseCallback]:
    """Return the callbacks that save the model at each checkpoint and, if there are validation plans, score it."""
    saves = Checkpoints(every, settings.seed, partial(save, settings=settings, out=out))
    if not settings.validation_map:
        return [saves]
    keep = partial(save_best, settings=settings, out=out)
    return [Validation(settings.make_validation_env, every, out / VALIDATION, keep), saves]


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


def _untrained_model(settings: TrainingSettings, venv: CyclicLoopVecEnv) -> BaseAlgorithm:
    discrete = settings.action_type == "discrete"
    return new_model(settings.algo, settings.hyperparameters, venv, settings.seed, discrete=discrete)


def _resumed_model(venv: CyclicLoopVecEnv, steps: int, out: Path) -> BaseAlgorithm:
    """Return the model in a folder, ready to be trained further, after checking that steps are left."""
    model = load_model(out / MODEL)
    check_fits(out / MODEL, model, venv.observation_space, venv.action_space)
    if model.num_timesteps >= steps:
        raise ConfigError(
            f"{out / MODEL} has been trained for {model.num_timesteps} steps already; give more than these as --steps."
        )
    model.set_env(venv)
    return model


def _checkpoint_spacing(settings: TrainingSettings, venv: CyclicLoopVecEnv) -> int:
    """Return how many steps of all rows `CHECKPOINT_EPISODES` episodes take, on the first plans that the rows draw."""
    venv.seed(settings.seed)
    venv.reset()
    longest = max(venv.get_attr("step_budget")) // venv.steps_per_action
    return max(SAVE_EVERY, CHECKPOINT_EPISODES * longest * venv.num_envs)


def _log_to_tensorboard(model: BaseAlgorithm, out: Path) -> None:
    """Let the model's logger write for TensorBoard, where that is installed, and nothing else."""
    installed = find_spec("tensorboard") is not None
    model.set_logger(configure(str(out / "tensorboard"), ["tensorboard"] if installed else []))


class _Bookkeeper(BaseCallback):
    """Writes a line for each episode, and shows progress."""

    def __init__(self, settings: TrainingSettings, out: Path, steps: int, progress: tqdm | None) -> None:
        super().__init__()
        self._settings, self._out, self._steps, self._progress = settings, out, steps, progress
        self._episodes: deque[list[float]] = deque(maxlen=RECENT_EPISODES)
        self._file: TextIO | None = None

    def _on_training_start(self) -> None:
        self._file = _open_episodes(self._out / PROGRESS, self.num_timesteps)
        if self._progress is not None:
            self._announce(self._progress)

    def _announce(self, progress: tqdm) -> None:
        update = self.model.n_envs * (self.model.n_steps if isinstance(self.model, OnPolicyAlgorithm) else 1)
        end = self.num_timesteps + math.ceil((self._steps - self.num_timesteps) / update) * update
        venv: Any = self.training_env
        budget = min(venv.get_attr("step_budget")) // venv.steps_per_action
        first_end = self.num_timesteps + budget * self.model.n_envs
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
            episode = info["episode"]
            terms = {f"reward_{term}": value for term, value in episode["terms"].items()}
            values = {**info, **terms, "return": episode["r"], "length": episode["l"]}
            self._episodes.append([values[column] for column in PROGRESS_COLUMNS])
            self._write_line([self.num_timesteps, *(values[column] for column in (*PROGRESS_COLUMNS, *MORE_COLUMNS))])
        if self._progress is not None:
            if ended:
                cycles, false_claims, episode_return, *_ = np.mean(self._episodes, axis=0)
                scores = f"{cycles:.2f} cycles, {false_claims:.1f} false claims, return {episode_return:.1f}"
                self._progress.set_postfix_str(f"{scores} (last {len(self._episodes)})", refresh=False)
            self._progress.update(self.num_timesteps - self._progress.n)
        return True

    def _write_line(self, values: Sequence[Any]) -> None:
        assert self._file is not None
        try:
            csv.writer(self._file, lineterminator="\n").writerow(values)
        except OSError as error:  # such as a full disk, whose error doesn't name the file
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
    write_text_atomically(path, ",".join(["steps", *PROGRESS_COLUMNS, *MORE_COLUMNS]) + "\n" + "".join(kept))
    return path.open("a", newline="", encoding="utf-8", buffering=1)  # whole lines at once

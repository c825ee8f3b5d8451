"""Train, save and load agents of Stable-Baselines3.

A training run is a folder: ``model.zip``, which holds its settings too; ``settings.json``, a copy of these for people,
with the steps done and the versions of all packages; and ``progress.csv``, a line for each training episode.
"""

from __future__ import annotations

import csv
import json
import math
import os
import platform
import sys
import time
import zipfile
from collections import deque
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from stable_baselines3 import A2C, PPO, SAC, TD3
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

import cyclic_env
from agents.rl.vec_env import CyclicLoopVecEnv, ScanFeatures
from cyclic_env.config import ACTION_TYPES, ActionType, noise_from_name
from cyclic_env.console import ProgressLine
from cyclic_env.errors import ConfigError, CyclicLoopError
from cyclic_env.floor_plans import load_floor_plans, separate_names
from cyclic_env.validation import check_choice

ALGORITHMS: Mapping[str, type[BaseAlgorithm]] = {"a2c": A2C, "ppo": PPO, "sac": SAC, "td3": TD3}
CONTINUOUS_ONLY = ("sac", "td3")

MODEL, SETTINGS, PROGRESS = "model.zip", "settings.json", "progress.csv"
STORED = "training_settings"
"""Attribute of a model that holds its settings, so that they are saved with it."""
PROGRESS_COLUMNS = ("cycles_closed", "false_claims", "return", "length", "coverage", "collisions", "is_success")

ROLLOUT = 128
"""Steps of each row between two updates of PPO."""

REPLAY = 100_000
"""Transitions that SAC and TD3 keep: 150 MB."""

SAVE_EVERY = 50_000
"""Steps between two checkpoints."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingSettings:
    """What a model is trained with; checked when made."""

    algo: str = "ppo"
    map_name: tuple[str, ...] = ("ring",)
    noise: str = "ideal"
    action_type: ActionType = "wheels"
    step_budget: int | None = None
    num_envs: int = 16
    seed: int = 0

    def __post_init__(self) -> None:
        check_choice("algorithm", self.algo, ALGORITHMS)
        check_choice("action type", self.action_type, ACTION_TYPES)
        if self.action_type == "discrete" and self.algo in CONTINUOUS_ONLY:
            raise ConfigError(f"{self.algo} takes no discrete actions; use ppo or a2c, or another action type.")
        noise_from_name(self.noise)
        load_floor_plans(self.map_name)
        for name in ("num_envs", "step_budget"):
            value = getattr(self, name)
            if (name, value) != ("step_budget", None) and (not isinstance(value, int) or value < 1):
                raise ConfigError(f"{name} is {value!r}; expected a whole number of at least 1.")
        if not isinstance(self.seed, int) or not 0 <= self.seed < 2**32:
            raise ConfigError(f"seed is {self.seed!r}; expected a whole number from 0 to {2**32 - 1}.")

    def make_env(self) -> CyclicLoopVecEnv:
        """Return the environment to train on."""
        return CyclicLoopVecEnv(
            self.num_envs,
            map_name=list(self.map_name),
            noise=self.noise,
            action_type=self.action_type,
            step_budget=self.step_budget,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainedModel:
    """A model, and what it was trained with; None for a model that is not from `train`."""

    model: BaseAlgorithm
    settings: TrainingSettings | None


class TrainingError(CyclicLoopError, RuntimeError):
    """The training of a model failed."""


def train(
    settings: TrainingSettings,
    *,
    steps: int,
    out: Path,
    resume: bool = False,
    overwrite: bool = False,
    progress: bool = True,
    save_every: int = SAVE_EVERY,
) -> tuple[BaseAlgorithm, bool]:
    """Train a model, and save it now and then, at the end, on Ctrl-C, and when the training fails.

    Parameters
    ----------
    settings : TrainingSettings
    steps : int
        Steps of all robots together, those before a resumption included; rounded up, since the algorithms learn in
        whole updates (PPO's of 128 steps of each robot).
    out : path
        Folder for the model; made if need be, and tried before anything else.
    resume : bool
        Go on with the model in `out`. Its replay buffer, if it has one, begins empty.
    overwrite : bool
        Replace the model in `out`; else it is an error that there is one.
    progress : bool
        Show progress on stderr.
    save_every : int
        Steps between two checkpoints.

    Returns
    -------
    model : BaseAlgorithm
    complete : bool
        False if Ctrl-C cut the training short.

    Raises
    ------
    ConfigError
        If the folder can't be written, holds a model already, or holds none to resume from; or steps aren't positive.
    TrainingError
        If the training failed; it says what has been saved.
    """
    if steps < 1:
        raise ConfigError(f"steps is {steps}; expected at least 1.")
    path = out / MODEL
    if path.exists() and not (resume or overwrite):
        raise ConfigError(
            f"{out} holds a model already; go on with --resume, replace it with --overwrite, or use another --out."
        )
    _check_writable(out)
    torch.set_num_threads(1)  # these networks are small: more threads wait for each other, and for the environment's
    venv = settings.make_env()
    try:
        if resume:
            model = _load(path)
            check_fits(path, model, venv.observation_space, venv.action_space)
            if model.num_timesteps >= steps:
                raise ConfigError(
                    f"{path} has been trained for {model.num_timesteps} steps already; give more than these as --steps."
                )
            venv.seed(settings.seed + model.num_timesteps)
            model.set_env(venv)
        else:
            model = _new_model(settings, venv)
            save(model, settings, out)  # so that no model of before stands beside the new settings, whatever happens
        end = _end_of_training(model, steps)
        if progress:
            budget = min(venv.get_attr("step_budget"))
            first_end = budget * settings.num_envs + model.num_timesteps
            print(
                f"training {settings.algo} on {','.join(settings.map_name)} until step {end:,}"
                + (f" ({steps:,} rounded up to whole updates)" if end > steps else "")
                + f"; each episode, the first by step {first_end:,}, will be a line of {out / PROGRESS}",
                file=sys.stderr,
            )
        callback = _Bookkeeper(settings, out, end, save_every, ProgressLine() if progress else None, append=resume)
        try:
            model.learn(steps - model.num_timesteps, callback=callback, reset_num_timesteps=not resume)
            complete = True
        except KeyboardInterrupt:
            complete = False
        except Exception as error:  # whatever goes wrong within SB3 and torch
            callback.close()
            kept = _saved_if_sound(model, settings, out)
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            raise TrainingError(
                f"the training failed after {model.num_timesteps:,} steps ({reason}); {kept}"
            ) from error
        callback.close()
        save(model, settings, out)
    finally:
        venv.close()
    return model, complete


def _saved_if_sound(model: BaseAlgorithm, settings: TrainingSettings, out: Path) -> str:
    """Save a model whose training failed, unless its weights are spoilt, and say what there is."""
    if not all(torch.isfinite(weights).all() for weights in model.policy.parameters()):
        return f"its weights are not finite, so {out / MODEL} is left as the last checkpoint has it."
    try:
        save(model, settings, out)
    except Exception as error:
        return f"it can't be saved ({error}), so {out / MODEL} is left as the last checkpoint has it."
    return f"{out / MODEL} has what was learnt until then; go on with --resume."


def _end_of_training(model: BaseAlgorithm, steps: int) -> int:
    """Return the first step from `steps` on at which an update of the model ends."""
    update = model.n_envs * (model.n_steps if isinstance(model, OnPolicyAlgorithm) else 1)
    return model.num_timesteps + math.ceil((steps - model.num_timesteps) / update) * update


def _new_model(settings: TrainingSettings, venv: CyclicLoopVecEnv) -> BaseAlgorithm:
    """Return a model with parameters for this environment; any others are as in Stable-Baselines3.

    Noise that is drawn anew in every step makes a robot tremble on the spot, so that it learns to stand still. Noise
    that lasts (gSDE; Raffin, Kober and Stulp 2021) makes it drive: on the ring, after 200,000 steps of PPO, it scored
    37 in place of 5.
    """
    policy_kwargs: dict[str, Any] = {"features_extractor_class": ScanFeatures}
    common: dict[str, Any] = {"gamma": 0.995, "seed": settings.seed, "device": "cpu", "policy_kwargs": policy_kwargs}
    if settings.action_type != "discrete" and settings.algo != "td3":  # which adds noise of its own
        common |= {"use_sde": True, "sde_sample_freq": 16}
        policy_kwargs["log_std_init"] = -1.0
    match settings.algo:
        case "ppo":
            batch = ROLLOUT * settings.num_envs // 8
            return PPO("MultiInputPolicy", venv, n_steps=ROLLOUT, batch_size=batch, **common)
        case "a2c":
            return A2C("MultiInputPolicy", venv, n_steps=32, **common)
        case "sac":
            return SAC("MultiInputPolicy", venv, buffer_size=REPLAY, **common)
        case _:
            shape = venv.action_space.shape
            assert shape is not None
            noise = NormalActionNoise(np.zeros(shape), np.full(shape, 0.2))
            return TD3("MultiInputPolicy", venv, buffer_size=REPLAY, action_noise=noise, **common)


class _Bookkeeper(BaseCallback):
    """Shows progress, writes a line for each episode, and saves now and then."""

    def __init__(
        self,
        settings: TrainingSettings,
        out: Path,
        end: int,
        save_every: int,
        line: ProgressLine | None,
        *,
        append: bool,
    ) -> None:
        super().__init__()
        self._settings, self._out, self._end, self._save_every, self._line = settings, out, end, save_every, line
        self._file = (out / PROGRESS).open("a" if append else "w", newline="", buffering=1)  # whole lines at once
        self._writer = csv.writer(self._file)
        if self._file.tell() == 0:
            self._writer.writerow(["steps", *PROGRESS_COLUMNS])
        self._episodes: deque[list[float]] = deque(maxlen=100)
        self._first = self._saved = 0
        self._began = 0.0

    def _on_training_start(self) -> None:
        self._first = self._saved = self.num_timesteps
        self._began = time.monotonic()

    def _on_step(self) -> bool:
        for info in self.locals["infos"]:
            if "episode" in info:
                values = {**info, "return": info["episode"]["r"], "length": info["episode"]["l"]}
                self._episodes.append([values[column] for column in PROGRESS_COLUMNS])
                self._writer.writerow([self.num_timesteps, *self._episodes[-1]])
        if self._line is not None:
            rate = (self.num_timesteps - self._first) / max(time.monotonic() - self._began, 1e-9)
            left = int((self._end - self.num_timesteps) / rate)
            scores = "no episode has ended yet"
            if self._episodes:
                cycles, false_claims, episode_return, *_ = np.mean(self._episodes, axis=0)
                scores = f"{cycles:.2f} cycles, {false_claims:.1f} false claims, return {episode_return:.1f}"
                scores += f" (last {len(self._episodes)})"
            done = f"{self.num_timesteps / self._end:.0%} of {self._end:,} steps, {left // 60}:{left % 60:02d} left"
            self._line.show(f"{done}, {scores}")
        if self.num_timesteps - self._saved >= self._save_every:
            self._saved = self.num_timesteps
            save(self.model, self._settings, self._out)
        return True

    def close(self) -> None:
        self._file.close()
        if self._line is not None:
            self._line.clear()


def save(model: BaseAlgorithm, settings: TrainingSettings, out: Path) -> None:
    """Write the model and its settings; a model that is there is replaced only when the new one is complete."""
    vars(model)[STORED] = asdict(settings)
    fresh = out / f"fresh_{MODEL}"
    model.save(fresh)
    fresh.replace(out / MODEL)
    packages = {"cyclic-loop": cyclic_env.__version__, "python": platform.python_version()}
    for package in ("gymnasium", "numpy", "pymunk", "stable-baselines3", "torch"):
        try:
            packages[package] = version(package)
        except PackageNotFoundError:
            packages[package] = "unknown"
    text = json.dumps({**asdict(settings), "steps": model.num_timesteps, "versions": packages}, indent=2)
    (out / SETTINGS).write_text(text + "\n", encoding="utf-8")


def training_settings(given: Mapping[str, Any]) -> TrainingSettings:
    """Return the settings with the fields that are given, maps as one text with commas between, and defaults else."""
    given = dict(given)
    if "map_name" in given:
        given["map_name"] = tuple(separate_names(given["map_name"]))
    return TrainingSettings(**given)


def resumed_settings(out: Path, given: Mapping[str, Any]) -> TrainingSettings:
    """Return the settings of the training run in a folder.

    Raises
    ------
    ConfigError
        If there is no run, or any of the `given` fields (as `training_settings` takes them) differ from its own.
    """
    if not (out / MODEL).is_file():
        raise ConfigError(f"there is no {MODEL} in {out} to resume from; leave out --resume to begin.")
    settings = stored_settings(out / MODEL)
    if settings is None:
        raise ConfigError(f"{out / MODEL} was not made by scripts/train.py, so it can't be resumed; use another --out.")
    asked = training_settings(given)
    for name in given:
        own, wanted = getattr(settings, name), getattr(asked, name)
        if own != wanted:
            raise ConfigError(f"{out} was begun with {name} {own!r}, not {wanted!r}; leave it out to resume.")
    return settings


def load_trained(path: Path) -> TrainedModel:
    """Return the model of a zip, or of the folder of a training run.

    Raises
    ------
    ConfigError
        If there is none, or it is no model of a known algorithm.
    """
    zip_path = path / MODEL if path.is_dir() else path
    return TrainedModel(model=_load(zip_path), settings=stored_settings(zip_path))


def stored_settings(path: Path) -> TrainingSettings | None:
    """Return the settings that a model was trained with, which are in its zip; None if it is not from `train`.

    Raises
    ------
    ConfigError
        If the zip is no model, or the `SETTINGS` beside it say something else: someone changed them.
    """
    stored = _stored_data(path).get(STORED)
    if stored is None:
        return None
    copy = path.with_name(SETTINGS)
    if path.name == MODEL and copy.exists():
        try:
            entries = json.loads(copy.read_text(encoding="utf-8"))
            changed = [name for name in stored if entries[name] != stored[name]]
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise ConfigError(f"{copy} is not as scripts/train.py wrote it; put it back, or delete it.") from error
        for name in changed:
            raise ConfigError(
                f"{copy} says {name} {entries[name]!r}, but the model was trained with {stored[name]!r}; put that back."
            )
    try:
        return TrainingSettings(**{**stored, "map_name": tuple(stored["map_name"])})
    except (KeyError, TypeError) as error:
        raise ConfigError(f"{path} was trained with another version, or is damaged: {error!r}.") from error


def check_fits(path: Path, model: BaseAlgorithm, observations: gymnasium.Space, actions: gymnasium.Space) -> None:
    """Check that the model takes the env's observations, and the env the model's actions.

    Raises
    ------
    ConfigError
        If they don't.
    """
    for kind, own, its in (
        ("observations", model.observation_space, observations),
        ("actions", model.action_space, actions),
    ):
        if own != its:
            raise ConfigError(f"{path} does not fit the environment: its {kind} are {own}, the environment's {its}.")


def _load(path: Path) -> BaseAlgorithm:
    algo = _algorithm_of(path)
    try:
        return ALGORITHMS[algo].load(path, device="cpu")
    except Exception as error:  # whatever unpickling meets in a file that is no model, or a damaged one
        raise ConfigError(f"{path} can't be loaded as a model of {algo}: {error!r}.") from error


def _algorithm_of(path: Path) -> str:
    """Tell the algorithm of a model by the names of its parameters, since SB3 doesn't save it."""
    names = _stored_data(path)
    for parameter, algo in (
        ("clip_range", "ppo"),
        ("target_entropy", "sac"),
        ("policy_delay", "td3"),
        ("vf_coef", "a2c"),
    ):
        if parameter in names:
            return algo
    raise ConfigError(f"{path} is a model of an unknown algorithm; known: {', '.join(ALGORITHMS)}.")


def _stored_data(path: Path) -> dict[str, Any]:
    """Return the parameters of a model by name, those that are no plain data as SB3 wraps them."""
    if not path.is_file():
        raise ConfigError(f"there is no model file {path}.")
    try:
        with zipfile.ZipFile(path) as archive:
            return dict(json.loads(archive.read("data")).items())
    except Exception as error:  # whatever a damaged zip, or one of something else, brings up
        raise ConfigError(f"{path} is no model of Stable-Baselines3, or a damaged one: {error!r}.") from error


def _check_writable(out: Path) -> None:
    try:
        out.mkdir(parents=True, exist_ok=True)
        trial = out / ".trial"
        trial.write_bytes(b"")
        trial.unlink()
    except OSError as error:
        raise ConfigError(f"can't write to the output folder {out}: {error.strerror}.") from error
    for path in (out / MODEL, out / SETTINGS, out / PROGRESS):
        if path.exists() and not (path.is_file() and os.access(path, os.W_OK)):
            raise ConfigError(f"can't write to {path}: it is no file, or not yours; use another --out.")

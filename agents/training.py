"""Train, save and load agents of Stable-Baselines3.

A training run is a folder: ``model.zip``, ``settings.json`` (what the model was trained on, and with which versions)
and ``progress.csv`` (a line for each training episode).
"""

from __future__ import annotations

import csv
import json
import platform
import time
import zipfile
from collections import deque
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
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

import cyclic_env
from agents.sb3 import CyclicLoopVecEnv, ScanFeatures
from cyclic_env.config import ACTION_TYPES, ActionType, noise_from_name
from cyclic_env.errors import ConfigError, unknown_name
from cyclic_env.evaluation import ProgressLine
from cyclic_env.floor_plans import load_floor_plans

ALGORITHMS: Mapping[str, type[BaseAlgorithm]] = {"a2c": A2C, "ppo": PPO, "sac": SAC, "td3": TD3}
CONTINUOUS_ONLY = ("sac", "td3")

MODEL, SETTINGS, PROGRESS = "model.zip", "settings.json", "progress.csv"
PROGRESS_COLUMNS = ("return", "length", "coverage", "cycles_closed", "false_claims", "collisions", "is_success")

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
        if self.algo not in ALGORITHMS:
            raise ConfigError(unknown_name("algorithm", self.algo, ALGORITHMS))
        if self.action_type not in ACTION_TYPES:
            raise ConfigError(unknown_name("action type", self.action_type, ACTION_TYPES))
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
    """A model, and what it was trained with; the settings are None for a zip that came without them."""

    model: BaseAlgorithm
    settings: TrainingSettings | None


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
    """Train a model, and save it now and then, at the end, and on Ctrl-C.

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
    """
    if steps < 1:
        raise ConfigError(f"steps is {steps}; expected at least 1.")
    path = out / MODEL
    if resume and not path.is_file():
        raise ConfigError(f"there is no {MODEL} in {out} to resume from; leave out --resume to begin.")
    if path.exists() and not (resume or overwrite):
        raise ConfigError(
            f"{out} holds a model already; go on with --resume, replace it with --overwrite, or use another --out."
        )
    _check_writable(out)
    torch.set_num_threads(1)  # these networks are small: more threads wait for each other, and for the environment's
    venv = settings.make_env()
    try:
        if resume:
            model = _load(path, settings.algo)
            _check_fits(path, model, venv.observation_space, venv.action_space)
            if model.num_timesteps >= steps:
                raise ConfigError(
                    f"{path} has been trained for {model.num_timesteps} steps already; give more than these as --steps."
                )
            venv.seed(settings.seed + model.num_timesteps)
            model.set_env(venv)
        else:
            model = _new_model(settings, venv)
            save(model, settings, out)  # so that no model of before stands beside the new settings, whatever happens
        callback = _Bookkeeper(settings, out, steps, save_every, ProgressLine() if progress else None, append=resume)
        try:
            model.learn(steps - model.num_timesteps, callback=callback, reset_num_timesteps=not resume)
            complete = True
        except KeyboardInterrupt:
            complete = False
        callback.close()
        save(model, settings, out)
    finally:
        venv.close()
    return model, complete


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
        steps: int,
        save_every: int,
        line: ProgressLine | None,
        *,
        append: bool,
    ) -> None:
        super().__init__()
        self._settings, self._out, self._steps, self._save_every, self._line = settings, out, steps, save_every, line
        self._file = (out / PROGRESS).open("a" if append else "w", newline="")
        self._writer = csv.writer(self._file)
        if self._file.tell() == 0:
            self._writer.writerow(["steps", *PROGRESS_COLUMNS])
        self._returns: deque[float] = deque(maxlen=100)
        self._first = self._saved = 0
        self._began = 0.0

    def _on_training_start(self) -> None:
        self._first = self._saved = self.num_timesteps
        self._began = time.monotonic()

    def _on_step(self) -> bool:
        for info in self.locals["infos"]:
            if "episode" in info:
                self._returns.append(info["episode"]["r"])
                own = {"return": info["episode"]["r"], "length": info["episode"]["l"]}
                self._writer.writerow([self.num_timesteps, *(own.get(key, info.get(key)) for key in PROGRESS_COLUMNS)])
        if self._line is not None:
            done = self.num_timesteps - self._first
            rate = done / max(time.monotonic() - self._began, 1e-9)
            left = max(self._steps - self.num_timesteps, 0) / rate
            share = min(1.0, self.num_timesteps / self._steps)
            bar = ("#" * round(20 * share)).ljust(20, ".")
            score = f", return {np.mean(self._returns):.1f} (last {len(self._returns)})" if self._returns else ""
            self._line.show(
                f"[{bar}] {self.num_timesteps:,} of {self._steps:,} steps, {rate:,.0f} a second, "
                f"{int(left) // 60}:{int(left) % 60:02d} left{score}"
            )
        if self.num_timesteps - self._saved >= self._save_every:
            self._saved = self.num_timesteps
            self._file.flush()
            save(self.model, self._settings, self._out)
        return True

    def close(self) -> None:
        self._file.close()
        if self._line is not None:
            self._line.clear()


def save(model: BaseAlgorithm, settings: TrainingSettings, out: Path) -> None:
    """Write the model and its settings; a model that is there is replaced only when the new one is complete."""
    fresh = out / f"fresh_{MODEL}"
    model.save(fresh)
    fresh.replace(out / MODEL)
    save_settings(settings, out, model.num_timesteps)


def save_settings(settings: TrainingSettings, out: Path, steps: int) -> None:
    """Write the settings, the steps trained so far, and the versions of all that took part."""
    packages = {"cyclic-loop": cyclic_env.__version__, "python": platform.python_version()}
    for package in ("gymnasium", "numpy", "pymunk", "stable-baselines3", "torch"):
        try:
            packages[package] = version(package)
        except PackageNotFoundError:
            packages[package] = "unknown"
    text = json.dumps({**asdict(settings), "steps": steps, "versions": packages}, indent=2)
    (out / SETTINGS).write_text(text + "\n", encoding="utf-8")


def load_settings(folder: Path) -> TrainingSettings | None:
    """Return the settings that are in a folder, or None if there are none.

    Raises
    ------
    ConfigError
        If the file is malformed.
    """
    path = folder / SETTINGS
    if not path.is_file():
        return None
    try:
        entries = json.loads(path.read_text(encoding="utf-8"))
        known = {field.name: entries[field.name] for field in fields(TrainingSettings)}
        return TrainingSettings(**{**known, "map_name": tuple(known["map_name"])})
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ConfigError(f"{path} is no settings file of scripts/train.py: {error!r}.") from error


def training_settings(given: Mapping[str, Any]) -> TrainingSettings:
    """Return the settings with the fields that are given, maps as one text with commas between, and defaults else."""
    given = dict(given)
    if "map_name" in given:
        given["map_name"] = tuple(given["map_name"].split(","))
    return TrainingSettings(**given)


def resumed_settings(out: Path, given: Mapping[str, Any]) -> TrainingSettings:
    """Return the settings of the training run in a folder.

    Raises
    ------
    ConfigError
        If there is no run, or any of the `given` fields (as `training_settings` takes them) differ from its own.
    """
    settings = load_settings(out)
    if settings is None:
        raise ConfigError(f"there is no {SETTINGS} in {out} to resume from; leave out --resume to begin.")
    asked = training_settings(given)
    for name in given:
        own, wanted = getattr(settings, name), getattr(asked, name)
        if own != wanted:
            raise ConfigError(f"{out} was begun with {name} {own!r}, not {wanted!r}; leave it out to resume.")
    return settings


def load_trained(path: Path) -> TrainedModel:
    """Return the model of a zip, or of the folder of a training run, with the settings beside it.

    Raises
    ------
    ConfigError
        If there is none, or it is no model of a known algorithm.
    """
    zip_path = path / MODEL if path.is_dir() else path
    settings = load_settings(zip_path.parent) if zip_path.name == MODEL else None
    return TrainedModel(model=_load(zip_path, settings.algo if settings else None), settings=settings)


def check_fits(path: Path, model: BaseAlgorithm, env: gymnasium.vector.VectorEnv) -> None:
    """Check that the model takes the env's observations, and the env the model's actions.

    Raises
    ------
    ConfigError
        If they don't.
    """
    _check_fits(path, model, env.single_observation_space, env.single_action_space)


def _check_fits(path: Path, model: BaseAlgorithm, observations: gymnasium.Space, actions: gymnasium.Space) -> None:
    for kind, own, its in (
        ("observations", model.observation_space, observations),
        ("actions", model.action_space, actions),
    ):
        if own != its:
            raise ConfigError(f"{path} does not fit the environment: its {kind} are {own}, the environment's {its}.")


def _load(path: Path, algo: str | None) -> BaseAlgorithm:
    if not path.is_file():
        raise ConfigError(f"there is no model file {path}.")
    if not zipfile.is_zipfile(path):
        raise ConfigError(f"{path} is no zip file, so it is no model of Stable-Baselines3.")
    algo = algo or _algorithm_of(path)
    try:
        return ALGORITHMS[algo].load(path, device="cpu")
    except Exception as error:  # whatever unpickling meets in a file that is no model, or a damaged one
        raise ConfigError(f"{path} can't be loaded as a model of {algo}: {error!r}.") from error


def _algorithm_of(path: Path) -> str:
    """Tell the algorithm of a model by the names of its parameters, since SB3 doesn't save it."""
    try:
        with zipfile.ZipFile(path) as archive:
            names = set(json.loads(archive.read("data")))
    except (KeyError, ValueError, OSError, zipfile.BadZipFile) as error:
        raise ConfigError(f"{path} is a zip file, but no model of Stable-Baselines3.") from error
    for parameter, algo in (
        ("clip_range", "ppo"),
        ("target_entropy", "sac"),
        ("policy_delay", "td3"),
        ("vf_coef", "a2c"),
    ):
        if parameter in names:
            return algo
    raise ConfigError(f"{path} is a model of an unknown algorithm; known: {', '.join(ALGORITHMS)}.")


def _check_writable(out: Path) -> None:
    try:
        out.mkdir(parents=True, exist_ok=True)
        trial = out / ".trial"
        trial.write_bytes(b"")
        trial.unlink()
    except OSError as error:
        raise ConfigError(f"can't write to the output folder {out}: {error.strerror}.") from error

"""Models and their settings in files.

A training run is a folder: ``model.zip``, which holds its settings too; ``settings.json``, a copy of these for people,
with the steps done and the versions of all packages; ``progress.csv``, a line for each training episode; and, where
checkpoints are scored, ``validation.csv``, a line for each score, and ``best.zip``, the model that scored best.
"""

from __future__ import annotations

import io
import json
import os
import platform
import zipfile
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import gymnasium
from stable_baselines3.common.base_class import BaseAlgorithm

import cyclic_env
from agents.rl.models import ALGORITHMS
from agents.rl.settings import LISTS, TrainingSettings, settings_from_stored, training_settings
from cyclic_env.atomic_write import atomic_write, check_writable, write_text_atomically
from cyclic_env.errors import ConfigError

MODEL, BEST, SETTINGS, PROGRESS = "model.zip", "best.zip", "settings.json", "progress.csv"
VALIDATION = "validation.csv"
STORED = "training_settings"
"""Attribute of a model that holds its settings, so that they are saved with it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainedModel:
    """A model and the settings that it was trained with, or None if it was not made by `train`."""

    model: BaseAlgorithm
    settings: TrainingSettings | None


def save(model: BaseAlgorithm, settings: TrainingSettings, out: Path) -> None:
    """Write the model and its settings; an existing model is replaced only when the new one is complete."""
    vars(model)[STORED] = asdict(settings)
    _write_model(model, out / MODEL)
    packages = {"cyclic-loop": cyclic_env.__version__, "python": platform.python_version()}
    for package in ("gymnasium", "numpy", "pymunk", "sb3-contrib", "stable-baselines3", "torch"):
        try:
            packages[package] = version(package)
        except PackageNotFoundError:
            packages[package] = "unknown"
    text = json.dumps({**asdict(settings), "steps": model.num_timesteps, "versions": packages}, indent=2)
    write_text_atomically(out / SETTINGS, text + "\n")


def save_best(model: BaseAlgorithm, settings: TrainingSettings, out: Path) -> None:
    """Write the model as the one that has scored best."""
    vars(model)[STORED] = asdict(settings)
    _write_model(model, out / BEST)


def _write_model(model: BaseAlgorithm, path: Path) -> None:
    buffer = io.BytesIO()  # so that one write meets a full disk, with an error that names the file
    # The last observations are not needed to resume, because all episodes then begin anew.
    model.save(buffer, exclude=["_last_obs", "_last_original_obs", "_last_episode_starts"])
    with atomic_write(path) as part:
        part.write_bytes(buffer.getvalue())


def steps_done(out: Path) -> int:
    """Return for how many steps the model of a training run has been trained; 0 if there is no model."""
    try:
        return json.loads((out / SETTINGS).read_text(encoding="utf-8"))["steps"]
    except OSError:
        return 0


def resumed_settings(out: Path, given: Mapping[str, Any]) -> TrainingSettings:
    """Return the settings of the training run in a folder.

    Raises
    ------
    ConfigError
        If there is no run, or one of the `given` fields (as `training_settings` takes them) differs from the run's.
    """
    if not (out / MODEL).is_file():
        raise ConfigError(f"there is no {MODEL} in {out} to resume from; leave out --resume to begin.")
    settings = stored_settings(out / MODEL)
    if settings is None:
        raise ConfigError(f"{out / MODEL} was not made by scripts/train.py, so it can't be resumed; use another --out.")
    asked = training_settings({"task": settings.task, "algo": settings.algo, **given})
    for name in given:
        own, wanted = getattr(settings, name), getattr(asked, name)
        if own != wanted:
            own, wanted = (",".join(value) if name in LISTS else value for value in (own, wanted))
            raise ConfigError(f"{out} was begun with {name} {own!r}, not {wanted!r}; leave it out to resume.")
    return settings


def load_trained(path: Path) -> TrainedModel:
    """Return the model of a zip, or of the folder of a training run.

    Raises
    ------
    ConfigError
        If there is no file, or it is not a model of a known algorithm.
    """
    zip_path = path
    if path.is_dir():
        zip_path = path / (BEST if (path / BEST).is_file() else MODEL)
    return TrainedModel(model=load_model(zip_path), settings=stored_settings(zip_path))


def stored_settings(path: Path) -> TrainingSettings | None:
    """Return the settings in a model's zip, with which it was trained; None if it was not made by `train`.

    Raises
    ------
    ConfigError
        If the zip is not a model, or the `SETTINGS` beside it differ because someone changed them.
    """
    stored = _stored_data(path).get(STORED)
    if stored is None:
        return None
    copy = path.with_name(SETTINGS)
    if path.name == MODEL and copy.exists():
        try:
            entries = json.loads(copy.read_text(encoding="utf-8"))
            changed = [name for name in stored if entries[name] != json.loads(json.dumps(stored[name]))]
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise ConfigError(f"{copy} is not as scripts/train.py wrote it; put it back, or delete it.") from error
        for name in changed:
            raise ConfigError(
                f"{copy} says {name} {entries[name]!r}, but the model was trained with {stored[name]!r}; put that back."
            )
    try:
        return settings_from_stored(stored)
    except (KeyError, TypeError) as error:
        raise ConfigError(f"{path} was trained with another version, or is damaged: {error!r}.") from error


def check_fits(path: Path, model: BaseAlgorithm, observations: gymnasium.Space, actions: gymnasium.Space) -> None:
    """Check that the model takes the environment's observations, and the environment the model's actions.

    Raises
    ------
    ConfigError
        If a space differs.
    """
    for kind, own, its in (
        ("observations", model.observation_space, observations),
        ("actions", model.action_space, actions),
    ):
        if own != its:
            raise ConfigError(f"{path} does not fit the environment: its {kind} are {own}, the environment's {its}.")


def load_model(path: Path) -> BaseAlgorithm:
    """Return the model in a zip.

    Raises
    ------
    ConfigError
        If the zip is not a model, or damaged.
    """
    algo = _algorithm_of(path)
    try:
        return ALGORITHMS[algo].load(path, device="cpu")
    except Exception as error:  # unpickling a damaged file can raise anything
        reason = f"{type(error).__name__}: {str(error).partition(chr(10))[0].rstrip(':')}"
        raise ConfigError(f"{path} can't be loaded; it is damaged, or of another version ({reason}).") from error


def _algorithm_of(path: Path) -> str:
    """Return the algorithm of a model. SB3 doesn't save it, but the names of its parameters show it."""
    names = _stored_data(path)
    if "maskable" in str(names.get("rollout_buffer_class")):
        return "maskable_ppo"
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
    """Return the parameters of a model by name; SB3 wraps those that are not plain data."""
    if not path.is_file():
        raise ConfigError(f"there is no model file {path}.")
    try:
        with zipfile.ZipFile(path) as archive:
            return dict(json.loads(archive.read("data")).items())
    except Exception as error:  # a damaged or foreign zip can raise anything
        raise ConfigError(f"{path} is no model of Stable-Baselines3, or a damaged one: {error!r}.") from error


def check_output_folder(out: Path) -> None:
    """Check that the files of a training run can be written.

    Raises
    ------
    ConfigError
        If one of them can't be; the message names it.
    """
    check_writable(out / MODEL)
    for path in (out / MODEL, out / BEST, out / SETTINGS, out / PROGRESS, out / VALIDATION):
        if path.exists() and not (path.is_file() and os.access(path, os.W_OK)):
            raise ConfigError(f"can't write to {path}: it is no file, or not yours; use another --out.")

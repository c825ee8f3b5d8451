"""A recorded episode and its file.

A recording is an NPZ file with everything that is needed to rebuild the environment, floor plans included, and with
everything that was done and measured in each step. ``docs/recording.md`` describes its layout. It holds no pickles.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import platform
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from cyclic_env import __version__
from cyclic_env.atomic_write import atomic_write
from cyclic_env.config import EnvConfig
from cyclic_env.envs.cyclic_loop import CyclicLoopEnv
from cyclic_env.errors import ConfigError, CyclicLoopError, RecordingError
from cyclic_env.floor_plans import FloorPlan, floor_plan_from_text, floor_plan_to_text
from cyclic_env.task.loop_closure import RULES_VERSION
from cyclic_env.task.path_history import CLAIM
from cyclic_env.validation import as_array, short_repr

LAYOUT = 1
"""Version of the file's layout. Files with another layout are refused."""

PACKAGES = ("numpy", "numba", "pymunk", "gymnasium", "shapely")
"""Packages that the bits of an episode depend on."""

HEADER = ("settings", "seed", "options", "generator", "versions", "map", "terminated", "truncated", "info")
"""Fields of a `Recording` that the file's header holds as they are."""

TRACK = "track_"
"""Prefix of the names of the arrays that hold an agent's tracks."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Recording:
    """An episode: its environment, its T steps, and what was measured at T + 1 times, the reset being the first.

    Attributes
    ----------
    plans : tuple of FloorPlan
        The pool from which the episode drew its plan.
    shipped : tuple of bool
        Which of them came with the package.
    settings : dict
        All arguments of the environment except the map, defaults included, as plain values.
    seed, options
        Arguments of the episode's reset.
    generator : dict
        State of the environment's random generator just before the episode drew from it.
    versions : dict
        Versions of the packages, and the kind of machine, that made the recording.
    map : str
        Name of the episode's plan.
    terminated, truncated : bool
        How the episode ended; both are False if it was stopped early.
    info : dict
        The scalars of the last info.
    actions : (T, 4) float64, or (T, 2) int64 if discrete
    rewards : (T,) float64
    poses : (T + 1, 3) float64
        The true poses: x, y, heading; metres and radians.
    distance, compass : (T + 1,), (T + 1, 2) float32
        As observed.
    laser : (T + 1, num_beams) float32, or None
        As observed, if the recorder was asked to keep it.
    dead_reckoned : (T + 1, 3) float64
        Poses by dead reckoning from the true start; see `cyclic_env.trajectory.dead_reckoning`.
    digests : (T + 1,) uint64
        `observation_digest` of each observation.
    claims : (n,) CLAIM
        The judged claims.
    tracks : dict of (n, 4) float64
        Tracks of the agent by name: step, x, y, heading, in the world's frame.
    """

    plans: tuple[FloorPlan, ...]
    shipped: tuple[bool, ...]
    settings: dict[str, Any]
    seed: int | None
    options: dict[str, Any]
    generator: dict[str, Any]
    versions: dict[str, str]
    map: str
    terminated: bool
    truncated: bool
    info: dict[str, Any]
    actions: np.ndarray
    rewards: np.ndarray
    poses: np.ndarray
    distance: np.ndarray
    compass: np.ndarray
    dead_reckoned: np.ndarray
    digests: np.ndarray
    claims: np.ndarray
    laser: np.ndarray | None = None
    tracks: dict[str, np.ndarray] = field(default_factory=dict)

    @property
    def steps(self) -> int:
        """Number of steps taken, T."""
        return len(self.actions)

    @property
    def dt(self) -> float:
        """Length of a step, seconds."""
        return float(self.settings["robot"]["dt"])

    @property
    def times(self) -> np.ndarray:
        """Seconds since the reset, `(T + 1,)`."""
        return self.dt * np.arange(self.steps + 1)

    @property
    def noise(self) -> str:
        """Name of the noise preset, or ``"custom"``."""
        return EnvConfig(noise=self.settings["noise"]).noise_name

    def make_env(self, render_mode: str | None = None) -> CyclicLoopEnv:
        """Return an environment in the state that the recorded one had before its reset.

        Raises
        ------
        RecordingError
            If this version can't rebuild it.
        """
        try:
            env = CyclicLoopEnv(self.plans, render_mode=render_mode, **self.settings)
            env.np_random = np.random.default_rng()
            env.np_random.bit_generator.state = self.generator
        except (CyclicLoopError, TypeError, ValueError, KeyError, OverflowError) as error:
            raise RecordingError(f"its environment can't be rebuilt: {error}") from error
        return env


def observation_digest(observation: Mapping[str, np.ndarray]) -> int:
    """Return the first 64 bits of the BLAKE2b hash of the bytes of laser, distance and compass, in this order."""
    digest = hashlib.blake2b(digest_size=8)
    for name in ("laser", "distance", "compass"):
        digest.update(np.ascontiguousarray(observation[name]).tobytes())
    return int.from_bytes(digest.digest(), "little")


def versions() -> dict[str, str]:
    """Return the versions of everything that an episode's bits depend on, among them the rules of loop closure."""
    packages = {name: importlib.metadata.version(name) for name in PACKAGES}
    return {
        "cyclic_env": __version__,
        "closure_rules": str(RULES_VERSION),
        "python": platform.python_version(),
        **packages,
        "machine": platform.machine(),
    }


def check_track(name: str, track: Any) -> np.ndarray:
    """Return an agent's track as float64 `(n, 4)`.

    Raises
    ------
    ConfigError
        If it has another shape.
    """
    expected = "step, x, y, heading in 4 columns"
    array = as_array(track, f"track {name!r}", expected, ConfigError).astype(np.float64)
    if array.ndim != 2 or array.shape[1] != 4:
        raise ConfigError(f"track {name!r} has shape {array.shape}; expected {expected}.")
    return array


def write_recording(recording: Recording, path: str | Path) -> None:
    """Write a recording; if that fails, the file stays as it was.

    Raises
    ------
    RecordingError
        If the file can't be written.
    """
    path = Path(path)
    maps = [
        {"name": plan.name, "shipped": shipped, "yaml": floor_plan_to_text(plan)}
        for plan, shipped in zip(recording.plans, recording.shipped, strict=True)
    ]
    header = {"layout": LAYOUT, "maps": maps} | {name: getattr(recording, name) for name in HEADER}
    arrays = {name: getattr(recording, name) for name in _ARRAYS if getattr(recording, name) is not None}
    arrays |= {TRACK + name: track for name, track in recording.tracks.items()}
    try:
        with atomic_write(path) as part, part.open("wb") as file:
            np.savez_compressed(file, header=np.frombuffer(json.dumps(header).encode(), np.uint8), **arrays)
    except OSError as error:
        raise RecordingError(f"{path}: can't be written: {error.strerror or error}.") from error


def read_recording(path: str | Path) -> Recording:
    """Read a recording.

    Raises
    ------
    RecordingError
        Naming the file, if it is missing, damaged, not a recording, or has another layout.
    """
    path = Path(path)
    try:
        if not path.exists():
            raise RecordingError("there is no such file.")
        if not path.is_file() or not zipfile.is_zipfile(path):
            raise RecordingError("is not an NPZ file, or was cut off.")
        with np.load(path, allow_pickle=False) as file:
            if "header" not in file.files:
                raise RecordingError("is an NPZ file, but not a recording: it has no header.")
            header = _parse_header(json.loads(file["header"].tobytes()))
            return Recording(**header, **_read_arrays(file, header["settings"]))
    except CyclicLoopError as error:
        raise RecordingError(f"{path}: {error}") from error
    except OSError as error:
        raise RecordingError(f"{path}: can't be read: {error.strerror or error}.") from error
    except Exception as error:  # a damaged file can hold any bytes
        reason = f"{type(error).__name__}: {error}"
        raise RecordingError(f"{path}: is damaged, or not a recording ({short_repr(reason)}).") from error


def _parse_header(header: dict[str, Any]) -> dict[str, Any]:
    """Return the fields of a `Recording` that a header holds."""
    if header.get("layout") != LAYOUT:
        got = short_repr(header.get("layout"))
        raise RecordingError(f"has layout {got}; this version of cyclic_env reads layout {LAYOUT}.")
    plans = tuple(floor_plan_from_text(entry["yaml"]) for entry in header["maps"])
    shipped = tuple(bool(entry["shipped"]) for entry in header["maps"])
    return {"plans": plans, "shipped": shipped} | {name: header[name] for name in HEADER}


_ARRAYS: dict[str, tuple[str, int | None, tuple[int, ...]]] = {
    "actions": ("", 0, ()),
    "rewards": ("f8", 0, ()),
    "poses": ("f8", 1, (3,)),
    "distance": ("f4", 1, ()),
    "compass": ("f4", 1, (2,)),
    "laser": ("f4", 1, ()),
    "dead_reckoned": ("f8", 1, (3,)),
    "digests": ("u8", 1, ()),
    "claims": ("", None, ()),
}
"""Type, number of rows beyond T (None: any), and columns of each array; some depend on the settings."""


def _read_arrays(file: np.lib.npyio.NpzFile, settings: dict[str, Any]) -> dict[str, Any]:
    """Return the arrays of a `Recording`, whose types and shapes have been checked."""
    discrete = settings["action_type"] == "discrete"
    types = {"actions": np.dtype(np.int64 if discrete else np.float64), "claims": CLAIM}
    columns = {"actions": (2 if discrete else 4,), "laser": (settings["laser"]["num_beams"],)}
    arrays: dict[str, Any] = {}
    for name, (kind, extra, shape) in _ARRAYS.items():
        if name == "laser" and name not in file.files:
            continue
        array = arrays[name] = file[name]
        rows = len(array) if extra is None else len(arrays["actions"]) + extra
        expected = (rows, *columns.get(name, shape))
        if array.dtype != types.get(name, kind) or array.shape != expected:
            raise RecordingError(f"is damaged: {name} is {array.dtype} of shape {array.shape}; expected {expected}.")
    names = [name for name in file.files if name.startswith(TRACK)]
    return arrays | {"tracks": {name.removeprefix(TRACK): check_track(name, file[name]) for name in names}}

"""Recording an episode, and replaying it bit for bit.

A recording is an NPZ file with all that it takes to build the environment anew, plans included, and what was done and
measured in every step; ``docs/recording.md`` has its layout. Nothing in it is pickled.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import platform
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.utils import seeding

from cyclic_env import __version__
from cyclic_env.atomic_write import atomic_write, check_writable
from cyclic_env.config import NOISE_PRESETS, NoiseConfig, from_mapping
from cyclic_env.engine.engine import INFO
from cyclic_env.envs.cyclic_loop import CyclicLoopEnv
from cyclic_env.envs.spaces import checked_seed
from cyclic_env.errors import ConfigError, CyclicLoopError, FloorPlanError, RecordingError, UsageError
from cyclic_env.floor_plans import FloorPlan, floor_plan_from_text, floor_plan_to_text, load_floor_plan, map_names
from cyclic_env.floor_plans.floor_plan import COORDINATE_MAX
from cyclic_env.task.loop_closure import CLAIM
from cyclic_env.trajectory.io import dead_reckon
from cyclic_env.validation import as_array, short_repr

LAYOUT = 1
"""Version of the file's layout; files of others are refused."""

PACKAGES = ("numpy", "numba", "pymunk", "gymnasium", "shapely")
"""Packages on which the bits of an episode depend."""

SETTINGS = ("action_type", "random_start", "terminate_on_collision", "step_budget")
SETTING_GROUPS = ("robot", "laser", "noise", "closure", "coverage", "reward")

MEASURED = ("poses", "distance", "compass", "dead_reckoned")
"""Arrays of lengths and angles, which are finite."""

TRACK = "track_"
"""Begins the names of the arrays that hold an agent's tracks."""

ALTERING = (gymnasium.ActionWrapper, gymnasium.ObservationWrapper, gymnasium.RewardWrapper)
"""Wrappers that give the environment other actions than the recorder sees, or the recorder other answers."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Recording:
    """An episode: its environment, T steps, and T + 1 moments, the reset being the first.

    Attributes
    ----------
    plans : tuple of FloorPlan
        The pool from which the episode drew its plan.
    shipped : tuple of bool
        Which of them came with the package.
    settings : dict
        All of the environment's arguments but its map, with their defaults, as plain values.
    seed, options
        With which the episode was reset.
    generator : dict
        State of the environment's random generator just before the episode drew from it.
    versions : dict
        Of the packages and the machine that made it.
    map : str
        Name of the episode's plan.
    terminated, truncated : bool
        How it ended; both False if it was cut short.
    info : dict
        The last one's scalars.
    actions : (T, 4) float64, or (T, 2) int64 if discrete
    rewards : (T,) float64
    poses : (T + 1, 3) float64
        The truth: x, y, heading, metres and radians.
    distance, compass : (T + 1,), (T + 1, 2) float32
        As observed.
    laser : (T + 1, beams) float32, or None
        As observed, if it was asked for.
    dead_reckoned : (T + 1, 3) float64
        Poses by distance meter and compass from the true start; see `cyclic_env.trajectory.io.dead_reckon`.
    digests : (T + 1,) uint64
        Of each observation; see `observation_digest`.
    claims : (n,) CLAIM
        The judged ones.
    tracks : dict of (n, 4) float64
        An agent's own, by name: step, x, y, heading, in the world's frame.
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
        """Steps taken, T."""
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
        noise = from_mapping(NoiseConfig, self.settings["noise"])
        return next((name for name, preset in NOISE_PRESETS.items() if preset == noise), "custom")

    def make_env(self, render_mode: str | None = None) -> CyclicLoopEnv:
        """Return an environment as the recorded one was before its reset.

        Raises
        ------
        RecordingError
            If this version can't make it.
        """
        try:
            env = CyclicLoopEnv(self.plans, render_mode=render_mode, **self.settings)
            env.np_random = np.random.default_rng()
            env.np_random.bit_generator.state = self.generator
        except (CyclicLoopError, TypeError, ValueError, KeyError, OverflowError) as error:
            raise RecordingError(f"its environment can't be made anew: {error}") from error
        return env


class Recorder(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Records the episodes of an environment, and writes each as it ends, as the next begins, or on `close`.

    Use it in a ``with`` statement, and a run that is interrupted keeps what was done.

    Parameters
    ----------
    env : CyclicLoopEnv
        Or what `gymnasium.make` returns; not wrapped in anything that alters actions, observations or rewards.
    path : str or path, optional
        File of the first episode; that of the second has ``-2`` before its suffix, and so on. None: nothing is
        written but by `write_recording`.
    laser : bool
        Keep the scans too, which makes the files some ten times larger. They can be had from a replay as well.

    Raises
    ------
    ConfigError
        If the env is none of ours or altered, or the file can't be written.
    """

    def __init__(self, env: gymnasium.Env[Any, Any], path: str | Path | None = None, *, laser: bool = False) -> None:
        if not isinstance(env, gymnasium.Env) or not isinstance(env.unwrapped, CyclicLoopEnv):
            raise ConfigError(f"the env is {short_repr(env)}; expected a CyclicLoop environment, a single one.")
        layer = env
        while isinstance(layer, gymnasium.Wrapper):
            if isinstance(layer, ALTERING):
                raise ConfigError(f"{type(layer).__name__} alters what is recorded; put it around the Recorder.")
            layer = layer.env
        super().__init__(env)
        self._core = env.unwrapped
        self._path = None if path is None else Path(path)
        if self._path is not None:
            check_writable(self._path)
        self._laser = laser
        plans = self._core.engine.config.plans
        self._shipped = tuple(_is_shipped(plan) for plan in plans)
        self._episode = 0
        self._written = True
        self._reset: dict[str, Any] = {}
        self._moments: list[tuple[Any, ...]] = []  # one entry a moment, so that Ctrl-C leaves no half of one
        self._ended = (False, False)
        self._info: dict[str, Any] = {}

    @property
    def path(self) -> Path | None:
        """File of the running episode."""
        if self._path is None or self._episode < 2:
            return self._path
        return self._path.with_stem(f"{self._path.stem}-{self._episode}")

    @property
    def steps(self) -> int:
        """Steps of the running episode so far."""
        return max(0, len(self._moments) - 1)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Write the last episode, if that was not done, and begin another."""
        self.save()
        seed = checked_seed(seed)
        generator = (self._core.np_random if seed is None else seeding.np_random(seed)[0]).bit_generator.state
        if generator["bit_generator"] != "PCG64":
            raise ConfigError(f"the env draws from {generator['bit_generator']}; only PCG64, NumPy's own, is recorded.")
        observation, info = self.env.reset(seed=seed, options=options)
        start = (options or {}).get("start")
        kept = {} if start is None else {"start": np.asarray(start, np.float64).tolist()}
        self._reset = {"seed": seed, "options": kept, "generator": generator}
        self._episode += 1
        self._written = False
        self._ended = (False, False)
        self._info = info
        self._moments = [self._moment(None, 0.0, observation, info)]
        return observation, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step the environment."""
        if not self._moments:
            raise UsageError("there is no episode to record yet: call reset() of the Recorder first.")
        kind = np.int64 if self._core.engine.config.action_type == "discrete" else np.float64
        observation, reward, terminated, truncated, info = self.env.step(action)
        kept = as_array(action, "the action", "one of the action space", ConfigError).astype(kind)
        self._info, self._ended = info, (bool(terminated), bool(truncated))
        self._moments.append(self._moment(kept, float(reward), observation, info))
        self._written = False
        if terminated or truncated:
            self.save()
        return observation, reward, terminated, truncated, info

    def _moment(self, action: Any, reward: float, observation: Any, info: dict[str, Any]) -> tuple[Any, ...]:
        laser = observation["laser"].copy() if self._laser else None
        pose = (info["x"], info["y"], info["heading"])
        distance, compass = observation["distance"].copy(), observation["compass"].copy()
        return action, reward, pose, distance, compass, observation_digest(observation), laser

    def recording(self, tracks: Mapping[str, Any] | None = None) -> Recording:
        """Return the running, or just ended, episode so far.

        Parameters
        ----------
        tracks : mapping of (n, 4) arrays, optional
            The agent's own, by name: step, x, y, heading, in the world's frame.

        Raises
        ------
        UsageError
            If there is none.
        ConfigError
            If a track has another shape.
        """
        if not self._moments:
            raise UsageError("there is no episode to record yet: call reset() of the Recorder first.")
        config = self._core.engine.config
        actions, rewards, poses, distance, compass, digests, laser = zip(*self._moments, strict=True)
        columns = 2 if config.action_type == "discrete" else 4
        distance, compass = np.concatenate(distance), np.stack(compass)
        claims = self._core.claims()
        return Recording(
            plans=tuple(config.plans),
            shipped=self._shipped,
            settings={name: getattr(config, name) for name in SETTINGS}
            | {name: asdict(getattr(config, name)) for name in SETTING_GROUPS},
            **self._reset,
            versions=versions(),
            map=self._core.floor_plan.name,
            terminated=self._ended[0],
            truncated=self._ended[1],
            info={name: self._info[name] for name in INFO.names or ()},
            actions=np.array(actions[1:], np.int64 if columns == 2 else np.float64).reshape(-1, columns),
            rewards=np.array(rewards[1:], np.float64),
            poses=np.array(poses, np.float64),
            distance=distance,
            compass=compass,
            laser=np.stack(laser) if self._laser else None,
            dead_reckoned=dead_reckon(distance, compass, poses[0][:2]),
            digests=np.array(digests, np.uint64),
            claims=claims[claims["step"] < len(poses)],  # a step that was interrupted may have judged one more
            tracks={name: _checked_track(name, track) for name, track in (tracks or {}).items()},
        )

    def save(self, tracks: Mapping[str, Any] | None = None) -> None:
        """Write the episode, unless it has no step, or is written already and no tracks are to be added."""
        if self.path is not None and self.steps and (tracks or not self._written):
            write_recording(self.recording(tracks), self.path)
            self._written = True

    def close(self) -> None:
        """Write the episode, and close the environment."""
        try:
            self.save()
        finally:
            super().close()


def observation_digest(observation: Mapping[str, np.ndarray]) -> int:
    """Return the first 64 bits of the BLAKE2b hash of laser, distance and compass, as bytes in that order."""
    digest = hashlib.blake2b(digest_size=8)
    for name in ("laser", "distance", "compass"):
        digest.update(np.ascontiguousarray(observation[name]).tobytes())
    return int.from_bytes(digest.digest(), "little")


def versions() -> dict[str, str]:
    """Return the versions of all that an episode's bits depend on."""
    packages = {name: importlib.metadata.version(name) for name in PACKAGES}
    return {"cyclic_env": __version__, "python": platform.python_version(), **packages, "machine": platform.machine()}


def _is_shipped(plan: FloorPlan) -> bool:
    return plan.name in map_names() and plan is load_floor_plan(plan.name)


def _checked_track(name: str, track: Any) -> np.ndarray:
    expected = "step, x, y, heading in 4 columns"
    array = as_array(track, f"track {name!r}", expected, ConfigError).astype(np.float64)
    if array.ndim != 2 or array.shape[1] != 4:
        raise ConfigError(f"track {name!r} has shape {array.shape}; expected {expected}.")
    return array


def write_recording(recording: Recording, path: str | Path) -> None:
    """Write a recording; the file is there whole or, if that fails, as it was.

    Raises
    ------
    RecordingError
        If it can't be written.
    """
    path = Path(path)
    header = {
        "layout": LAYOUT,
        "versions": recording.versions,
        "maps": [
            {"name": plan.name, "shipped": shipped, "yaml": floor_plan_to_text(plan)}
            for plan, shipped in zip(recording.plans, recording.shipped, strict=True)
        ],
        "settings": recording.settings,
        "seed": recording.seed,
        "options": recording.options,
        "generator": recording.generator,
        "map": recording.map,
        "terminated": recording.terminated,
        "truncated": recording.truncated,
        "info": recording.info,
    }
    arrays = {name: getattr(recording, name) for name in _ARRAYS if getattr(recording, name) is not None}
    arrays |= {TRACK + name: track for name, track in recording.tracks.items()}
    try:
        with atomic_write(path) as part, part.open("wb") as file:
            np.savez_compressed(file, header=np.frombuffer(json.dumps(header).encode(), np.uint8), **arrays)
    except OSError as error:
        raise RecordingError(f"{path}: can't be written: {error.strerror or error}.") from error


_ARRAYS: dict[str, tuple[str, int, tuple[int, ...]]] = {
    "actions": ("", 0, (-1,)),
    "rewards": ("f8", 0, ()),
    "poses": ("f8", 1, (3,)),
    "distance": ("f4", 1, ()),
    "compass": ("f4", 1, (2,)),
    "laser": ("f4", 1, (-1,)),
    "dead_reckoned": ("f8", 1, (3,)),
    "digests": ("u8", 1, ()),
    "claims": ("", -1, ()),
}
"""Type of each array ("": see `_checked_arrays`), its rows beyond T (-1: any number), and its columns (-1: any)."""


def read_recording(path: str | Path) -> Recording:
    """Read a recording.

    Raises
    ------
    RecordingError
        Naming the file: if it is missing, no recording, damaged, or of another layout.
    """
    path = Path(path)
    try:
        if not path.exists():
            raise RecordingError("there is no such file.")
        if not path.is_file():
            raise RecordingError("is no NPZ file, but a folder or a device.")
        if not zipfile.is_zipfile(path):
            raise RecordingError("is no NPZ file, or one that was cut off.")
        with np.load(path, allow_pickle=False) as file:
            if "header" not in file.files:
                raise RecordingError("is an NPZ file, but no recording: it has no header.")
            header = _checked_header(json.loads(file["header"].tobytes()))
            return Recording(**header, **_checked_arrays(file, header))
    except CyclicLoopError as error:
        raise RecordingError(f"{path}: {error}") from error
    except OSError as error:
        raise RecordingError(f"{path}: can't be read: {error.strerror or error}.") from error
    except Exception as error:  # a damaged file's bytes can be anything
        raise RecordingError(f"{path}: is damaged, or no recording ({short_repr(str(error))}).") from error


_HEADER: dict[str, type | tuple[type, ...]] = {
    "settings": dict,
    "seed": (int, type(None)),
    "options": dict,
    "generator": dict,
    "versions": dict,
    "map": str,
    "terminated": bool,
    "truncated": bool,
    "info": dict,
}


def _checked_header(header: Any) -> dict[str, Any]:
    """Return the fields of a `Recording` that a header holds."""
    layout = header.get("layout") if isinstance(header, dict) else None
    if layout != LAYOUT:
        raise RecordingError(f"is of layout {short_repr(layout)}; this version of cyclic_env reads layout {LAYOUT}.")
    for name, kind in _HEADER.items():
        if not isinstance(header.get(name), kind):
            raise RecordingError(f"is damaged: its header has no {name}.")
    for name in (*SETTINGS, *SETTING_GROUPS):
        if name not in header["settings"]:
            raise RecordingError(f"is damaged: its settings have no {name}.")
    for name in INFO.names or ():
        if name not in header["info"]:
            raise RecordingError(f"is damaged: its info has no {name}.")
    plans = tuple(floor_plan_from_text(entry["yaml"]) for entry in header["maps"])
    shipped = tuple(bool(entry["shipped"]) for entry in header["maps"])
    return {"plans": plans, "shipped": shipped} | {name: header[name] for name in _HEADER}


def _checked_arrays(file: np.lib.npyio.NpzFile, header: dict[str, Any]) -> dict[str, Any]:
    """Return the arrays of a `Recording` that a file holds, of the right types and shapes."""
    discrete = header["settings"]["action_type"] == "discrete"
    types = {"actions": np.dtype(np.int64 if discrete else np.float64), "claims": CLAIM}
    columns = {"actions": (2 if discrete else 4,), "laser": (header["settings"]["laser"]["num_beams"],)}
    arrays: dict[str, Any] = {}
    for name, (kind, extra, shape) in _ARRAYS.items():
        if name == "laser" and name not in file.files:
            continue
        if name not in file.files:
            raise RecordingError(f"is damaged: it has no array {name}.")
        array = arrays[name] = file[name]
        rows = len(array) if extra < 0 and array.ndim else len(arrays["actions"]) + extra
        expected = (rows, *columns.get(name, shape))
        if array.dtype != types.get(name, kind) or array.shape != expected:
            raise RecordingError(f"is damaged: {name} is {array.dtype} of shape {array.shape}; expected {expected}.")
        if name in MEASURED and not (np.abs(array) <= COORDINATE_MAX).all():
            raise RecordingError(
                f"is damaged: {name} has numbers that are not from {-COORDINATE_MAX:g} to {COORDINATE_MAX:g}."
            )
    arrays["tracks"] = {
        name.removeprefix(TRACK): _checked_track(name, file[name]) for name in file.files if name.startswith(TRACK)
    }
    return arrays


@dataclass(frozen=True, slots=True, kw_only=True)
class Replay:
    """What became of a recording that was replayed.

    Attributes
    ----------
    recording : Recording
    steps : int
        That were replayed: all, unless the episode ended earlier than it had.
    first_difference : int or None
        The first step, 0 being the reset, in which a bit differed.
    what : str
        What differed there; empty if nothing did.
    position_error_m : float
        Largest distance between a replayed and the recorded position.
    episode_return : float
    info : dict
        The last one.
    notes : tuple of str
        Versions and plans that are not as they were.
    """

    recording: Recording
    steps: int
    first_difference: int | None
    what: str
    position_error_m: float
    episode_return: float
    info: dict[str, Any]
    notes: tuple[str, ...]

    @property
    def equal(self) -> bool:
        """Whether every pose, observation, reward, claim and score is the same to the bit."""
        return self.first_difference is None

    def verdict(self) -> str:
        """Return the outcome and the notes, a line each."""
        total = f"{self.recording.steps:,} steps"
        if self.first_difference is None:
            first = f"bit-equal: all {total}"
        else:
            first = (
                f"not equal: the {self.what} differs first in step {self.first_difference:,} of {total}; "
                f"positions are up to {self.position_error_m:.3g} m off"
            )
        return "\n".join([first, *self.notes])


OnStep = Callable[[CyclicLoopEnv, int], None]
"""Called after the reset, as step 0, and after every step."""


def replay(
    recording: Recording | str | Path, *, render_mode: str | None = None, on_step: OnStep | None = None
) -> Replay:
    """Build a recording's environment anew, take its actions, and compare all that comes of them.

    Parameters
    ----------
    recording : Recording, str or path
    render_mode : {"human", "rgb_array"}, optional
        Of the environment.
    on_step : callable, optional

    Raises
    ------
    RecordingError
        If the file can't be read or its environment not be made.
    """
    if not isinstance(recording, Recording):
        path = recording
        recording = read_recording(path)
        try:
            return replay(recording, render_mode=render_mode, on_step=on_step)
        except RecordingError as error:
            raise RecordingError(f"{path}: {error}") from error
    env = recording.make_env(render_mode)
    try:
        try:
            observation, info = env.reset(options=recording.options or None)
        except FloorPlanError as error:
            raise RecordingError(f"its episode can't begin: {error}") from error
        first: tuple[int | None, str] = (None, "")
        step, reward, terminated, truncated, off, total = 0, 0.0, False, False, 0.0, 0.0
        while True:
            pose = np.array([info["x"], info["y"], info["heading"]])
            off = max(off, float(np.hypot(*(pose[:2] - recording.poses[step, :2]))))
            last = step == recording.steps
            differing = {
                "pose": pose.tobytes() != recording.poses[step].tobytes(),
                "observation": _observes_otherwise(observation, recording, step),
                "reward": step > 0 and reward != recording.rewards[step - 1],
                "end": not _ends_alike(terminated, truncated, recording, last),
                "list of claims": last and env.claims().tobytes() != recording.claims.tobytes(),
                "score": last and any(info.get(name) != value for name, value in recording.info.items()),
            }
            if first[0] is None and any(differing.values()):
                first = step, next(name for name, differs in differing.items() if differs)
            if on_step is not None:
                on_step(env, step)
            if last or terminated or truncated:
                break
            observation, reward, terminated, truncated, info = env.step(recording.actions[step])
            total += reward
            step += 1
    finally:
        env.close()
    return Replay(
        recording=recording,
        steps=step,
        first_difference=first[0],
        what=first[1],
        position_error_m=off,
        episode_return=total,
        info=info,
        notes=_notes(recording),
    )


def _observes_otherwise(observation: Mapping[str, np.ndarray], recording: Recording, step: int) -> bool:
    """Tell whether an observation differs from the digest, or from what was kept of the recorded one."""
    kept = {name: getattr(recording, name) for name in ("distance", "compass", "laser")}
    return observation_digest(observation) != int(recording.digests[step]) or any(
        observation[name].tobytes() != array[step].tobytes() for name, array in kept.items() if array is not None
    )


def _ends_alike(terminated: bool, truncated: bool, recording: Recording, last: bool) -> bool:
    """Tell whether the environment ends as it did; a wrapper's limit may have truncated the episode, or a person."""
    if not last:
        return not (terminated or truncated)
    return terminated == recording.terminated and truncated <= recording.truncated


def _notes(recording: Recording) -> tuple[str, ...]:
    """Say what is not as it was when the recording was made."""
    here = versions()
    made = {name: recording.versions.get(name, "an unknown version") for name in here}
    notes = [f"made with {name} {made[name]}, here it is {here[name]}" for name in here if made[name] != here[name]]
    for plan, shipped in zip(recording.plans, recording.shipped, strict=True):
        if shipped and not (plan.name in map_names() and _same(plan, load_floor_plan(plan.name))):
            notes.append(f"the plan {plan.name} that comes with cyclic_env has changed; replayed in the recorded one")
    return tuple(notes)


def _same(plan: FloorPlan, other: FloorPlan) -> bool:
    return plan.free_space.wkb == other.free_space.wkb and plan.start == other.start

"""The recorder: a Gymnasium wrapper that keeps the episodes of an environment."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.utils import seeding

from cyclic_env.atomic_write import check_writable
from cyclic_env.engine.building import INFO
from cyclic_env.envs.arguments import check_seed
from cyclic_env.envs.cyclic_loop import CyclicLoopEnv
from cyclic_env.errors import ConfigError, UsageError
from cyclic_env.floor_plans import FloorPlan, load_floor_plan, map_names
from cyclic_env.recording.format import Recording, check_track, observation_digest, versions, write_recording
from cyclic_env.trajectory.dead_reckoning import dead_reckon
from cyclic_env.validation import short_repr

ALTERING = (gymnasium.ActionWrapper, gymnasium.ObservationWrapper, gymnasium.RewardWrapper)
"""Wrappers that must not be inside the recorder, since they would alter what it records."""


class Recorder(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Records the episodes of an environment. It writes each one when it ends, when the next begins, or on `close`.

    Use it in a ``with`` statement, so that the file of an interrupted run is written, too.

    Parameters
    ----------
    env : CyclicLoopEnv
        It may be wrapped, but wrappers that alter actions, observations or rewards must go around the recorder.
    path : str or path, optional
        File of the first episode; the second one gets ``-2`` before the suffix, and so on. With None, nothing is
        written unless you call `write_recording`.
    laser : bool
        Whether to keep the scans, which makes the files about ten times larger. A replay measures them again.

    Raises
    ------
    ConfigError
        If the environment is not one of ours or is altered by a wrapper, or if the file can't be written.
    """

    def __init__(self, env: gymnasium.Env[Any, Any], path: str | Path | None = None, *, laser: bool = False) -> None:
        if not isinstance(env, gymnasium.Env) or not isinstance(env.unwrapped, CyclicLoopEnv):
            raise ConfigError(f"the env is {short_repr(env)}; expected a single CyclicLoop environment.")
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
        self._shipped = tuple(_is_shipped(plan) for plan in self._core.floor_plans)
        self._episode = 0
        self._written = True
        self._reset: dict[str, Any] = {}
        self._rows: list[tuple[Any, ...]] = []
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
        """Number of steps of the running episode so far."""
        return max(0, len(self._rows) - 1)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Write the last episode, unless it has been written, and begin another."""
        self.save()
        seed = check_seed(seed)
        generator = (self._core.np_random if seed is None else seeding.np_random(seed)[0]).bit_generator.state
        observation, info = self.env.reset(seed=seed, options=options)
        start = (options or {}).get("start")
        kept = {} if start is None else {"start": np.asarray(start, np.float64).tolist()}
        self._reset = {"seed": seed, "options": kept, "generator": generator}
        self._episode += 1
        self._written = False
        self._ended = (False, False)
        self._info = info
        self._rows = [self._row(None, 0.0, observation, info)]
        return observation, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step the environment and record the step."""
        self._check_begun()
        observation, reward, terminated, truncated, info = self.env.step(action)
        self._info, self._ended = info, (bool(terminated), bool(truncated))
        self._rows.append(self._row(np.array(action), float(reward), observation, info))
        self._written = False
        if terminated or truncated:
            self.save()
        return observation, reward, terminated, truncated, info

    def _row(self, action: Any, reward: float, observation: Any, info: dict[str, Any]) -> tuple[Any, ...]:
        laser = observation["laser"].copy() if self._laser else None
        pose = (info["x"], info["y"], info["heading"])
        distance, compass = observation["distance"].copy(), observation["compass"].copy()
        return action, reward, pose, distance, compass, observation_digest(observation), laser

    def _check_begun(self) -> None:
        if not self._rows:
            raise UsageError("there is no episode to record yet: call reset() of the Recorder first.")

    def recording(self, tracks: Mapping[str, Any] | None = None) -> Recording:
        """Return the episode so far, running or ended.

        Parameters
        ----------
        tracks : mapping of (n, 4) arrays, optional
            Tracks of the agent by name: step, x, y, heading, in the world's frame.

        Raises
        ------
        UsageError
            If there is no episode.
        ConfigError
            If a track has another shape.
        """
        self._check_begun()
        config = self._core.config
        actions, rewards, poses, distance, compass, digests, laser = zip(*self._rows, strict=True)
        kind, columns = (np.int64, 2) if config.action_type == "discrete" else (np.float64, 4)
        distance, compass = np.concatenate(distance), np.stack(compass)
        noise = [asdict(one) for one in config.sensor_noise]
        return Recording(
            plans=tuple(self._core.floor_plans),
            shipped=self._shipped,
            settings={name: value for name, value in asdict(config).items() if name != "map_name"}
            | {"noise": noise if len(noise) > 1 else noise[0]},
            **self._reset,
            versions=versions(),
            map=self._core.floor_plan.name,
            terminated=self._ended[0],
            truncated=self._ended[1],
            info={name: self._info[name] for name in INFO.names or ()},
            actions=np.array(actions[1:], kind).reshape(-1, columns),
            rewards=np.array(rewards[1:], np.float64),
            poses=np.array(poses, np.float64),
            distance=distance,
            compass=compass,
            laser=np.stack(laser) if self._laser else None,
            dead_reckoned=dead_reckon(distance, compass, poses[0][:2]),
            digests=np.array(digests, np.uint64),
            claims=self._core.claims(),
            tracks={name: check_track(name, track) for name, track in (tracks or {}).items()},
        )

    def save(self, tracks: Mapping[str, Any] | None = None) -> None:
        """Write the episode, if it has a step and has not been written yet, or to add tracks to its file."""
        if self.path is not None and self.steps and (tracks or not self._written):
            write_recording(self.recording(tracks), self.path)
            self._written = True

    def close(self) -> None:
        """Write the episode, and close the environment."""
        try:
            self.save()
        finally:
            super().close()


def _is_shipped(plan: FloorPlan) -> bool:
    return plan.name in map_names() and plan is load_floor_plan(plan.name)

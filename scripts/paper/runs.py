"""One run of the explorer, and what the report needs of it: scores, rows with the truth about them, and the way."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from agents.knn.config import ExplorerConfig, preset
from agents.knn.directions import sector_features
from agents.knn.explorer import KnnExplorer
from agents.knn.policy import KnnPolicy
from agents.slam.scan_filters import despeckle
from cyclic_env import CyclicLoopEnv
from cyclic_env.config import NoiseConfig, noise_from_name
from cyclic_env.task.judgement import true_returns
from cyclic_env.task.loop_closure import RETURNS
from cyclic_env.trajectory.metrics import ate

BEAM_ROUNDING = 0.5
"""Metres that the beams are whole multiples of, like the properties by default."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RunSettings:
    """All that a run depends on."""

    map: str
    preset: str = "paper"
    changes: Mapping[str, Any] = field(default_factory=dict)
    """Of the preset's settings, by name."""
    noise: str = "ideal"
    noise_scale: float = 1.0
    """Factor of all deviations and rates of the noise preset."""
    seed: int = 0
    range_max: float = 12.0
    """Reach of the laser, metres, of the environment and the explorer alike."""

    @property
    def config(self) -> ExplorerConfig:
        """The explorer's."""
        return preset(self.preset, **{"range_max": self.range_max, **self.changes})


@dataclass(frozen=True, slots=True, kw_only=True)
class RunRecord:
    """What is kept of a run. Of its n rows, i is an earlier one than i + 1."""

    metrics: dict[str, Any]
    """The last info's scalars, and counts and names of what the explorer has in its memory."""
    way: np.ndarray
    """True x, y and path length of every step, `(t + 1, 3)` float32, metres."""
    claims: np.ndarray
    """Judged claims, `(c,)` of `cyclic_env.task.path_history.CLAIM`."""
    step: np.ndarray
    """`(n,)`."""
    path: np.ndarray
    """Metres by the distance meter, `(n,)`."""
    heading: np.ndarray
    """True headings, `(n,)`, radians."""
    direction: np.ndarray
    """`(n,)`: 0 to 3 for north, east, south and west."""
    group: np.ndarray
    """`(n,)`."""
    features: np.ndarray
    """The explorer's properties ahead and back, `(n, 2, sectors)` int16."""
    beams: np.ndarray
    """Ranges in multiples of `BEAM_ROUNDING`, `(n, beams)` uint8."""
    truth: np.ndarray
    """`(n, n)` int8: how row i relates to an earlier row j, as `true_returns` tells it."""
    areas: np.ndarray
    """Open areas' list: true positions `(m, 2)`, metres."""

    @property
    def position(self) -> np.ndarray:
        """True positions of the rows, `(n, 2)`, metres."""
        return self.way[self.step, :2].astype(np.float64)

    @property
    def revisit(self) -> np.ndarray:
        """Which rows `(n,)` return to an earlier one."""
        return (self.truth == RETURNS).any(axis=1)


ARRAYS = tuple(entry.name for entry in fields(RunRecord) if entry.name != "metrics")


def scaled_noise(name: str, scale: float) -> NoiseConfig:
    """Return a noise preset with its deviations and rates multiplied; its correlation length stays."""
    noise = noise_from_name(name)
    names = [entry.name for entry in fields(NoiseConfig) if entry.name != "compass_field_length"]
    return replace(noise, **{name: scale * getattr(noise, name) for name in names})


def run_explorer(settings: RunSettings) -> RunRecord:
    """Run an episode to its end; with nothing left to explore, the explorer stands for the rest of it.

    Raises
    ------
    CyclicLoopError
        If the settings don't fit.
    """
    explorer = KnnPolicy(settings.config)
    noise = scaled_noise(settings.noise, settings.noise_scale)
    env = CyclicLoopEnv(settings.map, noise=noise, laser={"range_max": settings.range_max})
    observation, info = env.reset(seed=settings.seed)
    state, total, ending, headings = None, 0.0, "", [info["heading"]]
    while not ending:
        action, state = explorer.predict(observation, state)
        observation, reward, terminated, truncated, info = env.step(action)
        total += reward
        headings.append(info["heading"])
        if terminated:
            ending = "success"
        elif truncated:
            ending = state[0].stop_reason or "step budget"
    assert state is not None
    memory: KnnExplorer = state[0]
    tour = env.floor_plan.closed_tour()
    metrics = {
        **{name: value for name, value in info.items() if name != "reward_terms"},
        "return": total,
        "ending": ending,
        "tours": None if math.isnan(tour) else info["path_length_m"] / tour,
        "groups": len(memory.groups),
        "group_names": [group.name for group in memory.groups],
        "rows": memory.keyframes.count,
        "areas": len(memory.frontiers.listed),
        "area_states": [area.state for area in memory.frontiers.listed],
        "dead_reckoning_rms_m": _rms(memory.keyframes.odometry, memory.keyframes.step, env.trajectory()),
        "track_rms_m": _rms(memory.keyframes.pose, memory.keyframes.step, env.trajectory()),
    }
    record = _record(env, memory, metrics, np.array(headings))
    env.close()
    return record


def _rms(estimated: np.ndarray, steps: np.ndarray, way: np.ndarray) -> float:
    """Return how far positions `(n, 2+)` in the frame of the start are off the true way at their steps, rms, metres."""
    return ate(estimated[:, :2], way[steps, :2] - way[0, :2]) if len(steps) else 0.0


def _record(env: CyclicLoopEnv, memory: KnnExplorer, metrics: dict[str, Any], headings: np.ndarray) -> RunRecord:
    keyframes, way = memory.keyframes, env.trajectory()
    position = way[keyframes.step, :2]
    areas = [position[area.keyframe] + area.offset for area in memory.frontiers.listed]
    return RunRecord(
        metrics=metrics,
        way=way.astype(np.float32),
        claims=env.claims().copy(),
        step=keyframes.step.copy(),
        path=keyframes.path.copy(),
        heading=headings[keyframes.step],
        direction=keyframes.direction.astype(np.int8),
        group=keyframes.group.copy(),
        features=keyframes.features.astype(np.int16),
        beams=np.rint(keyframes.scan / BEAM_ROUNDING).astype(np.uint8),
        truth=true_returns(env.floor_plan, way, keyframes.step, env.config.closure),
        areas=np.array(areas).reshape(-1, 2),
    )


def drive_again(record: RunRecord, settings: RunSettings, laps: int, *, noise: str, seed: int = 0) -> RunRecord:
    """Return a run with its way driven again and again, in the same directions, as rows alone.

    The rows of a further lap lie anywhere between those of the first, and have scans of their own, with noise and
    without speckle. The truth is of the first two laps' rows if `laps` is 2, and else left out, `(0, 0)`.

    Parameters
    ----------
    record : RunRecord
    settings : RunSettings
        That gave it.
    laps : int
        In all.
    noise : str
        Preset of the laser's noise.
    seed : int
    """
    rng, config = np.random.default_rng(seed), settings.config
    # Between two steps a row may be nearer to a wall than the robot ever was, so a slim one takes the scans.
    slim = {"radius": 0.1, "substeps": 8}
    laser = {"range_max": settings.range_max}
    env = CyclicLoopEnv(settings.map, noise=noise, laser=laser, robot=slim, random_start=True)
    env.reset(seed=seed)
    rows, driven = len(record.step), float(record.way[-1, 2])
    features, beams, ways = [record.features], [record.beams], [record.way.astype(np.float64)]
    for lap in range(1, laps):
        shifted = record.way[record.step, 2] + rng.uniform(-0.5, 0.5, rows) * config.row_spacing
        along = np.clip(shifted, 0.0, driven)
        x, y = (np.interp(along, record.way[:, 2], record.way[:, axis]) for axis in range(2))
        ranges = np.empty((rows, record.beams.shape[1]))
        for row in range(rows):
            observation, _ = env.reset(options={"start": (x[row], y[row], record.heading[row])})
            despeckle(observation["laser"].astype(np.float64), ranges[row])
        found = [sector_features(scan, config.sectors, config.rounding) for scan in ranges]
        features.append(np.array(found, np.int16))
        beams.append(np.rint(ranges / BEAM_ROUNDING).astype(np.uint8))
        ways.append(np.column_stack([x, y, lap * driven + along]))
    way, first = np.concatenate(ways), len(record.way)
    step = np.concatenate([record.step, np.arange(first, len(way))])
    truth = np.zeros((0, 0), np.int8)
    if laps == 2:
        driven_so_far = np.maximum.accumulate(way[:, 2])  # some rows are shifted to before the one before them
        judged = np.column_stack([way[:, :2], driven_so_far])
        truth = true_returns(env.floor_plan, judged, step, env.config.closure)
    env.close()
    groups = int(record.group[-1]) + 1
    return replace(
        record,
        way=way.astype(np.float32),
        step=step,
        path=np.concatenate([record.path + lap * driven for lap in range(laps)]),
        heading=np.tile(record.heading, laps),
        direction=np.tile(record.direction, laps),
        group=np.concatenate([record.group + lap * groups for lap in range(laps)]),
        features=np.concatenate(features),
        beams=np.concatenate(beams),
        truth=truth,
    )

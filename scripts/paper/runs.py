"""Runs of the explorer, and what the report keeps of each: scores, trajectory, and the rows of the paper's tables."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from agents.knn.config import ExplorerConfig, preset
from agents.knn.directions import sector_features
from agents.knn.explorer import KnnExplorer
from agents.knn.policy import KnnPolicy
from agents.slam.scan_filters import despeckle
from cyclic_env import CyclicLoopEnv, NoiseConfig
from cyclic_env.config import noise_from_name
from cyclic_env.trajectory.metrics import ate

BEAM_ROUNDING = 0.5
"""Beams are stored as multiples of this many metres, as the sectors are by default."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RunSettings:
    """The settings of a run: everything that it depends on besides the code."""

    map: str = "killian_court"
    preset: str = "paper"
    changes: Mapping[str, Any] = field(default_factory=dict)
    """Fields of the preset that are changed."""
    noise: str = "ideal"
    noise_scale: float = 1.0
    """Factor on all standard deviations and rates of the noise preset."""
    random_start: bool = False
    seed: int = 0
    range_max: float = 12.0
    """Range of the laser, metres."""

    @property
    def config(self) -> ExplorerConfig:
        """The explorer's configuration."""
        return preset(self.preset, **{"range_max": self.range_max, **self.changes})


@dataclass(frozen=True, slots=True, kw_only=True)
class RunRecord:
    """The record of a run. Its n rows are in the order in which they were added."""

    settings: RunSettings
    metrics: dict[str, Any]
    """The scalars of the last info, the return, how the run ended, and the names of groups and states of open areas."""
    trajectory: np.ndarray
    """True x, y and path length at every step, `(t + 1, 3)`, metres."""
    claims: np.ndarray
    """Judged claims, `(c,)` records of `cyclic_env.task.loop_closure.CLAIM`."""
    step: np.ndarray
    """Step of each row, `(n,)`."""
    heading: np.ndarray
    """True heading at each row, `(n,)`, radians."""
    direction: np.ndarray
    """Compass direction of each row, `(n,)`: 0 to 3 for north, east, south and west."""
    group: np.ndarray
    """Group of each row, `(n,)`."""
    features: np.ndarray
    """Properties ahead and back, `(n, 2, sectors)`, in units of the explorer's rounding."""
    beams: np.ndarray
    """Ranges `(n, beams)` in units of `BEAM_ROUNDING`."""
    areas: np.ndarray
    """True positions `(m, 2)` of the open areas that were listed, metres."""

    @property
    def position(self) -> np.ndarray:
        """True positions of the rows, `(n, 2)`, metres."""
        return self.trajectory[self.step, :2]

    @property
    def path(self) -> np.ndarray:
        """Path length at each row, `(n,)`, metres."""
        return self.trajectory[self.step, 2]


def scaled_noise(name: str, scale: float) -> NoiseConfig:
    """Return a noise preset with its standard deviations and rates multiplied; its correlation length stays."""
    noise = noise_from_name(name)
    names = [entry.name for entry in fields(NoiseConfig) if entry.name != "compass_field_length"]
    return replace(noise, **{name: scale * getattr(noise, name) for name in names})


def run_explorer(settings: RunSettings) -> RunRecord:
    """Run one episode to its end; an explorer with no open areas left stands still for the rest of it."""
    policy = KnnPolicy(settings.config)
    env = CyclicLoopEnv(
        settings.map,
        noise=scaled_noise(settings.noise, settings.noise_scale),
        laser={"range_max": settings.range_max},
        random_start=settings.random_start,
    )
    observation, info = env.reset(seed=settings.seed)
    state, total, ending, headings = None, 0.0, "", [info["heading"]]
    while not ending:
        action, state = policy.predict(observation, state)
        observation, reward, terminated, truncated, info = env.step(action)
        total += reward
        headings.append(info["heading"])
        if terminated:
            ending = "success"
        elif truncated:
            ending = state[0].stop_reason or "step budget"
    assert state is not None
    scalars = {name: value for name, value in info.items() if name != "reward_terms"}
    record = _record(settings, env, state[0], np.array(headings), scalars | {"return": total, "ending": ending})
    env.close()
    return record


def _record(
    settings: RunSettings, env: CyclicLoopEnv, explorer: KnnExplorer, headings: np.ndarray, metrics: dict[str, Any]
) -> RunRecord:
    keyframes, trajectory = explorer.keyframes, env.trajectory()
    position = trajectory[keyframes.step, :2]
    areas = explorer.frontiers.listed
    return RunRecord(
        settings=settings,
        metrics={
            **metrics,
            "tour_m": env.floor_plan.closed_tour(),
            "group_names": [group.name for group in explorer.groups],
            "area_states": [area.state for area in areas],
            "dead_reckoning_ate_m": ate(keyframes.odometry, position - trajectory[0, :2]) if keyframes.count else 0.0,
        },
        trajectory=trajectory,
        claims=env.claims(),
        step=keyframes.step.copy(),
        heading=headings[keyframes.step],
        direction=keyframes.direction.astype(np.int8),
        group=keyframes.group.copy(),
        features=keyframes.features.astype(np.int16),
        beams=np.rint(keyframes.scan / BEAM_ROUNDING).astype(np.uint8),
        areas=np.array([position[area.keyframe] + area.offset for area in areas]).reshape(-1, 2),
    )


def drive_again(record: RunRecord, laps: int = 2) -> RunRecord:
    """Return the record of a run whose path is driven several times, in the same directions, with new scans.

    The rows of a further lap lie up to half a row spacing before or after those of the first one. Scans have the noise
    of the run, the groups of a further lap have numbers of their own, and no claims are made.

    Parameters
    ----------
    record : RunRecord
    laps : int
        Number of laps, including the first.
    """
    settings, config = record.settings, record.settings.config
    rng = np.random.default_rng(settings.seed)
    # A row between two steps may lie nearer to a wall than the robot ever was, so a slim robot takes the scans.
    slim = {"radius": 0.1, "substeps": 8}
    env = CyclicLoopEnv(
        settings.map, noise=settings.noise, laser={"range_max": settings.range_max}, robot=slim, random_start=True
    )
    env.reset(seed=settings.seed)
    rows, driven = len(record.step), float(record.trajectory[-1, 2])
    features, beams, ways = [record.features], [record.beams], [record.trajectory]
    for lap in range(1, laps):
        shifted = record.path + rng.uniform(-0.5, 0.5, rows) * config.row_spacing
        along = np.clip(shifted, 0.0, driven)
        x, y = (np.interp(along, record.trajectory[:, 2], record.trajectory[:, axis]) for axis in range(2))
        ranges = np.empty((rows, record.beams.shape[1]))
        for row in range(rows):
            observation, _ = env.reset(options={"start": (x[row], y[row], record.heading[row])})
            despeckle(observation["laser"].astype(np.float64), ranges[row])
        found = [sector_features(scan, config.sectors, config.rounding) for scan in ranges]
        features.append(np.array(found, np.int16))
        beams.append(np.rint(ranges / BEAM_ROUNDING).astype(np.uint8))
        ways.append(np.column_stack([x, y, lap * driven + along]))
    env.close()
    trajectory, groups = np.concatenate(ways), int(record.group[-1]) + 1
    return replace(
        record,
        trajectory=trajectory,
        claims=record.claims[:0],
        step=np.concatenate([record.step, np.arange(len(record.trajectory), len(trajectory))]),
        heading=np.tile(record.heading, laps),
        direction=np.tile(record.direction, laps),
        group=np.concatenate([record.group + lap * groups for lap in range(laps)]),
        features=np.concatenate(features),
        beams=np.concatenate(beams),
    )

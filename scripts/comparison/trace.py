"""The trace of an episode, from which a page replays it: where the robot was, what it believed, saw and claimed."""

from __future__ import annotations

import json
from base64 import b64decode, b64encode
from pathlib import Path
from typing import Any

import numpy as np

from cyclic_env.atomic_write import write_text_atomically
from cyclic_env.config import CoverageConfig
from cyclic_env.evaluation.privileged import Survey
from cyclic_env.floor_plans import FloorPlan, load_floor_plan
from cyclic_env.tiers import TIERS
from scripts.comparison.episode import EpisodeLog
from scripts.comparison.suite import Job

EVERY = 3
"""Steps from one frame to the next."""
CENTIMETRES = 5.0
"""Resolution of positions, cm: in 16 bits they reach 1.6 km."""

Trace = dict[str, Any]
"""Frames as base64 of little-endian arrays, the rest as plain numbers; see `trace_of`."""


def trace_of(job: Job, log: EpisodeLog) -> Trace:
    """Return the trace of an episode that has ended.

    Its keys are ``agent``, ``map``, ``tier``, ``frames`` (how many), ``every`` (steps from one to the next); ``poses``
    and ``beliefs`` (int16, x, y and heading of each frame, in 5 cm and 1/10,000 radian; beliefs may be missing),
    ``coverage`` (uint16, ten-thousandths), ``seen`` (uint16, the frame in which each free cell was first seen, row by
    row; 65535 for never), and ``claims``: the frame, the frame that was named, whether it was correct, whether it
    closed a cycle, both steps, the error in metres, and the winding numbers of its loop about the cycles.
    """
    plan, infos = load_floor_plan(job.map), log.all_infos()
    steps = np.unique(np.append(np.arange(0, len(infos), EVERY), len(infos) - 1))
    poses = np.column_stack([infos["x"], infos["y"], infos["heading"]])
    has_beliefs = all(belief is not None for belief in log.beliefs)
    start = np.array([*poses[0, :2], 0.0])
    beliefs = np.array([*log.beliefs, log.beliefs[-1]]) + start if has_beliefs else None
    return {
        "agent": job.agent,
        "map": job.map,
        "tier": job.tier,
        "frames": len(steps),
        "every": EVERY,
        "poses": pack_poses(poses[steps]),
        "beliefs": None if beliefs is None else pack_poses(beliefs[steps]),
        "coverage": _pack(np.rint(1e4 * infos["coverage"][steps]), "<u2"),
        "seen": _pack(first_seen(plan, job.tier, poses, infos["path_length_m"], steps), "<u2"),
        "claims": claims_of(plan, log),
    }


def first_seen(plan: FloorPlan, tier: str, poses: np.ndarray, path: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Return the frame `(free cells,)` in which each free cell was first seen; 65535 for those that never were.

    Parameters
    ----------
    plan : FloorPlan
    tier : str
    poses, path : (n, 3) and (n,)
        Poses and path lengths at every step.
    steps : (m,)
        The steps of the frames.
    """
    coverage = CoverageConfig()
    survey = Survey(plan, TIERS[tier].laser, coverage)
    marks = np.flatnonzero(np.diff(np.floor(path / coverage.scan_spacing), prepend=-1.0) > 0)
    frames = np.full(survey.num_cells, 65535, np.int64)
    for step in marks:
        survey.look(poses[step : step + 1])
        new = survey.seen & (frames == 65535)
        frames[new] = min(int(np.searchsorted(steps, step)), 65534)
    return frames


def claims_of(plan: FloorPlan, log: EpisodeLog) -> list[list[Any]]:
    """Return the judged claims of an episode, as `trace_of` describes them."""
    infos = log.all_infos()
    positions = np.column_stack([infos["x"], infos["y"]])
    matches = [*log.matches, _last_match(log)]
    found = []
    for step in np.flatnonzero(infos["claim_judged"]).tolist():
        match = max(matches[step], 0)
        loop = positions[match : step + 1]
        windings = [winding_number(loop, anchor) for anchor in plan.cycle_anchors] if len(loop) > 2 else []
        correct, new = bool(infos["claim_correct"][step]), bool(infos["new_cycle"][step])
        error = round(float(infos["claim_error_m"][step]), 2)
        found.append([step // EVERY, match // EVERY, correct, new, step, match, error, windings if correct else []])
    return found


def _last_match(log: EpisodeLog) -> int:
    """Return the step that a claim of the last action names; 0 for a discrete one, which names none."""
    *_, match = np.ravel(log.last_action).tolist()
    return round((match + 1) / 2 * len(log.infos)) if np.size(log.last_action) == 4 else 0


def winding_number(loop: np.ndarray, point: np.ndarray) -> int:
    """Return how often a closed path `(n, 2)` winds around a point `(2,)`, counter-clockwise."""
    around = np.vstack([loop, loop[:1]]) - point
    angles = np.unwrap(np.arctan2(around[:, 1], around[:, 0]))
    return round((angles[-1] - angles[0]) / (2 * np.pi))


def pack_poses(poses: np.ndarray) -> str:
    """Return poses `(n, 3)` as base64 text; see `trace_of`."""
    headings = (poses[:, 2] + np.pi) % (2 * np.pi) - np.pi
    return _pack(np.rint(np.column_stack([poses[:, :2] * 100 / CENTIMETRES, headings * 1e4])), "<i2")


def unpack_poses(text: str) -> np.ndarray:
    """Return the poses `(n, 3)` that `pack_poses` packed, rounded to its resolution."""
    values = np.frombuffer(b64decode(text), "<i2").reshape(-1, 3).astype(np.float64)
    return values * [CENTIMETRES / 100, CENTIMETRES / 100, 1e-4]


def _pack(values: np.ndarray, kind: str) -> str:
    return b64encode(values.astype(kind).tobytes()).decode()


def trace_path(folder: Path, job: Job) -> Path:
    """Return the file of a trace."""
    name = f"{job.agent}-{job.map}-{job.tier}-{job.seed}".replace("/", "_").replace(":", "_")
    return folder / "traces" / f"{name}.json"


def write_trace(folder: Path, job: Job, trace: Trace) -> None:
    """Write a trace to its file."""
    path = trace_path(folder, job)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text_atomically(path, json.dumps(trace))

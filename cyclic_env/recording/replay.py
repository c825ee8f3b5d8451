"""Replaying a recording: the same actions in a rebuilt environment, compared bit for bit."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cyclic_env.envs.cyclic_loop import CyclicLoopEnv
from cyclic_env.errors import FloorPlanError, RecordingError
from cyclic_env.floor_plans import FloorPlan, load_floor_plan, map_names
from cyclic_env.recording.format import Recording, observation_digest, read_recording, versions

FIRST_RULES = "1"
"""Version of the rules of loop closure by which recordings were judged before they stored it."""

OnStep = Callable[[CyclicLoopEnv, int], None]
"""Called after the reset, as step 0, and after every step."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Replay:
    """The result of replaying a recording.

    Attributes
    ----------
    recording : Recording
    steps : int
        Number of replayed steps: all, unless the replayed episode ended earlier.
    first_difference : int or None
        The first step in which a bit differed; step 0 is the reset.
    what : str
        What differed there; empty if nothing did.
    position_error_m : float
        Largest distance between a replayed and the recorded position.
    episode_return : float
    info : dict
        The last info.
    notes : tuple of str
        One line for each version and plan that differs from the recorded one.
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
        """Return the result and the notes, one per line."""
        total = f"{self.recording.steps:,} steps"
        if self.first_difference is None:
            first = f"bit-equal: all {total}"
        else:
            first = (
                f"not equal: the {self.what} differs first in step {self.first_difference:,} of {total}; "
                f"the largest position error is {self.position_error_m:.3g} m"
            )
        return "\n".join([first, *self.notes])


def replay(
    recording: Recording | str | Path, *, render_mode: str | None = None, on_step: OnStep | None = None
) -> Replay:
    """Rebuild a recording's environment, repeat its actions, and compare everything with the recording.

    Parameters
    ----------
    recording : Recording, str or path
    render_mode : {"human", "rgb_array"}, optional
        Render mode of the environment.
    on_step : OnStep, optional

    Raises
    ------
    RecordingError
        If the file can't be read or its environment can't be rebuilt.
    """
    if isinstance(recording, Recording):
        with closing(recording.make_env(render_mode)) as env:
            return _repeat(recording, env, on_step)
    path, recording = recording, read_recording(recording)
    try:
        return replay(recording, render_mode=render_mode, on_step=on_step)
    except RecordingError as error:
        raise RecordingError(f"{path}: {error}") from error


def _repeat(recording: Recording, env: CyclicLoopEnv, on_step: OnStep | None) -> Replay:
    """Repeat the actions of a recording in its rebuilt environment, and compare the results."""
    try:
        observation, info = env.reset(options=recording.options or None)
    except FloorPlanError as error:
        raise RecordingError(f"its episode can't begin: {error}") from error
    first_difference, what = None, ""
    step, reward, ended, position_error_m, episode_return = 0, 0.0, (False, False), 0.0, 0.0
    while True:
        error_m = np.hypot(info["x"] - recording.poses[step, 0], info["y"] - recording.poses[step, 1])
        position_error_m = max(position_error_m, float(error_m))
        differing = _difference(recording, step, env, (observation, reward, ended, info))
        if differing and first_difference is None:
            first_difference, what = step, differing
        if on_step is not None:
            on_step(env, step)
        if step == recording.steps or any(ended):
            break
        observation, reward, *ended, info = env.step(recording.actions[step])
        episode_return += reward
        step += 1
    return Replay(
        recording=recording,
        steps=step,
        first_difference=first_difference,
        what=what,
        position_error_m=position_error_m,
        episode_return=episode_return,
        info=info,
        notes=_notes(recording),
    )


def _difference(recording: Recording, step: int, env: CyclicLoopEnv, result: tuple[Any, ...]) -> str:
    """Name the first part of a step's result that differs from the recording; an empty string if none does."""
    observation, reward, (terminated, truncated), info = result
    kept = {name: getattr(recording, name) for name in ("distance", "compass", "laser")}
    last = step == recording.steps
    if np.array([info["x"], info["y"], info["heading"]]).tobytes() != recording.poses[step].tobytes():
        return "pose"
    if observation_digest(observation) != int(recording.digests[step]) or any(
        observation[name].tobytes() != array[step].tobytes() for name, array in kept.items() if array is not None
    ):
        return "observation"
    if step > 0 and reward != recording.rewards[step - 1]:
        return "reward"
    if not last and (terminated or truncated):
        return "end"
    if last and (terminated != recording.terminated or truncated > recording.truncated):
        return "end"  # a recording may be truncated where the environment is not, by the time limit of a wrapper
    if last and env.claims().tobytes() != recording.claims.tobytes():
        return "list of claims"
    if last and any(info.get(name) != value for name, value in recording.info.items()):
        return "score"
    return ""


def _notes(recording: Recording) -> tuple[str, ...]:
    """Return a line for each version and plan that differs from the recorded one."""
    here = versions()
    made = {name: recording.versions.get(name, "an unknown version") for name in here}
    rules_here, rules_made = here.pop("closure_rules"), recording.versions.get("closure_rules", FIRST_RULES)
    notes = [f"made with {name} {made[name]}; this is {here[name]}" for name in here if made[name] != here[name]]
    if rules_made != rules_here:
        notes.insert(0, f"older rules: made with version {rules_made} of the closure rules; this is {rules_here}")
    for plan, shipped in zip(recording.plans, recording.shipped, strict=True):
        if shipped and not (plan.name in map_names() and _is_same(plan, load_floor_plan(plan.name))):
            notes.append(f"the plan {plan.name} in cyclic_env has changed; the recorded one is replayed")
    return tuple(notes)


def _is_same(plan: FloorPlan, other: FloorPlan) -> bool:
    return plan.free_space.wkb == other.free_space.wkb and plan.start == other.start

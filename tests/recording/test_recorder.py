"""The recorder: what it keeps, when it writes, and what it refuses."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

from cyclic_env import ConfigError, CyclicLoopEnv, CyclicLoopVectorEnv, Recorder, read_recording, replay
from tests.helpers import bumping_actions


def test_an_interrupted_run_keeps_what_was_done(tmp_path: Path) -> None:
    def run_until_interrupted() -> None:
        with Recorder(CyclicLoopEnv("ring"), tmp_path / "run.npz") as recorder:
            recorder.reset(seed=0)
            for action in bumping_actions(40, 1)[:, 0]:
                recorder.step(action)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_until_interrupted()
    outcome = replay(tmp_path / "run.npz")
    assert outcome.equal
    assert (outcome.steps, outcome.recording.truncated) == (40, False)


def test_tracks_come_back(tmp_path: Path) -> None:
    recorder = Recorder(CyclicLoopEnv("ring"), tmp_path / "run.npz")
    recorder.reset(seed=0)
    recorder.step(np.zeros(4))
    assert recorder.recording().tracks == {}
    track = np.array([[0, 1.5, 2.5, 0.1], [1, 1.5, 2.5, 0.2]])
    recorder.save({"corrected": track})
    assert (read_recording(tmp_path / "run.npz").tracks["corrected"] == track).all()
    with pytest.raises(ConfigError, match="track 'bad' has shape"):
        recorder.save({"bad": track[:, :2]})


def test_an_episode_without_a_step_leaves_no_file(tmp_path: Path) -> None:
    with Recorder(CyclicLoopEnv("ring"), tmp_path / "run.npz") as recorder:
        recorder.reset(seed=0)
    assert list(tmp_path.iterdir()) == []


def test_a_refused_reset_or_action_leaves_the_recording_going(tmp_path: Path) -> None:
    with Recorder(CyclicLoopEnv("ring"), tmp_path / "run.npz") as recorder:
        recorder.reset(seed=0)
        recorder.step([1, 1, -1, 0])
        with pytest.raises(ConfigError):
            recorder.reset(seed=-1)
        with pytest.raises(ValueError, match="shape"):
            recorder.step([1, 1])
        recorder.step([1, 1, -1, 0])
    outcome = replay(tmp_path / "run.npz")
    assert outcome.equal
    assert outcome.steps == 2


class Halved(gymnasium.ActionWrapper[Any, Any, Any]):
    def action(self, action: Any) -> Any:
        return 0.5 * np.asarray(action)


def test_a_recorder_refuses_what_it_would_record_wrongly(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="Halved alters what is recorded"):
        Recorder(Halved(CyclicLoopEnv("ring")))
    with pytest.raises(ConfigError, match="expected a single CyclicLoop environment"):
        Recorder(CyclicLoopVectorEnv(2, "ring"))  # pyright: ignore[reportArgumentType]
    with pytest.raises(ConfigError, match="can't write to"):
        Recorder(CyclicLoopEnv("ring"), tmp_path)
    with pytest.raises(RuntimeError, match="call reset"):
        Recorder(CyclicLoopEnv("ring")).step(np.zeros(4))

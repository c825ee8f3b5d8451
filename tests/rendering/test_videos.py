"""Videos by the wrappers of other libraries."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

from cyclic_env import CyclicLoopEnv

pytest.importorskip("pygame")

FPS = CyclicLoopEnv.metadata["render_fps"]


def with_recorder(wrapper: str, folder: Path) -> tuple[Any, int]:
    """Return an environment in a library's video recorder, and the number of its rows."""
    settings: dict[str, Any] = {"map_name": "ring", "step_budget": 5, "render_mode": "rgb_array"}
    if wrapper == "RecordVideo":
        return gymnasium.wrappers.RecordVideo(gymnasium.make("CyclicLoop-v0", **settings), str(folder)), 1
    if wrapper == "vector.RecordVideo":
        envs = gymnasium.make_vec("CyclicLoop-v0", num_envs=2, **settings)
        return gymnasium.wrappers.vector.RecordVideo(envs, str(folder), video_aspect_ratio=(2, 1)), 2
    sb3 = pytest.importorskip("stable_baselines3.common.vec_env")
    from agents.rl.vec_env import CyclicLoopVecEnv

    return sb3.VecVideoRecorder(CyclicLoopVecEnv(2, **settings), str(folder), lambda step: step == 0, 5), 2


@pytest.mark.parametrize("wrapper", ["RecordVideo", "vector.RecordVideo", "VecVideoRecorder"])
def test_other_libraries_record_videos(wrapper: str, tmp_path: Path) -> None:
    moviepy = pytest.importorskip("moviepy")
    env, rows = with_recorder(wrapper, tmp_path / "video")
    env.reset()
    action = np.tile([1.0, 1.0, -1.0, 0.0], (rows, 1)).astype(np.float32)
    for _ in range(5):
        env.step(action[0] if wrapper == "RecordVideo" else action)
    env.close()
    (path,) = (tmp_path / "video").glob("*.mp4")
    with moviepy.VideoFileClip(str(path)) as clip:
        assert clip.fps == FPS
        assert np.ptp(clip.get_frame(0)) > 100
        assert clip.duration >= 5 / FPS

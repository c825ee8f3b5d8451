"""Recordings: they replay to the bit, say where they don't, and survive what goes wrong."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

import cyclic_env.recording.format as recording_format
from cyclic_env import (
    CyclicLoopEnv,
    CyclicLoopVectorEnv,
    FloorPlan,
    Recorder,
    RecordingError,
    load_floor_plan,
    map_names,
    read_recording,
    replay,
    write_floor_plan,
)
from cyclic_env.floor_plans import floor_plan_from_text, floor_plan_to_text
from cyclic_env.recording.format import observation_digest, write_recording
from cyclic_env.trajectory.dead_reckoning import dead_reckon
from tests.helpers import bumping_actions, load_script, roll_out

STEPS = 150
main = load_script("replay").main


def record(env: gymnasium.Env[Any, Any], path: Path, *, steps: int = STEPS, laser: bool = False, **reset: Any) -> Path:
    """Record an episode of driving into walls; return its file."""
    with Recorder(env, path, laser=laser) as recorder:
        recorder.reset(**reset)
        for action in bumping_actions(steps, 1)[:, 0]:
            *_, terminated, truncated, _ = recorder.step(action)
            if terminated or truncated:
                break
    return path


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a recording of a noisy run on the ring."""
    return record(CyclicLoopEnv("ring", noise="typical"), tmp_path_factory.mktemp("rec") / "run.npz", seed=3)


def changed(file: Path, path: Path, header: dict[str, Any] | None = None, **arrays: np.ndarray | None) -> Path:
    """Write a copy of a recording with other entries in the header, or other arrays (None: without)."""
    with np.load(file, allow_pickle=False) as old:
        entries: dict[str, Any] = {name: old[name] for name in old.files}
    text = json.loads(entries["header"].tobytes()) | (header or {})
    entries["header"] = np.frombuffer(json.dumps(text).encode(), np.uint8)
    entries = {name: value for name, value in (entries | arrays).items() if value is not None}
    np.savez_compressed(path, **entries)
    return path


@pytest.mark.parametrize("name", map_names())
def test_a_plan_written_as_text_reads_back_to_the_bit(name: str) -> None:
    plan = load_floor_plan(name)
    again = floor_plan_from_text(floor_plan_to_text(plan))
    assert again.free_space.wkb == plan.free_space.wkb
    assert (again.name, again.start, again.centrelines) == (plan.name, plan.start, plan.centrelines)


SETTINGS: dict[str, dict[str, Any]] = {
    "ideal": {},
    "poor": {"noise": "poor"},
    "own noise": {"noise": {"compass_white_deg": 0.1, "laser_sigma": 1 / 3}},
    "twist": {"action_type": "twist", "robot": {"dt": 0.1, "radius": 0.2}},
    "random start": {"random_start": True, "noise": "calibrated"},
    "other rules": {
        "closure": {"gap": 3.0, "leave_radius": 3.5},
        "reward": {"time": -1 / 3},
        "laser": {"num_beams": 45},
    },
    "ends early": {"step_budget": 60},
    "ends at a wall": {"terminate_on_collision": True},
    "a pool": {"map_name": ["ring", "grid", "office"], "noise": "calibrated"},
}


@pytest.mark.parametrize("case", SETTINGS)
def test_a_replay_is_equal_to_the_bit_whatever_the_settings(case: str, tmp_path: Path) -> None:
    settings = {"map_name": "ring", **SETTINGS[case]}
    env = CyclicLoopEnv(**settings)
    outcome = replay(record(env, tmp_path / "run.npz", seed=5))
    assert outcome.equal, outcome.verdict()
    assert outcome.notes == ()
    assert outcome.recording.map == env.floor_plan.name
    assert outcome.position_error_m == 0


def test_discrete_actions_replay(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    with Recorder(CyclicLoopEnv("ring", action_type="discrete"), tmp_path / "run.npz") as recorder:
        recorder.reset(seed=0)
        for drive in rng.integers(0, 5, 100):
            recorder.step([drive, 1])
    outcome = replay(tmp_path / "run.npz")
    assert outcome.equal
    assert outcome.recording.actions.dtype == np.int64


def test_an_episode_without_a_seed_and_with_a_start_replays(tmp_path: Path) -> None:
    with Recorder(CyclicLoopEnv("ring", noise="typical"), tmp_path / "run.npz") as recorder:
        recorder.reset(seed=1)
        for action in bumping_actions(20, 1)[:, 0]:
            recorder.step(action)
        recorder.reset(options={"start": np.array([24.0, 5.0, 1.0])})
        for action in bumping_actions(20, 1, seed=1)[:, 0]:
            recorder.step(action)
    first, second = replay(tmp_path / "run.npz"), replay(tmp_path / "run-2.npz")
    assert first.equal
    assert second.equal
    assert (first.recording.seed, second.recording.seed) == (1, None)
    assert second.recording.poses[0] == pytest.approx([24.0, 5.0, 1.0])


def test_a_time_limit_around_the_env_is_no_difference(tmp_path: Path) -> None:
    env = gymnasium.make("CyclicLoop-v0", map_name="ring", max_episode_steps=30)
    recording = replay(record(env, tmp_path / "run.npz", seed=0))
    assert recording.equal
    assert (recording.steps, recording.recording.truncated) == (30, True)


def test_a_plan_of_ones_own_is_in_the_file(tmp_path: Path, square_room: FloorPlan) -> None:
    skewed = FloorPlan("ring", square_room.free_space, (4 / 3, 5 / 3, 0.1 + 0.2))
    path = tmp_path / "plan.yaml"
    write_floor_plan(square_room, path)
    envs = CyclicLoopEnv(skewed), CyclicLoopEnv(str(path))
    path.unlink()
    for number, env in enumerate(envs):
        outcome = replay(record(env, tmp_path / f"run{number}.npz", seed=0))
        assert outcome.equal
        assert outcome.notes == ()


def test_the_arrays_are_what_was_seen(tmp_path: Path) -> None:
    env = CyclicLoopEnv("ring", noise="typical")
    path = record(env, tmp_path / "run.npz", seed=2, laser=True)
    other = CyclicLoopEnv("ring", noise="typical")
    kept, rollout = read_recording(path), roll_out(other, bumping_actions(STEPS, 1)[:, 0], seed=2)
    laser, distance, compass = ([step[0][name] for step in rollout] for name in ("laser", "distance", "compass"))
    observation, info = rollout[-1][0], rollout[-1][-1]
    assert kept.laser is not None
    assert (kept.laser == np.stack(laser)).all()
    assert (kept.poses == [[step[-1][name] for name in ("x", "y", "heading")] for step in rollout]).all()
    assert (kept.rewards == [step[1] for step in rollout[1:]]).all()
    assert (kept.claims == other.claims()).all()
    assert len(kept.claims)
    assert (kept.dead_reckoned == dead_reckon(distance, compass, other.trajectory()[0, :2])).all()
    assert int(kept.digests[-1]) == observation_digest(observation)
    assert {name: info[name] for name in kept.info} == kept.info
    assert (kept.noise, kept.seed, kept.dt, kept.times[-1]) == ("typical", 2, 0.2, pytest.approx(0.2 * STEPS))


def test_a_row_of_a_batch_makes_the_recorded_rewards(file: Path) -> None:
    envs = CyclicLoopVectorEnv(3, "ring", noise="typical")
    envs.reset(seed=[9, 3, 8])
    kept = read_recording(file)
    for action, reward in zip(kept.actions, kept.rewards, strict=True):
        assert envs.step(np.tile(action, (3, 1)))[1][1] == reward


@pytest.mark.parametrize(
    ("name", "row", "what", "step"),
    [
        ("poses", 70, "pose", 70),
        ("digests", 70, "observation", 70),
        ("rewards", 69, "reward", 70),
        ("actions", 69, "pose", 70),
        ("poses", 0, "pose", 0),
        ("claims", -1, "list of claims", STEPS),
    ],
)
def test_a_changed_bit_is_found_where_it_is(
    name: str, row: int, what: str, step: int, file: Path, tmp_path: Path
) -> None:
    with np.load(file) as old:
        array = old[name]
    if name == "claims":
        array = array[:-1]
    elif name == "actions":
        array[row, :2] = 0.123
    elif name == "digests":
        array[row] ^= np.uint64(1)
    else:
        array[row] = np.nextafter(array[row], np.inf)
    outcome = replay(changed(file, tmp_path / "run.npz", **{name: array}))
    assert (outcome.equal, outcome.first_difference, outcome.what) == (False, step, what)
    assert f"the {what} differs first in step {step} of {STEPS} steps" in outcome.verdict()
    assert (outcome.position_error_m > 0.01) == (name == "actions")


def test_an_episode_that_ends_too_early_is_a_difference(file: Path, tmp_path: Path) -> None:
    settings = json.loads(np.load(file)["header"].tobytes())["settings"]
    path = changed(file, tmp_path / "run.npz", {"settings": settings | {"terminate_on_collision": True}})
    outcome = replay(path)
    assert not outcome.equal
    assert outcome.steps < STEPS
    assert outcome.what == "reward"  # the first contact ends it, and is charged the rest of the budget


def test_other_versions_and_a_changed_plan_are_notes(file: Path, tmp_path: Path) -> None:
    header = json.loads(np.load(file)["header"].tobytes())
    header["versions"]["pymunk"] = "6.0.0"
    del header["versions"]["closure_rules"]
    header["maps"][0]["yaml"] = header["maps"][0]["yaml"].replace("heading: 0.0", "heading: 0.5")
    outcome = replay(changed(file, tmp_path / "run.npz", header))
    rules, made, plan = outcome.verdict().splitlines()[1:]
    assert rules.startswith("older rules: made with version 1 of the closure rules; this is ")
    assert made.startswith("made with pymunk 6.0.0; this is 7.")
    assert plan.startswith("the plan ring in cyclic_env has changed")
    assert outcome.first_difference == 0


def test_a_long_run_of_killian_court_is_small(tmp_path: Path) -> None:
    path = record(CyclicLoopEnv(noise="typical"), tmp_path / "run.npz", steps=7000, seed=0)
    assert read_recording(path).steps == 7000
    assert path.stat().st_size < 1e6


def test_a_failed_write_leaves_the_file_as_it_was(file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = changed(file, tmp_path / "run.npz")
    before = path.read_bytes()

    def full(handle: Any, **arrays: Any) -> None:
        handle.write(b"half of it")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(recording_format.np, "savez_compressed", full)
    with pytest.raises(RecordingError, match=r"run\.npz: can't be written: No space left on device\."):
        write_recording(read_recording(path), path)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def bad_files(file: Path, folder: Path) -> dict[Path, str]:
    """Return files that are not recordings, and what the error says about each."""
    whole = file.read_bytes()
    middle = len(whole) // 2
    damaged = whole[:middle] + bytes([whole[middle] ^ 0xFF]) + whole[middle + 1 :]
    for name, data in {"empty": b"", "text": b"hello", "cut": whole[:middle], "damaged": damaged}.items():
        (folder / name).write_bytes(data)
    np.savez(folder / "other.npz", a=np.zeros(3))
    np.savez(folder / "pickle.npz", header=np.array([{}, None], object))
    header = json.loads(np.load(file)["header"].tobytes())
    changed(file, folder / "layout.npz", {"layout": 7})
    changed(file, folder / "plan.npz", {"maps": [header["maps"][0] | {"yaml": "start: {x: 1"}]})
    changed(file, folder / "setting.npz", {"settings": header["settings"] | {"robot": {"leg": 2}}})
    changed(file, folder / "generator.npz", {"generator": {"bit_generator": "MT19937"}})
    changed(file, folder / "missing.npz", rewards=None)
    changed(file, folder / "short.npz", rewards=np.zeros(3))
    return {
        folder / "nowhere.npz": "there is no such file",
        **{folder / name: "is not an NPZ file, or was cut off" for name in (".", "empty", "text", "cut")},
        **{folder / name: "is damaged, or not a recording" for name in ("damaged", "pickle.npz", "missing.npz")},
        folder / "other.npz": "it has no header",
        folder / "layout.npz": "has layout 7; this version of cyclic_env reads layout 1",
        folder / "plan.npz": "not valid YAML",
        folder / "setting.npz": "unknown field of RobotConfig 'leg'",
        folder / "generator.npz": "can't be rebuilt",
        folder / "short.npz": "rewards is float64 of shape (3,)",
    }


def test_a_bad_file_gets_one_line_that_names_it(file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for path, message in bad_files(file, tmp_path).items():
        assert main([str(path)]) == 2, path
        said = capsys.readouterr().err
        assert said.startswith(f"replay.py: {path}: "), path
        assert message in said, path
        assert said.count("\n") == 1, path


def test_the_script_says_bit_equal_and_prints_the_scores(
    file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from PIL import Image

    assert main([str(file), "--gif", str(tmp_path / "new" / "run.gif")]) == 0
    said = capsys.readouterr().out
    kept = read_recording(file)
    assert said.startswith(f"bit-equal: all {STEPS} steps")
    assert "ring, typical, seed 3" in said
    assert f"false claims  {kept.info['false_claims']} of {kept.info['claims']}" in said
    with Image.open(tmp_path / "new" / "run.gif") as animation:
        assert getattr(animation, "n_frames", 1) > 10


def test_the_script_fails_where_a_bit_differs(file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    distance = read_recording(file).distance.copy()
    distance[20] += 0.5
    assert main([str(changed(file, tmp_path / "run.npz", distance=distance))]) == 1
    assert "not equal: the observation differs first in step 20 of 150 steps" in capsys.readouterr().out


def test_a_replay_does_not_write_over_its_recording(file: Path, tmp_path: Path) -> None:
    path = changed(file, tmp_path / "run.npz")
    before = path.read_bytes()
    assert main([str(path), "--gif", str(path)]) == 2
    assert path.read_bytes() == before

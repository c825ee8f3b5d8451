"""The command that plays a recorded run: a slice closes its loop, the whole run all of them, and files say so."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from agents.registry import make_agent
from cyclic_env import RecordedRun, RobotLog, read_robot_log
from cyclic_env.recording.robot_log import write_robot_log
from cyclic_env.trajectory.poses import relative
from cyclic_env.trajectory.readers import read_claims, read_trajectory
from tests.helpers import load_script
from tests.scripts.conftest import Refused

main = load_script("run_recorded").main
judge = load_script("judge").main


@pytest.fixture(scope="module")
def slice_150_m() -> RobotLog:
    """The first 150 m of the real run, which close its first loop."""
    return read_robot_log("killian_run")[:306]


def test_a_slice_closes_its_loop_and_can_be_judged_again(
    slice_150_m: RobotLog, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_robot_log(slice_150_m, tmp_path / "slice.npz")
    out, scores_file = tmp_path / "out", tmp_path / "scores.json"
    assert main(["--log", str(tmp_path / "slice.npz"), "--out", str(out), "--json", str(scores_file)]) == 0
    scores = json.loads(scores_file.read_text())
    assert (scores["false_claims"], scores["cycles_closed"]) == (0, 1)
    assert scores["revisits_recognised"] == scores["revisits"] == 1
    assert scores["row_recall"] > 0.5
    assert scores["claims"] > 3
    assert scores["gates"][0]["row_recall"] == scores["row_recall"]
    assert scores["median_ms_per_scan"] > 0
    assert (out / "run.png").stat().st_size > 10_000
    assert len(read_trajectory(out / "track.tum").times) == 306
    assert len(read_trajectory(out / "pose_graph.g2o").times) == 306
    loops, poses = read_claims(out / "pose_graph.g2o"), read_trajectory(out / "track.tum").poses
    ends = np.column_stack([loops.matches, loops.times]).astype(int)
    assert len(ends) > 3
    assert loops.measured is not None
    moved = relative(poses[ends[:, 0]], poses[ends[:, 1]])
    assert np.median(np.hypot(*(moved - loops.measured)[:, :2].T)) < 0.1
    capsys.readouterr()
    again = tmp_path / "again.json"
    files = ["--reference", str(out / "reference.tum"), "--claims", str(out / "claims.csv"), "--json", str(again)]
    assert judge([*files, "--map", "killian_court"]) == 0
    judged = json.loads(again.read_text())
    for name in ("claims", "false_claims", "revisits", "revisits_recognised", "cycles_closed", "row_recall"):
        assert judged[name] == scores[name]


@pytest.mark.parametrize("detector", ["paper", "position", "scans", "sectors", "panorama"])
def test_other_detectors_are_scored_beside_it(detector: str, slice_150_m: RobotLog, tmp_path: Path) -> None:
    write_robot_log(slice_150_m[::3], tmp_path / "slice.npz")
    assert main(["--log", str(tmp_path / "slice.npz"), "--out", str(tmp_path), "--detector", detector]) == 0
    scores = json.loads((tmp_path / "scores.json").read_text())
    assert scores["detector"] == detector
    assert 0 <= scores["row_recall"] <= 1
    ours = scores["definitions"][0]
    assert ours["rows"] > 10
    if detector not in ("paper", "position"):
        assert ours["right"] + ours["wrong"] > 10
        assert len(ours["thresholds"]) > 10


def test_a_log_without_a_reference_is_played_and_not_judged(
    slice_150_m: RobotLog, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bare = dataclasses.replace(slice_150_m[:60], reference=None, map_name=None, map_transform=None)
    write_robot_log(bare, tmp_path / "bare.npz")
    assert main(["--log", str(tmp_path / "bare.npz"), "--out", str(tmp_path), "--gate", "0.05"]) == 0
    assert "not judged: the log has no reference" in capsys.readouterr().out
    assert json.loads((tmp_path / "scores.json").read_text())["claims"] == 0
    assert not np.isnan(read_trajectory(tmp_path / "track.tum").poses).any()
    assert not (tmp_path / "reference.tum").exists()
    assert main(["--log", str(tmp_path / "bare.npz"), "--out", str(tmp_path), "--map", "ring"]) == 2
    assert "has no reference poses" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--detector", "maper"], "Did you mean 'mapper'"),
        (["--gate", "0.05;0.1"], "shares from 0 to 1"),
        (["--gate", "0"], "shares from 0 to 1"),
        (["--gate", "nan"], "shares from 0 to 1"),
        (["--gate", "0.1,0.2", "--detector", "paper"], "paper has no gate"),
        (["--log", "nothing.log"], "no such file"),
        (["--map", "killian_cort"], "Did you mean 'killian_court'"),
    ],
)
def test_bad_options_get_one_line(arguments: list[str], message: str, tmp_path: Path, refused: Refused) -> None:
    assert message in refused(main, [*arguments, "--out", str(tmp_path / "out")])


@pytest.mark.slow
def test_the_whole_run_closes_every_loop_without_a_false_claim(tmp_path: Path) -> None:
    assert main(["--out", str(tmp_path), "--gate", "0.06,0.04,0.12"]) == 0
    scores = json.loads((tmp_path / "scores.json").read_text())
    assert scores["row_recall"] >= 0.9
    assert scores["row_returns"] > 1500
    assert scores["revisits_recognised"] == scores["revisits"]
    assert scores["median_ms_per_scan"] < 20
    for gate in scores["gates"]:
        assert (gate["false_claims"], gate["cycles_closed"]) == (0, 6)
        assert abs(gate["row_recall"] - scores["row_recall"]) <= 0.03
    run = RecordedRun()
    policy, state, ended = make_agent("watcher", run), None, False
    observation, info = run.reset()
    while not ended:
        action, state = policy.predict(observation, state)
        observation, _, _, ended, info = run.step(action)
    for name in ("claims", "false_claims", "revisits", "revisits_recognised", "cycles_closed"):
        assert scores[name] == info[name]

"""The comparison: paired runs, a table that grows and survives, agents that misbehave, and what is said of it all."""

from __future__ import annotations

import csv
import math
import time
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from agents import make_agent
from cyclic_env.tiers import TIERS
from scripts.comparison.episode import EpisodeLog, run_episode
from scripts.comparison.measures import TIMES, coverage_curve, path_to
from scripts.comparison.runner import run_job
from scripts.comparison.suite import SUITES, Job, jobs_of
from scripts.comparison.summary import differences, rank
from scripts.comparison.table import DONE, RunTable
from scripts.comparison.trace import pack_poses, unpack_poses, winding_number
from tests.helpers import load_script
from tests.scripts.conftest import Refused

compare_main = load_script("compare").main
QUICK = ["--maps", "ring", "--noise", "calibrated", "--seeds", "2", "--processes", "1", "--no-report"]


class Broken:
    """Drives as the wall follower for five steps, and then does what it shouldn't."""

    def __init__(self, env: Any, fault: str) -> None:
        self.inner, self.fault, self.steps = make_agent("circling", env), fault, 0

    def predict(self, observation: Any, state: Any = None, **options: Any) -> Any:
        self.steps += 1
        actions, state = self.inner.predict(observation, state, options.get("episode_start"))
        if self.steps <= 5:
            return actions, state
        if self.fault == "raises":
            raise ValueError("no idea")
        if self.fault == "sleeps":
            time.sleep(60)
        wrong = {"nan": actions * np.nan, "shape": actions[:, :2], "text": "left", "tuple": actions}[self.fault]
        return wrong if self.fault == "tuple" else (wrong, state)


def raises(env: Any) -> Broken:
    return Broken(env, "raises")


def nan(env: Any) -> Broken:
    return Broken(env, "nan")


def shape(env: Any) -> Broken:
    return Broken(env, "shape")


def text(env: Any) -> Broken:
    return Broken(env, "text")


def only_actions(env: Any) -> Broken:
    return Broken(env, "tuple")


def sleeps(env: Any) -> Broken:
    return Broken(env, "sleeps")


HERE = "tests.scripts.test_compare"


def rows_of(folder: Path) -> list[dict[str, str]]:
    """Return the rows of a table, without the columns that differ from run to run."""
    with (folder / "runs.csv").open(newline="") as file:
        return [{name: row[name] for name in row if name not in TIMES} for row in csv.DictReader(file)]


def test_a_comparison_runs_once_grows_by_an_agent_and_can_be_verified(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = [*QUICK, "--out", str(tmp_path)]
    assert compare_main(["--agents", "circling", *arguments]) == 0
    first = rows_of(tmp_path)
    assert [(row["agent"], row["seed"], row["status"]) for row in first] == [
        ("circling", "0", "done"),
        ("circling", "1", "done"),
    ]
    assert compare_main(["--agents", "circling,oracle", *arguments]) == 0
    assert [row for row in rows_of(tmp_path) if row["agent"] == "circling"] == first
    assert {(row["agent"], row["privileged"]) for row in rows_of(tmp_path)} == {
        ("circling", "False"),
        ("oracle", "True"),
    }
    assert compare_main(["--verify", "2", "--agents", "oracle", *arguments]) == 0
    assert "2 are the same, 0 differ" in capsys.readouterr().out
    table = tmp_path / "runs.csv"
    table.write_text(table.read_text().replace(first[0]["return"], "1.5"))
    assert compare_main(["--verify", "9", "--agents", "circling", *arguments]) == 1
    assert "return was 1.5, is" in capsys.readouterr().out
    monkeypatch.setattr("scripts.comparison.runner.run_episode", None)
    assert compare_main(["--agents", "circling,oracle", *arguments]) == 0


def test_the_same_seed_is_the_same_start_and_noise_for_all_agents() -> None:
    logs = [EpisodeLog(), EpisodeLog()]
    jobs = [
        Job(tier="calibrated", map="ring", seed=3, start="random", agent=name)
        for name in ("circling", "standing_still")
    ]

    for job, log in zip(jobs, logs, strict=True):
        run_episode(job, log, 60)
    poses = [log.infos[0][["x", "y", "heading"]].item() for log in logs]
    assert poses[0] == poses[1]
    other = run_job(Job(tier="calibrated", map="ring", seed=4, start="random", agent="circling"), 60).row
    assert other["status"] == DONE
    assert other["path_length_m"] != logs[0].final["path_length_m"]


def test_a_table_that_was_cut_off_is_completed_to_that_of_an_uninterrupted_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["--agents", "circling,to_and_fro", *QUICK, "--out"]
    assert compare_main([*arguments, str(tmp_path / "whole")]) == 0
    cut = tmp_path / "cut"
    cut.mkdir()
    lines = (tmp_path / "whole" / "runs.csv").read_text().splitlines()
    (cut / "runs.csv").write_text("\n".join([lines[0], lines[3], "rubbish,,", lines[1][:200]]))
    assert compare_main([*arguments, str(cut)]) == 0
    assert "2 damaged lines" in capsys.readouterr().out
    assert rows_of(cut) == rows_of(tmp_path / "whole")
    assert "rubbish" in (cut / "runs.damaged.csv").read_text()


def test_an_interrupted_comparison_keeps_what_has_ended_and_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["--agents", "circling,to_and_fro", *QUICK, "--out", str(tmp_path)]

    def interrupted(self: Any, scan: np.ndarray) -> tuple[float, float]:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("agents.scripted.ToAndFroAgent.drive", interrupted)
        assert compare_main(arguments) == 130
    assert "the same command goes on" in capsys.readouterr().err
    assert [row["agent"] for row in rows_of(tmp_path)] == ["circling"]
    assert compare_main(arguments) == 0
    assert len(rows_of(tmp_path)) == 4


@pytest.mark.parametrize(
    ("agent", "reason"),
    [
        ("raises", "step 5: ValueError: no idea"),
        ("nan", "step 6: ActionError"),
        ("shape", "step 6: ActionError"),
        ("text", "step 6: ActionError"),
        ("only_actions", "step 6: ConfigError: the policy's predict returned"),
        ("sleeps", "step 5: TimeLimit"),
    ],
)
def test_an_agent_that_misbehaves_fails_alone_and_it_is_said_where(
    agent: str, reason: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["--agents", f"{HERE}:{agent},circling", *QUICK, "--seeds", "1", "--out", str(tmp_path)]
    assert compare_main([*arguments, "--time-limit", "3" if agent == "sleeps" else "60"]) == 0
    fine, failed = sorted(rows_of(tmp_path), key=lambda row: row["agent"])
    assert failed["status"] == "failed"
    assert reason in failed["error"]
    assert reason in capsys.readouterr().out
    assert fine["status"] == "done" or agent == "sleeps"  # the limit may be too short on a busy machine


@pytest.mark.slow
def test_a_local_dask_cluster_gives_the_same_rows(tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed", reason="Dask is not installed: pip install distributed")
    arguments = ["--agents", "circling,oracle", *QUICK, "--out"]
    assert compare_main([*arguments, str(tmp_path / "here")]) == 0
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        there = [*arguments, str(tmp_path / "there"), "--processes", "-1", "--backend", "dask"]
        assert compare_main([*there, "--address", cluster.scheduler_address]) == 0
    assert rows_of(tmp_path / "there") == rows_of(tmp_path / "here")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--agents", "cirling"], "Did you mean 'circling'?"),
        (["--agents", "nowhere:make"], "expected module:function"),
        (["--maps", "rink"], "Did you mean 'ring'?"),
        (["--noise", "loud"], "unknown tier"),
        (["--seeds", "0"], "nothing to compare"),
        (["--suite", "huge"], "unknown suite"),
        (["--processes", "0"], "--processes is 0"),
        (["--time-limit", "0"], "--time-limit is 0"),
        (["--verify", "3"], "no rows of these runs"),
        (["--backend", "dask"], "needs the --address"),
    ],
)
def test_bad_input_is_refused_in_one_line(arguments: list[str], message: str, tmp_path: Path, refused: Refused) -> None:
    base = ["--agents", "circling", "--maps", "ring", "--noise", "ideal", "--seeds", "1", "--out", str(tmp_path)]
    assert message in refused(compare_main, [*base, *arguments])


def test_a_file_that_is_no_table_is_refused_and_stays(tmp_path: Path, refused: Refused) -> None:
    (tmp_path / "runs.csv").write_text("a,b\n1,2\n")
    assert "is not a table of runs" in refused(compare_main, [*QUICK, "--agents", "circling", "--out", tmp_path])
    (tmp_path / "runs.csv").write_bytes(b"\xff\xfe\x00")
    assert "is not a table of runs" in refused(compare_main, [*QUICK, "--agents", "circling", "--out", tmp_path])
    assert (tmp_path / "runs.csv").read_bytes() == b"\xff\xfe\x00"


def test_the_suites_have_what_they_say() -> None:
    default = jobs_of(SUITES["default"])
    assert len(default) == 16 * 3 * 2 * 6
    assert len(set(default)) == len(default)
    assert {job.tier for job in default} == {"calibrated", "typical", "hard"}
    assert not any("test" in job.map for job in default)
    assert len({job.map for job in jobs_of(SUITES["report"])}) == 9 + 64
    assert TIERS["hard"].laser.range_max == 8.0


# Measures


def test_coverage_over_path_and_the_path_to_a_coverage() -> None:
    path, coverage = np.array([0.0, 5.0, 10.0, 20.0]), np.array([0.1, 0.5, 0.9, 0.95])
    curve = coverage_curve(path, coverage, tour_m=10.0)
    assert curve[[0, 9, 10, 20, 40]] == pytest.approx([0.1, 0.1, 0.5, 0.9, 0.95])
    assert path_to(path, coverage, 0.9) == 10.0
    assert math.isnan(path_to(path, coverage, 0.99))


def test_winding_numbers_and_packed_poses() -> None:
    square = np.array([[0.0, 0], [4, 0], [4, 4], [0, 4], [0, 0.1]])
    assert winding_number(square, np.array([1.0, 2.0])) == 1
    assert winding_number(square[::-1], np.array([1.0, 2.0])) == -1
    assert winding_number(square, np.array([9.0, 2.0])) == 0
    poses = np.array([[240.3, -12.7, 3.1], [0.0, 55.5, -9.0]])
    packed = unpack_poses(pack_poses(poses))
    assert packed[:, :2] == pytest.approx(poses[:, :2], abs=0.026)
    assert np.cos(packed[:, 2] - poses[:, 2]) == pytest.approx([1, 1])


# Statistics


def made_up(**agents: list[float]) -> Any:
    """Return runs with these returns, two on each map."""
    rows = [
        {
            **dict.fromkeys(("precision", "recall", "f1", "coverage", "coverage_area", "t90_m", "t99_m"), 0.5),
            **dict.fromkeys(("match_error_m", "tours", "loop_spl", "collisions_per_km", "ate_m", "decision_ms"), 1.0),
            "agent": agent,
            "map": f"map{index // 2}",
            "seed": index % 2,
            "start": "random",
            "return": value,
            "privileged": agent == "oracle",
            "is_success": value > 50,
            "false_claims": 0,
            "cycles_closed": 1,
            "cycles_total": 2,
        }
        for agent, values in agents.items()
        for index, value in enumerate(values)
    ]
    return pd.DataFrame(rows)


def test_the_ranking_puts_the_most_successful_first_and_privileged_agents_aside() -> None:
    frame = made_up(knn=[60.0, 70, 80, 40], frontier=[60.0, 70, 80, 90], oracle=[99.0] * 4, random=[0.0] * 4)
    table = rank(frame, ("random", "oracle", "knn", "frontier", "absent"))
    assert list(zip(table["rank"], table["agent"], strict=True)) == [
        ("1", "frontier"),
        ("2", "knn"),
        ("3", "random"),
        ("privileged", "oracle"),
    ]
    assert table["success"][0].startswith("1.00 [")
    assert table["cycles"].tolist() == ["0.50"] * 4


def test_differences_are_paired_and_over_maps() -> None:
    frame = made_up(knn=[10.0, 20, 30, 40], frontier=[15.0, 25, 35, 45])
    (row,) = differences(frame, ("knn", "frontier")).to_dict("records")
    assert row["pairs"] == "4"
    assert row["return minus that of knn"] == "5.0 [5.0, 5.0]"
    assert row["probability of improvement"] == "0.75"  # on each map, of two runs each, all but one in four pairs
    assert differences(frame, ("knn",)).empty


def test_a_frame_has_numbers_for_numbers_and_none_of_the_failed(tmp_path: Path) -> None:
    table = RunTable(tmp_path / "runs.csv")
    job = Job(tier="ideal", map="generated:cycles=1,seed=2", seed=1, start="plan", agent="x")
    settings = {name: getattr(job, name) for name in Job.__dataclass_fields__}
    table.add({**settings, "status": DONE, "return": 0.1 + 0.2, "is_success": True, "ate_m": math.nan})
    table.add({**settings, "seed": 2, "status": "failed", "error": "two\nlines, and a comma"})
    again = RunTable(tmp_path / "runs.csv")
    assert again.rows == table.rows
    frame = again.frame()
    assert len(frame) == 1
    assert frame["return"][0] == 0.1 + 0.2
    assert frame["map"][0] == job.map
    assert bool(frame["is_success"][0])
    assert np.isnan(frame["ate_m"][0])

"""The command that judges anyone's run: what it prints and writes, and one line for whatever is wrong."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cyclic_env import load_floor_plan
from cyclic_env.trajectory.io import write_tum
from tests.helpers import load_script
from tests.scripts.conftest import Refused

main = load_script("judge").main

TIMES = 0.5 * np.arange(200)


def around_the_ring(laps: float) -> np.ndarray:
    """Return 200 poses along the middle of the ring's corridors."""
    line = np.array(load_floor_plan("ring").centrelines[0])
    lengths = np.append(0.0, np.cumsum(np.hypot(*np.diff(line, axis=0).T)))
    s = np.linspace(0, laps * lengths[-1], 200) % lengths[-1]
    x, y = (np.interp(s, lengths, line[:, k]) for k in range(2))
    return np.column_stack([x, y, np.zeros(200)])


@pytest.fixture
def files(tmp_path: Path) -> Path:
    """A folder with a truth, an estimate, and claims: two laps, a right claim and a false one."""
    truth = around_the_ring(2)
    write_tum(tmp_path / "truth.tum", TIMES, truth)
    write_tum(tmp_path / "slam.tum", TIMES[::2], truth[::2] + np.array([0.0, 0.1, 0.0]))
    drift = np.column_stack([np.zeros(200), 0.01 * np.arange(200), np.zeros(200)])
    write_tum(tmp_path / "odom.tum", TIMES, truth + drift)
    (tmp_path / "claims.csv").write_text("time,match_time,score\n70,20,0.9\n90,10,0.5\n")
    return tmp_path


def arguments(files: Path, **changes: Any) -> list[str]:
    options = {"trajectory": files / "slam.tum", "reference": files / "truth.tum", "claims": files / "claims.csv"}
    return [str(word) for name, value in (options | changes).items() for word in (f"--{name}", value)]


def test_a_run_is_judged_on_a_map(files: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*arguments(files, map="ring", odometry=files / "odom.tum", json=files / "r.json"), "--price"]) == 0
    said = capsys.readouterr().out
    for part in ("1 of 1", "1 of 2", "within 3 m, in sight", "within 5 m", "ATE RMSE", "0.100 m", "one false claim"):
        assert part in said
    report = json.loads((files / "r.json").read_text())
    assert (report["false_claims"], report["claims"], report["cycles_closed"], report["cycles_total"]) == (1, 2, 1, 1)
    assert report["rows"] == 100
    assert report["definitions"][0]["thresholds"] == [0.9, 0.5]
    assert report["price"]["false"] == 1


def test_without_a_map_it_says_what_is_not_judged(files: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(arguments(files)) == 0
    assert "not counted, and sight not checked: no map was given" in capsys.readouterr().out


def test_the_reference_may_be_in_another_frame_than_the_map(files: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_tum(files / "moved.tum", TIMES, around_the_ring(2) - [100.0, 50.0, 0.0])
    options = arguments(files, map="ring", reference=files / "moved.tum")
    assert main([*options, "--map-pose", "100", "50", "0"]) == 0
    assert "1 of 1" in capsys.readouterr().out


def test_an_agent_that_claims_nothing_is_judged(files: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (files / "claims.csv").write_text("time,match_time\n")
    assert main([*arguments(files, odometry=files / "odom.tum"), "--price"]) == 0
    assert "0 of 0" in capsys.readouterr().out


def damaged(name: str, content: bytes) -> Any:
    def change(files: Path) -> dict[str, Any]:
        (files / name).write_bytes(content)
        return {}

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (damaged("slam.tum", b""), "holds no poses"),
        (damaged("slam.tum", bytes(range(256))), "not a text file"),
        (damaged("truth.tum", b"1 0 0 0 0 0 0 1\n0 0 0 0 0 0 0 1\n"), "not sorted by time"),
        (damaged("truth.tum", b"1 nan 0 0 0 0 0 1\n"), "finite numbers"),
        (damaged("truth.tum", b"1e9 0 0 0 0 0 0 1\n"), "none of the times of the"),
        (damaged("claims.csv", b"from,to\n1,2\n"), "expected the columns"),
        (damaged("claims.csv", b"time,match_time\n1e6,2e6\n"), "none of the times of the claims"),
        (damaged("claims.csv", b"step,match\n200,1\n"), "0 to 199"),
        (lambda files: {"claims": files}, "Is a directory"),
        (lambda files: {"trajectory": files / "none.tum"}, "no such file"),
        (lambda files: {"map": "rung"}, "Did you mean 'ring'"),
        (lambda files: {"map": "killian_court", "map-pose": "9"}, "map-pose"),
        (lambda files: {"tolerance": "-1"}, "at least 0"),
        (lambda files: {"tolerance": "nan"}, "at least 0"),
        (lambda files: {"log": "none.log"}, "no such file"),
        (lambda files: {"json": files / "claims.csv"}, "is read, and would be overwritten"),
    ],
)
def test_bad_input_gets_one_line(change: Any, message: str, files: Path, refused: Refused) -> None:
    changes = change(files)
    assert message in refused(main, arguments(files, **changes))


def test_what_is_missing_is_named(files: Path, refused: Refused) -> None:
    assert "give --odometry, or a --log" in refused(main, [*arguments(files), "--price"])
    assert "give --reference" in refused(main, ["--claims", files / "claims.csv"])

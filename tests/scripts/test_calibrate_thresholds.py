"""The calibration of thresholds: what it takes, what it writes, and the file that is shipped."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from agents.knn.config import PRESETS, calibrated_thresholds, preset
from agents.knn.similarity import MEASURES
from cyclic_env.task.loop_closure import ELSEWHERE, RETURNS, TOO_SOON
from tests.helpers import load_script

calibration = load_script("calibrate_thresholds")


@pytest.mark.parametrize("detector", ["both", "knn"])
def test_every_measure_has_a_calibrated_threshold_which_is_the_default(detector: str) -> None:
    thresholds = calibrated_thresholds(detector)
    assert set(thresholds) == set(MEASURES)
    for name, threshold in thresholds.items():
        assert preset("paper", measure=name, detector=detector).least_similarity == threshold
    assert preset("paper", threshold=0.9).least_similarity == 0.9
    assert PRESETS["paper"].threshold is None


def test_the_threshold_is_worth_most_by_the_reward() -> None:
    similarity = np.array([0.9, 0.8, 0.7, 0.6, 0.5, 0.95])
    outcome = np.array([RETURNS, RETURNS, ELSEWHERE, RETURNS, ELSEWHERE, TOO_SOON])
    best = calibration.best_threshold(similarity, outcome, 3)  # 2 right; a third one would cost a false claim
    assert best["threshold"] == pytest.approx(0.75)
    assert (best["precision"], best["recall"]) == pytest.approx((1.0, 2 / 3))
    assert (best["highest_precision"], best["recall_there"]) == pytest.approx((1.0, 1 / 3))


def test_where_nothing_is_worth_it_the_threshold_is_that_of_the_best_f1() -> None:
    outcome = np.array([ELSEWHERE, RETURNS, ELSEWHERE, RETURNS, ELSEWHERE])
    best = calibration.best_threshold(np.array([0.9, 0.8, 0.7, 0.6, 0.5]), outcome, 2)
    assert best["threshold"] == pytest.approx(0.55)
    assert (best["precision"], best["recall"]) == (0.5, 1.0)


def test_the_calibration_writes_its_file_and_refuses_what_there_is_not(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(0)
    rows = np.arange(40)
    columns = {
        "features": rng.integers(1, 20, (40, 2, 7)).astype(float),
        "direction": np.zeros(40, np.int64),
        "group": rows // 10,
        "step": rows,
        "path": 2.0 * rows,
        "odometry": np.column_stack([12 * np.cos(rows * np.pi / 10), 12 * np.sin(rows * np.pi / 10)]),
    }
    truth = np.where(np.subtract.outer(rows, rows) == 20, RETURNS, ELSEWHERE)
    monkeypatch.setattr(calibration, "training_run", lambda index, noise: calibration.TrainingRun(columns, truth))
    arguments = ["--plans", "1", "--processes", "1", "--out", str(tmp_path / "th.json")]
    assert calibration.main(arguments) == 0
    written = json.loads((tmp_path / "th.json").read_text())["detectors"]
    assert set(written["both"]) == set(written["knn"]) == set(MEASURES)
    assert written["both"]["cosine"]["precision"] == 1.0  # position leaves only the right rows
    capsys.readouterr()
    for wrong, message in ((["--plans", "0"], "--plans is 0"), (["--processes", "0"], "--processes is 0")):
        assert calibration.main([*arguments, *wrong]) == 2
        said = capsys.readouterr().err
        assert message in said
        assert said.count("\n") == 1

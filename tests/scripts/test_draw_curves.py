"""The command that draws learning curves."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from PIL import Image

from tests.helpers import load_script
from tests.scripts.conftest import Refused

script = load_script("draw_curves")


def episodes(folder: Path, returns: list[float]) -> Path:
    folder.mkdir()
    count = len(returns)
    table = pd.DataFrame({"steps": 10 * np.arange(1, count + 1), "return": returns, "false_claims": 0})
    table.assign(cycles_closed=1, cycles_total=2).to_csv(folder / "progress.csv", index=False)
    return folder


def test_curves_are_means_of_the_latest_episodes_of_each_run(tmp_path: Path) -> None:
    runs = [episodes(tmp_path / name, returns) for name, returns in (("a", [0.0] * 200), ("b", [4.0] * 150))]
    label, tables = script.parse_curve(f"PPO={runs[0]},{runs[1]}")
    steps, curves = script.smoothed(tables, "return")
    assert label == "PPO"
    assert steps[-1] == 2000
    assert (curves[0] == 0).all()
    np.testing.assert_array_equal(curves[1], np.where(steps <= 1500, 4.0, np.nan))
    assert script.main([f"PPO={runs[0]},{runs[1]}", "--out", str(tmp_path / "curves.png")]) == 0
    with Image.open(tmp_path / "curves.png") as picture:
        assert picture.width > picture.height


@pytest.mark.parametrize(("curve", "message"), [("PPO", "expected LABEL=FOLDER"), ("PPO=nowhere", "nowhere")])
def test_bad_input_is_one_clear_line(curve: str, message: str, refused: Refused) -> None:
    assert message in refused(script.main, [curve])

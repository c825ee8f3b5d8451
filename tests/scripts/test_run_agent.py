"""The command that lets any agent drive once: what it writes, and one line for bad input."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.helpers import load_script
from tests.scripts.conftest import Refused

main = load_script("run_agent").main


def test_a_run_is_drawn_and_scored(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "new"
    assert main(["headings_rule", "--map", "ring", "--step-budget", "150", "--out", str(out)]) == 0
    metrics = json.loads((out / "metrics.json").read_text())
    assert (metrics["steps"], metrics["agent"], metrics["map"]) == (150, "headings_rule", "ring")
    assert f"{metrics['path_length_m']:,.0f} m" in capsys.readouterr().out
    assert metrics["path_length_m"] > 15
    with Image.open(out / "run.png") as picture, Image.open(out / "run.gif") as animation:
        assert np.ptp(np.asarray(picture.convert("L"))) > 100
        assert getattr(animation, "n_frames", 1) > 10


@pytest.mark.parametrize(
    ("arguments", "message"),
    [(["headings_rul"], "'headings_rule'"), (["knn", "--map", "rin"], "'ring'"), (["knn", "--noise", "x"], "noise")],
)
def test_bad_input_is_one_clear_line(arguments: list[str], message: str, refused: Refused) -> None:
    assert message in refused(main, arguments)

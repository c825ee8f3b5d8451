"""The command line that measures and draws floor plans."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cyclic_env.floor_plans import load_floor_plan
from tests.helpers import load_script
from tests.scripts.conftest import Refused

show_plans = load_script("show_plans")


def test_it_measures_and_draws_plans(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    figure, numbers = tmp_path / "new" / "plans.png", tmp_path / "plans.json"
    names = ["ring", "generated:cycles=1,seed=3"]
    assert show_plans.main([*names, "--out", str(figure), "--json", str(numbers)]) == 0
    table = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in table] == ["plan", *names, "mean"]
    assert len({len(line) for line in table}) == 1
    ring, generated = json.loads(numbers.read_text())
    assert ring["closed_tour"] == pytest.approx(load_floor_plan("ring").closed_tour())
    assert (generated["plan"], generated["cycles"]) == (names[1], 1)
    assert 0 <= generated["aliasing"] <= 1
    assert figure.read_bytes().startswith(b"\x89PNG")


def test_a_plan_without_known_corridors_has_no_tour(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "room.yaml"
    file.write_text("start: {x: 2, y: 2}\nexterior: [[0, 0], [8, 0], [8, 5], [0, 5]]\n")
    assert show_plans.main([str(file)]) == 0
    assert "unknown" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["rign"], "Did you mean 'ring'?"),
        (["generated:cycles=99"], "cycles is 99"),
        (["ring", "--out", "/dev/null/plans.png"], "can't write to"),
        (["ring", "--out", "/tmp/plans.xyz"], "plans.xyz: "),
    ],
)
def test_bad_input_gets_one_line(arguments: list[str], message: str, refused: Refused) -> None:
    assert message in refused(show_plans.main, arguments)


def test_dollars_in_a_title_are_no_formula(tmp_path: Path) -> None:
    from cyclic_env.rendering.figures import contact_sheet, plan_figure

    plan = load_floor_plan("ring")
    figure, _ = plan_figure(plan, r"for $\frac$")
    figure.savefig(tmp_path / "plan.png")
    contact_sheet([plan], [r"$\frac$"], [np.zeros((0, 2))]).savefig(tmp_path / "sheet.png")


def test_ctrl_c_keeps_what_is_measured(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    measure_plan = show_plans.measure_plan

    def interrupted(plan: Any, progress: Any) -> Any:
        if plan.name == "grid":
            raise KeyboardInterrupt
        return measure_plan(plan, progress)

    monkeypatch.setattr(show_plans, "measure_plan", interrupted)
    assert show_plans.main(["ring", "grid", "office"]) == 130
    said = capsys.readouterr()
    assert "ring" in said.out
    assert "grid" not in said.out
    assert "1 of 3 plans" in said.err

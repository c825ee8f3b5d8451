"""Figures: where things are drawn, what the legend says, and that nothing needs a display."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection

from cyclic_env.errors import ConfigError
from cyclic_env.floor_plans import FloorPlan, load_floor_plan
from cyclic_env.rendering.figures import (
    HEIGHT_MAX,
    WIDTH,
    add_legend,
    draw_claims,
    draw_path,
    plan_figure,
)
from cyclic_env.task.path_history import CLAIM
from tests.helpers import labels, texts

WAY = np.array([(2.0, 2.0, 0.0), (8.0, 2.0, 6.0), (8.0, 8.0, 12.0), (2.0, 8.0, 18.0), (2.0, 2.5, 23.5)])


def segments(axes: Axes) -> list[np.ndarray]:
    return [np.array(lines.get_segments()) for lines in axes.collections if isinstance(lines, LineCollection)]


def test_figure_holds_the_whole_building_and_a_metre_is_as_long_north_as_east(plan: FloorPlan) -> None:
    figure, axes = plan_figure(plan, plan.title, "scores")
    west, south, east, north = plan.bounds
    assert axes.get_xlim()[0] < west < east < axes.get_xlim()[1]
    assert axes.get_ylim()[0] < south < north < axes.get_ylim()[1]
    origin, one = axes.transData.transform([(0.0, 0.0), (1.0, 1.0)])
    assert one[0] - origin[0] == pytest.approx(one[1] - origin[1])
    assert figure.get_figwidth() == WIDTH
    assert axes.get_position().height * figure.get_figheight() <= HEIGHT_MAX + 1e-9
    assert [text.get_text() for text in figure.texts] == [plan.title, "scores"]


def test_path_is_drawn_from_start_to_end(axes: Axes) -> None:
    draw_path(axes, WAY)
    (pieces,) = segments(axes)
    np.testing.assert_array_equal(pieces[0, 0], WAY[0, :2])
    np.testing.assert_array_equal(pieces[-1, 1], WAY[-1, :2])
    assert labels(axes) == ["path (darker: later)", "start", "end"]


def test_claims_are_told_apart_and_lead_to_the_places_they_named(axes: Axes) -> None:
    claims = np.array([(1, 0, True, False), (2, -1, False, False), (3, 1, False, False), (4, 0, True, True)], CLAIM)
    draw_claims(axes, WAY, claims)
    assert labels(axes) == ["correct claim (1)", "false claim (2)", "closes a cycle (1)", "claim to match"]
    right, wrong, closing = segments(axes)
    np.testing.assert_array_equal(right, WAY[[[1, 0]], :2])
    np.testing.assert_array_equal(wrong, WAY[[[3, 1]], :2])  # the other had no place to name
    np.testing.assert_array_equal(closing, WAY[[[4, 0]], :2])
    assert texts(axes) == ["1"]


def test_nothing_to_draw_draws_nothing(axes: Axes) -> None:
    draw_claims(axes, WAY, np.zeros(0, CLAIM))
    assert labels(axes) == []


@pytest.mark.parametrize("name", ["ring", "killian_court"])
def test_legend_lies_below_the_building(name: str, tmp_path: Path) -> None:
    plan = load_floor_plan(name)
    figure, axes = plan_figure(plan, plan.title)
    draw_path(axes, np.array([(*plan.start[:2], 0.0)]))
    add_legend(axes)
    figure.savefig(tmp_path / "figure.png", dpi=50)
    assert figure.legends[0].get_window_extent().y1 < axes.get_window_extent().y0
    assert (tmp_path / "figure.png").stat().st_size > 1000


def test_missing_matplotlib_is_an_error_that_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib.axes", None)
    monkeypatch.delitem(sys.modules, "cyclic_env.rendering.figures")
    with pytest.raises(ConfigError, match=r'pip install "cyclic-loop\[plot\]"'):
        import cyclic_env.rendering.figures  # noqa: F401


def test_importing_the_environment_loads_no_matplotlib() -> None:
    code = "import sys, cyclic_env, cyclic_env.evaluation.rollout; assert 'matplotlib' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True, cwd=Path(__file__).parents[2])

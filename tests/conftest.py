"""Fixtures that several test files share."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import shapely

from cyclic_env.floor_plans import FloorPlan, load_floor_plan, map_names
from tests.helpers import load_script


@pytest.fixture(scope="session")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a training run of 5,000 steps, begun from the command line."""
    out = tmp_path_factory.mktemp("run")
    arguments = ["--algo", "ppo", "--steps", "5000", "--map", "ring", "--step-budget", "200", "--out", str(out)]
    assert load_script("train").main(arguments) == 0
    return out


@pytest.fixture(params=map_names())
def plan(request: pytest.FixtureRequest) -> FloorPlan:
    """Every shipped plan in turn."""
    return load_floor_plan(request.param)


@pytest.fixture(scope="session")
def square_room() -> FloorPlan:
    """A room of 10 m x 10 m with a bent passage at its north-east corner that can't be seen from within."""
    boxes = [shapely.box(0, 0, 10, 10), shapely.box(10, 8, 20, 10), shapely.box(18, 8, 20, 30)]
    return FloorPlan("square_room", shapely.union_all(boxes), (5.0, 5.0, 0.0))  # pyright: ignore[reportArgumentType]


@pytest.fixture
def axes(square_room: FloorPlan) -> Any:
    """The axes of a figure of the square room."""
    from cyclic_env.rendering.figures import plan_figure

    return plan_figure(square_room, "A room")[1]


@pytest.fixture
def dummy_display(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A display that nobody sees."""
    pygame = pytest.importorskip("pygame")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    pygame.display.quit()
    yield
    pygame.display.quit()

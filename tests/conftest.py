"""What several test files share."""

from __future__ import annotations

import importlib.util
import types
from pathlib import Path

import numpy as np
import pytest
import shapely

from cyclic_env.floor_plans import FloorPlan, load_floor_plan, map_names

ROOT = Path(__file__).parents[1]


def load_script(name: str) -> types.ModuleType:
    """Return a script as a module."""
    spec = importlib.util.spec_from_file_location(f"{name}_script", ROOT / "scripts" / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


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


def bumping_actions(steps: int, num_robots: int, seed: int = 0) -> np.ndarray:
    """Return actions `(steps, num_robots, 4)` that drive fast, into walls, and claim now and then."""
    rng = np.random.default_rng(seed)
    actions = rng.uniform(-1, 1, (steps, num_robots, 4)).astype(np.float32)
    drives = np.repeat(rng.choice([0.4, 1.0, 1.0, -1.0], ((steps + 14) // 15, num_robots, 2)), 15, axis=0)[:steps]
    actions[..., :2] = drives
    actions[..., 2] = rng.choice([-1, -1, -1, 1], (steps, num_robots))
    return actions

"""What several test files share."""

from __future__ import annotations

import numpy as np
import pytest
import shapely

from cyclic_env.floor_plans import FloorPlan, load_floor_plan, map_names


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

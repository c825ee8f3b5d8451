"""Functions that several test files share."""

from __future__ import annotations

import importlib
import types
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[1]


def load_script(name: str) -> types.ModuleType:
    """Return a script as a module."""
    return importlib.import_module(f"scripts.{name}")


def bumping_actions(steps: int, num_robots: int, seed: int = 0) -> np.ndarray:
    """Return actions `(steps, num_robots, 4)` that drive fast, into walls, and claim now and then."""
    rng = np.random.default_rng(seed)
    actions = rng.uniform(-1, 1, (steps, num_robots, 4)).astype(np.float32)
    drives = np.repeat(rng.choice([0.4, 1.0, 1.0, -1.0], ((steps + 14) // 15, num_robots, 2)), 15, axis=0)[:steps]
    actions[..., :2] = drives
    actions[..., 2] = rng.choice([-1, -1, -1, 1], (steps, num_robots))
    return actions

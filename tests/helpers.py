"""Functions that several test files share."""

from __future__ import annotations

import importlib
import types
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from cyclic_env.errors import CyclicLoopError
from cyclic_env.evaluation.statistics import Evaluation

if TYPE_CHECKING:
    from matplotlib.axes import Axes

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


def record(**changes: Any) -> dict[str, Any]:
    """Return the record of an episode, made up."""
    base = {"seed": 0, "cycles_closed": 1, "cycles_total": 2, "false_claims": 3, "return": 4.0, "coverage": 0.5}
    base |= {"is_success": False, "claims": 4, "revisits": 1, "revisits_recognised": 1}
    return base | {"collisions": 0, "path_length_m": 10.0, "steps": 50} | changes


def evaluation(*records: dict[str, Any], **changes: Any) -> Evaluation:
    """Return an evaluation of these records, or one with other settings."""
    settings: dict[str, Any] = {"agent": "someone", "map": "ring", "noise": "ideal", "action_type": "wheels"}
    settings |= {"random_start": False, "seeds": tuple(range(len(records))), "episodes": list(records)}
    return Evaluation(**settings | changes)


def roll_out(env: Any, actions: np.ndarray, seed: int | None) -> list[tuple[Any, ...]]:
    """Reset and step a single env, beginning anew when an episode ends; return all that it returned."""
    rollout: list[tuple[Any, ...]] = [env.reset(seed=seed)]
    for action in actions:
        rollout.append(env.step(action))
        if rollout[-1][2] or rollout[-1][3]:
            rollout.append(env.reset())
    return rollout


@contextmanager
def refused(message: str, error: type[CyclicLoopError] = CyclicLoopError) -> Iterator[None]:
    """Expect an error of ours, in one line that matches the message."""
    with pytest.raises(error, match=message) as caught:
        yield
    assert "\n" not in str(caught.value)


def labels(axes: Axes) -> list[str]:
    """Return the labels of a figure's legend."""
    return [str(label) for label in axes.get_legend_handles_labels()[1]]


def texts(axes: Axes) -> list[str]:
    """Return the texts written in a figure."""
    return [text.get_text() for text in axes.texts]


def assert_same(a: Any, b: Any) -> None:
    """Assert that two structures of dicts, tuples, arrays and scalars are equal to the bit, types included."""
    assert type(a) is type(b)
    if isinstance(a, dict):
        assert a.keys() == b.keys()
        for key in a:
            assert_same(a[key], b[key])
    elif isinstance(a, list | tuple):
        assert len(a) == len(b)
        for x, y in zip(a, b, strict=True):
            assert_same(x, y)
    elif isinstance(a, np.ndarray) and a.dtype == object:
        assert_same(a.tolist(), b.tolist())
    else:
        np.testing.assert_array_equal(a, b, strict=True)

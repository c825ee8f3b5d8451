"""The example of an algorithm of one's own runs, and learns something."""

from __future__ import annotations

import importlib.util

import numpy as np
import torch

from tests.helpers import ROOT


def test_it_trains_and_returns_the_returns_of_episodes() -> None:
    spec = importlib.util.spec_from_file_location("ppo_from_scratch", ROOT / "docs" / "ppo_from_scratch.py")
    assert spec is not None
    assert spec.loader is not None
    example = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(example)
    torch.manual_seed(0)
    returns = example.train(updates=3, robots=4, decisions=12, map_name="ring", step_budget=60)
    assert len(returns) == 4 * 3
    assert np.isfinite(returns).all()

"""Rows of the benchmark's table, and how times are taken."""

from __future__ import annotations

import math
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
REPEATS = 5


class Row(NamedTuple):
    """One measurement, and what it should be: at least or at most so much."""

    what: str
    name: str
    value: float
    unit: str
    least: float = -math.inf
    most: float = math.inf

    @property
    def formatted(self) -> str:
        """The value for the table."""
        if math.isnan(self.value):
            return "-"
        return f"{self.value:,.0f}" if abs(self.value) >= 1000 else f"{self.value:.3g}"

    @property
    def target(self) -> str:
        """What the value should be, or nothing."""
        if self.least > -math.inf:
            return f"at least {self.least:,g}"
        return f"at most {self.most:,g}" if self.most < math.inf else ""

    @property
    def verdict(self) -> str:
        """Whether it is."""
        if not self.target:
            return ""
        return "ok" if self.least <= self.value <= self.most else "MISSED"

    def to_json(self) -> dict[str, Any]:
        """Return the row as plain values, with None for NaN."""
        return {
            "what": self.what,
            "measurement": self.name,
            "value": None if math.isnan(self.value) else self.value,
            "unit": self.unit,
            "target": self.target,
            "verdict": self.verdict,
        }


def best_time(function: Callable[[], Any], repeats: int = REPEATS) -> float:
    """Return the shortest of several run times of `function`, seconds, after one run to warm up."""
    function()
    times = []
    for _ in range(repeats):
        begin = time.perf_counter()
        function()
        times.append(time.perf_counter() - begin)
    return min(times)


def rate_of(env: Any, actions: np.ndarray, steps: int) -> float:
    """Return robot-steps a second of a vector env, best of several."""
    env.reset(seed=0)

    def run() -> None:
        for i in range(steps):
            env.step(actions[i % len(actions)])

    return steps * env.num_envs / best_time(run)


def random_actions(num_envs: int) -> np.ndarray:
    """Return uniformly random actions `(50, num_envs, 4)`, half of them claims."""
    return np.random.default_rng(0).uniform(-1, 1, (50, num_envs, 4)).astype(np.float32)


def run_python(code: str, **environment: str) -> float:
    """Run a program in a process of its own, and return the number that it prints last."""
    result = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=True,
        cwd=ROOT,
        env={**os.environ, **environment},
    )
    return float(result.stdout.split()[-1])

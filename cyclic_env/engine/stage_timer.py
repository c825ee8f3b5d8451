"""How long the stages of a step take."""

from __future__ import annotations

import time
from collections import defaultdict


class NoTimer:
    """Measures nothing; the engine's default, in place of a `StageTimer`."""

    def start(self) -> None:
        """Begin the first of several stages."""

    def lap(self, stage: str) -> None:
        """End a stage, and begin the next one."""


class StageTimer(NoTimer):
    """Adds up the seconds that each stage of a step takes, in an environment that uses one thread.

    Attributes
    ----------
    seconds : dict of float
        By stage: ``"actions"``, ``"drive"``, ``"judge"`` (with the scan), ``"sensors"`` and ``"observation"``.
    """

    def __init__(self) -> None:
        self.seconds: defaultdict[str, float] = defaultdict(float)
        self._last = time.perf_counter()

    def start(self) -> None:  # noqa: D102 (see the base class)
        self._last = time.perf_counter()

    def lap(self, stage: str) -> None:  # noqa: D102
        now = time.perf_counter()
        self.seconds[stage] += now - self._last
        self._last = now

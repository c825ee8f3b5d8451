"""How long the stages of a step take."""

from __future__ import annotations

import time
from collections import defaultdict
from typing import Protocol


class Timer(Protocol):
    """What the engine tells about the stages of its steps."""

    def start(self) -> None:
        """Begin the first of several stages."""

    def lap(self, stage: str) -> None:
        """End a stage, and begin the next one."""


class NoTimer:
    """Measures nothing, and so costs nothing."""

    def start(self) -> None:
        """Do nothing."""

    def lap(self, stage: str) -> None:
        """Do nothing."""


class StageTimer:
    """Adds up the seconds that each stage of a step takes, in an environment that uses one thread.

    Attributes
    ----------
    seconds : dict of float
        By stage: ``"actions"``, ``"drive"``, ``"judge"`` (with the scan), ``"sensors"`` and ``"observation"``.
    """

    def __init__(self) -> None:
        self.seconds: defaultdict[str, float] = defaultdict(float)
        self._last = time.perf_counter()

    def start(self) -> None:
        """Begin the first of several stages."""
        self._last = time.perf_counter()

    def lap(self, stage: str) -> None:
        """End a stage, and begin the next one."""
        now = time.perf_counter()
        self.seconds[stage] += now - self._last
        self._last = now

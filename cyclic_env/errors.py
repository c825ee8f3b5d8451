"""The errors of the package, all under one root."""

from __future__ import annotations


class CyclicLoopError(Exception):
    """Root of all errors that the package raises; command lines print them as one line."""


class ConfigError(CyclicLoopError, ValueError):
    """A setting is unknown, of the wrong type or out of range."""


class FloorPlanError(CyclicLoopError, ValueError):
    """A floor plan is missing, malformed, or does not suit the robot."""


class ActionError(CyclicLoopError, ValueError):
    """An action has the wrong shape or type, or holds a NaN."""


class RecordingError(CyclicLoopError, ValueError):
    """A recording is missing or damaged, has an unknown layout, or can't be written."""


class UsageError(CyclicLoopError, RuntimeError):
    """Calls came in an order that has no meaning, such as a step before the first reset."""

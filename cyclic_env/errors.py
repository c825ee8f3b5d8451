"""The errors that a user of the package can meet, all under one root."""

from __future__ import annotations

import difflib
import reprlib
from collections.abc import Iterable


class CyclicLoopError(Exception):
    """Root of all errors raised on purpose; a command line prints it as one line."""


class ConfigError(CyclicLoopError, ValueError):
    """A setting is unknown, of the wrong type or out of range."""


class FloorPlanError(CyclicLoopError, ValueError):
    """A floor plan is missing, malformed, or does not suit the robot."""


class ActionError(CyclicLoopError, ValueError):
    """An action has the wrong shape or type, or holds a NaN."""


class RecordingError(CyclicLoopError, ValueError):
    """A recording is missing, damaged, of another layout, or can't be written."""


class UsageError(CyclicLoopError, RuntimeError):
    """Calls came in an order that has no meaning, such as a step before the first reset."""


def short_repr(value: object) -> str:
    """Return a short form of what was given, in one line: arrays and nested lists can be too large to print."""
    short = reprlib.Repr()
    short.maxlevel, short.maxstring, short.maxother = 3, 200, 200
    try:
        text = short.repr(value)
    except ValueError:  # Python prints no whole number of more than 4,300 digits
        text = "a number with thousands of digits"
    return " ".join(text.split())


def unknown_name(kind: str, name: object, known: Iterable[str]) -> str:
    """Say that `name` is no known `kind`, which ones are known, and which is nearest.

    Parameters
    ----------
    kind : str
        What the name should have been, such as ``"map"``.
    name : object
        What was given.
    known : iterable of str
        All names that would have been right.
    """
    known = sorted(known)
    nearest = difflib.get_close_matches(name, known, n=1, cutoff=0.5) if isinstance(name, str) else []
    hint = f" Did you mean {nearest[0]!r}?" if nearest else ""
    return f"unknown {kind} {short_repr(name)}.{hint} Known: {', '.join(known) if known else 'none'}."

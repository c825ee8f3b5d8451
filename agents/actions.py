"""How an agent's decision, a drive and perhaps a claim, is written as an action of the environment."""

from __future__ import annotations

import numpy as np

from cyclic_env.config import ActionType

MATCH_START = -1.0
"""Match of an action that claims to be back at the reset."""
STOP, FORWARD, TURN_LEFT, TURN_RIGHT, BACK = range(5)
"""The discrete drives."""
TURN_FROM = 0.12
"""Radians; discrete turns are 10 degrees a step, so smaller errors of the heading can't be mended."""


def drive_actions(drive: np.ndarray, action_type: ActionType, claims: np.ndarray, matches: np.ndarray) -> np.ndarray:
    """Return actions `(N, 4)` float32, or `(N, 2)` int64 if discrete.

    Parameters
    ----------
    drive : (N, 2)
        Speed and turning rate as shares of a full twist.
    action_type : {"wheels", "twist", "discrete"}
    claims, matches : (N,)
        As in the action space; a discrete claim has no match.
    """
    speed, turn = drive.T
    if action_type == "discrete":
        drives = np.select(
            [turn > TURN_FROM, turn < -TURN_FROM, speed > 0, speed < 0],
            [TURN_LEFT, TURN_RIGHT, FORWARD, BACK],
            STOP,
        )
        return np.column_stack([drives, claims > 0])
    if action_type == "twist":
        return with_claims(drive, claims, matches)
    # A full turn, 3 rad/s, is half of the wheels' speed to either side.
    wheels = np.column_stack([speed - turn / 2, speed + turn / 2])
    return with_claims(wheels / np.maximum(1.0, np.abs(wheels).max(axis=1, keepdims=True)), claims, matches)


def with_claims(drives: np.ndarray, claims: np.ndarray, matches: np.ndarray) -> np.ndarray:
    """Return drives `(N, 2)`, claims and matches `(N,)` as actions `(N, 4)` float32."""
    return np.column_stack([drives, claims, matches]).astype(np.float32)

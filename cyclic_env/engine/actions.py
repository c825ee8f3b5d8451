"""Decoding of actions: wheel speeds, and the step that a claim names."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from cyclic_env.config import ActionType, RobotConfig
from cyclic_env.errors import ActionError
from cyclic_env.jit import compiled
from cyclic_env.task.loop_closure import NEAREST, NO_CLAIM
from cyclic_env.validation import as_array

TWIST_OMEGA_MAX = 3.0
"""Turning rate of a full twist action, rad/s."""

SPOT_TURN = 0.15
"""Wheel speed of a discrete turn, as a share of full speed: 0.9 rad/s, 10 degrees a step."""

DISCRETE_WHEELS = np.array([[0.0, 0.0], [1.0, 1.0], [-SPOT_TURN, SPOT_TURN], [SPOT_TURN, -SPOT_TURN], [-1.0, -1.0]])
"""Wheel speeds, as shares of full speed, of the discrete drives: stop, forward, left, right, back."""


def check_actions(actions: Any, action_type: ActionType, num_robots: int) -> np.ndarray:
    """Return a copy of the actions of all robots, float64 `(N, 4)`, or int64 `(N, 2)` if they are discrete.

    Raises
    ------
    ActionError
        If they have the wrong shape or type.
    """
    discrete = action_type == "discrete"
    shape = (num_robots, 2 if discrete else 4)
    array = as_array(actions, "the action", "an element of the action space", ActionError)
    if array.shape != shape:
        if array.shape[:1] != shape[:1]:
            raise ActionError(f"the actions have shape {array.shape}; expected {shape}, a row for each robot.")
        raise ActionError(f"the action has shape {array.shape[1:]}; expected {shape[1:]}.")
    if discrete and array.dtype.kind not in "iu":
        raise ActionError(f"a discrete action must hold whole numbers, got an array of type {array.dtype}.")
    return array.astype(np.int64 if discrete else np.float64)


def decode_actions(
    actions: np.ndarray,
    action_type: ActionType,
    robot: RobotConfig,
    status: np.ndarray,
    commands: np.ndarray,
    claimed: np.ndarray,
) -> None:
    """Turn actions into wheel speeds and claimed steps.

    Parameters
    ----------
    actions : (N, 4) float64, or (N, 2) int64
        From `check_actions`.
    action_type, robot
    status : (N,) STATUS
        Holds the number of steps so far, of which a claim names a share.
    commands : (N, 2) float64
        Output: speeds of the left and the right wheel, m/s.
    claimed : (N,) int64
        Output: the claimed step, `NEAREST` for a discrete claim, or `NO_CLAIM`.

    Raises
    ------
    ActionError
        If an action holds a NaN, or a discrete one is out of range.
    """
    if action_type == "discrete":
        bad = decode_discrete(actions, robot.wheel_speed_max, DISCRETE_WHEELS, commands, claimed)
        expected = f"a drive from 0 to {len(DISCRETE_WHEELS) - 1}, and 0 or 1 for the claim"
    else:
        twist = action_type == "twist"
        bad = decode_continuous(actions, status, twist, robot.wheel_speed_max, robot.axle_track, commands, claimed)
        expected = "no NaN"
    if bad >= 0:
        raise ActionError(f"the action of robot {bad} is {actions[bad].tolist()}; expected {expected}.")


@compiled
def decode_continuous(actions, status, twist, wheel_speed_max, axle_track, commands, claimed):
    """Turn actions `(N, 4)` into wheel speeds `(N, 2)` and claimed steps `(N,)`; return a row with a NaN, or -1."""
    for row in range(actions.shape[0]):
        action = actions[row]
        for value in action:
            if math.isnan(value):
                return row
        first, second = min(max(action[0], -1.0), 1.0), min(max(action[1], -1.0), 1.0)
        if twist:
            speed, swing = first * wheel_speed_max, 0.5 * axle_track * second * TWIST_OMEGA_MAX
            excess = max(1.0, max(abs(speed - swing), abs(speed + swing)) / wheel_speed_max)
            commands[row, 0], commands[row, 1] = (speed - swing) / excess, (speed + swing) / excess
        else:
            commands[row, 0], commands[row, 1] = first * wheel_speed_max, second * wheel_speed_max
        claimed[row] = NO_CLAIM
        if action[2] > 0:
            match = min(max(action[3], -1.0), 1.0)
            claimed[row] = int(np.rint((match + 1) / 2 * (status[row].steps + 1)))
    return -1


@compiled
def decode_discrete(actions, wheel_speed_max, wheels, commands, claimed):
    """Turn actions `(N, 2)` int64 into wheel speeds `(N, 2)` and claims `(N,)`; return a row out of range, or -1."""
    for row in range(actions.shape[0]):
        drive, claim = actions[row, 0], actions[row, 1]
        if not (0 <= drive < wheels.shape[0] and 0 <= claim <= 1):
            return row
        commands[row, 0], commands[row, 1] = wheels[drive, 0] * wheel_speed_max, wheels[drive, 1] * wheel_speed_max
        claimed[row] = NEAREST if claim else NO_CLAIM
    return -1

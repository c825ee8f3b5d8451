"""Decoding of actions into wheel speeds and claimed steps."""

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
"""Turning rate of a twist action at its limit, rad/s."""

SPOT_TURN = 0.15
"""Wheel speed of a discrete turn on the spot, as a share of full speed.

With the default `RobotConfig` the robot turns at 0.9 rad/s, about 10 degrees per step.
"""

DISCRETE_WHEELS = np.array([[0.0, 0.0], [1.0, 1.0], [-SPOT_TURN, SPOT_TURN], [SPOT_TURN, -SPOT_TURN], [-1.0, -1.0]])
"""Wheel speeds (left, right), as shares of full speed, of the drives stop, forward, left, right and back."""


def check_actions(actions: Any, action_type: ActionType, num_robots: int) -> np.ndarray:
    """Return a copy of the actions of all robots, float64 `(N, 4)`, or int64 `(N, 2)` if they are discrete.

    Checks shape and type only; `decode_actions` checks the values.

    Raises
    ------
    ActionError
        If they have the wrong shape or type.
    """
    discrete = action_type == "discrete"
    num_elements = 2 if discrete else 4
    array = as_array(actions, "the action", "an element of the action space", ActionError)
    if array.shape[:1] != (num_robots,):
        raise ActionError(f"the actions have shape {array.shape}; expected {num_robots} rows, one per robot.")
    if array.shape[1:] != (num_elements,):
        raise ActionError(f"the action has shape {array.shape[1:]}; each action must have {num_elements} elements.")
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
    """Turn actions into wheel speeds and claimed steps; continuous values beyond [-1, 1] are clipped.

    Parameters
    ----------
    actions : (N, 4) float64, or (N, 2) int64
        From `check_actions`.
    action_type, robot
    status : (N,) STATUS
        Supplies the step count: a claim's match in [-1, 1] maps linearly onto steps 0 ... steps + 1.
    commands : (N, 2) float64
        Output: speeds of the left and the right wheel, m/s.
    claimed : (N,) int64
        Output: the claimed step, `NEAREST` for a discrete claim, or `NO_CLAIM`.

    Raises
    ------
    ActionError
        If an action contains NaN, or a discrete one is out of range.
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
def _clip(value):
    """Return the value clipped to [-1, 1]."""
    return min(max(value, -1.0), 1.0)


@compiled
def decode_continuous(actions, status, twist, wheel_speed_max, axle_track, commands, claimed):
    """Turn actions `(N, 4)` into wheel speeds `(N, 2)` and claimed steps `(N,)`.

    Return the first row containing NaN, or -1; the rows after it are not decoded.
    """
    for row in range(actions.shape[0]):
        action = actions[row]
        for value in action:
            if math.isnan(value):
                return row
        first, second = _clip(action[0]), _clip(action[1])
        if twist:
            speed, half_difference = first * wheel_speed_max, 0.5 * axle_track * second * TWIST_OMEGA_MAX
            left, right = speed - half_difference, speed + half_difference
            scale = max(1.0, max(abs(left), abs(right)) / wheel_speed_max)  # keeps the ratio, and so the curve driven
            commands[row, 0], commands[row, 1] = left / scale, right / scale
        else:
            commands[row, 0], commands[row, 1] = first * wheel_speed_max, second * wheel_speed_max
        claimed[row] = NO_CLAIM
        if action[2] > 0:
            steps = status[row].steps + 1  # with the step that this action is for
            claimed[row] = int(np.rint((_clip(action[3]) + 1) / 2 * steps))
    return -1


@compiled
def decode_discrete(actions, wheel_speed_max, wheels, commands, claimed):
    """Turn actions `(N, 2)` int64 into wheel speeds `(N, 2)` and claims `(N,)`.

    Return the first row out of range, or -1; the rows after it are not decoded.
    """
    for row in range(actions.shape[0]):
        drive, claim = actions[row, 0], actions[row, 1]
        if not (0 <= drive < wheels.shape[0] and 0 <= claim <= 1):
            return row
        commands[row, 0], commands[row, 1] = wheels[drive, 0] * wheel_speed_max, wheels[drive, 1] * wheel_speed_max
        claimed[row] = NEAREST if claim else NO_CLAIM
    return -1

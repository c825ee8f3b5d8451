"""An agent's decision, and how it is written as an action of the environment."""

from __future__ import annotations

from typing import NamedTuple

from cyclic_env.config import ActionType

MATCH_START = -1.0
"""The match of a claim to be back at the reset."""
STOP, FORWARD, TURN_LEFT, TURN_RIGHT, BACK = range(5)
"""The discrete drives."""
TURN_FROM = 0.12
"""Share of the full turning rate from which a discrete action turns. One turn is 10 degrees, so smaller errors of the
heading can't be corrected."""


class Decision(NamedTuple):
    """What one robot does in a step."""

    speed: float
    """Share of full speed, -1 to 1."""
    turn: float
    """Share of the full turning rate, counter-clockwise, -1 to 1."""
    claim: bool = False
    """Whether the robot claims to be back at a place where it has been before."""
    match: float = MATCH_START
    """When the robot was there before, from -1 (the reset) to 1 (now); see `match_of`."""


def match_of(step: int, steps: int) -> float:
    """Return the match that names a step among the `steps` so far, which include the one that is being decided."""
    return 2 * step / steps - 1


def encode_action(decision: Decision, action_type: ActionType) -> tuple[float, ...]:
    """Return a decision as an action: four numbers, or two whole numbers (drive, claim) if the actions are discrete."""
    speed, turn, claim, match = decision
    if action_type == "discrete":
        if abs(turn) > TURN_FROM:
            return (TURN_LEFT if turn > 0 else TURN_RIGHT), int(claim)
        return (FORWARD if speed > 0 else BACK if speed < 0 else STOP), int(claim)
    sign = 1.0 if claim else -1.0
    if action_type == "twist":
        return speed, turn, sign, match
    # Turning at the full rate, 3 rad/s, takes half of the wheels' speed on either side.
    left, right = speed - turn / 2, speed + turn / 2
    scale = max(1.0, abs(left), abs(right))
    return left / scale, right / scale, sign, match

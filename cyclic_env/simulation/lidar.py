"""The laser scanner: exact ranges to the walls, by drawing walls into beams.

A scan is a one-dimensional picture, so a z-buffer renders it: every wall that is near the robot and faces it
covers an interval of beams, and each of these beams keeps the largest inverse range that it has met. Along a wall
the inverse range is linear in the beam's direction, which takes two multiplications and a subtraction for a beam, and
no beam has to search for its wall.

A beam that comes within `TOUCH` of a wall's end hits that end. A beam that grazes a corner therefore stops
there, and no rounding lets a beam through the joint of two walls.

`scan` is the plain NumPy twin: all beams against all walls. It is the specification.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from cyclic_env.config import LaserConfig
from cyclic_env.jit import compiled, inlined
from cyclic_env.simulation.wall_index import TILE_SIZE, cell_index

TOUCH = 1e-9
"""Metres. Far above rounding (1e-13 m in a building of 1 km), far below anything that matters."""

ANGLE_ERROR = 1e-4
"""Radians. Bound on the error of `_angle`; beams this near to an interval's end are tested exactly."""


class Beams(NamedTuple):
    """The beams of a laser, as the compiled code takes them.

    Attributes
    ----------
    directions : (2, 2 * num_beams) float64
        Their unit vectors in the robot's frame, rows x and y; all beams are listed twice, for two turns.
    first_bearing : float
        Bearing of beam 0, radians.
    per_radian, per_turn : float
        Number of beams in a radian and in a turn, if they were all around.
    range_max : float
        The laser's reach, metres.
    sees_all_around : bool
    """

    directions: np.ndarray
    first_bearing: float
    per_radian: float
    per_turn: float
    range_max: float
    sees_all_around: bool


def laser_beams(laser: LaserConfig) -> Beams:
    """Return the beams of a laser."""
    bearings = laser.bearings.tolist()
    once = np.array([[math.cos(bearing) for bearing in bearings], [math.sin(bearing) for bearing in bearings]])
    per_turn = float(laser.num_beams) if laser.sees_all_around else 2 * math.pi / laser.beam_spacing
    return Beams(
        directions=np.concatenate([once, once], axis=1),
        first_bearing=laser.first_bearing,
        per_radian=per_turn / (2 * math.pi),
        per_turn=per_turn,
        range_max=laser.range_max,
        sees_all_around=laser.sees_all_around,
    )


def scan(walls: np.ndarray, pose: np.ndarray, laser: LaserConfig) -> np.ndarray:
    """Return the ranges `(num_beams,)` in metres from `pose`, clipped to the laser's reach (the plain twin).

    Parameters
    ----------
    walls : (W, 4) float64
        x1, y1, x2, y2 in the world frame; free space lies on the left, and a wall is seen from there only.
    pose : (3,) float64
        x, y, heading. Must be in free space.
    laser : LaserConfig
        A beam that meets no wall reads `range_max`.
    """
    ux, uy = laser_beams(laser).directions[:, : laser.num_beams, None]
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    dx1, dy1, dx2, dy2 = (walls - np.array([pose[0], pose[1], pose[0], pose[1]])).T
    x1, y1 = cos * dx1 + sin * dy1, cos * dy1 - sin * dx1
    x2, y2 = cos * dx2 + sin * dy2, cos * dy2 - sin * dx2
    ex, ey = x2 - x1, y2 - y1
    area = x1 * y2 - x2 * y1
    seen = area > 0.5 * TOUCH * np.sqrt(ex * ex + ey * ey)
    after_first = x1 * uy - y1 * ux
    before_second = ux * y2 - uy * x2
    crossing = ux * ey - uy * ex
    hit = seen & (after_first >= -TOUCH) & (before_second >= -TOUCH) & (crossing > 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        ranges = area / crossing
    ranges = np.where(after_first < 0, np.sqrt(x1 * x1 + y1 * y1), ranges)
    ranges = np.where(before_second < 0, np.sqrt(x2 * x2 + y2 * y2), ranges)
    return np.where(hit, ranges, laser.range_max).min(axis=1, initial=laser.range_max)


@compiled
def _angle(x: float, y: float) -> float:
    """Return the angle of (x, y) in [0, 2 pi), within `ANGLE_ERROR` of the true one."""
    ax, ay = abs(x), abs(y)
    ratio = min(ax, ay) / max(ax, ay)
    square = ratio * ratio
    # Polynomial of the arctangent on [0, 1]: Abramowitz and Stegun 4.4.47, error below 1.2e-5.
    angle = ratio * (
        0.9998660 + square * (-0.3302995 + square * (0.1801410 + square * (-0.0851330 + square * 0.0208351)))
    )
    if ay > ax:
        angle = 0.5 * math.pi - angle
    if x < 0:
        angle = math.pi - angle
    if y < 0:
        angle = 2 * math.pi - angle
    return angle


@inlined
def _beam_at(x, y, beams):
    """Return the index of the beam that points at (x, y), from 0 to `per_turn`, with a fraction between two beams."""
    angle = _angle(x, y) - beams.first_bearing
    if not beams.sees_all_around or beams.first_bearing != 0.0:
        angle -= 2 * math.pi * math.floor(angle / (2 * math.pi))
    return angle * beams.per_radian


@inlined
def _draw_wall(wall, beams, low, high, inverse):
    """Draw a wall, (x1, y1, x2, y2) in the robot's frame, into the beams from `low` to `high`."""
    x1, y1, x2, y2 = wall
    ux, uy = beams.directions[0], beams.directions[1]
    ex, ey = x2 - x1, y2 - y1
    area = x1 * y2 - x2 * y1
    while low <= high and x1 * uy[low] - y1 * ux[low] < -TOUCH:
        low += 1
    while low <= high and ux[high] * y2 - uy[high] * x2 < -TOUCH:
        high -= 1
    # The outermost beams may pass the wall's end at less than TOUCH; such a beam hits the end itself.
    while low <= high and x1 * uy[low] - y1 * ux[low] < 0:
        if ux[low] * ey - uy[low] * ex > 0:
            inverse[low] = max(inverse[low], 1.0 / math.sqrt(x1 * x1 + y1 * y1))
        low += 1
    while low <= high and ux[high] * y2 - uy[high] * x2 < 0:
        if ux[high] * ey - uy[high] * ex > 0:
            inverse[high] = max(inverse[high], 1.0 / math.sqrt(x2 * x2 + y2 * y2))
        high -= 1
    gain_x, gain_y = ey / area, ex / area
    for beam in range(low, high + 1):
        inverse[beam] = max(inverse[beam], ux[beam] * gain_x - uy[beam] * gain_y)


@compiled
def scan_row(walls, plan, pose, beams, inverse, ranges):
    """Write the ranges from one pose into `ranges`.

    Parameters
    ----------
    walls : WallIndex
        Index of the walls within the laser's reach.
    plan : int
        Which of the index's plans the robot is in.
    pose : tuple of 3 floats
        x, y and heading, metres and radians; must be in free space.
    beams : Beams
    inverse : (2 * num_beams,) float64
        Scratch space.
    ranges : (num_beams,) float64
        Output, metres.
    """
    x, y, heading = pose
    num_beams, range_max = ranges.shape[0], beams.range_max
    cos, sin = math.cos(heading), math.sin(heading)
    slack = ANGLE_ERROR * beams.per_radian
    inverse[:] = 1.0 / range_max
    tile = cell_index(walls.grids[plan], TILE_SIZE, x, y)
    for i in range(walls.offsets[tile], walls.offsets[tile + 1]):
        wall = walls.walls[walls.indices[i]]
        dx1, dy1, dx2, dy2 = wall[0] - x, wall[1] - y, wall[2] - x, wall[3] - y
        if dx1 * dy2 - dx2 * dy1 <= -TOUCH:  # clearly seen from behind; the exact test follows
            continue
        x1, y1 = cos * dx1 + sin * dy1, cos * dy1 - sin * dx1
        x2, y2 = cos * dx2 + sin * dy2, cos * dy2 - sin * dx2
        ex, ey = x2 - x1, y2 - y1
        area = x1 * y2 - x2 * y1
        length = math.sqrt(ex * ex + ey * ey)
        if area <= 0.5 * TOUCH * length or area > (range_max + TOUCH) * length:
            continue
        first, last = _beam_at(x1, y1, beams), _beam_at(x2, y2, beams)
        if last - first < -0.5 * beams.per_turn:
            last += beams.per_turn
        elif last - first > 0.5 * beams.per_turn:
            last -= beams.per_turn
        low, high = math.ceil(first - slack), math.floor(last + slack)
        seen = (x1, y1, x2, y2)
        if beams.sees_all_around:
            _draw_wall(seen, beams, low, high, inverse)
        else:  # a wall across the gap between the last beam and beam 0 can be seen at both edges
            _draw_wall(seen, beams, low, min(high, num_beams - 1), inverse)
            high = math.floor(last - beams.per_turn + slack)
            _draw_wall(seen, beams, 0, min(high, num_beams - 1), inverse)
    for beam in range(num_beams):
        ranges[beam] = 1.0 / max(inverse[beam], inverse[beam + num_beams])

"""Buildings drawn by hand, and keyframes taken in them."""

from __future__ import annotations

import math

import numpy as np
import shapely

from agents.slam.keyframes import Keyframes
from agents.slam.registration import PanoramaMatcher
from cyclic_env.config import LaserConfig
from cyclic_env.floor_plans import FloorPlan
from cyclic_env.simulation.lidar import scan

BEAMS, REACH = 180, 12.0
SPACING = math.tau / BEAMS
MATCHER = PanoramaMatcher(REACH)


def plan_of(*boxes: tuple[float, float, float, float]) -> FloorPlan:
    """Return a building that is the union of boxes (west, south, east, north), with its start in the first."""
    space = shapely.union_all([shapely.box(*box) for box in boxes])
    x, y, *_ = boxes[0]
    return FloorPlan("drawn", space, (x + 1.0, y + 1.0, 0.0))  # pyright: ignore[reportArgumentType]


ROOM = plan_of((0, 0, 10, 6))
CROSSING = plan_of((0, 0, 30, 2.4), (14, -12, 16.4, 12))
"""A corridor from west to east and one from south to north, which cross at (15.2, 1.2)."""


def seen(plan: FloorPlan, *pose: float) -> np.ndarray:
    """Return the true scan at a pose."""
    return scan(plan.walls, np.array(pose), LaserConfig())


def keyframes_at(plan: FloorPlan, poses: list[tuple[float, float, float]]) -> Keyframes:
    """Return keyframes with true scans and poses, as if driven through in that order."""
    keyframes, path = Keyframes(BEAMS, 7), 0.0
    for step, pose in enumerate(poses):
        if step:
            path += math.hypot(pose[0] - poses[step - 1][0], pose[1] - poses[step - 1][1])
        ranges = seen(plan, *pose)
        keyframes.add(pose=pose, odometry=pose[:2], scan=ranges, step=step, path=path)
    return keyframes

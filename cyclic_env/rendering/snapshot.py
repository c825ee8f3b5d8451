"""A copy of the part of a robot's state that pictures show."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from cyclic_env.engine.engine import Engine


@dataclass(frozen=True, slots=True)
class RobotSnapshot:
    """A copy of the part of a robot's state that pictures show.

    Attributes
    ----------
    pose : (x, y, heading)
        The true pose.
    hits_world : (num_beams, 2) float64
        Endpoints of the last scan's beams, as seen from the true pose.
    is_hit : (num_beams,) bool
        Whether a beam ends before the laser's maximum range.
    sees_all_around : bool
        Whether the beams are all around the robot.
    track : (t + 1, 3) float64
        x, y and path length of every step.
    claims : (n,) CLAIM
    seen : (rows, columns) int8
        As returned by `Engine.seen_cells`.
    west, south, cell_size : float
        Corner and side of the cells, metres.
    radius : float
        Radius of the robot, metres.
    """

    pose: tuple[float, float, float]
    hits_world: np.ndarray
    is_hit: np.ndarray
    sees_all_around: bool
    track: np.ndarray
    claims: np.ndarray
    seen: np.ndarray
    west: float
    south: float
    cell_size: float
    radius: float

    @classmethod
    def of(cls, engine: Engine, row: int) -> RobotSnapshot:
        """Return the snapshot of a robot of an engine."""
        info, config = engine.info[row], engine.config
        x, y, heading = float(info["x"]), float(info["y"]), float(info["heading"])
        ranges = engine.sensors.ranges[row]
        bearings = heading + config.laser.bearings
        west, south, _, _ = engine.plan(row).bounds
        return cls(
            pose=(x, y, heading),
            hits_world=np.array([x, y]) + ranges[:, None] * np.stack([np.cos(bearings), np.sin(bearings)], axis=1),
            is_hit=ranges < config.laser.range_max,
            sees_all_around=config.laser.sees_all_around,
            track=engine.trajectory(row),
            claims=engine.claims(row),
            seen=engine.seen_cells(row),
            west=west,
            south=south,
            cell_size=float(config.coverage.cell_size),
            radius=config.robot.radius,
        )

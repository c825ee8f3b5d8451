"""Simulated logs of a robot with worn wheels in a building, on which settings are chosen before a real log is used.

Unlike the environment's robot, it has no compass: its heading comes from its wheels, and drifts.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import shapely
from scipy.ndimage import gaussian_filter1d
from shapely.geometry import LineString
from shapely.ops import nearest_points

from cyclic_env.config import LaserConfig
from cyclic_env.floor_plans import FloorPlan
from cyclic_env.floor_plans.tour import joins
from cyclic_env.recording.robot_log import NO_HIT, RobotLog
from cyclic_env.simulation.lidar import laser_beams, scan_row
from cyclic_env.simulation.wall_index import build_wall_index

SPACING = 0.1
"""Metres between scans."""
TURN = math.radians(12)
"""Greatest turn between two scans, radians."""
ROUNDING, WANDERING, ASIDE = 0.5, 4.0, 0.25
"""Metres: how smoothly corners and the offset from a corridor's middle are drawn, and the rms of this offset."""
CLEARANCE = 0.3
"""Least distance to the nearest wall, metres."""
SPEED = 0.5
"""Metres per second."""


@dataclass(frozen=True, slots=True, kw_only=True)
class WheelErrors:
    """Standard deviations of the errors of a robot's odometry, by default those of a worn B21 or Pioneer."""

    turn_drift_deg: float = 0.12
    """Drift of the heading, degrees per metre driven, drawn once for a log."""
    turn_scale: float = 0.03
    distance_scale: float = 0.015
    """Scale errors (1 = 100 %), drawn once for a log."""
    turn_noise_deg: float = 0.5
    distance_noise: float = 0.02
    """Random walks, degrees and metres per square root of a metre driven."""


def simulate_log(
    plan: FloorPlan,
    length: float,
    laser: LaserConfig,
    *,
    seed: int = 0,
    wheels: WheelErrors | None = None,
    range_std: float = 0.02,
) -> RobotLog:
    """Return the log of a robot that drives the corridors of a building and prefers those that it has driven least.

    Parameters
    ----------
    plan : FloorPlan
        It must have centrelines.
    length : float
        Approximate length of the path, metres.
    laser : LaserConfig
    seed : int
    wheels : WheelErrors, optional
    range_std : float
        Standard deviation of a range, metres.

    Returns
    -------
    RobotLog
        Its reference poses are the true ones.
    """
    rng, wheels = np.random.default_rng(seed), wheels or WheelErrors()
    poses = _with_turns(_drive(plan, length, rng))
    index, beams = build_wall_index(plan, laser.range_max), laser_beams(laser)
    ranges, inverse = np.empty((len(poses), laser.num_beams)), np.empty(2 * laser.num_beams)
    for pose, row in zip(poses, ranges, strict=True):
        scan_row(index, 0, tuple(pose.tolist()), beams, inverse, row)
    hit = ranges < laser.range_max
    ranges = np.where(hit, np.maximum(ranges + range_std * rng.standard_normal(ranges.shape), 0.02), NO_HIT)
    driven = np.append(0.0, np.linalg.norm(np.diff(poses[:, :2], axis=0), axis=1))
    return RobotLog(
        name=f"{plan.name} simulated",
        times=np.cumsum(np.maximum(driven / SPEED, 0.1)),
        ranges=ranges.astype(np.float32),
        laser=laser,
        odometry=_odometry(poses, driven, wheels, rng),
        reference=poses,
    )


def _odometry(poses: np.ndarray, driven: np.ndarray, wheels: WheelErrors, rng: np.random.Generator) -> np.ndarray:
    drift, scale, stretch = rng.standard_normal(3) * [
        math.radians(wheels.turn_drift_deg),
        wheels.turn_scale,
        wheels.distance_scale,
    ]
    noise = rng.standard_normal((2, len(poses))) * np.sqrt(driven)
    turns = (1 + scale) * np.append(0.0, np.diff(poses[:, 2])) + drift * driven
    turns += math.radians(wheels.turn_noise_deg) * noise[0]
    advances = (1 + stretch) * driven + wheels.distance_noise * noise[1]
    headings = np.cumsum(turns)
    middle = headings - 0.5 * turns
    return np.column_stack([np.cumsum(advances * np.cos(middle)), np.cumsum(advances * np.sin(middle)), headings])


def _drive(plan: FloorPlan, length: float, rng: np.random.Generator) -> np.ndarray:
    """Return positions `(n, 2)` along the corridors, a little off the middle and clear of the walls."""
    line = LineString(_route(plan, length, rng))
    points = shapely.get_coordinates(line.interpolate(np.arange(0.0, line.length, SPACING)))
    points = gaussian_filter1d(points, ROUNDING / SPACING, axis=0, mode="nearest")
    along = np.gradient(points, axis=0)
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 0.01)
    aside = gaussian_filter1d(rng.standard_normal(len(points)), WANDERING / SPACING, mode="nearest")
    aside *= ASIDE / aside.std()
    points = points + aside[:, None] * np.column_stack([-along[:, 1], along[:, 0]])
    points = gaussian_filter1d(points, ROUNDING / SPACING, axis=0, mode="nearest")
    free = plan.free_space.buffer(-CLEARANCE)
    for i in np.flatnonzero(~shapely.contains_xy(free, points[:, 0], points[:, 1])).tolist():
        nearest = nearest_points(free, shapely.Point(points[i]))[0]
        points[i] = nearest.x, nearest.y
    return points[np.append(True, np.linalg.norm(np.diff(points, axis=0), axis=1) > 1e-3)]


def _route(plan: FloorPlan, length: float, rng: np.random.Generator) -> np.ndarray:
    """Return points `(n, 2)` along the centrelines; at each crossing, the piece that was driven least comes next."""
    lines = [LineString(line) for line in plan.centrelines if len(line) > 1]
    lines += joins(lines, plan.free_space.boundary)
    pieces = shapely.get_parts(shapely.line_merge(shapely.union_all(lines, grid_size=1e-6)))
    ends = shapely.get_coordinates(shapely.get_point(pieces[:, None], [0, -1]))
    nodes = np.unique(ends, axis=0, return_inverse=True)[1].reshape(-1, 2)
    driven, node, last, total, way = np.zeros(len(pieces)), nodes[0, 0], -1, 0.0, []
    while total < length:
        # Turning back counts as four more drives of a piece.
        choices = [
            (driven[k] + rng.random() + 4 * (k == last), k, end) for k, end in np.argwhere(nodes == node).tolist()
        ]
        _, last, end = min(choices)
        piece = shapely.get_coordinates(pieces[last])
        way.append(piece if end == 0 else piece[::-1])
        driven[last] += 1
        total += pieces[last].length
        node = nodes[last, 1 - end]
    return np.concatenate(way)


def _with_turns(points: np.ndarray) -> np.ndarray:
    """Return poses `(m, 3)` at the points, each headed for the next one, with sharp turns made on the spot."""
    headings = np.unwrap(np.arctan2(*np.diff(points, axis=0).T[::-1]))
    counts = np.append(1, 1 + (np.abs(np.diff(headings)) / TURN).astype(np.int64))
    at = np.repeat(np.arange(len(headings)), counts)
    share = np.concatenate([np.arange(1, count + 1) / count for count in counts.tolist()])
    before = headings[np.maximum(at - 1, 0)]
    return np.column_stack([points[at], before + share * (headings[at] - before)])

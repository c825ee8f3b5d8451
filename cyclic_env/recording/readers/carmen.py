"""CARMEN logs: text files with one message per line.

The format is that of CARMEN's logger (Montemerlo, Roy and Thrun 2003), which many public data sets use, among them the
SLAM benchmark of Kuemmerle et al. (2009).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cyclic_env.errors import RecordingError
from cyclic_env.recording.robot_log import RobotLog, laser_of_beams
from cyclic_env.trajectory.poses import interpolate, relative

SCANS = ("ROBOTLASER1", "FLASER", "RAWLASER1")
"""Messages of the front laser. If a log has several kinds, the first in this order is read."""

FLASER_RANGE_MAX = 80.0
"""Metres. FLASER doesn't state the limit of its laser; a SICK LMS reads 81.83 m where it sees nothing."""

MOUNTING_TOLERANCE = 0.01
"""Metres and radians. A laser's pose in the robot's frame that varies by more counts as the robot's corrected pose."""


@dataclass(frozen=True, slots=True)
class LaserScan:
    """One scan message.

    Attributes
    ----------
    time : float
    ranges : list of float
    start, spacing : float
        Angles of beam 0 in the laser's frame, and from each beam to the next, radians.
    range_max : float
    laser_pose, robot_pose : (x, y, heading), or None
    """

    time: float
    ranges: list[float]
    start: float
    spacing: float
    range_max: float
    laser_pose: Sequence[float] | None = None
    robot_pose: Sequence[float] | None = None


def read_carmen(path: Path, range_max: float | None) -> RobotLog:
    """Read a CARMEN log; see `cyclic_env.recording.readers.read_robot_log`."""
    scans: dict[str, list[LaserScan]] = {name: [] for name in SCANS}
    odometry: list[list[float]] = []
    with path.open(encoding="utf-8", errors="replace") as file:
        for number, line in enumerate(file, 1):
            name, *words = line.split() or [""]
            name = "RAWLASER1" if name == "RAWLASER" else name
            try:
                if name == "ODOM":
                    odometry.append([float(words[6]), *map(float, words[:3])])
                elif name == "FLASER":
                    scans[name].append(parse_flaser(words))
                elif name in SCANS:
                    scans[name].append(parse_robot_laser(words, with_poses=name == "ROBOTLASER1"))
            except (ValueError, IndexError) as error:
                raise RecordingError(f"line {number} is damaged: {name} {' '.join(words)[:40]} ...") from error
    kind = next((name for name in SCANS if scans[name]), None)
    if kind is None:
        raise RecordingError(f"holds no scans ({', '.join(SCANS)}).")
    found = scans[kind]
    if kind != "RAWLASER1":
        return log_of_scans(path.stem, found, range_max)
    if len(odometry) < 2:
        raise RecordingError("holds RAWLASER1 scans, but no odometry (ODOM).")
    stamps, poses = np.array(odometry)[:, 0], np.array(odometry)[:, 1:]
    if (np.diff(stamps) < 0).any():
        raise RecordingError("its odometry (ODOM) is not sorted by time.")
    found = [scan for scan in found if stamps[0] <= scan.time <= stamps[-1]]
    return log_of_scans(path.stem, found, range_max, interpolate(_times(found), stamps, poses))


def parse_flaser(words: list[str]) -> LaserScan:
    """Parse ``num_readings [readings] laser_pose robot_pose ipc_timestamp ipc_hostname logger_timestamp``.

    The beams span 180 degrees. An even number of them ends one spacing earlier: 180 beams at -90 to +89 degrees.
    """
    n = int(words[0])
    values = [float(word) for word in words[1 : n + 8]]
    spacing = math.pi / (n - n % 2)
    poses = {"laser_pose": values[n : n + 3], "robot_pose": values[n + 3 : n + 6]}
    return LaserScan(values[n + 6], values[:n], -math.pi / 2, spacing, FLASER_RANGE_MAX, **poses)


def parse_robot_laser(words: list[str], *, with_poses: bool) -> LaserScan:
    """Parse RAWLASER1, or ROBOTLASER1, which has poses.

    ``laser_type start_angle field_of_view angular_resolution maximum_range accuracy remission_mode num_readings
    [readings] num_remissions [remissions]``, then for ROBOTLASER1 ``laser_pose robot_pose tv rv forward_safety_distance
    side_safety_distance turn_axis``, then ``ipc_timestamp ipc_hostname logger_timestamp``.
    """
    start, _, spacing, limit = map(float, words[1:5])
    n = int(words[7])
    ranges = [float(word) for word in words[8 : 8 + n]]
    rest = words[9 + n + int(words[8 + n]) :]
    if not with_poses:
        return LaserScan(float(rest[0]), ranges, start, spacing, limit)
    values = [float(word) for word in rest[:12]]
    return LaserScan(values[11], ranges, start, spacing, limit, values[:3], values[3:6])


def _times(scans: list[LaserScan]) -> np.ndarray:
    return np.array([scan.time for scan in scans])


def log_of_scans(
    name: str,
    scans: list[LaserScan],
    range_max: float | None,
    odometry: np.ndarray | None = None,
    reference: np.ndarray | None = None,
) -> RobotLog:
    """Return the log of scans with equal beams; `odometry` defaults to the robot poses in the scans."""
    if not scans:
        raise RecordingError("holds no scans within the time of its odometry.")
    first = scans[0]
    for i, scan in enumerate(scans):
        if (len(scan.ranges), scan.start, scan.spacing) != (len(first.ranges), first.start, first.spacing):
            raise RecordingError(f"scan {i} has {len(scan.ranges)} beams, or other angles than the first scan.")
    mounting = np.zeros(3)
    if first.laser_pose is not None:
        robot, laser = (np.array([getattr(scan, name) for scan in scans]) for name in ("robot_pose", "laser_pose"))
        odometry = robot if odometry is None else odometry
        offsets = relative(robot, laser)
        if np.abs(relative(offsets[0], offsets)).max() <= MOUNTING_TOLERANCE:
            mounting = offsets[0]
        elif reference is None:
            reference = laser
    ranges = np.array([scan.ranges for scan in scans])
    ranges, laser = laser_of_beams(
        ranges, float(first.start + mounting[2]), first.spacing, range_max or first.range_max
    )
    return RobotLog(
        name=name,
        times=_times(scans),
        ranges=ranges,
        laser=laser,
        laser_position=(float(mounting[0]), float(mounting[1])),
        odometry=np.zeros((len(scans), 3)) if odometry is None else odometry,
        reference=reference,
    )

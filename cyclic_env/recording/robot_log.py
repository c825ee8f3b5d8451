"""The log of a robot that drove through a building: scans and odometry, and their NPZ file."""

from __future__ import annotations

import dataclasses
import json
import math
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cyclic_env.atomic_write import atomic_write
from cyclic_env.config import LaserConfig
from cyclic_env.errors import ConfigError, RecordingError
from cyclic_env.trajectory.poses import relative, wrap_angle
from cyclic_env.validation import from_mapping

LAYOUT = 1
"""Version of the file's layout. Files with another layout are refused."""

NO_HIT = math.inf
"""Range of a beam that hit nothing within `range_max`, or that gave no valid reading (too near, or not a number)."""

NO_HIT_CM = 65_535
"""`NO_HIT` in a file, whose ranges are whole centimetres."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RobotLog:
    """Scans of a laser and the odometry of the robot that carried it.

    Attributes
    ----------
    name : str
    times : (n,) float64
        Time of each scan, seconds, increasing.
    ranges : (n, num_beams) float32
        Metres, or `NO_HIT`.
    laser : LaserConfig
        Its bearings are in the robot's frame.
    laser_position : (x, y)
        Position of the laser in the robot's frame, metres.
    odometry : (n, 3) float64
        Pose x, y, heading of the robot at each scan according to its wheels, metres and radians.
    reference : (n, 3) float64, or None
        The best known poses of the robot, in a frame of their own.
    map_name : str or None
        Name of the floor plan of the building.
    map_transform : (x, y, heading), or None
        Pose of the reference's frame in the floor plan's frame.
    """

    name: str
    times: np.ndarray
    ranges: np.ndarray
    laser: LaserConfig
    odometry: np.ndarray
    laser_position: tuple[float, float] = (0.0, 0.0)
    reference: np.ndarray | None = None
    map_name: str | None = None
    map_transform: tuple[float, float, float] | None = None

    def __post_init__(self) -> None:
        n = len(self.times)
        if n < 2 or self.ranges.shape != (n, self.laser.num_beams):
            raise RecordingError(f"holds {n} times and scans of shape {self.ranges.shape}; expected at least 2 scans.")
        for what, array in (("times", self.times), ("odometry", self.odometry), ("reference poses", self.reference)):
            if array is not None and not (len(array) == n and np.isfinite(array).all()):
                raise RecordingError(f"its {what} must have a finite row for each of {n} scans.")
        earlier = np.flatnonzero(np.diff(self.times) < 0)
        if len(earlier):
            i = int(earlier[0])
            raise RecordingError(
                f"is not sorted by time: scan {i + 1} is {self.times[i] - self.times[i + 1]:.3g} s before scan {i}."
            )

    def __len__(self) -> int:
        return len(self.times)

    @property
    def distance(self) -> np.ndarray:
        """Signed distance driven according to the odometry, metres, `(n,)`; driving backwards subtracts.

        Each step counts with its component along the heading halfway through it, the direction of an arc's chord.
        """
        step = relative(self.odometry[:-1], self.odometry[1:])
        half_turn = 0.5 * wrap_angle(step[:, 2])
        return np.append(0.0, np.cumsum(step[:, 0] * np.cos(half_turn) + step[:, 1] * np.sin(half_turn)))

    def observations(self) -> dict[str, np.ndarray]:
        """Return what an environment's robot would have observed at each scan, float32.

        Returns
        -------
        dict
            ``laser`` `(n, num_beams)`, in which beams without a hit read the laser's maximum; ``distance`` `(n, 1)`,
            the signed distance driven; ``compass`` `(n, 2)`, the odometry's heading as a vector, which drifts.
        """
        heading = self.odometry[:, 2]
        return {
            "laser": np.minimum(self.ranges, np.float32(self.laser.range_max)),
            "distance": self.distance[:, None].astype(np.float32),
            "compass": np.stack([np.cos(heading), np.sin(heading)], axis=1).astype(np.float32),
        }

    def thinned(self, spacing: float, turn: float = math.inf) -> RobotLog:
        """Return the log without scans closer than `spacing` metres of path and `turn` radians to the last one kept.

        Both are measured by the odometry. The first and the last scan are kept.
        """
        step = relative(self.odometry[:-1], self.odometry[1:])
        driven = np.append(0.0, np.cumsum(np.hypot(step[:, 0], step[:, 1])))
        turned = np.append(0.0, np.cumsum(np.abs(step[:, 2])))
        kept, last = [0], len(self) - 1
        for i in range(1, last):
            if driven[i] - driven[kept[-1]] >= spacing or turned[i] - turned[kept[-1]] >= turn:
                kept.append(i)
        return self[np.array([*kept, last])]

    def __getitem__(self, rows: Any) -> RobotLog:
        """Return the log of some of its scans; `rows` is a slice or an array of indices."""
        fields = {name: getattr(self, name) for name in self.__dataclass_fields__}
        for name in ("times", "ranges", "odometry", "reference"):
            fields[name] = None if fields[name] is None else fields[name][rows]
        return RobotLog(**fields)


def laser_of_beams(
    ranges: np.ndarray, first_bearing: float, spacing: float, range_max: float
) -> tuple[np.ndarray, LaserConfig]:
    """Return ranges whose invalid readings are `NO_HIT`, and the laser with these evenly spaced beams.

    Parameters
    ----------
    ranges : (n, num_beams) array
        Metres; a beam that repeats beam 0 after a full turn is left out.
    first_bearing, spacing : float
        Bearing of beam 0 in the robot's frame, and the angle from each beam to the next (clockwise: negative), radians.
    range_max : float
        Readings of this range, in metres, or more count as no hit.

    Raises
    ------
    RecordingError
        If there is no such laser.
    """
    if spacing < 0:
        ranges, first_bearing, spacing = ranges[:, ::-1], first_bearing + spacing * (ranges.shape[1] - 1), -spacing
    in_a_turn = round(math.tau / spacing) if spacing > 0 else 0
    if abs(in_a_turn * spacing - math.tau) < 0.5 * spacing:
        ranges = ranges[:, :in_a_turn]
    beams = ranges.shape[1]
    all_around = beams == in_a_turn
    field_of_view = math.tau if all_around else (beams - 1) * spacing
    try:
        laser = LaserConfig(
            num_beams=beams,
            range_max=range_max,
            field_of_view=field_of_view,
            mounting_angle=float(wrap_angle(first_bearing + (0.0 if all_around else 0.5 * field_of_view))),
        )
    except ConfigError as error:
        raise RecordingError(f"its laser is impossible: {error}") from error
    ranges = np.asarray(ranges, np.float32)
    return np.where((ranges > 0) & (ranges < range_max), ranges, np.float32(NO_HIT)), laser


_HEADER = ("name", "laser_position", "map_name", "map_transform")


def write_robot_log(log: RobotLog, path: str | Path) -> None:
    """Write a log as an NPZ file: ranges as whole centimetres, poses in single precision.

    Raises
    ------
    RecordingError
        If the file can't be written.
    """
    header = {"layout": LAYOUT, "kind": "robot log", "laser": dataclasses.asdict(log.laser)}
    header |= {name: getattr(log, name) for name in _HEADER}
    hits = np.isfinite(log.ranges)
    centimetres = np.where(hits, np.round(100 * np.where(hits, log.ranges, 0)), NO_HIT_CM).astype(np.uint16)
    arrays = {"ranges_cm": centimetres, "times": log.times, "odometry": log.odometry.astype(np.float32)}
    if log.reference is not None:
        arrays["reference"] = log.reference.astype(np.float32)
    try:
        with atomic_write(path) as part, part.open("wb") as file:
            np.savez_compressed(file, header=np.frombuffer(json.dumps(header).encode(), np.uint8), **arrays)
    except OSError as error:
        raise RecordingError(f"{path}: can't be written: {error.strerror or error}.") from error


def read_npz(path: Path) -> RobotLog:
    """Read what `write_robot_log` wrote; `cyclic_env.recording.readers.read_robot_log` reads any format.

    Raises
    ------
    RecordingError
        If the file is damaged, not a log, or has another layout; the message doesn't name the file.
    """
    if not zipfile.is_zipfile(path):
        raise RecordingError("is not an NPZ file, or was cut off.")
    with np.load(path, allow_pickle=False) as file:
        header = json.loads(file["header"].tobytes()) if "header" in file.files else {}
        if header.get("kind") != "robot log":
            raise RecordingError("is an NPZ file, but not the log of a robot.")
        if header["layout"] != LAYOUT:
            raise RecordingError(f"has layout {header['layout']}; this version of cyclic_env reads layout {LAYOUT}.")
        centimetres = file["ranges_cm"]
        ranges = np.where(centimetres == NO_HIT_CM, NO_HIT, centimetres / 100).astype(np.float32)
        transform = header["map_transform"]
        return RobotLog(
            **{name: header[name] for name in _HEADER}
            | {"laser_position": tuple(header["laser_position"]), "map_transform": transform and tuple(transform)},
            laser=from_mapping(LaserConfig, header["laser"]),
            times=file["times"],
            ranges=ranges,
            odometry=file["odometry"].astype(np.float64),
            reference=file["reference"].astype(np.float64) if "reference" in file.files else None,
        )

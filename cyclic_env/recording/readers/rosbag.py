"""ROS 1 and ROS 2 bags: LaserScan, Odometry and tf. Needs the package rosbags (the extra ``logs``), but no ROS."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from cyclic_env.errors import ConfigError, RecordingError
from cyclic_env.recording.robot_log import NO_HIT, RobotLog, laser_of_beams
from cyclic_env.trajectory.poses import interpolate

SCAN, ODOMETRY = "sensor_msgs/msg/LaserScan", "nav_msgs/msg/Odometry"
TRANSFORMS = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")

Frames = dict[str, tuple[str, np.ndarray]]
"""The parent of each frame, and the frame's pose in it as a homogeneous matrix `(4, 4)`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BagOptions:
    """What a bag may leave open.

    Attributes
    ----------
    scan_topic, odometry_topic : str or None
        Needed if the bag has several topics of that type.
    mounting : (x, y, heading), or None
        Pose of the laser in the robot's frame, metres and radians. Default: from tf.
    odometry_frame : str
        Frame of the odometry in tf, which is read if there are no Odometry messages.
    """

    scan_topic: str | None = None
    odometry_topic: str | None = None
    mounting: tuple[float, float, float] | None = None
    odometry_frame: str = "odom"


def read_bag(path: Path, range_max: float | None, options: BagOptions) -> RobotLog:
    """Read a bag; see `cyclic_env.recording.readers.read_robot_log`."""
    try:
        from rosbags.highlevel import AnyReader, AnyReaderError
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise ConfigError('reading bags needs rosbags, which is missing; pip install "cyclic-loop[logs]".') from error
    try:
        with AnyReader([path], default_typestore=get_typestore(Stores.LATEST)) as reader:
            scans = [message for _, message in _messages(reader, SCAN, options.scan_topic)]
            odometry = list(_messages(reader, ODOMETRY, options.odometry_topic, required=False))
            frames, moving = _transforms(reader, options.odometry_frame)
    except AnyReaderError as error:
        raise RecordingError(f"can't be read as a bag: {error}") from error
    if odometry:
        stamps = np.array([_seconds(message.header.stamp) for _, message in odometry])
        poses = np.array([_planar(_matrix(m.pose.pose.position, m.pose.pose.orientation)) for _, m in odometry])
        base = odometry[0][1].child_frame_id
    elif moving:
        stamps, poses = np.array([stamp for stamp, _, _ in moving]), np.array([_planar(m) for _, _, m in moving])
        base = moving[0][1]
    else:
        raise RecordingError(f"holds no Odometry messages, and no tf from {options.odometry_frame!r}.")
    if (np.diff(stamps) < 0).any():
        raise RecordingError("its odometry is not sorted by time.")
    mounting = options.mounting
    flipped = False
    if mounting is None:
        matrix = _pose_in(frames, _frame(scans[0].header.frame_id), _frame(base))
        flipped, mounting = matrix[2, 2] < 0, tuple(_planar(matrix).tolist())
    return _log(path.stem, scans, (stamps, poses), mounting, flipped, range_max)


def _log(
    name: str,
    scans: list[Any],
    odometry: tuple[np.ndarray, np.ndarray],
    mounting: tuple[float, ...],
    flipped: bool,
    range_max: float | None,
) -> RobotLog:
    """Return the log of the LaserScan messages within the time of the odometry."""
    stamps, poses = odometry
    scans = [scan for scan in scans if stamps[0] <= _seconds(scan.header.stamp) <= stamps[-1]]
    if not scans:
        raise RecordingError("holds no scans within the time of its odometry.")
    first = scans[0]
    for i, scan in enumerate(scans):
        if (len(scan.ranges), scan.angle_min) != (len(first.ranges), first.angle_min):
            raise RecordingError(f"scan {i} has {len(scan.ranges)} beams, or other angles than the first scan.")
    ranges = np.array([scan.ranges for scan in scans], np.float32)
    ranges[~(ranges >= first.range_min)] = NO_HIT
    side = -1 if flipped else 1  # a laser that hangs upside down turns the other way
    start, spacing = side * float(first.angle_min) + mounting[2], side * float(first.angle_increment)
    ranges, laser = laser_of_beams(ranges, start, spacing, range_max or float(first.range_max))
    times = np.array([_seconds(scan.header.stamp) for scan in scans])
    return RobotLog(
        name=name,
        times=times,
        ranges=ranges,
        laser=laser,
        laser_position=(mounting[0], mounting[1]),
        odometry=interpolate(times, stamps, poses),
    )


def _messages(reader: Any, kind: str, topic: str | None, *, required: bool = True) -> Iterator[tuple[str, Any]]:
    """Yield each message of a type, with its topic, from the topic given or the only one."""
    topics = sorted({connection.topic for connection in reader.connections if connection.msgtype == kind})
    short = kind.rpartition("/")[2]
    if topic is not None and topic not in topics:
        raise RecordingError(f"has no {short} topic {topic!r}; it has {', '.join(topics) or 'none'}.")
    if topic is None and len(topics) > 1:
        raise RecordingError(f"has several {short} topics, of which you must choose one: {', '.join(topics)}.")
    if required and not topics:
        raise RecordingError(f"holds no {short} messages.")
    chosen = [c for c in reader.connections if c.msgtype == kind and c.topic == (topic or topics[0])] if topics else []
    if chosen:
        for connection, _, data in reader.messages(connections=chosen):
            yield connection.topic, reader.deserialize(data, connection.msgtype)


def _transforms(reader: Any, odometry_frame: str) -> tuple[Frames, list[tuple[float, str, np.ndarray]]]:
    """Return the first transform to each frame, and all transforms from the odometry's frame: time, frame, matrix."""
    frames: Frames = {}
    moving: list[tuple[float, str, np.ndarray]] = []
    chosen = [c for c in reader.connections if c.msgtype in TRANSFORMS]
    for connection, _, data in reader.messages(connections=chosen) if chosen else ():
        for entry in reader.deserialize(data, connection.msgtype).transforms:
            parent, child = _frame(entry.header.frame_id), _frame(entry.child_frame_id)
            matrix = _matrix(entry.transform.translation, entry.transform.rotation)
            if parent == _frame(odometry_frame):
                moving.append((_seconds(entry.header.stamp), child, matrix))
            else:
                frames.setdefault(child, (parent, matrix))
    return frames, moving


def _pose_in(frames: Frames, frame: str, base: str) -> np.ndarray:
    """Return the pose of a frame in the robot's frame, as a homogeneous matrix.

    Raises
    ------
    RecordingError
        If tf doesn't connect them.
    """
    to_root = {}
    for start in (frame, base):
        matrix, at = np.eye(4), start
        to_root[start] = {at: matrix}
        while at in frames and frames[at][0] not in to_root[start]:
            parent, pose = frames[at]
            matrix, at = pose @ matrix, parent
            to_root[start][at] = matrix
    common = next((name for name in to_root[frame] if name in to_root[base]), None)
    if common is None:
        raise RecordingError(
            f"its tf doesn't connect the laser ({frame!r}) with the robot ({base!r}); give the laser's mounting."
        )
    return np.linalg.inv(to_root[base][common]) @ to_root[frame][common]


def _frame(name: str) -> str:
    return name.lstrip("/")


def _seconds(stamp: Any) -> float:
    return stamp.sec + 1e-9 * stamp.nanosec


def _matrix(position: Any, orientation: Any) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_quat([orientation.x, orientation.y, orientation.z, orientation.w]).as_matrix()
    matrix[:3, 3] = position.x, position.y, position.z
    return matrix


def _planar(matrix: np.ndarray) -> np.ndarray:
    """Return x, y, heading of a pose in space, the heading being that of its x axis."""
    return np.array([matrix[0, 3], matrix[1, 3], np.arctan2(matrix[1, 0], matrix[0, 0])])

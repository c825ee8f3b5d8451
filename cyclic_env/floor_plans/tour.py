"""The shortest closed tour that drives every corridor: route inspection on the graph of the centrelines."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import networkx as nx
import numpy as np
import shapely
from shapely.geometry import LineString, MultiLineString


def closed_tour(lines: Sequence[LineString], resolution: float = 1e-6) -> float:
    """Return the length of the shortest closed tour that drives every line at least once, metres.

    Parameters
    ----------
    lines : sequence of LineString
        Metres. They meet where they touch or cross; lines that coincide are one corridor.
    resolution : float
        Points closer together than this count as one, metres.

    Returns
    -------
    float
        The length of a loop, twice that of a single open line. NaN where there is no tour: there are no lines, they
        have no length, or they are not all connected.
    """
    graph = corridor_graph(lines, resolution)
    if not graph or not nx.is_connected(graph):
        return math.nan
    return graph.size(weight="weight") + repeated_length(graph)


def closed_tour_path(lines: Sequence[LineString], resolution: float = 1e-6) -> np.ndarray:
    """Return the corners `(n, 2)` of a shortest closed tour, as `closed_tour` measures it; the last is the first again.

    It is empty where there is no tour.
    """
    graph = corridor_graph(lines, resolution)
    if not graph or not nx.is_connected(graph):
        return np.zeros((0, 2))
    for way in repeated_ways(graph):
        for a, b in pairwise(way):
            shortest = min(graph[a][b].values(), key=lambda edge: edge["weight"])
            graph.add_edge(a, b, **shortest)
    parts = []
    for a, b, key in nx.eulerian_circuit(graph, keys=True):
        edge = graph.edges[a, b, key]
        parts.append(edge["line"] if edge["first"] == a else edge["line"][::-1])
    return np.concatenate([part[:-1] for part in parts] + [parts[0][:1]])


def corridor_graph(lines: Sequence[LineString], resolution: float) -> nx.MultiGraph:
    """Cut lines where they meet; return a graph whose edges are the pieces, with their lengths as weights.

    An edge also has its piece as a ``line`` `(n, 2)`, which begins at the node ``first``.
    """
    pieces = shapely.get_parts(shapely.line_merge(shapely.union_all(lines, grid_size=resolution)))
    points = shapely.get_coordinates(shapely.get_point(pieces[:, None], [0, -1]))
    _, nodes = np.unique(points, axis=0, return_inverse=True)
    graph = nx.MultiGraph()
    for (a, b), piece in zip(nodes.reshape(-1, 2).tolist(), pieces, strict=True):
        graph.add_edge(a, b, weight=piece.length, line=shapely.get_coordinates(piece), first=a)
    return graph


def repeated_length(graph: nx.MultiGraph) -> float:
    """Return the length of the edges of a connected graph that a shortest closed tour drives a second time."""
    return sum(nx.path_weight(graph, way, "weight") for way in repeated_ways(graph))


def repeated_ways(graph: nx.MultiGraph) -> list[list[int]]:
    """Return the paths in a connected graph that a shortest closed tour drives a second time, as lists of nodes.

    They are shortest paths between pairs of nodes where an odd number of edges meets, paired so that their total is
    least: J. Edmonds and E. L. Johnson, "Matching, Euler tours and the Chinese postman", Mathematical Programming 5
    (1973).
    """
    odd = [node for node, degree in graph.degree() if degree % 2]
    detours = nx.Graph()
    for i, node in enumerate(odd):
        distances = nx.single_source_dijkstra_path_length(graph, node)
        detours.add_weighted_edges_from((node, other, distances[other]) for other in odd[i + 1 :])
    pairs = nx.min_weight_matching(detours)
    return [nx.dijkstra_path(graph, a, b) for a, b in pairs]


def joins(lines: Sequence[LineString], walls: shapely.Geometry) -> list[LineString]:
    """Return the short lines that join the end of a line to another line, or to its own other end, that it just misses.

    A join is at most half as long as either corridor is wide, measured as the distance to the nearest wall, so that
    there is no wall in between. An end that meets another line needs no join.
    """
    found = []
    for i, line in enumerate(lines):
        start, end = shapely.get_point(line, [0, -1])
        others = MultiLineString([*lines[:i], *lines[i + 1 :]])
        for point, target in ((start, others), (end, others), (start, end)):
            join = shapely.shortest_line(point, target)  # None where there are no others
            if join and 0 < join.length <= shapely.distance(walls, shapely.get_point(join, [0, -1])).max():
                found.append(join)
    return found

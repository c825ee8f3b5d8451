"""The grid that a generated building is laid out on, and the straight corridors along its edges."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

from cyclic_env.floor_plans.generator.spec import Draw

SLOT_LENGTH = 4.0
"""Least length of a slot, a stretch of a corridor's side with at most one niche, metres."""
MAX_SLOTS = 16
CLEAR_OF_CROSSING = 1.5
"""Distance from a crossing, or from the end of a corridor, to the first slot, metres."""
TURN_SHARE = 0.7
"""Share of the nodes at which a path without cycles turns."""

Node = tuple[int, int]
Edge = tuple[Node, Node]
Point = tuple[float, float]
Box = tuple[float, float, float, float]
"""West, south, east and north, metres."""


def grow_edges(draw: Draw, cycles: int, joined: int) -> list[Edge]:
    """Return the edges of a connected grid with `cycles` faces, made of `cycles + joined` squares.

    Squares are added one by one beside random others, such that they never enclose a gap. Then `joined` edges between
    two faces are removed, the smallest faces first, together with edges that then lead nowhere.
    """
    cells: list[Node] = [(0, 0)]
    while len(cells) < cycles + joined:
        beside = sorted({side for cell in cells for side in _neighbours(cell)} - set(cells))
        beside = [cell for cell in beside if _faces(_sides([*cells, cell])) == len(cells) + 1]
        cells.append(beside[draw.below(len(beside))])
    edges = _sides(cells)
    face = {cell: i for i, cell in enumerate(cells)}
    for _ in range(joined):
        between = [(edge, [face[cell] for cell in _beside(edge) if cell in face]) for edge in edges]
        between = [(edge, pair) for edge, pair in between if len(set(pair)) == 2]
        sizes = [sum(owner in pair for owner in face.values()) for _, pair in between]
        smallest = [item for item, size in zip(between, sizes, strict=True) if size == min(sizes)]
        edge, (first, second) = smallest[draw.below(len(smallest))]
        edges.remove(edge)
        face = {cell: first if owner == second else owner for cell, owner in face.items()}
    return _without_stubs(edges)


def grow_path(draw: Draw, count: int) -> list[Edge]:
    """Return the edges of a path on a grid, which leads east or north and turns at most nodes."""
    nodes, east = [(0, 0)], draw.chance(0.5)
    for _ in range(count):
        x, y = nodes[-1]
        nodes.append((x + 1, y) if east else (x, y + 1))
        east = east != draw.chance(TURN_SHARE)
    return list(pairwise(nodes))


def _neighbours(cell: Node) -> list[Node]:
    x, y = cell
    return [(x - 1, y), (x, y - 1), (x, y + 1), (x + 1, y)]


def _sides(cells: Sequence[Node]) -> list[Edge]:
    """Return the edges around all cells, sorted; cell (x, y) lies north-east of node (x, y)."""
    return sorted(
        {
            edge
            for x, y in cells
            for edge in (
                ((x, y), (x + 1, y)),
                ((x, y + 1), (x + 1, y + 1)),
                ((x, y), (x, y + 1)),
                ((x + 1, y), (x + 1, y + 1)),
            )
        }
    )


def _beside(edge: Edge) -> tuple[Node, Node]:
    """Return the cells on both sides of an edge."""
    (x, y), (_, end) = edge
    return ((x, y), (x, y - 1)) if end == y else ((x, y), (x - 1, y))


def _faces(edges: Sequence[Edge]) -> int:
    """Return how many faces the edges of a connected graph enclose, by Euler's formula."""
    return len(edges) - len({node for edge in edges for node in edge}) + 1


def _without_stubs(edges: list[Edge]) -> list[Edge]:
    """Remove edges with a dead end until there are none, and return the others."""
    while True:
        nodes = [node for edge in edges for node in edge]
        kept = [edge for edge in edges if all(nodes.count(node) > 1 for node in edge)]
        if len(kept) == len(edges):
            return kept
        edges = kept


class Module(NamedTuple):
    """The appearance of a corridor of any length: its width in metres, and random numbers from 0 to 1."""

    width: float
    niches: list[list[list[float]]]  # (2, MAX_SLOTS, 4): side and slot; kind, length, place, depth
    room: list[float]  # side, place, length, depth, door


class Corridor(NamedTuple):
    """A straight stretch of corridor: from `base` in the direction `along`, a unit vector along an axis."""

    base: Point
    along: Node
    length: float
    module: Module
    first: float  # it can have rooms and niches from here, metres from the base,
    last: float  # to here

    @property
    def half(self) -> float:
        """Half of the width, metres."""
        return self.module.width / 2

    def at(self, s: float, t: float = 0.0) -> Point:
        """Return the point `s` metres along the corridor and `t` to its left, to the centimetre."""
        (x, y), (dx, dy) = self.base, self.along
        return round(x + s * dx - t * dy, 2), round(y + s * dy + t * dx, 2)

    def box(self, s1: float, s2: float, t1: float, t2: float) -> Box:
        """Return a rectangle along the corridor."""
        (x1, y1), (x2, y2) = self.at(s1, t1), self.at(s2, t2)
        return min(x1, x2), min(y1, y2), max(x1, x2), max(y1, y2)

    def slots(self) -> list[tuple[float, float]]:
        """Return the beginning and end of each slot of a side, metres along the corridor."""
        first, last = self.first + CLEAR_OF_CROSSING, self.last - CLEAR_OF_CROSSING
        count = min(math.floor(max(last - first, 0.0) / SLOT_LENGTH), MAX_SLOTS)
        ends = [first + (last - first) * i / max(count, 1) for i in range(count + 1)]
        return list(pairwise(ends))

    def branch_positions(self) -> list[float]:
        """Return where a dead end can branch off, in metres along the corridor, one metre apart."""
        first, last = self.first + CLEAR_OF_CROSSING, self.last - CLEAR_OF_CROSSING
        return [first + i for i in range(math.floor(max(last - first, 0.0)) + 1)]

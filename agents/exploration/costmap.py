"""A grid around the robot, drawn from the scans nearby, and the shortest ways over it."""

from __future__ import annotations

import math

import numpy as np

from agents.slam.scan_filters import SHORT_OF_REACH
from cyclic_env.jit import compiled

CELL = 0.2
"""Metres: less than the robot's radius, so that a doorway is some cells wide."""
CELLS = 128
"""Cells to a side: a little more than the laser's reach to all sides."""
CLEARANCE = 0.28
"""Metres between the centres of a cell that the robot may be in and one with a wall."""
COMFORT = 0.7
"""Metres from walls up to which a way costs more, so that it keeps to the middle."""
DRIVEN_COST = 3.0
"""Of a metre where the robot has been, whatever scans say of walls there: it always knows the way that it came."""
NEAR = 0.7
"""Metres from a point to the end of a way to it: the point may be by a wall."""


@compiled
def draw_scan(ranges, range_max, x, y, heading, left, bottom, passes, hits):
    """Count in `passes` and `hits` `(CELLS, CELLS)`, indexed [row, column], the cells that beams cross and end in.

    (left, bottom) is the grid's corner.
    """
    n = ranges.shape[0]
    spacing = 2 * math.pi / n
    for k in range(n):
        angle = heading + k * spacing
        cos, sin = math.cos(angle) / CELL, math.sin(angle) / CELL
        x0, y0 = (x - left) / CELL, (y - bottom) / CELL
        r = ranges[k]
        step = 0.0
        while step < r - 0.1:
            i, j = math.floor(y0 + step * sin), math.floor(x0 + step * cos)
            if 0 <= i < CELLS and 0 <= j < CELLS:
                passes[i, j] += 1
            step += 0.7 * CELL
        if r < range_max - SHORT_OF_REACH:
            r += 0.05  # the surface is the near side of the wall
            i, j = math.floor(y0 + r * sin), math.floor(x0 + r * cos)
            if 0 <= i < CELLS and 0 <= j < CELLS:
                hits[i, j] += 1


@compiled
def inflate(passes, hits, cost):
    """Write into `cost` `(CELLS, CELLS)` what a metre through each cell costs; inf where the robot can't be."""
    reach = int(COMFORT / CELL) + 1
    for i in range(CELLS):
        for j in range(CELLS):
            cost[i, j] = 1.0 if passes[i, j] > 0 else math.inf
    for i in range(CELLS):
        for j in range(CELLS):
            # A beam that grazes a wall passes its cells too; a stray end in free space is noise.
            if hits[i, j] == 0 or (3 * hits[i, j] < passes[i, j]):
                continue
            for a in range(max(0, i - reach), min(CELLS, i + reach + 1)):
                for b in range(max(0, j - reach), min(CELLS, j + reach + 1)):
                    distance = CELL * math.sqrt((a - i) ** 2 + (b - j) ** 2)
                    if distance <= CLEARANCE:
                        cost[a, b] = math.inf
                    elif distance < COMFORT:
                        cost[a, b] = max(cost[a, b], 1.0 + 1.5 * (COMFORT - distance) / COMFORT)


@compiled
def clear_driven(legs, left, bottom, cost):
    """Let the robot be, in `cost`, wherever it has driven: on straight legs `(n, 2, 2)`, metres."""
    for k in range(legs.shape[0]):
        x, y = (legs[k, 0, 0] - left) / CELL, (legs[k, 0, 1] - bottom) / CELL
        dx, dy = (legs[k, 1, 0] - legs[k, 0, 0]) / CELL, (legs[k, 1, 1] - legs[k, 0, 1]) / CELL
        steps = int(2 * math.sqrt(dx * dx + dy * dy)) + 1
        for step in range(steps + 1):
            i, j = math.floor(y + dy * step / steps), math.floor(x + dx * step / steps)
            if 0 <= i < CELLS and 0 <= j < CELLS:
                cost[i, j] = min(cost[i, j], DRIVEN_COST)


@compiled
def cost_to_go(cost, row, column, costs_to_go, predecessors, queue, waiting):
    """Write the least costs of ways from a cell to all others, and the cell before each on its way, as flat indices.

    `costs_to_go` and `predecessors` are `(CELLS, CELLS)`; `queue` `(CELLS**2,)` and `waiting` `(CELLS, CELLS)` are
    scratch. If the robot is where it can't be, its ways lead out of there first.
    """
    for i in range(CELLS):
        for j in range(CELLS):
            costs_to_go[i, j] = math.inf
            predecessors[i, j] = -1
            waiting[i, j] = False
    costs_to_go[row, column] = 0.0
    size = CELLS * CELLS
    queue[0], head, count = row * CELLS + column, 0, 1
    while count > 0:
        cell = queue[head]
        head = (head + 1) % size
        count -= 1
        i, j = cell // CELLS, cell % CELLS
        waiting[i, j] = False
        for a in range(max(0, i - 1), min(CELLS, i + 2)):
            for b in range(max(0, j - 1), min(CELLS, j + 2)):
                each = cost[a, b]
                if each == math.inf:
                    if (a - row) ** 2 + (b - column) ** 2 > 4:
                        continue
                    each = 10.0
                total = costs_to_go[i, j] + each * CELL * math.sqrt((a - i) ** 2 + (b - j) ** 2)
                if total < costs_to_go[a, b] - 1e-9:
                    costs_to_go[a, b] = total
                    predecessors[a, b] = cell
                    if not waiting[a, b]:
                        queue[(head + count) % size] = a * CELLS + b
                        count += 1
                        waiting[a, b] = True


@compiled
def costs_near(costs_to_go, points, costs, cells):
    """Write the least cost of a way that ends within `NEAR` of each point `(n, 2)`, in cells, and its last cell.

    The rest of the way, as the crow flies, counts double: nearer ends are better ones.
    """
    reach = int(NEAR / CELL)
    for k in range(points.shape[0]):
        costs[k], cells[k] = math.inf, -1
        i, j = math.floor(points[k, 1]), math.floor(points[k, 0])
        for a in range(max(0, i - reach), min(CELLS, i + reach + 1)):
            for b in range(max(0, j - reach), min(CELLS, j + reach + 1)):
                rest = CELL * math.sqrt((a - i) ** 2 + (b - j) ** 2)
                if rest <= NEAR and costs_to_go[a, b] + 2 * rest < costs[k]:
                    costs[k], cells[k] = costs_to_go[a, b] + 2 * rest, a * CELLS + b


class Costmap:
    """The grid, redrawn around the robot whenever it is asked for."""

    def __init__(self) -> None:
        self._passes = np.zeros((CELLS, CELLS), np.int32)
        self._hits = np.zeros((CELLS, CELLS), np.int32)
        self._cell_cost = np.zeros((CELLS, CELLS))
        self._costs_to_go = np.full((CELLS, CELLS), np.inf)
        self._predecessors = np.zeros((CELLS, CELLS), np.int64)
        self._queue = np.zeros(CELLS * CELLS, np.int64)
        self._waiting = np.zeros((CELLS, CELLS), np.bool_)
        self._left = self._bottom = 0.0

    def draw(self, pose, scans, poses, legs, range_max: float) -> None:
        """Draw scans `(n, beams)` taken at poses `(n, 3)`, and driven legs, around a pose; spread ways from it."""
        self._left, self._bottom = pose[0] - CELLS * CELL / 2, pose[1] - CELLS * CELL / 2
        self._passes[:] = 0
        self._hits[:] = 0
        for scan, (x, y, heading) in zip(scans, poses, strict=True):
            draw_scan(scan, range_max, x, y, heading, self._left, self._bottom, self._passes, self._hits)
        inflate(self._passes, self._hits, self._cell_cost)
        clear_driven(legs, self._left, self._bottom, self._cell_cost)
        middle = CELLS // 2
        cost_to_go(self._cell_cost, middle, middle, self._costs_to_go, self._predecessors, self._queue, self._waiting)

    def costs_to(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the costs `(n,)` of the ways to points `(n, 2)`, inf where none is known, and their last cells."""
        costs, cells = np.empty(len(points)), np.empty(len(points), np.int64)
        costs_near(self._costs_to_go, (points - (self._left, self._bottom)) / CELL, costs, cells)
        return costs, cells

    def path_to(self, cell: int) -> np.ndarray:
        """Return the centres `(m, 2)` of the cells on the way to a flat cell, the robot's own first."""
        path = [cell]
        while self._predecessors[path[-1] // CELLS, path[-1] % CELLS] >= 0:
            path.append(self._predecessors[path[-1] // CELLS, path[-1] % CELLS])
        cells = np.array(path[::-1])
        return np.column_stack([cells % CELLS, cells // CELLS]) * CELL + (
            self._left + CELL / 2,
            self._bottom + CELL / 2,
        )

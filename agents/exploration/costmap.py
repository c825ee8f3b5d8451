"""A costmap: a grid around the robot, drawn from the scans nearby, and the cheapest paths over it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from agents.component_config import ComponentConfig, kernel_tuple, pack
from agents.slam.scan_filters import SHORT_OF_REACH
from cyclic_env.jit import compiled


@dataclass(frozen=True, slots=True, kw_only=True)
class CostmapConfig(ComponentConfig):
    """The size of the grid, and what a metre costs where; lengths in metres."""

    cell: float = 0.2
    """Side of a cell; less than the robot's radius, so that a doorway is several cells wide."""
    cells: int = 128
    """Number of cells along a side; the grid extends a little beyond the laser's reach."""
    beam_step: float = 0.7
    """Distance between the points of a beam that are marked as free, in cells."""
    beam_margin: float = 0.1
    """Length at the end of a beam that is not marked as free."""
    wall_depth: float = 0.05
    """Distance from an endpoint, on the wall's surface, to the point inside the wall whose cell is marked."""
    passes_per_hit: int = 3
    """Number of beams that must pass a cell for each that ends in it, for the ends to be taken for noise."""
    clearance: float = 0.28
    """Least distance between the centres of the robot's cell and of a wall's: the robot's radius and a margin."""
    comfort: float = 0.7
    """Distance from walls within which a path costs more, so that it keeps to the middle of corridors."""
    comfort_cost: float = 1.5
    """Additional cost of a metre right at a wall."""
    driven_cost: float = 3.0
    """Greatest cost of a metre where the robot has driven, whatever scans show there, so that it can always go back."""
    escape_cells: int = 2
    escape_cost: float = 10.0
    """If the robot is in forbidden cells, it may leave through this many of them, at this cost per metre."""
    end_radius: float = 0.7
    """Greatest distance from a point to the end of a path to it, since the point may be close to a wall."""


CostmapValues = kernel_tuple("CostmapValues", CostmapConfig, __name__)


class Grid(NamedTuple):
    """Arrays of a costmap, `(cells, cells)`, indexed [row, column], and its south-western corner, `(2,)`, metres."""

    corner: np.ndarray
    passes: np.ndarray
    """Number of beams that cross each cell."""
    hits: np.ndarray
    """Number of beams that end in each cell."""
    cost: np.ndarray
    """Cost of a metre in each cell; inf where the robot can't be."""
    costs_to_go: np.ndarray
    """Cost of the cheapest path to each cell from where the paths begin."""
    predecessors: np.ndarray
    """The cell before each cell on that path, as a flat index; -1 if there is none."""


@compiled
def draw_scan(grid, ranges, range_max, pose, values):
    """Count the cells that the beams of a scan cross and end in."""
    n, cells = ranges.shape[0], grid.passes.shape[0]
    spacing = 2 * math.pi / n
    for k in range(n):
        angle = pose[2] + k * spacing
        cos, sin = math.cos(angle) / values.cell, math.sin(angle) / values.cell
        x0, y0 = (pose[0] - grid.corner[0]) / values.cell, (pose[1] - grid.corner[1]) / values.cell
        r = ranges[k]
        along = 0.0
        while along < r - values.beam_margin:
            i, j = math.floor(y0 + along * sin), math.floor(x0 + along * cos)
            if 0 <= i < cells and 0 <= j < cells:
                grid.passes[i, j] += 1
            along += values.beam_step * values.cell
        if 0.0 < r < range_max - SHORT_OF_REACH:
            r += values.wall_depth
            i, j = math.floor(y0 + r * sin), math.floor(x0 + r * cos)
            if 0 <= i < cells and 0 <= j < cells:
                grid.hits[i, j] += 1


@compiled
def draw_scans(grid, scans, range_max, poses, values):
    """Count the cells that the beams of scans `(n, beams)` at poses `(n, 3)` cross and end in."""
    for k in range(scans.shape[0]):
        draw_scan(grid, scans[k], range_max, poses[k], values)


@compiled
def inflate(grid, values):
    """Write the cost of each cell: 1 where beams have passed, more near walls, inf at walls and in unseen cells."""
    passes, hits, cost, cells = grid.passes, grid.hits, grid.cost, grid.passes.shape[0]
    reach = int(values.comfort / values.cell) + 1
    for i in range(cells):
        for j in range(cells):
            cost[i, j] = 1.0 if passes[i, j] > 0 else math.inf
    for i in range(cells):
        for j in range(cells):
            # Beams that graze a wall also pass its cells, but few ends among many passes are noise in free space.
            if hits[i, j] == 0 or (values.passes_per_hit * hits[i, j] < passes[i, j]):
                continue
            for a in range(max(0, i - reach), min(cells, i + reach + 1)):
                for b in range(max(0, j - reach), min(cells, j + reach + 1)):
                    distance = values.cell * math.sqrt((a - i) ** 2 + (b - j) ** 2)
                    if distance <= values.clearance:
                        cost[a, b] = math.inf
                    elif distance < values.comfort:
                        more = values.comfort_cost * (values.comfort - distance) / values.comfort
                        cost[a, b] = max(cost[a, b], 1.0 + more)


@compiled
def clear_driven(grid, legs, values):
    """Bound the cost where the robot has driven, along straight legs `(n, 2, 2)`, metres."""
    cells, left, bottom = grid.cost.shape[0], grid.corner[0], grid.corner[1]
    for k in range(legs.shape[0]):
        x, y = (legs[k, 0, 0] - left) / values.cell, (legs[k, 0, 1] - bottom) / values.cell
        dx, dy = (legs[k, 1, 0] - legs[k, 0, 0]) / values.cell, (legs[k, 1, 1] - legs[k, 0, 1]) / values.cell
        steps = int(2 * math.sqrt(dx * dx + dy * dy)) + 1
        for step in range(steps + 1):
            i, j = math.floor(y + dy * step / steps), math.floor(x + dx * step / steps)
            if 0 <= i < cells and 0 <= j < cells:
                grid.cost[i, j] = min(grid.cost[i, j], values.driven_cost)


@compiled
def cost_to_go(grid, starts, queue, waiting, values):
    """Write the cost of the cheapest path from any of the starts to each cell, and the cell before it on that path.

    `starts` `(n,)` are flat indices. The first one is the robot's cell, around which it may cross forbidden cells.
    `queue` `(cells**2,)` and `waiting` `(cells, cells)` are scratch space.
    """
    cost, costs_to_go, predecessors = grid.cost, grid.costs_to_go, grid.predecessors
    cells = cost.shape[0]
    for i in range(cells):
        for j in range(cells):
            costs_to_go[i, j] = math.inf
            predecessors[i, j] = -1
            waiting[i, j] = False
    row, column = starts[0] // cells, starts[0] % cells
    size = cells * cells
    head, count = 0, 0
    for start in starts:
        if not waiting[start // cells, start % cells]:
            costs_to_go[start // cells, start % cells] = 0.0
            waiting[start // cells, start % cells] = True
            queue[count] = start
            count += 1
    while count > 0:
        cell = queue[head]
        head = (head + 1) % size
        count -= 1
        i, j = cell // cells, cell % cells
        waiting[i, j] = False
        for a in range(max(0, i - 1), min(cells, i + 2)):
            for b in range(max(0, j - 1), min(cells, j + 2)):
                each = cost[a, b]
                if each == math.inf:
                    if (a - row) ** 2 + (b - column) ** 2 > values.escape_cells**2:
                        continue
                    each = values.escape_cost
                total = costs_to_go[i, j] + each * values.cell * math.sqrt((a - i) ** 2 + (b - j) ** 2)
                if total < costs_to_go[a, b] - 1e-9:
                    costs_to_go[a, b] = total
                    predecessors[a, b] = cell
                    if not waiting[a, b]:
                        queue[(head + count) % size] = a * cells + b
                        count += 1
                        waiting[a, b] = True


@compiled
def costs_near(grid, points, costs, ends, values):
    """Write the least cost of a path that ends near each point `(n, 2)`, given in cells, and that path's last cell.

    The straight rest of the way to the point counts double, so that nearer ends are preferred.
    """
    costs_to_go, cells = grid.costs_to_go, grid.cost.shape[0]
    reach = int(values.end_radius / values.cell)
    for k in range(points.shape[0]):
        costs[k], ends[k] = math.inf, -1
        i, j = math.floor(points[k, 1]), math.floor(points[k, 0])
        for a in range(max(0, i - reach), min(cells, i + reach + 1)):
            for b in range(max(0, j - reach), min(cells, j + reach + 1)):
                rest = values.cell * math.sqrt((a - i) ** 2 + (b - j) ** 2)
                if rest <= values.end_radius and costs_to_go[a, b] + 2 * rest < costs[k]:
                    costs[k], ends[k] = costs_to_go[a, b] + 2 * rest, a * cells + b


class Costmap:
    """A costmap, drawn anew around the robot whenever a path is needed.

    Parameters
    ----------
    range_max : float
        Reach of the laser, metres.
    config : CostmapConfig, optional
    """

    def __init__(self, range_max: float, config: CostmapConfig | None = None) -> None:
        self.range_max = range_max
        self.config = config or CostmapConfig()
        self._values: Any = pack(CostmapValues, self.config)
        shape = (self.config.cells, self.config.cells)
        self._grid = Grid(
            corner=np.zeros(2),
            passes=np.zeros(shape, np.int32),
            hits=np.zeros(shape, np.int32),
            cost=np.zeros(shape),
            costs_to_go=np.full(shape, np.inf),
            predecessors=np.zeros(shape, np.int64),
        )
        self._queue, self._waiting = np.zeros(shape[0] ** 2, np.int64), np.zeros(shape, np.bool_)

    def draw(self, pose: np.ndarray, scans: np.ndarray, poses: np.ndarray, legs: np.ndarray) -> None:
        """Draw the grid around a pose, and find the paths from there.

        Parameters
        ----------
        pose : (3,)
            The pose; a position `(2,)` suffices.
        scans, poses : (n, beams) and (n, 3)
        legs : (m, 2, 2)
            Straight pieces of the path that the robot has driven, metres.
        """
        grid, values = self._grid, self._values
        grid.corner[:] = pose[:2] - self.config.cells * self.config.cell / 2
        grid.passes[:] = 0
        grid.hits[:] = 0
        draw_scans(grid, scans, self.range_max, poses, values)
        inflate(grid, values)
        clear_driven(grid, legs, values)
        self.find_paths(np.array([(self.config.cells + 1) * (self.config.cells // 2)]))

    def find_paths(self, starts: np.ndarray, *, escape: bool = True) -> None:
        """Find the paths from cells, flat indices `(n,)`; `escape` allows forbidden cells around the first one."""
        values = self._values if escape else self._values._replace(escape_cells=0)
        cost_to_go(self._grid, starts, self._queue, self._waiting, values)

    @property
    def cost(self) -> np.ndarray:
        """The cost of a metre in each cell, `(cells, cells)`; inf where the robot can't be."""
        return self._grid.cost

    @property
    def costs_to_go(self) -> np.ndarray:
        """The costs of the paths to all cells, `(cells, cells)`; inf if no path is known."""
        return self._grid.costs_to_go

    def cells_at(self, points: np.ndarray) -> np.ndarray:
        """Return the cells of points `(n, 2)` as flat indices `(n,)`; points off the grid have the nearest cell."""
        columns, rows = np.clip((points - self._grid.corner) // self.config.cell, 0, self.config.cells - 1).T
        return (rows * self.config.cells + columns).astype(np.int64)

    def centers(self, cells: np.ndarray) -> np.ndarray:
        """Return the centres `(n, 2)` of cells, given as flat indices `(n,)`."""
        columns, rows = cells % self.config.cells, cells // self.config.cells
        return np.column_stack([columns, rows]) * self.config.cell + (self._grid.corner + self.config.cell / 2)

    def costs_to(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the costs `(n,)` of the paths to points `(n, 2)`, inf if no path is known, and their last cells."""
        costs, ends = np.empty(len(points)), np.empty(len(points), np.int64)
        costs_near(self._grid, (points - self._grid.corner) / self.config.cell, costs, ends, self._values)
        return costs, ends

    def path_to(self, cell: int) -> np.ndarray:
        """Return the centres `(m, 2)` of the cells on the path to a cell, a flat index, from the robot's on."""
        cells, path = self.config.cells, [cell]
        while self._grid.predecessors[path[-1] // cells, path[-1] % cells] >= 0:
            path.append(self._grid.predecessors[path[-1] // cells, path[-1] % cells])
        return self.centers(np.array(path[::-1]))
